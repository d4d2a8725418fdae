"""Log all entities of logs into a Rerun recording, or save them as an .rrd file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from imutool.mcap_io.storage.output_conflicts import refuse_existing
from imutool.mcap_io.storage.target import Target
from imutool.viewing import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, other_topics, require_rerun, rr
from imutool.viewing.rerun.entities import errors, paths, report, signals
from imutool.viewing.rerun.plots import diagonal_m
from imutool.viewing.rerun.sdk import Scope, new_stream, recording_name, rrd_bytes, scopes


def log(logs: Sequence[RunData], to: rr.RecordingStream, *, source: bool = True, root: Scope = ()) -> None:
    """Log all entities as whole columns on `elapsed`, `ros2_timestamp` and `message_log_time`.

    One log lies at the root of its entities, several each under `run/NAME`; each of several models lies under its own name.
    `world/{gt,raw,debiased}/{path,body}`, `imu/{gyro,accel}/{raw,debiased}`, `bias/{gyro,accel}/{estimated,true,sigma}`,
    `error/{orientation,position}/{raw,debiased}` (degrees and metres; parts below), `error/drift/…`,
    `spectrum/{gyro,accel}/…`, `events/KIND`, `report`; with `source` the log's other topics under their own names.
    """
    to.set_log_time_enabled(False)
    to.set_log_tick_enabled(False)
    if len(logs) > 1:  # first: the user sees it first, and a page receives slowly
        report.log_comparison(logs, to)
    for data, scope in zip(logs, scopes(logs, root), strict=True):
        _log_one(data, to, scope, source)


def send(logs: Sequence[RunData], to: rr.RecordingStream, *, source: bool) -> None:
    """Send the layout, then log all entities (ConfigError: Rerun is not installed)."""
    to.send_blueprint(layout.blueprint(logs, source=source))
    log(logs, to, source=source)


def save(logs: Sequence[RunData], path: Path | None = None, *, source: bool = True, overwrite: bool = False) -> Output:
    """Write all logs into one .rrd file: `path`, or NAME.rrd in the folder `path` or here.

    Raises:
        ConfigError: no log, Rerun is not installed, the file exists (without `overwrite`) or cannot be written.
    """
    place = path or Path()
    target = place / f"{recording_name(logs)}.rrd" if place.is_dir() else place
    require_rerun()
    if path is None:
        refuse_existing(target, overwrite=overwrite, choose="Give another name as `save`")
    with Target(target, overwrite=overwrite) as file:  # refuses before the work is done, leaves nothing after a failure
        file.write(rrd(logs, source=source))
    return Output("rrd", str(target), f"Saved {target}. Open with: rerun {quote(str(target))}")


def rrd(logs: Sequence[RunData], *, source: bool = True) -> bytes:
    """Content of an .rrd file with all logs and their layout.

    Raises:
        ConfigError: no log, or Rerun is not installed.
    """
    return rrd_bytes(new_stream(recording_name(logs)), lambda recording: send(logs, recording, source=source))


def _log_one(data: RunData, to: rr.RecordingStream, scope: Scope, with_source: bool) -> None:
    paths.log_paths(data, to, scope, diagonal_m(layout.scene_box(data)))
    signals.log_signals(data.integrated(), to, scope)
    errors.log_errors(data, to, scope)
    signals.log_spectra(data.integrated(), to, scope)
    errors.log_events(data, to, scope)
    notes = other_topics.log(data, to, scope) if with_source else []
    report.log_report(data, to, scope, [*signals.decimation_note(data), *notes])
