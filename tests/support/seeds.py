"""Seeds of tests that measure a rate: few in the suite, many times as many in a benchmark."""

from __future__ import annotations

import os


def seeds(count: int) -> range:
    """`count` seeds, or as many times that as the variable SEEDS says: tests/bench/seeds.py."""
    return range(count * int(os.environ.get("SEEDS", "1")))
