"""What a case conceals: drawn, and sized so that an optimal estimator could see it and tell it from everything else.

Sizes: `large` is the plausible size of the catalogue, `middle` a quarter of it, `small` 3.5 times the smallest that an optimal
test sees (`information.visible`), both against the noise and against the most similar other effect. What the motion cannot
show that clearly at the asked size is not drawn for it. Effects of stamps and of rounding, which any look at the numbers
shows, have fixed small sizes: a sixteenth of a share or a jitter, an LSB of one standard deviation of the noise; so has the
length of what a reference lost, a quarter of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.random import Generator

from imutool.blind_cases import unnamed
from imutool.blind_cases.amounts import drawn
from imutool.blind_cases.effects import CATALOGUE, Model, Stage, Theta
from imutool.blind_cases.information import Sight, visible
from imutool.errors import ConfigError, DataError
from imutool.noise.datasheet import SHEETS, Noise

Kind = Literal["single", "pair", "null", "driven", "unknown"]
Size = Literal["large", "middle", "small"]
KINDS, SIZES = get_args(Kind), get_args(Size)
CHANCES = {"single": 0.45, "pair": 0.2, "null": 0.1, "driven": 0.1, "unknown": 0.15}
FACTOR = {"large": 1.0, "middle": 0.25}
FIXED_SMALL = {"dropped_samples": 1 / 16, "timestamp_jitter": 1 / 16, "quantization": 1 / 8, "reference_error": 1 / 8}
CLEAR = 3.5  # times the smallest visible size
UNNAMED_SHARE = 0.3  # of an unknown's misfit that nothing in the catalogue takes over
TRIES, STEPS = 12, 8
TINY, CLOSE = 1e-9, 0.9  # as near to what is wanted as `_sized` comes
GYRO_BIAS, ACCEL_BIAS = 0.03, 0.3  # rad/s, m/s²: spread of the constant bias every real log has

# two of one row are never concealed together: by definition they are parts of the same thing
ALIKE = (
    {"mount_rotation", "gyro_misalignment", "accel_misalignment"},
    {"lever_arm", "size_effect"},
    {"dropped_samples", "timestamp_jitter"},
)
ALONE = {"reference_error", "earth_rotation"}  # never one of a pair

_FOG_GYRO, _FOG_ACCEL = 5.8e-7, 1e-4
NAVIGATION = Noise(
    gyro_density=(_FOG_GYRO,) * 3,
    accel_density=(_FOG_ACCEL,) * 3,
    sources={"gyro_density": "a fibre-optic gyro of 0.002 deg/sqrt(h)", "accel_density": "10 ug/sqrt(Hz)"},
)
GRADES = {"adis16448": SHEETS["adis16448"], "bmi160": SHEETS["bmi160"], "navigation": NAVIGATION}
GRADE_CHANCES = {"adis16448": 0.475, "bmi160": 0.475, "navigation": 0.05}


@dataclass(frozen=True, eq=False)
class Concealed:
    """What acts in a case: `acting` with the parameters as they are, and the size each was drawn at (1 is plausible)."""

    kind: str
    size: str
    acting: tuple[tuple[Model, Theta], ...] = ()
    factors: tuple[float, ...] = ()


def concealed(seen: Sight, rng: Generator, kind: Kind, size: Size, effects: Sequence[str] = ()) -> Concealed:
    """A case of a kind and size on a scene; `effects` names those to conceal instead of drawing them.

    Raises:
        ConfigError: no such effect.
        DataError: the motion shows nothing of that kind and size.
    """
    for name in effects:
        if name not in CATALOGUE and not (kind == "unknown" and name in unnamed.FORMS):
            raise ConfigError(f"no effect is called {name!r}", where="conceal", expected=f"one of {', '.join(CATALOGUE)}")
    if kind == "null":
        return Concealed(kind, size)
    if kind == "pair":
        return _pair(seen, rng, size, effects)
    for _ in range(TRIES):
        for model, theta in _candidates(seen, rng, kind, effects):
            sized = _sized(seen, model, theta, size)
            if sized is not None and (kind != "unknown" or _has_no_name(seen, model, sized[0])):
                return Concealed(kind, size, ((model, sized[0]),), (sized[1],))
    raise _hidden(kind, size, effects)


def shown(seen: Sight, what: Concealed) -> bool:
    """Whether a case could be drawn on this sight of its scene: everything in it as clear as a case has to be.

    What stamps, digits and lost poses show needs no sight.
    """
    plain = [(model, theta) for model, theta in what.acting if model.stage != Stage.STAMPS and model.name not in FIXED_SMALL]
    for model, theta in plain:
        wanted = CLEAR**2 * visible(max(int(model.amounts.sum()), 1))
        clear = seen.told_apart(model, theta)[0] >= wanted * CLOSE
        if not clear or (what.kind == "unknown" and not _has_no_name(seen, model, theta)):
            return False
    return len(plain) < 2 or _both_seen(seen, plain[0], plain[1])


def _pair(seen: Sight, rng: Generator, size: Size, effects: Sequence[str]) -> Concealed:
    for _ in range(TRIES):
        found: list[tuple[Model, Theta, float]] = []
        for model, theta in _candidates(seen, rng, "single", effects):
            if found and _alike(found[0][0].name, model.name):
                continue
            sized = None if model.name in ALONE else _sized(seen, model, theta, size)
            if sized is not None:
                found.append((model, *sized))
            if len(found) == 2:
                break
        if len(found) == 2 and _both_seen(seen, found[0][:2], found[1][:2]):
            acting, factors = tuple((m, theta) for m, theta, _ in found), tuple(factor for *_, factor in found)
            return Concealed("pair", size, acting, factors)
    raise _hidden("pair", size, effects)


def _candidates(seen: Sight, rng: Generator, kind: str, effects: Sequence[str]) -> list[tuple[Model, Theta]]:
    """Effects in the order in which they are tried, at the plausible size."""
    scene = seen.scene
    if kind == "driven":
        return [unnamed.driven(rng, {topic: float(values.std()) for topic, values in scene.channels.items()})]
    if kind == "unknown":
        return [unnamed.unknown(rng, effects[0] if effects else None)]
    ideal = scene.ideal(seen.t_s)
    names = list(effects) or [str(name) for name in rng.permutation(sorted(CATALOGUE))]
    return [(CATALOGUE[name], drawn(CATALOGUE[name], rng, ideal, scene.noise, scene.duration_s)) for name in names]


def _sized(seen: Sight, model: Model, theta: Theta, size: Size) -> tuple[Theta, float] | None:
    """Parameters at a size, and the size as a part of the plausible one; None where the motion does not show it."""
    ideal = seen.scene.ideal(seen.t_s)
    fixed = size == "small" and model.name in FIXED_SMALL
    factor = FIXED_SMALL[model.name] if fixed else FACTOR.get(size, 1.0)
    if model.stage == Stage.STAMPS:
        return model.sized(theta, factor, ideal), factor
    wanted = CLEAR**2 * visible(max(int(model.amounts.sum()), 1))
    for _ in range(STEPS):
        at = model.sized(theta, factor, ideal)
        shown = max(seen.told_apart(model, at)[0], TINY)
        if size != "small" or fixed:
            return (at, factor) if shown >= wanted else None
        if shown < wanted and factor >= 1.0:
            return None
        if abs(np.log(shown / wanted)) < 0.1:
            return at, factor
        factor = min(factor * float(np.clip(np.sqrt(wanted / shown), 1e-3, 3.0)), 1.0)
    return model.sized(theta, factor, ideal), factor


def _both_seen(seen: Sight, one: tuple[Model, Theta], other: tuple[Model, Theta]) -> bool:
    """Whether neither could be taken for a part of the other."""
    for first, second in ((one, other), (other, one)):
        if Stage.STAMPS in (first[0].stage, second[0].stage):
            continue
        if seen.beside(first, second) < 0.5 * CLEAR**2 * visible(max(int(first[0].amounts.sum()), 1)):
            return False
    return True


def _has_no_name(seen: Sight, model: Model, theta: Theta) -> bool:
    left, _ = seen.told_apart(model, theta)
    return left >= UNNAMED_SHARE * seen.seen([(model, theta)])


def _alike(one: str, other: str) -> bool:
    return any({one, other} <= row for row in ALIKE)


def _hidden(kind: str, size: str, effects: Sequence[str]) -> DataError:
    named = f" ({', '.join(effects)})" if effects else ""
    return DataError(
        f"this motion and noise show nothing of kind {kind} and size {size}{named}",
        expected="a motion that shows it",
        fix="Choose a livelier trajectory, another size, or less noise",
    )
