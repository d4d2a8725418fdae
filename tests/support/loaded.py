"""Modules that code or a command loads, seen from a Python of its own."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path


def loaded(code: str, among: Iterable[str], cwd: Path | None = None) -> list[str]:
    """Those of some modules that are loaded after the code."""
    program = f"import sys\n{code}\nprint(sorted({set(among)} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], cwd=cwd, check=True, capture_output=True, text=True)
    found: list[str] = ast.literal_eval(done.stdout.splitlines()[-1])
    return found


def loaded_by_command(words: Iterable[str | Path], among: Iterable[str], cwd: Path | None = None) -> list[str]:
    """Those of some modules that are loaded after a command has ended."""
    line = ["imutool", *map(str, words)]
    code = f"sys.argv = {line}\nfrom imutool.cli import main\ntry: main()\nexcept SystemExit: pass"
    return loaded(code, among, cwd)
