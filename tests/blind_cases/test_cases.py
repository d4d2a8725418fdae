"""Blind cases: forward models against closed forms, the envelope, what logs must not reveal, the score."""

from __future__ import annotations

import ast
import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.random import default_rng
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from support.benchmarks import benchmark
from support.made_once import made_once
from support.report_schema import assert_valid

from imutool.blind_cases import ENVELOPE, FINDINGS, KEY, OPENED, REAL, SIM, catalogue, conceal, open_case, random_case
from imutool.blind_cases.catalogue import CATALOGUE, NO_LIMIT
from imutool.blind_cases.detectability import FALSE_ALARM, cramer_rao_bounds, detectability, detectable_misfit
from imutool.blind_cases.effects import ACCEL, EARTH_RAD_S, GYRO, Reading, first_order, spring_mount
from imutool.blind_cases.envelope import to_truth, unseal
from imutool.blind_cases.motion import Kinematics, smoother
from imutool.blind_cases.random_case import draw_parameters
from imutool.blind_cases.scene import POSE_RATE_HZ, RATE_HZ, SIM_SHARE, Scene, place_scene
from imutool.blind_cases.score import score
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import GRAVITY_M_S2, Poses
from imutool.sensor.made_up_flight import flight

EXACT = 1e-12  # float64 arithmetic of a few products of numbers of order one
SPLINE = 2e-4  # rad/s, m/s²: what a spline of degree 5 with knots 50 ms apart, smoothed at 8 Hz, leaves of a slow circle
HALF_MS = 1e-5  # what differences over half a millisecond leave of motions below 20 Hz
FILTER = 2e-3  # straight lines between samples 1 ms apart, for sines of some hertz
TURN_RAD_S, RADIUS_M = 0.8, 2.0
SEED = 918273645546372819
FLIGHT_S = 30.0
WHERE = Path("findings.json")

ROOT = Path(__file__).parents[2]
MAY_IMPORT = {
    "imutool.array_types",
    "imutool.errors",
    "imutool.recording",
    "imutool.noise.datasheet",
    "imutool.mcap_io",
    "imutool.report",
}


def as_json(report: msgspec.Struct) -> dict[str, Any]:
    """A report as its reader gets it."""
    values: dict[str, Any] = json.loads(msgspec.json.encode(report))
    return values


def unsealed(case: Path) -> dict[str, Any]:
    return as_json(unseal(case / ENVELOPE, case / KEY))


def opened(case: Path) -> dict[str, Any]:
    return as_json(open_case(case))


def scored(truth: dict[str, Any], findings: dict[str, Any]) -> dict[str, Any]:
    return as_json(score(to_truth(truth, WHERE), findings, WHERE))


POSES = benchmark("pose_detectability")


# ── the generator's own hand ──


