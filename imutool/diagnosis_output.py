"""Output folder of a diagnosis: findings.json, physics.toml, report, log and view.

The files are made in a folder next to it and moved when all are there, so that a reader never finds half a diagnosis. Other
files in the folder, the logs themselves for instance, stay as they are.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from imutool.diagnosis.closed_loop import CLOSED_LOG, ROUNDS, check_metric, closed_loop, figure, is_worth_a_round
from imutool.diagnosis.compared_logs import ComparedLogs
from imutool.diagnosis.diagnose import diagnose as diagnose_logs
from imutool.diagnosis.result import Diagnosis
from imutool.diagnosis.second_simulation import simulate_again
from imutool.diagnosis.to_sensor_files import to_noise_file, to_physics_file
from imutool.errors import ConfigError, ImutoolError, required
from imutool.file_location import Location, local
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.local import remove_abandoned, temporary_path
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.mcap_io.storage.target import Target, writing
from imutool.noise import datasheet
from imutool.processes.forked import Forked
from imutool.report import NamedProgress, json_text, silent
from imutool.sensor import physics_file
from imutool.sensor.simulate import simulate

if TYPE_CHECKING:
    from imutool.viewing.model.run_data import RunData

FINDINGS, EFFECT, NOISE = "findings.json", "physics.toml", "noise.toml"
REPORT, LOG, VIEW = "report.html", "log.html", "view.rrd"
CLOSED = "closed.html"
FILES = (FINDINGS, EFFECT, NOISE, REPORT, LOG, VIEW)
OF_CLOSE = (CLOSED, CLOSED_LOG)
DRAWN = ("matplotlib", "report")  # the library that draws a file, and its extra
NEEDS = {LOG: DRAWN, REPORT: DRAWN, VIEW: ("rerun", "view")}


def refuse(folder: Path, *, overwrite: bool = False) -> None:
    """Refuse a folder that cannot take a diagnosis; ask before hours of work.

    Raises:
        ConfigError: a file of that name, a diagnosis in it already (without `overwrite`), or a place that cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise ConfigError("is a file", where=folder, expected="a folder, which need not exist")
    existing = [name for name in (*FILES, CLOSED) if (folder / name).exists()]
    if existing and not overwrite:
        raise ConfigError(
            f"holds a diagnosis already ({', '.join(existing)})", where=folder, fix="Choose another folder, or give `overwrite`"
        )
    above = next(parent for parent in folder.absolute().parents if parent.is_dir())
    with writing(folder), TemporaryDirectory(dir=above, prefix=".imutool-"):
        pass  # even the superuser cannot write everywhere


def write(
    d: Diagnosis,
    folder: Path,
    *,
    logs: Callable[[Path], list[RunData]] | None = None,
    drawn: Forked[dict[str, str]] | None = None,
    overwrite: bool = False,
) -> list[str]:
    """Write the folder of a diagnosis; return a remark for each file without its extra.

    With `logs`, which looks at the logs again with the folder's findings in hand, there is a page of them too, with what is
    `drawn` by then.
    A diagnosis that is replaced goes whole: of its files none is kept.

    Raises:
        ConfigError: as `refuse`, or the system refuses to write.
    """
    refuse(folder, overwrite=overwrite)
    target = folder.absolute()  # "." has no name of its own
    remove_abandoned(target)
    partial = temporary_path(target)
    complete = partial / target.name  # what is written names the folder as it will be called
    with writing(folder):
        try:
            complete.mkdir(parents=True)
            remarks = _make(d, complete, logs, drawn)
            _publish(complete, folder, overwrite=overwrite)
        except ImutoolError as error:
            raise error.renamed({str(complete): str(folder)}) from error.__cause__
        finally:
            with contextlib.suppress(FileNotFoundError):
                shutil.rmtree(partial)
    return remarks


