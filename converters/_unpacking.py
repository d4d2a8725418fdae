"""Packed recordings: .zip, .tar or .tar.gz of any files; one file as .gz, .xz, .bz2, .zst.

They may lie in a folder, or in each other. They are unpacked as a stream into a temporary folder, which is removed at the end.
"""

from __future__ import annotations

import logging
import shutil
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

from imutool.errors import DataError, ImutoolError

from ._archive import (
    CHUNK,
    MAX_RATIO,
    RATIO_FREE,
    SUFFIXES,
    each_member,
    is_zip,
    list_members,
    open_tar,
    plain_name,
    refusing,
    stem,
)
from ._source import each_path, head, named_folder
from ._tables.files.formats import kind_of
from ._tables.recordings.folder import ENDINGS as TABLES
from ._tables.recordings.folder import logger
from ._tables.text.packed import is_packed_alone, pieces, table_name

TAR = ".tar"  # in .xz, .bz2 or .zst; a .tar.gz is an archive itself
MAX_NESTED = 3  # archives in archives
SHARE = 2  # at most one part in two of the free disk: the log needs its place, too
ENCRYPTED = 1  # bit of a zip member's flags


@dataclass
class Unpacked:
    """What packed files hold."""

    content: Path  # a file, or a folder
    root: Path | None = None  # folder that stands for the source; None where nothing is packed
    places: dict[str, Path] = field(default_factory=dict)  # of each packed file of a folder, by its name from the folder
    errors: list[tuple[str, ImutoolError]] = field(default_factory=list)  # of packed files in a folder or in each other

    def enter(self, path: Path, name: str, place: Path) -> None:
        """Unpack a file to its place, or enter its error."""
        try:
            self.places[name] = _unpack(path, place)
        except ImutoolError as error:
            self.errors.append((name, error))


@contextmanager
def unpacked(source: Path, out: Path, known: Collection[str] = ()) -> Iterator[Unpacked]:
    """Yield the content of a packed file, or of the packed files of a folder.

    It is in a temporary folder next to `out`. Packed files in packed files are unpacked, too. Of a folder, those are left that
    are `known`, or in a known folder. Errors name the source.

    Raises:
        DataError: the file is damaged, encrypted, hostile, or too large for the disk or its own size.
    """
    top = named_folder(source) if source.is_dir() else source
    packed = _packed_below(top, known) if source.is_dir() else [*filter(_is_packed, [source])]
    if not packed:
        yield Unpacked(source)
        return
    beside = out.resolve().parent
    with refusing(source):
        holder = TemporaryDirectory(prefix=".imutool-", dir=beside if beside.is_dir() else None)
    with holder as folder:
        root = Path(folder).resolve() / (top.name if source.is_dir() else _place(source))
        found = Unpacked(root, root)

        def rename(record: logging.LogRecord) -> bool:
            record.args = tuple(str(part).replace(str(root), str(source)) for part in record.args or ())
            return True

        logger.addFilter(rename)
        try:
            if source.is_dir():
                for path in packed:
                    found.enter(path, str(path.relative_to(top)), root / path.relative_to(top).with_name(_place(path)))
            else:
                _unpack(source, root if _is_archive(source) else root / root.name)
            _unpack_nested(found)
            files = [path for path in root.rglob("*") if path.is_file()]
            found.content = files[0] if len(files) == 1 and not source.is_dir() else root
            found.errors = [(name, error.renamed({str(root): str(source)})) for name, error in found.errors]
            yield found
        except ImutoolError as error:
            raise error.renamed({str(root): str(source)}) from error
        finally:
            logger.removeFilter(rename)


def _packed_below(folder: Path, known: Collection[str] = ()) -> list[Path]:
    """Packed files in a folder that are no table, none that is known, or part of what is known."""
    return [
        path
        for path in each_path(folder)
        if _is_packed(path)
        and not (Path(table_name(path)).suffix.lower() in TABLES and kind_of(head(path), path))  # read as it is
        and not any(f"{place}/".startswith(f"{path}/") or str(path).startswith(f"{place}/") for place in known)
    ]


