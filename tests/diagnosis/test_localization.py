"""Where a misfit lies: the right axes, the right seconds, and the regime in words with its threshold."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.localization import Misfit, locate, locate_findings, locate_residual, regime
from imutool.diagnosis.result import Estimate, Finding, HeldOut, Located
from imutool.diagnosis.settings import LocalizationSettings
from imutool.sensor.samples import IdealMotion

RATE_HZ, DURATION_S = 100.0, 40.0
NOISE = np.array([0.003] * 3 + [0.03] * 3)
T = np.arange(int(RATE_HZ * DURATION_S)) / RATE_HZ
NOTHING = np.zeros((len(T), 6))
THRESHOLD = 0.3  # a second counts if any of it does, and the variable changes by up to 0.7 in one


def wandering(seed: int) -> np.ndarray:
    """A variable that goes up and down slowly, between 0 and about 2."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.02, 0.15, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    return np.abs(np.cos(2.0 * np.pi * np.outer(T, f) + phase).sum(1) / 2.0)


def acting(column: int, rows: np.ndarray, size: float = 5.0) -> np.ndarray:
    out = NOTHING.copy()
    out[rows, column] = size * NOISE[column] * np.sin(2.0 * np.pi * 1.7 * T[rows])
    return out


def test_no_misfit_lies_nowhere() -> None:
    assert locate(Misfit(T, NOTHING, NOISE), {}, {}) == []


def test_a_misfit_far_below_the_noise_lies_nowhere() -> None:
    assert locate(Misfit(T, acting(4, T >= 0.0, 0.05), NOISE), {}, {}) == []


def test_a_misfit_that_is_certain_and_shows_in_no_second_lies_everywhere() -> None:
    weak = acting(4, T >= 0.0, 0.15)
    (one,) = locate(Misfit(T, weak, NOISE), {}, {"accel": 1e-4}, certain=["accel"])
    assert (one.signal, one.axes, one.extent, one.share) == ("accel", ("y",), "everywhere", 1.0)
    assert one.intervals_s == ((0.0, DURATION_S),)
    assert one.p_value == 1e-4
    assert locate(Misfit(T, weak, NOISE), {}, {"accel": 1e-4}) == []
    weak[:, 0] = 1e-3 * NOISE[0] * np.sin(T)  # the gyro does not show what the finding does to both
    assert [one.signal for one in locate(Misfit(T, weak, NOISE), {}, {}, certain=["gyro", "accel"])] == ["accel"]


def test_what_is_certain_lies_where_samples_differ_and_another_signal_nowhere() -> None:
    """A gyro's finding changes the accelerometer by rounding; the log has a hole, behind which nothing acts."""
    t_s = np.concatenate([T[T < 10.0], T[T >= 30.0]])
    weak = (acting(1, T < 10.0, 0.25) + acting(4, T >= 0.0, 0.15))[(T < 10.0) | (T >= 30.0)]
    (one,) = located(t_s, weak, {"gyro": 1e-9, "accel": 0.01})
    assert (one.signal, one.axes, one.extent) == ("gyro", ("y",), "everywhere")
    assert one.intervals_s == ((0.0, 10.0),)


def located(
    t_s: np.ndarray, after: np.ndarray, p_values: dict[str, float], numbers: dict[str, float] | None = None, name: str = "log"
) -> list[Located]:
    """As a diagnosis locates what its findings change."""
    return locate_findings([pair(t_s, after, name)], [np.zeros_like(after)], [after], NOISE, [finding(numbers or {})], p_values)


def pair(t_s: np.ndarray, real: np.ndarray, name: str = "log", band_hz: float | None = None) -> Pair:
    nothing, every = np.zeros_like(real), np.ones(len(real), bool)
    ideal = IdealMotion(t_s, nothing[:, :3], nothing[:, 3:], nothing[:, :3])
    return Pair(name, t_s, real, every, ~every, ideal=ideal, band_hz=band_hz)


def finding(numbers: dict[str, float]) -> Finding:
    parameters = {name: Estimate(value, 0.0, "") for name, value in numbers.items()}
    return Finding("saturation", "gyro", 1.0, 0.0, 0.0, parameters, "", HeldOut(1.0, 0.0, "rad/s", 1.0))


def test_a_sensor_that_clips_or_rounds_shows_no_more_than_its_readings() -> None:
    """What lies beyond a limit, or below a digit, is not where an effect is read."""
    swing = acting(1, T >= 0.0, 20.0) - acting(4, T >= 0.0, 20.0)
    gyro, accel = located(T, swing, {"gyro": 1e-9, "accel": 1e-8})
    assert (gyro.axes, accel.axes) == (("y",), ("y",))
    (alone,) = located(T, swing, {"gyro": 1e-9, "accel": 1e-8}, {"gyro_limit": 1e-12})
    assert alone.signal == "accel"
    (alone,) = located(T, swing, {"gyro": 1e-9, "accel": 1e-8}, {"accel_limit_y": 1e-12, "accel_lsb": 1e-3})
    assert alone.signal == "gyro"
    (alone,) = located(T, swing, {"gyro": 1e-9, "accel": 1e-8}, {"accel_lsb": 41.0 * NOISE[3]})
    assert alone.signal == "gyro"


