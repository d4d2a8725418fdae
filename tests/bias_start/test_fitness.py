"""A model that ships fits logs of its sensor; of another sensor, or of samples that were tampered with, it is caught."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.switchings_on import Switchings
from support.switchings_on import log as switched_on

import imutool
from imutool.bias import hybrid, linear, static
from imutool.bias.model import BiasModel
from imutool.bias.model_file import save
from imutool.bias_start import Fitness, fitness
from imutool.bias_start.bias_at_rest import at_rest, auto
from imutool.bias_start.correction import apply
from imutool.bias_start.fitness import judge
from imutool.bias_start.initial_bias import from_numbers, relative_samples
from imutool.bias_start.model_choice import find_initial_bias, smooth_in_memory
from imutool.errors import ModelError
from imutool.inertial.innovations import Share
from imutool.inertial.stationary import CALM, white_noise
from imutool.recording import GRAVITY_M_S2, Imu, Recording, seconds
from imutool.sensor.made_up_flight import flight

SECOND_NS = 1_000_000_000
WRONG = np.array([[0.04, -0.02, 0.01], [0.02, -0.05, 0.03], [-0.03, 0.02, 0.04]])
MADE_FOR = {"sensor": "made up", "dataset": "flights"}


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A flight of a minute that starts at rest; its biases are its own."""
    return flight(3, duration_s=60.0)


@pytest.fixture(scope="module")
def model(recording: Recording) -> BiasModel:
    """A model of that very sensor, without a motion-dependent part."""
    rest = imutool.debias(recording, "static").start.rest
    statistics = {
        "prior_mean": rest,
        "prior_std": np.array([1e-3] * 3 + [0.05] * 3),
        "noise_std": CALM * white_noise(np.concatenate([recording.imu.gyro, recording.imu.accel], axis=1)),
    }
    made = linear.Model(linear.Config(), 1.0 / recording.imu.period_s, statistics)
    made.card = {"name": "own", "logs": [{}] * 3, **MADE_FOR}
    return made


def judged(model: BiasModel, imu: Imu, about: dict[str, str] | None = None) -> Fitness:
    return judge(model, auto(model, imu), [relative_samples(imu)], about or {})


def test_the_sensor_itself_fits(model: BiasModel, recording: Recording) -> None:
    assert judged(model, recording.imu).verdict == "fits"
    assert judged(model, recording.imu, MADE_FOR).verdict == "fits"
    given = judge(static.Model(), from_numbers("0,0,0,0,0,0"), [], {})
    assert given.verdict == "fits"
    assert given.reasons[0] == "the first 120 s have no stop that could contradict its bias"


@pytest.mark.parametrize("arm_m", [-1.0, 1.0])
def test_an_arm_to_the_point_of_the_poses_is_no_correction_of_the_sensor(
    arm_m: float, model: BiasModel, recording: Recording
) -> None:
    """Markers far from the sensor: their specific force says nothing about the unit."""
    config = hybrid.Config(gyro_effects=(), accel_effects=("lever_arm",), remainder=False)
    with_arm = hybrid.Model(config, model.rate_hz, {**model.tensors, "theta_accel": np.full(3, arm_m)})
    with_arm.card = model.card
    own, beside = (judged(each, recording.imu, MADE_FOR) for each in (model, with_arm))
    assert beside.verdict == own.verdict == "fits"


def test_another_name_is_doubtful_however_well_it_agrees(model: BiasModel, recording: Recording) -> None:
    found = judged(model, recording.imu, MADE_FOR | {"sensor": "another"})
    assert found == Fitness("doubtful", ("the model was made for the sensor made up, the log is of another",))


TAMPERED = {
    "gyro in deg/s": (
        "the raw samples agree with gravity and stops better",
        lambda imu: replace(imu, gyro=np.degrees(imu.gyro)),
    ),
    "accel in g": ("expected about 9.81", lambda imu: replace(imu, accel=imu.accel / 9.81)),
    "axes of the gyro permuted": ("gyro", lambda imu: replace(imu, gyro=imu.gyro[:, [1, 2, 0]])),
    "another unit": ("another unit", lambda imu: replace(imu, gyro=imu.gyro + np.array([0.08, 0.0, 0.0]))),
}


