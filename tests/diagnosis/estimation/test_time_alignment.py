"""A recording against a simulation or its own truth: one clock, no noise of the simulation's, tests apart from fits."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import periodogram
from scipy.spatial.transform import Rotation
from support import planted

from imutool.converters import fetch
from imutool.diagnosis.estimation.aligned_log import Pair, split
from imutool.diagnosis.estimation.jacobians import expected
from imutool.diagnosis.estimation.time_alignment import same_motion, with_simulation, with_truth
from imutool.errors import DataError
from imutool.inertial.resampling import AS_GOOD
from imutool.inertial.wiener import wiener_filter
from imutool.recording import Poses, Recording, Scalars

KEPT = 0.01  # of a signal below a tenth of Nyquist that the filter may change
NOISE_LEFT = 0.05  # of the noise's size above the signal's band: a band that stands out by chance goes as well
MARGIN_S = 0.25  # a little less than what lies around a border
GRID_S = 0.011  # the step of the correlation that aligns two clocks
REFINED_S = 2e-4  # a fiftieth of that step; noise of both gyros scatters the lag by less
SLACK = 1.05  # over the noise: what reading a spline between samples may add
YEAR_NS = 365 * 86_400 * 1_000_000_000


def slow(t: np.ndarray, seed: int) -> np.ndarray:
    """Thirty cosines up to 5 Hz, of unit size, on a ramp."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.05, 5.0, 30), rng.uniform(0.0, 2.0 * np.pi, 30)
    return np.asarray(np.cos(2.0 * np.pi * np.outer(t, f) + phase).sum(1) / np.sqrt(15.0) + 0.1 * t)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def left(pair: Pair) -> np.ndarray:
    """Real minus expected, by column, without its mean."""
    there = pair.ideal.sample(pair.stamp_s, pair.stamp_s)
    out = pair.real - np.concatenate([there.gyro, there.accel], axis=1)
    return np.asarray(out - out.mean(axis=0))


def logs(
    *,
    sim_hz: float = 200.0,
    sim_start_ns: int = planted.START_NS,
    sim_noise: bool = True,
    with_poses: bool = False,
    late_s: float = 0.0,
    seed: int = 1,
) -> tuple[Recording, Recording]:
    """Real at 100 Hz from second 1 to 21, simulation from 0 to 24; real samples taken `late_s` later than their stamps say."""
    path = planted.moving(seed)

    def at(t_s: np.ndarray) -> np.ndarray:
        imu = path.imu(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
        return np.concatenate([imu.gyro, imu.accel], axis=1)

    t_real, t_sim = 1.0 + planted.clock(20.0), planted.clock(24.0, sim_hz)
    real = at(t_real + late_s) + planted.noise(len(t_real), 3) + planted.BIAS
    sim = at(t_sim) + (planted.noise(len(t_sim), 4) if sim_noise else 0.0)
    poses = planted.poses(path, t_sim, sim_start_ns) if with_poses else None
    return planted.recording("real", t_real, real), planted.recording("sim", t_sim, sim, sim_start_ns, poses)


# ── the filter ──


@pytest.mark.parametrize("seed", range(3))
def test_a_band_limited_signal_without_noise_passes_to_a_per_cent(seed: int) -> None:
    x = slow(planted.clock(20.0), seed)
    assert rms(wiener_filter(x[:, None], 100.0)[:, 0] - x) < KEPT * rms(x)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [0.03, 0.1])
def test_white_noise_above_the_signals_band_is_taken_away(seed: int, size: float) -> None:
    t = planted.clock(40.0)
    x = slow(t, seed)
    noise = size * np.random.default_rng([seed, 1]).normal(size=len(t))
    error = wiener_filter((x + noise)[:, None], 100.0)[:, 0] - x
    above = np.fft.rfftfreq(len(t), 0.01) > 8.0
    window = np.hanning(len(t))
    passed = rms(np.abs(np.fft.rfft(window * error)[above])) / rms(np.abs(np.fft.rfft(window * noise)[above]))
    assert passed < NOISE_LEFT
    # what no filter can take is the noise in the signal's own band, a tenth of its power: 0.32 of its size
    assert rms(error) < 0.45 * size + KEPT * rms(x)


