"""Our figures against evo's command line, run as a separate process, and against answers known beforehand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.evo import statistics
from support.nees import consistency

from imutool.errors import DataError, NumericsError
from imutool.exporting.tum import write_tum
from imutool.inertial.metrics import AbsoluteErrors, absolute, evaluate, pairs_by_distance
from imutool.inertial.scoring.alignment import align
from imutool.recording import Poses

EVO_TOLERANCE = 1e-9  # measured 4e-16; the same formulas in double precision, summed in another order
EXACT = 1e-9
START_NS = 1_403_636_600_000_000_003


def wander(n: int, seed: int, dt_s: float = 0.02) -> Poses:
    """A smooth walk with turns in all axes and a rest of 150 poses in the middle, on uneven stamps."""
    rng = np.random.default_rng(seed)
    t_ns = START_NS + np.cumsum(rng.integers(int(0.9 * dt_s * 1e9), int(1.1 * dt_s * 1e9), n))
    t = (t_ns - t_ns[0]) * 1e-9
    phase, rate = rng.uniform(0, 2 * np.pi, (3, 4)), rng.uniform(0.1, 0.9, (3, 4))
    v = np.sin(phase[:, :, None] + rate[:, :, None] * t).mean(axis=1).T * 2
    v[n // 2 : n // 2 + 150] = 0.0
    p = np.cumsum(v * dt_s, axis=0)
    turn = np.stack([np.sin(0.3 * t), 0.5 * np.cos(0.17 * t), 0.4 * t], axis=1)
    return Poses(t_ns.astype(np.int64), p, quaternions(Rotation.from_rotvec(turn)), v)


def quaternions(rotations: Rotation) -> np.ndarray:
    return np.ascontiguousarray(rotations.as_quat(scalar_first=True))


def rotations(poses: Poses) -> Rotation:
    return Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)


def moved(poses: Poses, turn: Rotation, shift: np.ndarray) -> Poses:
    """The same trajectory seen from another world frame."""
    R = turn.as_matrix()
    v_w = None if poses.v_w is None else poses.v_w @ R.T
    return Poses(poses.t_ns, poses.p_wb @ R.T + shift, quaternions(turn * rotations(poses)), v_w)


def drifted(truth: Poses, seed: int) -> Poses:
    """An estimate that starts right and drifts away in angle and position."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(scale=0.002, size=(len(truth), 3)) + np.array([1e-4, -2e-4, 3e-4])
    walk = np.cumsum(steps, axis=0) - steps[0]
    p = truth.p_wb + 3 * walk + 0.02 * walk**2
    return Poses(truth.t_ns, p, quaternions(rotations(truth) * Rotation.from_rotvec(walk)), truth.v_w)


def everything(poses: Poses) -> np.ndarray:
    return np.ones(len(poses), bool)


# --- evo ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Poses, Poses, np.ndarray, Path]:
    truth = wander(3000, seed=3)
    estimate = moved(drifted(truth, seed=4), Rotation.from_rotvec([0.1, -0.2, 0.3]), np.array([1.0, 2.0, -0.5]))
    valid = everything(truth)
    valid[700:900] = valid[2500:2510] = False  # drop-outs of the motion capture
    folder = tmp_path_factory.mktemp("evo")
    write_tum([truth.rows(valid)], folder / "ref.txt")
    write_tum([estimate.rows(valid)], folder / "est.txt")
    return estimate, truth, valid, folder


ABSOLUTE = {
    "aoe_deg": ("-r", "angle_deg"),
    "ape_m": ("-r", "trans_part"),
    "aoe_aligned_deg": ("--align", "-r", "angle_deg"),
    "ape_aligned_m": ("--align", "-r", "trans_part"),
}
RELATIVE = {
    (figure, distance_m): ("-r", word, "--delta", distance_m, "--delta_unit", "m", "--all_pairs", "--pairs_from_reference")
    for figure, word in (("roe_deg", "angle_deg"), ("rpe_m", "trans_part"))
    for distance_m in ("5", "20")
}


