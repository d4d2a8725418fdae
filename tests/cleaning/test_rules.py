"""Each defect planted in a made-up flight is found where it is, as often as it is, and nothing else; where none is, none."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
from support.imu_defects import batch_of, late, pick, repeated, with_values, without

from imutool.cleaning.finding import Finding
from imutool.cleaning.rule import CleaningSettings
from imutool.cleaning.rules import saturation
from imutool.cleaning.rules.time_back import Epoch, left_out
from imutool.cleaning.survey import Survey, examine
from imutool.cleaning.truth import Truth
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.recording import GRAVITY_M_S2, Poses
from imutool.sensor.made_up_flight import flight

HOUR_NS = 3_600_000_000_000
HALF_A_SECOND_NS = 500_000_000
PART = 64  # samples: to within so many `changed_rate` knows where a rate changes
DEGREES = 180.0 / np.pi


@pytest.fixture(scope="module")
def made() -> ImuBatch:
    return batch_of(flight(3, duration_s=40.0).imu)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of(flight(3, duration_s=40.0).truth)


def truth_of(poses: Poses) -> Truth:
    return Truth("/ground_truth/pose", poses.t_ns[::12], poses.p_wb[::12], poses.q_wb_wxyz[::12])


def look(batch: ImuBatch, truth: Truth | None = None, rules: CleaningSettings | None = None) -> Survey:
    return examine(lambda: [batch], truth, rules, where="made.mcap", topic="/imu0")


def found(survey: Survey) -> dict[str, int]:
    """Counts by rule."""
    counts: dict[str, int] = {}
    for one in survey.findings:
        counts[one.rule] = counts.get(one.rule, 0) + one.count
    return counts


def only(survey: Survey, rule: str) -> Finding:
    """The one finding there is."""
    (one,) = survey.findings
    assert one.rule == rule
    return one


def spikes(batch: ImuBatch, rows: list[int]) -> ImuBatch:
    for row in rows:
        batch = with_values(batch, row, 3 + row % 3, 60.0, add=True)
    return batch


def half_the_rate(batch: ImuBatch) -> ImuBatch:
    return without(batch, np.arange(4001, 5001, 2))


def clipped(batch: ImuBatch) -> ImuBatch:
    limit = np.quantile(batch.gyro[:, 2], 0.97)
    return with_values(batch, slice(None), 2, np.minimum(batch.gyro[:, 2], limit))


def stuck(batch: ImuBatch) -> ImuBatch:
    frozen = np.concatenate([batch.gyro[3000], batch.accel[3000]])
    return with_values(batch, slice(3001, 3041), slice(None), frozen)


def shifted(batch: ImuBatch, rows: slice | list[int], by_ns: int) -> ImuBatch:
    stamp_ns = batch.stamp_ns.copy()
    stamp_ns[rows] += by_ns
    return batch._replace(stamp_ns=stamp_ns)


ROWS = [700, 1500, 2300, 6100]
# each at places of its own, so that any two can be planted together; those that reorder come last
PLANTS: dict[str, tuple[str, int, Callable[[ImuBatch], ImuBatch]]] = {
    "spikes": ("spikes", 4, lambda b: spikes(b, [row + 100 for row in ROWS])),
    "not finite": ("not_finite", 4, lambda b: with_values(b, [row + 200 for row in ROWS], 1, np.nan)),
    "stuck": ("stuck", 40, stuck),
    "saturation": ("saturation", -1, clipped),
    "stamps ahead": ("time_back", 4, lambda b: shifted(b, [row + 300 for row in ROWS], HOUR_NS)),
    "clock jump": ("clock_jumps", 1, lambda b: shifted(b, slice(5500, None), HALF_A_SECOND_NS)),
    "recorder's clock": ("clock_jumps", 1, lambda b: b._replace(log_time=b.log_time + HALF_A_SECOND_NS * (b.sequence > 7000))),
    "late": ("time_back", 4, lambda b: late(b, [row + 400 for row in ROWS])),
    "duplicates": ("duplicates", 4, lambda b: repeated(b, ROWS, 30)),
    "gap": ("gaps", 25, lambda b: without(b, slice(2650, 2675))),
}


def test_none_planted_none_found(made, truth):
    for poses in (truth, None):
        survey = look(made, poses)
        assert survey.findings == ()
        assert (survey.verdict, survey.score, survey.valid) == ("good", 1.0, len(made.stamp_ns))


@pytest.mark.parametrize("seed", range(4, 9))
def test_none_is_found_in_other_flights(seed):
    recording = flight(seed, duration_s=20.0)
    assert look(batch_of(recording.imu), truth_of(recording.truth)).findings == ()


def expected(name: str, planted: ImuBatch) -> tuple[str, int]:
    rule, count, _ = PLANTS[name]
    if name == "saturation":
        count = int((planted.gyro[:, 2] == np.nanmax(planted.gyro[:, 2])).sum())
    return rule, count


@pytest.mark.parametrize("name", PLANTS)
def test_each_is_found_as_often_as_it_was_planted_and_nothing_else(name, made, truth):
    planted = PLANTS[name][2](made)
    assert found(look(planted, truth)) == dict([expected(name, planted)])


@pytest.mark.parametrize("pair", list(combinations(PLANTS, 2)), ids=" and ".join)
def test_any_two_are_both_found(pair, made):
    planted = made
    counts: dict[str, int] = {}
    for name in pair:
        planted = PLANTS[name][2](planted)
        rule, count = expected(name, planted)
        counts[rule] = counts.get(rule, 0) + count
    assert found(look(planted)) == counts


def test_a_spike_is_found_where_it_is_on_the_axis_it_is_on(made):
    one = only(look(with_values(made, slice(2000, 2003), 4, -80.0, add=True)), "spikes")
    assert one.intervals_ns == ((int(made.stamp_ns[2000]), int(made.stamp_ns[2002])),)
    assert one.values["axes"] == {"accel.y": 3}
    assert one.values["largest_step"]["accel.y"] == pytest.approx(80.0, rel=0.05)
    assert one.action == "dropped"


def test_a_shock_that_rings_is_no_spike(made):
    t = np.arange(60) / 200.0
    ring = 120.0 * np.exp(-t / 0.03) * np.cos(2 * np.pi * 45.0 * t)
    assert look(with_values(made, slice(2000, 2060), 5, ring, add=True)).findings == ()


def test_a_step_is_no_spike(made):
    assert "spikes" not in found(look(with_values(made, slice(4000, 4200), 0, 3.0, add=True)))


def test_values_beyond_any_sensor_are_dropped(made):
    one = only(look(with_values(made, slice(2000, 2050), 3, 1e30)), "not_finite")
    assert one.count == 50


def test_stuck_samples_but_the_first_are_dropped(made):
    survey = look(stuck(made))
    assert np.flatnonzero(survey.dropped).tolist() == list(range(3001, 3041))
    one = only(survey, "stuck")
    assert one.intervals_ns == ((int(made.stamp_ns[3001]), int(made.stamp_ns[3040])),)


def test_a_gyro_within_one_count_while_the_accelerometer_moves_is_left_out(made):
    """Two of its axes alternate between two counts, as those of a board that failed."""
    count, rows = 0.002, slice(3000, 3500)
    coarse = made._replace(gyro=np.round(made.gyro / count) * count)
    failed, at_rest = coarse.gyro.copy(), coarse.accel.copy()
    failed[rows] = count * (np.array([382, 382, 384]) + np.arange(500)[:, None] // [7, 3, 1000] % 2)
    at_rest[rows] = at_rest[3000] + 0.01 * np.arange(500)[:, None] % 0.05
    survey = look(coarse._replace(gyro=failed))
    assert np.flatnonzero(survey.dropped).tolist() == list(range(3000, 3500))
    assert {one.count for one in survey.findings if one.action == "dropped"} == {500}
    assert not look(coarse).dropped.any()
    assert not look(coarse._replace(gyro=failed, accel=at_rest)).dropped.any()  # of another bias


def test_a_noiseless_sensor_at_rest_is_not_stuck(made):
    """Smooth motion without noise, then rest: nothing is dropped, and it is said."""
    t = np.arange(8000) / 200.0
    smooth = np.sin(0.7 * t)[:, None] * np.array([0.3, -0.2, 0.5]) * (t < 30.0)[:, None]
    still = made._replace(
        gyro=smooth[: len(made.stamp_ns)], accel=np.array([0.0, 0.0, GRAVITY_M_S2]) + 2.0 * smooth[: len(made.stamp_ns)]
    )
    still = pick(still, np.arange(8000))
    survey = look(still)
    assert not survey.dropped.any()
    assert {one.severity for one in survey.findings if one.what.startswith("samples that repeat")} == {"note"}


def test_an_axis_that_stands_still_is_said_and_distrusted_when_it_does_for_long(made):
    short = look(with_values(made, slice(1000, 1300), 1, 0.0123))
    assert only(short, "stuck").values["axis"] == "gyro.y"
    assert (only(short, "stuck").count, short.verdict) == (300, "usable")
    assert only(short, "stuck").intervals_ns == ((int(made.stamp_ns[1000]), int(made.stamp_ns[1299])),)
    long = look(with_values(made, slice(1000, 5000), 1, 0.0123))
    assert long.verdict == "quarantine"
    assert "gyro.y stands still" in long.reasons[0]


def test_values_held_by_a_topic_faster_than_its_sensor_are_said(made):
    held = pick(made, np.repeat(np.arange(2000), 4))._replace(stamp_ns=made.stamp_ns[:8000], log_time=made.log_time[:8000])
    survey = look(held)
    assert found(survey) == {"stuck": 6000}
    assert survey.valid == 8000


def test_the_earlier_of_equal_stamps_stays_and_equal_content_is_counted(made):
    twice = repeated(made, ROWS)
    other = with_values(twice, 701, 0, 0.5, add=True)
    one = only(look(other), "duplicates")
    assert (one.count, one.values["identical"]) == (4, 3)
    assert np.flatnonzero(look(other).dropped)[0] == 701


def test_a_clock_set_back_costs_what_comes_twice(made):
    """A tenth of a second lived through again: its samples are late until the clock is where it was."""
    survey = look(shifted(made, slice(4000, None), -100_001_000))
    counts = found(survey)
    assert counts == {"time_back": 20, "clock_jumps": 1}
    jump = next(one for one in survey.findings if one.rule == "clock_jumps")
    assert jump.values["clock"] == "stamp"
    assert jump.values["jumps_s"] == [pytest.approx(-0.1, abs=1e-3)]
    assert survey.missing == 0


@pytest.mark.parametrize("by_ns", [-3_000_000_000, -500_000_000, -501_700_000, -100_001_000])
def test_motion_that_is_missing_where_the_clock_was_set_back_is_said(by_ns, made):
    """The recorder's clock too: stamps that came twice were called duplicates, and the lost motion was not told."""
    back = shifted(made, slice(4000, None), by_ns)
    survey = look(back._replace(log_time=back.stamp_ns))
    (one,) = (each for each in survey.findings if each.rule == "time_back")
    assert one.values["set_back"] == 1
    assert one.values["missing_s"] == pytest.approx(-by_ns * 1e-9, abs=0.006)
    assert "the clock was set back" in one.what
    assert found(survey).get("duplicates", 0) <= 1


