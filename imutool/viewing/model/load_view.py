"""Load a log for viewing: raw and debiased runs with errors, events and provenance."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imutool import __version__
from imutool.array_types import Bool
from imutool.bias.model import GAP_S
from imutool.bias_start.aided_path import residual_prior
from imutool.bias_start.model_choice import check_start, fitness_in_memory
from imutool.errors import ConfigError
from imutool.file_location import Location
from imutool.inertial.aids import Aids, listed, parse_aids
from imutool.inertial.metrics import evaluate
from imutool.inertial.strapdown import StartPose, gaps_crossed, stretch_with_truth, with_velocity
from imutool.processes.system import release_memory
from imutool.recording import Poses, Recording, Scalars, seconds
from imutool.viewing.model.decimation import MAX_CURVE_ROWS
from imutool.viewing.model.events import Event, events_within, finding_events, stop_events, survey_events, worst_error_events
from imutool.viewing.model.read_log import read_log
from imutool.viewing.model.run_data import (
    LEVELLING_S,
    TRUE_BIAS,
    TRUTH,
    Run,
    RunData,
    Spectrum,
    Trace,
    level_start,
    spectra,
)
from imutool.viewing.model.trajectory_error import Alignment, aligned, drift_since_reset, errors, windows


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
    aid: str | None = None,
) -> RunData:
    """Load all data of one log for viewing, with the events of a diagnosis in `findings`.

    With `aid` there is an aided path of each model too, of the raw samples where there is no model.

    Raises:
        ConfigError: the log or the folder cannot be read; two models of one name; an `init` that is none; `smooth` with one.
        LogError, DataError: no IMU, a log from which nothing can be recovered, an invalid findings.json, or as `build`.
        ModelError: a model that cannot be used with this log.
    """
    check_start(init, smooth)
    asked = None if aid is None else parse_aids(aid)
    contents = read_log(log, imu=imu, truth=truth)
    release_memory()
    recording = contents.recording
    if recording.truths:
        recording = recording.with_truth(truth or next(iter(recording.truths)))
    aids = None
    if asked is not None:
        with contents.opened(log) as opened:
            from imutool.log_info.aid_search import find_aids

            aids = find_aids(opened, recording, asked)
    events, notes = survey_events(contents.survey)
    with_models, aided, origins = _with_models(recording, models, init, str(log), smooth, aids, notes)
    if findings is not None:
        more_events, more_notes = finding_events(findings, str(log), *recording.imu.t_ns[[0, -1]].tolist())
        events, notes = [*events, *more_events], [*notes, *more_notes]
    raw = Run.raw(recording.imu)
    if aids is not None:
        aided += [run.aided(aids, residual_prior(std=run.bias_std)) for run in contents.debiased]
        aided = aided or [raw.aided(aids, residual_prior())]
        notes.append(f"Aids: {listed(aids.signals)}.")
    data = build(
        recording,
        [raw, *with_models, *contents.debiased, *aided],
        align=align,
        events=events,
        notes=[*contents.notes, *notes],
    )
    release_memory()
    settings = {"start": init, "smooth": "yes"} if smooth else {"start": init} if models else {}
    return replace(
        data,
        provenance=provenance(log, recording, contents.metadata, origins, settings),
        source=log if isinstance(log, Path) else None,
        logged=contents.logged,
    )


def _with_models(
    recording: Recording,
    models: Sequence[str | Path],
    init: str,
    log: str,
    smooth: bool,
    aids: Aids | None,
    notes: list[str],
) -> tuple[list[Run], list[Run], dict[str, str]]:
    """Run of each model, the same with aids, and by its name its file digest, method and initial bias.

    A model that does not fit is named in `notes` and warned of.
    """
    if not models:
        return [], [], {}
    from imutool.bias_start.bias_from_truth import TRUTH_S
    from imutool.bias_start.correction import apply_with_std
    from imutool.evaluation import started
    from imutool.log_info.convention_report import contradictions, warn_of_recordings

    method = "smooth" if smooth else f"truth:{TRUTH_S:g}" if init == "truth" else init
    runs, aided, origins = list[Run](), list[Run](), dict[str, str]()
    wrong = [text for whole in warn_of_recordings([recording]) for text in contradictions(whole)]
    for name, model, start in started(recording, models, init, log, smooth=smooth, force=True):
        fit = fitness_in_memory(model, start, recording, wrong).report(name, recording.name, force=True)
        notes += [] if fit.verdict == "fits" else [fit.sentence(f"The model {name}")]
        debiased, std = apply_with_std(model, start, recording.imu)
        runs.append(Run(name, debiased.imu, debiased.bias[:, :3], debiased.bias[:, 3:], std, method))
        aided += [] if aids is None else [runs[-1].aided(aids, residual_prior(start, std))]
        digest = model.card.get("sha256")
        origins[name] = f"{f'sha256 {digest}, ' if digest else ''}{model.method}, start: {start.how}"
    return runs, aided, origins


def build(
    recording: Recording,
    runs: Sequence[Run],
    *,
    align: Alignment = "none",
    events: Sequence[Event] = (),
    notes: Sequence[str] = (),
) -> RunData:
    """Build the data of a view from a recording and its runs.

    With truth every path starts at the true pose and velocity of the first sample that has one and ends with the last such
    sample; figures, drift and windows are of that path, errors after the alignment asked for. Without, a path starts at the
    origin, at rest, level by the first half second of its own specific force and with heading zero, and there are no errors.

    Raises:
        ConfigError: no run, or two of one name.
        DataError: IMU and truth share fewer than two samples, or leave the alignment open.
        NumericsError: an integration overflows.
    """
    names = [run.name for run in runs]
    if not names or len(set(names)) < len(names) or TRUTH in names:
        raise ConfigError(
            f"the runs have the names {names}", where=recording.name, expected="different names, none of them 'truth'"
        )
    imu = recording.imu
    start_ns, end_ns = int(imu.t_ns[0]), int(imu.t_ns[-1])
    if recording.truths:
        truth = with_velocity(recording.truth)
        traces, of_paths = _scored(runs, truth, recording.name, align)
    else:
        truth, align = None, "none"
        traces = tuple(Trace(run, run.path_from(run.imu, level_start(run.imu)), None, spectra=_spectra(run)) for run in runs)
        of_paths = [
            f"This log has no truth, so there are no errors and nothing to align with. Paths start at the origin, at rest, "
            f"heading 0, levelled by the first {LEVELLING_S:g} s of specific force."
        ]
    with_worst = [trace for trace in traces if not trace.is_raw] or traces
    worst = [
        event for trace in with_worst if trace.errors is not None for event in worst_error_events(trace.name, trace.errors)
    ]
    if len(imu) > MAX_CURVE_ROWS:
        of_paths.append(
            f"Curves of {len(imu):,} samples are drawn with at most {MAX_CURVE_ROWS:,} rows: the extremes of each stretch."
        )
    shown, of_events = events_within([*events, *stop_events(imu), *worst], start_ns, end_ns)
    return RunData(
        name=recording.name,
        start_ns=start_ns,
        end_ns=end_ns,
        truth=None if truth is None else _within(truth, start_ns, end_ns),
        true_bias=_true_bias(recording),
        traces=traces,
        notes=(*of_paths, *notes, *of_events),
        alignment=align,
        events=shown,
    )


def _within(truth: Poses, start_ns: int, end_ns: int) -> Poses:
    """Poses in the time of the samples; where none is, as with few samples left, the two around it."""
    first, last = np.searchsorted(truth.t_ns, [start_ns, end_ns + 1])
    rows: Poses = truth.rows(slice(int(first), int(last)) if last > first else slice(max(0, int(first) - 1), int(last) + 1))
    return rows


def _true_bias(recording: Recording) -> Mapping[str, Scalars]:
    """True biases in the log, while the IMU runs."""
    imu = recording.imu
    known = {kind: recording.scalars[topic] for kind, topic in TRUE_BIAS.items() if topic in recording.scalars}
    return {kind: b.between(int(imu.t_ns[0]), int(imu.t_ns[-1])) for kind, b in known.items()}


def _scored(runs: Sequence[Run], truth: Poses, where: str, align: Alignment) -> tuple[tuple[Trace, ...], list[str]]:
    """Scored runs over the span with truth: errors, figures and notes."""
    known: list[TruthSpan] = []
    for k, run in enumerate(runs):
        alike = k > 0 and np.array_equal(run.imu.t_ns, runs[k - 1].imu.t_ns)
        known.append(known[-1] if alike else TruthSpan(*stretch_with_truth(run.imu.t_ns, truth, where)))
    release_memory()
    with ThreadPoolExecutor() as pool:  # nearly all of it is numpy's, which lets other threads work
        scored = list(pool.map(partial(_score, align=align), runs, known))
    traces, motions = tuple(trace for trace, _ in scored), [motion for _, motion in scored if motion]
    started = seconds(traces[0].path.t_ns[:1], int(runs[0].imu.t_ns[0]))[0]
    gaps = gaps_crossed(traces[0].path.t_ns, GAP_S, int(runs[0].imu.t_ns[0]))
    how = "errors are without alignment" if align == "none" else f"paths and errors are shown after alignment {align}"
    return traces, [
        f"Paths start at the true pose, {started:.2f} s into the log; {how}.",
        *(["The figures, drift and windows are without alignment."] if motions else []),
        *motions,
        *([f"{gaps[0].upper()}{gaps[1:]}."] if gaps else []),
    ]


class TruthSpan(NamedTuple):
    """Span with truth: rows of the IMU, true poses, and a mask of the rows outside gaps."""

    rows: slice
    true: Poses
    valid: Bool[np.ndarray, " n"]


def _score(run: Run, known: TruthSpan, align: Alignment) -> tuple[Trace, str]:
    """One run with its errors and figures, and a note on its alignment, if any."""
    rows, true, valid = known
    path = run.path_from(run.imu.rows(rows), StartPose.of(true))
    moved, motion = aligned(path, true, valid, align)
    figures = evaluate(path, true, valid)
    trace = Trace(run, moved, errors(moved, true, valid), figures=figures, spectra=_spectra(run))
    if not run.is_aided:  # only an integration goes on from a true pose as from its own
        trace = replace(trace, drift=drift_since_reset(path, true, valid), windows=windows(path, true, valid))
    if align == "none":
        return trace, ""
    shift_m = np.linalg.norm(moved.p_wb[valid].mean(axis=0) - path.p_wb[valid].mean(axis=0))
    turn_deg = np.rad2deg(motion.rotation.magnitude())
    return trace, f"{run.name}: alignment {align} turned the path by {turn_deg:.3g} deg, its centre moved {shift_m:.3g} m."


def _spectra(run: Run) -> Mapping[str, Spectrum]:
    """Spectra of the samples; an aided run has those of the run that it aids."""
    return {} if run.is_aided else spectra(run.imu)


METADATA_PREFIX = "imutool"  # of the names of metadata records that imutool writes
MAX_ENTRIES = 60  # from the log's records, which anybody may have written
MAX_VALUE_LENGTH = 200  # letters
NO_VALUE = ("", "null", "{}")


def provenance(
    log: Location,
    recording: Recording,
    metadata: Sequence[tuple[str, Mapping[str, str]]],
    models: Mapping[str, str],
    settings: Mapping[str, str],
) -> dict[str, str]:
    """Provenance by name: file, topics, settings, models, versions, imutool's metadata records.

    There is no digest of the log, which may have terabytes. Long values of records are cut, entries beyond MAX_ENTRIES counted.
    """
    entries = {"file": log.name, "size": f"{log.stat().st_size} bytes", "IMU": recording.imu_topic}
    if recording.truths:
        entries["truth"] = next(iter(recording.truths))
    entries |= {**settings, **{f"model {name}": how for name, how in models.items()}}
    entries |= {"imutool": __version__, "numpy": np.__version__, "python": platform.python_version()}
    records = [
        (name, key, value)
        for name, values in metadata
        if name.startswith(METADATA_PREFIX)
        for key, value in values.items()
        if value not in NO_VALUE
    ]
    entries |= {_cut(f"{name}: {key}"): _cut(value) for name, key, value in records[:MAX_ENTRIES]}
    if len(records) > MAX_ENTRIES:
        entries["more in the log's records"] = f"{len(records) - MAX_ENTRIES} entries"
    return entries


def _cut(text: str) -> str:
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[: MAX_VALUE_LENGTH - 1]}…"
