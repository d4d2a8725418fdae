"""What `inspect` says about logs whose defects, noise and coverage are known."""

from __future__ import annotations

import json
import struct
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import MessageIndex
from mcap.writer import IndexType, Writer
from support.imu_defects import survey

from imutool.api.logs import convert
from imutool.cleaning import CleaningSettings, look
from imutool.cli.info import imu_rows, topic_rows
from imutool.converters import fetch, tum_vi
from imutool.debiasing import debias
from imutool.errors import LogError
from imutool.log_info import clock
from imutool.log_info.inspection import inspect
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_imu
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import GRAVITY_M_S2, Frames, Imu, Poses, Recording
from imutool.report import json_values
from imutool.sensor.made_up_flight import flight

PERIOD_NS = 5_000_000
START_NS = 1_700_000_000_000_000_000
GYRO_STD, ACCEL_STD = 2.4e-3, 0.03
NOISE_TOLERANCE = 0.05  # of a quarter of 120 s: three deviations
IMAGE_BYTES = 1_000_000
HOSTILE_S = 4.0  # CPU seconds for 2000 samples, ten times what they take


def resting(count: int = 4000, seed: int = 3) -> Imu:
    rng = np.random.default_rng(seed)
    gyro = 0.02 + GYRO_STD * rng.normal(size=(count, 3))
    accel = np.array([0.0, 0.0, GRAVITY_M_S2]) + ACCEL_STD * rng.normal(size=(count, 3))
    return Imu(START_NS + PERIOD_NS * np.arange(count), gyro, accel)


def swinging(count: int = 4000) -> Imu:
    """Never at rest: 1.5 rad/s about x, twice a second."""
    imu = resting(count)
    gyro = imu.gyro.copy()
    gyro[:, 0] += 1.5 * np.sin(2 * np.pi * 2.0 * np.arange(count) * PERIOD_NS * 1e-9)
    return replace(imu, gyro=gyro)


def still_poses(t_ns: np.ndarray) -> Poses:
    return Poses(t_ns, np.zeros((len(t_ns), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t_ns), 1)))


def described(path: Path) -> dict[str, Any]:
    """The report as its JSON values."""
    report = json_values(inspect(path))
    json.dumps(report, allow_nan=False)
    return report


def logged(folder: Path, imu: Imu, **kwargs: object) -> dict[str, Any]:
    path = folder / "log.mcap"
    write(Recording("log", imu, **kwargs), path, overwrite=True)
    return described(path)


def test_a_sensor_that_never_changes_is_warned_of(tmp_path: Path) -> None:
    imu = resting()
    for name, given in (
        ("gyro", replace(imu, gyro=np.zeros_like(imu.gyro))),
        ("accel", replace(imu, accel=0.0 * imu.accel + 5.0)),
    ):
        write(Recording("log", given), tmp_path / f"{name}.mcap")
        warnings = [text for text in described(tmp_path / f"{name}.mcap")["warnings"] if "in a row" in text]
        value = [0.0, 0.0, 0.0] if name == "gyro" else [5.0, 5.0, 5.0]
        assert len(warnings) == 1
        assert warnings[0].startswith(f"/imu0: {name} reads {value} in 4000 samples in a row: ")
    write(Recording("log", replace(imu, gyro=imu.gyro * [0.0, 0.0, 1.0])), tmp_path / "one.mcap")  # one axis is left
    assert not [text for text in described(tmp_path / "one.mcap")["warnings"] if "in a row" in text]


def test_clocks_of_every_topic_are_measured(tmp_path):
    imu = resting(1000)
    truth = still_poses(imu.t_ns[::10])
    report = logged(tmp_path, imu, truths={"/ground_truth/pose": truth})
    assert report["schema"] == "imutool.info/1"
    topics = {topic["name"]: topic for topic in report["topics"]}
    assert {"/imu0", "/ground_truth/pose"} <= set(topics)
    assert topics["/imu0"]["type"] == "sensor_msgs/msg/Imu"
    assert topics["/imu0"]["count"] == 1000
    assert topics["/imu0"]["rate_hz"] == pytest.approx(200.0)
    assert topics["/imu0"]["jitter_s"] == 0.0
    assert topics["/imu0"]["largest_gap_s"] == pytest.approx(0.005)
    assert topics["/imu0"]["first_ns"] == START_NS
    assert topics["/imu0"]["last_ns"] == START_NS + 999 * PERIOD_NS
    assert topics["/ground_truth/pose"]["rate_hz"] == pytest.approx(20.0)
    assert report["duration_s"] == pytest.approx(999 * 0.005)


