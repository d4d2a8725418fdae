"""From a log on disk to what there is to see of it: raw, as it was debiased in the log, and with each model asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imutool.location import Location
from imutool.recording import Recording
from imutool.viewing.model.events import of_survey
from imutool.viewing.model.findings import of_findings
from imutool.viewing.model.provenance import provenance
from imutool.viewing.model.read_log import recorded
from imutool.viewing.model.run_data import Run, RunData, build
from imutool.viewing.model.trajectory_error import Alignment


def load(
    log: Location,
    *,
    models: Sequence[str | Path] = (),
    init: str = "auto",
    smooth: bool = False,
    imu: str | None = None,
    truth: str | None = None,
    align: Alignment = "none",
    findings: Path | None = None,
) -> RunData:
    """Everything to be shown of one log; with `findings`, the folder of a diagnosis, also where they act in it.

    Raises:
        ConfigError: the log or the folder cannot be read; two models of one name; `smooth` with another `init` than auto.
        LogError, DataError: no IMU, a log in which nothing can be saved, findings that are none, or as `rundata.build`.
        ModelError: a model that cannot be used with this log.
    """
    found = recorded(log, imu=imu, truth=truth)
    recording = found.recording
    if recording.truths:
        recording = recording.with_truth(truth or next(iter(recording.truths)))
    with_models, told = _with_models(recording, models, init, str(log), smooth) if models else ([], {})
    events, notes = of_survey(found.survey)
    if findings is not None:
        start_ns, end_ns = int(recording.imu.t_ns[0]), int(recording.imu.t_ns[-1])
        more = of_findings(findings, log.name, start_ns, end_ns)
        events, notes = [*events, *more[0]], [*notes, *more[1]]
    data = build(
        recording,
        [Run.raw(recording.imu), *with_models, *found.debiased],
        align=align,
        events=events,
        notes=[*found.notes, *notes],
    )
    asked = {"start": init, "smooth": "yes"} if smooth else {"start": init} if models else {}
    return replace(
        data,
        provenance=provenance(log, recording, found.metadata, told, asked),
        source=log if isinstance(log, Path) else None,
        logged=found.logged,
    )


def _with_models(
    recording: Recording, models: Sequence[str | Path], init: str, log: str, smooth: bool
) -> tuple[list[Run], dict[str, str]]:
    """As each model corrects the samples, and in words which file that is and how it started; only this needs torch."""
    from imutool.debiasing import apply_with_std
    from imutool.evaluation import started

    runs, told = [], {}
    for name, model, start in started(recording, models, init, log, smooth=smooth):
        debiased, std = apply_with_std(model, start, recording.imu)
        runs.append(Run(name, debiased.imu, debiased.bias[:, :3], debiased.bias[:, 3:], std))
        digest = model.card.get("sha256")
        told[name] = f"{f'sha256 {digest}, ' if digest else ''}{model.method}, start: {start.how}"
    return runs, told
