"""Real recordings: nothing is wrong with them, and what is planted in them is found. Limits were set on other sequences."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support.imu_defects import batch_of, late, repeated, with_values, without

from imutool.cleaning.survey import Survey, examine
from imutool.cleaning.truth import Truth
from imutool.converters import euroc, fetch, tum_vi
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.recording import Recording

SOURCES = {
    "MH_04_difficult": (euroc, "euroc/MH_04_difficult.zip"),
    "V1_03_difficult": (euroc, "euroc/V1_03_difficult.zip"),
    "room2": (tum_vi, "tumvi/dataset-room2.tar.gz"),
    "05_random": (fetch, "fetch/05_random"),
}
DEGREES = 180.0 / np.pi


@pytest.fixture(scope="module", params=SOURCES)
def recording(request: pytest.FixtureRequest, data: Path) -> Recording:
    module: ModuleType
    module, place = SOURCES[request.param]
    (found,) = module.read(data / place)
    assert isinstance(found, Recording)
    return found


@pytest.fixture(scope="module")
def truth(recording: Recording) -> Truth:
    poses = recording.truth
    every = max(1, round(0.1 / poses.period_s))
    return Truth("/ground_truth/pose", poses.t_ns[::every], poses.p_wb[::every], poses.q_wb_wxyz[::every])


def look(batch: ImuBatch, truth: Truth | None) -> Survey:
    return examine(lambda: [batch], truth)


def counts(survey: Survey) -> dict[str, int]:
    """Counts by rule, without the note that TUM-VI's raw accelerometer reads 0.7 m/s² too much."""
    return {one.rule: one.count for one in survey.findings if not one.what.startswith("accel reads 10.")}


def test_nothing_is_wrong_with_real_recordings(recording: Recording, truth: Truth) -> None:
    survey = look(batch_of(recording.imu), truth)
    assert counts(survey) == {}
    assert (survey.verdict, survey.score, survey.valid) == ("good", 1.0, len(recording.imu))


def test_what_is_planted_together_is_found_in_the_right_number(recording: Recording, truth: Truth) -> None:
    batch = batch_of(recording.imu)
    largest = np.abs(np.diff(np.concatenate([batch.gyro, batch.accel], axis=1), axis=0)).max(axis=0)
    for row, axis in ((1000, 0), (2001, 4), (3002, 5)):
        batch = with_values(batch, row, axis, 8.0 * largest[axis], add=True)
    batch = with_values(batch, [1500, 1501], 3, np.nan)
    batch = with_values(batch, slice(4001, 4031), slice(None), np.concatenate([batch.gyro[4000], batch.accel[4000]]))
    batch = repeated(late(without(batch, slice(5000, 5050)), [600, 700], 3), [200, 300], 2)
    planted = {"spikes": 3, "not_finite": 2, "stuck": 30, "gaps": 50, "time_back": 2, "duplicates": 2}
    assert counts(look(batch, truth)) == planted


def test_units_are_settled_by_gravity_and_by_the_poses(recording: Recording, truth: Truth) -> None:
    made = batch_of(recording.imu)
    survey = look(made._replace(accel=made.accel / 9.80665), truth)
    assert counts(survey) == {"units": 3}
    assert survey.scale.tolist() == [1.0] * 3 + [9.80665] * 3
    survey = look(made._replace(gyro=made.gyro * DEGREES), truth)
    assert [one.rule for one in survey.findings if one.severity != "note"] == ["units"]
    converted = bool((survey.scale[:3] < 1.0).all())
    assert converted or survey.verdict == "quarantine"  # FETCH turns so little that noise blurs the ratio: 64, not 57


def test_without_poses_nothing_is_converted_by_mistake(recording: Recording) -> None:
    survey = look(batch_of(recording.imu), None)
    assert (survey.scale == 1.0).all()
    assert survey.verdict == "good"


def test_a_flipped_axis_of_the_gyro_is_named(recording: Recording, truth: Truth) -> None:
    made = batch_of(recording.imu)
    survey = look(made._replace(gyro=made.gyro * [1.0, 1.0, -1.0]), truth)
    (one,) = [one for one in survey.findings if one.rule == "axes"]
    assert one.values["reading"].endswith("-z")  # of FETCH, which turns about z alone, x and y say nothing
    assert survey.verdict == "quarantine"
