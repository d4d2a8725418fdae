"""Source logs of a fleet, each with its name below OUT."""

from __future__ import annotations

import contextlib
import fnmatch
import logging
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import msgspec

from imutool.errors import ConfigError, redact
from imutool.file_location import (
    WEB,
    Location,
    absolute,
    exists,
    identity,
    io_errors,
    is_file,
    is_folder,
    reason,
    size_and_etag,
    to_location,
)
from imutool.fleet.journal import NAME as JOURNAL
from imutool.fleet.targets import relative, shown
from imutool.fleet.task import Source
from imutool.mcap_io.storage.output_conflicts import folded

logger = logging.getLogger(__name__)

LOG, BAG = ".mcap", ".bag"
TABLES, ARCHIVES = (".csv", ".tsv", ".xlsx", ".parquet", ".npz", ".mat", ".h5", ".hdf5"), (".zip", ".tar", ".tgz", ".tar.gz")
RAW = (BAG, ".db3", ".ulg", *TABLES, *ARCHIVES)
CONVERT, HIDDEN = "imutool convert makes logs of other recordings", "hidden"
PATTERN = re.compile(r"[*?\[]")


class Found(NamedTuple):
    """Logs of a fleet sorted by name, and the places of refused ones with the reason."""

    logs: list[Source]
    refused: list[tuple[str, str]]


class _File(NamedTuple):
    """File of a listing, with the details that a store's listing gives; or a folder or link that cannot be read, and why."""

    where: str
    about: dict[str, Any] | None = None
    unread: str = ""


def find(text: str, out: Location, *, bags: bool = False, once: bool = False) -> Found:
    """Find the logs of a path, a glob, a folder or a URL; logs below `out` are left out.

    With `bags` ROS 1 bags are logs too. A warning counts the files that are other recordings. With `once` a link to another of
    these logs is left out.

    The name of a log is its path from the folder, or from the last part of a pattern before its first wildcard; a single log
    keeps its own name. Links are followed, also to find what lies below `out`. Hidden files are no logs, such as macOS's
    `._x.mcap` and what lies in `.Trash`. A log without a usable name below OUT is refused, as is a folder that cannot be read,
    and the others go on.

    Raises:
        ConfigError: nothing there, or no log in it.
    """
    endings = (LOG, BAG) if bags else (LOG,)
    root, files = _files(text, (*endings, *RAW))
    if shown(root) != root:
        raise ConfigError("has bytes in its path that are no UTF-8", where=shown(root), fix="Rename the folder")
    real = cache(_real)
    logs, refused, taken, passed_over, outputs = [], [], dict[str, str](), Counter[str](), 0
    for where, about, unread in files:
        linked = about is None and os.path.islink(where)  # noqa: PTH114  Path.is_symlink raises where it may not look
        file = os.path.realpath(where) if linked else where
        if real(file.rpartition("/")[0]).startswith(real(str(out))):
            outputs += _ends(where, endings)
            continue
        if "/." in where[len(root.rstrip("/")) :]:
            passed_over[HIDDEN] += 1
            continue
        if not _ends(where, endings) and (ending := next((raw for raw in RAW if _ends(where, (raw,))), "")):
            passed_over[ending] += 1
            continue
        try:
            if unread:
                raise ConfigError(f"cannot be read ({unread})", fix="See who may read it")
            name = relative(where, root)
            before = taken.setdefault(folded(name), where)
            if before != where:
                raise ConfigError(f"would be called {name} on some systems, and so would {before}", fix="Rename one of the two")
            place = to_location(where)
            if isinstance(place, Path) and exists(place) and not place.is_file():
                raise ConfigError("is a pipe, a socket or a device", expected="a file", fix="Remove it")
            logs.append(Source(where, name, *(identity(place) if about is None else size_and_etag(about))))
        except ConfigError as error:
            refused.append((shown(where), str(error)))
    if not logs and not refused:
        raise _no_log(text, out, endings, outputs, passed_over)
    if outputs and not exists(out / JOURNAL):  # they are no results of a fleet
        redacted = redact(text), outputs, redact(str(out))
        logger.warning("%s: of its logs %d are left out, for they lie below OUT (%s); choose an OUT outside of it", *redacted)
    if passed_over:
        kinds = ", ".join(f"{count} {ending}" for ending, count in passed_over.items())
        advice = f"; {CONVERT}" if {*passed_over} - {HIDDEN} else ""
        logger.warning("%s: files that are no MCAP logs are passed over (%s)%s", redact(text), kinds, advice)
    logs.sort(key=lambda source: source.name)
    return Found(_without_links(logs, text) if once else logs, sorted(refused))


