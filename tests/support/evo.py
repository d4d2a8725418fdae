"""evo's own figures, by its own command line: many runs in one process, which takes a second to start."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

RUNS = """
import json, sys
from evo.cli import entry_points
for command, *words in json.loads(sys.argv[1]):
    sys.argv = [f"evo_{command}", *words]
    getattr(entry_points, command)()
"""


def statistics(folder: Path, lines: Sequence[Sequence[str]]) -> list[dict[str, float]]:
    """Statistics of each run: `ape` or `rpe`, true file, estimated file, further words. evo's settings go to the folder."""
    if importlib.util.find_spec("evo") is None:
        pytest.skip(f"evo is not installed for {sys.executable}")
    results = [folder / f"{number}.zip" for number in range(len(lines))]
    runs = [
        [command, "tum", *words, "--save_results", str(result), "--no_warnings"]
        for (command, *words), result in zip(lines, results, strict=True)
    ]
    env = {**os.environ, "HOME": str(folder), "MPLBACKEND": "agg"}
    line = [sys.executable, "-c", RUNS, json.dumps(runs)]
    subprocess.run(line, cwd=folder, env=env, check=True, capture_output=True, timeout=240)
    return [json.loads(zipfile.ZipFile(result).read("stats.json")) for result in results]
