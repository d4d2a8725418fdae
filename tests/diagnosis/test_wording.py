"""What is said in words: the right effect, size, sign and certainty, in a unit and with the digits a person reads."""

from __future__ import annotations

import importlib
import math
import pkgutil
import re
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import diagnoses
from support.diagnoses import replace

import imutool.sensor.effects
from imutool.diagnosis.result import Estimate, Extent, Finding, HeldOut, Located, Unexplained
from imutool.diagnosis.wording.conclusion import MEASURE, NULL, chance_text, conclusion, headline, lines, rms_text, table
from imutool.diagnosis.wording.effect_sentences import SENTENCES, named_sentence, signals
from imutool.diagnosis.wording.quantity import grouped, percent, value, vector

CATALOGUE = [  # of physics: what an ideal simulation leaves out, and what any signal can have
    "gyro_bias", "accel_bias", "gyro_scale", "gyro_misalignment", "gyro_g_sensitivity", "gyro_quadratic", "gyro_bias_drift",
    "gyro_scale_asymmetry", "accel_scale_asymmetry", "gyro_hysteresis", "accel_hysteresis", "gyro_bias_step", "accel_bias_step",
    "accel_scale", "accel_misalignment", "accel_quadratic", "accel_bias_drift", "lever_arm", "mount_rotation", "size_effect",
    "clock_offset", "clock_skew", "clock_jump", "clock_wander", "gyro_delay", "gyro_dead_band", "low_pass", "saturation",
    "quantization", "gravity", "earth_rotation", "vibration", "mount_resonance", "temperature", "dropped_samples",
    "timestamp_jitter", "reference_error", "reference_smoothing", "driven", "unknown", "gain", "offset", "delay", "dead_band",
    "drift", "friction", "gyro_scale_drift", "gyro_scale_temperature",
]  # fmt: skip
# An uncertainty keeps one digit between 1.95 and 9.5, else two: a number moves by at most this share of it.
ROUNDED = 0.26


def finding(effect: str, parameters: dict[str, Estimate], signal: str = "accel", **changes: object) -> Finding:
    return replace(diagnoses.LEVER_ARM, effect=effect, signal=signal, parameters=parameters, **changes)


# ── whole conclusions ──


def test_one_finding_is_one_sentence_with_place_size_gain_and_what_is_left() -> None:
    assert conclusion(diagnoses.LATE) == (
        "The gyro differs when turning: it lags the simulation by 12.4 ± 0.3 ms (clock_offset); modelling it removes 63 % of "
        "the misfit on 30 s of unseen data; nothing else stands above the noise."
    )


def test_a_lever_arm_is_a_vector_and_a_regime_without_a_preposition_gets_one() -> None:
    assert conclusion(diagnoses.ARM).startswith(
        "The accel differs at angular rate above 0.4 rad/s: it sits (0.213, -0.051, 0.120) ± 0.004 m from the tracked point "
        "(lever_arm); modelling it removes 71 % "
    )


def test_nothing_is_said_plainly_and_what_cannot_be_seen_with_it() -> None:
    assert conclusion(diagnoses.NOTHING) == NULL == "Nothing but a constant bias and noise separates the two."
    still = replace(diagnoses.NOTHING, not_identifiable=("gyro_scale.x", "gyro_scale.y", "lever_arm", "/odom.v.delay"))
    assert conclusion(still) == f"{NULL} These logs cannot show: gyro_scale (x, y), lever_arm, /odom.v.delay."


def test_a_diagnosis_is_shown_by_its_findings_alone() -> None:
    shown = [repr(one) for one in (diagnoses.ARM, diagnoses.UNEXPLAINED, diagnoses.NOTHING)]
    assert shown[0] == "<diagnosis of real.mcap: lever_arm (accel, 71%)>"
    assert [text.rpartition(": ")[2] for text in shown[1:]] == ["no name>", "a constant bias at most>"]


def test_several_findings_are_one_sentence_strongest_first_with_their_gain_and_what_is_left() -> None:
    said = headline(diagnoses.BOTH)
    assert said == (
        "Two effects separate the recording from the true poses: lever_arm (accel) and clock_offset (gyro); together they "
        "remove 90 % of the misfit of the gyro and 87 % of the misfit of the accel; nothing else stands above the noise."
    )
    assert conclusion(diagnoses.BOTH) == f"{said} These logs cannot show: gyro_scale (x), gravity (tilt)."


