"""Settings, tasks and results of a fleet, as plain data for planner and workers."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

import msgspec

from imutool import __version__
from imutool.errors import ConfigError, redact
from imutool.file_location import absolute, local

Command = Literal["debias", "repair", "info", "diagnose"]
Status = Literal["ok", "lost", "failed", "quarantined", "skipped"]

FINAL = frozenset({"ok", "lost", "quarantined"})  # with `resume` a failed log is tried again; these are done


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a fleet's command on every log.

    Paths are absolute; `model_sha256` is of the model file, or of all models that ship.
    """

    command: Command
    model: str | None = None
    model_sha256: str = ""
    init: str = "auto"
    smooth: bool = False
    force: bool = False  # debias: use a model although it does not fit the log
    clean: bool = True
    pages: bool = False  # debias: a page about each log next to it
    check: str = "imu"  # what of a new log is read back: all, imu or none
    damaged: str = "drop"
    sim: str | None = None
    imu: str | tuple[str, ...] | None = None  # of each log those that it has; a diagnosis takes the first of them
    truth: str | None = None
    robot_from: str | None = None  # a regular expression on the log's name, or metadata:RECORD.KEY; else its folder
    quick: bool = False  # diagnose: the effects that robots are compared by, and no search for others

    @property
    def imus(self) -> tuple[str, ...]:
        """IMUs that are named."""
        return self.imu if isinstance(self.imu, tuple) else () if self.imu is None else (self.imu,)

    @property
    def digest(self) -> str:
        """SHA-256 of everything that decides the results, with the version of the tool.

        Raises:
            ConfigError: a path holds bytes that are no UTF-8, which no journal takes.
        """
        try:
            return _sha256(__version__, msgspec.json.encode(self).decode())
        except UnicodeEncodeError as error:
            what = "a setting holds bytes that are no UTF-8"
            raise ConfigError(what, where=self.sim or self.model, fix="Rename the file or folder") from error


def with_model_hash(settings: Settings) -> Settings:
    """Settings with the model's absolute path and SHA-256, since the file may change.

    Without a model the hash is that of all that ship, since each log chooses one of them.

    Raises:
        ModelError: no such model.
    """
    from imutool.bias.model_file import digest, find_model, library

    name = settings.model
    if name is not None and Path(name).suffix.lower() in {".safetensors", ".toml"}:
        path = absolute(local(name, "model"))
        if path.suffix.lower() == ".safetensors":
            find_model(path)  # before a thousand logs say the same
        return msgspec.structs.replace(settings, model=str(path), model_sha256=digest(path))
    if name is not None and name != "static":
        return msgspec.structs.replace(settings, model_sha256=str(find_model(name).card["sha256"]))
    every = "".join(digest(path) for path in sorted(library().glob("*.safetensors")))
    return msgspec.structs.replace(settings, model_sha256=hashlib.sha256(every.encode()).hexdigest())


class Source(msgspec.Struct, frozen=True):
    """Source log: its place, its name below OUT, and its identity (size and stamp).

    `stamp` is the store's etag, or the time of the last change in nanoseconds. `simulation` is the identity of the simulation
    that it is compared with.
    """

    place: str
    name: str
    size: int
    stamp: str
    simulation: str = ""

    def key(self, settings: Settings) -> str:
        """Key of the result; it changes with the content, the simulation and the settings."""
        return _sha256(self.place, str(self.size), self.stamp, settings.digest, *filter(None, [self.simulation]))


class Imu(msgspec.Struct, frozen=True):
    """Initial bias of an IMU, gyro (rad/s) and accel (m/s²), with model and method."""

    topic: str
    model: str
    init_how: str
    gyro_bias: tuple[float, ...]
    accel_bias: tuple[float, ...]


class Parameter(msgspec.Struct, frozen=True):
    """Parameter of an effect as one log shows it, with its standard deviation."""

    effect: str
    name: str
    value: float
    std: float
    unit: str


class Result(msgspec.Struct, frozen=True, kw_only=True, tag_field="line", tag="done"):
    """Result of one log; `target` is relative to OUT.

    `exit_code` is the code of the command on this log alone.

    `earlier` is the status of a skipped log from the run that did it.
    """

    key: str
    source: str
    target: str
    status: Status
    earlier: Status | None = None
    source_bytes: int = 0
    target_bytes: int = 0
    target_sha256: str = ""
    target_digest: str = ""  # of a large log, in place of it: `source_digest.digest_with_crcs`
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    messages: int | None = None  # a diagnosis does not count them
    duration_s: float | None = None
    imus: tuple[Imu, ...] = ()
    losses: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    score: float | None = None
    robot: str = ""
    parameters: tuple[Parameter, ...] = ()
    effects: tuple[str, ...] | None = None  # that a search has found, where one was made
    page: str = ""  # about this log, relative to OUT
    page_says: str = ""  # its first sentence
    error: str = ""
    exit_code: int = 0
    peak_bytes: int = 0  # the most memory that the worker has held so far
    host: str = ""


def failed(key: str, source: Source, error: str, exit_code: int, target: str = "") -> Result:
    """Result of a log that was not worked on to the end."""
    return Result(
        key=key,
        source=source.place,
        target=target,
        status="failed",
        source_bytes=source.size,
        error=redact(error),
        exit_code=exit_code,
    )


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """Task of one log; `done` is the result of an earlier run, to be checked first.

    An existing target is replaced: the planner has checked that it is the fleet's own, or may be replaced.
    """

    key: str
    source: Source
    out: str
    target: str
    settings: Settings
    done: Result | None = None
    recheck: bool = False  # read the whole target again


def _sha256(*parts: str) -> str:
    whole = hashlib.sha256()
    for part in parts:
        raw = part.encode("utf-8", "surrogateescape")
        whole.update(len(raw).to_bytes(8, "little") + raw)
    return whole.hexdigest()
