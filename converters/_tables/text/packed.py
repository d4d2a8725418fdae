"""Packed tables of text: .csv.gz, .xz, .bz2, .zst, or the only one in a .zip.

They are unpacked in memory, under a bound.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import zstandard

from imutool.errors import DataError

from ..._archive import CHUNK, HEAD, MAX_RATIO, RATIO_FREE, refusing
from ..._source import head

TABLES = ".csv", ".txt", ".tsv", ".dat"
ENDINGS = ".gz", ".xz", ".bz2", ".zst", ".zstd", ".zip"  # a ROS 2 bag that is compressed as a whole ends in .zstd
LIMIT = 4 << 30  # bytes of a table
FEW_LINES, LONG_HEAD = 4, 1 << 18  # a header of hundreds of columns and a row of them are longer than the first bytes
UTF16 = b"\xff\xfe", b"\xfe\xff"
ZSTD = b"\x28\xb5\x2f\xfd"
ZSTD_STEP = 1 << 10  # packed bytes: a block of four bytes can unpack to 128 KiB
SAMPLED, LONGEST_LINE = 1000, 1 << 16  # lines from all over a text, which show whether its time begins anew
MAX_FALLS = 0.3  # of a time, by its rises
FOREIGN = lzma.LZMAError, zstandard.ZstdError  # errors of damaged bytes that are no OSError


def _open_zip(path: Path) -> Any:
    """Only table of a zip; others are read as folders."""
    archive = zipfile.ZipFile(path)
    names = [name for name in archive.namelist() if not name.endswith("/") and "__MACOSX" not in name]
    if len(names) != 1 or not names[0].lower().endswith(TABLES):
        raise ValueError("no zip of one table")
    return archive.open(names[0])


def _open_zstd(path: Path) -> Any:
    """Text of all frames; the library passes over the end of one that is cut."""
    return zstandard.ZstdDecompressor().stream_reader(path.open("rb"), read_across_frames=True)


OPENERS: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"\xfd7zXZ\0": lzma.open,
    b"BZh": bz2.open,
    ZSTD: _open_zstd,
    b"PK\x03\x04": _open_zip,
}


def opener(start: bytes) -> Callable[[Path], Any] | None:
    """What opens a file with these first bytes; None for one that is not packed."""
    return next((open_it for magic, open_it in OPENERS.items() if start.startswith(magic)), None)


def table_name(path: Path) -> str:
    """Name of a table's file without the ending of its packing."""
    return path.stem if path.suffix.lower() in ENDINGS else path.name


def text_head(path: Path) -> bytes:
    """First bytes of a text, unpacked; of one with long lines so many that they hold several.

    None of one that cannot be unpacked.
    """
    start = _first(path, HEAD)
    is_text = start.startswith(UTF16) or b"\0" not in start
    return _first(path, LONG_HEAD) if is_text and len(start) == HEAD and start.count(b"\n") < FEW_LINES else start


def _first(path: Path, size: int) -> bytes:
    if opener(head(path)) is None:
        return head(path, size)
    try:
        with _opened(path) as file:
            return bytes(file.read(size))
    except DataError:
        return b""


def read_bytes(path: Path) -> bytes:
    """All bytes of a file, unpacked.

    Raises:
        DataError: damaged, or unpacking beyond all proportion.
    """
    return path.read_bytes() if opener(head(path)) is None else b"".join(bounded_pieces(path))


def bounded_pieces(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, unpacked, in pieces of bounded size.

    Raises:
        DataError: damaged, or unpacking beyond all proportion.
    """
    is_packed = opener(head(path)) is not None
    total, maximum = 0, min(LIMIT, MAX_RATIO * path.stat().st_size + RATIO_FREE)
    for piece in pieces(path):
        total += len(piece)
        if is_packed and total > maximum:
            raise DataError(f"unpacks to more than {maximum} bytes", where=path, expected=f"at most {MAX_RATIO} to 1")
        yield piece


def _sampled(path: Path) -> list[bytes]:
    """Lines from all over a text; of one that is packed or in UTF-16 all is read for them."""
    if opener(head(path)) is not None or head(path).startswith(UTF16):
        text = read_bytes(path)
        lines = (text.decode("utf-16", "replace").encode() if text.startswith(UTF16) else text).splitlines()
        return [line.strip() for line in lines[:: max(len(lines) // SAMPLED, 1)]]
    lines = []
    with refusing(path), path.open("rb") as file:
        size = path.stat().st_size
        for start in range(0, size, max(size // SAMPLED, 1)):
            file.seek(start)
            file.readline(LONGEST_LINE)  # the rest of a line
            lines.append(file.readline(LONGEST_LINE).strip())
    return lines


def goes_back(path: Path) -> bool:
    """Whether lines from all over a text hold a column that rises, and falls a few times.

    Raises:
        DataError: it cannot be unpacked.
    """
    lines = _sampled(path)
    rows = [re.split(rb"[;,\t ]+", line) for line in lines if line]
    width = max(Counter(map(len, rows)).items(), key=lambda each: each[1], default=(0, 0))[0]
    for column in zip(*(row for row in rows if len(row) == width), strict=True):
        numbers = [number for field in column if (number := _number(field)) is not None]
        steps = [later - number for number, later in pairwise(numbers)]
        if len(numbers) < len(column) / 2:  # dates, which rise as texts do
            steps = [(later > text) - (later < text) for text, later in pairwise(column)]
        if 0 < sum(step < 0 for step in steps) <= MAX_FALLS * sum(step > 0 for step in steps):
            return True
    return False


def _number(field: bytes) -> float | None:
    try:
        return float(field)
    except ValueError:
        return None


def is_packed_alone(start: bytes) -> bool:
    """Whether a file with these first bytes is one packed file, not an archive."""
    return opener(start) not in (None, _open_zip)


def pieces(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, unpacked, in pieces of bounded size.

    Raises:
        DataError: it is damaged or cut off.
    """
    with _opened(path) as file:
        if head(path).startswith(ZSTD):
            yield from _zstd_pieces(path)
        else:
            while piece := file.read(CHUNK):
                yield bytes(piece)


def _zstd_pieces(path: Path) -> Iterator[bytes]:
    """Pieces of all frames; the library's own reader passes over the end of one that is cut."""
    frame = zstandard.ZstdDecompressor().decompressobj()
    with path.open("rb") as file:
        while packed := file.read(ZSTD_STEP):
            while packed:
                if frame.eof:
                    frame = zstandard.ZstdDecompressor().decompressobj()
                yield frame.decompress(packed)
                packed = frame.unused_data
    if not frame.eof:
        raise DataError(
            "cannot be unpacked (it is cut off)", where=path, fix="Unpack what is there with zstd -d, and convert that"
        )


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    open_it = opener(head(path)) or partial(Path.open, mode="rb")
    try:
        with refusing(path), open_it(path) as file:
            yield file
    except FOREIGN as error:
        raise DataError(f"cannot be unpacked ({error})", where=path) from error
