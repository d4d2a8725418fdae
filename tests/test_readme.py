"""The README's commands run as they stand: every `$ ` line of a console block marked `<!-- test -->`, in one empty folder."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
RUN_ALREADY = ["imutool", "demo", "-o", "demo-out"]  # by the fixture whose folder the others run in: it trains
MARKED = re.compile(r"^<!-- test -->\s*\n```console\n(.*?)^```", re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[str]:
    """The command lines of marked blocks, in order, with lines that end in a backslash joined."""
    blocks = [block.replace("\\\n", " ") for block in MARKED.findall(text)]
    return [line.removeprefix("$ ") for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def test_marked_blocks_alone_are_taken() -> None:
    text = (
        "```console\n$ imutool a\n```\n\n<!-- test -->\n```console\n$ imutool b \\\n    -c\nwhat it prints\n$ imutool d\n```\n"
    )
    assert [shlex.split(line) for line in commands(text)] == [["imutool", "b", "-c"], ["imutool", "d"]]


def test_the_readme_shows_commands_to_run() -> None:
    assert any(line.startswith("imutool ") for line in commands(README.read_text(encoding="utf-8")))


def test_every_marked_command_of_the_readme_runs(demonstration: Path) -> None:
    lines = commands(README.read_text(encoding="utf-8"))
    if not lines:
        pytest.fail("README.md has no console block marked <!-- test -->")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in lines:
        assert line.startswith("imutool "), f"{line!r}: only imutool's own commands are run here"
        if shlex.split(line) == RUN_ALREADY:
            continue
        done = subprocess.run(
            ["bash", "-c", line],
            cwd=demonstration,
            env={**os.environ, "PATH": path, "DISPLAY": "", "WAYLAND_DISPLAY": ""},  # no window opens here
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
        )
        assert done.returncode == 0, f"$ {line}\n{done.stderr}"
