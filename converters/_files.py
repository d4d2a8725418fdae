"""Files recognised by their first bytes, alone or in a folder."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from imutool.errors import DataError

from . import Sequence
from ._archive import HEAD, ROOT, stem

DEPTH = 4  # folders below the source that are searched


def find_files(source: Path, suffixes: Collection[str], is_mine: Callable[[bytes], bool]) -> list[Sequence]:
    """Find files of one kind: a file of any name, or those in a folder with one of the suffixes.

    Raises:
        DataError: the source does not exist.
    """
    if source.is_dir():
        paths = (path for path in each_path(named_folder(source)) if path.suffix.lower() in suffixes)
        return [Sequence(name(path), path) for path in paths if is_mine(head(path))]
    if not source.exists():
        raise DataError("does not exist", where=source, expected="a file or a folder")
    return [Sequence(name(source), source)] if is_mine(head(source)) else []


def find_folders(source: Path, is_mine: Callable[[Path], bool]) -> list[Sequence]:
    """Find folders of one kind: the source itself, or those in it."""
    if not source.is_dir():
        return []
    return [Sequence(path.name, path) for path in _folders(named_folder(source), DEPTH, is_mine)]


def _folders(folder: Path, depth: int, is_mine: Callable[[Path], bool]) -> Iterator[Path]:
    if is_mine(folder):
        yield folder
    elif depth > 0 and not ((folder / ROOT).is_dir() or folder.name == ROOT):
        for child in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
            yield from _folders(child, depth - 1, is_mine)


def name(path: Path) -> str:
    """Name of a recording: that of its file without the ending."""
    without = stem(path)
    return path.stem if without == path.name and path.stem else without


def head(path: Path, size: int = HEAD) -> bytes:
    """First bytes of a file; none of one that cannot be read or is no plain file."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(size)
    except OSError:
        return b""


def named_folder(source: Path) -> Path:
    """Folder with a name of its own: `.` and `..` have none."""
    return source.absolute() if ".." not in source.parts else source.resolve()


def each_path(folder: Path, depth: int = DEPTH) -> Iterator[Path]:
    """Files below a folder in order; of an ASL sequence its folder instead.

    Raises:
        DataError: a folder cannot be listed.
    """
    if (folder / ROOT).is_dir() or folder.name == ROOT:
        yield folder
        return
    try:
        children = sorted(folder.iterdir())
    except OSError as error:
        raise DataError(f"cannot be listed ({error.strerror})", where=folder) from error
    for child in children:
        if child.name.startswith((".", "__MACOSX")):
            continue
        if not child.is_dir():
            yield child
        elif depth > 0:
            yield from each_path(child, depth - 1)
