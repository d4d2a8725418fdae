"""Words and numbers of a report: conclusion, key numbers, labels of figures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from imutool.viewing.model.run_data import IN_LOG, RunData, Trace
from imutool.viewing.model.trajectory_error import row_of_largest

FIGURE_LABELS = {
    "aoe_deg": "Orientation error (AOE, °)",
    "ape_m": "Position error (APE, m)",
    "ape_aligned_m": "Position error, aligned (m)",
    "velocity_rmse_m_s": "Velocity error (m/s)",
    "roe_deg": "Turn over {} m (ROE, °)",
    "rpe_m": "Motion over {} m (RPE, m)",
}
SAME_WITHIN = 0.05  # relative difference up to which two errors count as the same
NOT_ERRORS = ("samples", "duration_s")  # no errors


def best_run(data: RunData) -> Trace | None:
    """Run with the smallest orientation error, a model if there is one; None without truth."""
    scored = [trace for trace in data.integrated().traces if trace.figures.get("aoe_deg") is not None]
    models = [trace for trace in scored if not trace.is_raw]
    return min(models or scored, key=lambda trace: float(trace.figures["aoe_deg"]), default=None)


def raw_run(data: RunData) -> Trace | None:
    """Run as recorded, if it is shown."""
    return next((trace for trace in data.traces if trace.is_raw), None)


def run_name(trace: Trace) -> str:
    """Name of a run within a sentence; samples of the log are told from those of the same model."""
    model = trace.name.removeprefix(IN_LOG)
    return trace.name if model == trace.name else f"{model} (in the log)"


def format_number(value: float | None) -> str:
    """Number with three digits and thousands separators."""
    if value is None or not np.isfinite(value):
        return "–"
    value = float(f"{value:.2e}") if abs(value) < 999.5 else value  # 0.9996 has two digits behind the point, as 1.00
    size = abs(value)
    if size >= 999.5:
        return f"{value:,.0f}"
    digits = 0 if size == 0.0 else max(0, min(6, 2 - int(np.floor(np.log10(size)))))
    return f"{value:.{digits}f}" if size == 0.0 or size >= 1e-4 else f"{value:.1e}"


def format_quantity(value: float, unit: str) -> str:
    """Number with its unit; from one kilometre on in kilometres."""
    if unit == "m" and abs(value) >= 1000.0:
        return f"{format_number(value / 1000.0)} km"
    return f"{format_number(value)}{'' if unit == '°' else ' '}{unit}"


def figure_label(name: str) -> str:
    """Label of a figure in a table, such as that of `roe_deg 5`."""
    key, _, distance = name.partition(" ")
    return FIGURE_LABELS[key].format(distance) if key in FIGURE_LABELS else name.replace("_", " ")


def alignment_text(data: RunData) -> str:
    """Alignment before errors are computed, as text."""
    how = {"none": "without alignment", "origin": "aligned at the start", "yaw": "aligned in position and heading"}
    return how.get(data.alignment, "aligned by a rigid motion")


def worst_orientation_error(trace: Trace, data: RunData) -> tuple[float, float] | None:
    """Largest orientation error (deg) and its time (s from the start)."""
    if trace.errors is None or (row := row_of_largest(trace.errors.orientation_total_deg)) is None:
        return None
    at_s = data.elapsed_s(trace.errors.t_ns[row : row + 1])[0]
    return float(trace.errors.orientation_total_deg[row]), float(at_s)


def conclusion(data: RunData) -> str:
    """Conclusion in one or two sentences, with the start, from figures without alignment."""
    chosen, before = best_run(data), raw_run(data)
    if chosen is None:
        return _without_truth(data)
    if chosen.is_raw or before is None:
        seconds = format_number(chosen.figures["duration_s"])
        text = f"{run_name(chosen)} has errors of {_errors(chosen)} over {seconds} s{start_text(chosen)}, without alignment"
    else:
        seconds = format_number(chosen.figures["duration_s"])
        text = f"{comparison(chosen, before)} over {seconds} s{start_text(chosen)}, without alignment"
    largest = worst_orientation_error(chosen, data)
    if largest is None:
        return f"{data.name}: {text}."
    how = f" ({alignment_text(data)})" * (data.alignment != "none")
    at_s = f"{format_quantity(largest[0], '°')}{how} at {format_number(largest[1])} s"
    return f"{data.name}: {text}. The largest orientation error is {at_s}."


def start_text(trace: Trace) -> str:
    """Start of a bias as part of a sentence, ` after a start from 15 s of truth`, or empty."""
    method, _, length = trace.run.start.partition(":")
    if method == "truth":
        return f" after a start from {length} s of truth" if length else " after a start from truth"
    known = {
        "auto": " from a start without truth",
        "stationary": " from a start at rest",
        "prior": " from the prior of the model",
        "smooth": " with the bias smoothed over the whole log",
    }
    return known.get(method, " from a given bias" if method else "")


def comparison(chosen: Trace, before: Trace) -> str:
    """Comparison of a model with raw: orientation first, then position, if the truth has it."""
    parts: list[tuple[str, str]] = []
    for figure, what, unit in (("aoe_deg", "orientation", "°"), ("ape_m", "position", "m")):
        if before.figures[figure] is None or chosen.figures[figure] is None:
            continue
        old, new = float(before.figures[figure]), float(chosen.figures[figure])
        span = f"the {what} error from {format_quantity(old, unit)} to {format_quantity(new, unit)}"
        if abs(new - old) <= SAME_WITHIN * max(old, new):
            parts.append(
                ("leaves", f"the {what} error about as it was ({format_quantity(old, unit)}, now {format_quantity(new, unit)})")
            )
        elif new < old:
            parts.append(("cuts", f"{span} ({ratio_text(old, new)})"))
        else:
            parts.append(("raises", f"{span} ({ratio_text(new, old)})"))
    (does, first), *others = parts
    rest = "".join(f" and {second if also == does else f'{also} {second}'}" for also, second in others)
    return f"{run_name(chosen)} {does} {first}{rest}"


def ratio_text(large: float, small: float) -> str:
    """Ratio as text: `31 times`."""
    if small <= 0.0:
        return "to nothing"
    ratio = large / small
    return f"{ratio:.0f} times" if ratio >= 9.5 else f"{ratio:.1f} times"


def summary_of_logs(logs: Sequence[RunData]) -> str:
    """Summary of several logs: how often a model beats raw, and the median errors."""
    pairs = [(best_run(data), raw_run(data)) for data in logs]
    scored = [(a, b) for a, b in pairs if a is not None and b is not None and not a.is_raw]
    if not scored:
        with_truth = sum(data.truth is not None for data in logs)
        return f"{len(logs)} logs, {with_truth} of them with truth, none with both truth and a model."
    better = sum(float(a.figures["aoe_deg"]) < float(b.figures["aoe_deg"]) for a, b in scored)
    new, old = (float(np.median([run.figures["aoe_deg"] for run in side])) for side in zip(*scored, strict=True))
    return (
        f"In {better} of {len(scored)} logs the best model has a smaller orientation error than raw. "
        f"The median is {format_quantity(new, '°')} instead of {format_quantity(old, '°')}, without alignment."
    )


def key_numbers(data: RunData) -> list[tuple[str, str]]:
    """Key numbers of a log, each with its caption."""
    numbers = [(f"{format_number(data.duration_s)} s", f"{len(data.traces[0].run.imu):,} samples at {rate_hz(data):.0f} Hz")]
    chosen, before = best_run(data), raw_run(data)
    for trace in dict.fromkeys(trace for trace in (before, chosen) if trace is not None and trace.figures):
        numbers.append((format_quantity(float(trace.figures["aoe_deg"]), "°"), f"orientation error, {run_name(trace)}"))
        if trace.figures["ape_m"] is not None:
            numbers.append((format_quantity(float(trace.figures["ape_m"]), "m"), f"position error, {run_name(trace)}"))
    drifts = {} if chosen is None else {window.length_s: window.orientation_deg for window in chosen.windows}
    if chosen is not None and 10.0 in drifts:
        numbers.append((format_quantity(drifts[10.0], "°"), f"drift in 10 s, {run_name(chosen)}"))
    if (count := sum(event.kind != "worst" for event in data.events)) > 0:
        numbers.append((f"{count:,}", "event" if count == 1 else "events"))
    return numbers


def rate_hz(data: RunData) -> float:
    """Sample rate by the median step."""
    return 1.0 / data.traces[0].run.imu.period_s


def index_of_best(values: Sequence[float | None], name: str) -> int | None:
    """Index of the smallest error; None for fewer than two values or for counts."""
    known = [(value, k) for k, value in enumerate(values) if value is not None]
    if name in NOT_ERRORS or len(known) < 2 or min(known)[0] == max(known)[0]:
        return None
    return min(known)[1]


def _errors(trace: Trace) -> str:
    sizes = [(trace.figures[name], unit) for name, unit in (("aoe_deg", "°"), ("ape_m", "m"))]
    return " and ".join(format_quantity(float(size), unit) for size, unit in sizes if size is not None)


def _without_truth(data: RunData) -> str:
    sentence = f"{data.name}: {format_number(data.duration_s)} s without truth, so its errors are unknown."
    for trace in data.models():
        gyro, accel = (np.linalg.norm(bias.mean(axis=0)) for bias in (trace.run.gyro_bias, trace.run.accel_bias))
        off = f"{np.degrees(gyro):.3g}°/s from the angular rate and {accel:.3g} m/s² from the specific force"
        sentence += f" {run_name(trace)} subtracts {off}."
    return sentence
