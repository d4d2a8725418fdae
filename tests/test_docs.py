"""The documentation site builds strictly, needs no network, and says what the commands and the package say."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import imutool
from imutool.cli import MODULES, load

ROOT = Path(__file__).parents[1]
LOADED = re.compile(r"""<(?:script|link|img)\b[^>]*(?:src|href)=["']?(?:https?:)?//""")
PATH_IN_TEXT = re.compile(r"`((?:imutool|converters|tests|docs|models|examples)/[\w./]*)`")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it; with `--quiet` MkDocs would count no warnings, and `--strict` never fail."""
    out = tmp_path_factory.mktemp("site")
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(line, cwd=ROOT, env=env, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    return out


def text_of(page: Path) -> str:
    """A page's words."""
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def test_no_page_asks_another_machine(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 15
    asking = {page.name: found for page in pages if (found := LOADED.findall(page.read_text(encoding="utf-8")))}
    canonical = {name: links for name, links in asking.items() if any('rel="canonical"' not in link for link in links)}
    assert canonical == {}
    assert not list(site.rglob("*.py"))


def test_every_command_and_option_stands_in_the_reference(site: Path) -> None:
    import typer

    text = text_of(site / "reference" / "commands.html")
    root = typer.main.get_command(load())
    assert len(root.commands) >= len(MODULES)
    for name, command in root.commands.items():
        assert f"imutool {name}" in text
        for option in (word for parameter in command.params for word in parameter.opts if word.startswith("--")):
            assert option in text, f"imutool {name} {option}"


def test_every_setting_stands_in_the_reference_with_its_meaning(site: Path) -> None:
    page = (site / "reference" / "settings.html").read_text(encoding="utf-8")
    rows = re.findall(r"<tr>\s*<td><code>(.*?)</code></td>\s*<td>.*?</td>\s*<td>(.*?)</td>\s*</tr>", page, re.DOTALL)
    assert {"steps", "paper.gyro_steps", "ode.drift_step_s", "search.max_effects", "smoother.lag_s"} <= dict(rows).keys()
    assert [key for key, meaning in rows if not meaning] == []


def test_every_public_name_stands_in_the_reference(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    missing = [
        name for name in imutool.__all__ if name != "__version__" and not re.search(rf'id="imutool\.[\w.]*{name}"', page)
    ]
    assert missing == []


def test_the_architecture_names_files_that_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = PATH_IN_TEXT.findall(text)
    assert len(named) > 40
    missing = [path for path in named if "NAME" not in path and not (ROOT / path).exists()]
    assert missing == []


def test_the_architecture_names_every_room() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = {path.parent.name for path in (ROOT / "imutool").glob("*/__init__.py")} | {"converters"}
    assert [room for room in sorted(rooms) if f"{room}/" not in text] == []


def test_every_promise_names_a_test_that_exists() -> None:
    text = (ROOT / "docs" / "promises.md").read_text(encoding="utf-8")
    promises = re.findall(r"^\d+\. .*?(?=^\d+\. |^#|\Z)", text, re.MULTILINE | re.DOTALL)
    assert len(promises) == 10
    for promise in promises:
        ((path, name),) = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", promise)
        assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8"), promise
