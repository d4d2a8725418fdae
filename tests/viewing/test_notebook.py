"""In a notebook the widget is given everything that a file would hold, from the package; the page is shut in its frame."""

from __future__ import annotations

import html.parser
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support import saved_rrd

from imutool.errors import ConfigError
from imutool.mcap_io.write import write
from imutool.recording import Recording
from imutool.viewing import notebook
from imutool.viewing.model.load_view import load
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import viewer

# In a process of its own: where the widget's program comes from is settled once, by an import that takes seconds.
WIDGET = """
import gzip, sys
from pathlib import Path
gzip.compress = lambda program: program[:1]  # 67 MB, which nobody runs here
from imutool.viewing import notebook
from imutool.viewing.model.load_view import load
viewer = notebook.show([load(Path(sys.argv[1]))], source=False)
assert not __import__("rerun_notebook").ASSET_IS_URL, "the program would come from the network"
parts = [buffer for event, buffers in viewer._viewer._event_queue for buffer in buffers]
for number, part in enumerate(parts):
    Path(sys.argv[2], f"{number:05}.rrd").write_bytes(part)
"""


class Frame(html.parser.HTMLParser):
    """The attributes of the only tag."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_the_widget_is_given_all_that_a_file_would_hold(recording: Recording, tmp_path: Path) -> None:
    log, parts = tmp_path / "log.mcap", tmp_path / "parts"
    write(recording, log)
    parts.mkdir()
    env = {**os.environ, "PYTHONPATH": str(Path(notebook.__file__).parents[2])}
    env.pop(notebook.ASSET, None)
    line = [sys.executable, "-c", WIDGET, str(log), str(parts)]
    done = subprocess.run(line, env=env, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    merge = [str(viewer.binary()), "rrd", "merge", *sorted(map(str, parts.iterdir())), "-o", str(tmp_path / "all.rrd")]
    subprocess.run(merge, check=True, capture_output=True)
    saved_rrd.written([load(log)], tmp_path / "file.rrd", source=False)
    given, kept = saved_rrd.read(tmp_path / "all.rrd"), saved_rrd.read(tmp_path / "file.rrd")
    assert set(given) == set(kept)
    name = "Scalars:scalars"
    np.testing.assert_array_equal(given["/imu/gyro/raw"].numbers(name), kept["/imu/gyro/raw"].numbers(name))
    assert len(RrdReader(tmp_path / "all.rrd").blueprints()) == 1


@pytest.mark.parametrize("missing", ["rerun", "rerun_notebook"])
def test_without_the_extra_the_refusal_says_what_to_install_and_what_else_there_is(
    data: RunData, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    there = notebook.find_spec
    monkeypatch.setattr(notebook, "find_spec", lambda name: None if name == missing else there(name))
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[notebook\]', or show notebook\.page"):
        notebook.show([data])


def test_a_page_is_shut_in_its_frame_whatever_a_log_is_called(data: RunData, monkeypatch: pytest.MonkeyPatch) -> None:
    content = '<h1>"flight"</h1><script>alert(1)</script></iframe><img src=x>'
    monkeypatch.setattr(notebook.report, "page", lambda logs: content)
    shown = notebook.page([data])._repr_html_()
    ((tag, attributes),) = Frame(shown).tags
    assert (tag, attributes["sandbox"], attributes["srcdoc"]) == ("iframe", "", content)
    assert "height: 720px" in str(attributes["style"])