def test_the_generator_shares_no_code_with_the_estimator() -> None:
    robots = [*(ROOT / "tests/support/robot_cases").glob("*.py")]
    modules = [*(ROOT / "imutool/blind_cases").glob("*.py"), *robots]
    assert len(modules) > 12
    assert len(robots) > 4
    for path in modules:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [n.name for n in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [str(node.module)]
            for name in (n for n in names if n.startswith("imutool")):
                own = name.startswith("imutool.blind_cases")
                assert own or any(name == may or name.startswith(f"{may}.") for may in MAY_IMPORT), (path.name, name)


@pytest.fixture(scope="module")
def circle() -> Poses:
    """A body that goes round a level circle, looking along it: turning about z alone."""
    t = np.arange(0.0, 40.0, 0.01)
    angle = TURN_RAD_S * t
    p = np.stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), np.ones_like(t)], axis=1)
    q = np.stack([np.cos(angle / 2), np.zeros_like(t), np.zeros_like(t), np.sin(angle / 2)], axis=1)
    return Poses((1_700_000_000 * 10**9 + np.round(t * 1e9)).astype(np.int64), p, q)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A made-up flight."""
    return place_scene(smoother(flight(3, duration_s=FLIGHT_S).truth), random_case.GRADES["bmi160"], default_rng(0), 60.0)


def test_a_circle_is_felt_as_mechanics_says(circle: Poses) -> None:
    felt = smoother(circle).motion().kinematics(np.arange(2.0, 38.0, 0.005))
    # the body's x axis points outwards: the centripetal acceleration is -w² r along it
    assert np.abs(felt.omega - [0.0, 0.0, TURN_RAD_S]).max() < SPLINE
    assert np.abs(felt.alpha).max() < 10 * SPLINE
    assert np.abs(felt.f - [-(TURN_RAD_S**2) * RADIUS_M, 0.0, GRAVITY_M_S2]).max() < SPLINE


def test_outliers_and_gaps_of_the_poses_leave_no_jerk(circle: Poses) -> None:
    p = circle.p_wb.copy()
    p[::97] += 0.5
    kept = np.ones(len(p), dtype=bool)
    kept[1500:1600] = False
    felt = smoother(replace(circle, p_wb=p).rows(kept)).motion().kinematics(np.arange(2.0, 38.0, 0.005))
    assert np.abs(felt.f - [-(TURN_RAD_S**2) * RADIUS_M, 0.0, GRAVITY_M_S2]).max() < 0.02


def test_derivatives_are_those_of_the_motion(scene: Scene) -> None:
    t, h = np.arange(1.0, 20.0, 0.1), 1e-5
    before, after = scene.kinematics(t - h), scene.kinematics(t + h)
    assert np.abs((after.omega - before.omega) / (2 * h) - scene.kinematics(t).alpha).max() < 1e-5
    turn = np.einsum("nji,njk->nik", before.R_wb, after.R_wb)
    omega = np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1)
    assert np.abs(omega / (4 * h) - scene.kinematics(t).omega).max() < 1e-5


# ── each model against its closed form ──

T = np.array([0.0, 10.0, 20.0])
OMEGA, ALPHA, F = np.array([0.3, -0.5, 2.0]), np.array([0.4, 0.1, -0.2]), np.array([1.0, -2.0, 9.0])
R_WB = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter turn about z
FELT = Kinematics(T, np.tile(OMEGA, (3, 1)), np.tile(ALPHA, (3, 1)), np.tile(F, (3, 1)), np.tile(R_WB, (3, 1, 1)))
BOTH = np.tile(np.concatenate([OMEGA, F]), (3, 1))
READING = Reading(T, BOTH, {"/imu0/temperature": np.array([25.0, 30.0, 40.0])})
NONE3 = np.zeros(3)


def _lever(r: np.ndarray) -> np.ndarray:
    return np.cross(ALPHA, r) + OMEGA * (OMEGA @ r) - r * (OMEGA @ OMEGA)


FELT_CASES = {
    "lever_arm": ([0.1, -0.2, 0.3], np.concatenate([NONE3, _lever(np.array([0.1, -0.2, 0.3]))])),
    "size_effect": (
        [0.1, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 0.3],
        np.concatenate(
            [NONE3, [_lever(np.array([0.1, 0, 0]))[0], _lever(np.array([0, -0.2, 0]))[1], _lever(np.array([0, 0, 0.3]))[2]]]
        ),
    ),
    # a world tilted by 0.1 about its x pulls towards +y (which is the body's x): up leans to -y
    "gravity": (
        [0.05, 0.1, 0.0],
        np.array([0, 0, 0, -9.86 * np.sin(0.1), 0.0, 9.86 * np.cos(0.1) - GRAVITY_M_S2]),
    ),
    "earth_rotation": ([np.pi / 6, 0.0], EARTH_RAD_S * np.array([0.0, -np.cos(np.pi / 6), 0.5, 0, 0, 0])),
}


@pytest.mark.parametrize("name", FELT_CASES)
def test_what_is_felt_in_closed_form(name: str) -> None:
    theta, expected = FELT_CASES[name]
    assert np.abs(CATALOGUE[name].act(FELT, np.array(theta)) - expected).max() < EXACT


def test_a_vibration_is_a_sine_on_each_column() -> None:
    theta = np.concatenate([[0.025], np.arange(1.0, 7.0), np.full(6, np.pi / 2)])
    added = CATALOGUE["vibration"].act(FELT, theta)
    assert np.abs(added - np.outer([1.0, 0.0, -1.0], np.arange(1.0, 7.0))).max() < 1e-9


SENSOR_CASES: dict[str, tuple[list[float], np.ndarray]] = {
    "gyro_scale": ([0.1, 0.0, -0.2], np.concatenate([[0.03, 0.0, -0.4], NONE3])),
    "gyro_scale_asymmetry": ([0.2, 0.2, -0.2], np.concatenate([[0.03, 0.05, -0.2], NONE3])),
    "gyro_misalignment": ([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], np.concatenate([[0.35, 0.89, -0.15], NONE3])),
    "gyro_g_sensitivity": ([1.0, 0, 0, 0, 1.0, 1.0, 0, 0, 0], np.concatenate([[1.0, 7.0, 0.0], NONE3])),
    "gyro_quadratic": ([1.0, 1.0, 0.1], np.concatenate([[0.09, 0.25, 0.4], NONE3])),
    "accel_scale": ([0.1, 0.1, -0.1], np.concatenate([NONE3, [0.1, -0.2, -0.9]])),
    "accel_scale_asymmetry": ([0.2, 0.2, -0.2], np.concatenate([NONE3, [0.1, 0.2, -0.9]])),
    "accel_misalignment": ([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], np.concatenate([NONE3, [1.6, 3.9, -0.7]])),
    "accel_quadratic": ([0.1, 0.1, 0.01], np.concatenate([NONE3, [0.1, 0.4, 0.81]])),
}


@pytest.mark.parametrize("name", SENSOR_CASES)
def test_what_a_sensor_adds_in_closed_form(name: str) -> None:
    theta, expected = SENSOR_CASES[name]
    assert np.abs(CATALOGUE[name].act(READING, np.array(theta)) - BOTH - expected).max() < EXACT


def test_drift_and_temperature_in_closed_form() -> None:
    drift = CATALOGUE["gyro_bias_drift"].act(READING, np.array([1.0, 0.0, -2.0, 10.0])) - BOTH
    rise = 1.0 - np.exp([0.0, -1.0, -2.0])
    assert np.abs(drift[:, GYRO] - np.outer(rise, [1.0, 0.0, -2.0])).max() < EXACT
    assert np.abs(drift[:, ACCEL]).max() == 0.0
    later = CATALOGUE["accel_bias_drift"].act(READING, np.array([0.0, 3.0, 0.0, 20.0])) - BOTH
    assert np.abs(later[:, 4] - 3.0 * (1.0 - np.exp([0.0, -0.5, -1.0]))).max() < EXACT
    warm = CATALOGUE["temperature"].act(READING, np.arange(6.0)) - BOTH
    assert np.abs(warm - np.outer([0.0, 5.0, 15.0], np.arange(6.0))).max() < 1e-10


def test_a_bias_steps_once() -> None:
    step = CATALOGUE["gyro_bias_step"].act(READING, np.array([1.0, 0.0, -2.0, 10.0])) - BOTH
    assert np.abs(step[:, GYRO] - np.outer([0.0, 1.0, 1.0], [1.0, 0.0, -2.0])).max() < EXACT
    assert np.abs(step[:, ACCEL]).max() == 0.0
    late = CATALOGUE["accel_bias_step"].act(READING, np.array([0.0, 3.0, 0.0, 15.0])) - BOTH
    assert np.abs(late[:, 4] - [0.0, 0.0, 3.0]).max() < EXACT


def test_play_drags_a_reading_behind_its_motion() -> None:
    rate = np.repeat(np.array([0.0, 0.3, 1.0, 0.8, -0.5, 0.1])[:, None], 6, axis=1)
    held = CATALOGUE["gyro_hysteresis"].act(Reading(np.arange(6.0), rate, {}), np.array([0.25]))
    assert np.abs(held[:, 0] - [0.0, 0.05, 0.75, 0.75, -0.25, -0.15]).max() < EXACT
    assert (held[:, 3:] == rate[:, 3:]).all()


def test_a_mount_turned_by_a_quarter_swaps_the_axes() -> None:
    turned = CATALOGUE["mount_rotation"].act(RATE_HZ, BOTH, np.array([0.0, 0.0, np.pi / 2]))
    assert np.abs(turned[0] - [OMEGA[1], -OMEGA[0], OMEGA[2], F[1], -F[0], F[2]]).max() < EXACT


def test_clocks_in_closed_form() -> None:
    assert CATALOGUE["clock_offset"].act(T, np.array([0.05])).tolist() == [0.05, 10.05, 20.05]
    assert np.abs(CATALOGUE["clock_skew"].act(T, np.array([1e-3])) - [0.0, 10.01, 20.02]).max() < EXACT
    assert CATALOGUE["clock_jump"].act(T, np.array([10.0, -0.25])).tolist() == [0.0, 9.75, 19.75]


def test_converters_in_closed_form() -> None:
    clipped = CATALOGUE["saturation"].act(BOTH, np.array([0.4, NO_LIMIT]))[0]
    assert clipped.tolist() == [0.3, -0.4, 0.4, 1.0, -2.0, 9.0]
    rounded = CATALOGUE["quantization"].act(BOTH, np.array([0.0, 0.75]))[0]
    assert rounded.tolist() == [*OMEGA.tolist(), 0.75, -2.25, 9.0]


def test_a_filter_has_the_gain_and_the_delay_of_its_formula() -> None:
    t = np.arange(0.0, 20.0, 1e-3)
    sine = np.sin(2 * np.pi * 4.0 * t)[:, None]
    late = first_order(sine, 1000.0, 4.0)[10_000:, 0]
    assert np.abs(late - np.sin(2 * np.pi * 4.0 * t[10_000:] - np.pi / 4) / np.sqrt(2.0)).max() < FILTER
    ramp = first_order(t[:, None], 1000.0, 4.0)[10_000:, 0]
    assert np.abs(t[10_000:] - ramp - 1.0 / (2 * np.pi * 4.0)).max() < 1e-9  # a ramp is late by the time constant
    on_mount = spring_mount(sine, 1000.0, 4.0, 0.1)[15_000:, 0]
    assert np.abs(on_mount).max() == pytest.approx(np.sqrt(1.0 + 0.2**2) / 0.2, abs=10 * FILTER)  # at resonance


def test_a_resonant_mount_passes_gravity_and_each_axis_to_its_share() -> None:
    still = np.tile(np.concatenate([OMEGA, F]), (4000, 1))
    theta = np.array([10.0, 0.1, 1.0, 0.5, 0.0])
    assert np.abs(CATALOGUE["mount_resonance"].act(1000.0, still, theta) - still).max() < 1e-9
    shaken = still + np.sin(2 * np.pi * 10.0 * np.arange(4000) / 1000.0)[:, None]
    moved = CATALOGUE["mount_resonance"].act(1000.0, shaken, theta) - shaken
    assert np.abs(moved[:, :3]).max() == 0.0
    assert np.abs(moved[:, 5]).max() == 0.0
    assert np.abs(moved[:, 4] - 0.5 * moved[:, 3]).max() < 1e-9


def test_models_act_in_the_stated_order(scene: Scene) -> None:
    acting = [(CATALOGUE["gyro_scale"], np.full(3, 0.1)), (CATALOGUE["mount_rotation"], np.array([0.0, 0.0, np.pi / 2]))]
    ideal = scene.ideal(scene.t_s)
    expected = 1.1 * np.stack([ideal[:, 1], -ideal[:, 0], ideal[:, 2]], axis=1)
    assert np.abs(scene.converter_input(acting, scene.t_s)[:, GYRO] - expected).max() < EXACT
    added = {"accel_scale": np.ones(3), "gyro_g_sensitivity": 0.1 * np.eye(3).ravel(), "gyro_bias_step": [1.0, 2.0, 3.0, -1.0]}
    acting = [*acting, *((CATALOGUE[name], np.array(theta)) for name, theta in added.items())]
    force = np.stack([ideal[:, 4], -ideal[:, 3], ideal[:, 5]], axis=1)
    expected += 0.1 * force + np.array([1.0, 2.0, 3.0])
    assert np.abs(scene.converter_input(acting, scene.t_s)[:, GYRO] - expected).max() < EXACT


def test_a_late_clock_reads_the_motion_of_that_time(scene: Scene) -> None:
    t = scene.t_s
    late = scene.converter_input([(CATALOGUE["clock_offset"], np.array([0.05]))], t)
    assert np.abs(late - scene.ideal(t + 0.05)).max() < EXACT


def test_a_late_gyro_reads_the_rate_of_before_and_leaves_the_force_alone(scene: Scene) -> None:
    late = scene.converter_input([(CATALOGUE["gyro_delay"], np.array([0.004]))], scene.t_s)
    assert np.abs(late - scene.ideal(scene.t_s - 0.004))[:, GYRO].max() < 1e-6
    assert np.abs(late - scene.ideal(scene.t_s))[:, ACCEL].max() < 1e-6


def test_filters_on_the_way_agree_with_the_slow_limit(scene: Scene) -> None:
    late = scene.converter_input([(CATALOGUE["low_pass"], np.array([100.0]))], scene.t_s)
    assert np.abs(late - scene.ideal(scene.t_s - 1.0 / (200.0 * np.pi)))[200:].max() < 0.02  # far below its cut-off: a delay


def test_a_driven_column_follows_its_channel_late(scene: Scene) -> None:
    model, theta = catalogue.driven(default_rng(5), {topic: float(v.std()) for topic, v in scene.channels.items()})
    t = scene.t_s[200:]
    added = (scene.converter_input([(model, theta)], scene.t_s) - scene.ideal(scene.t_s))[200:]
    column = int(np.argmax(np.abs(added).max(axis=0)))
    grid = scene.channels_at(scene.t_s)[model.driver]
    assert np.abs(added[:, column] - theta[0] * np.interp(t - theta[1], scene.t_s, grid)).max() < 1e-9
    assert np.abs(np.delete(added, column, axis=1)).max() == 0.0


@pytest.mark.parametrize("form", sorted(catalogue.FORMS))
def test_an_unknown_term_is_on_one_column_and_says_its_equation(scene: Scene, form: str) -> None:
    model, theta = catalogue.unknown(default_rng(1), form)
    added = scene.converter_input([(model, theta)], scene.t_s) - scene.ideal(scene.t_s)
    assert np.count_nonzero(np.abs(added).max(axis=0)) == 1
    assert model.equation.startswith(f"{model.signal}.")


# ── sizes ──


def test_what_a_test_sees_every_second_time() -> None:
    # one parameter: |z| beyond 3.2905 half of the time means z centred there
    assert detectable_misfit(1) == pytest.approx(3.2905**2, rel=1e-3)
    draws = default_rng(0).noncentral_chisquare(9, detectable_misfit(9), 200_000)
    from scipy.stats import chi2

    assert np.mean(draws > chi2.isf(FALSE_ALARM, 9)) == pytest.approx(0.5, abs=0.005)  # four standard errors


def test_the_bound_of_a_scale_is_that_of_a_straight_line(scene: Scene) -> None:
    (std,) = cramer_rao_bounds(scene, [(CATALOGUE["gyro_scale"], np.full(3, 0.01))])
    omega = scene.ideal(scene.t_s)[:, GYRO]
    sigma = scene.noise[:3] * np.hypot(1.0, SIM_SHARE)
    assert std is not None
    assert std == pytest.approx(sigma / (omega.std(axis=0) * np.sqrt(len(omega))), rel=2e-2)  # every fourth sample is looked at


def test_what_a_motion_cannot_show_has_no_bound(circle: Poses) -> None:
    planar = place_scene(smoother(circle), random_case.GRADES["bmi160"], default_rng(0), 30.0)
    turning = replace(planar, noise=np.ones(6))
    (std,) = cramer_rao_bounds(turning, [(CATALOGUE["gyro_scale"], np.full(3, 0.01))])
    assert std is not None
    assert std.min() > 1.0  # a constant turn tells a scale from a bias no more than rest does


@pytest.mark.parametrize("name", ["gyro_scale", "lever_arm", "clock_jump", "gyro_bias_step"])
def test_sizes_are_what_they_say(scene: Scene, name: str) -> None:
    seen, model = detectability(scene), CATALOGUE[name]
    ideal = scene.ideal(seen.t_s)
    theta = draw_parameters(model, default_rng(2), ideal, scene.noise, scene.duration_s)
    amounts = model.amounts
    used = theta[amounts] / model.plausible[amounts]
    assert np.sqrt(np.mean(used[used != 0.0] ** 2)) == pytest.approx(1.0)
    middle = random_case.sized(seen, model, theta, "middle")
    small = random_case.sized(seen, model, theta, "small")
    assert middle is not None
    assert small is not None
    assert middle[0][amounts] == pytest.approx(0.25 * theta[amounts])
    left, _ = seen.distinct_misfit(model, small[0])
    assert left == pytest.approx(random_case.CLEAR**2 * detectable_misfit(int(amounts.sum())), rel=0.2)
    assert small[1] < 0.25


def test_what_cannot_be_seen_is_not_drawn(scene: Scene) -> None:
    with pytest.raises(DataError, match="earth_rotation"):
        random_case.draw_effects(detectability(scene), default_rng(0), "single", "large", ["earth_rotation"])


def test_poses_without_noise_show_what_a_simulation_shows_and_noisy_ones_less(scene: Scene) -> None:
    model = CATALOGUE["lever_arm"]
    acting = [(model, np.array([0.05, -0.02, 0.03]))]
    noiseless, good, bad = (
        POSES.beside_poses(scene, size).squared_misfit(acting) for size in ((0.0, 0.0), (1e-4, 1e-4), (2e-3, 5e-3))
    )
    beside_simulation = detectability(scene).squared_misfit(acting) * (
        1.0 + SIM_SHARE**2
    )  # whose own noise the poses do not have
    assert noiseless == pytest.approx(beside_simulation, rel=1e-6)
    assert noiseless > good > 5.0 * bad


def test_power_of_poses_is_that_of_their_derivatives(scene: Scene) -> None:
    f_hz, noise, size = np.array([0.0, 5.0]), np.zeros(6), (1e-3, 2e-3)
    still, fast = POSES.pose_noise_power(f_hz, noise, size)
    omega = 2.0 * np.pi * 5.0
    assert still[:3] == pytest.approx(0.0)
    assert fast[:3] == pytest.approx(omega**2 * 4e-6 / POSE_RATE_HZ)
    assert still[3:] == pytest.approx(GRAVITY_M_S2**2 * 4e-6 / POSE_RATE_HZ)
    assert fast[3:] - still[3:] == pytest.approx(omega**4 * 1e-6 / POSE_RATE_HZ)


def test_a_case_drawn_beside_a_simulation_is_shown_by_good_poses_and_not_by_bad_ones(scene: Scene) -> None:
    what = random_case.draw_effects(detectability(scene), default_rng(0), "single", "small", ["accel_scale"])
    assert POSES.is_detectable(POSES.beside_poses(scene, (1e-6, 1e-7)), what)
    assert not POSES.is_detectable(POSES.beside_poses(scene, (5e-3, 1e-1)), what)
    assert POSES.is_detectable(POSES.beside_poses(scene, (5e-3, 1e-1)), random_case.Concealed("null", "middle"))


@pytest.mark.parametrize(("kind", "count"), [("pair", 2), ("uncalibrated", random_case.MANY)])
def test_several_effects_are_different_things(scene: Scene, kind: random_case.Kind, count: int) -> None:
    seen = detectability(scene)
    for seed in range(5):
        names = {model.name for model, _ in random_case.draw_effects(seen, default_rng(seed), kind, "large").acting}
        assert len(names) == count
        assert all(len(names & row) <= 1 for row in random_case.ALIKE)
        assert kind == "pair" or names <= {*random_case.UNCALIBRATED}


# ── the seal ──


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trajectory") / "flight.mcap"
    write(flight(3, duration_s=FLIGHT_S), path)
    return path


CASES: list[dict[str, Any]] = [
    *({"kind": kind, "size": "large"} for kind in ("null", "pair", "driven", "unknown", "any")),
    *(
        {"kind": "single", "size": "large", "effects": [name]}
        for name in ("gyro_scale", "lever_arm", "quantization", "saturation", "clock_skew", "temperature", "vibration")
    ),
    *(
        {"kind": "single", "size": "small", "effects": [name]}
        for name in ("mount_rotation", "low_pass", "timestamp_jitter", "dropped_samples", "reference_error", "gravity")
    ),
    {"kind": "pair", "size": "small"},
    {"kind": "null", "size": "small"},
]


@pytest.fixture(scope="module")
def cases(trajectory: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Twenty, one of a kind each."""

    def make(folder: Path) -> None:
        for k, case in enumerate(CASES):
            conceal(trajectory, folder / f"{k}", seed=SEED + k, noise="bmi160", **case)

    folder = made_once(tmp_path_factory, "cases", make)
    return [folder / f"{k}" for k in range(len(CASES))]