def test_white_noise_alone_goes_almost_altogether() -> None:
    noise = np.random.default_rng(0).normal(size=4000)
    assert rms(wiener_filter(noise[:, None], 100.0)) < 0.05


# ── against a simulation ──


@pytest.mark.parametrize("sim_hz", [100.0, 137.0, 200.0, 400.0])
def test_rates_that_differ_leave_nothing_but_noise(sim_hz: float) -> None:
    (pair,) = with_simulation(*logs(sim_hz=sim_hz, sim_noise=False))
    assert (left(pair).std(axis=0) < SLACK * planted.NOISE).all()


def test_noise_of_the_simulation_does_not_add_to_that_of_the_recording() -> None:
    real, sim = logs()
    (pair,) = with_simulation(real, sim)
    assert (left(pair).std(axis=0) < 1.15 * planted.NOISE).all()  # of equal noise, plain samples leave 1.41
    assert (np.abs(pair.sim_noise / planted.NOISE - 1.0) < 0.3).all()  # a calm estimate: it finds five sixths


def test_poses_of_the_simulation_stand_in_for_its_samples_and_bring_the_attitude() -> None:
    (pair,) = with_simulation(*logs(with_poses=True))
    path = planted.moving()
    exact = path.imu(path.start_ns + np.round((pair.stamp_s + 1.0) * 1e9).astype(np.int64))
    there = pair.ideal.sample(pair.stamp_s, pair.stamp_s)
    inner = slice(50, -50)  # splines through poses know less at their ends
    assert np.abs(there.gyro - exact.gyro)[inner].max() < planted.NOISE[0] / 10.0
    assert np.abs(there.accel - exact.accel)[inner].max() < planted.NOISE[3] / 3.0
    assert pair.ideal.R_wb is not None
    assert not pair.sim_noise.any()  # nothing had to be filtered


def test_rounding_errors_of_the_simulations_poses_are_no_motion() -> None:
    """Two derivatives make millimetres per second squared of a tenth of a micrometre: a mount that rings takes them away."""
    real, sim = logs(with_poses=True)
    poses = sim.truth.rows(slice(None, None, 2))  # at 100 Hz
    error_m = 1e-7 * np.random.default_rng(0).normal(size=poses.p_wb.shape)
    rounded = replace(sim, truths={"/ground_truth/pose": replace(poses, p_wb=poses.p_wb + error_m)})
    (pair,) = with_simulation(real, rounded)
    assert not pair.sim_noise.any()  # the poses
    f_hz, power = periodogram(pair.ideal.accel, pair.ideal.rate_hz, "hann", axis=0)
    fast = np.sqrt(power[(f_hz > 15.0) & (f_hz < 50.0)].sum(axis=0) * f_hz[1])
    assert (fast < 1e-4).all()  # 3e-3 as they are