def test_a_burst_that_comes_late_is_no_clock_set_back(made):
    order = np.r_[0:4000, 4050:4100, 4000:4050, 4100 : len(made.stamp_ns)]
    burst = pick(made, order)
    survey = look(burst._replace(log_time=np.sort(burst.log_time)))
    assert "set_back" not in only(survey, "time_back").values


@pytest.mark.parametrize("part", [slice(0, 1500), slice(6000, None)], ids=["before", "after"])
@pytest.mark.parametrize("by", [-HOUR_NS * 24 * 400, HOUR_NS, 30 * HOUR_NS])
def test_of_two_settings_of_the_clock_the_longer_part_stays(part, by, made):
    survey = look(shifted(made, part, by))
    inside = np.zeros(len(made.stamp_ns), bool)
    inside[part] = True
    if by == HOUR_NS and part.start:  # an hour forward may be true
        assert not survey.dropped.any()
        assert found(survey) == {"clock_jumps": 1}
        assert survey.missing == 0
    else:
        assert (survey.dropped == inside).all()
        assert survey.verdict == "quarantine"
        assert "are invalid" in survey.reasons[0]


def test_stamps_that_nobody_filled_in_are_not_guessed(made):
    survey = look(made._replace(stamp_ns=np.zeros_like(made.stamp_ns)))
    assert survey.verdict == "quarantine"
    assert survey.valid == 1