@pytest.mark.parametrize("how", TAMPERED)
def test_what_is_not_of_the_sensor_is_unfit(how: str, model: BiasModel, recording: Recording) -> None:
    reason, tamper = TAMPERED[how]
    found = judged(model, tamper(recording.imu), MADE_FOR)
    assert found.verdict == "unfit"
    assert reason in " ".join(found.reasons)


def test_another_switching_on_is_doubtful_not_unfit(model: BiasModel, recording: Recording) -> None:
    shifted = replace(recording.imu, gyro=recording.imu.gyro + np.array([0.0, 0.015, 0.0]))
    found = judged(model, shifted, MADE_FOR)
    assert found.verdict == "doubtful"
    assert "about y differs by" in found.reasons[0]
    assert "from the model's prior" in found.reasons[0]  # a physics.toml has one without training logs


@pytest.fixture(scope="module")
def scaled(recording: Recording) -> Imu:
    """Samples of a gyro whose scale and axes are wrong by some percent."""
    return replace(recording.imu, gyro=recording.imu.gyro @ (np.eye(3) + WRONG).T)


def corrects(model: BiasModel, wrong: np.ndarray) -> BiasModel:
    """Model that also removes an error of scale and axes."""
    W = np.eye(3) - np.linalg.inv(np.eye(3) + wrong)
    made = linear.Model(linear.Config(), model.rate_hz, dict(model.tensors) | {"W.gyro": W})
    made.card = model.card
    return made


def test_gravity_confirms_the_sensors_own_correction(model: BiasModel, scaled: Imu) -> None:
    found = judged(corrects(model, WRONG), scaled)
    assert found.verdict == "fits"
    assert "% of the model's correction" in found.reasons[0]


def test_another_units_correction_is_caught_beside_a_bias_larger_than_usual(model: BiasModel, scaled: Imu) -> None:
    bias, other = np.array([0.4, -0.3, 0.35]), corrects(model, -WRONG.T)
    rest = model.prior_mean + np.concatenate([np.linalg.inv(np.eye(3) - WRONG.T) @ bias, np.zeros(3)])
    made = linear.Model(linear.Config(), model.rate_hz, dict(other.tensors) | {"prior_mean": rest})
    made.card = model.card
    assert judged(made, replace(scaled, gyro=scaled.gyro + bias)).verdict == "unfit"


@pytest.mark.parametrize("half_turns", [True, False])
def test_turned_axes_are_caught_though_a_scale_is_the_same_in_them(
    model: BiasModel, recording: Recording, half_turns: bool
) -> None:
    """As of a driver in FRD for a model of FLU; a new turn-on bias is none."""
    scale, bias = np.diag([0.08, -0.06, 0.05]), np.array([0.03, 0.02, -0.03, 0.6, -0.7, 0.6])
    gyro, accel = recording.imu.gyro @ (np.eye(3) + scale).T + bias[:3], recording.imu.accel + bias[3:]
    own = corrects(model, scale)
    turn_on = {"prior_mean": model.prior_mean + bias, "prior_std": np.array([0.01] * 3 + [0.15] * 3)}
    wide = linear.Model(linear.Config(), model.rate_hz, dict(own.tensors) | turn_on)
    wide.card = model.card
    P = np.diag([1.0, -1.0, -1.0]) if half_turns else np.eye(3)
    shift = np.zeros(3) if half_turns else np.array([0.012, -0.01, 0.008])
    found = judged(wide, replace(recording.imu, gyro=(gyro + shift) @ P, accel=accel @ P))
    assert found.verdict == ("unfit" if half_turns else "fits")
    assert ("+x -y -z: the axes are turned" in " ".join(found.reasons)) is half_turns


@pytest.mark.parametrize(
    ("share", "verdict"), [(Share(0.2, 0.15), "doubtful"), (Share(0.2, 0.25), "fits"), (Share(0.6, 0.05), "fits")]
)
def test_a_share_far_from_the_whole_correction_and_below_half_of_it_is_doubtful(
    monkeypatch: pytest.MonkeyPatch, model: BiasModel, recording: Recording, share: Share, verdict: str
) -> None:
    """A third of other units' models that do harm had such a share, and were said to fit."""
    monkeypatch.setattr(fitness, "_share", lambda *given: share)
    assert judged(model, recording.imu).verdict == verdict