def _no_log(text: str, out: Location, endings: tuple[str, ...], outputs: int, passed_over: Counter[str]) -> ConfigError:
    """Error of a source without a log: what is there instead."""
    if outputs:
        what = f"its {outputs} logs lie below OUT ({redact(str(out))}), where outputs are and no sources"
        return ConfigError(what, where=text, fix="Choose an OUT outside the folder of the logs")
    fix = CONVERT if {*passed_over} - {HIDDEN} else f"Rename its {passed_over[HIDDEN]} hidden files" if passed_over else ""
    expected = "a log, a folder with logs, or a pattern that fits some"
    return ConfigError(f"no {' or '.join(endings)} log", where=text, expected=expected, fix=fix)


def _without_links(logs: list[Source], text: str) -> list[Source]:
    """Logs without those that are another one's file, by a link; a warning counts them."""
    files = {log.place: log.place if "://" in log.place else os.path.realpath(log.place) for log in logs}
    first = dict[str, str]()
    for place in sorted(files, key=lambda place: files[place] != place):  # a file before the links to it
        first.setdefault(files[place], place)
    kept = [log for log in logs if first[files[log.place]] == log.place]
    if len(kept) < len(logs):
        logger.warning("%s: %d logs are links to others, and do not count again", redact(text), len(logs) - len(kept))
    return kept


def simulation(folder: Location, name: str) -> Location:
    """Simulation of a log: the same name in another folder, or one file for all.

    Raises:
        ConfigError: there is none.
    """
    own = quote(name) if str(folder).startswith(WEB) else name
    found = folder if _ends(folder.name, (LOG,)) else folder / own
    if not is_file(found):
        raise ConfigError("is not there", where=found, expected="the simulation of a log under the same name")
    return found


def with_simulations(found: Found, sim: str | None) -> Found:
    """Logs with the identity of their simulations.

    A log whose simulation has changed is not done.

    Raises:
        ConfigError: there are no simulations.
    """
    if sim is None:
        return found
    folder = to_location(sim)
    if not exists(folder):
        raise ConfigError("is not there", where=folder, expected="a folder with simulations, or one simulation")

    def compared(source: Source) -> Source:
        with contextlib.suppress(ConfigError):  # the task of the log says why
            size, stamp = identity(simulation(folder, source.name))
            return msgspec.structs.replace(source, simulation=f"{size} {stamp}")
        return source

    return Found([compared(source) for source in found.logs], found.refused)


def _files(text: str, endings: tuple[str, ...]) -> tuple[str, Iterator[_File]]:
    """Root folder of the names, and the files."""
    where = to_location(text)
    if text.startswith(WEB):
        return _on_web(text, endings)
    if not isinstance(where, Path):
        return _in_store(text, endings)
    if is_folder(where):
        root = absolute(where)
        return str(root), _walk(root, endings, frozenset())
    if exists(where):
        return str(absolute(where).parent), iter([_File(str(absolute(where)))])
    if not PATTERN.search(str(where)):
        raise ConfigError("is not there", where=redact(text), expected="a log, a folder with logs, or a pattern")
    root, parts = Path.cwd(), list(where.parts)
    while not PATTERN.search(parts[0]):
        root /= parts.pop(0)
    fitting = _fitting(root, parts, frozenset()) if is_folder(root) else ()
    files = {os.path.abspath(file.where): file.unread for file in fitting}  # noqa: PTH100  Path.resolve would follow links
    return str(absolute(root)), _logs(files, endings)


def _on_web(text: str, endings: tuple[str, ...]) -> tuple[str, Iterator[_File]]:
    """Root and files on a web server."""
    match = PATTERN.search(text)
    if match is None and _ends(text, endings):  # to list one file, the library would fetch it and look for links in it
        return text.rpartition("/")[0], iter([_File(text)])
    root = text.rstrip("/") if match is None else text[: match.start()].rpartition("/")[0]
    top, parts = to_location(root), text[len(root) + 1 :].split("/")
    found = _walk(top, endings, frozenset()) if match is None else _fitting(top, parts, frozenset())
    return root, _logs({file.where: file.unread for file in found}, endings)