def diagnose(
    asked: ComparedLogs,
    folder: Path | None = None,
    *,
    close: bool = False,
    metric: Callable[[Path], float] | None = None,
    overwrite: bool = False,
    tell: NamedProgress = silent,
    names: Mapping[str, str] | None = None,
) -> tuple[Diagnosis, list[str]]:
    """Diagnosis of recordings, written to a folder if given; a remark for each file left out.

    With `close` its physics is simulated along `sim` or the recording's poses. What is missing against that log begins another
    search, for some rounds. `metric` is called with `sim` first; if it fails later, a remark says so. `names` replace paths.

    Raises:
        ConfigError: as `refuse`; with `close` several recordings, no folder, or an input that is no file or would be replaced;
            `metric` gives no number for `sim`.
        LogError: no such topic.
        DataError: no truth and no simulation, or too little shared time.
    """
    reals, sim, imu, truth, _, settings = asked

    def look(findings: Path | None = None) -> list[RunData]:
        from imutool.viewing.model.load_view import load

        return [load(real, imu=asked.compared_imu(), truth=truth, findings=findings) for real in reals]

    if metric is not None:
        check_metric(metric, closes=close and sim is not None)
    if close:
        _check_close(reals, sim, folder, overwrite=overwrite)
    search = partial(_diagnosed, names or {}, tell=tell)
    if folder is None:
        return search(asked), []
    refuse(folder, overwrite=overwrite)
    given = local(sim, "close") if close and sim is not None else None
    was = None if metric is None or given is None else figure(metric, given)
    if find_spec(DRAWN[0]) is not None:
        required("matplotlib.figure", DRAWN[1])  # once, here: each process that draws is a copy of this one
    drawn = Forked(partial(_drawings, look), idle=True)  # of the logs, while they are diagnosed, where time is left
    diagnosis = search(asked)
    tell(0, 1, "writing")
    remarks = write(diagnosis, folder, logs=look, drawn=drawn, overwrite=overwrite)
    if close:
        rewrite = partial(write, folder=folder, logs=look, overwrite=True)
        simulated: Callable[..., object] = partial(simulate, local(reals[0], "close"), truth=truth)
        if given is not None:
            simulated = partial(simulate_again, reals[0], given, imu=imu, settings=settings)
        own = None if metric is None or was is None else (metric, was)
        diagnosis = _closed(diagnosis, asked, search, rewrite, simulated, folder, metric=own, overwrite=overwrite)
    return diagnosis, remarks


def _diagnosed(names: Mapping[str, str], asked: ComparedLogs, **options: Any) -> Diagnosis:
    d = diagnose_logs(**asked._asdict(), **options)
    real, sim = tuple(names.get(place, place) for place in d.real), names.get(d.sim or "", d.sim)
    located = tuple(msgspec.structs.replace(at, log=names.get(at.log, at.log)) for at in d.located)
    traces = tuple(replace(trace, path=names.get(trace.path, trace.path)) for trace in d.traces)
    return replace(d, real=real, sim=sim, located=located, traces=traces)


def _check_close(reals: Sequence[Location], sim: Location | None, folder: Path | None, *, overwrite: bool) -> None:
    if folder is None or len(reals) != 1:
        raise ConfigError("`close` needs one recording and a folder", fix="Give one recording, and a folder")
    inputs = [local(place, "close") for place in (reals[0], sim) if place is not None]
    check_outputs([OutputFile("close", folder, files=(*FILES, *OF_CLOSE))], inputs, overwrite=overwrite)
    for place in inputs:
        with Log(place) as log:
            if not log.imu_topics:
                raise ConfigError("`close` simulates an IMU, and the log has none", where=place, fix="Leave `close` out")