def test_a_new_turn_on_bias_is_no_turn_of_the_axes_where_the_correction_is_the_sensors(model: BiasModel, scaled: Imu) -> None:
    """One of 23 turns of the axes often explains two biases of a sensor that changes them by 20 mrad/s."""
    bias, swapped = np.array([0.03, -0.02, 0.01]), np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    own = corrects(model, WRONG)
    turn_on = {"prior_mean": np.concatenate([model.prior_mean[:3] + bias, model.prior_mean[3:]])}
    turn_on["prior_std"] = np.array([7e-3] * 3 + [0.5] * 3)
    known = linear.Model(linear.Config(), model.rate_hz, dict(own.tensors) | turn_on)
    known.card = model.card
    shift = swapped @ (model.prior_mean[:3] + bias) - model.prior_mean[:3]
    found = judged(known, replace(scaled, gyro=scaled.gyro + shift))
    assert found.verdict != "unfit", found.reasons
    assert "axes" not in " ".join(found.reasons)


def test_the_correction_of_another_unit_is_caught_though_its_bias_agrees(
    model: BiasModel, recording: Recording, scaled: Imu
) -> None:
    """On samples that need none, and on samples that need the opposite."""
    for imu, wrong in ((recording.imu, WRONG), (scaled, -WRONG)):
        found = judged(corrects(model, wrong), imu)
        assert found.verdict != "fits"
        assert "another unit's" in " ".join(found.reasons)


def test_a_small_correction_of_another_unit_fits_but_the_reason_says_what_the_log_does_not_show(
    model: BiasModel, recording: Recording
) -> None:
    """A thousandth of scale and axes is too little for a minute of flight."""
    found = judged(corrects(model, 0.02 * WRONG), recording.imu)
    assert found.verdict == "fits"
    assert "correction in motion" in found.reasons[0]
    assert "correction in motion" not in judged(model, recording.imu).reasons[0], "this model has none"


@pytest.mark.parametrize("walked_m_s", [0.0, 4.0])
def test_a_correction_of_half_a_percent_is_judged_where_the_body_stays_in_a_room(walked_m_s: float) -> None:
    """Other units' corrections of this size did more harm than good, and were said to fit; a walk shows none."""
    made = switched_on(1, 1, Switchings(scale=0.0, misalignment_rad=0.0, rest_s=8.0, duration_s=60.0))
    t, truth = made.imu.t_ns, made.truth
    R = Slerp(truth.t_ns, Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True))(np.clip(t, *truth.t_ns[[0, -1]]))
    sets_off = 0.5 * walked_m_s * ((t >= t[0] + 10 * SECOND_NS) & (t < t[0] + 12 * SECOND_NS))
    exact = replace(made.imu, accel=made.imu.accel + R.inv().apply(sets_off[:, None] * [1.0, 0.0, 0.0]))
    statistics = {"prior_mean": imutool.debias(made, "static").start.rest, "prior_std": np.array([1e-3] * 3 + [0.05] * 3)}
    unit = linear.Model(linear.Config(), 100.0, statistics)
    unit.card = {"name": "own", "logs": [{}] * 3}
    scale = -0.1 * WRONG
    own = judged(corrects(unit, scale), replace(exact, gyro=exact.gyro @ (np.eye(3) + scale).T))
    other = judged(corrects(unit, scale), exact)
    assert own.verdict == "fits", own.reasons
    assert (other.verdict == "doubtful") == (walked_m_s == 0.0), other.reasons


@pytest.mark.parametrize(("bias", "verdict"), [(1.5, "fits"), (9.7, "unfit"), (-8.8, "unfit")])
def test_a_bias_at_rest_as_large_as_gravity_is_none(bias: float, verdict: str, recording: Recording) -> None:
    """It is what rest shows of accelerations without gravity, and of those in g, however strong the motion later is."""
    x, y, z = imutool.debias(recording, "static").start.rest[:3]
    found = judge(static.Model(), from_numbers(f"{x},{y},{z},0,0,{bias}"), [relative_samples(recording.imu)], {})
    assert found.verdict == verdict
    assert ("does not measure gravity, or its unit is not m/s²" in found.reasons[0]) == (verdict == "unfit")


