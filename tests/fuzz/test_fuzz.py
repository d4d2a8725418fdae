"""A new seed each day: no broken input breaks a promise."""

from __future__ import annotations

import datetime
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz import kinds, run_case

TOTAL_S = float(os.environ.get("IMUTOOL_FUZZ_SECONDS", "60" if os.environ.get("CI") else "15"))  # over all kinds
SEED = os.environ.get("IMUTOOL_FUZZ_SEED", datetime.datetime.now(datetime.UTC).date().isoformat())
BENCH = Path(__file__).parents[1] / "bench" / "fuzz.py"


@pytest.mark.parametrize("kind", kinds())
def test_no_input_breaks_a_promise(kind: str) -> None:
    seconds = TOTAL_S / len(kinds())
    # a process of its own: annotations that are checked at every call would make it ten times slower
    line = [sys.executable, BENCH, kind, "--seed", SEED, "--seconds", str(seconds)]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300 + seconds, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# inputs that broke a promise once: what they are, with the draw that makes them
FOUND = {
    "a chunk of another log before all definitions": ("logs", "2026-11-21", 522),
    "a definition of a damaged chunk whose topic got another name": ("logs", "2026-11-24", 217),
    "a channel and its schema of two logs": ("logs", "2026-11-24", 76),
    "the same summary twice, the first one cut off": ("logs", "2026-11-24", 230),
    "another log behind a gap, whose first channel the log does not have": ("logs", "2026-11-25", 65),
    "a schema that was cut off by a chunk": ("logs", "2026-11-25", 412),
    "another log behind a gap, of which a channel is not defined": ("logs", "2026-11-26", 99),
    "bytes of a damaged chunk that look like a schema": ("logs", "harm-29", 20),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_stays_mended(name: str) -> None:
    assert run_case(*FOUND[name]) == []
