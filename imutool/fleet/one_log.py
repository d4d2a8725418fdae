"""Task on one log: debias, repair, info or diagnose; no cluster is involved."""

from __future__ import annotations

import contextlib
import hashlib
import platform
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from imutool.cleaning import UntrustedError
from imutool.errors import LOST, ConfigError, ImutoolError, LogError, ModelError
from imutool.file_location import Location, exists, identity, is_file, to_location
from imutool.fleet.sources import simulation
from imutool.fleet.targets import digest, is_current, page_name, remove_files, within
from imutool.fleet.task import Imu, Parameter, Result, Settings, Task
from imutool.mcap_io.codec.joined_imu import parse_parts
from imutool.mcap_io.recovery.losses import unchecked
from imutool.mcap_io.recovery.recovered_log import RecoveredLog
from imutool.mcap_io.storage.source import sha256
from imutool.mcap_io.storage.target import Target
from imutool.processes.system import peak_bytes, user
from imutool.report import UNSET, Report, UnsetType, json_text, json_values

MAX_LOSSES = 20  # stretches listed for a log; its metadata and its repair list all
MAX_LETTERS = 300  # of what a page says


@dataclass(frozen=True)
class _Job:
    """Task with its places as locations."""

    name: str
    source: Location
    target: Location
    settings: Settings


def work(task: Task, model: bytes | None = None) -> Result:
    """Run one task; an `ImutoolError` becomes a failed result, a bug is raised.

    `model` is the content of the model file, where the settings name one: this machine may not have it. The target is written
    whole or not at all, and with the same bytes each time.
    """
    began, cpu_began = time.perf_counter(), time.process_time()
    result = Result(
        key=task.key,
        source=task.source.place,
        target=task.target,
        status="ok",
        source_bytes=task.source.size,
        host=platform.node(),
    )
    try:
        job = _Job(
            task.source.name,
            to_location(task.source.place),
            within(to_location(task.out), task.target),
            _at_hand(task.settings, model),
        )
        if task.done is not None and is_current(task.done, job.target, whole=task.recheck):
            return msgspec.structs.replace(task.done, status="skipped", earlier=task.done.status)
        _refuse_changed(task, job.source)
        if isinstance(job.target, Path):
            job.target.parent.mkdir(parents=True, exist_ok=True)
        entries = COMMANDS[task.settings.command](job)
        _refuse_changed(task, job.source, job.target)
        result = msgspec.structs.replace(result, **entries, target_bytes=identity(job.target)[0], **digest(job.target))
    except UntrustedError as error:
        result = msgspec.structs.replace(result, status="quarantined", error=str(error), exit_code=error.exit_code)
    except ImutoolError as error:
        result = msgspec.structs.replace(result, status="failed", error=str(error), exit_code=error.exit_code)
    except OSError as error:
        reason = f"{error.filename or task.source.place}: {error.strerror or error}"
        result = msgspec.structs.replace(result, status="failed", error=reason, exit_code=ConfigError.exit_code)
    except MemoryError:
        result = msgspec.structs.replace(result, status="failed", error="out of memory", exit_code=LogError.exit_code)
    if result.status in {"failed", "quarantined"}:
        result = msgspec.structs.replace(result, error=result.error + _left_behind(task))
    spent = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu_began}
    return msgspec.structs.replace(result, **spent, peak_bytes=peak_bytes())


def _left_behind(task: Task) -> str:
    """Sentence about a target that is there, although this run has not written it; nobody should take it for its result."""
    with contextlib.suppress(ConfigError):
        target = within(to_location(task.out), task.target)
        return f" {target} is from an earlier run." if is_file(target) else ""
    return ""