def test_half_the_rate_is_another_rate_and_nothing_is_missing(made):
    survey = look(half_the_rate(made))
    one = only(survey, "changed_rate")
    assert abs(one.count - 500) <= 2 * PART
    assert one.values["usual_hz"] == pytest.approx(200.0)
    assert one.values["rates_hz"] == [pytest.approx(100.0)]
    assert survey.verdict == "quarantine"


def test_a_gap_has_its_place_its_length_and_its_count(made):
    one = only(look(without(made, slice(2000, 2100))), "gaps")
    assert one.intervals_ns == ((int(made.stamp_ns[1999]), int(made.stamp_ns[2100])),)
    assert one.count == 100
    assert one.values["longest_s"] == pytest.approx(0.505)


def test_a_pause_of_the_recording_is_said_and_nothing_is_missing(made):
    later = np.where(np.arange(len(made.stamp_ns)) < 3000, 0, 20 * HOUR_NS)
    survey = look(made._replace(stamp_ns=made.stamp_ns + later, log_time=made.log_time + later))
    assert (only(survey, "gaps").count, survey.missing, survey.verdict, survey.score) == (1, 0, "good", 1.0)


def test_a_log_with_half_of_it_missing_is_not_trusted(made):
    survey = look(without(made, slice(1000, 5000)))
    assert survey.verdict == "quarantine"
    assert "are missing" in survey.reasons[0]