@pytest.fixture(scope="module")
def evos(pair: tuple[Poses, Poses, np.ndarray, Path]) -> dict[str | tuple[str, str], dict[str, float]]:
    """evo's statistics of the pair, by our names of the figures."""
    files = ("ref.txt", "est.txt")
    lines = [("ape", *files, *words) for words in ABSOLUTE.values()] + [("rpe", *files, *words) for words in RELATIVE.values()]
    return dict(zip([*ABSOLUTE, *RELATIVE], statistics(pair[3], lines), strict=True))


@pytest.mark.parametrize("figure", ABSOLUTE)
def test_absolute_figures_equal_those_of_evo(pair: tuple[Poses, Poses, np.ndarray, Path], evos: Any, figure: str) -> None:
    estimate, truth, valid, _ = pair
    got = absolute(estimate, truth, valid)[figure]
    assert got == pytest.approx(evos[figure]["rmse"], rel=EVO_TOLERANCE)
    assert got is not None
    assert got > 0.1  # an error there is to measure


@pytest.mark.parametrize(("figure", "distance_m"), RELATIVE)
def test_relative_figures_equal_those_of_evo(
    pair: tuple[Poses, Poses, np.ndarray, Path], evos: Any, figure: str, distance_m: str
) -> None:
    estimate, truth, valid, _ = pair
    got = evaluate(estimate, truth, valid)[figure][distance_m]
    assert got == pytest.approx(evos[figure, distance_m]["mean"], rel=EVO_TOLERANCE)
    assert got is not None
    assert got > 0.1


# --- answers known beforehand --------------------------------------------------------------------------------------------


def test_a_constant_offset_is_its_own_error_and_vanishes_when_aligned() -> None:
    truth = wander(400, seed=5)
    turn, shift = Rotation.from_rotvec([0.0, 0.3, 0.0]), np.array([3.0, 4.0, 0.0])
    at_rest = Poses(truth.t_ns, truth.p_wb + shift, quaternions(turn * rotations(truth)), truth.v_w + np.array([0, 0, 0.5]))
    figures = absolute(at_rest, truth, everything(truth))
    assert figures["aoe_deg"] == pytest.approx(np.degrees(0.3), abs=EXACT)
    assert figures["ape_m"] == pytest.approx(5.0, abs=EXACT)
    assert figures["velocity_rmse_m_s"] == pytest.approx(0.5, abs=EXACT)
    assert figures["ape_aligned_m"] == pytest.approx(0.0, abs=EXACT)
    bare = Poses(truth.t_ns, truth.p_wb, truth.q_wb_wxyz)
    assert absolute(at_rest, bare, everything(truth)) == figures | {"velocity_rmse_m_s": None}, "positions are enough"
    rigid = absolute(moved(truth, turn, shift), truth, everything(truth))
    assert rigid["aoe_aligned_deg"] == pytest.approx(0.0, abs=1e-6)
    assert rigid["ape_aligned_m"] == pytest.approx(0.0, abs=EXACT)


def test_the_angle_is_that_of_the_relative_rotation_up_to_half_a_turn() -> None:
    truth = wander(4, seed=6)
    errors = Rotation.from_rotvec(np.array([[0, 0, 0], [0.1, 0, 0], [0, 3.1, 0], [0, 0, np.pi + 0.2]]))
    estimate = Poses(truth.t_ns, truth.p_wb, quaternions(rotations(truth) * errors), truth.v_w)
    expected = np.degrees(np.sqrt(np.mean(np.square([0, 0.1, 3.1, np.pi - 0.2]))))
    assert absolute(estimate, truth, everything(truth))["aoe_deg"] == pytest.approx(expected, abs=EXACT)