def _at_hand(settings: Settings, model: bytes | None) -> Settings:
    """Settings with the model file copied to this machine.

    Raises:
        ModelError: the model's content is not the one that the fleet began with.
    """
    if model is None or settings.model is None:
        return settings
    if hashlib.sha256(model).hexdigest() != settings.model_sha256:
        raise ModelError("has changed since the fleet was begun", where=settings.model, fix="Begin again with `overwrite`")
    copy = Path(tempfile.gettempdir(), f"imutool-models.{user()}", settings.model_sha256, Path(settings.model).name)
    if not copy.is_file() or sha256(copy) != settings.model_sha256:
        copy.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with Target(copy, overwrite=True) as out:
            out.write(model)
    return msgspec.structs.replace(settings, model=str(copy))


def _refuse_changed(task: Task, source: Location, made: Location | None = None) -> None:
    """Refuse a log that is still being written, and remove what was `made` of it."""
    if identity(source) != (task.source.size, task.source.stamp):
        if made is not None:
            remove_files([made])
        raise LogError("has changed since it was listed", where=source, fix="Go on with `resume` when it is complete")


def _debias(job: _Job) -> dict[str, Any]:
    from imutool.cleaning import CleaningSettings
    from imutool.debiasing import debias

    s = job.settings
    rules = CleaningSettings() if s.clean else None
    options: dict[str, Any] = {"init": s.init, "smooth": s.smooth, "force": s.force, "clean": rules, "check": s.check}
    options["imus"] = _imus(job)
    report = debias(job.source, job.target, model=s.model, **options, overwrite=True)
    imus = tuple(
        Imu(topic, report.models[topic], start.how, tuple(start.rest[:3].tolist()), tuple(start.rest[3:].tolist()))
        for topic, start in report.starts.items()
    )
    entries: dict[str, Any] = {"messages": report.rewrite.copied, "imus": imus, **_lost(report.losses.plain())}
    if report.surveys:
        entries["score"] = min(survey.score for survey in report.surveys.values())
        found = (
            f"{topic}: {finding.count} {finding.what}, {finding.action}"
            for topic, survey in report.surveys.items()
            for finding in survey.findings
            if finding.severity != "note"
        )
        entries["warnings"] = (*entries.get("warnings", ()), *found)
    unmeasured = [f"{topic}: {text}" for topic, sieve in report.sieves.items() for text in sieve.warnings()]
    unfit = [f"{topic}: {fit.sentence('the model')}" for topic, fit in report.fits.items() if fit.verdict != "fits"]
    if unmeasured or unfit:
        entries["warnings"] = (*entries.get("warnings", ()), *unmeasured, *unfit)
    if s.pages:
        entries |= _page(job, list(report.starts), entries.get("warnings", ()))
    return entries


def _imus(job: _Job) -> tuple[str, ...]:
    """IMUs of a log among those that the settings name; none where they name none.

    Raises:
        LogError: it has none of them.
    """
    named = job.settings.imus
    if not named:
        return ()
    with RecoveredLog(job.source) as log:
        found = tuple(imu for imu in named if {*(parse_parts(imu) or (imu,))} <= log.topics.keys())
        if not found:
            what = f"the log has no topic {' or '.join(named)}"
            raise LogError(what, where=log.path, expected=log.listing(), fix="Give `imu` once more, for the IMU of this log")
    return found


def _page(job: _Job, topics: Sequence[str], warnings: tuple[str, ...]) -> dict[str, Any]:
    """Write a page next to a debiased log; on failure the result has a warning."""
    from imutool.viewing.html import report
    from imutool.viewing.html.page import is_imutool_page
    from imutool.viewing.html.report_wording import conclusion
    from imutool.viewing.model.load_view import load

    path = job.target.with_name(page_name(job.target.name))
    try:
        if exists(path) and not is_imutool_page(path):
            raise ConfigError("the page exists, and no fleet has written it", where=path, fix="Move it, or choose another OUT")
        logs = [load(job.target, imu=topic) for topic in topics]
        report.write_page(report.name_by_topic(logs, topics), path, overwrite=True)
    except ImutoolError as error:
        return {"warnings": (*warnings, f"no page: {error}")}
    return {"page": page_name(job.name), "page_says": conclusion(logs[0])[:MAX_LETTERS]}


