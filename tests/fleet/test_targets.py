"""Names below OUT lead nowhere else, and only half-written files of the fleet itself are removed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imutool.errors import ConfigError
from imutool.fleet.targets import partial_files, relative, remove_files, within

WEB = "http://host/src"


@pytest.mark.parametrize("file", ["/src/../etc/x.mcap", "/src//x.mcap", "/src/./x.mcap", "/etc/x.mcap", "/srcx/a.mcap", "/src"])
def test_a_name_that_leads_elsewhere_is_refused(file: str) -> None:
    with pytest.raises(ConfigError):
        relative(file, "/src")


@pytest.mark.parametrize(
    "name", ["%2e%2e/x.mcap", "a%2Fb.mcap", "..%5Cx.mcap", "%2Ehidden.mcap", "a%0Ab.mcap", "fleet%2Ex.mcap"]
)
def test_a_percent_encoded_name_leads_no_further_than_a_plain_one(name: str) -> None:
    with pytest.raises(ConfigError):
        relative(f"{WEB}/{name}", WEB)
    assert relative(f"{WEB}/run%201.mcap", WEB) == "run 1.mcap"
    assert relative("s3://bucket/src/run%201.mcap", "s3://bucket/src") == "run%201.mcap"  # there a percent sign is one


@given(st.text(max_size=30))
def test_no_name_leads_out_of_out(name: str) -> None:
    try:
        taken = relative(f"/src/{name}", "/src")
    except ConfigError:
        return
    target = Path(os.path.normpath(Path("/out") / taken))
    assert target.is_relative_to("/out")
    assert target != Path("/out")
    assert taken.isprintable()


def test_a_link_in_out_is_not_followed_elsewhere(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "there").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    (out / "a").symlink_to(tmp_path / "elsewhere")
    assert within(out, "there/b.mcap") == out / "there" / "b.mcap"
    with pytest.raises(ConfigError, match="outside OUT"):
        within(out, "a/b.mcap")


def test_only_what_was_half_written_beside_these_targets_goes(tmp_path: Path) -> None:
    ours = [".a.mcap.12.0123abcd.partial", "b/.c.mcap.1.ffffffff.partial"]
    others = [".other.mcap.12.0123abcd.partial", ".a.mcap.partial", "a.mcap", "b/.c.mcap.1.ffffffff.partial.mcap"]
    (tmp_path / "b").mkdir()
    for name in (*ours, *others):
        (tmp_path / name).touch()
    remove_files(partial_files(tmp_path, ["a.mcap", "b/c.mcap", "gone/d.mcap"]))
    assert sorted(str(one.relative_to(tmp_path)) for one in tmp_path.rglob("*") if one.is_file()) == sorted(others)
