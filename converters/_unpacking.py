"""Packed recordings: .zip, .tar or .tar.gz of any files; one file as .gz, .xz, .bz2, .zst.

They are unpacked as a stream into a temporary folder, which is removed at the end.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
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
from ._source import head
from ._table_packed import is_packed_alone, pieces, table_name

TAR = ".tar"  # in .xz, .bz2 or .zst; a .tar.gz is an archive itself
SHARE = 2  # at most one part in two of the free disk: the log needs its place, too
ENCRYPTED = 1  # bit of a zip member's flags


@contextmanager
def unpacked(source: Path, out: Path) -> Iterator[tuple[Path, Path | None]]:
    """Yield the content of a packed file, and the temporary folder that stands for the file.

    The content is a file or a folder; of a source that is not packed, the source and no folder. Errors name the source.

    Raises:
        DataError: damaged, encrypted, hostile, or too large for the disk or its own size.
    """
    is_archive = source.name.lower().endswith(SUFFIXES)
    if not source.is_file() or not (is_archive or is_packed_alone(head(source))):
        yield source, None
        return
    beside = out.resolve().parent
    with refusing(source):
        holder = TemporaryDirectory(prefix=".imutool-", dir=beside if beside.is_dir() else None)
    with holder as folder:
        root = Path(folder).resolve() / ((stem(source) if is_archive else table_name(source)).strip(".") or "log")
        try:
            yield (_unpack_archive if is_archive else _unpack_file)(source, root), root
        except ImutoolError as error:
            raise error.renamed({str(root): str(source)}) from error


def _unpack_archive(source: Path, root: Path) -> Path:
    """Unpack every plain file; the only one itself, or the folder of several."""
    sizes = list_members(source).sizes
    wanted = {name for name in sizes if not any(part.startswith((".", "__MACOSX")) for part in name.split("/"))}
    total, most = sum(sizes[name] for name in wanted), _room(root.parent)
    if total > most:
        raise _too_large(source, f"unpacks to {total} bytes", most)
    with refusing(source):
        root.mkdir()
        for name, file in _zip_files(source) if is_zip(source) else _tar_files(source):
            if name in wanted:
                (root / name).parent.mkdir(parents=True, exist_ok=True)
                with (root / name).open("xb") as target:
                    shutil.copyfileobj(file, target, CHUNK)
    return root / wanted.pop() if len(wanted) == 1 else root


def _zip_files(source: Path) -> Iterator[tuple[str, IO[bytes]]]:
    with zipfile.ZipFile(source) as archive:
        for info in archive.infolist():
            if info.flag_bits & ENCRYPTED:
                where = f"{source}/{plain_name(info.filename)}"
                raise DataError("is encrypted", where=where, fix="Unpack it with its password, and convert what is in it")
            if not info.is_dir():
                with archive.open(info) as file:
                    yield plain_name(info.filename), file


def _tar_files(source: Path) -> Iterator[tuple[str, IO[bytes]]]:
    with open_tar(source) as archive:
        for member in each_member(archive):
            if member.isreg() and (file := archive.extractfile(member)) is not None:
                yield plain_name(member.name), file


def _unpack_file(source: Path, root: Path) -> Path:
    """Unpack a file that is packed alone, under its name without the ending; of a tar its files."""
    natural, room = MAX_RATIO * source.stat().st_size + RATIO_FREE, _room(root.parent)
    total, target = 0, root / root.name
    with refusing(source):
        root.mkdir()
        with target.open("xb") as file:
            for piece in pieces(source):
                total += len(piece)
                if total > natural:
                    raise DataError(f"unpacks to more than {natural} bytes", where=source, expected=f"at most {MAX_RATIO} to 1")
                if total > room:
                    raise _too_large(source, f"unpacks to more than {room} bytes", room)
                file.write(piece)
    if target.suffix.lower() != TAR:
        return target
    content = _unpack_archive(target, root / stem(target))
    target.unlink()
    return content


def _room(folder: Path) -> int:
    """Bytes that may be unpacked into a folder."""
    with refusing(folder):
        return shutil.disk_usage(folder).free // SHARE


def _too_large(source: Path, what: str, most: int) -> DataError:
    expected = f"at most {most}, half of the free disk beside the target"
    return DataError(what, where=source, expected=expected, fix="Choose an `out` on a larger disk, or unpack it there yourself")
