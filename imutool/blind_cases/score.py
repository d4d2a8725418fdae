"""How well findings of `diagnose` (schema imutool.diagnosis/1) meet what was concealed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool.blind_cases.effects import AXES, CATALOGUE
from imutool.blind_cases.recheck import explained
from imutool.errors import DataError
from imutool.recording import Recording

SCHEMA, FINDINGS_SCHEMA = "imutool.score/1", "imutool.diagnosis/1"
NO_NEWS = {"gyro_bias", "accel_bias"}  # part of every log: right, and nothing that was concealed
SIGNALS = ("gyro", "accel")
# other names under which a parameter may be told
ALIASES: Mapping[str, tuple[str, ...]] = {
    **{axis: (f"phi_{axis}", f"r_{axis}", f"{axis}_m") for axis in AXES},
    "tau": ("tau_s", "offset", "time_constant"),
    "eps": ("epsilon", "skew"),
    "t_j": ("t_jump", "time", "t"),
    "step": ("jump", "offset"),
    "f_c": ("fc", "cutoff", "cut_off", "f"),
    "f0": ("f_0", "frequency"),
    "f": ("f1", "frequency"),
    "zeta": ("damping",),
    "g": ("dg", "magnitude", "size"),
    "gyro": ("gyro_limit", "gyro_lsb", "limit_gyro", "lsb_gyro"),
    "accel": ("accel_limit", "accel_lsb", "limit_accel", "lsb_accel"),
    "share_x": ("x",),
    "share_y": ("y",),
    "share_z": ("z",),
    "share": ("fraction",),
    "std": ("jitter", "sigma"),
    "lag": ("delay", "tau"),
}
TELLING = 0.02  # of the noise's power: with less misfit than that a signal has no gain worth a ratio


def score(truth: Mapping[str, Any], found: Mapping[str, Any], where: Path, sim: Recording | None = None) -> dict[str, Any]:
    """Names, place, parameters and gain.

    `right`: the names are those concealed, none more and none less; `wrong`: names that are not. `place`: F1 of seconds (of a
    signal whose misfit comes and goes) and of axes, doubtful ones left out. `parameters`: those that a lower bound calls
    identifiable, of effects that were named. `gain_said`: what the findings say they remove on held-out
    time over what perfect knowledge would. `gain`: the same by our own forward models where they can tell (`recheck`, which
    needs the simulation `sim`), else as said.

    Raises:
        DataError: findings of another schema, or with fields that are no numbers.
    """
    if found.get("schema") != FINDINGS_SCHEMA:
        raise DataError(f"schema {found.get('schema')!r}", where=where, expected=FINDINGS_SCHEMA)
    try:
        return _score(truth, found, sim)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"the findings cannot be read ({error!r})", where=where, expected=FINDINGS_SCHEMA) from error


def _score(truth: Mapping[str, Any], found: Mapping[str, Any], sim: Recording | None) -> dict[str, Any]:
    findings = [one for one in found["findings"] if one["effect"] not in NO_NEWS]
    hidden = list(truth["effects"])
    met: list[tuple[Mapping[str, Any], Mapping[str, Any]]] = []
    left = list(findings)
    for effect in hidden:
        match = next((one for one in left if _same(effect, one)), None)
        if match is not None:
            left.remove(match)
            met.append((effect, match))
    names = [one["effect"] for one in hidden]
    parameters = [row for pair in met for row in _parameters(*pair)]
    said = _gain(truth, found, findings)
    checked = None if sim is None else explained(truth, [(one, _by_our_names(one)) for one in findings], sim)
    return {
        "schema": SCHEMA,
        "kind": truth["kind"],
        "size": truth["size"],
        "concealed": names,
        "found": [one["effect"] for one in findings],
        "detected": bool(findings) or bool(found["mismatch"]),
        "right": len(met) == len(hidden) and not left,
        "hits": [effect["effect"] for effect, _ in met],
        "missing": [effect["effect"] for effect in hidden if all(effect is not one for one, _ in met)],
        "wrong": [one["effect"] for one in left],
        "precision": len(met) / len(findings) if findings else None,
        "recall": len(met) / len(hidden) if hidden else None,
        "place": _place(truth["place"], found["located"]),
        "parameters": parameters,
        "untold": [f"{e['effect']}.{name}" for e, one in met for name in _untold(e, one)],
        "gain": said if checked is None else checked,
        "gain_said": said,
    }


def _same(effect: Mapping[str, Any], finding: Mapping[str, Any]) -> bool:
    """The same name; what is driven must be driven by the same topic, an unknown be seen in the same signal."""
    if effect["effect"] != finding["effect"]:
        return False
    if effect["effect"] == "driven":
        driver = str(finding.get("driver", ""))
        return driver == effect["driver"] or driver.startswith((f"{effect['driver']}.", f"{effect['driver']}/"))
    return effect["effect"] != "unknown" or finding["signal"] in (effect["signal"], "both", "imu")


def _told(name: str, finding: Mapping[str, Any]) -> Mapping[str, Any] | None:
    told: Mapping[str, Any] = finding["parameters"]
    for candidate in (name, *ALIASES.get(name, ())):
        if candidate in told:
            one: Mapping[str, Any] = told[candidate]
            return one
    sensor, _, axis = name.rpartition("_")
    waves = [(f"sin_{axis}", f"cos_{axis}"), (f"{sensor}_sin_{axis}", f"{sensor}_cos_{axis}")]
    for sine, cosine in waves if sensor in SIGNALS else []:
        if sine in told and cosine in told and (sine.startswith(sensor) or sensor == "accel"):
            return _amplitude(told[sine], told[cosine])
    return None


def _by_our_names(finding: Mapping[str, Any]) -> dict[str, float]:
    """Parameters of a finding, by the names of our models."""
    model = CATALOGUE.get(finding["effect"])
    names = ("gain", "lag") if model is None else tuple(one.name for one in model.parameters)
    told = {name: _told(name, finding) for name in names}
    return {name: float(one["value"]) for name, one in told.items() if one is not None}


def _amplitude(sine: Mapping[str, Any], cosine: Mapping[str, Any]) -> Mapping[str, Any]:
    """Of a line told as sine and cosine."""
    s, c = float(sine["value"]), float(cosine["value"])
    value = float(np.hypot(s, c))
    std = float(np.hypot(s * float(sine["std"]), c * float(cosine["std"]))) / value if value > 0.0 else float(sine["std"])
    return {"value": value, "std": std}


def _parameters(effect: Mapping[str, Any], finding: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for name, true in effect["parameters"].items():
        told = _told(name, finding)
        if told is None or not true["identifiable"]:
            continue
        error, std = float(told["value"]) - true["value"], float(told["std"])
        rows.append(
            {
                "effect": effect["effect"],
                "parameter": name,
                "true": true["value"],
                "value": float(told["value"]),
                "std": std,
                "sigmas": error / std if std > 0.0 else None,
                "percent": 100.0 * abs(error) / true["scale"],
                "over_bound": None if not true["smallest_std"] else std / true["smallest_std"],
            }
        )
    return rows


def _untold(effect: Mapping[str, Any], finding: Mapping[str, Any]) -> list[str]:
    """Parameters that could have been told and were not. Those of an unknown have no names to be told by."""
    if effect["effect"] == "unknown":
        return []
    return [name for name, true in effect["parameters"].items() if true["identifiable"] and _told(name, finding) is None]


# ── place ──


def _place(true: Mapping[str, Any], located: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    seconds, axes = [], []
    for signal in SIGNALS:
        here = [one for one in located if one["signal"] in (signal, "both", "imu")]
        marks = true[signal]["seconds"]
        if true[signal]["localised"]:
            seconds += list(zip(marks, _covered(len(marks), float(true["window_s"]), here), strict=True))
        named = {axis for one in here for axis in one["axes"]}
        axes += [(true[signal]["axes"][axis], axis in named) for axis in AXES]
    both = (_f1(seconds), _f1(axes))
    known = [value for value in both if value is not None]
    return {"seconds_f1": both[0], "axes_f1": both[1], "f1": float(np.mean(known)) if known else None}


def _covered(count: int, window_s: float, located: Sequence[Mapping[str, Any]]) -> list[bool]:
    """Which windows are at least half inside an interval; no intervals at all mean everywhere."""
    inside = np.zeros(count)
    starts = window_s * np.arange(count)
    for one in located:
        if not one["intervals_s"]:
            return [True] * count
        for start, end in one["intervals_s"]:
            inside = np.maximum(inside, np.clip(np.minimum(end, starts + window_s) - np.maximum(start, starts), 0.0, None))
    return [bool(value >= 0.5 * window_s) for value in inside]


def _f1(pairs: Sequence[tuple[str, bool]]) -> float | None:
    """Of clear marks against said ones; None where nothing is clear."""
    right = sum(mark == "#" and said for mark, said in pairs)
    missed = sum(mark == "#" and not said for mark, said in pairs)
    false = sum(mark == "." and said for mark, said in pairs)
    return 2.0 * right / (2.0 * right + missed + false) if right + missed else None


# ── gain ──


def _gain(truth: Mapping[str, Any], found: Mapping[str, Any], findings: Sequence[Mapping[str, Any]]) -> float | None:
    """Share of the achievable reduction of the residual's power, signals weighted by their misfit over the noise.

    Achievable is all down to the recording's own noise: that of the simulation can be smoothed away.
    """
    shares, weights = [], []
    for signal in SIGNALS:
        best = truth["achievable"][signal]
        weight = (best["rms_before"] / best["rms_after"]) ** 2 - 1.0
        if weight > TELLING:
            weights.append(weight)
            noise = truth["noise_std"]["real"][3 * SIGNALS.index(signal) :][:3]
            shares.append(_share(signal, float(np.sqrt(np.mean(np.square(noise)))), found, findings))
    return float(np.average(shares, weights=weights)) if shares else None


def _share(signal: str, noise: float, found: Mapping[str, Any], findings: Sequence[Mapping[str, Any]]) -> float:
    told = [found["closer"][signal]] if signal in found.get("closer", {}) else []
    told = told or [one["held_out"] for one in findings if one["signal"] in (signal, "both", "imu")]
    if not told:
        return 0.0
    before = max(float(one["rms_before"]) for one in told)
    after = min(float(one["rms_after"]) for one in told)
    said = float(found["unexplained"]["noise_floor"].get(signal) or noise)
    floor = noise * (np.sqrt(3.0) if said > noise * 3.0**0.25 else 1.0)  # of three axes together, or of one
    most = before**2 - floor**2
    return float(np.clip((before**2 - after**2) / most, 0.0, 1.0)) if most > 0.0 else 0.0
