"""Where the misfit of a diagnosis lies: in the stretches of each log, by what was found or by what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from jaxtyping import Float64
from scipy.ndimage import uniform_filter1d

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.locate import located
from imutool.diagnosis.result import Finding, Located

SLOW = 9  # samples of a running mean

Samples = Float64[np.ndarray, "_ 6"]


def of_findings(
    pairs: Sequence[Pair],
    before: Sequence[Samples],
    after: Sequence[Samples],
    floor: Float64[np.ndarray, "6"],
    findings: Sequence[Finding],
    p_values: Mapping[str, float],
) -> list[Located]:
    """Where the findings change what is expected: `after` against `before` of each pair, with the findings of converters."""
    return _places(pairs, [_converted(a, findings) - b for a, b in zip(after, before, strict=True)], floor, p_values)


def of_what_is_left(pairs: Sequence[Pair], after: Sequence[Samples], floor: Float64[np.ndarray, "6"]) -> list[Located]:
    """Where something is left that nothing explains: running means that stand out of the noise."""
    left = [_slow(pair.real - a) for pair, a in zip(pairs, after, strict=True)]
    return _places(pairs, left, floor / np.sqrt(SLOW), {})


def _places(
    pairs: Sequence[Pair], misfits: Sequence[Samples], floor: Float64[np.ndarray, "6"], p_values: Mapping[str, float]
) -> list[Located]:
    """Strongest first, log by log: `log` is the pair's name where there are several."""
    logs = list(dict.fromkeys(pair.name for pair in pairs))
    out = []
    for log in logs:
        stretches = [(pair, misfit) for pair, misfit in zip(pairs, misfits, strict=True) if pair.name == log]
        places = _of_one(stretches, floor, p_values)
        out += [msgspec.structs.replace(one, log=log) if len(logs) > 1 else one for one in places]
    return sorted(out, key=lambda one: one.p_value)


def _of_one(
    stretches: Sequence[tuple[Pair, Samples]], floor: Float64[np.ndarray, "6"], p_values: Mapping[str, float]
) -> list[Located]:
    """Stretches of one log share its clock; the constant of each is its own."""
    t_s = np.concatenate([pair.stamp_s for pair, _ in stretches])
    misfit = np.concatenate([misfit - np.median(misfit, axis=0) for _, misfit in stretches])
    each = [_variables(pair) for pair, _ in stretches]
    variables = {name: (unit, np.concatenate([one[name][1] for one in each])) for name, (unit, _) in each[0].items()}
    return located(t_s, misfit, floor, variables, p_values)


def _converted(there: Float64[np.ndarray, "n 6"], findings: Sequence[Finding]) -> Float64[np.ndarray, "n 6"]:
    """As a converter gives it whose limits and steps were found."""
    out = there.copy()
    told = {name: estimate.value for one in findings for name, estimate in one.parameters.items()}
    for k, signal in enumerate(("gyro", "accel")):
        part, limit, lsb = slice(3 * k, 3 * k + 3), told.get(f"{signal}_limit"), told.get(f"{signal}_lsb")
        if limit is not None and np.isfinite(limit):
            out[:, part] = np.clip(out[:, part], -limit, limit)
        if lsb is not None:
            out[:, part] = lsb * np.rint(out[:, part] / lsb)
    return out


def _slow(left: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
    """A running mean: what is left without most of its noise."""
    return np.asarray(uniform_filter1d(left, SLOW, axis=0))


def _variables(pair: Pair) -> dict[str, tuple[str, Float64[np.ndarray, " n"]]]:
    """What a regime can be of."""
    read = pair.felt.sample(pair.stamp_s, pair.stamp_s)
    rate, force = np.linalg.norm(read.gyro, axis=1), np.linalg.norm(read.accel, axis=1)
    out = {
        "angular rate": ("rad/s", rate),
        "acceleration": ("m/s²", np.abs(force - 9.81)),
        "angular acceleration": ("rad/s²", np.linalg.norm(read.alpha, axis=1)),
        "time": ("s", pair.stamp_s),
    }
    if read.R_wb is not None:
        out["tilt"] = ("rad", np.arccos(np.clip(read.R_wb[:, 2, 2], -1.0, 1.0)))
    for k, axis in enumerate("xyz"):
        out[f"rate about {axis}"] = ("rad/s", np.abs(read.gyro[:, k]))
        out[f"force along {axis}"] = ("m/s²", np.abs(read.accel[:, k]))
    return out | {name: ("", values) for name, values in pair.channels.items()}