@given(st.integers(0, 10**6), st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-100, 100)] * 3))
@settings(max_examples=25, deadline=None)
def test_aligned_and_relative_figures_do_not_depend_on_the_frame_of_the_estimate(
    seed: int, turn: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    truth = wander(900, seed=7)
    estimate = drifted(truth, seed)
    elsewhere = moved(estimate, Rotation.from_rotvec(turn), np.array(shift))
    mask = everything(truth)
    for name in ("aoe_aligned_deg", "ape_aligned_m"):
        assert absolute(elsewhere, truth, mask)[name] == pytest.approx(absolute(estimate, truth, mask)[name], abs=1e-6)
    here, there = evaluate(estimate, truth, mask, (2.0,)), evaluate(elsewhere, truth, mask, (2.0,))
    assert there["roe_deg"]["2"] == pytest.approx(here["roe_deg"]["2"], abs=1e-6)
    assert there["rpe_m"]["2"] == pytest.approx(here["rpe_m"]["2"], abs=1e-6)


@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.5, 3.0, 40.0]))
@settings(max_examples=60, deadline=None)
def test_pairs_found_by_bisection_are_those_of_a_search_of_all(seed: int, distance_m: float) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.0, 0.0, 0.125, 0.25, 1.0, 6.0], size=(80, 1)) * [1.0, 0.0, 0.0]  # rests, and ties that are exact
    p = np.cumsum(steps, axis=0)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    expected = []
    for i in range(len(p) - 1):
        miss = np.abs(travelled[i + 1 :] - travelled[i] - distance_m)
        if miss.min() <= 0.1 * distance_m:
            expected.append((i, i + 1 + int(miss.argmin())))
    i, j = pairs_by_distance(travelled, np.arange(len(p) - 1), distance_m)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected


def test_umeyama_never_mirrors() -> None:
    p = np.random.default_rng(8).normal(size=(50, 3))
    found = align(p, p * [1.0, 1.0, -1.0])
    assert found is not None
    assert np.linalg.det(found[0]) == pytest.approx(1.0)


def test_masked_rows_count_nowhere() -> None:
    truth = wander(1500, seed=9)
    estimate = drifted(truth, seed=1)
    valid = everything(truth)
    valid[300:500] = False
    spoiled = Poses(truth.t_ns, np.where(valid[:, None], truth.p_wb, 1e6), truth.q_wb_wxyz, truth.v_w)
    got = evaluate(estimate, spoiled, valid)
    assert got == evaluate(estimate.rows(valid), truth.rows(valid), everything(truth)[valid])
    assert got["samples"] == 1300


def test_evaluate_holds_the_contract() -> None:
    truth = wander(1200, seed=10)
    figures = evaluate(drifted(truth, seed=2), truth, everything(truth))
    assert set(figures) == {
        *("samples", "duration_s", "aoe_deg", "aoe_aligned_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s"),
        *("roe_deg", "rpe_m"),
    }
    assert list(figures["roe_deg"]) == list(figures["rpe_m"]) == ["5", "10", "15", "20"]
    assert json.loads(json.dumps(figures)) == figures