def test_of_many_findings_the_three_strongest_are_named() -> None:
    weaker = [finding(name, {"k": Estimate(1.0, 0.1, "K")}, "gyro") for name in ("gyro_scale", "gyro_quadratic")]
    five = (diagnoses.LEVER_ARM, diagnoses.LAG, diagnoses.DRIVEN, *weaker)
    said = headline(replace(diagnoses.BOTH, findings=five))
    assert said.startswith("Five effects separate the recording from the true poses: lever_arm (accel), clock_offset (gyro), ")
    assert "driven by /motor.current (accel) and 2 smaller ones; together they remove" in said
    unknown = {signal: replace(closer, share=None) for signal, closer in diagnoses.BOTH.closer.items()}
    said = headline(replace(diagnoses.BOTH, findings=(*five, *weaker), closer=unknown))
    assert said.startswith("7 effects separate ")
    assert "remove" not in said


def test_poses_made_with_the_gyro_are_a_caveat_of_the_headline() -> None:
    caveat = "its poses were estimated with this IMU, and hide errors of the gyro"
    assert headline(replace(diagnoses.BOTH, caveat=caveat)).endswith(f"; {caveat}.")
    assert caveat not in headline(diagnoses.BOTH)


def test_a_parameter_smaller_than_its_deviation_is_no_value() -> None:
    tilt = {f"tilt_{axis}": Estimate(size, 0.001, "rad") for axis, size in (("x", 0.01), ("y", 0.0))}
    tilt = {"magnitude": Estimate(-0.1, 0.2, "m/s²"), **tilt}
    said = headline(replace(diagnoses.ARM, findings=(finding("gravity", tilt),)))
    assert "-0.1" not in said
    assert "tilt_x 0.57 ± 0.06°; magnitude, tilt_y not distinguished from zero (gravity)" in said
    assert table(replace(diagnoses.ARM, findings=(finding("gravity", tilt),)))[1][2].startswith("tilt_x 0.57 ± 0.06°\n")


def test_a_wrong_reference_removes_nothing() -> None:
    wrong = finding("reference_error", {"length": Estimate(2.0, 0.1, "s")}, "both", share=0.94)
    d = replace(diagnoses.BOTH, findings=(wrong,), closer={})
    assert "94 %" not in headline(d)
    assert table(d)[1][1] == "–"


def test_two_sizes_are_told_apart_with_as_many_digits_as_it_takes() -> None:
    assert rms_text(HeldOut(0.8761, 0.8759, "m/s^2", 9.0)) == "rms 0.8761 to 0.8759 m/s²"
    assert rms_text(HeldOut(0.52, 0.19, "m/s^2", 9.0)) == "rms 0.52 to 0.19 m/s²"
    assert rms_text(HeldOut(0.5, 0.5, "m/s^2", 9.0)) == "rms 0.5 to 0.5 m/s²"


def test_a_driver_is_named_with_its_gain_and_lag() -> None:
    said = conclusion(diagnoses.BY_CURRENT)
    assert "it follows /motor.current with gain 0.31 ± 0.02 m/s² per A, lag 120 ± 10 ms (driven);" in said


def test_the_unknown_is_said_to_have_no_name() -> None:
    assert "it follows a smooth curve of angular rate z that has no name among the known effects (unknown)" in conclusion(
        diagnoses.NAMELESS
    )
    equation = finding("unknown", {"a": Estimate(0.3, 0.01, "s²/m")}, equation="accel_x += a f_z^2")
    assert named_sentence(diagnoses.ARM, equation) == (
        "accel_x += a f_z^2, with a 0.300 ± 0.010 s²/m; this has no name among the known effects (unknown)"
    )


def test_what_cannot_be_told_apart_is_said_beside_the_name() -> None:
    one = replace(diagnoses.LAG, similar=("low_pass", "delay"))
    assert named_sentence(diagnoses.LATE, one).endswith("by 12.4 ± 0.3 ms (clock_offset; could as well be low_pass or delay)")


def test_a_place_without_a_name_is_not_passed_over() -> None:
    said = conclusion(diagnoses.UNEXPLAINED)
    assert "The accel differs at angular rate above 0.4 rad/s, and no known effect explains it." in said
    assert "What remains of the accel is 0.2 against 0.05 m/s² of noise, and has no explanation yet." in said