@pytest.mark.parametrize(("unit", "factor"), [("g", 9.80665), ("mg", 9.80665e-3), ("mm/s^2", 1e-3), ("ft/s^2", 0.3048)])
def test_gravity_settles_the_accelerometers_unit(unit, factor, made):
    survey = look(made._replace(accel=made.accel / factor))
    one = only(survey, "units")
    assert (one.values["unit"], one.action) == (unit, "converted")
    assert survey.scale.tolist() == [1.0] * 3 + [factor] * 3


def test_true_poses_settle_the_gyros_unit(made, truth):
    survey = look(made._replace(gyro=made.gyro * DEGREES), truth)
    assert only(survey, "units").action == "converted"
    assert survey.scale[:3] == pytest.approx(1.0 / DEGREES)
    assert survey.verdict == "usable"


def test_both_units_are_settled_together(made, truth):
    survey = look(made._replace(gyro=made.gyro * DEGREES, accel=made.accel / 9.80665), truth)
    assert found(survey) == {"units": 6}
    assert survey.scale == pytest.approx([1.0 / DEGREES] * 3 + [9.80665] * 3)


@pytest.mark.parametrize(("step", "factor"), [(250 / 2**15, 1.0 / DEGREES), (np.deg2rad(250 / 2**15), 1.0), (0.01, 1.0)])
def test_the_steps_of_a_register_settle_the_gyros_unit_at_rest(step, factor, made):
    """As a driver of a hobby sensor that sends its deg/s as rad/s; other steps show none."""
    counts = np.round(np.random.default_rng(5).normal(20.0, 8.0, made.gyro.shape))
    still = np.array([0.3, -0.2, 9.8]) + np.random.default_rng(6).normal(0.0, 0.01, made.accel.shape)
    survey = look(made._replace(gyro=np.round(counts * step, 6), accel=still))
    assert survey.scale[:3] == pytest.approx(factor)
    assert [one.what for one in survey.findings] == (
        [f"gyro is in deg/s, not rad/s: it counts in steps of {step:.6g} deg/s, as a common sensor does"] if factor != 1 else []
    )


