"""A new seed each day: no broken input breaks a promise."""

from __future__ import annotations

import datetime
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz import kinds

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