def test_where_nothing_was_compared_it_is_not_said_that_nothing_is_missing() -> None:
    assert conclusion(replace(diagnoses.NOTHING, unexplained={}, sim="sim.mcap")).startswith("Nothing could be compared")


def test_a_finding_of_a_message_explains_its_fields() -> None:
    """A wheel's radius is a finding of /odom: its speeds do not differ without a name."""
    wheels = finding("wheel_radius", {"wheel_0": Estimate(0.02, 0.001, "-")}, signal="/odom")
    place = replace(diagnoses.UNEXPLAINED.located[0], signal="/odom.twist.twist.linear.x")
    left = {place.signal: Unexplained(0.05, 0.05, white=True)}
    assert "no known effect" not in conclusion(replace(diagnoses.ARM, findings=(wheels,), located=(place,), unexplained=left))


@pytest.mark.parametrize(
    ("tau", "words"),
    [(Estimate(86400.0, 1.3e5, "s"), "its bias drifts by [(400.0, -300.0, 500.0) ± 1.0] × 10⁻⁶ rad/s², steadily ("),
     (Estimate(20.0, 1.0, "s"), "its bias drifts by (34.56, -25.92, 43.20) ± 0.09 rad/s in all, tau 20.0 ± 1.0 s (")],
)  # fmt: skip
def test_a_drift_whose_end_the_log_does_not_show_is_told_as_a_rate(tau: Estimate, words: str) -> None:
    amplitudes = {axis: Estimate(value, 0.0864, "rad/s") for axis, value in zip("xyz", (34.56, -25.92, 43.2), strict=True)}
    drift = finding("gyro_bias_drift", {**amplitudes, "tau": tau})
    assert named_sentence(diagnoses.ARM, drift).startswith(words)


def test_a_curve_of_which_no_number_is_distinguished_still_has_a_sentence() -> None:
    curve = replace(diagnoses.NAMELESS.findings[0].curve, variable="t")
    drift = finding("drift", {"c0": Estimate(0.1, 1.0, "m")}, equation="y += curve(t)", curve=curve)
    assert named_sentence(diagnoses.ARM, drift).startswith("it drifts along a smooth curve of the time; c0 not distinguished")


@pytest.mark.parametrize(
    ("effect", "parameters", "words"),
    [
        ("actuator_delay", {"delay": Estimate(0.007, 1e-4, "s")}, "the effort acts 7.00 ± 0.10 ms after it is commanded"),
        ("actuator_delay", {"delay": Estimate(-0.007, 1e-4, "s")}, "the effort is logged 7.00 ± 0.10 ms after it acts"),
        ("gravity", {"magnitude": Estimate(-0.03, 1e-3, "m/s^2")}, "gravity differs from the 9.81 m/s² that poses are given, "),
    ],
)
def test_a_sentence_says_what_a_sign_or_a_reference_means(effect: str, parameters: dict[str, Estimate], words: str) -> None:
    """A negative delay acted before it was commanded, and true poses had a gravity."""
    assert named_sentence(diagnoses.BOTH, finding(effect, parameters)).startswith(words)


def test_an_effect_that_acts_several_times_is_named_once() -> None:
    step = finding("gyro_bias_step", {"x": Estimate(0.01, 1e-4, "rad/s")}, "gyro")
    said = headline(replace(diagnoses.BOTH, findings=(diagnoses.LEVER_ARM, step, step)))
    assert said.startswith(
        "Three effects separate the recording from the true poses: lever_arm (accel) and gyro_bias_step (gyro)"
    )
    assert "gyro_bias_step (gyro) twice; together they remove" in said


@pytest.mark.parametrize(
    ("rms", "white", "words"),
    [
        (0.05, True, "; nothing else stands above the noise."),
        (0.05, False, "has no name. What remains of the accel is as small as the noise, but not white."),
        (
            0.06,
            True,
            "be noise. What remains of the accel is 0.06 against 0.05 m/s² of noise, and may exceed it by chance.",
        ),
        (0.06, False, "has no name. What remains of the accel is 0.06 against 0.05 m/s² of noise, and has no explanation yet."),
    ],
)
def test_what_remains_is_held_against_the_noise(rms: float, white: bool, words: str) -> None:
    left = {"accel": Unexplained(rms, 0.05, white)}
    assert conclusion(replace(diagnoses.ARM, unexplained=left)).endswith(words)


