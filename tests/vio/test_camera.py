"""Tracks are what a stereo camera on the true trajectory would see: exact without noise, limited in length, in both images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.recording import Poses
from imutool.sensor.made_up_flight import FlightSettings, flight
from imutool.vio.camera import EUROC, FAR_M, NEAR_M, Frame, StereoRig, blackouts, observe, room

EXACT_PX = 1e-9  # rounding of a few products of numbers up to 1e3
FEATURES, LONGEST = 25, 8
SEED = 3


@pytest.fixture(scope="module")
def poses() -> Poses:
    """Ten seconds of a flight at 4 Hz."""
    made = flight(4, FlightSettings(duration_s=10.0, truth_rate_hz=4.0))
    return made.truth


def see(
    poses: Poses, pixel_noise: float, seed: int = SEED, dark: slice = slice(0, 0)
) -> tuple[list[Frame], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    landmarks_w = room(poses.p_wb, rng)
    sighted = np.ones(len(poses), bool)
    sighted[dark] = False
    frames, landmark_of = observe(poses, sighted, landmarks_w, rng, features=FEATURES, pixel_noise=pixel_noise, longest=LONGEST)
    return frames, landmark_of, landmarks_w


def test_a_point_on_the_axis_falls_on_the_centre_and_its_disparity_tells_its_depth() -> None:
    (ahead, aside, behind) = EUROC.project(np.array([[0.0, 0.0, 1.1], [1.0, -0.5, 2.0], [0.0, 0.0, -1.0]]))
    assert ahead == pytest.approx([367.215, 367.215 - 45.8654, 248.375], abs=EXACT_PX)
    assert aside == pytest.approx([367.215 + 229.327, 367.215 + 229.327 - 25.22597, 248.375 - 114.324], abs=EXACT_PX)
    assert np.isnan(behind).all()
    assert EUROC.in_view(np.array([ahead, behind, [10.0, -1.0, 100.0], [752.0, 700.0, 100.0]])).tolist() == [
        True,
        False,
        False,
        False,
    ]


def test_pixels_lead_back_to_the_point() -> None:
    p_c = np.random.default_rng(0).uniform([-2.0, -2.0, 0.5], [2.0, 2.0, 12.0], size=(100, 3))
    np.testing.assert_allclose(EUROC.back_project(EUROC.project(p_c)), p_c, rtol=1e-10, atol=1e-10)


def test_the_camera_is_rigidly_on_the_body() -> None:
    np.testing.assert_allclose(EUROC.R_bc @ EUROC.R_bc.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(EUROC.R_bc) == pytest.approx(1.0, abs=1e-9)


def test_noise_free_tracks_are_the_projections_of_their_landmarks(poses: Poses) -> None:
    """By the chain world - body - camera - image, written out here for each point alone."""
    frames, landmark_of, landmarks_w = see(poses, 0.0)
    for k, frame in enumerate(frames):
        body = Rotation.from_quat(poses.q_wb_wxyz[k], scalar_first=True)
        for track, pixels in zip(frame.tracks, frame.pixels, strict=True):
            p_b = body.inv().apply(landmarks_w[landmark_of[track]] - poses.p_wb[k])
            x, y, z = Rotation.from_matrix(EUROC.R_bc).inv().apply(p_b - EUROC.p_bc)
            expected = (458.654 * x / z + 367.215, 458.654 * (x - 0.11) / z + 367.215, 457.296 * y / z + 248.375)
            assert pixels == pytest.approx(expected, abs=1e-6)  # R_bc is printed to 12 digits, so only nearly a rotation
            assert NEAR_M - 1e-9 <= z <= FAR_M + 1e-9
            assert EUROC.in_view(pixels[None])[0]


def test_the_noise_is_white_and_of_the_size_asked_for(poses: Poses) -> None:
    exact, noisy = see(poses, 0.0)[0], see(poses, 2.0)[0]
    errors = np.concatenate([b.pixels - a.pixels for a, b in zip(exact, noisy, strict=True)])
    n = errors.size
    assert abs(errors.mean()) < 4 * 2.0 / np.sqrt(n)
    assert errors.std() == pytest.approx(2.0, abs=4 * 2.0 / np.sqrt(2 * n))
    assert abs(np.corrcoef(errors.T)[0, 1]) < 4 / np.sqrt(len(errors))


def test_tracks_are_of_limited_length_without_holes_and_always_as_many(poses: Poses) -> None:
    frames, landmark_of, _ = see(poses, 1.0)
    assert [len(frame.tracks) for frame in frames] == [FEATURES] * len(poses)
    seen_at = {track: [k for k, frame in enumerate(frames) if track in frame.tracks] for track in range(len(landmark_of))}
    lengths = [len(at) for at in seen_at.values()]
    assert max(lengths) == LONGEST
    assert all(at == list(range(at[0], at[-1] + 1)) for at in seen_at.values())
    for frame in frames:
        assert len({landmark_of[track] for track in frame.tracks}) == FEATURES


def test_a_dark_camera_sees_nothing_and_starts_anew(poses: Poses) -> None:
    frames, _, _ = see(poses, 1.0, dark=slice(10, 14))
    assert [len(frame.tracks) for frame in frames[10:14]] == [0] * 4
    before = set(np.concatenate([frame.tracks for frame in frames[:10]]))
    after = set(np.concatenate([frame.tracks for frame in frames[14:]]))
    assert before
    assert after
    assert not before & after


def test_landmarks_lie_on_the_six_sides_of_a_room_around_the_way(poses: Poses) -> None:
    points = room(poses.p_wb, np.random.default_rng(0), count=2000, margin_m=1.5)
    low, high = poses.p_wb.min(axis=0) - 1.5, poses.p_wb.max(axis=0) + 1.5
    on = np.concatenate([points == low, points == high], axis=1)
    assert on.sum(axis=1).tolist() == [1] * 2000
    assert on.any(axis=0).all()
    assert (points >= low).all()
    assert (points <= high).all()


def test_landmarks_are_as_dense_on_each_side_of_a_room() -> None:
    count, size = 40_000, np.array([12.0, 6.0, 3.0])
    points = room(np.array([[0.0, 0.0, 0.0], size - 2.0]), np.random.default_rng(0), count=count, margin_m=1.0) + 1.0
    on = np.concatenate([(points == 0.0).sum(axis=0), (points == size).sum(axis=0)])
    area = np.tile([6.0 * 3.0, 12.0 * 3.0, 12.0 * 6.0], 2)
    expected = count * area / area.sum()
    np.testing.assert_array_less(np.abs(on - expected), 4.0 * np.sqrt(expected))


def test_the_outermost_pixels_are_in_view_and_those_beyond_are_not() -> None:
    right, below = EUROC.width - 1.0, EUROC.height - 1.0
    inside, off = np.array([[0.0, 0.0, 0.0], [right, right, below]]), 1e-6
    assert EUROC.in_view(inside).all()
    for column in range(3):
        beyond = inside + off * np.array([[-1.0], [1.0]]) * np.eye(3)[column]
        assert not EUROC.in_view(beyond).any(), column


def test_the_seed_decides(poses: Poses) -> None:
    first, again, other = (see(poses, 1.0, seed)[0] for seed in (1, 1, 2))
    assert all(np.array_equal(a.pixels, b.pixels) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0].pixels, other[0].pixels)


def test_blackouts_come_at_the_end_of_each_period() -> None:
    dark = blackouts(np.arange(0.0, 31.0), 3.0, 15.0)
    assert np.flatnonzero(dark).tolist() == [12, 13, 14, 27, 28, 29]
    assert not blackouts(np.arange(0.0, 31.0), 0.0, 15.0).any()


def test_a_wider_baseline_means_more_disparity() -> None:
    wide = StereoRig(**{name: getattr(EUROC, name) for name in EUROC.__dataclass_fields__} | {"baseline_m": 0.22})
    point = np.array([[0.3, 0.1, 2.0]])
    (near, far) = (rig.project(point)[0] for rig in (EUROC, wide))
    assert (far[0] - far[1]) == pytest.approx(2 * (near[0] - near[1]), rel=1e-12)
