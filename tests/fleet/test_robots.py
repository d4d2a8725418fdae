"""The robots that are unlike the others are named, and no other ones."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.errors import DataError
from imutool.fleet.one_log import work
from imutool.fleet.robots import FALSE_DISCOVERY, FEWEST, compare
from imutool.fleet.robots import _robust as robust
from imutool.fleet.sources import find
from imutool.fleet.task import Parameter, Result, Settings, Task
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write

ROBOTS, PARAMETERS, STD = 20, 12, 0.2
FALSE_FLEETS = 0.03  # of 200 with nothing to find: three standard deviations above FALSE_DISCOVERY
FOUND = 0.9


def fleet(rng: np.random.Generator, robots: int = ROBOTS, odd: Mapping[tuple[int, int], float] | None = None) -> list[Result]:
    """Robots whose parameters differ by one, known to within STD; `odd` ones are farther off."""
    results = []
    for robot in range(robots):
        values = [rng.normal() + rng.normal(0.0, STD) + (odd or {}).get((robot, k), 0.0) for k in range(PARAMETERS)]
        made = tuple(Parameter(f"effect_{k // 3}", "xyz"[k % 3], v, STD, "-") for k, v in enumerate(values))
        results.append(Result(key=str(robot), source="", target="", status="ok", robot=f"r{robot}", parameters=made))
    return results


def test_where_there_is_nothing_nothing_is_found() -> None:
    rng = np.random.default_rng(0)
    wrong = [bool(compare(fleet(rng, robots)).outliers) for robots in (8, 20) for _ in range(100)]
    assert np.mean(wrong) <= FALSE_FLEETS, FALSE_DISCOVERY


def test_two_that_are_far_off_are_found_and_ranked() -> None:
    rng, right = np.random.default_rng(1), []
    for _ in range(50):
        found = compare(fleet(rng, odd={(3, 4): 25.0, (11, 0): 14.0}))
        right.append([(one.robot, one.effect, one.parameter) for one in found.outliers][:2])
    assert np.mean([one == [("r3", "effect_1", "y"), ("r11", "effect_0", "x")] for one in right]) > FOUND


def test_a_fleet_whose_logs_all_failed_has_nothing_to_compare() -> None:
    found = compare([Result(key="a.mcap", source="", target="", status="failed", robot="a")])
    assert (found.robots, found.outliers, found.shared) == (0, (), ())


def test_few_robots_are_not_compared() -> None:
    found = compare(fleet(np.random.default_rng(2), FEWEST - 1, {(0, 0): 100.0}))
    assert not found.outliers
    assert "too few" in found.summary


def test_a_log_that_is_unsure_says_little() -> None:
    results = fleet(np.random.default_rng(3))
    vague = Parameter("effect_0", "x", 50.0, 40.0, "-")
    results[4] = Result(key="4", source="", target="", status="ok", robot="r4", parameters=(vague, *results[4].parameters[1:]))
    assert not compare(results).outliers


def test_logs_of_a_robot_are_weighed_by_their_certainty() -> None:
    def log(value: float, std: float) -> Result:
        return Result(key="", source="", target="", status="ok", robot="a", parameters=(Parameter("e", "x", value, std, "m"),))

    (shared,) = compare([log(1.0, 0.1), log(3.0, 0.2)]).shared
    assert shared.middle == pytest.approx((1.0 / 0.01 + 3.0 / 0.04) / (1.0 / 0.01 + 1.0 / 0.04))
    assert (shared.robots, compare([log(1.0, 0.1), log(3.0, 0.2)]).logs) == (1, 2)


@settings(deadline=None)
@given(st.integers(2, 60), st.integers(0, 2**32 - 1), st.floats(-1e3, 1e3), st.floats(1e-3, 1e3))
def test_middle_and_spread_move_and_grow_with_the_numbers(n: int, seed: int, shift: float, scale: float) -> None:
    x = np.random.default_rng(seed).normal(size=n)
    middle, spread = robust(x)
    assert robust(shift + scale * x) == pytest.approx((shift + scale * middle, scale * spread), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("n", [5, 9, 20, 101])
def test_the_spread_of_normal_numbers_is_their_deviation(n: int) -> None:
    rng = np.random.default_rng(n)
    assert np.mean([robust(rng.normal(size=n))[1] for _ in range(2000)]) == pytest.approx(1.0, abs=0.03)


def test_half_of_the_robots_cannot_spoil_the_spread() -> None:
    x = np.random.default_rng(5).normal(size=40)
    x[:19] = 1e6
    assert robust(x)[1] < 10.0


def test_of_a_dozen_robots_the_rotated_mount_and_the_wrong_scale_are_named(
    robot: Callable[[Path, int, Mapping[str, Sequence[float]]], None], tmp_path: Path
) -> None:
    rng = np.random.default_rng(7)
    for k in range(12):
        effects = {"mount_rotation": np.deg2rad(0.2) * rng.normal(size=3), "gyro_scale": 0.002 * rng.normal(size=3)}
        effects["mount_rotation"][1] += np.deg2rad(2.1) * (k == 11)
        effects["gyro_scale"][2] += 0.03 * (k == 5)
        robot(tmp_path / "logs" / f"robot_{k:02d}" / "log.mcap", k + 1, effects)
    quick = Settings(command="diagnose", quick=True)
    results = [
        work(Task(key=one.name, source=one, out=str(tmp_path / "out"), target=f"{one.name}.json", settings=quick))
        for one in find(str(tmp_path / "logs"), tmp_path / "out").logs
    ]
    assert [one.error for one in results if one.status != "ok"] == []
    found = compare(results)
    assert {(one.robot, one.effect, one.parameter) for one in found.outliers} == {
        ("robot_11", "mount_rotation", "phi_y"),
        ("robot_05", "gyro_scale", "z"),
    }
    turned = next(one for one in found.outliers if one.robot == "robot_11")
    assert turned.value - turned.middle == pytest.approx(np.deg2rad(2.1), abs=4.0 * np.deg2rad(0.2))
    assert "robot_11: mount rotation phi y 2" in turned.sentence


def test_a_robot_in_another_unit_is_refused_and_not_compared(logs: Path, tmp_path: Path) -> None:
    made = read(logs / "flight_1.mcap")
    write(replace(made, imu=replace(made.imu, gyro=np.rad2deg(made.imu.gyro))), tmp_path / "log.mcap")
    (source,) = find(str(tmp_path / "log.mcap"), tmp_path / "out").logs
    quick = Settings(command="diagnose", quick=True)
    done = work(Task(key="k", source=source, out=str(tmp_path / "out"), target="log.json", settings=quick))
    assert (done.status, done.exit_code, done.parameters) == ("failed", DataError.exit_code, ())
    assert "deg/s" in done.error
