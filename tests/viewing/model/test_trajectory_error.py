"""Drift is what integrating anew from each reset gives; alignments find a planted motion, and evo says the same of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.evo import statistics

from imutool.errors import DataError
from imutool.exporting.tum import write_tum
from imutool.inertial.strapdown import StartPose, along_truth, dead_reckon
from imutool.recording import Imu, Poses, Recording
from imutool.viewing.model.trajectory_error import ALIGNMENTS, Alignment, aligned, drift_since_reset, errors, windows

AGREEMENT = 1e-9  # both round once a sample, in another order
EVO_TOLERANCE = 1e-6  # evo reads what was written with nine decimals
FOUND = 1e-9
MOVED = Rotation.from_rotvec([0.0, 0.0, 0.7]), np.array([3.0, -2.0, 0.5])

Stretch = tuple[Imu, Poses, Poses, np.ndarray]


@pytest.fixture(scope="module")
def stretch(recording: Recording) -> Stretch:
    """The raw path and the truth of the made-up flight, the truth unknown for a while after 3.2 s."""
    path, true, valid = along_truth(recording.imu, recording.truth, "flight")
    valid = valid.copy()
    valid[640:800] = False
    return recording.imu.between(int(path.t_ns[0]), int(path.t_ns[-1])), path, true, valid


def moved(poses: Poses, turn: Rotation, shift: np.ndarray) -> Poses:
    R = turn.as_matrix()
    q = (turn * Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    assert poses.v_w is not None
    return Poses(poses.t_ns, poses.p_wb @ R.T + shift, np.ascontiguousarray(q), poses.v_w @ R.T)


def test_drift_is_that_of_integrating_anew_from_every_reset(stretch: Stretch) -> None:
    imu, path, true, valid = stretch
    got = drift_since_reset(path, true, valid, reset_s=1.0)
    assert got.reset_s == 1.0
    turn_of = (path.t_ns - path.t_ns[0]) // 1_000_000_000
    resets = 0
    for number in np.unique(turn_of[valid]):
        rows = np.flatnonzero((turn_of == number) & valid)
        again = dead_reckon(imu.rows(slice(rows[0], rows[-1] + 1)), StartPose.of(true, int(rows[0])))
        anew = errors(again, true.rows(slice(rows[0], rows[-1] + 1)), np.ones(len(again), bool))
        part = rows - rows[0]
        np.testing.assert_allclose(got.since_s[rows], (path.t_ns[rows] - path.t_ns[rows[0]]) * 1e-9, atol=AGREEMENT)
        np.testing.assert_allclose(got.orientation_deg[rows], anew.orientation_total_deg[part], atol=AGREEMENT)
        np.testing.assert_allclose(got.position_m[rows], anew.position_total_m[part], atol=AGREEMENT)
        assert again.v_w is not None
        assert true.v_w is not None
        apart = np.linalg.norm(again.v_w - true.v_w[rows[0] : rows[-1] + 1], axis=1)
        np.testing.assert_allclose(got.velocity_m_s[rows], apart[part], atol=AGREEMENT)
        resets += 1
    assert resets == 9  # the sample that ends the eighth second begins another
    for column in (got.since_s, got.orientation_deg, got.velocity_m_s, got.position_m):
        assert np.array_equal(np.isnan(column), ~valid)
    assert got.since_s[800] == 0.0  # truth is back in the middle of a second: reset at once, not at the next


def test_windows_are_the_drift_at_their_ends(stretch: Stretch) -> None:
    imu, path, true, _ = stretch
    found = windows(path, true, np.ones(len(path), bool))
    assert [window.length_s for window in found] == [1.0, 5.0]  # of eight seconds, no 10 and 30
    first = found[1]
    end = int(np.searchsorted(path.t_ns, path.t_ns[0] + 5_000_000_000))
    again = dead_reckon(imu.rows(slice(0, end + 1)), StartPose.of(true))
    error = errors(again, true.rows(slice(0, end + 1)), np.ones(end + 1, bool))
    assert first.count == 1
    assert first.orientation_deg == pytest.approx(error.orientation_total_deg[-1], abs=AGREEMENT)
    assert first.position_m == pytest.approx(error.position_total_m[-1], abs=AGREEMENT)
    assert windows(path, true, np.zeros(len(path), bool)) == ()


def test_no_alignment_changes_no_bit(stretch: Stretch) -> None:
    _, path, true, valid = stretch
    same, motion = aligned(path, true, valid, "none")
    assert same == path
    assert motion.rotation.magnitude() == 0.0
    assert not motion.shift_m.any()


@pytest.mark.parametrize("alignment", [one for one in ALIGNMENTS if one != "none"])
def test_a_planted_motion_about_the_vertical_is_found_by_every_alignment(stretch: Stretch, alignment: Alignment) -> None:
    _, _, true, valid = stretch
    turn, shift = MOVED
    back, motion = aligned(moved(true, turn, shift), true, valid, alignment)
    assert (motion.rotation * turn).magnitude() < FOUND
    np.testing.assert_allclose(back.p_wb, true.p_wb, atol=1e-7)
    assert errors(back, true, valid).orientation_total_deg[valid].max() < 1e-5
    assert back.v_w is not None
    np.testing.assert_allclose(back.v_w, true.v_w, atol=1e-7)


def test_the_truths_holes_count_in_no_alignment(stretch: Stretch) -> None:
    _, _, true, valid = stretch
    wrong = true.p_wb.copy()
    wrong[~valid] += 1000.0
    estimate = Poses(true.t_ns, wrong, true.q_wb_wxyz, true.v_w)
    for alignment in ("origin", "yaw", "se3"):
        assert aligned(estimate, true, valid, alignment)[1].rotation.magnitude() < FOUND  # type: ignore[arg-type]


def test_yaw_turns_about_the_vertical_alone_and_is_the_best_such_turn(stretch: Stretch) -> None:
    _, path, true, valid = stretch
    best, motion = aligned(path, true, valid, "yaw")
    np.testing.assert_allclose(motion.rotation.apply([0.0, 0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-12)

    def misfit(poses: Poses) -> float:
        away = (poses.p_wb - true.p_wb)[valid]
        return float(((away - away.mean(axis=0)) ** 2).sum())

    for angle in (-1e-3, 1e-3):
        assert misfit(moved(best, Rotation.from_rotvec([0.0, 0.0, angle]), np.zeros(3))) > misfit(best)
    assert np.abs((best.p_wb - true.p_wb)[valid].mean(axis=0)).max() < 1e-9


def test_origin_makes_the_first_known_pose_the_true_one(stretch: Stretch) -> None:
    _, path, true, valid = stretch
    valid = valid.copy()
    valid[:7] = False
    got = errors(aligned(path, true, valid, "origin")[0], true, valid)
    assert got.position_total_m[7] < FOUND
    assert got.orientation_total_deg[7] < 1e-6
    assert np.nanmax(got.position_total_m) > 1.0


def test_positions_on_a_line_leave_the_turn_open(stretch: Stretch) -> None:
    _, _, true, valid = stretch
    line = Poses(true.t_ns, np.outer(np.arange(len(true)), [1.0, 0.0, 0.0]), true.q_wb_wxyz)
    with pytest.raises(DataError, match="line"):
        aligned(line, line, valid, "se3")
    assert aligned(line, line, valid, "yaw")[1].rotation.magnitude() < FOUND
    with pytest.raises(DataError, match="none of the estimate's stamps"):
        aligned(line, line, np.zeros(len(line), bool), "se3")


@pytest.mark.parametrize(("alignment", "word"), [("se3", "--align"), ("origin", "--align_origin")])
def test_errors_after_alignment_are_those_of_evo(stretch: Stretch, tmp_path: Path, alignment: Alignment, word: str) -> None:
    _, path, true, valid = stretch
    estimate = moved(path, Rotation.from_rotvec([0.3, -0.2, 0.9]), np.array([4.0, 5.0, 6.0]))  # origin has work to do
    write_tum([true.rows(valid)], tmp_path / "ref.txt")
    write_tum([estimate.rows(valid)], tmp_path / "est.txt")
    rmse = statistics(tmp_path, [("ape", "ref.txt", "est.txt", word)])[0]["rmse"]
    got = errors(aligned(estimate, true, valid, alignment)[0], true, valid).position_total_m[valid]
    assert float(np.sqrt(np.mean(got**2))) == pytest.approx(rmse, rel=EVO_TOLERANCE)
    assert rmse > 1e-3
