"""What benchmarks share: recordings with the truth that they are compared with; and the benchmarks as modules for tests."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from unittest import mock

from imutool.mcap_io.read import read
from imutool.recording import Recording

FOLDER = Path(__file__).parents[1] / "bench"
RECOMPUTED = "/ground_truth_recomputed/pose"


def recordings(logs: Iterable[Path]) -> list[Recording]:
    """Logs, each with one truth: the recomputed one where there is one (V1_01), else the first."""
    return [recording.with_truth(_best(recording)) for recording in map(read, logs)]


def _best(recording: Recording) -> str:
    return RECOMPUTED if RECOMPUTED in recording.truths else next(iter(recording.truths))


@functools.cache
def benchmark(name: str) -> Any:
    """Module of tests/bench, which is no package. It finds the others next to it; `sys.path` stays as it was."""
    spec = importlib.util.spec_from_file_location(f"bench_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # dataclasses look their module up
    with mock.patch.object(sys, "path", [*sys.path, str(FOLDER)]):
        spec.loader.exec_module(module)
    return module
