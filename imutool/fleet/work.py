"""What is done to one log, wherever that is: a task comes in, a result goes out. Nothing here knows of a cluster."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from imutool.cleaning import UntrustedError
from imutool.errors import ConfigError, ImutoolError, LogError, ModelError
from imutool.fleet.sources import leftovers, remove, within
from imutool.fleet.task import Imu, Parameter, Result, Settings, Task
from imutool.location import Location, identity, to_location
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.source import sha256
from imutool.mcap_io.storage.target import Target
from imutool.report import json_values

LOST = 3  # exit code: something of the log was lost
MOST_LOSSES = 20  # stretches told of a log; its metadata and its repair tell all
MOST_LETTERS = 300  # of what a page says
MAXRSS = 1 if sys.platform == "darwin" else 1024  # bytes in what the system counts memory in


@dataclass(frozen=True)
class _Job:
    """A task with its places opened up."""

    name: str
    source: Location
    target: Location
    settings: Settings


def work(task: Task, model: bytes | None = None) -> Result:
    """Does one log. What fails for a reason a user can act on becomes a failed result; a bug is raised.

    `model` is the content of the model file, where the settings name one: this machine may not have it. The target is there
    whole or not at all, and is the same, byte for byte, however often this is done. What an attempt that was killed has left
    beside it is removed.
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
        if task.done is not None and stands(task.done, job.target, whole=task.recheck):
            return msgspec.structs.replace(task.done, status="skipped", earlier=task.done.status)
        _refuse_changed(task, job.source)
        _clear(task, job.target)
        told = COMMANDS[task.settings.command](job)
        result = msgspec.structs.replace(result, **told, **_measured(job.target))
    except UntrustedError as error:
        result = msgspec.structs.replace(result, status="quarantined", error=str(error), exit_code=error.exit_code)
    except ImutoolError as error:
        result = msgspec.structs.replace(result, status="failed", error=str(error), exit_code=error.exit_code)
    except OSError as error:
        reason = f"{error.filename or task.source.place}: {error.strerror or error}"
        result = msgspec.structs.replace(result, status="failed", error=reason, exit_code=ConfigError.exit_code)
    except MemoryError:
        result = msgspec.structs.replace(result, status="failed", error="out of memory", exit_code=LogError.exit_code)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS
    spent = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu_began}
    return msgspec.structs.replace(result, **spent, peak_bytes=peak)


def page_name(log: str) -> str:
    """What the page about a log is called: as the log."""
    return log.removesuffix(".mcap") + ".html"


def stands(done: Result, target: Location, *, whole: bool = False) -> bool:
    """Whether a target is still what an earlier run left: of its size, and a log that opens; with `whole`, of its SHA-256."""
    if done.status == "quarantined":  # nothing was written
        return True
    try:
        if identity(target)[0] != done.target_bytes or (done.page and not target.with_name(page_name(target.name)).is_file()):
            return False
        if whole or target.suffix != ".mcap":
            return sha256(target) == done.target_sha256
        with Log(target):
            return True
    except ImutoolError:
        return False


def _at_hand(settings: Settings, model: bytes | None) -> Settings:
    """Settings that name a file here, with the model that the fleet began with: who planned it may sit at another machine.

    Raises:
        ModelError: what was sent is not what was meant.
    """
    if model is None or settings.model is None:
        return settings
    if hashlib.sha256(model).hexdigest() != settings.model_sha256:
        raise ModelError("has changed since the fleet was begun", where=settings.model, fix="Begin again with --overwrite")
    there = Path(tempfile.gettempdir(), f"imutool-models.{os.getuid()}", settings.model_sha256, Path(settings.model).name)
    if not there.is_file() or sha256(there) != settings.model_sha256:
        there.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with Target(there, overwrite=True) as out:
            out.write(model)
    return msgspec.structs.replace(settings, model=str(there))


def _refuse_changed(task: Task, source: Location) -> None:
    """A log that is still being written is left for another time."""
    if identity(source) != (task.source.size, task.source.stamp):
        raise LogError("has changed since it was listed", where=source, fix="Go on with --resume when it is complete")