@pytest.mark.parametrize("untrained", [False, True])
def test_a_start_that_the_log_contradicts_is_named(untrained: bool, model: BiasModel, recording: Recording) -> None:
    """Doubtful where it is no worse than no correction, else unfit."""
    own = imutool.debias(recording, "static").start.rest
    for off, verdict in ((np.zeros(6), "fits"), (-own, "doubtful"), (np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]), "unfit")):
        start = from_numbers(",".join(str(x) for x in own + off))
        found = judge(static.Model() if untrained else model, start, [relative_samples(recording.imu)], MADE_FOR)
        assert found.verdict == verdict
        assert ("the start's bias of the gyro about " in found.reasons[0]) == (verdict != "fits")
        assert (found.reasons[0] == "its bias agrees with the gyro at rest") == (untrained and verdict == "fits")


def test_another_switching_on_is_no_doubt_where_gravity_confirms_the_correction(model: BiasModel, scaled: Imu) -> None:
    shifted = replace(scaled, gyro=scaled.gyro + np.array([0.0, 0.015, 0.0]))
    found = judged(corrects(model, WRONG), shifted)
    assert found.verdict == "fits"
    assert "about y differs by" in found.reasons[1]
    assert judged(corrects(model, -WRONG), shifted).verdict == "unfit"


def test_more_noise_is_doubtful_and_less_is_not(model: BiasModel, recording: Recording) -> None:
    """A vehicle with its motors off is quieter than in training."""
    more, less = (
        linear.Model(linear.Config(), model.rate_hz, dict(model.tensors) | {"noise_std": times * model.noise_std})
        for times in (0.2, 10.0)
    )
    more.card = less.card = model.card
    assert judged(less, recording.imu).verdict == "fits"
    found = judged(more, recording.imu)
    assert found.verdict == "doubtful"
    assert "5 times as noisy" in found.reasons[0]


@pytest.mark.parametrize(("start", "turn_rad_s"), [("static", 0.08), ("auto", 0.04), ("smooth", 0.04), ("truth", 0.04)])
def test_a_steady_turn_about_gravity_is_no_stop(start: str, turn_rad_s: float, model: BiasModel) -> None:
    """Before the flight the sensor turns at a constant rate, as on a table: it looks like a bias until the sensor tilts."""
    log = flight(3, duration_s=60.0, still_s=8.0, room_m=0.5)
    imu, poses, turning_s = log.imu, log.truth, 8.5
    turns = np.arange(len(imu)) * imu.period_s < turning_s
    up = imu.accel[turns].mean(axis=0)
    imu = replace(imu, gyro=imu.gyro + np.outer(turns, turn_rad_s * up / np.linalg.norm(up)))
    yaw = turn_rad_s * (np.minimum(seconds(poses.t_ns, int(poses.t_ns[0])), turning_s) - turning_s)
    turned = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]) * Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True)
    poses = replace(poses, q_wb_wxyz=turned.as_quat(scalar_first=True))
    own = linear.Model(linear.Config(), model.rate_hz, dict(model.tensors) | {"prior_std": 7.0 * model.prior_std})
    own.card, untrained = model.card, start == "static"
    chosen = static.Model() if untrained else own
    starts = {"static": lambda: at_rest(chosen, imu), "smooth": lambda: smooth_in_memory(own, imu, "")}
    log = replace(log, imu=imu, truths={"/ground_truth/pose": poses})
    begun = starts[start]() if start in starts else find_initial_bias(start, own, log)
    found = judge(chosen, begun, [relative_samples(imu)], {})
    assert found.verdict == ("doubtful" if untrained else "fits"), found
    assert ("steady turn" in " ".join(found.reasons)) == (start in {"static", "smooth"})
    at_end = imu.gyro[-1] - apply(chosen, begun, imu).imu.gyro[-1]
    for bias in (begun.rest[:3], at_end):
        assert np.linalg.norm(bias - model.prior_mean[:3]) == pytest.approx(turn_rad_s * untrained, abs=5e-3)


@pytest.mark.parametrize(("slower", "jitter", "is_doubt"), [(0.02, 0.0, True), (0.02, 0.4, False), (0.005, 0.0, False)])
def test_another_rate_is_a_doubt_where_the_steps_show_it(
    slower: float, jitter: float, is_doubt: bool, model: BiasModel, recording: Recording
) -> None:
    """The median step of stamps that jitter scatters by itself; a logger's own jitter of 0.5 % changes no model."""
    imu, period_ns = recording.imu, 1e9 * recording.imu.period_s
    late_ns = np.random.default_rng(6).uniform(-jitter, jitter, len(imu)) * period_ns
    found = judged(
        model, Imu(imu.t_ns + (slower * period_ns * np.arange(len(imu)) + late_ns).astype(np.int64), imu.gyro, imu.accel)
    )
    assert ("Hz, in the training logs at" in " ".join(found.reasons)) == is_doubt, found


