"""Increments of exact motions miss what a planted error makes them miss; what has no truth in it does not count."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from imutool.bias.conv import Config as ConvConfig
from imutool.bias.networks import linear, static
from imutool.bias.networks.conv import Network
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.errors import ConfigError, DataError, NumericsError
from imutool.geometry import so3
from imutool.recording import Imu, Recording
from imutool.sensor.made_up_flight import flight
from imutool.training import checkpoint
from imutool.training.fit import Training, TrainSettings
from imutool.training.objectives.increments import IncrementObjective, products
from imutool.training.objectives.objective import RestBiases, orientation_error
from imutool.training.settings import IncrementSettings, settings_for, settings_of
from imutool.training.training_windows import Pool, corrected

Make = Callable[..., Recording]
PERIOD_S = 0.005
LENGTHS = (5, 16, 32)
CHOSEN = TrainSettings(increments=IncrementSettings(gyro_samples=LENGTHS, accel_samples=LENGTHS, stretch_s=1.0))
# The rule's second order over 160 ms for exact samples and poses of at most 6 rad/s² and 30 m/s³.
RULE = {"gyro": 3e-5, "accel": 3e-4}
OFFSET = {"gyro": [0.01, -0.02, 0.02], "accel": [0.1, -0.2, 0.2]}  # length 0.03 rad/s and 0.3 m/s²
SMALL = {"channels": [8, 16], "dilations": [1, 4], "kernel": 5}


def objective(
    recordings: list[Recording], sensor: str, rest: list[float] | None = None, model: BiasNetwork | None = None
) -> IncrementObjective:
    pool = Pool.of(recordings)
    tracks = RestBiases(pool, 20.0)
    for name, columns in (("gyro", slice(0, 3)), ("accel", slice(3, 6))):
        tracks.set(name, torch.tensor(rest or [0.0] * 6, dtype=torch.float64)[columns].expand(len(recordings), 3))  # type: ignore[arg-type]
    return IncrementObjective(model or static.Network().double(), sensor, pool, tracks, CHOSEN)  # type: ignore[arg-type]


# ── the errors ───────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 16, 21, 32, 40])
def test_products_by_doubling_are_products_one_by_one(n: int) -> None:
    steps = so3.exp(0.3 * torch.randn(2, 40, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64))
    found = products(steps, n)
    assert found.shape == (2, 40 - n + 1, 3, 3)
    for k in (0, (40 - n) // 2, 40 - n):
        expected = torch.eye(3, dtype=torch.float64)
        for step in range(k, k + n):
            expected = expected @ steps[:, step]
        torch.testing.assert_close(found[:, k], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_an_exact_sensor_has_no_error(perfect: Make, sensor: str) -> None:
    asked = objective([perfect(1, duration_s=8.0, still_s=0.5)], sensor)
    for n, (size, _) in asked.errors(asked.first[::200]).items():
        assert len(size) > 1000, n
        assert size.max() < RULE[sensor]


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_constant_moves_an_increment_by_itself_times_its_time(perfect: Make, sensor: str) -> None:
    """Rotations: what turning meanwhile takes back is of second order. Velocities: the attitude is the true one."""
    rest = [*OFFSET["gyro"], *[0.0] * 3] if sensor == "gyro" else [*[0.0] * 3, *OFFSET["accel"]]
    asked = objective([perfect(1, duration_s=8.0, still_s=0.5)], sensor, rest)
    size_of_offset = float(np.linalg.norm(OFFSET[sensor]))
    for n, (size, _) in asked.errors(asked.first[::200]).items():
        expected = size_of_offset * n * PERIOD_S
        assert float(size.detach().median()) == pytest.approx(expected, rel=0.03)
        assert size.max() <= expected + RULE[sensor]


def test_the_rotation_error_is_that_of_the_window_it_is(perfect: Make) -> None:
    """The same windows one by one (`loss.orientation_error`), with a bias that makes every one differ."""
    asked = objective([perfect(2, duration_s=8.0)], "gyro", [0.3, -0.2, 0.5, 0.0, 0.0, 0.0])
    first, n = asked.first[500:501], 16
    rest = torch.tensor([[0.3, -0.2, 0.5, 0.0, 0.0, 0.0]], dtype=torch.float64)
    size = asked.errors(first)[n].size
    starts = first + torch.arange(len(size))
    expected = orientation_error(static.Network().double(), asked.pool.windows(starts, n, rest.expand(len(size), 6)))
    torch.testing.assert_close(size, expected, rtol=0, atol=1e-9)


# ── what counts ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_what_counts_are_all_the_windows_of_the_training_part_and_no_others(perfect: Make, without_truth: Make) -> None:
    """A stretch from every sample: each increment is met once for every stretch that holds it."""
    holed = without_truth(perfect(3, duration_s=8.0), 3.0, 3.5)
    asked = objective([holed, perfect(4, duration_s=8.0)], "gyro")
    for n in LENGTHS:
        starts = set(asked.pool.starts(n, "train").tolist())
        met = {int(s) for s in torch.nonzero(asked.whole[n])[:, 0]}
        assert met == starts
        stretch = asked.stretch
        for first in (int(asked.first[0]), int(asked.first[len(asked.first) // 2]), int(asked.first[-1])):
            size, log = asked.errors(torch.tensor([first]))[n]
            log_end = int(torch.nonzero(asked.pool.log == asked.pool.log[first])[-1])
            expected = [k for k in starts if first <= k <= first + stretch - n and k + n <= log_end]
            assert len(size) == len(expected)
            assert set(log.tolist()) <= {int(asked.pool.log[first])}
    gone = (asked.pool.t > 3.1) & (asked.pool.t < 3.4) & (asked.pool.log == 0)
    assert gone.any()
    assert not (asked.whole[5] & gone).any()


def test_lengths_that_no_truth_holds_are_left_out_and_if_all_are_it_is_said(perfect: Make, without_truth: Make) -> None:
    """The only stretch of 120 samples lies where no stretch of the sampling by stride begins."""
    recording = perfect(3, duration_s=8.0)
    for k in range(8):
        if k != 5:
            recording = without_truth(recording, k + 0.4, k + 0.55)
    pool = Pool.of([recording])
    chosen = TrainSettings(increments=IncrementSettings(gyro_samples=(16, 120, 4000), stretch_s=0.7))
    asked = IncrementObjective(static.Network().double(), "gyro", pool, RestBiases(pool, 20.0), chosen)
    assert asked.lengths == [16, 120]
    assert set(asked.loss.medians) == {16, 120}
    far = TrainSettings(increments=IncrementSettings(gyro_samples=(4000,)))
    with pytest.raises(DataError, match=r"for the gyro: no increment of 4000 samples.*setting increments.gyro_samples"):
        IncrementObjective(static.Network().double(), "gyro", pool, RestBiases(pool, 20.0), far)


def test_no_index_leaves_its_log(perfect: Make) -> None:
    pool = Pool.of([perfect(seed, duration_s=2.0) for seed in (5, 6, 7)])
    bounds = [(int(rows.min()), int(rows.max())) for rows in (torch.nonzero(pool.log == i) for i in range(3))]
    first = torch.tensor([bounds[0][0], bounds[1][0], bounds[1][1], bounds[2][1], bounds[1][0] + 150])
    index = pool.around(first, 100, 60)
    assert index.shape == (5, 161)
    for row, begin in zip(index, first, strict=True):
        low, high = bounds[int(pool.log[begin])]
        expected = [min(max(int(begin) + k, low), high) for k in range(-100, 61)]
        assert row.tolist() == expected


# ── models that look back ────────────────────────────────────────────────────────────────────────────────────────────


def looking_back() -> Network:
    torch.manual_seed(3)
    model = Network(ConvConfig(channels=(8, 16), dilations=(1, 40), kernel=5)).double().eval()
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.1 * torch.randn_like(value))
    return model.requires_grad_(False)


def whole_log(model: BiasNetwork, pool: Pool, log: int) -> Tensor:
    """The model's answer over a log from its first sample on."""
    rows = pool.log == log
    return model(Segment(pool.t[rows][None], pool.gyro[rows][None], pool.accel[rows][None], torch.zeros(1, 6).double()))[0]


