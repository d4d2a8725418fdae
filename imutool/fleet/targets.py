"""Targets of a fleet: names below OUT, partial files, and whether a result is current."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote

from imutool.errors import ConfigError, ImutoolError
from imutool.file_location import WEB, Location, identity, io_errors, is_file, reason
from imutool.fleet.task import Result
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough import source_digest
from imutool.mcap_io.storage.source import sha256

LONGEST = 200  # bytes of one part of a name: room for what is written next to it under another, within the usual 255
PARTIAL = re.compile(r"\.(?P<name>.+)\.\d+\.[0-9a-f]{8,24}\.partial", re.DOTALL)
LARGEST_HASHED = 4 << 20  # bytes of a log: SHA-256 takes two milliseconds for so many, a digest with CRCs a tenth of one
OWN = "fleet."  # how the names of what the fleet itself writes at the top of OUT begin


def relative(file: str, root: str) -> str:
    """Name below OUT of a file below a root.

    Raises:
        ConfigError: the name leads elsewhere, or a terminal or a file system would not take it.
    """
    if not file.startswith(f"{root.rstrip('/')}/"):
        raise ConfigError("lies outside the source", expected=f"something below {root}")
    parts = file[len(root.rstrip("/")) + 1 :].split("/")
    parts = [unquote(part) for part in parts] if file.startswith(WEB) else parts
    name = "/".join(parts)
    if not name.isprintable() or shown(name) != name:
        raise ConfigError("has control characters in its name", expected="printable characters", fix="Rename the log")
    if any(part in {"", ".", ".."} or {*part} & {"/", "\\"} for part in parts):
        raise ConfigError("has a name that leads elsewhere", expected="plain folders and a plain name")
    if parts[0].startswith(OWN) or any(part.startswith(".") for part in parts):
        raise ConfigError("has a hidden name, or one that the fleet itself uses", fix="Rename the log")
    if max(len(part.encode()) for part in parts) > LONGEST:
        raise ConfigError(f"has a name of more than {LONGEST} bytes", fix="Rename the log")
    return name


def shown(name: str) -> str:
    """Printable name: bytes that are not UTF-8 become escapes."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def within(out: Location, name: str) -> Location:
    """Target of a name below OUT.

    Raises:
        ConfigError: a link in OUT leads elsewhere.
    """
    target = out / name
    if isinstance(target, Path) and isinstance(out, Path):
        real = target.parent.resolve()
        if not real.is_relative_to(out.resolve()):
            raise ConfigError(f"leads to {real}, outside OUT", where=target.parent, fix="Remove the link")
    return target


def refuse_own(out: Location, names: Iterable[str], **outputs: Location | None) -> None:
    """Refuse an output that would take the place of one of these files below OUT.

    Raises:
        ConfigError: with the parameter of the output.
    """
    folder = f"{_real(out).rstrip('/')}/"
    files = {_real(place): parameter for parameter, place in outputs.items() if place is not None}
    below = {file.removeprefix(folder): parameter for file, parameter in files.items() if file.startswith(folder)}
    own = next((name for name in names if name in below), None) if below else None
    if own is not None:
        what = f"`{below[own]}` would replace a file of the fleet's own"
        raise ConfigError(what, where=out / own, expected="another name than those of its results")


def _real(place: Location) -> str:
    return os.path.realpath(place) if isinstance(place, Path) else str(place)


def target_name(name: str, command: str) -> str:
    """Output name for a log: logs and bags keep their names, reports end in .json."""
    return name if command in {"debias", "repair"} else f"{without_suffix(name)}.json"


def page_name(log: str) -> str:
    """Name of the page about a log."""
    return f"{without_suffix(log)}.html"


def without_suffix(log: str) -> str:
    """Name of a log without `.mcap`, in small or capital letters."""
    return log[: -len(".mcap")] if log.lower().endswith(".mcap") else log


def digest(target: Location) -> dict[str, str]:
    """Name and digest of a target: SHA-256, or for a larger log `digest_with_crcs`.

    SHA-256 of all bytes would take a seventh of the time of a fleet.
    """
    if not _is_log(target) or not isinstance(target, Path) or target.stat().st_size <= LARGEST_HASHED:
        return {"target_sha256": sha256(target)}  # in a store each chunk's head would be a request
    with Log(target) as log, log.named():
        return {"target_digest": source_digest.digest_with_crcs(log.index)}


def _is_log(target: Location) -> bool:
    return target.suffix.lower() == ".mcap"


def is_current(done: Result, target: Location, *, whole: bool = False) -> bool:
    """Whether a target still has its recorded size and opens as a log.

    With `whole`, whether its digest is unchanged, and every CRC for which that stands.
    """
    if done.status == "quarantined":  # nothing was written
        return True
    try:
        if identity(target)[0] != done.target_bytes or (done.page and not is_file(target.with_name(page_name(target.name)))):
            return False
        if done.target_sha256 and (whole or not _is_log(target)):
            return sha256(target) == done.target_sha256
        with Log(target) as log, log.named():
            if whole:
                log.index.check()
                return source_digest.digest_with_crcs(log.index) == done.target_digest
            return True
    except ImutoolError:
        return False


def partial_files(out: Location, names: Iterable[str]) -> Iterator[Location]:
    """Partial files that killed runs left next to these targets: .NAME.PID.RANDOM.partial."""
    folders: dict[str, set[str]] = {}
    for name in names:
        folder, _, file = name.rpartition("/")
        folders.setdefault(folder, set()).add(file)
    for folder, ours in folders.items():
        for path in _partial(out / folder if folder else out):
            match = PARTIAL.fullmatch(path.name)
            if match is not None and match["name"] in ours:
                yield path


def remove_files(leftover: Iterable[Location]) -> None:
    """Remove files; a missing one is no error.

    Raises:
        ConfigError: the system refuses.
    """
    for path in leftover:
        try:
            path.unlink()
        except FileNotFoundError:
            continue
        except io_errors(path) as error:
            raise ConfigError(f"cannot be removed ({reason(error)})", where=path) from error


def _partial(folder: Location) -> list[Location]:
    try:
        return list(folder.glob(".*.partial"))
    except io_errors(folder) as error:
        raise ConfigError(f"cannot be listed ({reason(error)})", where=folder) from error
