"""Archive members with checked names and sizes: list and read a .zip or .tar safely.

An archive is refused whole when a member's name is absolute or climbs with `..`, when a link leaves the archive, or
when a member is a device. A link below `mav0` is refused too; one elsewhere that stays inside is never followed.
"""

from __future__ import annotations

import gzip
import re
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, wraps
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import TypeVar

from imutool.errors import DataError

SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")
BAG = ".bag"
ROOT = "mav0"  # the folder of an ASL sequence

MIB = 1 << 20
IMAGE_LIMIT = 64 * MIB
LIMITS = {".csv": 512 * MIB, ".yaml": MIB, ".png": IMAGE_LIMIT, ".jpg": IMAGE_LIMIT, ".jpeg": IMAGE_LIMIT}  # bytes
MAX_MEMBERS = 1_000_000  # an hour of two cameras at 20 Hz has 144 000
MAX_RATIO = 100  # unpacked over packed; tables reach 10, deflate can reach 1032
RATIO_FREE = 16 * MIB  # small members may pack as well as they like
CHUNK = MIB
MAX_HEADER = 4 * MIB  # one tar header record; tarfile reads long names whole, whatever their declared length
HEAD = 4096  # bytes of a table that tell which data set it is from
BLOCK = 512  # tar's unit


Found = TypeVar("Found")


def once_per_content(maximum: int) -> Callable[[Callable[[Path], Found]], Callable[[Path], Found]]:
    """Decorator that keeps what a function finds in up to `maximum` files, until they change."""

    def kept(find: Callable[[Path], Found]) -> Callable[[Path], Found]:
        known = lru_cache(maximum)(lambda path, _mtime_ns, _size: find(path))

        @wraps(find)
        def found(path: Path) -> Found:
            status = path.stat()
            return known(path, status.st_mtime_ns, status.st_size)

        return found

    return kept


@dataclass
class Listing:
    """Regular members of an archive with their sizes.

    For a tar also their offsets, and the first bytes of its tables.
    """

    sizes: dict[str, int] = field(default_factory=dict)
    offsets: dict[str, int] = field(default_factory=dict)
    heads: dict[str, bytes] = field(default_factory=dict)


def list_members(path: Path) -> Listing:
    """List the members of an archive; the list is cached until the file changes.

    Raises:
        DataError: empty, damaged, cut off, hostile, or a member larger than its kind may be; the member is named.
    """
    with refusing(path):
        return _listing(path)


@once_per_content(64)  # three converters ask about the same archive, and a tar.gz takes its time
def _listing(path: Path) -> Listing:
    if path.stat().st_size == 0:
        raise DataError("is empty", where=path, expected="an archive")
    return _list_zip(path) if is_zip(path) else _list_tar(path)


def _list_zip(path: Path) -> Listing:
    listing = Listing()
    with refusing(path), zipfile.ZipFile(path) as archive:
        total, maximum = 0, MAX_RATIO * path.stat().st_size + RATIO_FREE
        for number, info in enumerate(archive.infolist()):
            name = _checked_name(path, info.filename, number)
            if not info.filename or not name.isprintable():  # such as a Mac's "Icon\r": nothing that is read has such a name
                continue
            mode = info.external_attr >> 16
            if stat.S_ISLNK(mode):
                with archive.open(info) as file:
                    _check_link(path, name, file.read(HEAD).decode("utf-8", "replace"))
            elif info.is_dir():
                continue
            elif stat.S_IFMT(mode) not in (0, stat.S_IFREG):
                raise DataError("is a device, not a file", where=f"{path}/{name}")
            else:
                _add(listing, path, name, info.file_size)
                if info.file_size > RATIO_FREE and info.file_size > MAX_RATIO * max(info.compress_size, 1):
                    raise DataError(
                        f"unpacks to {info.file_size} bytes from {info.compress_size}",
                        where=f"{path}/{name}",
                        expected=f"at most {MAX_RATIO} to 1",
                    )
                total += info.file_size
                if total > maximum:  # members may share their bytes, each of them within its own bound
                    raise DataError(f"unpacks to more than {maximum} bytes", where=path, expected=f"at most {MAX_RATIO} to 1")
    return listing


def _list_tar(path: Path) -> Listing:
    listing = Listing()
    with open_tar(path) as archive:
        for number, member in enumerate(each_member(archive)):
            name = _checked_name(path, member.name, number)
            if member.isdir() or not name.isprintable():
                continue
            if member.issym() or member.islnk():
                _check_link(path, name, member.linkname, "" if member.islnk() else str(PurePosixPath(name).parent))
            elif not member.isreg() or member.issparse():
                raise DataError("is a device or a sparse file", where=f"{path}/{name}", expected="plain files")
            else:
                _add(listing, path, name, member.size)
                listing.offsets[name] = member.offset_data
                if name.endswith("imu0/data.csv"):
                    file = archive.extractfile(member)
                    assert file is not None
                    listing.heads[name] = file.read(HEAD)
        _check_end(path, archive)
    return listing


def _add(listing: Listing, path: Path, name: str, size: int) -> None:
    if name in listing.sizes:
        raise DataError("is in the archive twice", where=f"{path}/{name}")
    check_size(f"{path}/{name}", name, size)
    listing.sizes[name] = size