def test_logs_and_stretches_have_their_own_constants_and_the_surer_signal_comes_first() -> None:
    misfit = acting(1, (T >= 12.0) & (T < 19.0)) + acting(5, (T >= 2.0) & (T < 6.0))
    first, names = T < 20.0, ("a", "a", "b")
    rows = [first, ~first, np.ones(len(T), bool)]
    shifted = [misfit[row] + shift * NOISE for row, shift in zip(rows, (0.0, 7.0, 3.0), strict=True)]
    pairs = [pair(T[row], after, name) for row, after, name in zip(rows, shifted, names, strict=True)]
    before = [np.zeros_like(after) for after in shifted]
    p_values = {"gyro": 1e-5, "accel": 1e-9}
    found = locate_findings(pairs, before, shifted, NOISE, [], p_values)
    assert [(one.signal, one.log) for one in found] == [("accel", "a"), ("accel", "b"), ("gyro", "a"), ("gyro", "b")]
    assert {one.intervals_s for one in found} == {((2.0, 6.0),), ((12.0, 19.0),)}
    assert {one.log for one in locate_findings(pairs[:2], before[:2], shifted[:2], NOISE, [], p_values)} == {""}


def test_a_misfit_of_one_sign_is_off_the_constant_of_most_samples() -> None:
    """They differ by more than rounding: a body at rest trembles. The mean would put a misfit where there is none."""
    misfit = 0.01 * NOISE * np.random.default_rng(0).normal(size=(len(T), 6))
    misfit[(T >= 12.0) & (T < 19.0), 4] += 5.0 * NOISE[4]
    (one,) = locate(Misfit(T, misfit, NOISE), {}, {})
    assert one.intervals_s == ((12.0, 19.0),)


def test_the_share_is_that_of_the_seconds_that_are_named() -> None:
    rows = (T >= 12.0) & (T < 19.0)
    (one,) = locate(Misfit(T, acting(4, rows) + acting(4, ~rows, 0.4), NOISE), {}, {})
    assert one.intervals_s == ((12.0, 19.0),)
    assert one.share == pytest.approx(7.0 * 25.0 / (7.0 * 25.0 + 33.0 * 0.16), abs=2e-3)


def test_a_log_of_one_second_has_its_misfit_everywhere() -> None:
    (one,) = locate(Misfit(T[:90], acting(4, T >= 0.0)[:90], NOISE), {"time": ("s", T[:90])}, {})
    assert (one.extent, one.regime) == ("everywhere", "always")


@pytest.mark.parametrize(
    ("rate_hz", "noisier", "f_hz"), [(50.0, 1.0, 3.0), (200.0, 1.0, 3.0), (200.0, 3.0, 3.0), (100.0, 1.0, 23.0)]
)
def test_a_residual_lies_where_it_stands_out_of_the_noise(rate_hz: float, noisier: float, f_hz: float) -> None:
    """A burst on one axis of noise, also where the noise is more than is known, or a mean holds its ends alone."""
    t_s, rng = np.arange(int(80.0 * rate_hz)) / rate_hz, np.random.default_rng(5)
    residual = noisier * NOISE * rng.normal(size=(len(t_s), 6))
    alone = located_residual(residual, rate_hz)
    assert [(one.signal, one.intervals_s) for one in alone] == [("gyro", ((0.0, 80.0),))], "certain, and in no second"
    residual[:, 1] += 15.0 * NOISE[1] * np.sin(2.0 * np.pi * f_hz * t_s) * ((t_s >= 30.5) & (t_s < 39.5))
    (one,) = located_residual(residual, rate_hz)
    assert (one.signal, one.axes, one.intervals_s) == ("gyro", ("y",), ((30.0, 40.0),))
    residual[:, 4] = residual[:, 1] * NOISE[4] / NOISE[1]  # of a signal that is white as a whole nothing is said
    assert len(located_residual(residual, rate_hz)) == 1
    poses = located_residual(residual, rate_hz, band_hz=8.0)  # which know no motion that a mean loses
    assert [one.intervals_s for one in poses] == [((30.0, 40.0),) if f_hz < 8.0 else ((0.0, 80.0),)]