def test_units_are_only_said_when_asked_so(made, truth):
    survey = look(made._replace(gyro=made.gyro * DEGREES), truth, CleaningSettings(convert_units=False))
    assert only(survey, "units").action == "flagged"
    assert (survey.scale == 1.0).all()
    assert survey.verdict == "quarantine"


def test_an_unknown_unit_is_not_guessed(made):
    survey = look(made._replace(accel=made.accel * 17.0))
    assert (only(survey, "units").action, survey.verdict) == ("flagged", "quarantine")
    assert "unknown" in survey.reasons[0]


def test_acceleration_without_gravity_is_not_trusted(made):
    survey = look(made._replace(accel=0.05 * np.random.default_rng(1).normal(size=made.accel.shape)))
    assert "accel has no gravity in it" in survey.reasons


def test_noise_as_large_as_gravity_is_not_taken_for_a_reading_in_g(made):
    """Random numbers of a test publisher: means of a second read 1, as a log in g does."""
    survey = look(made._replace(accel=np.random.default_rng(3).uniform(-9.9, 9.9, made.accel.shape)))
    assert any(reason.startswith("the unit of accel is unknown") for reason in survey.reasons)
    assert (survey.scale[3:] == 1.0).all()


def test_gravity_in_a_body_that_spins_within_a_second_is_gravity(made):
    """As a phone that is spun for the magnetometer: in means of a second gravity is gone."""
    phase = 2 * np.pi * np.linspace(0.0, 1.0, len(made.accel)) * len(made.accel) / 200.0
    spun = 9.81 * np.stack([np.sin(phase), np.cos(phase), 0 * phase], axis=1)
    survey = look(made._replace(accel=spun + 0.5 * np.random.default_rng(1).normal(size=spun.shape)))
    assert not any("accel" in reason for reason in survey.reasons)
    assert (survey.scale[3:] == 1.0).all()


def test_motion_of_one_metre_per_second_squared_without_gravity_is_not_taken_for_g(made):
    """At rest it reads noise; the median of the rest is 1, as that of a log in g is."""
    phase = 1.5 * np.linspace(0.0, 2 * np.pi * 10, len(made.accel))
    turning = np.stack([np.sin(phase), np.cos(phase), 0 * phase], axis=1) * (np.arange(len(phase)) > 0.2 * len(phase))[:, None]
    survey = look(made._replace(accel=turning + 0.02 * np.random.default_rng(1).normal(size=made.accel.shape)))
    assert "accel has no gravity in it" in survey.reasons
    assert (survey.scale[3:] == 1.0).all()


@pytest.mark.parametrize(
    ("sensor", "columns", "signs", "named"),
    [
        ("gyro", [0, 1, 2], [1, 1, -1], "+x +y -z"),
        ("gyro", [1, 0, 2], [1, 1, 1], "+y +x +z"),
        ("gyro", [2, 0, 1], [1, -1, 1], "-y +z +x"),
        ("accel", [0, 1, 2], [1, 1, -1], "+x +y -z"),
        ("accel", [2, 1, 0], [1, 1, 1], "+z +y +x"),
    ],
)
def test_axes_that_contradict_the_poses_are_named_and_not_mended(sensor, columns, signs, named, made, truth):
    wrong = made._replace(**{sensor: getattr(made, sensor)[:, columns] * signs})
    survey = look(wrong, truth)
    one = only(survey, "axes")
    assert (one.values["sensor"], one.values["reading"], one.action) == (sensor, named, "flagged")
    assert survey.verdict == "quarantine"
    assert (survey.scale == 1.0).all()