def test_a_null_case_with_coloured_noise_says_so() -> None:
    said = conclusion(replace(diagnoses.NOTHING, unexplained=diagnoses.unexplained(white=False)))
    assert said == f"{NULL} What remains of the accel is as small as the noise, but not white."


def test_a_residual_above_the_noise_is_never_called_nothing() -> None:
    left = {"gyro": Unexplained(0.022, 0.009, white=False)}
    everywhere = Located("gyro", ("x",), ((0.0, 60.0),), "always", 1.0, 1e-5, extent="everywhere")
    found = replace(diagnoses.NOTHING, unexplained=left, located=(everywhere,))
    assert headline(found) == "The gyro differs throughout, and no known effect explains it."


@pytest.mark.parametrize(
    ("extent", "regime", "words"),
    [
        ("everywhere", "always", "The gyro differs throughout: it"),
        (
            "everywhere",
            "always, most with angular rate above 0.4 rad/s",
            "The gyro differs throughout, most with angular rate above 0.4 rad/s: it",
        ),
        ("intermittent", "no regime: it comes and goes", "The gyro differs from time to time: it"),
        ("regime", "when turning", "The gyro differs when turning: it"),
        ("regime", "after 30 s", "The gyro differs after 30 s: it"),
        ("everywhere", "always, most in the first 43 s", "The gyro differs throughout, most in the first 43 s: it"),
        ("regime", "", "The gyro differs: it"),
    ],
)
def test_a_regime_goes_on_after_differs(extent: Extent, regime: str, words: str) -> None:
    assert conclusion(replace(diagnoses.LATE, located=(replace(diagnoses.TURNING, regime=regime, extent=extent),))).startswith(
        words
    )


def test_the_regime_is_that_of_the_largest_share_of_the_same_signal() -> None:
    small = replace(diagnoses.TURNING, regime="always", share=0.1)
    assert conclusion(replace(diagnoses.LATE, located=(small, diagnoses.TURNING, diagnoses.FAST))).startswith(
        "The gyro differs when turning:"
    )


def test_what_was_counted_and_not_fitted_claims_no_gain() -> None:
    steps = finding("quantization", {"gyro_lsb": Estimate(0.001, 1e-6, "rad/s")}, "gyro", held_out=HeldOut(0.0, 0.0, "-", 90.0))
    d = replace(diagnoses.LATE, findings=(steps,))
    assert conclusion(d) == (
        "The gyro differs when turning: it comes in steps of 1.0000 ± 0.0010 mrad/s (quantization); "
        "nothing else stands above the noise."
    )
    assert not any("rms" in line for line in lines(d))


def test_what_is_on_both_sensors_is_said_of_the_sensor() -> None:
    both = replace(diagnoses.LAG, signal="gyro, accel")
    said = conclusion(replace(diagnoses.LATE, findings=(both,)))
    assert said.startswith("Gyro and accel differ when turning: the sensor lags the simulation by 12.4 ± 0.3 ms")
    assert signals("both") == signals("imu") == signals("gyro+accel") == signals("gyro and accel") == ("gyro", "accel")


def test_any_other_signal_goes_by_its_own_name() -> None:
    one = finding("gain", {"gain": Estimate(1.05, 0.002, "-")}, "/odom.twist.twist.linear.x")
    said = conclusion(replace(diagnoses.ARM, located=(), findings=(one,)))
    assert said.startswith("/odom.twist.twist.linear.x differs: its gain is 1.050 ± 0.002 of that of the simulation (gain);")


def test_lines_hold_each_finding_place_gain_and_remark() -> None:
    said = lines(diagnoses.BOTH)
    assert said[0] == headline(diagnoses.BOTH)
    assert said[2] == (
        "1. lever_arm (accel): (0.213, -0.051, 0.120) ± 0.004 m; rms 0.52 to 0.19 m/s² on 30 s of unseen data; "
        "1 in 100 by chance"
    )
    assert said[4] == MEASURE
    assert said[5] == "Where: accel x, y, angular rate above 0.4 rad/s, 12.0 to 48.5 s; 83 % of the misfit"
    assert said[7] == (
        "With everything that was found, over 90 s held out of the search: "
        "gyro rms 0.02 to 0.0074 rad/s, 90 % of the misfit removed; accel rms 0.52 to 0.19 m/s², 87 % of the misfit removed"
    )
    assert said[-1] == diagnoses.BOTH.remarks[0]
    assert len(said) == 9
    assert lines(diagnoses.NOTHING) == [NULL]


