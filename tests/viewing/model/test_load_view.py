"""From a log to everything that is shown of it: exact log times, the bias and its certainty, and logs that are not sound."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from support.imu_defects import batch_of, late, pick, repeated, with_values, write_log

from imutool.api.logs import convert
from imutool.bias_start.correction import apply, apply_with_std
from imutool.cleaning.survey import raw_batches
from imutool.debiasing import debias
from imutool.errors import ConfigError, DataError, LogError
from imutool.evaluation import evaluate, started
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch, TwistColumns, decode_twist
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.topics import DERIVED_KEY
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording
from imutool.sensor.made_up_flight import flight
from imutool.viewing.model.events import FINDINGS
from imutool.viewing.model.load_view import MAX_ENTRIES, MAX_VALUE_LENGTH, build, load, provenance
from imutool.viewing.model.read_log import read_log
from imutool.viewing.model.run_data import Run

LAST_BITS = 1e-12  # rad/s and m/s²: the bias in blocks and in one go


@pytest.fixture(scope="module")
def made() -> Recording:
    return flight(6, duration_s=20.0)


@pytest.fixture(scope="module")
def log(made: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "made.mcap"
    write(made, path)
    return path


@pytest.fixture(scope="module")
def debiased(log: Path) -> Path:
    path = log.with_name("debiased.mcap")
    debias(log, path, model="static")
    return path


@pytest.mark.parametrize("is_debiased", [False, True])
def test_of_a_clock_that_is_set_the_longest_stretch_is_shown(made: Recording, tmp_path: Path, is_debiased: bool) -> None:
    first = len(made.imu) // 3
    set_later = made.imu.t_ns - 50 * 365 * 86_400 * 10**9 * (np.arange(len(made.imu)) < first)
    path = tmp_path / "log.mcap"
    write(replace(made, imu=Imu(set_later, made.imu.gyro, made.imu.accel)), path)
    if is_debiased:
        debias(path, tmp_path / "debiased.mcap", model="static")
        path = tmp_path / "debiased.mcap"
    data = load(path)
    assert len(data.traces) == 1 + is_debiased
    for trace in data.traces:
        assert np.array_equal(trace.run.imu.t_ns, made.imu.t_ns[first:])
        assert trace.figures is not None
    assert any("Only the longest stretch of /imu0 on one setting of its clock is shown" in note for note in data.notes)


def test_a_log_is_shown_with_where_it_comes_from(made: Recording, log: Path) -> None:
    data = load(log)
    assert data.source == log
    assert data.name == made.name
    assert data.traces[0].run.imu == made.imu
    assert data.traces[0].drift is not None
    assert [window.length_s for window in data.traces[0].windows] == [1.0, 5.0, 10.0]
    assert {event.kind for event in data.events} >= {"stop", "worst"}
    told = data.provenance
    assert told["file"] == "made.mcap"
    assert told["size"] == f"{log.stat().st_size} bytes"
    assert (told["IMU"], told["truth"]) == ("/imu0", "/ground_truth/pose")
    assert "start" not in told  # nothing was started
    assert "imutool: writer" in told
    assert not {"", "null", "{}"} & set(told.values())  # what a record does not know is no entry


def test_log_times_are_exact_and_not_the_stamps(made: Recording, tmp_path: Path) -> None:
    batch = batch_of(made.imu)
    write_log(batch, tmp_path / "delayed.mcap")
    data = load(tmp_path / "delayed.mcap")
    assert data.logged is not None
    assert np.array_equal(data.logged.stamp_ns, batch.stamp_ns)
    assert np.array_equal(data.logged.log_ns, batch.log_time)
    assert np.array_equal(data.log_ns(made.imu.t_ns), batch.log_time)
    assert not np.array_equal(batch.log_time, batch.stamp_ns)
    between = int(batch.stamp_ns[10]) + 1
    assert data.log_ns(np.array([between])) == between + batch.log_time[10] - batch.stamp_ns[10]


def test_what_debias_left_in_the_log_is_shown_with_its_certainty(made: Recording, debiased: Path) -> None:
    raw, model = load(debiased).traces
    assert raw.run.bias_std is None
    assert model.name == "in the log: static"
    (_, chosen, start) = next(started(made, ["static"], "auto", "made"))
    again, std = apply_with_std(chosen, start, made.imu)
    assert model.run.imu == again.imu
    assert model.run.bias_std is not None
    np.testing.assert_array_equal(np.hstack([model.run.gyro_bias, model.run.accel_bias]), again.bias)
    np.testing.assert_allclose(model.run.bias_std, std, rtol=1e-12)
    assert (std > 0.0).all()


def test_a_channel_without_its_bias_in_the_log_is_subtracted_at_equal_stamps(debiased: Path, tmp_path: Path) -> None:
    only = tmp_path / "only.mcap"
    with Log(debiased) as opened:
        (imu,) = list(raw_batches(opened, "/imu0/debiased"))[:1]
    raw = batch_of(load(debiased).traces[0].run.imu)
    fewer = pick(imu, np.arange(0, len(imu.stamp_ns), 2))
    write_both(raw, fewer, only)
    _, model = load(only).traces
    assert model.name == "debiased"
    assert model.run.bias_std is None
    np.testing.assert_allclose(model.run.gyro_bias, raw.gyro[: len(imu.stamp_ns) : 2] - fewer.gyro)
    foreign = fewer._replace(stamp_ns=fewer.stamp_ns + 1)
    write_both(raw, foreign, tmp_path / "foreign.mcap")
    data = load(tmp_path / "foreign.mcap")
    assert len(data.traces) == 1
    assert any("/imu0/debiased is left out" in note for note in data.notes)


def write_both(raw: ImuBatch, derived: ImuBatch, path: Path) -> None:
    """An IMU and what claims to be derived from it, without anything else."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        for topic, batch, about in (("/imu0", raw, {}), ("/imu0/debiased", derived, {DERIVED_KEY: "/imu0"})):
            channel = writer.register_channel(topic, "cdr", kind, about)
            payload = encode_imu(batch.stamp_ns, batch.gyro, batch.accel, batch.frame_id)
            for stamp_ns, data in zip(batch.stamp_ns, payload, strict=True):
                writer.add_message(channel, int(stamp_ns), data.tobytes(), int(stamp_ns))
        writer.finish()