def _is_packed(path: Path) -> bool:
    return path.is_file() and (_is_archive(path) or is_packed_alone(head(path)))


def _is_archive(path: Path) -> bool:
    return path.name.lower().endswith(SUFFIXES)


def _place(path: Path) -> str:
    """Name of the folder or file that a packed file becomes."""
    return (stem(path) if _is_archive(path) else table_name(path)).strip(".") or "log"


def _unpack_nested(found: Unpacked) -> None:
    """Unpack what is packed in packed files, each in its place."""
    for _ in range(MAX_NESTED):
        for path in _packed_below(found.content):
            place = path.with_name(_place(path) + "_" * (_place(path) == path.name))
            found.enter(path, str(path.relative_to(found.content)), place)
            path.unlink()


def _unpack(source: Path, place: Path) -> Path:
    """Unpack an archive into a folder, or one file; of a tar that is packed alone its files. What was made."""
    if _is_archive(source):
        return _unpack_archive(source, place)
    target = _unpack_file(source, place)
    if target.suffix.lower() != TAR:
        return target
    content = _unpack_archive(target, target.with_suffix(""))
    target.unlink()
    return content


def _unpack_archive(source: Path, folder: Path) -> Path:
    """Unpack every plain file into a folder."""
    sizes = list_members(source).sizes
    wanted = {name for name in sizes if not any(part.startswith((".", "__MACOSX")) for part in name.split("/"))}
    with refusing(source):
        folder.mkdir(parents=True)
        total, maximum = sum(sizes[name] for name in wanted), _room(folder)
        if total > maximum:
            raise _too_large(source, f"unpacks to {total} bytes", maximum)
        for name, file in _zip_files(source) if is_zip(source) else _tar_files(source):
            if name in wanted:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                with (folder / name).open("xb") as target:
                    shutil.copyfileobj(file, target, CHUNK)
    return folder


def _zip_files(source: Path) -> Iterator[tuple[str, IO[bytes]]]:
    with zipfile.ZipFile(source) as archive:
        for info in archive.infolist():
            if info.flag_bits & ENCRYPTED:
                where = f"{source}/{plain_name(info.filename)}"
                raise DataError("is encrypted", where=where, fix="Unpack it with its password, and convert what is in it")
            if info.filename and not info.is_dir():
                with archive.open(info) as file:
                    yield plain_name(info.filename), file


def _tar_files(source: Path) -> Iterator[tuple[str, IO[bytes]]]:
    with open_tar(source) as archive:
        for member in each_member(archive):
            if member.isreg() and (file := archive.extractfile(member)) is not None:
                yield plain_name(member.name), file


def _unpack_file(source: Path, target: Path) -> Path:
    """Unpack a file that is packed alone."""
    natural, total = MAX_RATIO * source.stat().st_size + RATIO_FREE, 0
    with refusing(source):
        target.parent.mkdir(parents=True, exist_ok=True)
        room = _room(target.parent)
        with target.open("xb") as file:
            for piece in pieces(source):
                total += len(piece)
                if total > natural:
                    raise DataError(f"unpacks to more than {natural} bytes", where=source, expected=f"at most {MAX_RATIO} to 1")
                if total > room:
                    raise _too_large(source, f"unpacks to more than {room} bytes", room)
                file.write(piece)
    return target


def _room(folder: Path) -> int:
    """Bytes that may be unpacked into a folder."""
    with refusing(folder):
        return shutil.disk_usage(folder).free // SHARE


def _too_large(source: Path, what: str, maximum: int) -> DataError:
    expected = f"at most {maximum}, half of the free disk of the target"
    return DataError(what, where=source, expected=expected, fix="Choose an `out` on a larger disk, or unpack it there yourself")