def test_steps_of_two_lengths_are_no_doubt_of_the_rate(model: BiasModel, recording: Recording) -> None:
    """A host stamps each sample at one of two of its ticks: the median step is the one or the other by chance."""
    imu, period_ns = recording.imu, 1e9 * recording.imu.period_s
    longer = np.random.default_rng(6).permutation(len(imu)) < 0.502 * len(imu)
    t_ns = imu.t_ns[0] + np.cumsum(np.where(longer, 1.02, 0.98) * period_ns).astype(np.int64)
    found = judged(model, Imu(t_ns, imu.gyro, imu.accel))
    assert "Hz, in the training logs at" not in " ".join(found.reasons), found


def test_an_unfit_model_is_refused_unless_forced_and_a_doubtful_one_is_used(
    model: BiasModel, recording: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    imutool.write(tmp_path / "in.mcap", replace(recording, imu=replace(recording.imu, gyro=np.degrees(recording.imu.gyro))))
    save(model, tmp_path / "own.safetensors")
    words = [str(tmp_path / name) for name in ("in.mcap", "out.mcap", "own.safetensors")]
    with pytest.raises(ModelError, match=r"does not fit this log.*`force`"):
        imutool.debias(words[0], words[1], model=words[2])
    assert not Path(words[1]).exists()
    report = imutool.debias(words[0], words[1], model=words[2], force=True)
    assert report.fits["/imu0"].verdict == "unfit"
    assert "the model own is unfit: " in caplog.text
    doubtful = imutool.debias(replace(recording, metadata={"imutool": {"sensor": "another"}}), model)
    assert doubtful.fitness.verdict == "doubtful"
    assert "the model own is doubtful: " in caplog.text


@pytest.mark.parametrize(("untrained", "moved"), [(False, 0.008), (True, 0.01)])
def test_a_bias_that_moves_from_stop_to_stop_is_doubtful(untrained: bool, moved: float, model: BiasModel) -> None:
    """A flight from rest, and the same backwards: at rest again, where the gyro shows what moved."""
    imu, bias = flight(3, duration_s=30.0).imu, model.prior_mean
    model = static.Model() if untrained else model
    gyro, accel = imu.gyro - bias[:3], imu.accel - bias[3:]
    t_ns = imu.t_ns[0] + np.diff(imu.t_ns[:2]) * np.arange(2 * len(imu) - 1)
    there = np.concatenate([gyro, -gyro[-2::-1]]), np.concatenate([accel, accel[-2::-1]])
    still, drifts = (
        judged(model, Imu(t_ns, there[0] + bias[:3] + by * np.linspace(0.0, 1.0, len(t_ns))[:, None], there[1] + bias[3:]))
        for by in (0.0, moved)
    )
    assert "from stop to stop" not in " ".join(still.reasons)
    assert drifts.verdict == "doubtful"
    assert "from stop to stop" in " ".join(drifts.reasons)


def boat(model_rad_s: list[float], log_rad_s: list[float], std_rad_s: float) -> tuple[BiasModel, Imu]:
    """Model of a boat that rolls and pitches, and turns about the vertical, and a log: gravity hides the bias about that."""
    rng, t = np.random.default_rng(4), np.arange(0.0, 60.0, 0.01)
    roll, pitch, yaw = 0.05 * np.sin(0.9 * t), 0.04 * np.sin(0.7 * t + 1.0), 0.3 * np.sin(0.2 * t)
    turn = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1))
    rates = (turn[:-1].inv() * turn[1:]).as_rotvec() / 0.01
    gyro = np.concatenate([rates, rates[-1:]]) + 1e-3 * rng.normal(size=(len(t), 3)) + log_rad_s
    accel = turn.inv().apply([0.0, 0.0, GRAVITY_M_S2]) + 0.02 * rng.normal(size=(len(t), 3))
    statistics = {"prior_mean": np.array([*model_rad_s, 0.0, 0.0, 0.0]), "prior_std": np.array([std_rad_s] * 3 + [0.05] * 3)}
    made = linear.Model(linear.Config(), 100.0, statistics)
    made.card = {"name": "boat", "logs": [{"name": "own"}] * 3}
    return made, Imu((1e9 * t).astype(np.int64), gyro, accel)


