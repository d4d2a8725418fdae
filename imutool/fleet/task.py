"""What crosses the border between the one who plans and those who work: a task there, a result back, both plain data."""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec

from imutool import __version__

Command = Literal["debias", "repair", "info", "diagnose"]
Status = Literal["ok", "lost", "failed", "quarantined", "skipped"]

FINAL = frozenset({"ok", "lost", "quarantined"})  # a failed log is tried again by --resume, these are done


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """What is done to every log. Paths and URLs are absolute; `model_sha256` is of the model file, or of all that ship."""

    command: Command
    model: str | None = None
    model_sha256: str = ""
    init: str = "auto"
    smooth: bool = False
    clean: bool = True
    pages: bool = False  # debias: a page about each log beside it
    check: str = "imu"  # what of a new log is read back: all, imu or none
    damaged: str = "drop"
    sim: str | None = None
    imu: str | None = None
    truth: str | None = None
    robot_from: str | None = None  # a regular expression on the log's name, or metadata:RECORD.KEY; else its folder
    quick: bool = False  # diagnose: the effects that robots are compared by, and no search for others

    @property
    def digest(self) -> str:
        """One hash over all that decides what comes out, the version of the tool included."""
        return _sha256(__version__, msgspec.json.encode(self).decode())


class Source(msgspec.Struct, frozen=True):
    """A log: where it is, what it is called below OUT, and what tells it from another one of that name.

    `stamp` is the store's etag, or the time of the last change in nanoseconds.
    """

    place: str
    name: str
    size: int
    stamp: str

    def key(self, settings: Settings) -> str:
        """What its result is filed under: another content or other settings make another key."""
        return _sha256(self.place, str(self.size), self.stamp, settings.digest)


class Imu(msgspec.Struct, frozen=True):
    """What was taken off an IMU at the start: model, how the start was found, gyro (rad/s) and accel (m/s²) bias."""

    topic: str
    model: str
    init_how: str
    gyro_bias: tuple[float, ...]
    accel_bias: tuple[float, ...]


class Parameter(msgspec.Struct, frozen=True):
    """A number of an effect as one log shows it, with its standard deviation."""

    effect: str
    name: str
    value: float
    std: float
    unit: str


class Result(msgspec.Struct, frozen=True, kw_only=True, tag_field="line", tag="done"):
    """What became of one log. `target` is relative to OUT; `exit_code` is what the command alone would have ended with.

    `earlier`, of a log that was skipped, is the status it got when it was done.
    """

    key: str
    source: str
    target: str
    status: Status
    earlier: Status | None = None
    source_bytes: int = 0
    target_bytes: int = 0
    target_sha256: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    messages: int = 0
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


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """One log to be worked on. `done` is what an earlier run says of it, to be checked before it is believed.

    An existing target is replaced: who makes a task has seen that it is the fleet's own, or may be replaced.
    """

    key: str
    source: Source
    out: str
    target: str
    settings: Settings
    done: Result | None = None
    recheck: bool = False  # by reading it whole


def _sha256(*parts: str) -> str:
    whole = hashlib.sha256()
    for part in parts:
        raw = part.encode("utf-8", "surrogateescape")
        whole.update(len(raw).to_bytes(8, "little") + raw)
    return whole.hexdigest()