def test_a_bias_in_the_log_that_is_no_number_is_found_by_subtraction(debiased: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sound = load(debiased).traces[1].run

    def spoiled(*words: object) -> TwistColumns:
        columns = decode_twist(*words)  # type: ignore[arg-type]
        return columns._replace(variance=np.full_like(columns.variance, np.nan))

    monkeypatch.setattr("imutool.mcap_io.topics.decode_twist", spoiled)
    run = load(debiased).traces[1].run
    assert run.bias_std is None
    np.testing.assert_allclose(run.gyro_bias, sound.gyro_bias, atol=LAST_BITS)


def test_models_come_with_their_certainty_and_say_how_they_started(made: Recording, log: Path) -> None:
    data = load(log, models=["static"], align="yaw")
    (trace,) = data.models()
    (_, model, start) = next(started(made, ["static"], "auto", "made"))
    whole = apply(model, start, made.imu)
    np.testing.assert_allclose(trace.run.gyro_bias, whole.bias[:, :3], atol=LAST_BITS)
    assert trace.run.bias_std is not None
    assert data.alignment == "yaw"
    assert data.provenance["start"] == "auto"
    assert start.how in data.provenance["model static"]


def test_a_model_that_does_not_fit_is_named_beside_its_figures(
    made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A page on an accelerometer in g told by how much its model cuts the errors, and nothing else."""
    path = tmp_path / "g.mcap"
    write(replace(made, imu=Imu(made.imu.t_ns, made.imu.gyro, made.imu.accel / 9.80665)), path)
    found = load(path, models=["static"])
    assert any("The model static is unfit: the specific force has a median of" in note for note in found.notes)
    assert "accel looks like g" in caplog.text
    assert "is unfit" in caplog.text


def test_smooth_reaches_the_models_and_is_refused_with_another_start(log: Path) -> None:
    assert load(log, models=["static"], smooth=True).provenance["smooth"] == "yes"
    with pytest.raises(ConfigError, match="smooth"):
        load(log, models=["static"], smooth=True, init="prior")
    with pytest.raises(ConfigError, match="init: 'trut'"):
        load(log, init="trut")


def test_an_aided_path_is_that_of_evaluate_and_has_no_samples_of_its_own(log: Path) -> None:
    data = load(log, models=["static"], aid="stops")
    assert [trace.name for trace in data.traces] == ["raw", "static", "static aided"]
    row = evaluate(log, models=["static"], aid="stops")[-1]
    assert (row["estimate"], row["ape_m"]) == ("aided", pytest.approx(data.traces[2].figures["ape_m"], rel=1e-9))
    assert data.traces[2].figures["ape_m"] != data.traces[1].figures["ape_m"]
    assert [trace.name for trace in data.integrated().traces] == ["raw", "static"]
    assert (data.traces[2].drift, data.traces[2].windows) == (None, ())  # a path with aids has no state to reset
    assert ([*data.traces[1].spectra], data.traces[2].spectra) == (["gyro", "accel"], {})
    assert "Aids: stops." in data.notes
    assert [trace.name for trace in load(log, aid="stops").traces] == ["raw", "raw aided"]


def test_an_aided_path_needs_no_truth(made: Recording, tmp_path: Path) -> None:
    write(replace(made, truths={}), tmp_path / "log.mcap")
    pure, aided = load(tmp_path / "log.mcap", models=["static"], aid="stops").models()
    assert aided.errors is None
    np.testing.assert_allclose(aided.path.p_wb[0], pure.path.p_wb[0], atol=1e-6)
    assert np.abs(aided.path.p_wb - pure.path.p_wb).max() > 1.0


def test_the_bias_in_a_log_gives_its_aided_path(debiased: Path) -> None:
    assert [trace.name for trace in load(debiased, aid="stops").traces][2:] == [f"{load(debiased).traces[1].name} aided"]


@pytest.mark.parametrize("step", [10, 120])
def test_poses_too_far_apart_for_their_turns_are_told(made: Recording, tmp_path: Path, step: int) -> None:
    """A page showed 46° of error, of which the straight lines between poses at 1 Hz were a third."""
    write(replace(made, truths={next(iter(made.truths)): made.truth.rows(slice(None, None, step))}), tmp_path / "log.mcap")
    told = [note for note in load(tmp_path / "log.mcap").notes if note.startswith("The poses ")]
    assert (len(told) == 1 and "are 1 s apart" in told[0]) if step == 120 else told == []


BROKEN = {
    "out_of_order": lambda batch: late(batch, [2000], 5),
    "duplicate": lambda batch: repeated(batch, [2000, 2500]),
    "not_finite": lambda batch: with_values(batch, slice(2000, 2003), 1, np.nan),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_log_that_cannot_be_held_as_it_is_is_shown_all_the_same(
    made: Recording, log: Path, tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "broken.mcap"
    write_log(BROKEN[kind](batch_of(made.imu)), path, beside=log)
    with pytest.raises(LogError):
        read(path)
    data = load(path)
    assert any("left out" in note and "/imu0" in note for note in data.notes)
    assert kind in {event.kind for event in data.events}
    assert len(made.imu) - 3 <= len(data.traces[0].run.imu) <= len(made.imu)
    assert data.traces[0].errors is not None
    assert data.logged is not None
    assert np.array_equal(data.logged.stamp_ns, data.traces[0].run.imu.t_ns)


def test_a_log_cut_short_is_shown_as_far_as_it_goes(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 6 // 10])
    before = cut.read_bytes()
    data = load(cut)
    assert any(note.startswith("The log is damaged; ") for note in data.notes)
    assert [trace.name for trace in load(cut, aid="stops").traces] == ["raw", "raw aided"]
    assert 0 < len(data.traces[0].run.imu) <= 4001
    assert cut.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["cut.mcap"]


def test_true_poses_that_cannot_be_held_are_left_out_unless_asked_for(made: Recording, tmp_path: Path) -> None:
    poses = made.truth
    write(replace(made, truths={"/good": poses, "/bad": poses}, scalars={}), tmp_path / "both.mcap")
    spoil_stamps(tmp_path / "both.mcap", tmp_path / "spoiled.mcap", "/bad")
    data = load(tmp_path / "spoiled.mcap")
    assert data.truth is not None
    assert data.provenance["truth"] == "/good"
    assert any("/bad are left out" in note for note in data.notes)
    with pytest.raises(LogError, match="bad"):
        load(tmp_path / "spoiled.mcap", truth="/bad")


def spoil_stamps(source: Path, target: Path, topic: str) -> None:
    """The same log with the messages of a topic written twice."""
    with source.open("rb") as opened, target.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channels: dict[str, int] = {}
        for kind, about, message in make_reader(opened).iter_messages():
            assert kind is not None
            if about.topic not in channels:
                number = writer.register_schema(kind.name, kind.encoding, kind.data)
                channels[about.topic] = writer.register_channel(about.topic, "cdr", number)
            for _ in range(1 + (about.topic == topic)):
                writer.add_message(channels[about.topic], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_a_log_without_imu_or_samples_or_bytes_is_refused(made: Recording, tmp_path: Path) -> None:
    empty = batch_of(Imu(made.imu.t_ns[:1], made.imu.gyro[:1], made.imu.accel[:1]))
    write_log(empty, tmp_path / "one.mcap")
    with pytest.raises(LogError, match="1 samples"):
        load(tmp_path / "one.mcap")
    (tmp_path / "nothing.mcap").write_bytes(b"")
    with pytest.raises(LogError, match="empty"):
        load(tmp_path / "nothing.mcap")
    (tmp_path / "text.mcap").write_text("not a log")
    with pytest.raises(LogError):
        load(tmp_path / "text.mcap")
    with pytest.raises(ConfigError):
        load(tmp_path / "missing.mcap")
    with pytest.raises(LogError, match="no topic /imu7"):
        load(tmp_path / "one.mcap", imu="/imu7")


def test_a_diagnosis_is_marked_in_its_log(log: Path, tmp_path: Path) -> None:
    place = {"signal": "gyro", "axes": ["x"], "intervals_s": [[4.0, 6.5]], "regime": "", "share": 0.5}
    found = {"schema": "imutool.diagnosis/1", "real": [str(log)], "located": [place], "findings": []}
    (tmp_path / FINDINGS).write_text(json.dumps(found))
    data = load(log, findings=tmp_path)
    (event,) = [event for event in data.events if event.kind == "finding"]
    assert (event.start_ns - data.start_ns, event.end_ns - data.start_ns) == (4_000_000_000, 6_500_000_000)
    (tmp_path / FINDINGS).write_text("{}")
    with pytest.raises(DataError):
        load(log, findings=tmp_path)


def test_what_others_wrote_into_a_log_is_bounded(made: Recording, log: Path) -> None:
    hostile = [("imutool<script>", {f"{'k' * 500}{k}": "v" * 10_000 for k in range(1000)}), ("other", {"a": "b"})]
    how = "hybrid, start: " + "0" * MAX_VALUE_LENGTH  # our own words stay whole
    assert provenance(log, made, hostile, {"mine": how}, {})["model mine"] == how
    told = provenance(log, made, hostile, {}, {})
    assert len(told) <= MAX_ENTRIES + 10
    assert max(map(len, [*told, *told.values()])) <= MAX_VALUE_LENGTH
    assert f"{1000 - MAX_ENTRIES} entries" in told.values()
    assert not any(key.startswith("other") for key in told)


def test_of_samples_between_two_poses_the_poses_around_them_are_shown(made: Recording) -> None:
    """A log of which next to nothing is measured: the pictures had no point of the truth, and ended with a ValueError."""
    start_ns, end_ns = made.truth.t_ns[1000], made.truth.t_ns[1003]
    imu = made.imu.between(int(start_ns) + 1, int(end_ns) - 1)
    truth = made.truth.rows(np.isin(np.arange(len(made.truth)), (998, 999, 1000, 1003, 1004, 1005)))
    data = build(
        replace(made, imu=imu, truths={next(iter(made.truths)): truth}),
        [Run("raw", imu, np.zeros((len(imu), 3)), np.zeros((len(imu), 3)))],
    )
    assert data.truth is not None
    assert data.truth.t_ns.tolist() == [start_ns, end_ns]


def test_of_stamps_that_were_never_set_the_refusal_says_what_to_do(made: Recording, tmp_path: Path) -> None:
    batch = batch_of(made.imu)
    write_log(batch._replace(stamp_ns=np.zeros_like(batch.stamp_ns)), tmp_path / "unset.mcap")
    with pytest.raises(LogError, match="--restamp takes the log times"):
        load(tmp_path / "unset.mcap")


def test_of_several_imus_the_one_that_was_debiased_is_shown(made: Recording, tmp_path: Path) -> None:
    header = "t [ns],gyro_x [rad/s],gyro_y [rad/s],gyro_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    lines = [
        f"{t}," + ",".join(map(repr, row))
        for t, row in zip(made.imu.t_ns.tolist(), np.hstack([made.imu.gyro, made.imu.accel]).tolist(), strict=True)
    ]
    source = tmp_path / "flight"
    source.mkdir()
    for name in ("imu_1", "imu_2"):
        (source / f"{name}.csv").write_text(header + "\n".join(lines) + "\n")
    poses = np.column_stack([made.truth.t_ns * 1e-9, made.truth.p_wb, made.truth.q_wb_wxyz])
    text = "\n".join(",".join(map(repr, row)) for row in poses.tolist())
    (source / "gt.csv").write_text(f"t [s],x,y,z,qw,qx,qy,qz\n{text}\n")
    (two,) = convert(source, tmp_path / "two.mcap").written
    with pytest.raises(LogError, match="the log has 2 IMU topics"):
        load(two)
    debias(two, tmp_path / "debiased.mcap", model="static", imus=["/imu_2/imu"])
    assert read_log(tmp_path / "debiased.mcap").recording.imu_topic == "/imu_2/imu"


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_true_poses_are_left_out(made: Recording, tmp_path: Path, count: int) -> None:
    write(replace(made, truths={"/few": made.truth.rows(slice(0, count))}, scalars={}), tmp_path / "few.mcap")
    data = load(tmp_path / "few.mcap")
    assert data.truth is None
    assert any("/few are left out" in note for note in data.notes)