@pytest.mark.parametrize(("usual", "is_none"), [(0.001, True), (0.02, False)])
def test_a_bias_that_a_log_does_not_show_is_doubtful_where_it_may_as_well_be_none(usual: float, is_none: bool) -> None:
    found = judged(*boat([0.0, 0.0, usual], [0.0, 0.0, usual], 7e-3))
    told = " ".join(found.reasons)
    assert ("neither stops nor gravity shows the gyro's bias about z" in told) == is_none, told
    assert found.verdict == "doubtful", told


def test_a_boat_whose_bias_another_unit_may_have_as_well_is_doubtful_unless_it_tells_the_unit() -> None:
    """Its heading goes with the model's bias about the vertical, which nothing in the log refutes."""
    small, other = [0.003, -0.002, 0.004], [0.0015, -0.003, -0.002]
    model, imu = boat(small, other, 2.5e-3)
    found = judged(model, imu)
    assert found.verdict == "doubtful", found
    assert "neither shows the gyro's bias about z, +0.004 rad/s in the training logs, nor tells its unit" in found.reasons[0]
    assert judged(model, imu, {"sequence": "own"}).verdict == "fits"
    large = [0.03, -0.025, 0.004]
    assert judged(*boat(large, large, 2.5e-3)).verdict == "fits", "two axes that agree tell the unit"


@pytest.mark.parametrize("smooth", [False, True])
def test_a_bias_about_the_vertical_is_not_taken_from_a_unit_that_the_other_axes_refute(smooth: bool) -> None:
    model, imu = boat([0.012, -0.01, 0.006], [-0.003, 0.004, -0.002], 2.5e-3)
    start = smooth_in_memory(model, imu, "boat") if smooth else auto(model, imu)
    assert abs(start.rest[2]) < 2e-3, start
    np.testing.assert_allclose(start.rest[:2], [-0.003, 0.004], atol=1.5e-3)
    own, imu = boat([0.012, -0.01, 0.006], [0.014, -0.011, 0.006], 2.5e-3)
    start = smooth_in_memory(own, imu, "boat") if smooth else auto(own, imu)
    assert start.rest[2] > 4e-3, "its own unit has another turn-on bias"


@pytest.mark.parametrize("stops", [True, False])
def test_a_sensor_without_bias_is_not_taken_for_one_with_a_large_bias(stops: bool) -> None:
    """Steps on a flat floor, which show the accelerometer's bias upwards alone; a stop shows the gyro's, too."""
    rng, t = np.random.default_rng(5), np.arange(0.0, 40.0, 0.01)
    moves = np.where(stops & (t < 5.0), 0.0, 1.0)[:, None]
    gyro = moves * np.stack([0.02 * np.sin(5.0 * t), 0.02 * np.cos(4.0 * t), 0.5 * np.sin(0.4 * t)], axis=1)
    accel = moves * np.sin(np.outer(t, [6.0, 5.0, 9.0])) * [1.5, 1.0, 2.0] + [0.0, 0.0, GRAVITY_M_S2]
    statistics = {"prior_mean": np.array([0.0, 0.0, 0.08, 0.0, 0.0, 0.0]), "prior_std": np.array([3e-3] * 3 + [0.05] * 3)}
    other = linear.Model(linear.Config(), 100.0, statistics)
    other.card = {"name": "other", "logs": [{"name": "own"}] * 3, **MADE_FOR}
    imu = Imu(
        (1e9 * t).astype(np.int64), gyro + 1e-3 * rng.normal(size=(len(t), 3)), accel + 0.01 * rng.normal(size=(len(t), 3))
    )
    found = judged(other, imu)
    told = " ".join(found.reasons)
    assert found.verdict == ("unfit" if stops else "doubtful"), told
    assert ("the log neither shows the gyro's bias about z, +0.08 rad/s in the training logs" in told) == (not stops), told
    assert judged(other, imu, {"sequence": "own"}).verdict == ("unfit" if stops else "fits")
