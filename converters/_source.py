"""Sequences in folders and archives, and their files; files recognised by their first bytes.

Nothing is unpacked on disk here: members are read one by one, each under a bound, and a .tar.gz is streamed.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import IO

from imutool.errors import ConfigError, DataError

from . import Sequence
from ._archive import (
    BAG,
    HEAD,
    ROOT,
    SUFFIXES,
    check_size,
    each_member,
    is_packed,
    is_zip,
    list_members,
    open_tar,
    plain_name,
    read_bounded,
    refusing,
    stem,
)

DEPTH = 4  # folders below the source that are searched


def find(source: Path) -> list[Sequence]:
    """Find the sequences in a folder, an archive, or a folder of these.

    Unreadable archives in a folder are listed too.

    Raises:
        ConfigError: the source does not exist.
        DataError: it is itself an archive that cannot be read.
    """
    if source.is_dir():
        folder = named_folder(source)
        return [Sequence(folder.parent.name, folder.parent)] if folder.name == ROOT else list(_in_folder(folder))
    if not source.exists():
        raise ConfigError("does not exist", where=source, expected="a log, a table, an archive, or a folder of these")
    return _in_file(source)


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag by its name."""
    return path.suffix.lower() == BAG


def _in_folder(folder: Path) -> Iterator[Sequence]:
    for path in each_path(folder):
        try:
            yield from [Sequence(path.name, path)] if path.is_dir() else _in_file(path)
        except DataError:  # said again, with its reason, when the sequence is read: the others go on
            yield Sequence(stem(path), path)


def _in_file(path: Path) -> list[Sequence]:
    name = path.name.lower()
    if name.endswith(BAG):
        return [Sequence(stem(path), path)]
    if not name.endswith(SUFFIXES):
        return []
    members = list_members(path).sizes
    folders = (member.split("/")[:-1] for member in members)
    roots = {"/".join(parts[: parts.index(ROOT)]) for parts in folders if ROOT in parts and "__MACOSX" not in parts}
    return [Sequence(PurePosixPath(root).name or stem(path), path, root) for root in sorted(roots)]