def test_a_corrected_pool_is_the_model_over_whole_logs(perfect: Make) -> None:
    model, pool = looking_back(), Pool.of([perfect(seed, duration_s=4.0) for seed in (1, 2)])
    bare, left = corrected(model, pool)
    assert bare.method == "static"
    for log in (0, 1):
        rows, bias = pool.log == log, whole_log(model, pool, log)
        torch.testing.assert_close(left.gyro[rows], pool.gyro[rows] - bias[:, :3], rtol=0, atol=1e-12)
        torch.testing.assert_close(left.accel[rows], pool.accel[rows] - bias[:, 3:], rtol=0, atol=1e-12)
    _, held_out = corrected(model, pool, "held_out", ("gyro",))
    torch.testing.assert_close(held_out.gyro[pool.held_out], left.gyro[pool.held_out], rtol=0, atol=1e-12)
    assert torch.equal(held_out.gyro[~pool.held_out], pool.gyro[~pool.held_out])
    assert torch.equal(held_out.accel, pool.accel)


def test_a_model_that_does_not_look_back_is_left_as_it_is(perfect: Make) -> None:
    model, pool = linear.Network().double(), Pool.of([perfect(1, duration_s=2.0)])
    assert corrected(model, pool) == (model, pool)


def test_a_stretch_is_shown_with_the_samples_before_it(perfect: Make) -> None:
    """The errors in a stretch in the middle of a log are those of the whole log corrected; of one at its start too."""
    recording = perfect(1, duration_s=6.0)
    model = looking_back()
    asked = objective([recording], "gyro", model=model)
    bare, left = corrected(model, asked.pool)
    plainly = objective([recording], "gyro", model=bare)
    plainly.pool = left
    for first in (asked.first[:1], asked.first[400:401]):
        for n in LENGTHS:
            torch.testing.assert_close(asked.errors(first)[n].size, plainly.errors(first)[n].size, rtol=0, atol=1e-10)