def _clear(task: Task, target: Location) -> None:
    """Makes the folder, and removes what a killed attempt at this target left in it."""
    if isinstance(target, Path):
        target.parent.mkdir(parents=True, exist_ok=True)
    remove(leftovers(to_location(task.out), [task.target, page_name(task.target)]))


def _measured(target: Location) -> dict[str, Any]:
    return {"target_bytes": identity(target)[0], "target_sha256": sha256(target)}


def _debias(job: _Job) -> dict[str, Any]:
    from imutool.cleaning import Rules
    from imutool.debiasing import debias

    s = job.settings
    rules = Rules() if s.clean else None
    report = debias(
        job.source, job.target, model=s.model, init=s.init, smooth=s.smooth, clean=rules, check=s.check, overwrite=True
    )
    imus = tuple(
        Imu(topic, report.models[topic], start.how, tuple(start.rest[:3].tolist()), tuple(start.rest[3:].tolist()))
        for topic, start in report.starts.items()
    )
    told: dict[str, Any] = {"messages": report.rewrite.copied, "imus": imus, **_lost(report.losses.plain())}
    if report.surveys:
        told["score"] = min(one.score for one in report.surveys.values())
        said = (
            f"{topic}: {finding.count} {finding.what}, {finding.action}"
            for topic, one in report.surveys.items()
            for finding in one.findings
            if finding.severity != "note"
        )
        told["warnings"] = (*told.get("warnings", ()), *said)
    if s.pages:
        told |= _page(job, list(report.starts), told.get("warnings", ()))
    return told


def _page(job: _Job, topics: Sequence[str], warnings: tuple[str, ...]) -> dict[str, Any]:
    """Writes a page about a debiased log beside it. A log that cannot be drawn is whole all the same, and is warned of."""
    from imutool.viewing.html import report
    from imutool.viewing.html.page import is_imutool_page
    from imutool.viewing.html.report_wording import conclusion
    from imutool.viewing.model.runs import load

    path = job.target.with_name(page_name(job.target.name))
    try:
        if path.exists() and not is_imutool_page(path):
            raise ConfigError("the page exists, and no fleet has written it", where=path, fix="Move it, or choose another OUT")
        logs = [load(job.target, imu=topic) for topic in topics]
        report.write_page(report.name_by_topic(logs, topics), path, overwrite=True)
    except ImutoolError as error:
        return {"warnings": (*warnings, f"no page: {error}")}
    return {"page": page_name(job.name), "page_says": conclusion(logs[0])[:MOST_LETTERS]}


def _info(job: _Job) -> dict[str, Any]:
    from imutool.log_info import inspect

    report = inspect(job.source)
    write_json(report, job.target)
    told = {"messages": report["messages"], "duration_s": report["duration_s"]}
    lost = _lost(report.get("losses"))
    return told | lost | {"warnings": (*lost.get("warnings", ()), *report["warnings"])}


def _repair(job: _Job) -> dict[str, Any]:
    from imutool.bag.repair import NO_ATTACHMENTS, is_bag, repair_bag
    from imutool.mcap_io.repair import repair

    if is_bag(job.source):
        if job.settings.damaged == "keep":
            raise ConfigError(NO_ATTACHMENTS, where=job.source, fix="Leave --damaged out")
        bag = repair_bag(job.source, job.target, overwrite=True)
        return {"messages": sum(bag.messages.values()), **_lost(bag.plain())}
    report = repair(job.source, job.target, damaged=job.settings.damaged, overwrite=True)
    return {"messages": sum(report.messages.values()), **_lost(report.losses.plain())}


def _lost(losses: Mapping[str, Any] | None) -> dict[str, Any]:
    """What a result says of a log's losses, from the values that stand in JSON for them; the first of many."""
    if not losses:
        return {}
    stretches, told = losses["stretches"], []
    for one in stretches[:MOST_LOSSES]:
        count = "an unknown number of" if one["messages"] is None else one["messages"]
        told.append(f"byte {one['offset']}, {one['bytes']} bytes: {one['reason']} ({count} messages lost)")
    more = len(stretches) - len(told) + losses["stretches_not_listed"]
    status = {"status": "lost", "exit_code": LOST} if stretches else {}
    return {**status, "losses": (*told, *([f"{more} more stretches"] if more else ())), "warnings": tuple(losses["mended"])}


