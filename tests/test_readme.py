"""What README and the pages show runs: every `$ ` line of a console block marked `<!-- test -->`, and every Python block."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from support.made_once import made_once

from imutool.cli.demo import write_asl
from imutool.debiasing import debias
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Recording

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUN_ALREADY = ["imutool", "demo", "-o", "demo-out"]  # by the fixture whose folder the others run in: it trains
SHORT_S = 27.0  # of each flight of the demo, which last a minute: the commands are the same
MARKED = re.compile(r"^<!-- test -->\s*\n```console\n(.*?)^```", re.MULTILINE | re.DOTALL)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def commands(text: str) -> list[str]:
    """The command lines of marked blocks, in order, with lines that end in a backslash joined."""
    blocks = [block.replace("\\\n", " ") for block in MARKED.findall(text)]
    return [line.removeprefix("$ ") for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def with_blocks(pattern: re.Pattern[str]) -> list[Path]:
    """Pages that have such a block."""
    return [page for page in PAGES if pattern.search(page.read_text(encoding="utf-8"))]


def test_marked_blocks_alone_are_taken() -> None:
    text = (
        "```console\n$ imutool a\n```\n\n<!-- test -->\n```console\n$ imutool b \\\n    -c\nwhat it prints\n$ imutool d\n```\n"
    )
    assert [shlex.split(line) for line in commands(text)] == [["imutool", "b", "-c"], ["imutool", "d"]]


def test_the_readme_and_every_tutorial_show_commands_to_run() -> None:
    wanted = {ROOT / "README.md", ROOT / "docs" / "quick-start.md", *(ROOT / "docs" / "tutorials").glob("*.md")}
    assert wanted <= set(with_blocks(MARKED))


@pytest.fixture(scope="session")
def short(tmp_path_factory: pytest.TempPathFactory, demonstration: Path) -> Path:
    """What `imutool demo` left, with the beginning of each flight in place of the whole."""

    def begun(recording: Recording) -> Recording:
        start_ns = int(recording.imu.t_ns[0])
        return recording.between(start_ns, start_ns + int(SHORT_S * 1e9))

    def make(folder: Path) -> None:
        for source in (demonstration / "demo-out" / "logs").glob("*.mcap"):
            flight = begun(read(source))
            (folder / "logs").mkdir(exist_ok=True)
            write(flight, folder / "logs" / source.name)
            write_asl(flight, folder / "raw" / source.stem)
        model = shutil.copy(demonstration / "demo-out" / "model.safetensors", folder)
        debias(folder / "logs" / "flight_5.mcap", folder / "debiased.mcap", model=model)

    return made_once(tmp_path_factory, "short", make)


@pytest.mark.parametrize("page", with_blocks(MARKED), ids=lambda page: page.stem)
def test_every_marked_command_runs(
    page: Path, short: Path, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    (tmp_path / "demo-out").symlink_to(short)
    for line in commands(page.read_text(encoding="utf-8")):
        words = shlex.split(line, comments=True)
        assert words[0] == "imutool", f"{line!r}: only imutool's own commands are run here"
        assert not set(line.partition("#")[0]) & set("|<>&;$*?{"), f"{line!r}: no shell is needed to run it"
        if words == RUN_ALREADY:
            continue
        done = imutool(*words[1:], cwd=tmp_path, env={"DISPLAY": "", "WAYLAND_DISPLAY": ""})  # no window opens here
        assert done.returncode == 0, f"$ {line}\n{done.stderr}"


@pytest.mark.parametrize("page", with_blocks(PYTHON), ids=lambda page: page.stem)
def test_every_python_block_runs(page: Path, short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "demo-out").symlink_to(short)
    blocks = PYTHON.findall(page.read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    exec(compile("\n".join(blocks), str(page), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "models/README.md", "docs/architecture.md"])
def test_relative_links_lead_somewhere(name: str) -> None:
    page = ROOT / name
    targets = [link.partition("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in link]
    assert [target for target in targets if target and not (page.parent / target).exists()] == []