def _closed(
    first: Diagnosis,
    asked: ComparedLogs,
    search: Callable[..., Diagnosis],
    rewrite: Callable[[Diagnosis], object],
    simulated: Callable[..., object],
    folder: Path,
    *,
    metric: tuple[Callable[[Path], float], float] | None,
    overwrite: bool,
) -> Diagnosis:
    """Diagnosis with its closed loop; `metric` is the user's, and its figure of the simulation that was given."""
    log = folder / CLOSED_LOG
    for number in range(1, ROUNDS + 1):
        simulated(log, physics=folder / EFFECT, overwrite=overwrite or number > 1)
        second = search(asked._replace(sim=log, signals=()))
        if number == ROUNDS or not is_worth_a_round(first, second):
            break
        better = search(asked, begin=(*first.findings, *second.findings))
        if {finding.effect for finding in better.findings} == {finding.effect for finding in first.findings}:
            break
        rewrite(first := better)
    try:
        figures = None if metric is None else (metric[1], figure(metric[0], log))
    except ImutoolError as error:  # for a figure no diagnosis is thrown away
        figures, first = None, replace(first, remarks=(*first.remarks, f"The metric is not compared: {error}"))
    done = replace(first, closed=closed_loop(first, second, log, metric=figures, rounds=number))
    with Target(folder / FINDINGS, overwrite=True) as findings:
        findings.write(json_text(done.report).encode())
    if find_spec("matplotlib") is not None:
        from imutool.viewing.html.diagnosis_page import write as write_page

        write_page(second, folder / CLOSED, logs=LOG if (folder / LOG).exists() else None, first=done)
    return done


def _make(
    d: Diagnosis, folder: Path, logs: Callable[[Path], list[RunData]] | None, drawn: Forked[dict[str, str]] | None
) -> list[str]:
    (folder / FINDINGS).write_text(json_text(d.report), encoding="utf-8")
    physics_file.write(to_physics_file(d), folder / EFFECT)
    noise = to_noise_file(d)
    if noise is not None:
        datasheet.write(noise, folder / NOISE)
    remarks: list[str] = []
    seen: list[RunData] = []
    missing = {name for name, (library, _) in NEEDS.items() if find_spec(library) is None}
    wanted = logs is not None and LOG not in missing and not (d.bias.size and np.isnan(d.bias).all())  # it draws an IMU
    report = Forked(partial(_report, d, LOG if wanted else None))
    if logs is not None and wanted:
        try:
            seen = logs(folder)
        except ImutoolError as error:
            remarks.append(f"{LOG} is left out: {error}")  # for a picture of the logs no diagnosis is thrown away
            report.end()
            report = Forked(partial(_report, d, None))
    if VIEW not in missing:
        from imutool.viewing.rerun.diagnosis import save

        save(d, folder / VIEW)
    if seen:
        from imutool.viewing.html.report import write_page

        write_page(seen, folder / LOG, drawn=(drawn.ready() if drawn is not None else None) or {})
    if REPORT not in missing:
        (folder / REPORT).write_text(report.result(), encoding="utf-8")
    for name in (LOG, REPORT, VIEW):
        library, extra = NEEDS[name]
        if name in missing and not (name == LOG and logs is None):
            remarks.append(f"{name} is left out: {library} is not installed (pip install 'imutool[{extra}]')")
    return remarks


def _report(d: Diagnosis, logs: str | None) -> str:
    from imutool.viewing.html.diagnosis_page import html

    return html(d, logs=logs)


def _drawings(logs: Callable[[], list[RunData]]) -> dict[str, str]:
    from imutool.viewing.html.report import drawings

    return drawings(logs())


def _publish(complete: Path, folder: Path, *, overwrite: bool) -> None:
    """Put a whole diagnosis in its folder; of two that end together one is refused.

    Raises:
        ConfigError: as `refuse`, if another diagnosis came meanwhile.
    """
    refuse(folder, overwrite=overwrite)
    if not folder.exists():
        try:
            complete.rename(folder)
        except OSError:
            if not folder.is_dir():
                raise
        else:
            return
    if not overwrite:
        try:
            (folder / FINDINGS).open("xb").close()  # only one of two can make it
        except FileExistsError:
            refuse(folder)
    _move(complete, folder)


def _move(complete: Path, folder: Path) -> None:
    """Replace each file of an old diagnosis; remove those without a new one."""
    for name in (*FILES, CLOSED):
        if (complete / name).exists():
            (complete / name).replace(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)