def test_many_stretches_are_counted_not_listed() -> None:
    many = Located("gyro", ("x",), tuple((float(k), k + 0.5) for k in range(9)), "", 0.5, 0.01)
    assert lines(replace(diagnoses.NOTHING, located=(many,)))[1] == (
        "Where: gyro x, 0.0 to 0.5 s, 1.0 to 1.5 s, 7 more stretches; 50 % of the misfit"
    )


# ── every effect ──


@pytest.mark.parametrize("effect", CATALOGUE)
def test_every_effect_has_a_sentence_with_its_number_its_unit_and_its_name(effect: str) -> None:
    assert effect in SENTENCES
    said = named_sentence(diagnoses.ARM, finding(effect, {"k": Estimate(3.25, 0.02, "K")}))
    assert "3.25 ± 0.02 K" in said
    assert said.endswith(f"({effect})")


def physics() -> list[object]:
    modules = [m.name for m in pkgutil.iter_modules(imutool.sensor.effects.__path__) if not m.name.startswith("_")]
    found = [getattr(importlib.import_module(f"imutool.sensor.effects.{name}"), "EFFECT", None) for name in modules]
    return [one for one in found if one is not None]


@pytest.mark.parametrize("one", physics(), ids=lambda one: one.name)
def test_a_sentence_leaves_no_quantity_of_a_real_effect_out(one: SimpleNamespace) -> None:
    theta = {n.name: Estimate(n.plausible * (0.71 + 0.1 * k), n.plausible * 0.01, n.unit) for k, n in enumerate(one.parameters)}
    said = named_sentence(diagnoses.ARM, finding(one.name, theta))
    for quantity in grouped(theta):
        assert str(quantity) in said, quantity


def test_an_effect_nobody_wrote_a_sentence_for_is_still_said_with_its_equation_and_numbers() -> None:
    one = finding("vendor_effect", {"k": Estimate(3.25, 0.02, "K")}, equation="accel += k T")
    assert named_sentence(diagnoses.ARM, one) == "it shows vendor_effect, accel += k T, k 3.25 ± 0.02 K (vendor_effect)"
    turned = {f"turned_{axis}": Estimate(size, 0.002, "rad") for axis, size in (("x", 0.0), ("y", 0.0), ("z", 0.046))}
    assert named_sentence(diagnoses.BOTH, finding("reference_error", turned, "both")).startswith(
        "the attitude of the true poses is wrong, not the sensor: it is turned by 2.64 ± 0.11° against gyro and gravity"
    )
    bare = finding("reference_error", {}, equation="the truth is late")
    assert named_sentence(diagnoses.ARM, bare) == "it shows reference_error, the truth is late (reference_error)"


@pytest.mark.parametrize(
    ("effect", "number", "words"),
    [
        ("clock_offset", Estimate(-0.0124, 0.0003, "s"), "it lags the simulation by 12.4 ± 0.3 ms"),  # taken at t + tau
        ("clock_offset", Estimate(0.0124, 0.0003, "s"), "it is ahead of the simulation by 12.4 ± 0.3 ms"),
        ("clock_skew", Estimate(5e-5, 3e-6, "-"), "the clock of the recording runs slow by 50 ± 3 ppm"),  # t (1 + eps)
        ("clock_skew", Estimate(-5e-5, 3e-6, "-"), "the clock of the recording runs fast by 50 ± 3 ppm"),
        ("delay", Estimate(0.2, 0.01, "s"), "it lags the simulation by 200 ± 10 ms"),
    ],
)
def test_signs_become_words(effect: str, number: Estimate, words: str) -> None:
    assert named_sentence(diagnoses.ARM, finding(effect, {"k": number})).startswith(words)


def test_a_jump_says_when_and_how_far() -> None:
    jump = {"t_jump": Estimate(31.02, 0.05, "s"), "step": Estimate(0.02, 0.0004, "s")}
    assert named_sentence(diagnoses.ARM, finding("clock_jump", jump)) == (
        "the clock of the recording jumps by 20.0 ± 0.4 ms at 31.02 ± 0.05 s (clock_jump)"
    )


