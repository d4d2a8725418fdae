"""What was measured and what was subtracted: samples raw and debiased, biases with three standard deviations and the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from imutool.recording import Times
from imutool.viewing.model.decimate import MOST, curve_rows
from imutool.viewing.model.run_data import RunData, Trace
from imutool.viewing.rerun.entities import clock, names, styles
from imutool.viewing.rerun.entities.names import Scope

if TYPE_CHECKING:
    import rerun as rr

KINDS = ("gyro", "accel")
SIGMAS = 3.0
MOST_DERIVED = 50_000  # rows of a curve that is computed: four minutes at 200 Hz; a sample is only left out above MOST


def log(data: RunData, to: rr.RecordingStream, scope: Scope) -> None:
    """Samples of every run, biases of every model, and the true ones where they are known."""
    for trace in data.traces:
        _log_samples(data, to, scope, trace)
        if not trace.is_raw:
            _log_bias(data, to, scope, trace)
    for kind, bias in data.true_bias.items():
        scalars(to, data, names.path(scope, "bias", kind, "true"), bias.t_ns, bias.values, styles.true_bias())


def _log_samples(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace) -> None:
    imu, role = trace.run.imu, names.role(trace)
    alone = not data.models()
    style = styles.axes(role, names.label(data, trace), rank=rank(data, trace), alone=alone)
    for kind, values in zip(KINDS, (imu.gyro, imu.accel), strict=True):
        scalars(to, data, names.of(data, trace, scope, "imu", kind, role), imu.t_ns, values, style, most=MOST)


def _log_bias(data: RunData, to: rr.RecordingStream, scope: Scope, trace: Trace) -> None:
    run, name = trace.run, names.label(data, trace)
    for kind, bias, columns in zip(KINDS, (run.gyro_bias, run.accel_bias), (slice(0, 3), slice(3, 6)), strict=True):
        home = names.of(data, trace, scope, "bias", kind)
        estimated = styles.axes("debiased", "estimated" if name == "debiased" else name, rank=rank(data, trace))
        scalars(to, data, f"{home}/estimated", run.imu.t_ns, bias, estimated)
        if run.bias_std is not None:
            spread = SIGMAS * run.bias_std[:, columns]
            band = np.hstack([bias + spread, bias - spread])
            scalars(to, data, f"{home}/sigma", run.imu.t_ns, band, styles.sigma("estimated", rank=rank(data, trace)))


def rank(data: RunData, trace: Trace) -> int:
    """The how-manyth model it is, from 0; also 0 for raw."""
    return 0 if trace.is_raw else data.models().index(trace)


def scalars(
    to: rr.RecordingStream,
    data: RunData,
    entity: str,
    t_ns: Times,
    values: Float64[np.ndarray, "n k"],
    style: rr.AsComponents,
    *,
    most: int | None = None,
) -> None:
    """One curve per column, its style first; of more than `most` rows (MOST_DERIVED) those with the extremes."""
    import rerun as rr

    to.log(entity, style, static=True, strict=True)
    rows = curve_rows(values, MOST_DERIVED if most is None else most)
    # strict: Rerun only warns of a length that does not match, and then the rows are missing
    to.send_columns(entity, clock.at(data, t_ns[rows]), rr.Scalars.columns(scalars=values[rows]), strict=True)


def thinning(data: RunData) -> list[str]:
    """A sentence, if computed curves of this log are thinned."""
    if all(len(trace.run.imu) <= MOST_DERIVED for trace in data.traces):
        return []
    return [f"Of errors and biases at most {MOST_DERIVED} rows are drawn, the lowest and highest of every stretch among them."]