# ── settings ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_method_has_its_own_defaults_and_what_is_given_wins() -> None:
    kind = settings_of("conv")
    for name, value in Network.prefers.items():
        assert getattr(kind(), name) == value
        assert getattr(kind(), name) != getattr(TrainSettings(), name) or name == "gyro_rate"
    assert kind(steps=7).steps == 7
    assert kind().gyro_window_s == TrainSettings().gyro_window_s
    assert settings_of("linear") is settings_of("neural_ode") is TrainSettings
    assert settings_of("conv") is kind
    assert settings_for("conv", None) == kind()
    with pytest.raises(
        ConfigError, match=r"settings of type TrainSettings; expected TrainSettings_conv.*settings_of\('conv'\)"
    ):
        settings_for("conv", TrainSettings())


# ── a training ───────────────────────────────────────────────────────────────────────────────────────────────────────


def lagging(recording: Recording, tau_s: float, scale: float, seed: int) -> Recording:
    """A gyro behind a first-order low-pass, too large, with a constant and a little noise; the accelerometer stays perfect."""
    gyro, period_s = recording.imu.gyro, recording.imu.period_s
    slow, keep = np.empty_like(gyro), np.exp(-period_s / tau_s)
    slow[0] = gyro[0]
    for k in range(1, len(gyro)):
        slow[k] = keep * slow[k - 1] + (1 - keep) * gyro[k]
    rng = np.random.default_rng(seed)
    measured = (1 + scale) * slow + 0.02 * rng.normal(size=3) + 1e-3 * rng.normal(size=gyro.shape)
    return Recording(recording.name, Imu(recording.imu.t_ns, measured, recording.imu.accel), recording.truths)


@pytest.fixture(scope="module")
def trained(perfect: Make) -> dict[str, Training]:
    """conv and linear on three flights of a gyro that lags by 20 ms and is 5 % too large."""
    torch.set_num_threads(1)
    flights = [lagging(perfect(seed, duration_s=20.0), 0.02, 0.05, seed) for seed in (1, 2, 3)]
    small = {
        "steps": 150,
        "gyro_rate": 4e-2,
        "samples": 6000,
        "validate_every": 40,
        "gyro_window_s": (0.5, 2.0),
        "accel_window_s": (0.5, 1.0),
    }
    small |= {"increments": IncrementSettings(stretch_s=5.0)}
    done = {
        "conv": Training(flights, "conv", settings_of("conv")(**small, model=SMALL | {"gyro_unit_rad_s": 0.1})),
        "linear": Training(flights, "linear", TrainSettings(gyro_window_s=(0.5, 2.0), accel_window_s=(0.5, 1.0))),
    }
    for training in done.values():
        list(training.epochs())
    return done


def rate_error(model: BiasNetwork, exact: Recording, measured: Recording) -> float:
    """Root mean square of the corrected rate less the true one, its own mean taken off: what no constant mends."""
    t_s = (measured.imu.t_ns - measured.imu.t_ns[0]) * 1e-9
    bias = model.frozen().stream(np.zeros(6))(t_s, measured.imu.gyro, measured.imu.accel)[:, :3]
    left = measured.imu.gyro - bias - exact.imu.gyro
    return float(np.sqrt(((left - left.mean(axis=0)) ** 2).mean()))


