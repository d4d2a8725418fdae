"""How far pure integration drifts, raw and with each model: the figures of the paper's tables, for any log with true poses."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imutool import metrics
from imutool.bias import static
from imutool.bias._base import BiasModel
from imutool.bias._file import check_rate, find_model
from imutool.debias import Debiased, apply, estimate_at_rest
from imutool.errors import ConfigError
from imutool.mcap_io.read import read
from imutool.recording import Poses, Recording
from imutool.strapdown import along_truth
from imutool.turn_on import TurnOn, find

RAW = "raw"
SCHEMA = "imutool.evaluation/1"


def evaluate(
    log: Path,
    *,
    models: Sequence[str | Path] = (),
    init: str = "auto",
    truth: str | None = None,
    imu: str | None = None,
    trajectories: Path | None = None,
    overwrite: bool = False,
) -> list[dict[str, Any]]:
    """One result for the raw samples and one for each model (contracts.md, evaluate).

    Every trajectory starts at the true pose and velocity at the first sample the truth covers, and is integrated by
    `strapdown.dead_reckon`; only samples outside gaps of the truth are scored.

    Raises:
        LogError, DataError: no IMU, no truth, or the two share no time.
        ModelError: a model that cannot be used with this log.
    """
    if trajectories is not None:
        _refuse_twins(models)
    recording = read(log, imu=imu, truth=truth)
    if truth is None and recording.truths:
        recording = recording.with_truth(next(iter(recording.truths)))
    results = []
    for name, found, start in runs(recording, models, init, log):
        estimate, true, valid = along_truth(found.imu, recording.truth, recording.name)
        figures = metrics.evaluate(estimate, true, valid)
        results.append(
            {
                "log": recording.name,
                "model": name,
                "init": init if start else None,
                "init_how": start.how if start else None,
                **figures,
                "gyro_bias": start.rest[:3].tolist() if start else [0.0, 0.0, 0.0],
                "accel_bias": start.rest[3:].tolist() if start else [0.0, 0.0, 0.0],
            }
        )
        if trajectories is not None:
            _write(trajectories, recording.name, name, estimate, true, valid, overwrite=overwrite)
    return results


def runs(
    recording: Recording, models: Sequence[str | Path], init: str, where: str | Path
) -> Iterator[tuple[str, Debiased, TurnOn | None]]:
    """The samples as recorded, then as each model corrects them: name, samples and bias, and the start."""
    yield RAW, Debiased(recording.imu, np.zeros((len(recording.imu), 6))), None
    for given in models:
        model, start = _model_and_start(given, recording, init, where)
        yield str(model.card.get("name", model.method)), apply(model, start, recording.imu), start


def _model_and_start(given: str | Path, recording: Recording, init: str, where: str | Path) -> tuple[BiasModel, TurnOn]:
    if str(given) == static.Model.method:
        if init == "auto":
            return estimate_at_rest(recording.imu, where)
        untrained = static.Model()
        return untrained, find(init, untrained, recording)
    model = find_model(given)
    check_rate(model, 1.0 / recording.imu.period_s, where)
    return model, find(init, model, recording)


def _refuse_twins(models: Sequence[str | Path]) -> None:
    """Two models of one name would write one file."""
    names = [Path(model).stem for model in models]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"two models are called {name!r}", where="--trajectories", fix="Rename one of the files")


def _write(folder: Path, log: str, model: str, estimate: Poses, true: Poses, valid: Any, *, overwrite: bool) -> None:
    """TUM-format files: LOG_truth.tum and LOG_MODEL.tum on the same stamps, those that are scored."""
    folder.mkdir(parents=True, exist_ok=True)
    log = re.sub(r"[^\w.+-]", "_", log).lstrip(".") or "_"  # a log's name is its writer's, and must not lead elsewhere
    if model == RAW:
        metrics.write_tum(true.rows(valid), folder / f"{log}_truth.tum", overwrite)
    metrics.write_tum(estimate.rows(valid), folder / f"{log}_{model}.tum", overwrite)
