"""What is logged to Rerun of one or several logs, entity by entity; how it is laid out is the layout's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import source as other_topics
from imutool.viewing.rerun.entities import errors, events, names, paths, report, signals, spectrum
from imutool.viewing.rerun.layout import size_m
from imutool.viewing.rerun.sdk import need_sdk

if TYPE_CHECKING:
    import rerun as rr


def log(logs: Sequence[RunData], to: rr.RecordingStream, *, source: bool = True) -> None:
    """Everything there is to see, into one Rerun recording: whole columns on `elapsed`, `ros2_timestamp`, `message_log_time`.

    One log lies at the root, several each under `run/NAME`; of several models each lies under its own name (see `entities`).
    `world/{gt,raw,debiased}/{path,body}`, `imu/{gyro,accel}/{raw,debiased}`, `bias/{gyro,accel}/{estimated,true,sigma}`,
    `error/{orientation,position}/{raw,debiased}` (degrees and metres; in parts below it), `error/drift/…`,
    `spectrum/{gyro,accel}/…`, `events/KIND`, `report`; with `source` the log's other topics under their own names.

    Raises:
        ConfigError: Rerun is not installed.
    """
    need_sdk()
    to.set_log_time_enabled(False)
    to.set_log_tick_enabled(False)
    if len(logs) > 1:  # first: it is what is seen first, and a page receives slowly
        report.log_comparison(logs, to)
    for data, scope in zip(logs, names.scopes(logs), strict=True):
        _log_one(data, to, scope, source)


def _log_one(data: RunData, to: rr.RecordingStream, scope: names.Scope, with_source: bool) -> None:
    paths.log(data, to, scope, size_m(data))
    signals.log(data, to, scope)
    errors.log(data, to, scope)
    spectrum.log(data, to, scope)
    events.log(data, to, scope)
    said = other_topics.log(data, to, scope) if with_source else []
    report.log(data, to, scope, [*signals.thinning(data), *said])
