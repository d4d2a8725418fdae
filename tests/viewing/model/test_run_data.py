"""What is shown is what the maths says: errors in closed form, figures from the metrics, honest words without truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.errors import ConfigError, DataError
from imutool.inertial import metrics
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses, Recording, seconds
from imutool.sensor.made_up_flight import ACCEL, GYRO, flight
from imutool.viewing.model import load_view
from imutool.viewing.model.events import Event
from imutool.viewing.model.load_view import build
from imutool.viewing.model.run_data import MIN_SAMPLES, RAW, Run, RunData, level_start, spectra, split_at_gaps
from imutool.viewing.model.trajectory_error import Alignment, errors

ROUNDING = 1e-9  # degrees and metres: some thousand float64 operations on numbers of size one
NO_ERROR = dict.fromkeys(GYRO.__struct_fields__, 0.0)
STILL = {"duration_s": 2.0, "gyro": NO_ERROR, "accel": NO_ERROR, "truth_noise_m": 0.0, "truth_noise_rad": 0.0}


def shifted(run: Run, gyro: np.ndarray) -> Run:
    """A run of another name whose gyro reads more."""
    return replace(run, name="shifted", imu=Imu(run.imu.t_ns, run.imu.gyro + gyro, run.imu.accel))


def test_figures_are_those_of_the_metrics(recording: Recording, runs: list[Run], data: RunData) -> None:
    truth, valid = recording.truth.at(recording.imu.t_ns)
    assert valid.all()
    for run, trace in zip(runs, data.traces, strict=True):
        path = dead_reckon(run.imu, StartPose.of(truth))
        assert trace.path == path
        assert dict(trace.figures) == metrics.evaluate(path, truth, valid)


def test_error_curves_agree_with_the_figures(data: RunData) -> None:
    for trace in data.traces:
        assert trace.errors is not None
        rms = [
            float(np.sqrt(np.mean(total**2))) for total in (trace.errors.orientation_total_deg, trace.errors.position_total_m)
        ]
        assert rms == pytest.approx([trace.figures["aoe_deg"], trace.figures["ape_m"]], rel=1e-9)


def test_a_constant_rate_error_grows_into_its_angle_about_its_axis() -> None:
    recording = flight(0, **STILL)
    rate = np.array([0.01, -0.02, 0.03])
    trace = build(recording, [shifted(Run.raw(recording.imu), rate)]).traces[0]
    assert trace.errors is not None
    t = seconds(trace.errors.t_ns, int(recording.imu.t_ns[0]))
    np.testing.assert_allclose(trace.errors.orientation_deg, np.rad2deg(t[:, None] * rate), atol=ROUNDING)
    np.testing.assert_allclose(trace.errors.orientation_total_deg, np.rad2deg(t * np.linalg.norm(rate)), atol=ROUNDING)


def test_errors_are_log_of_true_transposed_times_estimated_and_estimated_minus_true() -> None:
    rng = np.random.default_rng(1)
    true = Rotation.random(50, rng=rng)
    turn, offset = rng.uniform(-0.9, 0.9, (50, 3)), rng.normal(size=(50, 3))
    t_ns = np.arange(50, dtype=np.int64) * 1000
    p = rng.normal(size=(50, 3))

    def poses(rotation: Rotation, position: np.ndarray) -> Poses:
        return Poses(t_ns, position, np.ascontiguousarray(rotation.as_quat(scalar_first=True)))

    valid = np.arange(50) % 7 != 0
    found = errors(poses(true * Rotation.from_rotvec(turn), p + offset), poses(true, p), valid)
    np.testing.assert_allclose(found.orientation_deg[valid], np.rad2deg(turn)[valid], atol=ROUNDING)
    np.testing.assert_allclose(found.position_m[valid], offset[valid], atol=ROUNDING)
    assert np.isnan(found.orientation_deg[~valid]).all()
    assert np.isnan(found.position_m[~valid]).all()


def test_a_gap_in_the_truth_is_a_hole_in_the_errors_and_in_the_true_path(recording: Recording, runs: list[Run]) -> None:
    start = int(recording.imu.t_ns[0])
    kept = (recording.truth.t_ns < start + 4_000_000_000) | (recording.truth.t_ns > start + 5_000_000_000)
    gappy = replace(recording, truths={"/ground_truth/pose": recording.truth.rows(kept)})
    data = build(gappy, runs[:1])
    trace = data.traces[0]
    assert trace.errors is not None
    hole = np.isnan(trace.errors.orientation_total_deg)
    t = data.elapsed_s(trace.errors.t_ns)
    assert hole[(t > 4.01) & (t < 4.99)].all()
    assert not hole[(t < 3.99) | (t > 5.01)].any()
    assert data.truth is not None
    pieces = split_at_gaps(data.truth)
    assert len(pieces) == 2
    assert sum(map(len, pieces)) == len(data.truth)
    assert int(pieces[1].t_ns[0] - pieces[0].t_ns[-1]) > 900_000_000


def test_paths_run_from_the_first_to_the_last_sample_with_truth(recording: Recording, runs: list[Run]) -> None:
    start = int(recording.imu.t_ns[0])
    late = recording.truth.between(start + 1_000_000_000, start + 6_000_000_000)
    data = build(replace(recording, truths={"/ground_truth/pose": late}), runs[:1])
    path = data.traces[0].path
    assert late.t_ns[0] <= path.t_ns[0] < late.t_ns[0] + 5_000_000
    assert late.t_ns[-1] - 5_000_000 < path.t_ns[-1] <= late.t_ns[-1]
    assert "1.0" in data.notes[0]
    assert len(data.traces[0].run.imu) == len(recording.imu)  # the signals are shown whole


def test_truth_without_velocity_starts_with_a_derived_one(recording: Recording, runs: list[Run]) -> None:
    truth = recording.truth
    bare = replace(recording, truths={"/ground_truth/pose": Poses(truth.t_ns, truth.p_wb, truth.q_wb_wxyz)})
    with_velocity, derived = (build(log, runs[:1]).traces[0].path.v_w for log in (recording, bare))
    assert with_velocity is not None
    assert derived is not None
    # A tenth of a second of 0.1 mm noise gives its slope to about 1 mm/s.
    np.testing.assert_allclose(derived[0], with_velocity[0], atol=0.01)


def test_without_truth_there_are_no_errors_and_it_says_so(recording: Recording, runs: list[Run]) -> None:
    data = build(replace(recording, truths={}), runs)
    assert data.truth is None
    assert all(trace.errors is None and not trace.figures for trace in data.traces)
    assert data.table() == []
    assert "no truth" in data.notes[0]


def test_without_truth_a_still_tilted_imu_stays_where_it_is() -> None:
    recording = flight(0, **STILL)
    tilt = Rotation.from_euler("ZYX", [0.7, 0.4, -1.2])
    accel = tilt.inv().apply(np.tile([0.0, 0.0, 9.81], (len(recording.imu), 1)))
    still = Imu(recording.imu.t_ns, np.zeros_like(accel), accel)
    start = level_start(still)
    level = Rotation.from_euler("ZYX", [0.0, 0.4, -1.2])  # the same but for the heading, which nobody can know
    assert (level.inv() * Rotation.from_quat(start.q_wb_wxyz, scalar_first=True)).magnitude() < 1e-12
    path = build(replace(recording, imu=still, truths={}), [Run.raw(still)]).traces[0].path
    assert np.abs(path.p_wb).max() < ROUNDING


def test_true_bias_is_shown_where_the_log_knows_it(recording: Recording, runs: list[Run], data: RunData) -> None:
    assert data.true_bias["gyro"] == recording.scalars["/ground_truth/bias/gyro"]
    assert data.true_bias["accel"].unit == "m/s^2"
    assert not build(replace(recording, scalars={}), runs).true_bias


@pytest.mark.parametrize("align", ["origin", "yaw", "se3"])
def test_alignment_moves_paths_and_errors_alone_and_is_said(
    recording: Recording, runs: list[Run], data: RunData, align: Alignment
) -> None:
    turned = build(recording, runs, align=align)
    assert (data.alignment, turned.alignment) == ("none", align)
    for before, after in zip(data.traces, turned.traces, strict=True):
        assert dict(before.figures) == dict(after.figures)
        assert before.windows == after.windows
        assert before.drift is not None
        assert after.drift is not None
        np.testing.assert_array_equal(before.drift.position_m, after.drift.position_m)
        assert after.errors is not None
        rms_m = float(np.sqrt(np.mean(after.errors.position_total_m**2)))
        if align == "se3":
            assert rms_m == pytest.approx(after.figures["ape_aligned_m"], rel=1e-9)
        else:
            assert rms_m >= after.figures["ape_aligned_m"]
        assert any(note.startswith(f"{after.name}: alignment {align} turned the path by") for note in turned.notes)
    assert not any("turned" in note for note in data.notes)


def test_without_truth_nothing_is_aligned(recording: Recording, runs: list[Run]) -> None:
    blind = build(replace(recording, truths={}), runs, align="se3")
    assert blind.alignment == "none"
    assert "nothing to align with" in blind.notes[0]
    assert all(trace.drift is None and trace.windows == () for trace in blind.traces)
    assert {event.kind for event in blind.events} <= {"stop"}


def test_events_are_those_given_stops_and_the_worst_of_each_model(recording: Recording, runs: list[Run]) -> None:
    start_ns = int(recording.imu.t_ns[0])
    gap = Event("gap", start_ns + 1_000_000_000, start_ns + 2_000_000_000, "here")
    data = build(recording, runs, events=[gap], notes=["A word."])
    assert gap in data.events
    assert "A word." in data.notes
    worst = [event.text.partition(":")[0] for event in data.events if event.kind == "worst"]
    assert sorted(worst) == ["my model/v1", "my model/v1", "static", "static"]
    alone = build(recording, runs[:1])
    assert [event.text.partition(":")[0] for event in alone.events if event.kind == "worst"] == ["raw", "raw"]


def test_runs_of_other_stamps_are_each_scored_on_their_own(recording: Recording, runs: list[Run]) -> None:
    fewer = runs[1].imu.rows(slice(200, None, 2))
    half = Run("half", fewer, runs[1].gyro_bias[200::2].copy(), runs[1].accel_bias[200::2].copy())
    data = build(recording, [runs[0], half, runs[2]])
    alone = build(recording, [half]).traces[0]
    assert data.traces[1].path == alone.path
    assert dict(data.traces[1].figures) == dict(alone.figures)
    assert len(data.traces[2].path) == len(data.traces[0].path) != len(alone.path)


def test_a_log_too_long_to_be_drawn_whole_says_so(
    recording: Recording, runs: list[Run], data: RunData, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not any("at most" in note for note in data.notes)
    monkeypatch.setattr(load_view, "MAX_CURVE_ROWS", 1000)
    assert any("at most 1,000 rows" in note for note in build(recording, runs).notes)


def test_the_table_has_a_row_per_figure_and_a_column_per_run(data: RunData) -> None:
    table = dict(data.table())
    assert table["aoe_deg"] == [trace.figures["aoe_deg"] for trace in data.traces]
    assert table["roe_deg 5"] == [trace.figures["roe_deg"]["5"] for trace in data.traces]
    assert all(len(values) == 3 for values in table.values())


def test_raw_subtracts_nothing(data: RunData) -> None:
    raw, *models = data.traces
    assert raw.is_raw
    assert raw.name == RAW
    assert not raw.run.gyro_bias.any()
    assert data.models() == tuple(models)


@pytest.mark.parametrize("names", [[], ["raw", "raw"], ["raw", "truth"]])
def test_runs_need_names_of_their_own(recording: Recording, runs: list[Run], names: list[str]) -> None:
    with pytest.raises(ConfigError, match="runs have the names"):
        build(recording, [replace(runs[0], name=name) for name in names])


def test_a_bias_of_another_length_is_refused(recording: Recording) -> None:
    short = np.zeros((5, 3))
    with pytest.raises(DataError, match="5 rows"):
        Run("m", recording.imu, short, short)


def test_truth_and_imu_that_never_meet_are_refused(recording: Recording, runs: list[Run]) -> None:
    elsewhere = flight(4, duration_s=4.0).truths  # another hour
    with pytest.raises(DataError, match="share fewer than two samples"):
        build(replace(recording, truths=elsewhere), runs)


def test_the_settings_of_a_triad_are_all_switched_off_here() -> None:
    assert set(NO_ERROR) == set(ACCEL.__struct_fields__)


RATE_HZ, COUNT = 200.0, 40_000
SCATTER = 0.1  # of a mean over 800 frequencies of 49 half-overlapping windows: a hundredth, with margin


def sampled(gyro: np.ndarray) -> Imu:
    t_ns = np.arange(len(gyro), dtype=np.int64) * 5_000_000 + 1_700_000_000_000_000_000
    return Imu(t_ns, gyro, np.tile([0.0, 0.0, 9.81], (len(gyro), 1)))


def test_white_noise_has_its_density_at_all_frequencies() -> None:
    density = 1e-3  # rad/s/sqrt(Hz)
    noise = np.random.default_rng(1).normal(size=(COUNT, 3)) * density * np.sqrt(RATE_HZ / 2)
    found = spectra(sampled(noise))["gyro"]
    assert found.frequency_hz[0] == pytest.approx(0.125)
    assert found.frequency_hz[-1] == pytest.approx(RATE_HZ / 2)
    assert found.density.shape == (len(found.frequency_hz), 3)
    np.testing.assert_allclose(np.sqrt(found.density.mean(axis=0)), density, rtol=SCATTER)


def test_a_vibration_is_found_on_its_axis_with_its_power_and_a_constant_nowhere() -> None:
    t = np.arange(COUNT) / RATE_HZ
    gyro = np.zeros((COUNT, 3))
    gyro[:, 1] = 0.3 * np.sin(2 * np.pi * 37.0 * t) + 5.0
    found = spectra(sampled(gyro))
    line = found["gyro"]
    assert line.frequency_hz[line.density[:, 1].argmax()] == pytest.approx(37.0, abs=0.125)
    power = line.density[:, 1].sum() * np.diff(line.frequency_hz).mean()
    assert power == pytest.approx(0.3**2 / 2, rel=1e-3)
    assert line.density[:, [0, 2]].max() < 1e-20
    assert found["accel"].density.max() < 1e-20


def test_a_log_too_short_has_no_spectrum() -> None:
    assert not spectra(sampled(np.zeros((MIN_SAMPLES - 1, 3))))
    assert set(spectra(sampled(np.zeros((MIN_SAMPLES, 3))))) == {"gyro", "accel"}