@pytest.mark.parametrize(
    ("signal", "c", "words"),
    [
        ("gyro", -2.01, "its sign is reversed"),
        ("accel", -1.98, "its sign is reversed"),
        ("gyro", 56.3, "so it is in deg/s instead of rad/s"),
        ("accel", 1.0 / 9.81 - 1.0, "so it is in g instead of m/s²"),
        ("gyro", -0.898, "this has no name among the known effects"),
        ("accel", -1.0, "this has no name among the known effects"),
    ],
)
def test_a_gain_that_is_a_convention_is_told_as_one(signal: str, c: float, words: str) -> None:
    own = {"gyro": "omega", "accel": "f"}[signal]
    term = {"c": Estimate(c, 1e-4, f"- per unit of {own}_x")}
    equation = f"{signal}.x += c {own}_x"
    told = named_sentence(diagnoses.ARM, finding("unknown", term, signal, equation=equation, kind="unknown", axis="x"))
    assert told.endswith(f"; {words} (unknown)")
    other = finding("unknown", term, signal, equation=equation.replace("_x", "_y"), kind="unknown", axis="x")
    assert "no name" in named_sentence(diagnoses.ARM, other)


def test_a_step_says_how_far_and_when() -> None:
    step = {axis: Estimate(value, 4e-4, "rad/s") for axis, value in zip("xyz", (0.0123, -0.0045, 0.0081), strict=True)}
    told = finding("gyro_bias_step", step | {"t_step": Estimate(31.02, 0.05, "s")}, "gyro")
    assert named_sentence(diagnoses.ARM, told) == (
        "its bias steps by (12.3, -4.5, 8.1) ± 0.4 mrad/s at 31.02 ± 0.05 s (gyro_bias_step)"
    )
    told = finding("gyro_scale", {"x": Estimate(0.02, 1e-3, "-"), "t_step": Estimate(31.02, 0.05, "s")}, "gyro")
    assert "from 31.02 ± 0.05 s on" in named_sentence(diagnoses.ARM, told)


def test_a_clock_that_wanders_says_from_where_to_where() -> None:
    offsets = {
        "at_0": Estimate(2.73e-3, 1.1e-4, "s"),
        "at_30": Estimate(6.8e-4, 6e-5, "s"),
        "at_60": Estimate(-5.5e-4, 6e-5, "s"),
        "at_90": Estimate(8e-3, 3e-3, "s"),  # at rest, where no clock shows
    }
    assert named_sentence(diagnoses.ARM, finding("clock_wander", offsets)) == (
        "the clock of the recording wanders, by -0.55 ± 0.06 ms to 2.73 ± 0.11 ms (clock_wander)"
    )


@pytest.mark.parametrize(("tau_s", "words"), [(1.5e-3, "it lags"), (-1.5e-3, "it is ahead of")])
def test_a_late_gyro_is_late_against_the_motion_as_the_accelerometer_may_be_filtered(tau_s: float, words: str) -> None:
    late = finding("gyro_delay", {"tau": Estimate(tau_s, 1e-4, "s")}, "gyro")
    assert named_sentence(diagnoses.ARM, late) == f"{words} the motion by 1.50 ± 0.10 ms (gyro_delay)"


def test_a_limit_that_is_never_reached_is_not_news() -> None:
    limits = {"gyro_limit": Estimate(math.inf, 0.0, "rad/s"), "accel_limit": Estimate(39.2, 0.2, "m/s²")}
    assert (
        named_sentence(diagnoses.ARM, finding("saturation", limits)) == "it stops at its limit of 39.2 ± 0.2 m/s² (saturation)"
    )