class Tree:
    """Files of an ASL sequence in a folder or archive, named from its root."""

    def __init__(self, sequence: Sequence) -> None:
        self.sequence = sequence
        self.path = sequence.path
        self._prefix = f"{sequence.inside}/{ROOT}/".removeprefix("/")
        if self.path.is_dir():
            self.sizes: Mapping[str, int] = _folder_sizes(self.path / ROOT)
        else:
            self._listing = list_members(self.path)
            cut = len(self._prefix)
            self.sizes = {m[cut:]: size for m, size in self._listing.sizes.items() if m.startswith(self._prefix)}
            if not self.sizes:
                raise DataError(f"holds no {ROOT} folder", where=self.path)

    def __contains__(self, name: str) -> bool:
        return name in self.sizes

    def where(self, name: str) -> str:
        """Address of a file for messages: archive (or folder) and member."""
        return f"{self.path}/{self._prefix}{name}"

    def sensors(self) -> list[str]:
        """Sensor folders: those directly below the root that hold a table."""
        return sorted(name.split("/")[0] for name in self.sizes if re.fullmatch(r"[^/]+/data\.csv", name))

    def head(self, name: str) -> bytes:
        """First bytes of a table; empty without such a table."""
        if name not in self:
            return b""
        if self.path.is_dir():
            with refusing(self.where(name)), (self.path / ROOT / name).open("rb") as file:
                return file.read(HEAD)
        if (kept := self._listing.heads.get(self._prefix + name)) is not None:
            return kept
        with refusing(self.path), zipfile.ZipFile(self.path) as archive, archive.open(self._prefix + name) as file:
            return file.read(HEAD)

    def load(self, names: Collection[str]) -> dict[str, bytes]:
        """Load some files completely."""
        return dict(self.each(names))

    def each(self, names: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Yield names and contents of some files, in the order of the source.

        Raises:
            DataError: a file is missing, damaged, or larger than its kind may be.
        """
        for name in names:
            if name not in self:
                raise DataError("is missing", where=self.where(name))
            check_size(self.where(name), name, self.sizes[name])
        if self.path.is_dir():
            yield from self._each_opened(names, lambda name: (self.path / ROOT / name).open("rb"))
        elif is_zip(self.path):
            with refusing(self.path), zipfile.ZipFile(self.path) as archive:
                yield from self._each_opened(names, lambda name: archive.open(self._prefix + name))
        elif not is_packed(self.path):
            yield from self._each_in_plain_tar(names)
        else:
            yield from self._each_in_tar(names)

    def _each_opened(self, names: Collection[str], open_file: Callable[[str], IO[bytes]]) -> Iterator[tuple[str, bytes]]:
        for name in names:
            with refusing(self.where(name)), open_file(name) as file:
                content = read_bounded(file.read, self.where(name), name)
            yield name, content

    def _each_in_plain_tar(self, names: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Yield the files in the requested order.

        A tar's own order is often a folder's hash order; images should come in time order.
        """
        with refusing(self.path), self.path.open("rb") as file:
            for name in names:
                file.seek(self._listing.offsets[self._prefix + name])
                content = file.read(self.sizes[name])
                if len(content) < self.sizes[name]:
                    raise DataError("is cut off", where=self.where(name))
                yield name, content

    def _each_in_tar(self, names: Collection[str]) -> Iterator[tuple[str, bytes]]:
        wanted = {self._prefix + name: name for name in names}
        with open_tar(self.path) as archive:
            for member in each_member(archive):
                name = wanted.pop(plain_name(member.name), None)
                if name is None:
                    continue
                file = archive.extractfile(member)
                assert file is not None  # a regular file, or the listing would have refused it
                yield name, read_bounded(file.read, self.where(name), name)
                if not wanted:
                    return
        if wanted:
            raise DataError("changed while it was read", where=self.path)


def _folder_sizes(root: Path, prefix: str = "") -> dict[str, int]:
    """Sizes of files below a folder (four times as fast as `Path.rglob`)."""
    sizes: dict[str, int] = {}
    with refusing(root), os.scandir(root) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            if entry.is_dir():
                sizes |= _folder_sizes(root / entry.name, f"{prefix}{entry.name}/")
            elif entry.is_file():
                sizes[prefix + entry.name] = entry.stat().st_size
    return sizes


# ── files by their first bytes ──


def find_files(source: Path, suffixes: Collection[str], is_mine: Callable[[bytes], bool]) -> list[Sequence]:
    """Find files of one kind: a file of any name, or those in a folder with one of the suffixes.

    Raises:
        ConfigError: the source does not exist.
    """
    if source.is_dir():
        paths = (path for path in each_path(named_folder(source)) if path.suffix.lower() in suffixes)
        return [Sequence(name(path), path) for path in paths if is_mine(head(path))]
    if not source.exists():
        raise ConfigError("does not exist", where=source, expected="a file or a folder")
    return [Sequence(name(source), source)] if is_mine(head(source)) else []


def find_folders(
    source: Path, is_mine: Callable[[Path], bool], is_whole: Callable[[Path], bool] = lambda _: True
) -> list[Sequence]:
    """Find folders of one kind: the source and those below, none below one that is whole."""
    if not source.is_dir():
        return []
    return [Sequence(path.name, path) for path in _folders(named_folder(source), DEPTH, is_mine, is_whole)]


def _folders(folder: Path, depth: int, is_mine: Callable[[Path], bool], is_whole: Callable[[Path], bool]) -> Iterator[Path]:
    if is_found := is_mine(folder):
        yield folder
    if depth > 0 and not (is_found and is_whole(folder)) and not ((folder / ROOT).is_dir() or folder.name == ROOT):
        for child in sorted(path for path in folder.iterdir() if is_open(path) and not path.name.startswith(".")):
            yield from _folders(child, depth - 1, is_mine, is_whole)


def is_open(path: Path) -> bool:
    """Whether a path is a folder whose files may be read; `convert` names one that is not."""
    return path.is_dir() and os.access(path, os.R_OK | os.X_OK)


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


def with_suffix(folder: Path, suffix: str) -> list[Path]:
    """Files of a folder with a suffix, in small or capital letters, in order."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == suffix) if folder.is_dir() else []


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
        elif depth > 0 and is_open(child):
            yield from each_path(child, depth - 1)