def _kinds(case: Path) -> set[str]:
    return {one["effect"] for one in unsealed(case)["effects"]}


def test_an_envelope_gives_back_what_was_put_in(cases: list[Path]) -> None:
    for case, asked in zip(cases, CASES, strict=True):
        truth = unsealed(case)
        assert asked["kind"] in (truth["kind"], "any")
        assert {one["effect"] for one in truth["effects"]} >= set(asked.get("effects", ()))
        assert len(truth["effects"]) == {"null": 0, "pair": 2}.get(truth["kind"], 1)


def test_the_logs_hold_what_the_truth_says(cases: list[Path]) -> None:
    case = next(case for case in cases if _kinds(case) == {"gyro_scale"})
    truth = unsealed(case)
    sim, real = read(case / SIM).imu, read(case / REAL).imu
    scale = [truth["effects"][0]["parameters"][axis]["value"] for axis in "xyz"]
    left = real.gyro - sim.gyro * (1.0 + np.array(scale)) - truth["bias"]["gyro"]
    sigma = np.hypot(truth["noise_std"]["real"][0], truth["noise_std"]["sim"][0])
    assert left.std() == pytest.approx(sigma, rel=0.05)
    assert np.abs(left.mean(axis=0)).max() < 5.0 * sigma / np.sqrt(len(left))


