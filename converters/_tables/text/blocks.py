"""Files of text: as a whole, and large ones in blocks of whole lines."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

from .packed import UTF16, bounded_pieces

BLOCK = 4 << 20  # bytes of text that are in memory at a time; a shorter file is read as a whole
MAX_LINE = 65_536  # characters
AROUND = "\ufeff \t"  # a header that a program has written again
FIRST_CHARACTERS = 4096  # of a text, which show how its lines begin
ARRIVAL = re.compile(r"^(\d\d:\d\d:\d\d\.\d{3}) -> ")  # of Arduino's serial monitor


def text_of(raw: bytes) -> str:
    """Text in UTF-8, UTF-16 or the code page of Western Windows; lines and minus as in ASCII."""
    return _with_arrivals(_decoded(raw).replace("\r\n", "\n").replace("\r", "\n").replace("\u2212", "-"))


def _decoded(raw: bytes) -> str:
    if raw.startswith(UTF16):
        return raw.decode("utf-16", "replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        cut = error.start >= len(raw) - 3  # inside a character
        return raw.decode("utf-8-sig", "ignore") if cut else raw.decode("cp1252", "replace")


def _with_arrivals(text: str) -> str:
    """Text in which the times before Arduino's rows are fields, `15:04:05.123 -> 0.1,0.2`; any other text as it is."""
    rows = [row for line in text[:FIRST_CHARACTERS].splitlines() if (row := ARRIVAL.sub("", line)) != line]
    if len(rows) <= text[:FIRST_CHARACTERS].count("\n") / 2:
        return text
    mark = max(";\t, ", key=lambda each: sum(each in row for row in rows))
    named = re.sub(rf"{ARRIVAL.pattern}(?=\D*$)", f"arrival{mark}", text, flags=re.MULTILINE)  # a board's own time counts first
    return re.sub(ARRIVAL.pattern, rf"\1{mark}", named, flags=re.MULTILINE)


def first_block(path: Path) -> str:
    """First lines of a file that is longer than a block; none of any other file."""
    first, second = [*islice(_blocks(path), 2), b"", b""][:2]
    return text_of(first) if second and first.endswith(b"\n") and not first.startswith(UTF16) else ""


def rows_in_blocks(path: Path, first: list[str], header: set[str]) -> Iterator[list[str]]:
    """Yield the rows of a file in blocks; `first` are those of the first one.

    Raises:
        ValueError: they are not ASCII alone, one is too long for a table, or one repeats a line of the header.
    """
    if not all(map(str.isascii, first)):
        raise ValueError("a letter that is not ASCII")
    texts = (raw.decode("ascii") for raw in islice(_blocks(path), 1, None))
    for lines in chain([first], ([line for line in text.splitlines() if line.strip()] for text in texts)):
        if max(map(len, lines), default=0) > MAX_LINE or not header.isdisjoint(line.strip(AROUND) for line in lines):
            raise ValueError("a line that is too long, or repeats the header")
        if lines:
            yield lines


def _blocks(path: Path) -> Iterator[bytes]:
    """Yield a file, unpacked, in blocks of whole lines."""
    rest = b""
    for piece in bounded_pieces(path):
        rest += piece
        if len(rest) >= BLOCK:
            end = rest.rfind(b"\n") + 1 or len(rest)
            yield rest[:end]
            rest = rest[end:]
    if rest:
        yield rest
