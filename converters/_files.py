"""Files recognised by their first bytes, alone or in a folder."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from imutool.errors import DataError

from . import Sequence
from ._archive import HEAD, ROOT
from ._source import DEPTH, stem


def find_files(source: Path, suffixes: Collection[str], is_mine: Callable[[bytes], bool]) -> list[Sequence]:
    """Find files of one kind: a file of any name, or those in a folder with one of the suffixes.

    Raises:
        DataError: the source does not exist.
    """
    if source.is_dir():
        folder = source.absolute() if ".." not in source.parts else source.resolve()
        return [Sequence(name(path), path) for path in _walk(folder, suffixes, DEPTH) if is_mine(head(path))]
    if not source.exists():
        raise DataError("does not exist", where=source, expected="a file or a folder")
    return [Sequence(name(source), source)] if is_mine(head(source)) else []


def find_folders(source: Path, is_mine: Callable[[Path], bool]) -> list[Sequence]:
    """Find folders of one kind: the source itself, or those in it."""
    if not source.is_dir():
        return []
    folder = source.absolute() if ".." not in source.parts else source.resolve()
    return [Sequence(path.name, path) for path in _folders(folder, DEPTH, is_mine)]


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


def _walk(folder: Path, suffixes: Collection[str], depth: int) -> Iterator[Path]:
    if (folder / ROOT).is_dir() or folder.name == ROOT:
        return
    try:
        children = sorted(folder.iterdir())
    except OSError as error:
        raise DataError(f"cannot be listed ({error.strerror})", where=folder) from error
    for child in children:
        if child.name.startswith((".", "__MACOSX")):
            continue
        if child.is_dir():
            if depth > 0:
                yield from _walk(child, suffixes, depth - 1)
        elif child.suffix.lower() in suffixes:
            yield child
