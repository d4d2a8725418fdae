"""A viewer that is not there is said: a test that cannot look fails in CI and is skipped, loudly, elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support import viewers


@pytest.fixture(params=["browser", "driver"])
def hidden(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """What tests look with, out of their sight."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "no_driver.json"))
    monkeypatch.delenv("VK_DRIVER_FILES", raising=False)
    return str(request.param)


def look(what: str) -> None:
    with {"browser": viewers.chromium, "driver": viewers.native}[what]():
        raise AssertionError("there is nothing to look with")


def test_in_ci_a_missing_viewer_fails_the_test_and_names_the_package(hidden: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match=rf"no {hidden} .*apt-get install .*{viewers.PACKAGES[hidden][0]}"):
        look(hidden)


def test_elsewhere_a_missing_viewer_skips_the_test_and_names_the_package(hidden: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match=rf"NOT LOOKED AT: .*apt-get install .*{viewers.PACKAGES[hidden][0]}"):
        look(hidden)


def test_a_driver_that_the_environment_chooses_is_taken(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "mine.json").touch()
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "mine.json"))
    assert viewers.driver() == tmp_path / "mine.json"


def test_a_viewer_that_dies_is_asked_once_more_and_one_that_shows_the_wrong_thing_never(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def die(viewer: Any) -> None:
        asked.append(viewer)
        viewer.process.kill()
        viewer.process.wait()
        raise ConnectionError

    def wrong(viewer: Any) -> None:
        asked.append(viewer)
        raise AssertionError("no such curve")

    for job, raises, times in ((die, viewers.DiedError, 2), (wrong, AssertionError, 1)):
        asked: list[Any] = []
        with pytest.raises(raises):
            viewers.seen(job)
        assert len(asked) == times


@pytest.mark.parametrize("works", [True, False])
def test_what_is_missing_is_fetched_three_times_before_it_is_given_up(
    hidden: str, works: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    asked = tmp_path / "asked"
    for name, body in (("apt-get", f'echo "$@" >> {asked}; {"true" if works else "false"}'), ("sudo", 'shift; exec "$@"')):
        (tmp_path / name).write_text(f"#!/bin/sh\n{body}\n")
        (tmp_path / name).chmod(0o755)
    for name in ("env", "true", "false", "sh"):
        (tmp_path / name).symlink_to(f"/usr/bin/{name}")
    monkeypatch.setitem(viewers.main.__globals__, "PAUSE_S", 0.0)
    viewers.main()
    lines = asked.read_text().splitlines()
    assert len(lines) == (2 if works else viewers.ATTEMPTS)
    assert ("NOT LOOKED AT" in capfd.readouterr().err) == (not works)
    if works:
        assert lines[0].endswith("update")
        assert all(package in lines[1] for package in viewers.PACKAGES[hidden])