def test_logs_tell_nothing_of_themselves(cases: list[Path]) -> None:
    """Everything but the numbers is the same in all cases; but for dropped samples, whose number is the effect."""
    for name in (SIM, REAL):
        described = set()
        for case in cases:
            with Log(case / name) as log:
                topics = tuple((t.name, t.schema_name, tuple(sorted(t.metadata.items()))) for t in log.topics.values())
                metadata = tuple((n, tuple(values.items())) for n, values in log.metadata_records())
            recording = read(case / name)
            count = len(recording.imu) if "dropped_samples" not in _kinds(case) else None
            size = (case / name).stat().st_size if count is not None else None
            ends = (int(recording.imu.t_ns[0]), int(recording.imu.t_ns[-1]), len(recording.truth))
            described.add((topics, metadata, ends, tuple(len(s) for s in recording.scalars.values())))
            described.add((count, size)) if count is not None else None
        assert len(described) == 2


def test_no_name_and_no_seed_is_in_the_bytes(cases: list[Path]) -> None:
    named = set(CATALOGUE) - {"temperature"}  # a channel of that name is in every log
    words = [name.encode() for name in (*named, *catalogue.FORMS, "driven", "seed", "single", "flight", "bmi160")]
    for k, case in enumerate(cases):
        seed = SEED + k
        secrets = [*words, str(seed).encode(), seed.to_bytes(8, "little"), seed.to_bytes(8, "big")]
        for name in (SIM, REAL):
            held = (case / name).read_bytes()
            for secret in secrets:
                assert secret not in held, secret
    assert len({(case / ENVELOPE).stat().st_size for case in cases}) == 1
    assert len({tuple(json.loads((case / ENVELOPE).read_text())) for case in cases}) == 1
    assert {path.name for case in cases for path in case.iterdir()} == {SIM, REAL, ENVELOPE, KEY}