def _logs(files: dict[str, str], endings: tuple[str, ...]) -> Iterator[_File]:
    """Logs among files, each once, and what could not be read."""
    found = (_File(where, unread=files[where]) for where in sorted(files))
    return (file for file in found if file.unread or _ends(file.where, endings))


def _fitting(folder: Location, parts: Sequence[str], above: frozenset[object]) -> Iterator[_File]:
    """Files below a folder that fit the parts of a pattern, never through a link to a parent folder."""
    part, *rest = parts
    if part == "..":
        yield from _fitting(folder / part, rest or ["*"], above)
        return
    inode, folders, files, unread = _listed(folder)
    yield from unread if part != "**" or inode not in above else ()
    folders, files = ([name for name in names if part[0] == "." or name[0] != "."] for names in (folders, files))
    if part != "**":
        for name in fnmatch.filter(folders if rest else files, part):
            yield from _fitting(folder / name, rest, above) if rest else [_File(str(folder / name))]
    elif inode not in above:
        yield from _fitting(folder, rest or ["*"], above)
        for name in folders:
            yield from _fitting(folder / name, parts, above | {inode})


def _walk(folder: Location, endings: tuple[str, ...], above: frozenset[object]) -> Iterator[_File]:
    """Logs below a folder, through links too, but never through a link to a parent folder."""
    inode, folders, files, unread = _listed(folder)
    if inode in above:
        return
    yield from unread
    for name in folders:
        yield from _walk(folder / name, endings, above | {inode}) if name[0] != "." else ()
    yield from (_File(str(folder / name)) for name in files if _ends(name, endings))


def _listed(folder: Location) -> tuple[object, list[str], list[str], list[_File]]:
    """Inode of a folder, the folders and files in it, and what of it cannot be read."""
    folders, files, unread = list[str](), list[str](), list[_File]()
    if not isinstance(folder, Path):  # the library's own walk passes over a folder where the server does not answer
        try:
            for entry in folder.fs.ls(folder.path, detail=True):
                name = entry["name"][len(folder.path.rstrip("/")) :].strip("/").removeprefix("./")
                (folders if entry["type"] == "directory" else files).append(name)
        except io_errors(folder) as error:
            unread.append(_File(str(folder), unread=reason(error)))
        return str(folder), sorted(filter(None, folders)), sorted(filter(None, files)), unread
    try:
        status = folder.stat()
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError as error:
        return None, [], [], [_File(str(folder), unread=reason(error))]
    for entry in entries:
        try:
            (folders if entry.is_dir() else files).append(entry.name)
        except OSError as error:  # a link to itself, or into a folder that cannot be read
            unread.append(_File(str(folder / entry.name), unread=reason(error)))
    return (status.st_dev, status.st_ino), folders, files, unread


def _ends(name: str, endings: tuple[str, ...]) -> bool:
    """Whether a name has one of these endings, in small or capital letters, as some recorders write them."""
    return name.lower().endswith(endings)


def _real(folder: str) -> str:
    """Folder without links, with a slash at its end."""
    return f"{(folder if '://' in folder else os.path.realpath(folder)).rstrip('/')}/"


def _in_store(text: str, endings: tuple[str, ...]) -> tuple[str, Iterator[_File]]:
    """Files in an object store, by listings: a thousand objects a request."""
    match = PATTERN.search(text)
    fixed = text.rstrip("/") if match is None else text[: match.start()].rpartition("/")[0]
    root = to_location(fixed)
    assert not isinstance(root, Path), "a URL, not a path"
    try:
        pattern = root.path.rstrip("/") + text[len(fixed) :]
        found = root.fs.find(root.path, detail=True) if match is None else root.fs.glob(pattern, detail=True)
    except io_errors(root) as error:
        raise ConfigError(f"cannot be listed ({reason(error)})", where=text) from error
    whole = fixed.rpartition("/")[0] if list(found) == [root.path] else fixed  # a log alone, by its own name
    files = [
        _File(fixed + path[len(root.path.rstrip("/")) :], about)
        for path, about in sorted(found.items())
        if about and about.get("type", "file") == "file" and _ends(path, endings)
    ]
    return whole, iter(files)