def test_float_stamps_of_the_simulations_poses_are_no_motion() -> None:
    """Seconds since 1970 as a float have steps of 238 ns, which second derivatives show as lines."""
    real, sim = logs(with_poses=True)
    poses = sim.truth.rows(slice(None, None, 2))  # at 100 Hz
    p_wb = poses.p_wb + np.outer(planted.clock(24.0), [20.0, 0.0, 0.0])  # fast, so that the lines are loud
    moved = [replace(poses, p_wb=p_wb, t_ns=t_ns) for t_ns in (poses.t_ns, poses.t_ns // 256 * 256)]
    pairs = [with_simulation(real, replace(sim, truths={"/ground_truth/pose": one}))[0] for one in moved]
    assert not any(pair.sim_noise.any() for pair in pairs)  # the poses
    even, rounded = (pair.ideal.sample(pair.stamp_s, pair.stamp_s).accel[50:-50] for pair in pairs)
    assert rms(even - rounded) < 1e-4


def test_a_spline_through_a_slow_simulation_is_exact_for_the_noise_of_a_fast_recording() -> None:
    """Motion at a fifth of the simulation's rate: a cubic spline loses 0.4 % of it, as a filter does."""
    t_s, sim_s = np.arange(8000) / 400.0, np.arange(2001) / 100.0

    def turn(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = sum(np.sin(2.0 * np.pi * f * t + f) / (f * 20.0) for f in (1.3, 7.1, 19.7))
        rate = sum(2.0 * np.pi * np.cos(2.0 * np.pi * f * t + f) / 20.0 for f in (1.3, 7.1, 19.7))
        return np.outer(angle, [0.0, 0.0, 1.0]), np.outer(rate, [0.0, 0.0, 1.0])

    def samples(t: np.ndarray) -> np.ndarray:
        return np.concatenate([turn(t)[1], np.tile([0.0, 0.0, 9.81], (len(t), 1))], axis=1)

    noise = np.random.default_rng(0).normal(size=(len(t_s), 6)) * [2e-3] * 6
    t_ns = planted.START_NS + np.round(sim_s * 1e9).astype(np.int64)
    q_wb_wxyz = np.ascontiguousarray(Rotation.from_rotvec(turn(sim_s)[0]).as_quat(scalar_first=True))
    poses = Poses(t_ns, np.zeros((len(sim_s), 3)), q_wb_wxyz)
    real = planted.recording("real", t_s, samples(t_s) + noise)
    (pair,) = with_simulation(real, planted.recording("sim", sim_s, samples(sim_s), poses=poses))
    off = pair.ideal.sample(pair.stamp_s, pair.stamp_s).gyro - samples(pair.stamp_s)[:, :3]
    squares = float((off[400:-400] ** 2).sum()) / 2e-3**2
    assert squares < 2.0 * AS_GOOD**2
    f_hz, power = periodogram(pair.ideal.gyro[:, 2], pair.ideal.rate_hz, "hann")
    assert pair.ideal.rate_hz > 150.0
    assert power[f_hz > 55.0].sum() < 1e-8 * power.sum()  # a spline between poses has images of the motion there


def test_poses_do_not_stand_in_for_impacts_that_they_are_too_slow_to_hold() -> None:
    real, sim = logs(with_poses=True)
    t_s, at_s, width_s = planted.clock(24.0, 200.0), np.arange(1.0, 23.0, 0.37), 0.003
    u = (t_s[:, None] - at_s) / width_s
    bump = 1e-4 * np.exp(-0.5 * u**2)
    poses, _ = sim.truth.at(sim.imu.t_ns)
    up = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    felt = sim.imu.accel + up * ((u**2 - 1.0) * bump / width_s**2).sum(axis=1)[:, None]
    moved = replace(sim.truth, p_wb=sim.truth.p_wb + np.outer(bump.sum(axis=1), [0.0, 0.0, 1.0]))
    (pair,) = with_simulation(real, replace(sim, imu=replace(sim.imu, accel=felt), truths={"/ground_truth/pose": moved}))
    assert pair.sim_noise.any()  # the samples


def test_poses_that_disagree_with_the_simulations_samples_do_not_stand_in_for_them() -> None:
    real, sim = logs(with_poses=True)
    other = planted.poses(planted.moving(9), planted.clock(24.0, 200.0))
    (pair,) = with_simulation(real, replace(sim, truths={"/ground_truth/pose": other}))
    assert (left(pair).std(axis=0) < 1.15 * planted.NOISE).all()


def test_poses_that_stand_in_have_the_simulators_own_gravity() -> None:
    """9.79 m/s²: with another, every scale of an accelerometer would be three thousandths off."""
    real, sim = logs(with_poses=True)
    poses, _ = sim.truth.at(sim.imu.t_ns)
    up = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    (pair,) = with_simulation(real, replace(sim, imu=replace(sim.imu, accel=sim.imu.accel - 0.02 * up)))
    assert not pair.sim_noise.any()  # the poses
    (before,) = with_simulation(real, sim)
    inner, R_wb = slice(50, -50), pair.ideal.R_wb
    assert R_wb is not None
    less = np.einsum("nij,nj->ni", R_wb, pair.ideal.accel - before.ideal.accel)[inner]
    np.testing.assert_allclose(less, np.broadcast_to([0.0, 0.0, -0.02], less.shape), atol=1e-3)  # noise over 24 s
    (exact,) = with_simulation(*logs(with_poses=True, sim_noise=False))
    off = np.einsum("nij,nj->ni", R_wb, before.ideal.accel - exact.ideal.accel)[inner].mean(axis=0)
    assert (np.abs(off) < 1e-5).all()  # noise is no other gravity


def test_poses_do_not_stand_in_for_samples_with_a_vibration_that_poses_do_not_show() -> None:
    """The noise that a calm second difference finds has this line in it."""
    real, sim = logs(with_poses=True)
    line = np.outer(np.sin(2.0 * np.pi * 70.0 * planted.clock(24.0, 200.0)), [0.02, 0.01, 0.0])
    (pair,) = with_simulation(real, replace(sim, imu=replace(sim.imu, gyro=sim.imu.gyro + line)))
    f_hz, power = periodogram(pair.ideal.gyro, pair.ideal.rate_hz, "hann", axis=0)
    close = np.abs(f_hz - 70.0) < 0.2
    np.testing.assert_allclose(2.0 * power[close].sum(axis=0) * f_hz[1], [0.02**2, 0.01**2, 0.0], rtol=0.05, atol=1e-6)


def test_clocks_of_one_epoch_are_left_alone_so_that_an_offset_between_them_shows() -> None:
    (pair,) = with_simulation(*logs(late_s=0.02))
    assert pair.aligned_s == 0.0
    there = pair.ideal.sample(pair.stamp_s, pair.stamp_s)
    rate = there.alpha[:, 0]
    assert float(rate @ left(pair)[:, 0] / (rate @ rate)) == pytest.approx(0.02, rel=0.1)  # first order of 20 ms
    (later,) = with_simulation(*logs(late_s=0.2))  # the search finds this, too
    assert later.aligned_s == 0.0


@pytest.mark.parametrize("away_ns", [0, YEAR_NS])
def test_at_rest_a_bias_that_drifts_is_no_motion(away_ns: int) -> None:
    t_s = planted.clock()
    rest, warm = (
        np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (len(t_s), 1)),
        np.outer(1.0 - np.exp(-t_s / 8.0), [0.02, 0, 0, 0, 0.2, 0]),
    )
    sim = planted.recording("sim", t_s, rest, planted.START_NS + away_ns)
    (pair,) = with_simulation(planted.recording("real", t_s, rest + warm + planted.noise(len(t_s), 2)), sim)
    assert pair.aligned_s == pytest.approx(away_ns * 1e-9)
    assert not same_motion(planted.recording("real", t_s, rest + 10.0 * warm).imu, sim.imu)


def test_beside_a_dead_gyro_the_accelerometer_shows_the_motion() -> None:
    real, sim = logs(sim_start_ns=planted.START_NS + YEAR_NS)
    (pair,) = with_simulation(replace(real, imu=replace(real.imu, gyro=np.zeros_like(real.imu.gyro))), sim)
    assert pair.aligned_s - YEAR_NS * 1e-9 == pytest.approx(0.0, abs=GRID_S)


@pytest.mark.parametrize("away_ns", [YEAR_NS, -YEAR_NS, 3_600_000_000_000, 700_000_000, -1_500_000_000, 4_900_000_000])
def test_clocks_without_a_common_epoch_are_aligned_by_the_motion(away_ns: int) -> None:
    (pair,) = with_simulation(*logs(sim_start_ns=planted.START_NS + away_ns))
    assert pair.aligned_s - away_ns * 1e-9 == pytest.approx(0.0, abs=GRID_S)
    (same,) = with_simulation(*logs())
    ratio = left(pair)[:, :3].std(axis=0) / same.real[:, :3].std(axis=0)
    assert (ratio < 0.05).all()  # ten milliseconds of a motion at a hertz


@pytest.mark.parametrize("off_ns", [3_700_000, -4_900_000])
def test_clocks_without_a_common_epoch_are_aligned_below_the_step_of_the_correlation(off_ns: int) -> None:
    (pair,) = with_simulation(*logs(sim_start_ns=planted.START_NS + YEAR_NS + off_ns))
    assert pair.aligned_s - (YEAR_NS + off_ns) * 1e-9 == pytest.approx(0.0, abs=REFINED_S)


def test_a_clock_that_begins_at_zero_keeps_the_samples_of_a_simulation_where_they_are() -> None:
    """Seconds of a float since 1970 are known to a quarter of a microsecond: an even clock of a rate by them drifts away."""
    real, sim = logs(sim_hz=1000.0, sim_start_ns=0)
    (pair,) = with_simulation(real, sim)
    assert len(pair.ideal.t_s) == len(sim.imu.t_ns)


def test_clocks_aligned_by_the_motion_leave_the_same_misfit_but_for_the_step_of_the_search() -> None:
    (pair,) = with_simulation(*logs(sim_start_ns=planted.START_NS + YEAR_NS, with_poses=True))
    there = pair.ideal.sample(pair.stamp_s, pair.stamp_s)
    offset = float((there.alpha * left(pair)[:, :3]).sum() / (there.alpha**2).sum())
    assert abs(offset) < GRID_S / 2.0


@pytest.mark.parametrize("away_ns", [0, YEAR_NS])
def test_another_motion_is_refused(away_ns: int) -> None:
    real, _ = logs()
    _, sim = logs(seed=5, sim_start_ns=planted.START_NS + away_ns)
    with pytest.raises(DataError, match="turn differently"):
        with_simulation(real, sim)


def test_a_long_recording_has_no_piece_that_is_like_another_motion() -> None:
    """Of ten thousand lags some piece is alike by chance, the shorter the better."""
    long = [planted.moving(seed, 90.0) for seed in range(6)]
    t_s = planted.clock(90.0)
    at = [planted.START_NS + k * YEAR_NS + np.round(t_s * 1e9).astype(np.int64) for k in range(2)]
    for first, second in combinations(long, 2):
        real, sim = (
            replace(path.imu(path.start_ns + t_ns - t_ns[0]), t_ns=t_ns) for path, t_ns in zip((first, second), at, strict=True)
        )
        assert not same_motion(real, sim)


@pytest.mark.parametrize("name", ["01_square", "06_right_turn", "07_left_turn"])
def test_real_recordings_of_one_robot_are_not_one_motion(data: Path, name: str) -> None:
    """Drives of one kind: a norm of the rates alone correlated up to 0.8 in some piece of them."""
    (one,), (other,) = (fetch.read(data / "fetch" / folder) for folder in (name, "03_um"))
    assert not same_motion(one.imu, other.imu)


def test_too_little_shared_time_is_refused_with_how_much_there_is() -> None:
    real, sim = logs()
    short = replace(real, imu=real.imu.rows(slice(0, 601)))
    with pytest.raises(DataError, match=r"^real: 6\.0 s shared with the simulation"):
        with_simulation(short, sim)


def test_too_little_shared_time_is_refused() -> None:
    real, sim = logs()
    with pytest.raises(DataError):
        with_simulation(replace(real, imu=real.imu.rows(slice(0, 601))), sim)


def test_a_part_of_the_motion_on_another_epoch_is_found_in_the_whole() -> None:
    real, sim = logs(sim_start_ns=planted.START_NS + YEAR_NS)
    (pair,) = with_simulation(replace(real, imu=real.imu.rows(slice(400, 1301))), sim)  # nine seconds
    assert pair.aligned_s - YEAR_NS * 1e-9 == pytest.approx(0.0, abs=GRID_S)


def test_only_what_both_cover_is_compared() -> None:
    real, sim = logs()
    part = replace(sim, imu=sim.imu.rows(slice(5 * 200, 17 * 200 + 1)))  # 5 to 17 s
    (pair,) = with_simulation(real, part)
    assert pair.start_ns - planted.START_NS == pytest.approx(5e9, abs=1.1e7)
    assert pair.stamp_s[-1] - pair.stamp_s[0] == pytest.approx(12.0, abs=0.03)
    assert len(pair.real) == len(pair.fitted) == len(pair.held_out) == len(pair.stamp_s)


def test_channels_come_along_at_the_samples_and_constant_ones_do_not() -> None:
    real, sim = logs()
    t_ns = planted.START_NS + np.arange(0, 24_000_000_001, 50_000_000)
    ramp = np.linspace(0.0, 24.0, len(t_ns))
    scalars = {
        "/motor/current": Scalars(t_ns, ramp[:, None]),
        "/wheel": Scalars(t_ns, np.stack([ramp, ramp * 0.0 + 3.0, -ramp], axis=1)),
    }
    (pair,) = with_simulation(replace(real, scalars=scalars), sim)
    assert set(pair.channels) == {"/motor/current", "/wheel.x", "/wheel.z"}
    np.testing.assert_allclose(pair.channels["/motor/current"], pair.stamp_s + 1.0, atol=1e-6)
    np.testing.assert_allclose(pair.ideal.channels["/wheel.z"], -(pair.ideal.t_s + 1.0).clip(0.0, 24.0), atol=1e-6)


def test_without_a_simulation_the_motion_itself_is_expected() -> None:
    real, _ = logs()
    felt = planted.rich()
    pair = with_truth(real, replace(felt, t_s=felt.t_s - 1e-9 * (real.imu.t_ns[0] - planted.START_NS)), 12.0)
    assert (left(pair).std(axis=0) < SLACK * planted.NOISE).all()
    assert pair.band_hz == 12.0
    assert pair.aligned_s == 0.0


def test_true_poses_of_another_time_are_refused() -> None:
    (real, _), felt = logs(), planted.rich()
    with pytest.raises(DataError, match="shared with the true poses"):
        with_truth(real, replace(felt, t_s=felt.t_s + 1e-9 * YEAR_NS), 12.0)


# ── what is fitted and what is held out ──


@pytest.mark.parametrize("duration_s", [12.0, 20.0, 31.0, 90.0, 300.0])
def test_about_a_third_is_held_out_and_apart_from_what_is_fitted(duration_s: float) -> None:
    t = planted.clock(duration_s)
    held_out, usable = split(t)
    fitted, unseen = usable & ~held_out, usable & held_out
    assert 0.2 < unseen.sum() / usable.sum() < 0.45
    assert usable.mean() > 0.6
    times = np.concatenate([t[fitted], t[unseen]])
    kinds = np.concatenate([np.zeros(fitted.sum()), np.ones(unseen.sum())])
    order = np.argsort(times)
    border = np.diff(kinds[order]) != 0
    assert border.sum() >= 2
    assert np.diff(times[order])[border].min() > 2.0 * MARGIN_S  # neither looks over it


def test_gaps_and_ends_count_for_neither() -> None:
    t = planted.clock(40.0)
    keep = (t < 14.0) | (t > 15.5)
    t = t[keep]
    _, usable = split(t)
    near = (np.abs(t - 14.0) < MARGIN_S) | (np.abs(t - 15.5) < MARGIN_S) | (t < MARGIN_S) | (t > t[-1] - MARGIN_S)
    assert near.sum() > 80
    assert not usable[near].any()


def test_every_row_counts_for_one_part_at_most() -> None:
    (pair,) = with_simulation(*logs())
    assert not (pair.fitted & pair.held_out).any()
    assert pair.fitted.any()
    assert pair.held_out.any()


def test_a_simulation_with_a_hole_is_compared_stretch_by_stretch() -> None:
    """Interpolated over a hole it would read what it never did."""
    real, sim = logs()
    t_s = (sim.imu.t_ns - sim.imu.t_ns[0]) * 1e-9
    whole, middle = float(t_s[-1]), 0.5 * float(t_s[-1])
    with_hole = replace(sim, imu=sim.imu.rows((t_s < middle - 0.5) | (t_s > middle + 0.5)))
    first, second = with_simulation(real, with_hole)
    (one,) = with_simulation(real, sim)
    assert second.stamp_s[0] - first.stamp_s[-1] == pytest.approx(1.0, abs=0.05)
    for pair in (first, second):
        rows = np.searchsorted(one.stamp_s, pair.stamp_s)
        amid = slice(200, -200)  # the filter of its noise reaches so far
        assert np.abs((expected(pair, ()) - expected(one, ())[rows])[amid]).max() < SLACK * planted.NOISE.max()
    short = replace(sim, imu=sim.imu.rows((t_s < 0.9 * whole) | (t_s > 0.95 * whole)))
    assert len(with_simulation(real, short)) == 1, "what is left after the second hole is too short to be judged"


def test_a_slow_simulation_is_no_row_of_holes() -> None:
    real, sim = logs()
    slow = replace(sim, imu=sim.imu.rows(slice(0, None, 50)))
    assert len(with_simulation(real, slow)) == 1
