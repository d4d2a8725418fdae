"""From a log on disk to what there is to see of it: raw, as it was debiased in the log, and with each model asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from imutool.mcap_io import schema
from imutool.mcap_io.log import DERIVED_KEY, Log
from imutool.mcap_io.read import read
from imutool.recording import Recording
from imutool.view.rundata import Run, RunData, build


def load(
    log: Path, *, models: Sequence[str | Path] = (), init: str = "auto", imu: str | None = None, truth: str | None = None
) -> RunData:
    """Everything to be shown of one log.

    Raises:
        LogError, DataError, ModelError: as `imutool.evaluate`.
    """
    recording = read(log, imu=imu, truth=truth)
    if recording.truths:
        recording = recording.with_truth(truth or next(iter(recording.truths)))
    found = _with_models(recording, models, init, log) if models else [Run.raw(recording.imu)]
    return build(recording, [*found, *_already_debiased(log, recording)])


def _with_models(recording: Recording, models: Sequence[str | Path], init: str, log: Path) -> list[Run]:
    """Raw, then as each model corrects it; only this needs torch."""
    from imutool.evaluate import runs

    return [Run(n, d.imu, d.bias[:, :3], d.bias[:, 3:]) for n, d, _ in runs(recording, models, init, log)]


def _already_debiased(log: Path, recording: Recording) -> list[Run]:
    """The debiased channels that the log holds of this IMU."""
    with Log(log) as opened:
        topics = [
            topic.name for topic in opened.with_schema((schema.IMU,)) if topic.metadata.get(DERIVED_KEY) == recording.imu_topic
        ]
        named = [values.get("model") for name, values in opened.metadata_records() if name.startswith("imutool")]
    model = next((name for name in reversed(named) if name), None)
    runs_found = []
    for topic in topics:
        imu = read(log, imu=topic, start_ns=None).imu
        raw = recording.imu
        name = f"in the log: {model}" if model else topic.rpartition("/")[2]
        runs_found.append(Run(name, imu, raw.gyro - imu.gyro, raw.accel - imu.accel))
    return runs_found
