"""The delay of poses against a gyro: its size and sign, whatever the path's frame, and none of too few windows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.inertial.scoring.path_blocks import WindowPiece
from imutool.inertial.scoring.pose_delay import FEWEST_WINDOWS, pose_delay
from imutool.recording import Poses

RATE_HZ, DELAY_S = 200, 4e-3
NOISE_RAD = 1e-4
FIRST_ORDER = 0.02  # relative: what the second order of the delay adds


def turned(t_s: np.ndarray) -> Rotation:
    """A body that swings about all axes."""
    return Rotation.from_rotvec(np.stack([np.sin(3.0 * t_s), 0.7 * np.cos(2.2 * t_s), 0.5 * np.sin(1.7 * t_s)], axis=1))


def poses(t_s: np.ndarray, turns: Rotation) -> Poses:
    q_wb_wxyz = turns.as_quat(scalar_first=True)
    return Poses(np.round(t_s * 1e9).astype(np.int64), np.zeros((len(t_s), 3)), q_wb_wxyz)


def piece(seconds: int, delay_s: float = DELAY_S, seed: int = 0, frame: tuple[float, ...] = (0.5, -1.0, 2.0)) -> WindowPiece:
    """Windows of a second from the first row to the last; the path has another world than the truth."""
    t_s = np.arange(seconds * RATE_HZ + 1) / RATE_HZ
    noise = Rotation.from_rotvec(NOISE_RAD * np.random.default_rng(seed).normal(size=(len(t_s), 3)))
    first = RATE_HZ * np.arange(seconds)
    windows = np.stack([first, first + RATE_HZ], axis=1)
    return WindowPiece(
        poses(t_s, Rotation.from_rotvec(frame) * turned(t_s)), poses(t_s, turned(t_s - delay_s) * noise), windows
    )


@pytest.mark.parametrize("delay_s", [DELAY_S, -DELAY_S, 0.0])
def test_the_delay_is_found_with_its_deviation(delay_s: float) -> None:
    errors = []
    for seed in range(30):
        found = pose_delay([piece(12, delay_s, seed), piece(9, delay_s, seed + 100)])
        assert found is not None
        errors.append((found[0] - delay_s, found[1]))
    off_s, std_s = np.array(errors).T
    assert abs(off_s.mean()) < FIRST_ORDER * DELAY_S
    assert off_s.std() / std_s.mean() == pytest.approx(1.0, abs=0.4)


def test_windows_of_poses_that_jump_do_not_count() -> None:
    whole = piece(20)
    jumped = whole.truth.q_wb_wxyz.copy()
    jumped[7 * RATE_HZ + 1 :] = (turned_by(0.5) * Rotation.from_quat(jumped[7 * RATE_HZ + 1 :], scalar_first=True)).as_quat(
        scalar_first=True
    )
    found = pose_delay([whole._replace(truth=Poses(whole.truth.t_ns, whole.truth.p_wb, jumped))])
    assert found is not None
    assert found[0] == pytest.approx(DELAY_S, rel=FIRST_ORDER)


def turned_by(rad: float) -> Rotation:
    return Rotation.from_rotvec([0.0, 0.0, rad])


def test_few_windows_and_a_body_that_does_not_turn_show_none() -> None:
    """The first and the last window of a piece have no rate at one end."""
    assert pose_delay([piece(FEWEST_WINDOWS + 1)]) is None
    assert pose_delay([piece(FEWEST_WINDOWS + 2)]) is not None
    t_s = np.arange(20 * RATE_HZ) / RATE_HZ
    still = poses(t_s, Rotation.from_rotvec(np.zeros((len(t_s), 3))))
    windows = np.stack([RATE_HZ * np.arange(19), RATE_HZ * np.arange(1, 20)], axis=1)
    found = pose_delay([WindowPiece(still, still, windows)])
    assert found is not None
    assert found[0] == 0.0