def test_it_learns_to_take_back_a_lag_which_no_matrix_can(trained: dict[str, Training], perfect: Make) -> None:
    """On a flight it has not seen: half the error of the raw samples, 0.7 of that of the best matrix, and 0.75 of its drift
    where both were judged. Four seeds gave 0.32 to 0.43, 0.43 to 0.57 and 0.40 to 0.58."""
    exact = perfect(9, duration_s=20.0)
    measured = lagging(exact, 0.02, 0.05, 9)
    raw = rate_error(static.Network().double(), exact, measured)
    conv, matrix = (rate_error(trained[name].model, exact, measured) for name in ("conv", "linear"))
    assert conv < raw / 2
    assert conv < 0.7 * matrix
    assert trained["conv"].done["gyro"] < 0.75 * trained["linear"].done["gyro"]


def test_rest_biases_are_left_as_the_model_at_work_needs_them(trained: dict[str, Training]) -> None:
    """The accelerometer's stage follows the debiased gyro: with rest biases of training mode it would lean over."""
    assert trained["conv"].done["accel"] < 1.5 * trained["linear"].done["accel"]


@pytest.fixture(scope="module")
def flights() -> list[Recording]:
    return [flight(seed, duration_s=6.0, still_s=0.5) for seed in (1, 2)]


TINY = {
    "gyro_window_s": (0.25, 0.5),
    "accel_window_s": (0.25,),
    "samples": 600,
    "steps": 6,
    "validate_every": 2,
    "model": SMALL,
    "increments": IncrementSettings(stretch_s=1.0),
}


def short(recordings: list[Recording], seed: int = 0) -> Training:
    return Training(recordings, "conv", settings_of("conv")(**TINY, seed=seed))


def state(training: Training) -> dict[str, Tensor]:
    return {**training.model.state_dict(), "tracks": training.tracks.knots.detach().clone()}


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def expected(flights: list[Recording]) -> Training:
    """A training of seed 0 without incident."""
    training = short(flights)
    list(training.epochs())
    return training


def test_one_seed_gives_the_same_bits_and_another_does_not(flights: list[Recording], expected: Training) -> None:
    for seed in (0, 1):
        torch.manual_seed(99 + seed)  # whatever the state of the world
        training = short(flights, seed)
        list(training.epochs())
        assert same(state(training), state(expected)) == (seed == 0)


@pytest.mark.parametrize("lines", [2, 6])
def test_taken_up_again_it_draws_the_dropout_it_would_have_drawn(
    flights: list[Recording], expected: Training, tmp_path: Path, lines: int
) -> None:
    path = tmp_path / "c"
    first = short(flights)
    progress = first.epochs()
    for _ in range(lines):
        next(progress)
    checkpoint.save(first, path)
    torch.manual_seed(1234)
    second = short(flights)
    torch.manual_seed(4321)
    checkpoint.restore(second, path)
    list(second.epochs())
    assert same(state(second), state(expected))
    assert second.done == expected.done


def test_the_accelerometers_stage_leaves_the_gyros_part_alone(flights: list[Recording]) -> None:
    """Its weights, its batch statistics and its rest biases."""
    training = short(flights)
    kept: dict[str, Tensor] = {}
    for epoch in training.epochs():
        if epoch.sensor == "accel" and not kept:
            kept = {name: value.clone() for name, value in training.model.state_dict().items() if ".gyro" in name}
    assert kept
    assert all(torch.equal(training.model.state_dict()[name], value) for name, value in kept.items())


def test_running_statistics_are_averaged_with_the_weights(flights: list[Recording]) -> None:
    """What is judged is not the last step's batch statistics on weights of thirty steps."""
    training = short(flights)
    progress = training.epochs()
    for _ in range(3):
        next(progress)
    assert training.stage is not None
    now, mean = training.model.state_dict(), training.stage.mean.module.state_dict()
    name = "net.gyro.layers.0.mean"
    assert now[name].any()
    assert not torch.equal(now[name], mean[name])


def test_logs_of_numbers_that_overflow_are_refused(flights: list[Recording]) -> None:
    imu = flights[0].imu
    absurd = Recording("absurd", Imu(imu.t_ns, imu.gyro * 1e200, imu.accel * 1e200), flights[0].truths)
    with pytest.raises(NumericsError, match="gyro"):
        list(short([absurd]).epochs())
