"""Where a misfit lies: the right axes, the right seconds, and the regime in words with its threshold."""

from __future__ import annotations

import re

import numpy as np
import pytest

from imutool.diagnosis.estimation.aligned_log import Pair
from imutool.diagnosis.localization import Misfit, locate, locate_findings, locate_residual
from imutool.diagnosis.result import Located
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


def located_residual(residual: np.ndarray, rate_hz: float) -> list[Located]:
    """As a diagnosis locates what no finding explains."""
    t_s, every, nothing = np.arange(len(residual)) / rate_hz, np.ones(len(residual), bool), np.zeros_like(residual)
    ideal = IdealMotion(t_s, nothing[:, :3], nothing[:, 3:], nothing[:, :3])
    pair = Pair("log", t_s, residual, every, ~every, ideal=ideal)
    return locate_residual([pair], [nothing], NOISE, {"gyro": 1e-9})


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
    misfit = NOTHING + 0.1  # the best constant is of both parts
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
    rows = ((T >= 5.0) & (T < 8.0)) | ((T >= 20.0) & (T < 24.0)) | ((T >= 30.0) & (T < 40.0))
    (one,) = locate(Misfit(T, acting(3, rows), NOISE), {}, {})
    assert one.intervals_s == ((5.0, 8.0), (20.0, 24.0), (30.0, 40.0))


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


@pytest.mark.parametrize(("rows", "words"), [(T < 23.0, "in the first 23 s"), (T >= 23.0, "after 23 s")])
def test_a_regime_of_the_time_is_a_part_of_the_log(rows: np.ndarray, words: str) -> None:
    (one,) = locate(Misfit(T, acting(4, rows), NOISE), {"time": ("s", T)}, {})
    assert one.regime == words


def test_what_follows_none_of_the_variables_is_given_none() -> None:
    rng = np.random.default_rng(0)
    rows = (rng.random(40) < 0.5)[np.floor(T).astype(int)]
    (one,) = locate(
        Misfit(T, acting(4, rows), NOISE), {"angular rate": ("rad/s", wandering(7)), "tilt": ("rad", wandering(8))}, {}
    )
    assert one.regime == "no regime: it comes and goes"


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
    ideal = IdealMotion(T, NOTHING[:, :3], NOTHING[:, 3:], NOTHING[:, :3])
    first, every = T < 20.0, np.ones(len(T) // 2, bool)
    alone = Pair("log", T[first], NOTHING[first], every, ~every, ideal=ideal, channels={"/load": T[first]})
    pairs = [alone, Pair("log", T[~first], NOTHING[~first], every, ~every, ideal=ideal)]  # constant there
    before, misfit = [NOTHING[first], NOTHING[~first]], acting(1, np.ones(len(T), bool))
    (one,) = locate_findings(pairs, before, [misfit[first], misfit[~first]], NOISE, [], {"gyro": 1e-9})
    assert one.intervals_s == ((0.0, DURATION_S),)