@pytest.mark.parametrize("fix", [False, True])
def test_a_sensor_mounted_otherwise_than_the_body_of_the_poses_is_no_defect_and_keeps_its_axes(made, truth, fix):
    turned = made._replace(gyro=made.gyro[:, [2, 0, 1]], accel=made.accel[:, [2, 0, 1]])
    survey = look(turned, truth, CleaningSettings(fix=fix))
    assert (only(survey, "axes").severity, survey.verdict) == ("note", "good")
    assert (survey.matrices == np.eye(3)).all()
    np.testing.assert_array_equal(survey.mount @ [1.0, 2.0, 3.0], [2.0, 3.0, 1.0])


def test_a_mirrored_sensor_is_a_defect(made, truth):
    survey = look(made._replace(gyro=made.gyro * [1, 1, -1], accel=made.accel * [1, 1, -1]), truth)
    assert survey.verdict == "quarantine"


def test_rules_can_be_left_out_or_asked_for_alone(made):
    planted = PLANTS["spikes"][2](PLANTS["not finite"][2](made))
    assert set(found(look(planted, None, CleaningSettings(only=("not_finite",))))) == {"not_finite"}
    assert set(found(look(planted, None, CleaningSettings(without=("spikes",))))) == {"not_finite"}


def test_an_empty_topic_and_a_single_sample_are_not_trusted(made):
    for count in (0, 1):
        survey = look(pick(made, np.arange(count)))
        assert survey.verdict == "quarantine"
        assert 0.0 <= survey.score <= 1.0


def test_stamps_that_were_never_set_are_told_with_what_to_do(made: ImuBatch) -> None:
    first, second = look(made._replace(stamp_ns=0 * made.stamp_ns)).reasons
    assert first == f"valid samples: 1 of {len(made.stamp_ns)}"
    assert second == "the stamps were never set: imutool convert LOG OUT --restamp takes the log times"


def test_samples_that_are_all_nan_are_not_told_as_stamps_that_were_never_set(made: ImuBatch) -> None:
    reasons = look(with_values(made, slice(0, None), 1, np.nan)).reasons
    assert any("not finite" in reason for reason in reasons)
    assert not any("stamps" in reason for reason in reasons)


