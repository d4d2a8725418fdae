"""Random choice of what a blind case conceals, so large that an optimal estimator sees it.

Sizes: `large` is the plausible size of the catalogue, `middle` a quarter of it, `small` 3.5 times the smallest that an optimal
test sees (`information.detectable_misfit`), against the noise and against the most similar other effect. An effect that the
motion cannot show that clearly at the asked size is not drawn. Effects of stamps and of rounding, which any look at the numbers
shows, have fixed small sizes: a sixteenth of a share or a jitter, an LSB of one standard deviation of the noise; so has the
length of what a reference lost, a quarter of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import numpy as np
from numpy.random import Generator

from imutool.array_types import Float64, Rows6
from imutool.blind_cases import catalogue
from imutool.blind_cases.catalogue import CATALOGUE, NO_LIMIT, clipping
from imutool.blind_cases.detectability import Detectability, detectable_misfit
from imutool.blind_cases.effects import ACCEL, GYRO, Model, Stage, Theta
from imutool.errors import ConfigError, DataError
from imutool.noise.datasheet import SHEETS, Noise

Kind = Literal["single", "pair", "null", "driven", "unknown", "uncalibrated"]
Size = Literal["large", "middle", "small"]
KINDS, SIZES = get_args(Kind), get_args(Size)
MANY = 5  # of the errors of a sensor that was never calibrated
UNCALIBRATED = (
    "gyro_scale",
    "accel_scale",
    "gyro_misalignment",
    "accel_misalignment",
    "gyro_g_sensitivity",
    "lever_arm",
    "gravity",
    "clock_offset",
)
CHANCES = {"single": 0.45, "pair": 0.2, "null": 0.1, "driven": 0.1, "unknown": 0.15}
FACTOR = {"large": 1.0, "middle": 0.25}
FIXED_SMALL = {"dropped_samples": 1 / 16, "timestamp_jitter": 1 / 16, "quantization": 1 / 8, "reference_error": 1 / 8}
CLEAR = 3.5  # times the smallest detectable size
UNNAMED_SHARE = 0.3  # of an unknown's misfit that no effect of the catalogue explains
TRIES, STEPS = 12, 8
TINY = 1e-9
GYRO_BIAS, ACCEL_BIAS = 0.03, 0.3  # rad/s, m/s²: spread of the constant bias every real log has

# two of one row are never concealed together: by definition they are parts of the same thing
ALIKE = (
    {"mount_rotation", "gyro_misalignment", "accel_misalignment"},
    {"lever_arm", "size_effect"},
    {"dropped_samples", "timestamp_jitter"},
)
ONCE = {"gyro_bias_step", "accel_bias_step"}
ALONE = {"reference_error", "earth_rotation"}  # never one of a pair

_FOG_GYRO, _FOG_ACCEL = 5.8e-7, 1e-4
NAVIGATION = Noise(
    gyro_density=(_FOG_GYRO,) * 3,
    accel_density=(_FOG_ACCEL,) * 3,
    sources={"gyro_density": "a fibre-optic gyro of 0.002 deg/sqrt(h)", "accel_density": "10 ug/sqrt(Hz)"},
)
GRADES = {"adis16448": SHEETS["adis16448"], "bmi160": SHEETS["bmi160"], "navigation": NAVIGATION}
GRADE_CHANCES = {"adis16448": 0.475, "bmi160": 0.475, "navigation": 0.05}
Sigma = Float64[np.ndarray, "6"]


@dataclass(frozen=True, eq=False)
class Concealed:
    """Effects of a case with their parameters, and the size each was drawn at (1 is plausible)."""

    kind: str
    size: str
    acting: tuple[tuple[Model, Theta], ...] = ()
    factors: tuple[float, ...] = ()


def draw_effects(seen: Detectability, rng: Generator, kind: Kind, size: Size, effects: Sequence[str] = ()) -> Concealed:
    """Effects of a case of some kind and size; `effects` names them instead of drawing them.

    Raises:
        ConfigError: no such effect.
        DataError: the motion shows nothing of that kind and size.
    """
    for name in effects:
        if name not in CATALOGUE and not (kind == "unknown" and name in catalogue.FORMS):
            raise ConfigError(f"no effect is called {name!r}", where="conceal", expected=f"one of {', '.join(CATALOGUE)}")
    if kind == "null":
        return Concealed(kind, size)
    if kind in ("pair", "uncalibrated"):
        return _together(seen, rng, kind, size, effects)
    for _ in range(TRIES):
        for model, theta in _candidates(seen, rng, kind, effects):
            found = sized(seen, model, theta, size)
            if found is not None and (kind != "unknown" or has_no_name(seen, model, found[0])):
                return Concealed(kind, size, ((model, found[0]),), (found[1],))
    raise _hidden(kind, size, effects)


def _together(seen: Detectability, rng: Generator, kind: Kind, size: Size, effects: Sequence[str]) -> Concealed:
    """Several effects, of which none explains another."""
    count = 2 if kind == "pair" else MANY
    names = effects if effects or kind == "pair" else [str(name) for name in rng.permutation(UNCALIBRATED)]
    for _ in range(TRIES):
        found: list[tuple[Model, Theta, float]] = []
        for model, theta in _candidates(seen, rng, "single", names):
            if any({before.name, model.name} <= row for before, *_ in found for row in ALIKE):
                continue
            at_size = None if model.name in ALONE else sized(seen, model, theta, size)
            if at_size is not None:
                found.append((model, *at_size))
            if len(found) == count:
                break
        if len(found) == count and all(distinct(seen, first[:2], other[:2]) for first, other in combinations(found, 2)):
            acting, factors = tuple((m, theta) for m, theta, _ in found), tuple(factor for *_, factor in found)
            return Concealed(kind, size, acting, factors)
    raise _hidden(kind, size, effects)


def _candidates(seen: Detectability, rng: Generator, kind: str, effects: Sequence[str]) -> list[tuple[Model, Theta]]:
    """Effects in the order in which they are tried, at the plausible size."""
    scene = seen.scene
    if kind == "driven":
        return [catalogue.driven(rng, {topic: float(values.std()) for topic, values in scene.channels.items()})]
    if kind == "unknown":
        return [catalogue.unknown(rng, effects[0] if effects else None)]
    ideal = scene.ideal(seen.t_s)
    names = list(effects) or [str(name) for name in rng.permutation(sorted(CATALOGUE))]
    return [(CATALOGUE[name], draw_parameters(CATALOGUE[name], rng, ideal, scene.noise, scene.duration_s)) for name in names]


def sized(seen: Detectability, model: Model, theta: Theta, size: Size) -> tuple[Theta, float] | None:
    """Parameters at a size, and its ratio to the plausible one; None if no motion shows it."""
    ideal = seen.scene.ideal(seen.t_s)
    fixed = size == "small" and model.name in FIXED_SMALL
    factor = FIXED_SMALL[model.name] if fixed else FACTOR.get(size, 1.0)
    if model.stage == Stage.STAMPS:
        return model.sized(theta, factor, ideal), factor
    wanted = wanted_misfit(model)
    for _ in range(STEPS):
        at = model.sized(theta, factor, ideal)
        shown = max(seen.distinct_misfit(model, at)[0], TINY)
        if size != "small" or fixed:
            return (at, factor) if shown >= wanted else None
        if shown < wanted and factor >= 1.0:
            return None
        if abs(np.log(shown / wanted)) < 0.1:
            return at, factor
        factor = min(factor * float(np.clip(np.sqrt(wanted / shown), 1e-3, 3.0)), 1.0)
    return model.sized(theta, factor, ideal), factor


def wanted_misfit(model: Model) -> float:
    """Squared misfit over the noise that an effect of a case must have."""
    return CLEAR**2 * detectable_misfit(max(int(model.amounts.sum()), 1))


def distinct(seen: Detectability, effect: tuple[Model, Theta], other: tuple[Model, Theta]) -> bool:
    """Whether neither of two effects explains the other."""
    for first, second in ((effect, other), (other, effect)):
        if Stage.STAMPS in (first[0].stage, second[0].stage):
            continue
        if seen.misfit_beyond(first, second) < 0.5 * wanted_misfit(first[0]):
            return False
    return True


def has_no_name(seen: Detectability, model: Model, theta: Theta) -> bool:
    """Whether no effect of the catalogue explains most of the misfit."""
    remaining, _ = seen.distinct_misfit(model, theta)
    return remaining >= UNNAMED_SHARE * seen.squared_misfit([(model, theta)])


def _hidden(kind: str, size: str, effects: Sequence[str]) -> DataError:
    named = f" ({', '.join(effects)})" if effects else ""
    return DataError(
        f"this motion and noise show nothing of kind {kind} and size {size}{named}",
        expected="a motion that shows it",
        fix="Choose a livelier trajectory, another size, or less noise",
    )


# ── parameters at the plausible size ──


def draw_parameters(model: Model, rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    """Random parameters at the plausible size.

    Amounts are Gaussian with a root mean square of one plausible size, every second time on a single axis; the others are
    spread over their plausible range.
    """
    if model.name in _SPECIAL:
        return _SPECIAL[model.name](rng, signal, noise, duration_s)
    amounts = model.amounts
    theta = model.plausible * np.where(amounts, rng.standard_normal(len(amounts)), 1.0)
    count = int(amounts.sum())
    parts = {"gravity": 1, "temperature": 2}.get(model.name, 3)  # one row of a matrix, one axis, one sensor
    if count % parts == 0 and rng.random() < 0.5:
        kept = np.zeros(count, dtype=bool)
        kept[rng.integers(parts) * (count // parts) :][: count // parts] = True
        theta[amounts] *= kept
    if model.name == "size_effect":  # what is common to all three axes would be a lever arm
        theta -= np.tile(theta.reshape(3, 3).mean(axis=0), 3)
    if not amounts.all():
        early, late = (0.2, 0.8) if model.name in ONCE else (0.1, 0.4)  # the time of a step, or constants of the drifts
        theta[~amounts] = rng.uniform(early, late) * duration_s
    used = theta[amounts] / model.plausible[amounts]
    theta[amounts] /= np.sqrt(np.mean(used[used != 0.0] ** 2))
    return theta


def _either_sign(rng: Generator, value: float) -> Theta:
    return np.array([value * rng.choice([-1.0, 1.0])])


def _line(rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    which = rng.choice(3, p=[0.2, 0.6, 0.2])
    amplitude = np.abs(rng.standard_normal(6)) + 0.2
    amplitude[GYRO] *= 0.1 * (which != 1)
    amplitude[ACCEL] *= 1.0 * (which != 0)
    return np.concatenate([[rng.uniform(15.0, 80.0)], amplitude, rng.uniform(0.0, 2.0 * np.pi, 6)])


def _resonance(rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    share = np.ones(3) if rng.random() < 0.4 else rng.permutation([1.0, rng.uniform(0.0, 0.5), 0.0])
    return np.array([np.exp(rng.uniform(np.log(3.0), np.log(30.0))), rng.uniform(0.05, 0.4), *share])


def _limits(rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    """Which sensor clips; `clipping` gives the limit."""
    which = rng.choice(3, p=[0.4, 0.4, 0.2])
    return clipping(np.array([NO_LIMIT * (which == 1), NO_LIMIT * (which == 0)]), 1.0, signal)


def _lsb(rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    """Eight standard deviations of the noise."""
    which = rng.choice(3)
    return 8.0 * np.array([noise[0] * (which != 1), noise[3] * (which != 0)])


def _gaps(rng: Generator, signal: Rows6, noise: Sigma, duration_s: float) -> Theta:
    starts = (np.arange(3) + rng.uniform(0.2, 0.7, 3)) * duration_s / 3.0
    return np.array([2.0, *starts])


_SPECIAL: Mapping[str, Callable[[Generator, Rows6, Sigma, float], Theta]] = {
    "clock_offset": lambda rng, *_: _either_sign(rng, 0.05),
    "clock_skew": lambda rng, *_: _either_sign(rng, 1e-3),
    "clock_jump": lambda rng, signal, noise, span: np.array([rng.uniform(0.25, 0.75) * span, *_either_sign(rng, 0.05)]),
    "gyro_delay": lambda rng, *_: _either_sign(rng, 5e-3),
    "gyro_hysteresis": lambda rng, *_: np.array([rng.uniform(0.016, 0.024)]),
    "accel_hysteresis": lambda rng, *_: np.array([rng.uniform(0.16, 0.24)]),
    "gyro_dead_band": lambda rng, *_: np.array([rng.uniform(0.04, 0.06)]),
    "low_pass": lambda rng, *_: np.array([rng.uniform(4.0, 6.0)]),
    "saturation": _limits,
    "quantization": _lsb,
    "vibration": _line,
    "mount_resonance": _resonance,
    "earth_rotation": lambda rng, *_: np.array([rng.uniform(-1.2, 1.2), rng.uniform(-3.0, 3.0)]),
    "dropped_samples": lambda rng, *_: np.array([0.02]),
    "timestamp_jitter": lambda rng, *_: np.array([2e-3]),
    "reference_error": _gaps,
}
