"""Closed loop: simulate with the physics that was found, diagnose again, compare.

recording + simulation ─ diagnose ─> physics.toml ─ simulate ─> closed.mcap ─ diagnose ─> nothing is missing
          ^                                                                        │
          └────────────────────── effects that are still missing ──────────────────┘
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Rows6, Vectors
from imutool.diagnosis.compare_findings import ANOTHER_MOTION
from imutool.diagnosis.result import ClosedLoop, Compared, Diagnosis
from imutool.diagnosis.to_sensor_files import NO_EFFECT
from imutool.diagnosis.wording.quantity import symbol
from imutool.errors import ConfigError, ImutoolError
from imutool.units import ASCII_UNITS, COLUMNS, SENSORS

CLOSED_LOG = "closed.mcap"
WINDOW_S = 5.0  # over which samples are integrated
EDGES_HZ = (0.0, 1.0, 5.0, 20.0, np.inf)  # of the bands of the spectrum
LATE_PARTS = 4  # of a log, for the error over time
STAYS = NO_EFFECT | {
    "quantization",  # seen in the recording or its poses alone, whatever the simulation
    "gyro_dead_band",  # a spline rounds the edges of the simulated one; to apply it twice is to apply it once
}
ROUNDS = 3  # at most
METRIC_S = 600.0  # that a metric may take


def closed_loop(
    first: Diagnosis,
    second: Diagnosis,
    log: Path,
    *,
    metric: tuple[float, float] | None = None,
    rounds: int = 1,
) -> ClosedLoop:
    """Figures of a recording and two simulations, the second with the physics that was found."""
    other = ANOTHER_MOTION in second.remarks and ANOTHER_MOTION not in first.remarks  # then its figures are of other poses
    compared = [] if other else [*_compared(_shared(first, second))]
    if metric is not None:
        compared.append(Compared("metric", *metric, "-"))
    given = {finding.effect for finding in first.findings} & STAYS
    missing = tuple(finding.effect for finding in second.findings if finding.effect not in given)
    white = all(second.unexplained[sensor].white for sensor in SENSORS if sensor in second.unexplained)  # what was simulated
    nameless = not white or (bool(second.located) and not second.findings)  # the misfit of what stays is located, too
    return ClosedLoop(str(log), bool(missing) or nameless or other, missing, tuple(compared), rounds)


def is_worth_a_round(first: Diagnosis, second: Diagnosis) -> bool:
    """Whether a search that begins with all effects of both may find more than the first did."""
    named = {finding.effect for finding in second.findings if finding.kind == "catalogue"} - NO_EFFECT
    return bool(named - {finding.effect for finding in first.findings})


def script_metric(script: Path, real: Path) -> Callable[[Path], float]:
    """Metric of a user's script: `python SCRIPT REAL SIM` prints a number on its last line.

    Raises:
        ConfigError: no such script; when called: the script fails, or prints no number.
    """
    if not script.is_file():
        raise ConfigError("no such script", where=script, expected="a Python script that prints a number")

    def metric(sim: Path) -> float:
        words = [sys.executable, str(script), str(real), str(sim)]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=METRIC_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise ConfigError(f"took longer than {METRIC_S:g} s", where=script, expected="a number") from error
        printed = done.stdout.strip().splitlines()
        try:
            return float(printed[-1]) if done.returncode == 0 else float("")
        except (IndexError, ValueError) as error:
            why = (done.stderr.strip().splitlines() or printed or ["nothing"])[-1]
            what = f"printed no number for {sim.name}: {why}"
            raise ConfigError(what, where=script, expected="a number on its last line") from error

    return metric


def check_metric(metric: object, *, closes: bool) -> None:
    """Check that a metric is a function, and that there are two simulations to compare by it.

    Raises:
        ConfigError: it is not.
    """
    if not callable(metric):
        raise ConfigError("`metric` is no function", expected="a function of the path of a simulated log")
    if not closes:
        raise ConfigError("`metric` compares two simulations", fix="Give `close` and `sim`, or leave `metric` out")


def figure(metric: Callable[[Path], float], log: Path) -> float:
    """Figure of a simulation's log by the user's metric.

    Raises:
        ConfigError: the metric fails, or gives no number.
    """
    try:
        value: object = metric(log)
    except ImutoolError:
        raise
    except Exception as error:  # whatever a user's function raises
        what = f"`metric` fails for {log.name}: {type(error).__name__}: {error}"
        raise ConfigError(what, expected="a number", fix="Correct the function, or leave `metric` out") from error
    try:
        return float(value)  # type: ignore[arg-type]  # whatever a user's function gives
    except (TypeError, ValueError) as error:
        raise ConfigError(f"`metric` gives {value!r} for {log.name}", expected="a number") from error


def table(loop: ClosedLoop) -> list[list[str]]:
    """Rows of the comparison, with its header."""
    rows = [["Figure", "Before", "After", "Unit"]]
    return rows + [[row.figure, f"{row.before:.3g}", f"{row.after:.3g}", symbol(row.unit) or "–"] for row in loop.compared]


class _Stretch(NamedTuple):
    """Samples of which both diagnoses have an expectation."""

    t_s: Float64[np.ndarray, " n"]
    real: Rows6
    expected: tuple[Rows6, Rows6]  # before and after, with the best constant

    def misfits(self, part: slice) -> list[Vectors]:
        """Of a sensor, before and after."""
        return [(self.real - expected)[:, part] for expected in self.expected]


def _shared(first: Diagnosis, second: Diagnosis) -> list[_Stretch]:
    out = []
    for before, after in product(first.traces, second.traces):
        t_s, rows, later = np.intersect1d(before.t_s, after.t_s, return_indices=True)
        if len(t_s) > 1:
            out.append(_Stretch(t_s, before.real[rows], (before.before[rows], after.before[later])))
    return out


def _compared(stretches: Sequence[_Stretch]) -> Iterator[Compared]:
    """Figures of the expected samples over all stretches."""
    for sensor, part in COLUMNS.items():
        unit = ASCII_UNITS[sensor]
        misfits = [np.concatenate(all_of) for all_of in zip(*(stretch.misfits(part) for stretch in stretches), strict=True)]
        yield Compared(f"{sensor} rms", _rms(misfits[0]), _rms(misfits[1]), unit)
        bands = [_by_band([(stretch.t_s, stretch.misfits(part)[k]) for stretch in stretches]) for k in range(2)]
        for name in bands[0]:
            yield Compared(f"{sensor} rms, {name}", bands[0][name], bands[1][name], unit)
        parts = [np.array_split(misfit, LATE_PARTS) for misfit in misfits]
        for quarter, (a, b) in enumerate(zip(*parts, strict=True), start=1):
            yield Compared(f"{sensor} rms, quarter {quarter}", _rms(a), _rms(b), unit)
    before, after = (_integrated([(stretch.t_s, stretch.real, stretch.expected[k]) for stretch in stretches]) for k in range(2))
    for name, was, is_now, unit in zip(("rotation", "path"), before, after, ("rad", "m"), strict=True):
        yield Compared(f"{name} over {WINDOW_S:g} s", was, is_now, unit)


def _rms(x: Vectors) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _by_band(misfits: Sequence[tuple[Float64[np.ndarray, " _"], Float64[np.ndarray, "_ 3"]]]) -> Mapping[str, float]:
    """Root mean square of a misfit in bands of its spectrum, over stretches."""
    squares: dict[str, list[tuple[int, float]]] = {}
    for t_s, x in misfits:
        rate_hz = 1.0 / float(np.median(np.diff(t_s)))
        f_hz, power = welch(x, rate_hz, nperseg=min(len(x), round(8.0 * rate_hz)), axis=0)
        for low, high in pairwise(EDGES_HZ):
            band = (f_hz >= low) & (f_hz < high)
            if band.any():
                name = f"{low:g} to {high:g} Hz" if np.isfinite(high) else f"above {low:g} Hz"
                squares.setdefault(name, []).append((len(x), float(power[band].sum() * (f_hz[1] - f_hz[0]) / 3.0)))
    return {name: float(np.sqrt(np.average([x for _, x in own], weights=[n for n, _ in own]))) for name, own in squares.items()}


def _integrated(stretches: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Rotation (rad) and displacement (m) by which recorded and expected samples part within windows; root mean squares."""
    angle, distance = [], []
    for t_s, real, simulated in stretches:
        (R_real, p_real), (R_sim, p_sim) = (_window_ends(samples, t_s) for samples in (real, simulated))
        angle.append((R_real.inv() * R_sim).magnitude())
        distance.append(((p_real - p_sim) ** 2).sum(axis=1))
    return float(np.sqrt(np.mean(np.concatenate(angle) ** 2))), float(np.sqrt(np.concatenate(distance).mean()))


def _window_ends(samples: Rows6, t_s: Float64[np.ndarray, " n"]) -> tuple[Rotation, Float64[np.ndarray, "w 3"]]:
    """Attitude and displacement at the end of each window, from its own start, gravity included."""
    period_s = float(np.median(np.diff(t_s)))
    count = min(round(WINDOW_S / period_s), len(t_s))
    x = samples[: len(t_s) // count * count].reshape(-1, count, 6)
    R, v, p = Rotation.identity(len(x)), np.zeros((len(x), 3)), np.zeros((len(x), 3))
    for k in range(count):
        p = p + v * period_s
        v = v + R.apply(x[:, k, 3:]) * period_s
        R = R * Rotation.from_rotvec(x[:, k, :3] * period_s)
    return R, p