def test_stamps_in_batches_are_no_missing_samples(made: ImuBatch) -> None:
    number = np.arange(len(made.stamp_ns))
    last = np.minimum(number // 10 * 10 + 9, len(number) - 1)
    survey = look(made._replace(stamp_ns=made.stamp_ns[last] + 1000 * (number % 10)))  # as they arrive, ten at a time
    assert (survey.missing, survey.verdict) == (0, "quarantine")
    assert (
        "stamps come in batches of about 10.0 samples: the driver's, not the sensor's; imutool convert LOG OUT --restamp"
        in (survey.reasons[0])
    )


def turned_on_a_table(limit: float | None) -> np.ndarray:
    """Rates of an axis that rests, and then turns at a constant rate again and again, clipped before a drifting calibration."""
    t = np.arange(4000) / 100.0
    rate = 8.0 * np.clip(3.0 * np.sin(0.9 * (t - 10.0)), -1.0, 1.0) * (t > 10.0)
    rate += np.random.default_rng(3).normal(0.0, 0.005, len(t))
    return (rate if limit is None else np.clip(rate, -limit, limit)) * (1.0 + 2e-6 * t)


@pytest.mark.parametrize("limit", [7.9, 5.0, None])
def test_an_axis_that_is_clipped_before_its_calibration_is_saturated_and_a_constant_rate_is_not(limit):
    rates = turned_on_a_table(limit)
    plateau = saturation.Plateau()
    for first in range(0, len(rates), 333):  # parts as they come from a file
        part = slice(first, first + 333)
        number = np.arange(len(rates))[part]
        plateau.see(rates[part], number, 10 * number)
    marked = saturation.at_limit(rates)
    if limit is None:
        assert plateau.flat(-1) is plateau.flat(1) is None
        assert not marked.any()
        return
    for side in (-1, 1):
        flat = plateau.flat(side)
        assert flat is not None
        assert flat[0] == pytest.approx(side * limit, rel=1e-3)
        assert np.array_equal(flat[2], 10 * flat[1])
        assert (side * rates[flat[1]] > 0.99 * limit).all()
    assert np.isin(np.concatenate([plateau.flat(-1)[1], plateau.flat(1)[1]]), np.flatnonzero(marked)).all()
    assert marked.sum() > 0.9 * (np.abs(rates) > 0.9999 * limit).sum()


def test_a_sensor_that_rests_on_its_side_is_at_no_end_of_its_range() -> None:
    """Next to motion to the other side, its noise at rest was said to be flat near -9.3 m/s²."""
    rng, t = np.random.default_rng(0), np.arange(4000) / 100.0
    rests, moves = -9.3 + 0.004 * rng.normal(size=len(t)), 1.5 + 7.0 * np.sin(t) + 0.5 * rng.normal(size=len(t))
    values = np.where(t < 6.0, rests, np.maximum(moves, -8.0))
    assert not saturation.at_limit(np.where(values < 8.0, values, 2.0 * values - 8.0)).any()
    assert saturation.at_limit(values)[1:600].all()  # where nothing exceeds it, it may be the end of a range


def test_slow_motion_without_noise_is_not_flat_where_it_turns_back():
    """A simulation of a boat lost the crests of its waves: 1509 of 15000 samples of its gyro were said to be clipped."""
    assert not saturation.at_limit(0.08 * np.sin(0.3 * np.arange(0.0, 60.0, 0.005))).any()


def test_a_long_rest_near_the_largest_value_hides_no_plateau_far_above_it(monkeypatch):
    """As gravity at rest before a flight: too many samples to be held, until a larger value shows what they were."""
    monkeypatch.setattr(saturation, "MAX_NEAR", 5000)
    rest = 1.0 + np.random.default_rng(1).normal(0.0, 0.005, 40_000)
    rates = np.concatenate([rest, turned_on_a_table(5.0)])
    marked, flight = saturation.at_limit(rates), saturation.at_limit(rates[len(rest) :])
    assert not marked[: len(rest)].any()
    assert flight.any()
    np.testing.assert_array_equal(marked[len(rest) :], flight)
    monkeypatch.setattr(saturation, "MAX_NEAR", 100)
    assert not saturation.at_limit(np.abs(turned_on_a_table(5.0))).any()


def test_a_clipped_and_calibrated_axis_is_a_finding(made):
    rates = np.resize(turned_on_a_table(5.0), len(made.stamp_ns))
    (one,) = (each for each in look(with_values(made, slice(None), 1, rates)).findings if each.values.get("limit", 0.0) > 0.0)
    assert one.rule == "saturation"
    assert one.values == {"axis": "gyro.y", "limit": pytest.approx(5.0, rel=1e-3)}
    assert "clipped before a calibration" in one.what


def test_a_pause_between_two_settings_of_a_clock_counts_as_no_samples() -> None:
    epochs = [Epoch(0, 10, 0, 10, 10), Epoch(10, 25, 5, 20, 15), Epoch(25, 37, 11, 16, 12)]
    assert left_out(epochs, 40) == [(10, 25), (37, 40)]  # 10 + 12 samples, and not 10 and the last two thirds of 15
