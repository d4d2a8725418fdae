"""No window crosses a gap, a log's border or the border of the held-out part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.errors import DataError
from imutool.geometry import so3
from imutool.recording import Imu, Recording
from imutool.recording.columns import MAX_GAP_S
from imutool.sensor.made_up_flight import flight
from imutool.training.objectives.objective import RestBiases
from imutool.training.training_windows import HELD_OUT, Pool

RATE_HZ = 200.0
Make = Callable[..., Recording]


@pytest.fixture(scope="module")
def pool(perfect: Make, without_truth: Make) -> Pool:
    """Three logs of different length, the second with two holes in its truth."""
    holed = without_truth(without_truth(perfect(2, duration_s=8.0), 1.5, 1.9), 4.0, 5.0)
    return Pool.of([perfect(1, duration_s=5.0), holed, perfect(3, duration_s=6.0)])


def test_all_logs_lie_end_to_end_with_their_own_clocks(pool: Pool) -> None:
    assert torch.bincount(pool.log).tolist() == [1001, 1601, 1201]
    assert pool.names == ("exact_1", "exact_2", "exact_3")
    assert pool.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    for i, duration_s in enumerate((5.0, 8.0, 6.0)):
        t = pool.t[pool.log == i]
        assert (t[0].item(), t[-1].item()) == (0.0, pytest.approx(duration_s, abs=1e-9))


def test_the_truth_is_the_flights_own(pool: Pool, perfect: Make) -> None:
    exact = perfect(3, duration_s=6.0)
    mine = pool.log == 2
    assert exact.truth.v_w is not None
    np.testing.assert_array_equal(pool.p_wb[mine].numpy(), exact.truth.p_wb)
    np.testing.assert_array_equal(pool.v_w[mine].numpy(), exact.truth.v_w)
    R_wb = so3.matrix_from_quaternion_wxyz(torch.from_numpy(exact.truth.q_wb_wxyz.copy()))
    torch.testing.assert_close(pool.R_wb[mine], R_wb, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(pool.gyro[mine].numpy(), exact.imu.gyro)
    assert pool.trusted[mine].all()


def test_the_holes_are_where_they_were_made(pool: Pool) -> None:
    t = pool.t[(pool.log == 1) & ~pool.trusted]
    inside = ((t > 1.5) & (t < 1.9)) | ((t > 4.0) & (t < 5.0))
    assert inside.all()
    assert len(t) == pytest.approx((0.4 + 1.0) * RATE_HZ, abs=4)


def test_the_held_out_part_is_the_last_fifth_of_each_log(pool: Pool) -> None:
    for i in range(3):
        t, held_out = pool.t[pool.log == i], pool.held_out[pool.log == i]
        assert torch.equal(held_out, t > (1 - HELD_OUT) * t[-1])
        assert float(held_out.float().mean()) == pytest.approx(0.2, abs=2 / len(t))


@given(n=st.integers(1, 300), hop=st.integers(1, 40), part=st.sampled_from(["train", "held_out", "all"]), ends=st.booleans())
@settings(max_examples=40, deadline=None)
def test_windows_are_exactly_those_that_cross_nothing(pool: Pool, n: int, hop: int, part: str, ends: bool) -> None:
    """Against the definition, window by window."""
    log, trusted, held_out = (value.numpy() for value in (pool.log, pool.trusted, pool.held_out))
    expected = []
    for first in range(0, len(log) - n, hop):
        inside = slice(first, first + n + 1)
        keep = len(set(log[inside])) == 1
        keep &= bool(trusted[[first, first + n]].all()) if ends else bool(trusted[inside].all())
        if part != "all":
            keep &= set(held_out[inside]) == {part == "held_out"}
        if keep:
            expected.append(first)
    assert pool.starts(n, part, hop=hop, ends_only=ends).tolist() == expected  # type: ignore[arg-type]


def test_a_window_is_its_samples_and_the_true_poses_at_its_ends(pool: Pool) -> None:
    first, n = pool.starts(40, "train", hop=97), 40
    rest = torch.arange(6.0, dtype=torch.float64).expand(len(first), 6)
    windows = pool.windows(first, n, rest)
    assert set(windows.log.tolist()) == {0, 1, 2}
    assert torch.equal(windows.segment.rest, rest)
    assert not windows.segment.t[:, 0].any()
    torch.testing.assert_close(windows.dt.sum(1), windows.segment.t[:, -1], rtol=0, atol=1e-12)
    for row in (0, len(first) // 2, len(first) - 1):
        start, end = int(first[row]), int(first[row]) + n
        assert torch.equal(windows.segment.gyro[row], pool.gyro[start : end + 1])
        assert torch.equal(windows.segment.accel[row], pool.accel[start : end + 1])
        for at, where in ((windows.R_start, start), (windows.R_end, end)):
            assert torch.equal(at[row], pool.R_wb[where])
        assert torch.equal(windows.v_end[row] - windows.v_start[row], pool.v_w[end] - pool.v_w[start])
        assert torch.equal(windows.p_end[row] - windows.p_start[row], pool.p_wb[end] - pool.p_wb[start])


def test_no_window_crosses_a_hole_in_the_samples(perfect: Make) -> None:
    """Integration would hold one rate through the hole and blame the sensor for what the body did meanwhile."""
    whole = perfect(4, duration_s=6.0)
    keep = np.ones(len(whole.imu), bool)
    keep[400:500] = False  # half a second of samples lost
    pool = Pool.of([Recording("holed", whole.imu.rows(keep), whole.truths)])
    for ends_only in (False, True):
        first = pool.starts(40, "all", ends_only=ends_only)
        windows = pool.windows(first, 40, torch.zeros(len(first), 6, dtype=torch.float64))
        assert len(first) > 500
        assert windows.dt.max() < 1.5 / RATE_HZ


def test_a_jump_of_the_clock_counts_as_an_hour_at_most(perfect: Make) -> None:
    recording = perfect(1)
    t_ns = recording.imu.t_ns
    set_ns, years_ns = int(t_ns[len(t_ns) // 2]), 50 * 365 * 86400 * 10**9
    moved = replace(
        recording,
        imu=replace(recording.imu, t_ns=np.where(t_ns < set_ns, t_ns - years_ns // 10, t_ns)),
        truths={
            k: replace(p, t_ns=np.where(p.t_ns < set_ns, p.t_ns - years_ns // 10, p.t_ns)) for k, p in recording.truths.items()
        },
    )
    pool = Pool.of([moved])
    assert MAX_GAP_S < float(pool.t[-1]) < MAX_GAP_S + recording.imu.duration_s + 1.0
    assert len(RestBiases(pool, 10.0).knots) < 2 * MAX_GAP_S / 10.0


def test_logs_of_different_rates_are_refused_with_each_rate(perfect: Make) -> None:
    said = r"different rates \(exact_1 200.0, exact_2 100.0 Hz\).*logs of one sensor at one rate. Train a model"
    with pytest.raises(DataError, match=said):
        Pool.of([perfect(1, duration_s=4.0), perfect(2, duration_s=4.0, rate_hz=100.0)])


def test_clocks_that_differ_by_a_few_per_mille_are_one_sensor(perfect: Make) -> None:
    pool = Pool.of([perfect(1, duration_s=4.0), perfect(2, duration_s=4.0, rate_hz=199.4)])
    assert 199.4 <= pool.rate_hz <= 200.0


def test_a_log_without_truth_is_refused_by_name() -> None:
    made = flight(1, duration_s=3.0)
    with pytest.raises(DataError, match=r"flight_1: no true poses; expected a pose topic"):
        Pool.of([made, Recording("flight_1", made.imu)])


def test_a_truth_of_another_time_is_refused_by_name(perfect: Make) -> None:
    made = perfect(1, duration_s=3.0)
    late = Imu(made.imu.t_ns + 10**11, made.imu.gyro, made.imu.accel)
    with pytest.raises(DataError, match="exact_1: IMU and true poses share no time"):
        Pool.of([Recording("exact_1", late, made.truths)])


def test_a_truth_without_velocity_gets_one(perfect: Make) -> None:
    made = perfect(5, duration_s=6.0)
    positions = Recording("p", made.imu, {"/p": replace(made.truth, v_w=None)})
    derived, exact = Pool.of([positions]), Pool.of([made])
    # Savitzky-Golay of exact positions over 0.2 s: what is left is the motion's fifth derivative, 5 mm/s of 3 m/s
    assert (derived.v_w - exact.v_w).norm(dim=1).max() < 0.05
    assert (derived.v_w - exact.v_w).norm(dim=1).median() < 5e-3


def test_single_precision_is_for_those_who_ask(perfect: Make) -> None:
    pool = Pool.of([perfect(1, duration_s=3.0)], dtype=torch.float32)
    assert {value.dtype for value in (pool.t, pool.gyro, pool.R_wb)} == {torch.float32}