# ── numbers ──


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (Estimate(0.01243, 0.00031, "s"), "12.4 ± 0.3 ms"),
        (Estimate(0.01243, 0.00012, "s"), "12.43 ± 0.12 ms"),
        (Estimate(0.01243, 0.000096, "s"), "12.43 ± 0.10 ms"),
        (Estimate(0.01243, 0.05, "s"), "10 ± 50 ms"),
        (Estimate(1.5, 0.2, "s"), "1.5 ± 0.2 s"),
        (Estimate(math.radians(2.5), math.radians(0.3), "rad"), "2.5 ± 0.3°"),
        (Estimate(0.0213, 0.0004, "-"), "2.13 ± 0.04 %"),
        (Estimate(9.81, 0.0, "m/s^2"), "9.81 m/s²"),
        (Estimate(9.81, math.nan, "m/s^2"), "9.81 m/s² (uncertainty unknown)"),
        (Estimate(0.0, 0.002, "m"), "0 ± 2 mm"),
        (Estimate(-0.0004, 0.02, "m"), "0 ± 20 mm"),
        (Estimate(2.1e-5, 3e-7, "rad/s per m/s²"), "(21.0 ± 0.3) × 10⁻⁶ rad/s per m/s²"),
        (Estimate(1234567.0, 30.0, "Hz"), "(1.23457 ± 0.00003) × 10⁶ Hz"),
    ],
)
def test_a_number_is_rounded_to_its_uncertainty_in_a_unit_of_its_size(number: Estimate, words: str) -> None:
    assert value(number) == words


@given(st.floats(1e-9, 1e9), st.floats(1e-4, 10.0), st.sampled_from(["s", "m", "rad", "-", "rad/s", "K"]))
def test_rounding_moves_a_number_by_less_than_its_uncertainty(size: float, relative: float, unit: str) -> None:
    said = value(Estimate(size, size * relative, unit))
    number, band = (float(part) for part in re.findall(r"-?\d+(?:\.\d+)?(?= |\)|$|°)", said.replace("°", " "))[:2])
    raised = re.search(r"× 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", said)
    power = int(raised[1].translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))) if raised else 0
    symbol = said.rpartition("°" if "°" in said else " ")[2] if "°" not in said else "°"
    scale = {"ms": 1e-3, "µs": 1e-6, "mm": 1e-3, "°": math.pi / 180.0, "%": 1e-2, "ppm": 1e-6, "mrad/s": 1e-3}.get(symbol, 1.0)
    scale *= 10.0**power
    assert abs(number * scale - size) <= ROUNDED * size * relative
    assert abs(band * scale - size * relative) <= ROUNDED * size * relative


def test_parameters_that_belong_together_are_grouped_and_words_that_end_like_an_axis_are_not() -> None:
    names = ["x", "y", "z", "tau", "tilt_x", "tilt_y", "frequency", "latency", "xy", "yx"]
    units = dict.fromkeys(["x", "y", "z"], "m") | {"xy": "-", "yx": "-"}
    found = grouped({name: Estimate(1.0, 0.1, units.get(name, "s")) for name in names})
    assert [(one.label, one.axes) for one in found] == [
        ("", ("x", "y", "z")),
        ("tau", ("tau",)),
        ("tilt", ("x", "y")),
        ("frequency", ("frequency",)),
        ("latency", ("latency",)),
        ("", ("xy", "yx")),
    ]


def test_a_vector_rounds_each_component_to_its_own_uncertainty() -> None:
    several = [Estimate(0.2131, 0.0043, "m"), Estimate(-0.0512, 0.031, "m"), Estimate(0.4, 0.3, "m")]
    assert vector(several) == "(0.213, -0.05, 0.4) ± (0.004, 0.03, 0.3) m"


def test_of_a_matrix_the_clearest_three_are_said() -> None:
    matrix = {a + b: Estimate(0.001 * k, 0.001, "-") for k, (a, b) in enumerate((a, b) for a in "xyz" for b in "xyz")}
    assert str(grouped(matrix)[0]) == "(zx 0.60, zy 0.70, zz 0.80) ± 0.10 % and 6 more"


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.63, "63 %"), (0.0, "0 %"), (0.004, "less than 1 %"), (0.0004, "less than 0.1 %"), (0.999, "more than 99 %"),
     (1.0, "100 %"), (-0.1, "-10 %"), (math.nan, "an unknown share")],
)  # fmt: skip
def test_a_share_is_never_nothing_or_all_unless_it_is(share: float, words: str) -> None:
    assert percent(share) == words


def test_a_chance_too_small_for_a_float_is_a_bound() -> None:
    assert chance_text(0.0) == "less than 1 in 10⁹ by chance"
    assert chance_text(5e-7) == "1 in 2 000 000 by chance"
    assert chance_text(0.25) == "25 % by chance"
    assert chance_text(1e-12, short=True) == "below 10⁻⁹"