def test_one_seed_is_one_case_under_another_seal(trajectory: Path, cases: list[Path], tmp_path: Path) -> None:
    conceal(trajectory, tmp_path / "again", seed=SEED + 5, noise="bmi160", **CASES[5])
    for name in (SIM, REAL):
        assert (tmp_path / "again" / name).read_bytes() == (cases[5] / name).read_bytes()
    assert (tmp_path / "again" / ENVELOPE).read_bytes() != (cases[5] / ENVELOPE).read_bytes()


@pytest.fixture
def case(cases: list[Path], tmp_path: Path) -> Path:
    """A copy of one of them, with findings that say nothing."""
    for name in (SIM, REAL, ENVELOPE, KEY):
        (tmp_path / name).write_bytes((cases[5] / name).read_bytes())
    (tmp_path / FINDINGS).write_text(json.dumps(_findings([])))
    return tmp_path


def test_an_opened_case_is_planned_again_by_its_seed(cases: list[Path], trajectory: Path) -> None:
    for k in (0, 5):
        truth = unsealed(cases[k])
        assert isinstance(POSES.detectable_from_poses(trajectory, to_truth(truth, WHERE), CASES[k].get("effects", ())), bool)
    other = to_truth({**truth, "effects": [_concealed("none", "gyro")]}, WHERE)
    with pytest.raises(DataError, match="not made of this"):
        POSES.detectable_from_poses(trajectory, other, CASES[k].get("effects", ()))