def test_a_residual_lies_in_the_larger_part_of_a_log_and_on_an_axis_of_little_noise_alone() -> None:
    t_s, rng = np.arange(8000) / 100.0, np.random.default_rng(5)
    noise = NOISE * [1.0, 1.0, 0.3, 1.0, 1.0, 1.0] * rng.normal(size=(len(t_s), 6))
    noise[t_s > 79.0, 2] *= 3.0  # still less than the noise that is known
    for end_s in (40.0, 80.0):
        residual = noise.copy()
        residual[:, 1] += 3.0 * NOISE[1] * np.sin(2.0 * np.pi * 3.0 * t_s) * ((t_s >= 30.0) & (t_s < end_s))
        (one,) = located_residual(residual, 100.0)
        assert (one.axes, one.intervals_s) == (("y",), ((30.0, end_s),))


def located_residual(residual: np.ndarray, rate_hz: float, band_hz: float | None = None) -> list[Located]:
    """As a diagnosis locates what no finding explains."""
    of = pair(np.arange(len(residual)) / rate_hz, residual, band_hz=band_hz)
    return locate_residual([of], [np.zeros_like(residual)], NOISE, {"gyro": 1e-9})


@pytest.mark.parametrize("column", range(6))
def test_axis_and_seconds_are_those_in_which_it_acts(column: int) -> None:
    (one,) = locate(Misfit(T, acting(column, (T >= 12.0) & (T < 19.0)), NOISE), {}, {"gyro": 1e-9, "accel": 1e-7})
    assert one.signal == ("gyro" if column < 3 else "accel")
    assert one.axes == ("xyz"[column % 3],)
    assert one.intervals_s == ((12.0, 19.0),)
    assert one.share == pytest.approx(1.0)
    assert one.p_value == (1e-9 if column < 3 else 1e-7)


@pytest.mark.parametrize(("begins_s", "words"), [(12.6, "after 12 s"), (27.3, "after 27 s")])
def test_what_sets_in_is_there_from_then_on_also_before_the_middle_of_a_log(begins_s: float, words: str) -> None:
    """The median took off what had set in: a scale from 12.6 s on was always there, and one from 27.3 s on from 27 s on."""
    misfit = NOTHING + 0.1 + 1e-9 * NOISE * np.sin(T)[:, None]  # the best constant is of both parts, but for rounding
    misfit[:, 4] += np.where(begins_s > T, 0.0, 0.1 * (9.81 + np.sin(T)))
    (one,) = locate(Misfit(T, misfit, NOISE), {"time": ("s", T)}, {})
    assert (one.axes, one.regime) == (("y",), words)
    assert np.array(one.intervals_s) == pytest.approx(np.array([[begins_s, DURATION_S]]))
    step = NOTHING.copy()
    step[:, 1] = np.where(begins_s > T, 0.0, 0.1)  # the bias is that of the longer part
    (one,) = locate(Misfit(T, step, NOISE), {"time": ("s", T)}, {})
    ends = (begins_s, DURATION_S) if begins_s > DURATION_S / 2.0 else (0.0, begins_s)
    assert np.array(one.intervals_s) == pytest.approx(np.array([ends]), abs=0.02)


def test_intervals_are_on_the_clock_that_is_given() -> None:
    (one,) = locate(Misfit(T + 5.0, acting(4, (T >= 12.0) & (T < 19.0)), NOISE), {}, {})
    assert one.intervals_s == ((17.0, 24.0),)


def test_stretches_far_apart_stay_apart_and_close_ones_join() -> None:
    rows = ((T >= 5.0) & (T < 8.0)) | ((T >= 20.0) & (T < 24.0)) | ((T >= 25.0) & (T < 40.0))
    (one,) = locate(Misfit(T, acting(3, rows), NOISE), {}, {})
    assert one.intervals_s == ((5.0, 8.0), (20.0, 24.0), (25.0, 40.0))


def test_an_axis_that_is_only_touched_is_not_named() -> None:
    rows = (T >= 5.0) & (T < 15.0)
    (one,) = locate(Misfit(T, acting(3, rows, 20.0) + acting(4, rows, 1.0) + acting(5, rows, 15.0), NOISE), {}, {})
    assert one.axes == ("x", "z")


def test_both_signals_are_told_the_surer_first() -> None:
    rows = (T >= 5.0) & (T < 15.0)
    found = locate(Misfit(T, acting(0, rows) + acting(5, rows), NOISE), {}, {"gyro": 1e-3, "accel": 1e-8})
    assert [(one.signal, one.axes) for one in found] == [("accel", ("z",)), ("gyro", ("x",))]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("word", ["above", "below"])
