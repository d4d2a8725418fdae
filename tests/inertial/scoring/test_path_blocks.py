"""A path in blocks has the errors of the whole path, whose arrays it does not need."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from imutool.errors import DataError
from imutool.inertial import metrics
from imutool.inertial.kinematics import trapezoidal
from imutool.inertial.metrics import RelativeErrors
from imutool.inertial.scoring import path_blocks
from imutool.inertial.scoring.path_blocks import AT_ONCE, TrueSpan, in_memory, integrated, pieces
from imutool.inertial.strapdown import StartPose, along_truth, dead_reckon, drift_windows, window_drift
from imutool.recording import Recording
from imutool.sensor.made_up_flight import flight

ROUNDING = 1e-9  # relative


@pytest.fixture(scope="module")
def made() -> Recording:
    """More than two blocks, in the middle of which the truth has a gap; it begins after the IMU and ends before it."""
    found = flight(2, duration_s=(2 * AT_ONCE + 1000) / 200.0)
    t_s = (found.truth.t_ns - found.truth.t_ns[0]) * 1e-9
    known = (t_s > 0.5) & (t_s < 86.5) & ((t_s < 30.0) | (t_s > 33.0)) & ((t_s < 50.0) | (t_s > 50.06))
    return Recording("made", found.imu, {"/truth": found.truth.rows(known)})


@pytest.mark.parametrize("means", [False, True])
def test_blocks_have_the_errors_of_the_whole_path(made: Recording, means: bool) -> None:
    imu = trapezoidal(made.imu) if means else made.imu
    path, true, valid = along_truth(imu, made.truth, made.name)
    span = TrueSpan(made.imu.t_ns, made.truth, made.name)
    np.testing.assert_array_equal(span.valid, valid)
    samples = made.imu.rows(span.span)
    whole = metrics.evaluate(path, true, valid)
    assert not valid.all()
    assert whole["rpe_m"]["20"] is not None
    blocks = partial(integrated, samples, span, means=means)
    assert max(len(block.truth) for block in blocks()) == AT_ONCE
    for found in (metrics.evaluate_blocks(blocks), metrics.evaluate_blocks(partial(in_memory, path, span))):
        assert {key: value for key, value in found.items() if key not in ("roe_deg", "rpe_m")} == pytest.approx(
            {key: value for key, value in whole.items() if key not in ("roe_deg", "rpe_m")}, rel=ROUNDING
        )
        for key in ("roe_deg", "rpe_m"):
            assert found[key] == pytest.approx(whole[key], rel=ROUNDING)


def test_blocks_without_truth_count_nowhere(made: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ahead of the first pose, in a gap, and behind the last pose; a slow truth has longer gaps."""
    monkeypatch.setattr(path_blocks, "AT_ONCE", 1 << 8)
    imu = made.imu.rows(slice(0, 25 * 200))
    t_s = (made.truth.t_ns - imu.t_ns[0]) * 1e-9
    for every in (1, 12):
        truth = made.truth.rows((t_s > 4.0) & (t_s < 20.0) & ((t_s < 9.0) | (t_s > 14.0))).rows(slice(None, None, every))
        path, true, valid = along_truth(imu, truth, made.name)
        span = TrueSpan(imu.t_ns, truth, made.name)
        np.testing.assert_array_equal(span.valid, valid)
        found = metrics.evaluate_blocks(partial(integrated, imu.rows(span.span), span))
        assert (found["samples"], found["duration_s"]) == (valid.sum(), (true.t_ns[-1] - true.t_ns[0]) * 1e-9)
        assert found["aoe_deg"] == pytest.approx(metrics.evaluate(path, true, valid)["aoe_deg"], rel=ROUNDING)


def test_windows_drift_in_pieces_as_on_the_whole_path(made: Recording) -> None:
    span = TrueSpan(made.imu.t_ns, made.truth, made.name)
    samples, windows = made.imu.rows(span.span), drift_windows(span.t_ns, span.valid, 5.0)
    true = span.rows(slice(None))
    expected = window_drift(dead_reckon(trapezoidal(samples), StartPose.of(true)), true, *windows.T)
    found = [
        (window_drift(piece.path, piece.truth, *piece.windows.T), piece) for piece in pieces(samples, span, windows, margin=1)
    ]
    assert len(found) > 1
    assert {int(piece.windows[0, 0]) for _, piece in found[1:]} == {1}
    assert {len(piece.path) - 1 - int(piece.windows[-1, 1]) for _, piece in found[:-1]} == {1}
    assert max(len(piece.path) for _, piece in found) <= AT_ONCE + 3
    for column in range(3):
        joined = np.concatenate([drift[column] for drift, _ in found])
        np.testing.assert_allclose(joined, expected[column], rtol=1e-6, atol=1e-9)  # metres of kilometres
    assert sum(len(piece.windows) for _, piece in found) == len(windows)


def test_relative_errors_keep_the_poses_of_the_longest_distance_alone(made: Recording) -> None:
    span = TrueSpan(made.imu.t_ns, made.truth, made.name)
    sums, kept = RelativeErrors((5.0, 20.0)), []
    for block in integrated(made.imu.rows(span.span), span):
        sums.add(*block.scored())
        kept.append(len(sums._travelled))
    assert max(kept) < 1.5 * AT_ONCE


def test_one_stamp_with_truth_is_no_span(made: Recording) -> None:
    before = made.imu.t_ns[made.imu.t_ns <= made.truth.t_ns[0]]
    with pytest.raises(DataError, match="fewer than two samples"):
        TrueSpan(before, made.truth, made.name)
    with pytest.raises(DataError, match="fewer than two samples"):
        TrueSpan(before[:0], made.truth, made.name)
