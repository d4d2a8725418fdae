"""The template of a converter works as it is written: its test passes, and the command line finds it."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys

from imutool.conversion.converter_template import write_template
from imutool.mcap_io.read import read


def test_the_template_passes_its_own_test(imutool, tmp_path):
    assert imutool("new-converter", "my_logger", cwd=tmp_path).returncode == 0
    folder = tmp_path / "imutool-my_logger"
    line = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(folder), str(folder)]
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)
    assert "3 passed" in done.stdout, done.stdout + done.stderr


def test_an_installed_template_is_known_to_convert(imutool, tmp_path, monkeypatch):
    write_template("my_logger", tmp_path / "package")
    monkeypatch.syspath_prepend(tmp_path / "package")
    point = importlib.metadata.EntryPoint("my_logger", "imutool_my_logger", "imutool.converters")
    real = importlib.metadata.entry_points
    monkeypatch.setattr(
        "imutool.registry.entry_points", lambda **group: [*real(**group), *([point] if group == {"group": point.group} else [])]
    )
    rows = [f"{10 + 0.005 * n} 90 0 0 0 0 1" for n in range(50)]
    (tmp_path / "run1").write_text("\n".join(["# my_logger", *rows]))
    done = imutool("convert", "run1", "out.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(read(tmp_path / "out.mcap").imu) == 50


def test_names_that_are_taken_or_no_names_are_refused(imutool, tmp_path):
    for name in ("euroc", "auto", "My-Logger"):
        assert imutool("new-converter", name, cwd=tmp_path).returncode == 3
    (tmp_path / "imutool-a").mkdir()
    assert imutool("new-converter", "a", cwd=tmp_path).returncode == 3
