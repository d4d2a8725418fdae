"""A new seed each day: no broken input breaks a promise."""

from __future__ import annotations

import datetime
import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.made_once import made_once

from fuzz import kinds
from fuzz.logs import (
    Damage,
    Original,
    exchange,
    flip,
    join,
    judged,
    length,
    overlap,
    overwrite,
    pair,
    record,
    remove,
    wrong_index,
)

# of each kind, what 60 s reached on a quiet machine, to be shared; a search by the clock would find less next to other runs
CASES = {
    "archives": 75,
    "bags": 1200,
    "flights": 200,
    "logs": 530,
    "models": 360,
    "numbers": 28,
    "settings": 330,
    "tables": 550,
}
SHARE = 4
SEED = os.environ.get("IMUTOOL_FUZZ_SEED", datetime.datetime.now(datetime.UTC).date().isoformat())
BENCH = Path(__file__).parents[1] / "bench" / "fuzz.py"


@pytest.fixture(scope="module")
def said(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What the search for problems says of all kinds."""

    def search(folder: Path) -> None:
        # a process of its own: annotations that are checked at every call would make it ten times slower
        line = [sys.executable, BENCH, *(f"{kind}:{CASES[kind] // SHARE}" for kind in kinds()), "--seed", SEED]
        done = subprocess.run(line, capture_output=True, text=True, timeout=600, check=False)
        (folder / "said.txt").write_text(done.stdout + done.stderr, encoding="utf-8")

    return (made_once(tmp_path_factory, "fuzz", search) / "said.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", kinds())
def test_no_input_breaks_a_promise(said: str, kind: str) -> None:
    assert f"{kind}: seed {SEED}, {CASES[kind] // SHARE} cases, 0 problems\n" in said, said


# ── inputs that broke a promise once: of two whole logs `a` and `b`, as bytes ──

Craft = Callable[[Original, Original], bytes]


def over(raw: bytes, at: int, new: bytes) -> bytes:
    """The bytes with a stretch overwritten."""
    return raw[:at] + new + raw[at + len(new) :]


def exchanged(raw: bytes, first: tuple[int, int], second: tuple[int, int]) -> bytes:
    """The bytes with two stretches in each other's place."""
    (a, b), (c, d) = first, second
    return raw[:a] + raw[c:d] + raw[b:c] + raw[a:b] + raw[d:]


def flipped(raw: bytes, bits: dict[int, int]) -> bytes:
    """The bytes with some bits flipped, by place."""
    return bytes(byte ^ bits.get(at, 0) for at, byte in enumerate(raw))


def with_summary(raw: bytes, a: Original, b: Original) -> bytes:
    """The bytes with the summary of `b` where that of `a` was."""
    return raw[: len(raw) - len(a.summary)] + b.summary


FOUND: dict[str, tuple[int, tuple[Damage, ...], Craft]] = {
    "a chunk of another log before all definitions": (
        19,
        (record,),
        lambda a, b: a.raw[:46] + b.raw[1818:2326] + a.raw[46:],
    ),
    "a definition of a damaged chunk whose topic got another name": (
        19,
        (join,),
        lambda a, b: over(flipped(a.raw, {820: 2, 2311: 4}), 5369, bytes(60)) + b.raw,
    ),
    "a channel and its schema of two logs": (
        6,
        (overlap,),
        lambda a, b: over(a.raw[:1030] + b.raw[1030:], 3000, b.raw[155:3155]),
    ),
    "the same summary twice, the first one cut off": (
        7,
        (overlap,),
        lambda a, b: with_summary(over(a.raw[:5586] + b.raw[5586:], 1231, (5).to_bytes(8, "little")), a, b),
    ),
    "another log behind a gap, whose first channel the log does not have": (
        11,
        (overwrite,),
        lambda a, b: over(over(a.raw[:46] + a.raw[1112:], 5055, b.raw[:4755]), 9341, b.raw[:469]),
    ),
    "a schema that was cut off by a chunk": (
        4,
        (remove, exchange),
        lambda a, b: exchanged(a.raw[:3915] + a.raw[4275:], (46, 530), (3915, 4275)),
    ),
    "another log behind a gap, of which a channel is not defined": (
        23,
        (overwrite,),
        lambda a, b: over(a.raw, 8352, b.raw[464:3464]),
    ),
    "bytes of a damaged chunk that look like a schema": (
        14,
        (remove, exchange, length),
        lambda a, b: over(
            exchanged(a.raw[:1466] + a.raw[2571:], (46, 1262), (2793, 4134)), 4024, (2**62).to_bytes(8, "little")
        ),
    ),
    "a chunk with a damaged head of a log that nothing defines": (
        20,
        (overlap, length),
        lambda a, b: over(a.raw[:1400] + b.raw[1400:], 3623, (1).to_bytes(8, "little")),
    ),
    "two exchanged chunks, and a summary that lists every chunk one byte further on": (
        2,
        (exchange, wrong_index),
        lambda a, b: wrong_index(exchanged(a.raw, (761, 1247), (2228, 2815)), a, b, random.Random(4)),
    ),
    "a chunk without its message indexes in front of what is left of a summary": (
        3,
        (remove, exchange),
        lambda a, b: exchanged(a.raw[:3146] + a.raw[3974:], (2100, 2892), (8030, 8192)),
    ),
    "a chunk that says it is as long as those behind it together": (
        16,
        (flip,),
        lambda a, b: flipped(a.raw, {2303: 32, 4048: 4, 4860: 8}),
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_stays_mended(tmp_path: Path, name: str) -> None:
    number, damages, craft = FOUND[name]
    (tmp_path / "log.mcap").write_bytes(craft(*pair(number)))
    assert list(judged(tmp_path / "log.mcap", tmp_path / "out.mcap", pair(number), damages)) == []