def test_stamps_that_are_no_nanoseconds_are_told(tmp_path):
    report = logged(tmp_path, replace(resting(400), t_ns=(START_NS + PERIOD_NS * np.arange(400)) // 1000))
    assert any("2e+05 samples a second: the stamps are not in nanoseconds" in warning for warning in report["warnings"])


def test_stamps_in_batches_are_not_called_another_unit(tmp_path):
    number = np.arange(4000)
    t_ns = START_NS + PERIOD_NS * (number // 10 * 10 + 9) + 1000 * (number % 10)  # as they arrive, ten at a time
    warnings = logged(tmp_path, replace(resting(4000), t_ns=t_ns))["warnings"]
    assert any("stamps come in batches of about 10.0 samples" in warning for warning in warnings)
    assert not any("not in nanoseconds" in warning for warning in warnings)


def test_jitter_and_gaps_are_those_of_the_periods(tmp_path):
    imu = resting(1001)
    shift = np.where(np.arange(1001) % 2, 500_000, 0)  # periods alternate between 5.5 and 4.5 ms
    (found,) = logged(tmp_path, Imu(imu.t_ns + shift, imu.gyro, imu.accel))["imu"]
    assert found["jitter_s"] == pytest.approx(0.5e-3, rel=1e-6)
    assert found["largest_gap_s"] == pytest.approx(5.5e-3)


def test_missing_samples_are_counted_from_the_gaps(tmp_path):
    imu = resting(1000)
    kept = np.ones(1000, bool)
    kept[100] = kept[300:310] = False
    (found,) = logged(tmp_path, imu.rows(kept))["imu"]
    assert found["missing"] == 11
    assert "11 samples missing" in found["warnings"]
    assert found["largest_gap_s"] == pytest.approx(0.055)


def test_a_pause_of_the_recorder_is_no_jitter_and_is_said(tmp_path):
    imu = resting(1000)
    (found,) = logged(tmp_path, Imu(imu.t_ns + np.where(np.arange(1000) < 400, 0, 90 * 10**9), imu.gyro, imu.accel))["imu"]
    assert (found["missing"], found["jitter_s"]) == (0, pytest.approx(0.0, abs=1e-6))
    assert "pauses of more than 60 s: 1, the longest of 90 s" in found["warnings"]


def test_disorder_repeats_and_values_that_are_no_numbers_are_counted_not_refused(tmp_path, monkeypatch):
    """A log as a poor recorder leaves it; our own writer would refuse, so its checks are stepped around."""
    imu = resting(1000)
    path = tmp_path / "log.mcap"
    write(Recording("log", imu), path)

    def spoiled(rows, encoding="cdr", layout=None):
        columns = decode_imu(rows, encoding, layout)
        stamps, gyro = columns.stamp_ns.copy(), columns.gyro.copy()
        stamps[[10, 11]] = stamps[[11, 10]]
        stamps[500] = stamps[499]
        gyro[700, 1] = np.nan
        return columns._replace(stamp_ns=stamps, gyro=gyro)

    monkeypatch.setattr("imutool.mcap_io.topics.decode_imu", spoiled)
    (found,) = described(path)["imu"]
    assert (found["out_of_order"], found["duplicated"], found["not_finite"]) == (1, 1, 1)
    assert found["samples"] == 1000
    assert {"1 sample out of order", "1 sample with a repeated stamp"} <= set(found["warnings"])


@pytest.mark.parametrize(
    ("set_back", "clock", "sorts"),
    [(0, "stamp", True), (0, "file", False), (50, "stamp", False), (50.4, "stamp", False), (10**7, "stamp", False)],
    ids=["halves in the wrong order", "late stamps", "clock set back", "the same between samples", "by half a day"],
)
def test_messages_that_convert_puts_in_order_are_named(tmp_path, set_back, clock, sorts):
    """Two halves in the wrong order follow each other by their log times; of a clock that was set back they overlap."""
    numbers = [*range(100, 200), *range(100)] if not set_back else [*range(100), *(n - set_back for n in range(100, 200))]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        imu = writer.register_channel("/imu", "json", writer.register_schema("Imu", "jsonschema", b'{"type": "object"}'))
        for row, n in enumerate(numbers):
            t_ns = START_NS + round(n * PERIOD_NS)
            vectors = {name: {"x": 0.0, "y": 1e-3 * n, "z": 9.81} for name in ("angularVelocity", "linearAcceleration")}
            data = json.dumps({"header": {"stamp": {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}}, **vectors}).encode()
            writer.add_message(imu, t_ns if clock == "stamp" else START_NS + row * PERIOD_NS, data, t_ns)
        writer.finish()
    (found,) = described(tmp_path / "a.mcap")["imu"]
    assert found["out_of_order"] > 0
    named = "the messages are not in order of their log time; imutool convert LOG OUT puts them in order"
    assert (named in found["warnings"]) is sorts
    if sorts:
        convert(tmp_path / "a.mcap", tmp_path / "b.mcap")
        np.testing.assert_allclose(read(tmp_path / "b.mcap").imu.gyro[:, 1], 1e-3 * np.arange(200))


def test_clipping_is_seen_and_noise_and_coarse_steps_are_not(tmp_path):
    imu = swinging()
    clipped = replace(imu, gyro=imu.gyro.clip(-1.0, 1.0))
    (found,) = logged(tmp_path, clipped)["imu"]
    assert found["saturated"] == int((np.abs(imu.gyro) >= 1.0).any(axis=1).sum())
    coarse = replace(imu, gyro=np.round(imu.gyro / 0.01) * 0.01, accel=np.round(resting().accel / 0.02) * 0.02)
    for clean in (imu, coarse, replace(resting(), accel=coarse.accel)):
        (found,) = logged(tmp_path, clean)["imu"]
        assert found["saturated"] == 0
    assert "exactly that value" in found["saturation_rule"]


def test_rest_noise_and_gravity_of_a_resting_sensor(tmp_path):
    (found,) = logged(tmp_path, resting(24_000))["imu"]
    assert found["stationary_s"] > 119.0
    assert found["stationary"][0]["first_ns"] == START_NS
    assert found["accel_at_rest_m_s2"] == pytest.approx(GRAVITY_M_S2, abs=0.01)
    noise = found["noise"]
    assert noise["gyro_std_rad_s"] == pytest.approx([GYRO_STD] * 3, rel=NOISE_TOLERANCE)
    assert noise["accel_std_m_s2"] == pytest.approx([ACCEL_STD] * 3, rel=NOISE_TOLERANCE)
    assert noise["gyro_density"] == pytest.approx([GYRO_STD * np.sqrt(0.005)] * 3, rel=NOISE_TOLERANCE)
    assert noise["accel_density"] == pytest.approx([ACCEL_STD * np.sqrt(0.005)] * 3, rel=NOISE_TOLERANCE)
    assert found["warnings"] == []


def test_the_density_of_stamps_in_whole_milliseconds_is_that_of_their_mean_rate(tmp_path):
    imu = resting(24_000)
    (found,) = logged(tmp_path, replace(imu, t_ns=START_NS + 1_000_000 * np.ceil(5 / 3 * np.arange(24_000)).astype(int)))["imu"]
    assert found["noise"]["gyro_density"] == pytest.approx([GYRO_STD * np.sqrt(1 / 600)] * 3, rel=NOISE_TOLERANCE)


def test_the_noise_of_a_noisier_axis_is_not_that_of_its_calmest_seconds(tmp_path):
    imu = resting(24_000)
    (found,) = logged(tmp_path, replace(imu, gyro=imu.gyro[0] + (imu.gyro - imu.gyro[0]) * [1.0, 2.0, 4.0]))["imu"]
    assert found["noise"]["gyro_std_rad_s"] == pytest.approx(GYRO_STD * np.array([1.0, 2.0, 4.0]), rel=NOISE_TOLERANCE)


def test_without_rest_there_is_no_noise_estimate(tmp_path):
    (found,) = logged(tmp_path, swinging())["imu"]
    assert found["stationary"] == []
    assert found["noise"] is None
    assert found["accel_at_rest_m_s2"] is None


@pytest.mark.parametrize(("factor", "unit"), [(1 / GRAVITY_M_S2, "g"), (1000 / GRAVITY_M_S2, "mg"), (1 / 0.3048, "ft/s^2")])
@pytest.mark.parametrize("make", [resting, swinging])
def test_specific_force_in_another_unit_is_said(tmp_path, factor, unit, make):
    imu = make()
    (found,) = logged(tmp_path, replace(imu, accel=imu.accel * factor))["imu"]
    assert any(f"accel looks like {unit}, not m/s^2" in warning for warning in found["warnings"])


def test_a_rate_in_degrees_is_said(tmp_path):
    imu = swinging()
    (found,) = logged(tmp_path, replace(imu, gyro=np.degrees(imu.gyro)))["imu"]
    assert any("gyro looks like deg/s, not rad/s" in warning for warning in found["warnings"])
    (found,) = logged(tmp_path, imu)["imu"]
    assert found["warnings"] == []


def test_a_saturated_gyro_in_rad_s_is_no_gyro_in_degrees(tmp_path):
    """The shocks of a hand-held sensor with a full scale of 2280 degrees a second; `clean` finds the same."""
    imu = flight(4, duration_s=20.0).imu
    gyro = imu.gyro.copy()
    gyro[1000:1100, 1] += 60.0 * np.sin(np.linspace(0.0, 6.0 * np.pi, 100))
    gyro = gyro.clip(-39.78, 39.78)
    (found,) = logged(tmp_path, replace(imu, gyro=gyro))["imu"]
    at_limit = int((np.abs(gyro) == 39.78).any(axis=1).sum())
    assert found["warnings"] == [f"{at_limit} samples saturated"]
    findings = survey(tmp_path / "log.mcap").findings
    assert {(finding.rule, finding.values.get("axis")) for finding in findings} == {("saturation", "gyro.y")}
    assert sum(finding.count for finding in findings) == at_limit


def test_three_times_with_steps_of_different_length_have_the_rate_of_their_median(tmp_path):
    """No step is near the median of two: the rate was no number, with a warning of numpy's."""
    imu = resting(400)
    truth = still_poses(imu.t_ns[[0, 1, 100]])
    write(Recording("three", imu, truths={"/ground_truth/pose": truth}), tmp_path / "three.mcap")
    report = described(tmp_path / "three.mcap")
    (poses,) = [topic for topic in report["topics"] if topic["name"] == "/ground_truth/pose"]
    assert poses["rate_hz"] == pytest.approx(1e9 / (50 * PERIOD_NS))


def test_a_clock_that_is_set_is_no_jitter(tmp_path):
    imu = resting()
    set_later = imu.t_ns - 50 * 365 * 86_400 * 10**9 * (np.arange(len(imu)) < len(imu) // 2)
    found = logged(tmp_path, Imu(set_later, imu.gyro, imu.accel))
    assert found["topics"][0]["jitter_s"] == found["imu"][0]["jitter_s"] == 0.0
    assert any("the clock jumps by +1.5768e+09 s (50.0 years)" in warning for warning in found["warnings"])


@pytest.mark.parametrize("hostile", ["zero", "huge", "nan", "a clock that jumps by fifty years", "constant"])
def test_hostile_values_cost_no_more_than_others_and_give_no_nan(tmp_path, monkeypatch, hostile):
    imu = resting(2000)
    write(Recording("log", imu), tmp_path / "log.mcap")

    def spoiled(rows, encoding="cdr", layout=None):
        columns = decode_imu(rows, encoding, layout)
        stamps, gyro, accel = columns.stamp_ns.copy(), columns.gyro.copy(), columns.accel.copy()
        half = slice(len(gyro) // 2, None)
        if hostile == "zero":
            gyro[:] = accel[:] = 0.0
        elif hostile == "huge":
            gyro[half] = accel[::3] = 1e30
        elif hostile == "nan":
            gyro[half] = accel[::3] = np.nan
        elif hostile == "constant":
            gyro[:], accel[:] = 0.1, 9.81
        else:
            stamps[half] += 50 * 365 * 86_400 * 10**9
        return columns._replace(stamp_ns=stamps, gyro=gyro, accel=accel)

    monkeypatch.setattr("imutool.mcap_io.topics.decode_imu", spoiled)
    began = time.process_time()
    (found,) = described(tmp_path / "log.mcap")["imu"]
    cleaned = json_values(survey(tmp_path / "log.mcap").report())
    assert time.process_time() - began < HOSTILE_S
    json.dumps(cleaned, allow_nan=False)
    assert found["missing"] == cleaned["missing"] == 0
    assert found["warnings"] != [] or hostile == "a clock that jumps by fifty years"


def test_slow_rates_in_degrees_show_against_the_truth(data, tmp_path):
    """FETCH turns so slowly that half its rates pass for rad/s; the motion capture knows better."""
    (recording,) = fetch.read(data / "fetch" / "05_random")
    for slow_by in (1.0, 0.5):
        gyro = np.degrees(recording.imu.gyro) * slow_by
        write(replace(recording, imu=replace(recording.imu, gyro=gyro)), tmp_path / "log.mcap", overwrite=True)
        assert any("looks like deg/s" in warning for warning in inspect(tmp_path / "log.mcap").warnings)
    write(recording, tmp_path / "log.mcap", overwrite=True)
    (warning,) = inspect(tmp_path / "log.mcap").warnings
    assert warning.startswith("the gyro reads turns about y with the opposite sign of the poses /ground_truth/pose")


def test_coverage_by_the_truth_counts_samples_between_near_poses(tmp_path):
    imu = resting(2000)
    known = np.ones(2000, bool)
    known[:200] = known[1000:1200] = False  # starts 1 s late and has a gap of 201 periods
    early_ns = imu.t_ns[0] - 40_000_000_000 + 5_000_000 * np.r_[:100, 250:400]  # with a gap that is none of the IMU's time
    for before in (early_ns[:0], early_ns):
        poses = still_poses(np.concatenate([before, imu.t_ns[known]]))
        (truth,) = logged(tmp_path, imu, truths={"/ground_truth/pose": poses})["truth"]
        assert truth["gaps"] == 1 + bool(len(before))
    report = logged(tmp_path, imu, truths={"/ground_truth/pose": still_poses(imu.t_ns[known])})
    (truth,) = report["truth"]
    assert truth["coverage"] == pytest.approx(1600 / 2000)
    assert truth["gaps"] == 1
    assert truth["longest_gap_s"] == pytest.approx(201 * 0.005)
    assert truth["starts_after_s"] == pytest.approx(1.0)
    assert truth["ends_before_s"] == 0.0


def test_a_truth_of_another_time_is_said(tmp_path):
    imu = resting(500)
    report = logged(tmp_path, imu, truths={"/ground_truth/pose": still_poses(imu.t_ns + 10**12)})
    assert report["truth"][0]["coverage"] == 0.0
    assert "/ground_truth/pose: shares no time with the IMU" in report["warnings"]


def test_a_log_without_truth_says_so(tmp_path):
    assert logged(tmp_path, resting(500))["warnings"] == ["no true poses"]


def test_images_are_counted_without_holding_them(tmp_path):
    imu = resting(500)
    images = Frames("png", 60, lambda: ((START_NS + n * 30_000_000, bytes([n]) * IMAGE_BYTES) for n in range(60)))
    write(Recording("log", imu, frames={"/cam0/image_raw/compressed": images}), tmp_path / "log.mcap", compression="none")
    tracemalloc.start()
    report = described(tmp_path / "log.mcap")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    camera = next(topic for topic in report["topics"] if topic["name"].startswith("/cam0"))
    assert camera["count"] == 60
    assert camera["rate_hz"] == pytest.approx(1 / 0.03)
    assert peak < 12 * IMAGE_BYTES  # of 60


def test_real_recordings_are_described_without_false_alarms(data, tmp_path):
    (room,) = tum_vi.read(data / "tumvi" / "dataset-room2.tar.gz")
    write(room, tmp_path / "room2.mcap")
    report = described(tmp_path / "room2.mcap")
    assert report["warnings"] == []
    (truth,) = report["truth"]
    assert truth["gaps"] == 17  # drop-outs of the motion capture
    assert truth["longest_gap_s"] == pytest.approx(2.491667)
    assert report["imu"][0]["rate_hz"] == pytest.approx(199.372, abs=1e-3)
    assert report["imu"][0]["missing"] == 0


def test_the_tables_hold_what_the_report_holds(tmp_path):
    imu = resting(1000)
    values = logged(tmp_path, imu, truths={"/ground_truth/pose": still_poses(imu.t_ns)})
    report = inspect(tmp_path / "log.mcap")
    header, *rows = topic_rows(report)
    assert header[0] == "topic"
    assert {row[0]: row[2] for row in rows}["/imu0"] == "1000"
    properties = {(topic, name): value for topic, name, value in imu_rows(report)[1:]}
    assert properties["/imu0", "accel at rest"] == f"{values['imu'][0]['accel_at_rest_m_s2']:.3f} m/s²"
    assert properties["/imu0", "missing"] == "0"
    assert properties["/ground_truth/pose", "covers"].startswith("100.0 %")


@pytest.mark.parametrize("content", [b"", b"just text, no log"])
def test_what_is_no_log_is_refused(tmp_path, content):
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(LogError, match=r"log\.mcap"):
        inspect(tmp_path / "log.mcap")


WITHOUT_STAMP = "as the messages state no stamp with its unit"
UNITS = {"gyro": "deg/s", "accel": "g"}


@pytest.mark.parametrize(
    ("fields", "time", "others"),
    [
        ({"header": {"stamp": {"sec": 1_700_000_000, "nsec": 0}}}, None, None),
        ({"header": {"stamp": {"sec": 1_700_000_000, "nsec": 0}}, "sensor_time_us": 5000}, "header.stamp", ["sensor_time_us"]),
        ({"timestamp": 1_700_000_000.25}, "log time", []),  # of which unit?
    ],
)
def test_the_time_that_counts_is_named_if_a_message_leaves_it_open(tmp_path: Path, fields, time, others) -> None:
    """A made-up driver's JSON: a header of the computer, the sensor's own counter, which starts at 0, or a bare number."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        imu = writer.register_channel("/imu", "json", writer.register_schema("Imu", "jsonschema", b'{"type": "object"}'))
        for n in range(200):
            t_ns = 1_700_000_000_000_000_000 + n * 5_000_000
            vectors = {name: {"x": 0.0, "y": 0.1, "z": 9.81} for name in ("angularVelocity", "linearAcceleration")}
            writer.add_message(imu, t_ns, json.dumps({**fields, **vectors}).encode(), t_ns)
        writer.finish()
    report = inspect(tmp_path / "a.mcap")
    (info,) = json_values(report)["imu"]
    assert info["first_ns"] == 1_700_000_000_000_000_000
    assert (info.get("time"), info.get("other_times")) == (time, others)
    shown = [value for _, name, value in imu_rows(report) if name == "time of the samples"]
    assert shown == ([f"{time}, {'not sensor_time_us' if others else WITHOUT_STAMP}"] if time else [])
    notes = convert(tmp_path / "a.mcap", tmp_path / "b.mcap").notes
    assert any(note.endswith(f"; at the log time, {WITHOUT_STAMP}") for note in notes) == (time == "log time")


def test_units_in_the_comments_of_a_definition_are_named(tmp_path: Path) -> None:
    """They were applied without a word."""
    definition = "".join(f"float64 {sensor}_{axis} # {unit}\n" for sensor, unit in UNITS.items() for axis in "xyz")
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("my_driver/msg/Imu", "ros2msg", definition.encode())
        imu = writer.register_channel("/imu", "cdr", schema)
        for n in range(200):
            t_ns = 1_700_000_000_000_000_000 + n * 5_000_000
            data = b"\0\1\0\0" + struct.pack("<6d", 180.0, 0.0, 0.0, 0.0, 0.0, 1.0 + 1e-4 * (n % 2))
            writer.add_message(imu, t_ns, data, t_ns)
        writer.finish()
    said = "gyro in deg/s, accel in g, by the comments of its definition"
    assert f"b.mcap: /imu: {said}" in convert(tmp_path / "a.mcap", tmp_path / "b.mcap").notes
    report = inspect(tmp_path / "b.mcap")
    assert [value for _, name, value in imu_rows(report) if name == "units"] == [said]
    assert json_values(report)["imu"][0]["stated_units"] == "gyro in deg/s, accel in g"
    np.testing.assert_allclose(read(tmp_path / "b.mcap").imu.gyro[0], [np.pi, 0.0, 0.0])


def test_messages_that_a_message_index_leaves_out_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second message was missed, and the rate was half of what it is."""
    whole = MessageIndex.write
    monkeypatch.setattr(MessageIndex, "write", lambda self, to: whole(MessageIndex(self.channel_id, self.records[::2]), to))
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = writer.register_channel("/text", "json", writer.register_schema("Text", "jsonschema", b"{}"))
        for n in range(200):
            writer.add_message(text, START_NS + n * PERIOD_NS, b'"text"', START_NS)
        writer.finish()
    assert described(tmp_path / "a.mcap")["messages"] == 200


@pytest.mark.parametrize("max_held", [clock.MAX_HELD, 1000])
def test_chunks_without_indexes_are_not_unpacked_for_each_topic(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, max_held: int
) -> None:
    """A log of 8 MB with 3000 topics took 128 s."""
    monkeypatch.setattr(clock, "MAX_HELD", max_held)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=2000, index_types=IndexType.NONE)
        writer.start()
        ids = [writer.register_channel(f"/text{n}", "json", 0) for n in range(50)]
        for n in range(1000):
            writer.add_message(ids[n % 50], START_NS + n * PERIOD_NS, b"1", START_NS)
        writer.finish()
    unpack, count = LogIndex.unpack, [0]
    monkeypatch.setattr(LogIndex, "unpack", lambda self, block: count.__setitem__(0, count[0] + 1) or unpack(self, block))
    topics = described(tmp_path / "a.mcap")["topics"]
    assert {(topic["count"], round(topic["rate_hz"], 3), topic["largest_gap_s"]) for topic in topics} == {(20, 4.0, 0.25)}
    assert [topic["first_ns"] - START_NS for topic in topics] == [n * PERIOD_NS for n in range(50)]
    with Log(tmp_path / "a.mcap") as log:
        assert count[0] <= 12 * len(log.index.blocks)  # it was 56


def test_two_sensors_on_one_topic_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Their biases differ, and debias took the mean of both without a word; clean found the log good."""
    with (path := tmp_path / "two.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        channel = writer.register_channel("/imu", "cdr", kind)
        imu = resting(2000)
        for n, frame in enumerate(["", "/front", *["rear", "/front"] * 999]):
            rows = slice(n, n + 1)
            payload = encode_imu(imu.t_ns[rows], imu.gyro[rows], imu.accel[rows], frame)[0].tobytes()
            writer.add_message(channel, int(imu.t_ns[n]), payload, int(imu.t_ns[n]))
        writer.finish()
    said = "the messages name 2 frames: front (1000), rear (999); several sensors have no common bias"
    assert json_values(inspect(path))["imu"][0]["warnings"] == [said]
    assert [(finding.rule, finding.what) for finding in survey(path).findings] == [("frames", said)]
    with Log(path) as log:
        assert look(log, "/imu", CleaningSettings(without=("frames",))).score == 1.0
    for clean in (None, CleaningSettings()):
        with pytest.raises(LogError, match="2 sensors take turns on the topic"):  # it took the mean of both after a minute
            debias(path, tmp_path / "out.mcap", clean=clean)
    debias(path, tmp_path / "out.mcap", force=True)
    assert f"/imu: {said}" in caplog.text