def _diagnose(job: _Job) -> dict[str, Any]:
    from imutool.diagnosis.diagnose import diagnose
    from imutool.diagnosis.effect_sizes import effect_sizes

    s = job.settings
    robot = robot_of(job.name, s.robot_from, job.source)
    sim = None if s.sim is None else _simulation(to_location(s.sim), job.name)
    fixed = effect_sizes(job.source, sim, imu=s.imu, truth=s.truth)
    parameters = tuple(
        Parameter(physics.name, number.name, float(value), float(std), number.unit)
        for physics, theta in fixed.chosen
        for number, value, std in zip(physics.parameters, theta, fixed.std[physics.name], strict=True)
    )
    told: dict[str, Any] = {"robot": robot, "parameters": parameters}
    report: dict[str, Any] = {"schema": "imutool.unit/1", "robot": robot, "bias": fixed.bias.tolist()}
    report["parameters"] = [msgspec.to_builtins(one) for one in parameters]
    if not s.quick:
        found = diagnose([job.source], sim, imu=s.imu, truth=s.truth)
        report["diagnosis"] = json_values(found.report)
        told["effects"] = tuple(one.effect for one in found.findings)
        told["warnings"] = found.remarks
    write_json(report, job.target)
    return told


def robot_of(name: str, pattern: str | None, log: Location) -> str:
    """Whose log it is: as a pattern says of its name, or `metadata:RECORD.KEY` of what it holds; else its folder's name.

    Raises:
        ConfigError: the pattern is none, or fits neither.
    """
    fits = robot_pattern(pattern)
    if fits is None:
        folder, _, file = name.rpartition("/")
        return folder or file.removesuffix(".mcap")
    if isinstance(fits, str):
        record, _, key = fits.rpartition(".")
        with Log(log) as opened:
            found = opened.metadata().get(record, {}).get(key, "")
        if not found:
            raise ConfigError(f"has no {key!r} in its metadata {record!r}", where=log)
        return found
    match = fits.search(name)
    if match is None:
        raise ConfigError(f"{fits.pattern!r} fits nothing in {name}", where="--robot-from")
    return str(match[1] if fits.groups else match[0])


def robot_pattern(pattern: str | None) -> re.Pattern[str] | str | None:
    """A regular expression on names, or RECORD.KEY of metadata.

    Raises:
        ConfigError: it is neither.
    """
    if pattern is None:
        return None
    if pattern.startswith("metadata:"):
        if "." not in pattern:
            raise ConfigError(f"{pattern!r} names no metadata", where="--robot-from", expected="metadata:RECORD.KEY")
        return pattern.removeprefix("metadata:")
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ConfigError(f"{pattern!r} is no pattern ({error})", where="--robot-from") from error


def _simulation(folder: Location, name: str) -> Location:
    """The simulation of a log: of the same name in another folder; a file serves for all."""
    found = folder if folder.suffix == ".mcap" else folder / name
    if not found.is_file():
        raise ConfigError("is not there", where=found, expected="the simulation of a log under the same name")
    return found


def write_json(report: Mapping[str, Any], target: Location) -> None:
    """Writes values as JSON, in place of what is there."""
    with Target(target, overwrite=True) as out:
        out.write(json.dumps(report, indent=2, allow_nan=False, ensure_ascii=False).encode() + b"\n")


COMMANDS: dict[str, Callable[[_Job], dict[str, Any]]] = {
    "debias": _debias,
    "repair": _repair,
    "info": _info,
    "diagnose": _diagnose,
}


def called(name: str, command: str) -> str:
    """What a command calls what it makes of a log: a log keeps its name, and so does a bag, which is repaired as a bag."""
    return name if command in {"debias", "repair"} else f"{name.removesuffix('.mcap')}.json"