def test_a_second_simulation_is_named_as_the_source_of_the_gain() -> None:
    again = {signal: replace(one, by="second simulation") for signal, one in diagnoses.BOTH.closer.items()}
    d = replace(diagnoses.BOTH, closer=again)
    assert any(line.startswith("Simulated again with everything that was found, over 90 s held") for line in lines(d))
    assert not any("Simulated again" in line for line in lines(diagnoses.BOTH))
    only_gyro = replace(d, findings=(diagnoses.LAG, replace(diagnoses.LAG, effect="gyro_scale")))
    assert headline(only_gyro).count("of the misfit of") == 1


def test_many_things_that_cannot_be_seen_are_counted() -> None:
    many = replace(diagnoses.NOTHING, not_identifiable=tuple("abcdefgh"))
    assert conclusion(many).endswith("These logs cannot show: a, b, c, d, 4 more effects in whole or part.")


def test_an_axis_that_is_no_measurement_is_named() -> None:
    why = "it reads 3.25 m/s² in every sample"
    stuck = Located("accel", ("y",), ((0.0, 90.0),), f"always: {why}", 1.0, 0.0, reason=why)
    said = conclusion(replace(diagnoses.LATE, located=(diagnoses.TURNING, stuck)))
    assert said.startswith("The gyro differs when turning")
    assert ". The accel's y is no measurement: it reads 3.25 m/s² in every sample." in said


def test_the_table_has_a_row_for_each_finding_no_wider_than_a_terminal() -> None:
    head, *rows = table(diagnoses.BOTH)
    assert head == ["What", "Removes", "Value"]
    assert rows[0] == ["lever_arm (accel)", "71 %", "(0.213, -0.051, 0.120) ± 0.004 m\n1 in 100 by chance"]
    assert all(max(map(len, row[2].split("\n"))) <= 40 for row in rows)


def test_many_entries_of_one_effect_that_cannot_be_seen_are_counted() -> None:
    hidden = tuple(f"gyro_misalignment.{k}" for k in range(9))
    assert conclusion(replace(diagnoses.NOTHING, not_identifiable=hidden)).endswith(
        "show: gyro_misalignment (9 of its numbers)."
    )


def test_a_place_of_one_of_several_logs_names_it() -> None:
    place = replace(diagnoses.FAST, log="folder/second.mcap")
    assert lines(replace(diagnoses.NOTHING, located=(place,)))[1].startswith(
        "Where: second, accel x, y, angular rate above 0.4"
    )
    (like,) = diagnoses.NOTHING.traces
    traces = [replace(like, log=name, path=f"{folder}/real.mcap") for folder, name in (("a", "real"), ("b", "real (2)"))]
    places = [replace(place, log=trace.path) for trace in traces]
    said = lines(replace(diagnoses.NOTHING, located=places, traces=traces))
    assert [line[:22] for line in said[1:]] == ["Where: real, accel x, ", "Where: real (2), accel"]


def test_no_unseen_time_is_not_called_unseen() -> None:
    one = replace(diagnoses.LAG, held_out=HeldOut(0.02, 0.01, "rad/s", 0.0))
    assert "unseen" not in conclusion(replace(diagnoses.LATE, findings=(one,)))


@pytest.mark.parametrize(
    ("effect", "numbers", "said"),
    [
        (
            "gyro_hysteresis",
            {"width": (0.2, "rad/s")},
            "it follows only once the simulation has moved by 0.200 ± 0.010 rad/s, and",
        ),
        ("gyro_hysteresis", {"width": (0.2, "rad/s"), "share": (0.1, "-")}, "10.0 ± 0.5 % of it follows only once"),
        (
            "gyro_hysteresis",
            {"width": (0.2, "rad/s"), "share": (-0.1, "-")},
            "it reads motion of less than 0.200 ± 0.010 rad/s larger",
        ),
        ("low_pass", {"f_c": (9.0, "Hz")}, "(first-order low-pass)"),
        ("low_pass", {"f_c": (9.0, "Hz"), "smoothing_rate": (200.0, "Hz")}, "(exponential smoothing)"),
    ],
)
def test_forms_of_an_effect_have_sentences_of_their_own(effect: str, numbers: dict[str, tuple[float, str]], said: str) -> None:
    parameters = {name: Estimate(value, 0.05 * abs(value), unit) for name, (value, unit) in numbers.items()}
    assert said in conclusion(replace(diagnoses.ARM, findings=(finding(effect, parameters, "gyro"),)))
