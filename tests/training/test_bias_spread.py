"""Priors from few logs: logs of one switching-on are one draw of the turn-on bias."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.switchings_on import Switchings, log

from imutool.bias import static
from imutool.bias_start.bias_at_rest import rest_differences
from imutool.bias_start.initial_bias import AT_REST_STD
from imutool.bias_start.prior_width import USUAL_WALK
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import ACCEL
from imutool.training.bias_spread import MAX_TAIL, TURN_ON_STD, USUAL_STD, shift_at_rest, turn_on_prior
from imutool.training.run import train
from imutool.training.settings import TrainSettings

HOUR_NS = 3600 * 10**9
USUAL = np.array([USUAL_STD["gyro"]] * 3 + [USUAL_STD["accel"]] * 3)


def spans(*hours: float) -> list[tuple[int, int]]:
    """Logs of a minute that begin at some hours."""
    return [(round(hour * HOUR_NS), round(hour * HOUR_NS) + 60 * 10**9) for hour in hours]


def biases(*means: float, seed: int = 0) -> np.ndarray:
    return np.array(means)[:, None] + 1e-4 * np.random.default_rng(seed).normal(size=(len(means), 6))


def test_six_logs_of_one_switching_on_say_little_of_the_next_one() -> None:
    rest = biases(*[0.01] * 6)
    mean, std, min_std, sessions = turn_on_prior(rest, spans(*np.arange(6) / 4))
    assert (std[:3] > TURN_ON_STD["gyro"]).all()
    assert (min_std < USUAL).all(), "unless the sensor repeats its bias"
    np.testing.assert_allclose(mean, rest.mean(axis=0))
    (session,) = sessions
    assert (session.std < USUAL).all(), "the next log of the same day is like them"
    assert (session.start_ns, session.end_ns) == (0, spans(1.25)[0][1])


def test_sessions_are_hours_apart_or_have_other_biases() -> None:
    rest = biases(0.01, 0.01, 0.011, 0.03, 0.0, 0.0)
    _, std, _, sessions = turn_on_prior(rest[[3, 0, 1, 2, 4, 5]], [spans(20.0, 0.0, 1.0, 2.0, 3.0, 50.0)[k] for k in range(6)])
    assert [round(float(s.mean[0]), 2) for s in sessions] == [0.01, 0.0, 0.03, 0.0]
    draws = np.array([0.01, 0.0, 0.03, 0.0])
    between = (((draws - draws.mean()) ** 2).sum() + TURN_ON_STD["gyro"] ** 2) / 4 * 1.25
    np.testing.assert_allclose(std[0], np.sqrt(between), rtol=0.03)


def test_logs_that_follow_closely_and_differ_say_nothing_of_the_next_one() -> None:
    _, std, _, sessions = turn_on_prior(biases(0.01, 0.02, 0.014, 0.006), spans(0.0, 1.0, 2.0, 3.0))
    assert sessions == []
    assert (std > TURN_ON_STD["gyro"]).all()


def test_a_sensor_without_bias_gets_none_by_a_new_switching_on() -> None:
    """A fibre-optic gyro: with the width of other sensors gravity in motion gave it a bias of 1e-3 rad/s."""
    rest = np.concatenate([1e-3 * biases(0.01, 0.01), biases(0.05, 0.05)], axis=1)[:, [0, 1, 2, 6, 7, 8]]
    std = turn_on_prior(rest, spans(0.0, 1.0)).std
    assert (std[:3] < 5e-4).all()
    assert (std[3:] > TURN_ON_STD["accel"]).all()


def test_one_log_is_a_session_of_its_own() -> None:
    _, std, _, (session,) = turn_on_prior(biases(0.01), spans(0.0))
    np.testing.assert_allclose(std[:3], np.sqrt(2 * TURN_ON_STD["gyro"] ** 2 + MAX_TAIL * USUAL[0] ** 2))
    np.testing.assert_allclose(session.std, np.sqrt(2 * MAX_TAIL) * USUAL)


def test_the_next_log_of_a_session_lies_within_its_prior_however_few_its_logs() -> None:
    rng = np.random.default_rng(3)
    for count in (3, 4, 8):
        deviations = []
        for _ in range(400):
            rest = np.repeat([0.5, 2.0], 3) * USUAL * rng.normal(size=(count + 1, 6))
            *_, (session,) = turn_on_prior(rest[:-1], spans(*np.arange(count) / 4))
            deviations.append((rest[-1] - session.mean) / session.std)
        outside = (np.abs(deviations) > 1.96).reshape(-1, 2, 3).mean(axis=(0, 2))
        assert (outside < 0.08).all(), f"{count} logs: {outside} of 0.05; with the variance of the logs alone 0.09 and more"
        assert outside[1] > 0.03, f"{count} logs: wider than a sensor that is as noisy asks for"


def test_a_shift_at_rest_has_to_be_shown_by_the_logs_together() -> None:
    std = np.full((6, 6), 1e-3)
    noise = std[0, 0] * np.random.default_rng(1).normal(size=(6, 6))
    stops = [noise[log : log + 1] for log in range(6)]
    np.testing.assert_array_equal(shift_at_rest(stops, std), AT_REST_STD)
    shifted = [rows + np.array([5e-3, 0.0, 0.0, 0.0, 0.0, 0.0]) for rows in stops]
    shift = shift_at_rest(shifted, std)
    assert shift[0] > 5e-3
    np.testing.assert_array_equal(shift[3:], AT_REST_STD[3:])
    np.testing.assert_array_equal(shift_at_rest([np.zeros((0, 6))], std[:1]), AT_REST_STD)


def test_a_steady_drive_is_no_stop() -> None:
    """A straight road looks like rest; the bias in its bends made that of all stops uncertain by 3 mrad/s."""
    rng, t_s = np.random.default_rng(0), np.arange(0.0, 20.0, 0.01)
    gyro, accel = 1e-3 * rng.normal(size=(2000, 3)), np.array([0.0, 0.0, 9.81]) + 0.01 * rng.normal(size=(2000, 3))
    drives = t_s > 8.0
    gyro[drives, 2] += 0.01
    v_w = np.outer(15.0 * drives, [1.0, 0.0, 0.0])
    model, log, rest = static.Model(), [(t_s, gyro, accel)], np.zeros((1, 6))
    (stops,), (driven,) = rest_differences(model, log, rest, [v_w]), rest_differences(model, log, rest)
    np.testing.assert_allclose(stops[:, 2], 0.0, atol=2e-4)
    assert len(stops) == 1
    assert np.abs(driven[:, 2]).max() > 2e-3


@pytest.mark.parametrize(
    ("walk", "truth_noise", "minimum", "maximum"),
    [
        (1e-5, 1e-3, 3e-6, 5e-5),  # a quiet sensor
        (1e-5, 6e-3, 3e-5, 1e-4),  # poses that hide the walk: it is as usual, and their noise is none
        (2e-3, 6e-3, 1e-3, 4e-3),
    ],
)
def test_a_walk_is_found_where_the_poses_show_it(
    walk: float, truth_noise: float, minimum: float, maximum: float, tmp_path: Path
) -> None:
    kind = Switchings(truth_noise=truth_noise, walk_rad_s2_rthz=walk, rest_s=5.0, duration_s=40.0, rate_hz=50.0)
    paths = [tmp_path / f"{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(paths):
        write(log(seed, 0, kind), path)
    model = train(paths, tmp_path / "model.safetensors", method="linear", settings=TrainSettings(compare=False))
    assert (model.walk_std[:3] == model.walk_std[0]).all()
    assert minimum < model.walk_std[0] < maximum


def test_logs_too_short_for_a_walk_leave_it_as_usual_and_show_the_noise(tmp_path: Path) -> None:
    """The noise is that of a debiased message: with five sixths of it 57 % of the messages held their error, not 68 %."""
    kind = Switchings(rest_s=1.0, duration_s=7.0)
    paths = [tmp_path / f"{seed}.mcap" for seed in range(4)]
    for seed, path in enumerate(paths):
        write(log(seed, 0, kind), path)
    settings = TrainSettings(compare=False, gyro_window_s=(0.5, 1.0), accel_window_s=(0.5, 1.0))
    model = train(paths, tmp_path / "model.safetensors", method="linear", settings=settings)
    np.testing.assert_allclose(model.walk_std, USUAL_WALK, rtol=0.05)
    noise = np.sqrt(kind.rate_hz) * np.array([kind.noise_rad_s_rthz] * 3 + [ACCEL.noise_density] * 3)
    np.testing.assert_allclose(model.noise_std, noise, rtol=0.1)