def _findings(findings: list[dict[str, Any]], located: list[dict[str, Any]] | None = None, **more: Any) -> dict[str, Any]:
    floor = {"noise_floor": {"gyro": 0.1, "accel": 0.1}}
    said = {"schema": "imutool.diagnosis/1", "mismatch": bool(findings), "located": located or [], "findings": findings}
    return {**said, "unexplained": floor, **more}


@pytest.mark.parametrize("changed", ["commitment", "sealed", "salt", KEY, SIM, REAL])
def test_a_change_of_anything_sealed_is_noticed(case: Path, changed: str) -> None:
    if changed in (KEY, SIM, REAL):
        held = bytearray((case / changed).read_bytes())
        held[len(held) // 2] = ord("0") if held[len(held) // 2] != ord("0") else ord("1")
        (case / changed).write_bytes(held)
    else:
        envelope = json.loads((case / ENVELOPE).read_text())
        text = envelope[changed]
        envelope[changed] = text[:10] + ("0" if text[10] != "0" else "1") + text[11:]
        (case / ENVELOPE).write_text(json.dumps(envelope))
    with pytest.raises(DataError, match="changed"):
        opened(case)
    assert not (case / OPENED).exists()


@pytest.mark.parametrize(("off", "gain"), [(0.0, 1.0), (0.1, 0.99), (1.0, 0.0), (-1.0, 0.0)])
def test_the_gain_is_what_our_own_model_of_the_findings_explains(case: Path, off: float, gain: float) -> None:
    """A scale that is wrong by a share leaves the square of it, whatever the findings say of themselves."""
    true = unsealed(case)["effects"][0]["parameters"]
    told = {axis: ((1.0 + off) * true[axis]["value"], 0.1) for axis in "xyz"}
    (case / FINDINGS).write_text(json.dumps(_findings([_finding("gyro_scale", "gyro", **told)])))
    assert opened(case)["gain"] == pytest.approx(gain, abs=1e-6)  # the spline through poses 10 ms apart is that good


def test_nothing_found_gains_nothing(case: Path) -> None:
    assert opened(case)["gain"] == 0.0


def test_what_acts_in_no_second_that_counts_has_no_gain(case: Path) -> None:
    """As a limit that the first second alone reaches: here none does."""
    truth = _truth(_concealed("saturation", "both", gyro=1e3, accel=1e3))
    truth["achievable"] = {signal: {"rms_before": 0.1, "rms_after": 0.1} for signal in ("gyro", "accel")}
    assert as_json(score(to_truth(truth, WHERE), _findings([]), WHERE, read(case / SIM)))["gain"] is None


def test_findings_changed_after_the_opening_are_refused(case: Path) -> None:
    first = opened(case)
    assert not first["right"]
    assert opened(case)["right"] == first["right"]
    (case / FINDINGS).write_text(json.dumps(_findings([_finding("gyro_scale", "gyro")])))
    with pytest.raises(DataError, match="not the findings"):
        opened(case)


def test_a_case_is_never_overwritten(case: Path, trajectory: Path) -> None:
    before = {path.name: path.read_bytes() for path in case.iterdir()}
    with pytest.raises(ConfigError, match="holds a case already"):
        conceal(trajectory, case, seed=1)
    assert {path.name: path.read_bytes() for path in case.iterdir()} == before


@pytest.mark.parametrize(
    ("option", "value"), [("kind", "double"), ("size", "huge"), ("noise", "bmi16"), ("effects", ["lever"])]
)
def test_a_wrong_word_is_refused_and_leaves_nothing(trajectory: Path, tmp_path: Path, option: str, value: Any) -> None:
    with pytest.raises(ConfigError):
        conceal(trajectory, tmp_path / "case", **{"seed": 1, "kind": "single", "size": "large", option: value})
    assert list(tmp_path.iterdir()) == []


def test_noise_of_nothing_is_refused(trajectory: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="sized by it"):
        conceal(trajectory, tmp_path / "case", seed=1, noise="none")


@pytest.mark.parametrize(("duration_s", "what"), [(8.0, "true poses"), (24.0, "a case of 19 s.*at least 20 s, and 2.5 s")])
def test_a_trajectory_too_short_is_refused(tmp_path: Path, duration_s: float, what: str) -> None:
    """Also where the case alone would be too short to be opened."""
    write(flight(1, duration_s=duration_s), tmp_path / "short.mcap")
    with pytest.raises(DataError, match=what):
        conceal(tmp_path / "short.mcap", tmp_path / "case", seed=1)


def test_the_command_conceals_and_opens(
    imutool: Callable[..., subprocess.CompletedProcess[str]], trajectory: Path, tmp_path: Path
) -> None:
    done = imutool("conceal", trajectory, "case", "--seed", "4", "--kind", "null", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "sim.mcap" in done.stdout
    done = imutool("conceal", "--open", "case", cwd=tmp_path)
    assert done.returncode == 4
    assert "Run imutool diagnose case/real.mcap --sim case/sim.mcap -o case" in done.stderr
    (tmp_path / "case" / FINDINGS).write_text(json.dumps(_findings([])))
    done = imutool("conceal", "--open", "case", "--json", "score.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "the names are right" in done.stdout
    opened = json.loads((tmp_path / "score.json").read_text())
    assert_valid(opened)
    assert opened["schema"] == "imutool.score/1"
    done = imutool("conceal", "--open", "case", "--seed", "0", cwd=tmp_path)
    assert (done.returncode, "--seed is of a case that is made" in done.stderr) == (3, True)
    done = imutool("conceal", "--open", "nowhere", cwd=tmp_path)
    assert (done.returncode, "nowhere: holds no blind case" in done.stderr) == (4, True)


# ── the benchmark, and the second generator ──


def test_cases_are_dealt_in_proportion_whatever_their_number() -> None:
    bench = benchmark("diagnose")
    deck = bench.deck()
    assert {effect for task in deck for effect in task.effects} == {*CATALOGUE, *catalogue.FORMS}
    for count in (40, len(deck), 200):
        tasks = bench.dealt(count, 1)
        assert len(tasks) == count
        for kind in random_case.KINDS:
            share = sum(task.kind == kind for task in deck) / len(deck)
            assert abs(sum(task.kind == kind for task in tasks) - share * count) <= 2.0
    assert sorted(bench.dealt(len(deck), 5)) == sorted(deck)
    assert bench.dealt(30, 1) != bench.dealt(30, 2)


def test_a_line_of_scores_becomes_a_row() -> None:
    bench = benchmark("diagnose")
    said = _findings([_finding("gyro_scale", "gyro", x=(0.12, 0.01), y=(-0.2, 0.01))])
    line = {"case": 0, "effects": ["gyro_scale"], "seconds": 2.0, "failed": "", **scored(_truth(SCALE), said)}
    wrong = {**line, **scored(_truth(SCALE), _findings([_finding("low_pass", "gyro")]))}
    cells = dict(zip(bench.HEAD, bench.row("all", [line, wrong]), strict=True))
    assert cells["n"] == "2"
    assert cells["detected"] == "100 %"
    assert cells["names right"] == cells["precision"] == cells["recall"] == cells["with a wrong name"] == "50 %"
    assert cells["within 3 sigmas"] == "100 %"
    assert cells["error (median)"] == "10 %"


def test_mujoco_moves_a_lever_arm_as_mechanics_says() -> None:
    pytest.importorskip("mujoco", reason="the second generator is MuJoCo's")
    cases = benchmark("mujoco_cases")
    r = (0.1, -0.05, 0.08)
    flown = cases.fly(cases.Mounted(lever_m=r), 4.0, default_rng(1))
    omega = flown.ideal[:, :3]
    alpha = np.gradient(omega, cases.STEP_S, axis=0)
    lever = np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
    inner = slice(100, -100)
    assert np.abs(flown.real[inner, :3] - omega[inner]).max() < 1e-9
    assert np.abs((flown.real - flown.ideal)[inner, 3:] - lever[inner]).max() < HALF_MS * np.abs(lever[inner]).max()


def test_mujocos_accelerometer_reads_what_its_poses_do() -> None:
    """No half a step ahead of them, as forces that are held for a step would have it."""
    pytest.importorskip("mujoco", reason="the second generator is MuJoCo's")
    cases = benchmark("mujoco_cases")
    flown = cases.fly(cases.Mounted(), 2.0, default_rng(1))
    a_w = make_interp_spline(flown.t_s, flown.p_wb, k=5)(flown.t_s, 2)
    R_wb = Rotation.from_quat(flown.q_wb_wxyz, scalar_first=True)
    f = R_wb.inv().apply(a_w + np.array([0.0, 0.0, GRAVITY_M_S2]))
    inner = slice(100, -100)
    assert np.abs(flown.ideal[inner, 3:] - f[inner]).max() < HALF_MS * np.abs(f[inner]).max()


def test_mujoco_and_our_rotating_mount_agree() -> None:
    pytest.importorskip("mujoco", reason="the second generator is MuJoCo's")
    cases = benchmark("mujoco_cases")
    turn = (0.05, -0.03, 0.08)
    flown = cases.fly(cases.Mounted(rotation_rad=turn), 2.0, default_rng(1))
    assert np.abs(flown.real - CATALOGUE["mount_rotation"].act(RATE_HZ, flown.ideal, np.array(turn))).max() < 1e-9


def test_a_case_of_mujoco_opens_like_any_other(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="the second generator is MuJoCo's")
    benchmark("mujoco_cases").conceal_mujoco(tmp_path / "case", seed=3, kind="lever_arm+clock_offset", duration_s=8.0)
    (tmp_path / "case" / FINDINGS).write_text(json.dumps(_findings([_finding("lever_arm", "accel")])))
    out = opened(tmp_path / "case")
    assert (out["kind"], out["hits"], out["missing"]) == ("pair", ["lever_arm"], ["clock_offset"])


# ── the score ──


def _finding(effect: str, signal: str, driver: str = "", **parameters: tuple[float, float]) -> dict[str, Any]:
    told = {name: {"value": value, "std": std, "unit": "-"} for name, (value, std) in parameters.items()}
    held_out = {"rms_before": 0.5, "rms_after": 0.3, "unit": "rad/s", "seconds": 10.0}
    return {"effect": effect, "signal": signal, "driver": driver, "parameters": told, "held_out": held_out}


def _truth(*effects: dict[str, Any], kind: str = "single") -> dict[str, Any]:
    nothing = {"seconds": "......", "axes": dict.fromkeys("xyz", "."), "localised": False}
    something = {"seconds": "..##?.", "axes": {"x": "#", "y": "?", "z": "."}, "localised": True}
    quiet = {"rms_before": 0.1, "rms_after": 0.1}
    return {
        "schema": "imutool.sealed_truth/1",
        "seed": 1,
        "trajectory": "flight",
        "noise": "bmi160",
        "kind": kind,
        "size": "middle",
        "effects": list(effects),
        "came_to": {},
        "bias": {"gyro": [0.0] * 3, "accel": [0.0] * 3},
        "duration_s": 6.0,
        "place": {"window_s": 1.0, "gyro": something if effects else nothing, "accel": nothing},
        "achievable": {"gyro": {"rms_before": 0.5, "rms_after": 0.1} if effects else quiet, "accel": quiet},
        "noise_std": {"real": [0.1] * 6, "sim": [0.03] * 6},
    }


def _concealed(effect: str, signal: str, driver: str = "", **values: float) -> dict[str, Any]:
    parameters = {
        name: {"value": value, "unit": "-", "scale": abs(value), "smallest_std": 0.01, "identifiable": True}
        for name, value in values.items()
    }
    return {"effect": effect, "signal": signal, "driver": driver, "equation": "", "factor": 1.0, "parameters": parameters}


SCALE = _concealed("gyro_scale", "gyro", x=0.1, y=-0.2)


def test_all_right_scores_in_full() -> None:
    located = [{"signal": "gyro", "axes": ["x"], "intervals_s": [[2.0, 4.0]], "regime": "", "share": 1.0, "p_value": 0.0}]
    closer = {"gyro": {"rms_before": 0.5, "rms_after": 0.1, "unit": "rad/s", "seconds": 10.0}}
    said = _findings([_finding("gyro_scale", "gyro", x=(0.12, 0.01), y=(-0.2, 0.01))], located, closer=closer)
    out = scored(_truth(SCALE), said)
    assert (out["right"], out["detected"], out["precision"], out["recall"]) == (True, True, 1.0, 1.0)
    assert out["place"] == {"seconds_f1": 1.0, "axes_f1": 1.0, "f1": 1.0}
    assert [row["sigmas"] for row in out["parameters"]] == pytest.approx([2.0, 0.0])
    assert [row["percent"] for row in out["parameters"]] == pytest.approx([20.0, 0.0])
    assert [row["over_bound"] for row in out["parameters"]] == pytest.approx([1.0, 1.0])
    assert out["untold"] == []
    assert out["gain"] == pytest.approx(1.0)


def test_a_wrong_name_is_a_miss_and_a_false_finding() -> None:
    out = scored(_truth(SCALE), _findings([_finding("gyro_quadratic", "gyro")]))
    assert (out["right"], out["hits"], out["missing"], out["wrong"]) == (False, [], ["gyro_scale"], ["gyro_quadratic"])
    assert (out["precision"], out["recall"]) == (0.0, 0.0)
    assert out["place"]["seconds_f1"] == 0.0
    # 0.5 to 0.3, where 0.5 to 0.1 could be had: 0.16 of 0.24
    assert out["gain"] == pytest.approx(2.0 / 3.0)


def test_a_missing_one_and_an_extra_one() -> None:
    pair = _truth(SCALE, _concealed("lever_arm", "accel", x=0.1), kind="pair")
    out = scored(pair, _findings([_finding("gyro_scale", "gyro", x=(0.1, 0.01))]))
    assert (out["right"], out["missing"], out["wrong"], out["precision"], out["recall"]) == (False, ["lever_arm"], [], 1.0, 0.5)
    assert out["untold"] == ["gyro_scale.y"]
    extra = scored(_truth(SCALE), _findings([_finding("gyro_scale", "gyro"), _finding("low_pass", "gyro")]))
    assert (extra["right"], extra["wrong"], extra["precision"], extra["recall"]) == (False, ["low_pass"], 0.5, 1.0)


def test_nothing_where_nothing_is_and_a_bias_is_no_news() -> None:
    out = scored(_truth(kind="null"), _findings([]))
    assert (out["right"], out["detected"], out["precision"], out["recall"], out["gain"]) == (True, False, None, None, None)
    assert out["place"]["f1"] is None
    assert scored(_truth(kind="null"), _findings([_finding("gyro_bias", "gyro")]))["right"]
    false = scored(_truth(kind="null"), _findings([_finding("unknown", "gyro")]))
    assert (false["right"], false["wrong"]) == (False, ["unknown"])


def test_a_driver_must_be_the_right_one() -> None:
    truth = _truth(_concealed("driven", "gyro", "/motor/current", gain=0.1, lag=0.2))
    field = _finding("driven", "gyro", "/motor/current.data", gain=(0.1, 0.01), lag=(0.2, 0.1))
    out = scored(truth, _findings([field]))
    assert out["right"]
    assert [row["parameter"] for row in out["parameters"]] == ["gain", "lag"]
    assert not scored(truth, _findings([_finding("driven", "gyro", "/motor/currents")]))["right"]


def test_a_place_half_found_scores_by_its_f1() -> None:
    located = [{"signal": "gyro", "axes": ["x", "z"], "intervals_s": [[0.0, 3.0]], "regime": "", "share": 1.0, "p_value": 0.0}]
    out = scored(_truth(SCALE), _findings([], located))
    # seconds 0 and 1 are false, 2 is right, 3 is missed; of the axes x is right and z is false
    assert out["place"] == pytest.approx({"seconds_f1": 2.0 / 5.0, "axes_f1": 2.0 / 3.0, "f1": (2.0 / 5.0 + 2.0 / 3.0) / 2.0})


def test_a_line_told_as_sine_and_cosine_is_compared_by_its_amplitude() -> None:
    truth = _truth(_concealed("vibration", "accel", accel_x=5.0))
    out = scored(truth, _findings([_finding("vibration", "accel", sin_x=(3.0, 0.1), cos_x=(4.0, 0.1))]))
    assert [(row["value"], row["std"]) for row in out["parameters"]] == [(pytest.approx(5.0), pytest.approx(0.1))]


@pytest.mark.parametrize(
    "said",
    [
        {"schema": "imutool.diagnosis/2"},
        {"schema": "imutool.diagnosis/1"},
        {"schema": "imutool.diagnosis/1", "findings": 3, "located": [], "mismatch": False},
        {"schema": "imutool.diagnosis/1", "findings": ["x"], "located": [], "mismatch": False},
    ],
    ids=["schema", "empty", "number", "text"],
)
def test_findings_that_are_none_are_refused(said: dict[str, Any]) -> None:
    with pytest.raises(DataError):
        scored(_truth(SCALE), said)
