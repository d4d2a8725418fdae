"""TUM files hold every digit, and are whole or absent."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from imutool.errors import ConfigError
from imutool.exporting.tum import write_tum
from imutool.recording import Poses


def wander(n: int, seed: int) -> Poses:
    """A random walk of poses."""
    rng = np.random.default_rng(seed)
    q_wxyz = rng.normal(size=(n, 4))
    t_ns = 1_403_636_580_123_456_789 + 5_000_001 * np.arange(n)
    return Poses(t_ns, rng.normal(size=(n, 3)).cumsum(axis=0), q_wxyz / np.linalg.norm(q_wxyz, axis=1, keepdims=True))


def test_tum_files_read_back_exactly(tmp_path: Path) -> None:
    poses = wander(50, seed=15)
    write_tum([poses], tmp_path / "t.txt")
    rows = [line.split() for line in (tmp_path / "t.txt").read_text().splitlines()]
    assert [int(row[0].replace(".", "")) for row in rows] == poses.t_ns.tolist()
    assert rows[0][0].partition(".")[2] == f"{poses.t_ns[0] % 10**9:09d}"
    numbers = np.array([[float(word) for word in row[1:]] for row in rows])
    assert np.array_equal(numbers[:, :3], poses.p_wb)
    assert np.array_equal(numbers[:, [6, 3, 4, 5]], poses.q_wb_wxyz)


@pytest.mark.parametrize(
    ("t_ns", "text"), [(0, "0.000000000"), (-1, "-0.000000001"), (-1_500_000_000, "-1.500000000"), (7, "0.000000007")]
)
def test_stamps_keep_all_their_digits_on_either_side_of_zero(tmp_path: Path, t_ns: int, text: str) -> None:
    write_tum([Poses(np.array([t_ns], np.int64), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))], tmp_path / "t.txt")
    assert (tmp_path / "t.txt").read_text().split()[0] == text


def test_an_existing_file_stays_unless_told_and_nothing_is_left_beside(tmp_path: Path) -> None:
    poses, path = wander(3, seed=16), tmp_path / "t.txt"
    path.write_text("mine")
    with pytest.raises(ConfigError, match="overwrite"):
        write_tum([poses], path)
    assert path.read_text() == "mine"
    write_tum([poses], path, overwrite=True)
    assert len(path.read_text().splitlines()) == 3
    with pytest.raises(ConfigError, match="cannot be written"):
        write_tum([poses], tmp_path / "nowhere" / "t.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["t.txt"]


def test_an_interrupt_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "link", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_tum([wander(3, seed=17)], tmp_path / "t.txt")
    assert list(tmp_path.iterdir()) == []