def test_what_the_data_do_not_determine_is_none() -> None:
    truth = wander(200, seed=11)  # 4 s at about 1 m/s
    still = Poses(truth.t_ns, np.zeros_like(truth.p_wb), truth.q_wb_wxyz)
    mask = everything(truth)
    figures = evaluate(still, truth, mask)
    assert figures["roe_deg"]["20"] is None
    assert figures["rpe_m"]["20"] is None
    assert figures["velocity_rmse_m_s"] is None
    assert figures["aoe_aligned_deg"] is None
    assert figures["ape_aligned_m"] is None
    assert figures["aoe_deg"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_straight_path_says_nothing_of_a_turn_about_itself(seed: int) -> None:
    """Off its line by rounding alone, it was turned by up to 176 degrees against itself."""
    rng = np.random.default_rng(seed)
    p_wb = np.linspace(0.0, 1.0, 500)[:, None] * rng.normal(size=3) * 10.0 ** rng.uniform(-3.0, 3.0) + rng.normal(size=3)
    for written in (p_wb, p_wb.round(9)):
        line = Poses(START_NS + 10**7 * np.arange(500), written, np.tile([1.0, 0.0, 0.0, 0.0], (500, 1)))
        figures = absolute(line, line, everything(line))
        assert (figures["aoe_aligned_deg"], figures["ape_aligned_m"]) == (None, None)


def test_a_path_whose_last_block_turns_at_the_origin_has_positions() -> None:
    path, errors = wander(200, seed=11), AbsoluteErrors()
    errors.add(path, path)
    at_origin = Poses(path.t_ns + 10**10, np.zeros_like(path.p_wb), path.q_wb_wxyz, np.zeros_like(path.p_wb))
    errors.add(at_origin, at_origin)
    assert errors.figures(lambda: iter(()))["ape_m"] == 0.0


@pytest.mark.parametrize("angle", [0.4, -0.4])
def test_a_body_without_positions_that_has_stopped_turning_has_none(angle: float) -> None:
    errors, turns = AbsoluteErrors(), quaternions(Rotation.from_rotvec(np.outer(np.linspace(0.0, 1.0, 50), [0.0, 0.0, angle])))
    for start_ns, q_wb in ((0, turns), (10**9, turns[-1:])):
        nothing = np.zeros((len(q_wb), 3))
        bare = Poses(start_ns + 10**7 * np.arange(len(q_wb)), nothing, q_wb, nothing)
        errors.add(bare, bare)
    figures = errors.figures(lambda: iter(()))
    assert (figures["ape_m"], figures["velocity_rmse_m_s"]) == (None, None)


def test_one_pose_has_absolute_figures_only() -> None:
    one = wander(1, seed=12)
    figures = evaluate(one, one, everything(one))
    assert figures["ape_m"] == 0.0
    assert figures["rpe_m"] == {"5": None, "10": None, "15": None, "20": None}


def test_diverged_numbers_are_refused() -> None:
    truth = wander(300, seed=13)
    for factor in (1e200, 1e307):  # as do their squares, and their products with the truth
        away = Poses(truth.t_ns, truth.p_wb * factor, truth.q_wb_wxyz, truth.v_w)
        for function in (absolute, evaluate):
            with pytest.raises(NumericsError):
                function(away, truth, everything(truth))


def test_trajectories_that_do_not_match_are_refused() -> None:
    truth = wander(10, seed=14)
    with pytest.raises(DataError, match="do not match"):
        absolute(truth.rows(slice(0, 9)), truth, everything(truth))
    with pytest.raises(DataError, match="no stamp of the estimate has truth"):
        absolute(truth, truth, ~everything(truth))


# --- consistency -----------------------------------------------------------------------------------------------------------


def gaussian(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n, 6, 6)) + 2 * np.eye(6)
    return (roots @ rng.normal(size=(n, 6, 1)))[..., 0], roots @ roots.transpose(0, 2, 1)


def test_honest_covariances_are_found_consistent_as_often_as_stated() -> None:
    found = [consistency(*gaussian(50, seed))["consistent"] for seed in range(400)]
    assert abs(np.mean(found) - 0.95) < 0.04  # four standard deviations of 400 draws


@pytest.mark.parametrize(("factor", "side"), [(0.7, "nees_upper"), (1.4, "nees_lower")])
def test_covariances_too_small_or_too_large_are_not(factor: float, side: str) -> None:
    errors, covariances = gaussian(200, 1)
    result = consistency(errors, factor * covariances)
    assert not result["consistent"]
    assert (result["nees_mean"] > result[side]) == (side == "nees_upper")
    assert result["nees_mean"] == pytest.approx(consistency(errors, covariances)["nees_mean"] / factor)


def test_the_bounds_are_those_of_the_chi_square_tables() -> None:
    """Bar-Shalom's example: 50 runs of 2 states, two-sided 95 %: chi-square with 100 degrees, [74.22, 129.56] / 50."""
    result = consistency(np.ones((50, 2)), np.tile(np.eye(2), (50, 1, 1)))
    assert result["nees_lower"] == pytest.approx(74.22 / 50, abs=1e-4)
    assert result["nees_upper"] == pytest.approx(129.56 / 50, abs=1e-4)
    assert result["nees_mean"] == pytest.approx(2.0)


def test_covariances_that_cannot_be_are_refused() -> None:
    with pytest.raises(DataError, match="positive definite"):
        consistency(np.ones((1, 2)), np.diag([1.0, -1.0])[None])
    with pytest.raises(NumericsError, match="not finite"):
        consistency(np.full((1, 2), np.inf), np.eye(2)[None])
    with pytest.raises(DataError, match="at least one"):
        consistency(np.ones((0, 2)), np.ones((0, 2, 2)))