def test_the_regime_is_the_variable_with_its_threshold(word: str, seed: int) -> None:
    rate, other = wandering(seed), wandering(seed + 100)
    at = float(np.quantile(rate, 0.5))
    rows = rate > at if word == "above" else rate < at
    variables = {"temperature": ("°C", 20.0 + other), "angular rate": ("rad/s", rate), "time": ("s", T)}
    variables["speed"] = ("m/s", rate + 0.5 * other)  # goes with it, and separates less
    (one,) = locate(Misfit(T, acting(4, rows), NOISE), variables, {})
    said = re.fullmatch(r"angular rate (above|below) (\S+) rad/s", one.regime)
    assert said is not None, one.regime
    assert said[1] == word
    assert abs(float(said[2]) - at) < THRESHOLD
    inside = np.zeros(len(T), bool)
    for begin, end in one.intervals_s:
        inside |= (begin <= T) & (end > T)
    both = (inside & rows).sum()
    assert 2.0 * both / (inside.sum() + rows.sum()) > 0.8  # F1 of its seconds


def test_a_large_threshold_is_a_plain_number() -> None:
    rate = wandering(1)
    (one,) = locate(Misfit(T, acting(4, rate > np.quantile(rate, 0.5)), NOISE), {"effort": ("N m", 500.0 * rate)}, {})
    assert re.fullmatch(r"effort above -?\d+ N m", one.regime), one.regime


def test_a_misfit_that_grows_with_a_variable_is_always_there_most_where_that_is_large() -> None:
    rate = wandering(3) + 0.3
    misfit = NOTHING.copy()
    misfit[:, 1] = 10.0 * NOISE[1] * rate * np.sin(2.0 * np.pi * 1.7 * T)
    (one,) = locate(Misfit(T, misfit, NOISE), {"other": ("", wandering(50)), "angular rate": ("rad/s", rate)}, {})
    assert one.regime.startswith("always, most with angular rate above")
    assert one.intervals_s == ((0.0, 40.0),)
    (one,) = locate(Misfit(T, acting(4, T >= 20.0, 10.0) + acting(4, T < 20.0, 2.0), NOISE), {"time": ("s", T)}, {})
    assert one.regime == "always, most after 20 s"


@pytest.mark.parametrize(("rows", "words"), [(T < 23.0, "in the first 23 s"), (T >= 23.0, "after 23 s")])
def test_a_regime_of_the_time_is_a_part_of_the_log(rows: np.ndarray, words: str) -> None:
    (one,) = locate(Misfit(T, acting(4, rows), NOISE), {"time": ("s", T)}, {})
    assert one.regime == words


def test_what_follows_none_of_the_variables_is_given_none() -> None:
    rng = np.random.default_rng(0)
    rows = (rng.random(40) < 0.5)[np.floor(T).astype(int)]
    (one,) = locate(
        Misfit(T, acting(4, rows), NOISE),
        {"angular rate": ("rad/s", wandering(7)), "tilt": ("rad", wandering(8))},
        {},
    )
    assert one.regime == "no regime: it comes and goes"


def test_a_regime_is_no_chance_among_its_variables_and_separates_most_seconds() -> None:
    """One of twelve has a p-value of 6e-4 alone; and of 400 seconds a loose relation is certain."""
    rng = np.random.default_rng(187)
    inside, values = rng.random(60) < 0.5, rng.normal(size=(12, 60))
    many = {str(k): ("", column) for k, column in enumerate(values)}
    assert regime(inside, 1.0 * inside, np.arange(60), many, LocalizationSettings())[0] == "intermittent"
    loose = np.random.default_rng(0).normal(size=(2, 400)) * [[1.0], [3.0]]
    inside = loose.sum(axis=0) > 0.0
    assert regime(inside, 1.0 * inside, np.arange(400), {"x": ("", loose[0])}, LocalizationSettings())[0] == "intermittent"


def test_a_variable_that_never_changes_is_no_regime() -> None:
    rows = (T >= 12.0) & (T < 19.0)
    (one,) = locate(Misfit(T, acting(4, rows), NOISE), {"tilt": ("rad", np.zeros(len(T)))}, {})
    assert "tilt" not in one.regime


def test_stretches_of_one_log_are_placed_on_its_clock_and_the_hole_between_them_is_nowhere() -> None:
    there = (T < 10.0) | (T >= 30.0)
    t_s, misfit = T[there], acting(1, np.ones(len(T), bool))[there]
    (one,) = locate(Misfit(t_s, misfit, NOISE), {}, {"gyro": 1e-9})
    assert one.intervals_s == ((0.0, 10.0), (30.0, DURATION_S))


def test_a_channel_that_one_segment_lacks_is_no_variable_of_the_log() -> None:
    first = T < 20.0
    alone = replace(pair(T[first], NOTHING[first]), channels={"/load": T[first]})
    pairs = [alone, pair(T[~first], NOTHING[~first])]  # constant there
    before, misfit = [NOTHING[first], NOTHING[~first]], acting(1, np.ones(len(T), bool))
    (one,) = locate_findings(pairs, before, [misfit[first], misfit[~first]], NOISE, [], {"gyro": 1e-9})
    assert one.intervals_s == ((0.0, DURATION_S),)