def _info(job: _Job) -> dict[str, Any]:
    from imutool.log_info.inspection import inspect

    report = inspect(job.source)
    write_json(report, job.target)
    counts = {"messages": report.messages, "duration_s": report.duration_s}
    lost = _lost(report.losses)
    return counts | lost | {"warnings": (*lost.get("warnings", ()), *report.warnings)}


def _repair(job: _Job) -> dict[str, Any]:
    from imutool.bag.repair import NO_ATTACHMENTS, is_bag, repair_bag
    from imutool.mcap_io.repair import repair

    if is_bag(job.source):
        if job.settings.damaged == "keep":
            raise ConfigError(NO_ATTACHMENTS, where=job.source, fix="Leave `damaged` out")
        bag = repair_bag(job.source, job.target, overwrite=True)
        return {"messages": sum(bag.messages.values()), **_lost(bag.plain())}
    report = repair(job.source, job.target, damaged=job.settings.damaged, overwrite=True)
    return {"messages": sum(report.messages.values()), **_lost(report.losses.plain())}


def _lost(losses: Mapping[str, Any] | None) -> dict[str, Any]:
    """Status, losses and warnings of a result, from the log's losses in JSON.

    It lists at most `MAX_LOSSES` stretches.
    """
    if not losses:
        return {}
    stretches, lines = losses["stretches"], []
    for stretch in stretches[:MAX_LOSSES]:
        count = "an unknown number of" if stretch["messages"] is None else stretch["messages"]
        lines.append(f"byte {stretch['offset']}, {stretch['bytes']} bytes: {stretch['reason']} ({count} messages lost)")
    more = len(stretches) - len(lines) + losses["stretches_not_listed"]
    status = {"status": "lost", "exit_code": LOST} if stretches else {}
    warnings = (*losses["mended"], *unchecked(losses))
    return {**status, "losses": (*lines, *([f"{more} more stretches"] if more else ())), "warnings": warnings}


def _diagnose(job: _Job) -> dict[str, Any]:
    from imutool.diagnosis.diagnose import diagnose, effect_sizes
    from imutool.fleet.robots import robot_of

    s = job.settings
    robot = robot_of(job.name, s.robot_from, job.source)
    sim = None if s.sim is None else simulation(to_location(s.sim), job.name)
    imu = next(iter(_imus(job)), None)
    fixed = effect_sizes(job.source, sim, imu=imu, truth=s.truth)
    parameters = tuple(
        Parameter(physics.name, number.name, float(value), float(std), number.unit)
        for physics, theta in fixed.chosen
        for number, value, std in zip(physics.parameters, theta, fixed.std[physics.name], strict=True)
    )
    entries: dict[str, Any] = {"robot": robot, "parameters": parameters, "warnings": fixed.remarks}
    diagnosis: dict[str, Any] | UnsetType = UNSET
    if not s.quick:
        found = diagnose([job.source], sim, imu=imu, truth=s.truth)
        diagnosis = json_values(found.report)
        entries["effects"] = tuple(finding.effect for finding in found.findings)
        entries["warnings"] = tuple(dict.fromkeys((*fixed.remarks, *found.remarks)))
    write_json(UnitReport(robot, fixed.bias.tolist(), list(parameters), diagnosis), job.target)
    return entries


class UnitReport(Report, frozen=True, tag="imutool.unit/1"):
    """Parameters of one robot's sensor from one log, with the initial bias (rad/s, m/s²)."""

    robot: str
    bias: list[list[float]]
    parameters: list[Parameter]
    diagnosis: dict[str, Any] | UnsetType = UNSET


def write_json(report: Report, target: Location) -> None:
    """Write a report as JSON; an existing file is replaced."""
    with Target(target, overwrite=True) as out:
        out.write(json_text(report).encode())


COMMANDS: dict[str, Callable[[_Job], dict[str, Any]]] = {
    "debias": _debias,
    "repair": _repair,
    "info": _info,
    "diagnose": _diagnose,
}