def plain_name(name: str) -> str:
    """Member name without a leading `./`."""
    return name.removeprefix("./").rstrip("/")


def _checked_name(path: Path, name: str, number: int) -> str:
    """Member name without a leading `./`, checked.

    Raises:
        DataError: it points outside the archive, or there are too many members.
    """
    if number >= MAX_MEMBERS:
        raise DataError(f"has more than {MAX_MEMBERS} members", where=path)
    if name.startswith("/") or "\\" in name or "\0" in name or ":" in name[:2] or ".." in name.split("/"):
        raise DataError(f"member {name!r} points outside the archive", where=path, expected="relative names without ..")
    return plain_name(name)


def _check_link(path: Path, name: str, target: str, base: str | None = None) -> None:
    parts = [*PurePosixPath(base if base is not None else str(PurePosixPath(name).parent)).parts]
    for part in target.split("/"):
        if part == "..":
            if not parts:
                break
            parts.pop()
        elif part not in ("", "."):
            parts.append(part)
    else:
        if not target.startswith("/") and "\\" not in target and not re.search(rf"(^|/){ROOT}(/|$)", name):
            return
    raise DataError(f"is a link to {target!r}", where=f"{path}/{name}", expected="plain files")


def check_size(where: str, name: str, size: int) -> None:
    """Refuse a declared size above the limit for the kind of file.

    Raises:
        DataError: with both sizes.
    """
    limit = LIMITS.get(PurePosixPath(name).suffix.lower())
    if limit is not None and size > limit:
        raise DataError(f"is {size} bytes", where=where, expected=f"at most {limit}")


def read_bounded(read: Callable[[int], bytes], where: str, name: str) -> bytes:
    """Read all bytes of a member, up to the limit for its kind, whatever size it declares."""
    limit = LIMITS.get(PurePosixPath(name).suffix.lower(), MIB)
    parts: list[bytes] = []
    total = 0
    while part := read(CHUNK):
        parts.append(part)
        total += len(part)
        if total > limit:
            raise DataError("is larger than it says", where=where, expected=f"at most {limit} bytes")
    return b"".join(parts)


def is_zip(path: Path) -> bool:
    """Whether an archive is a .zip, by its name; all others are tars."""
    return path.name.lower().endswith(".zip")


def is_packed(path: Path) -> bool:
    """Whether a tar is packed with gzip, by its first bytes."""
    with path.open("rb") as file:
        return file.read(2) == b"\x1f\x8b"


@contextmanager
def refusing(where: Path | str) -> Iterator[None]:
    """Turn errors of the archive modules on damaged input into a DataError with the place."""
    try:
        yield
    except (OSError, EOFError, zipfile.BadZipFile, tarfile.TarError, zlib.error, RuntimeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise DataError(f"cannot be read ({reason or type(error).__name__})", where=where) from error


class _Bounded:
    """Tar stream with bounds: it refuses extreme compression ratios and huge headers."""

    def __init__(self, path: Path, file: BufferedReader | gzip.GzipFile, limit: int | None) -> None:
        self._path, self._file, self._limit = path, file, limit
        self.last = b""  # the bytes read last, for `_check_end`: going back in a .gz means unpacking it again

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= MAX_HEADER:
            raise DataError(f"has a header of {size} bytes", where=self._path, expected=f"at most {MAX_HEADER}")
        self._check(self._file.tell() + size)
        self.last = self._file.read(size)
        return self.last

    def seek(self, offset: int) -> int:
        self._check(offset)
        return self._file.seek(offset)

    def tell(self) -> int:
        return self._file.tell()

    def _check(self, offset: int) -> None:
        if self._limit is not None and offset > self._limit:
            raise DataError(f"unpacks to more than {self._limit} bytes", where=self._path, expected=f"at most {MAX_RATIO} to 1")


def stem(path: Path) -> str:
    """Archive name without its endings."""
    for ending in (*SUFFIXES, BAG):
        if path.name.lower().endswith(ending):
            return path.name[: -len(ending)]
    return path.name


@contextmanager
def open_tar(path: Path) -> Iterator[tarfile.TarFile]:
    """Open a tar, compressed or not, with bounded reading.

    Raises:
        DataError: damaged, or unpacking beyond all proportion.
    """
    with refusing(path), path.open("rb") as raw:
        packed = is_packed(path)
        limit = MAX_RATIO * path.stat().st_size + RATIO_FREE if packed else None
        bounded = _Bounded(path, gzip.GzipFile(fileobj=raw, mode="rb") if packed else raw, limit)
        with tarfile.open(fileobj=bounded, mode="r:") as archive:  # type: ignore[call-overload]
            yield archive


def each_member(archive: tarfile.TarFile) -> Iterator[tarfile.TarInfo]:
    """Yield the members one by one; `tarfile` would cache each, a kilobyte a piece."""
    kept: list[tarfile.TarInfo] = vars(archive)["members"]
    while (member := archive.next()) is not None:
        yield member
        kept.clear()


def _check_end(path: Path, archive: tarfile.TarFile) -> None:
    """Check that a tar ends with a block of zeros.

    `tarfile` takes a damaged header in the middle for the end.
    """
    assert isinstance(archive.fileobj, _Bounded)
    if archive.fileobj.last != bytes(BLOCK):
        raise DataError(f"is cut off or damaged at byte {archive.offset}", where=path)
