"""A debiased log is the log and three topics more; batch, stream and one sample at a time give the same numbers."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from support.imu_defects import batch_of, cut
from support.two_imus import write_two_imus

from imutool.api.logs import convert
from imutool.bias.model import BiasModel
from imutool.bias.model_file import load, save
from imutool.bias.networks import linear, neural_ode, static
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.neural_ode import Config
from imutool.bias_start.bias_at_rest import at_rest, auto
from imutool.bias_start.bias_from_truth import from_truth
from imutool.bias_start.correction import OnlineDebiaser, apply
from imutool.bias_start.initial_bias import InitialBias, bias_prior, from_numbers, prior, smoothed_start, tracked_from_prior
from imutool.bias_start.model_choice import estimate_at_rest
from imutool.cleaning import CleaningSettings
from imutool.cli.debias import assigned
from imutool.debiasing import Debiaser, debias
from imutool.errors import ConfigError, DataError, LogError, ModelError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import decode_imu, decode_scalars
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.index import LogIndex
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.source import Source, sha256
from imutool.mcap_io.write import write
from imutool.recording import Frames, Recording, Scalars, seconds
from imutool.sensor.made_up_flight import flight

RATE_HZ = 200.0
ONLINE = 1e-6  # rad/s and m/s²: the contract's figure
NEW = ("/imu0/debiased", "/imu0/bias/gyro", "/imu0/bias/accel", "/imu0/bias")
IMAGES = [(1_700_003_600_100_000_000 + 100_000_000 * i, bytes([i]) * 5000) for i in range(20)]


def make_network(method: str, rate_hz: float = RATE_HZ) -> BiasNetwork:
    """A network that does something to every sample."""
    torch.manual_seed(1)
    kinds: dict[str, BiasNetwork] = {
        "static": static.Network(rate_hz=0.0),
        "linear": linear.Network(rate_hz=rate_hz),
        "neural_ode": neural_ode.Network(Config(curve_width=8, drift_step_s=0.1), rate_hz),
    }
    model = kinds[method].double()
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.003 * torch.randn(value.shape, dtype=value.dtype))
        model.prior_std.copy_(torch.tensor([0.05] * 3 + [0.4] * 3))
        model.truth_std.copy_(torch.tensor([1e-3] * 3 + [0.05] * 3))
        model.noise_std.copy_(torch.tensor([2e-3] * 3 + [0.03] * 3))
    return model.requires_grad_(False).eval()


def make_model(method: str, rate_hz: float = RATE_HZ) -> BiasModel:
    return make_network(method, rate_hz).frozen()


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A flight of several chunks, with images, scalars and metadata next to it; it starts at rest."""
    made = flight(1, duration_s=20.0)
    return Recording(
        made.name,
        made.imu,
        made.truths,
        {"/imu0/temperature": Scalars(made.imu.t_ns[::50], np.arange(81.0)[:, None], "degC"), **made.scalars},
        {"/cam0/image_raw/compressed": Frames("png", len(IMAGES), lambda: iter(IMAGES))},
        {"sensor": {"gyro_noise": "1.7e-4"}},
    )


@pytest.fixture(scope="module")
def files(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording as flight.mcap, a model m.safetensors, and out.mcap, which the model makes of the log."""
    folder = tmp_path_factory.mktemp("files")
    write(recording, folder / "flight.mcap")
    save(make_model("neural_ode"), folder / "m.safetensors")
    debias(folder / "flight.mcap", folder / "out.mcap", model=folder / "m.safetensors")
    return folder


@pytest.fixture
def source(files: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(files / "flight.mcap", tmp_path))


@pytest.fixture
def model_file(files: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(files / "m.safetensors", tmp_path))


def messages(path: Path) -> Iterator[tuple[str, str, str, int, int, int, bytes]]:
    """Every message as the format's own reader gives it: topic, schema, encoding, log time, publish time, sequence, data."""
    with path.open("rb") as file:
        for kind, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            assert kind is not None
            times = message.log_time, message.publish_time, message.sequence
            yield channel.topic, kind.name, channel.message_encoding, *times, message.data


def originals(path: Path) -> dict[str, str]:
    """One digest a topic over everything its messages are, in order."""
    digests: dict[str, Any] = {}
    for topic, *rest, data in messages(path):
        if topic not in NEW:
            digests.setdefault(topic, hashlib.sha256()).update(repr((*rest, len(data))).encode() + data)
    return {topic: digest.hexdigest() for topic, digest in digests.items()}


def columns(path: Path, *topics: str) -> dict[str, list[tuple[int, int, int, bytes]]]:
    """Log time, publish time, sequence and data of the messages on some topics, in one pass."""
    found: dict[str, list[tuple[int, int, int, bytes]]] = {topic: [] for topic in topics}
    for name, _, _, log, publish, sequence, data in messages(path):
        if name in found:
            found[name].append((log, publish, sequence, data))
    return found


def rows(messages: list[tuple[int, int, int, bytes]]) -> np.ndarray:
    return np.stack([np.frombuffer(data, np.uint8) for *_, data in messages])


def metadata(path: Path) -> list[tuple[str, dict[str, str]]]:
    with path.open("rb") as file:
        return [(record.name, dict(record.metadata)) for record in make_reader(file).iter_metadata()]


# ── the log ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def target(files: Path, source: Path, model_file: Path, tmp_path: Path) -> Path:
    """What the model made of the log; both lie next to it."""
    return Path(shutil.copy(files / "out.mcap", tmp_path))


def test_every_original_message_is_unchanged_and_so_is_the_source(source: Path, model_file: Path, tmp_path: Path) -> None:
    before, contents = sha256(source), source.stat()
    report = debias(source, tmp_path / "out.mcap", model=model_file)
    assert (sha256(source), source.stat().st_mtime_ns) == (before, contents.st_mtime_ns)
    assert originals(tmp_path / "out.mcap") == originals(source)
    assert len(originals(source)) == 8  # IMU, truth on two topics, its velocity, temperature, two biases, images
    assert report.rewrite.copied == sum(1 for _ in messages(source))
    assert dict(report.rewrite.added) == dict.fromkeys(NEW, 4001)


def test_the_new_messages_have_their_sources_times_sequence_stamp_and_frame(target: Path) -> None:
    found = columns(target, "/imu0", *NEW)
    stamps = decode_imu(rows(found["/imu0"]))
    for topic in NEW:
        assert [row[:3] for row in found[topic]] == [row[:3] for row in found["/imu0"]], topic
        kind = decode_imu(rows(found[topic])) if topic == NEW[0] else decode_scalars(rows(found[topic]), schemas.VECTOR3)
        np.testing.assert_array_equal(kind.stamp_ns, stamps.stamp_ns)
        assert kind.frame_id == stamps.frame_id


def test_the_topics_their_schemas_and_where_they_come_from(target: Path) -> None:
    with target.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found = {c.topic: (summary.schemas[c.schema_id].name, c.message_encoding, c) for c in summary.channels.values()}
    kinds = {topic: found[topic][:2] for topic in NEW}
    vector = ("geometry_msgs/msg/Vector3Stamped", "cdr")
    twist = ("geometry_msgs/msg/TwistWithCovarianceStamped", "cdr")
    assert kinds == {NEW[0]: ("sensor_msgs/msg/Imu", "cdr"), NEW[1]: vector, NEW[2]: vector, NEW[3]: twist}
    for topic in NEW:
        assert found[topic][2].metadata["imutool_source_topic"] == "/imu0"
        assert "offered_qos_profiles" in found[topic][2].metadata


def test_what_was_subtracted_is_raw_minus_debiased(target: Path) -> None:
    found = columns(target, "/imu0", *NEW)
    raw, made = decode_imu(rows(found["/imu0"])), decode_imu(rows(found[NEW[0]]))
    for topic, values, left in ((NEW[1], raw.gyro, made.gyro), (NEW[2], raw.accel, made.accel)):
        bias = decode_scalars(rows(found[topic]), schemas.VECTOR3).values
        np.testing.assert_allclose(bias, values - left, rtol=0, atol=1e-14)
        assert np.ptp(bias, axis=0).min() > 1e-4  # and it is no constant


def test_the_streamed_log_holds_what_the_model_says_in_memory(target: Path, recording: Recording, model_file: Path) -> None:
    model = load(model_file)
    expected = apply(model, auto(model, recording.imu), recording.imu)
    made = read(target, imu="/imu0/debiased")
    np.testing.assert_allclose(made.imu.gyro, expected.imu.gyro, rtol=0, atol=1e-12)
    np.testing.assert_allclose(made.imu.accel, expected.imu.accel, rtol=0, atol=1e-12)


def covariances(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orientation, rate and acceleration covariances of the debiased messages, by rosbags' reading of them."""
    with AnyReader([path]) as bag:
        (connection,) = [c for c in bag.connections if c.topic == "/imu0/debiased"]
        found = [bag.deserialize(raw, connection.msgtype) for _, _, raw in bag.messages([connection])]
    names = ("orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance")
    return tuple(np.stack([getattr(m, name).reshape(3, 3) for m in found]) for name in names)  # type: ignore[return-value]


@pytest.mark.parametrize("init", ["auto", "prior", "truth", "0,0,0,0,0,0"])
@pytest.mark.parametrize("method", ["static", "linear"])
def test_covariances_are_positive_and_as_large_as_the_noise(source: Path, tmp_path: Path, init: str, method: str) -> None:
    path: str | Path = method
    if method != "static":
        path = tmp_path / "m.safetensors"
        save(make_model(method), path)
    debias(source, tmp_path / "out.mcap", model=path, init=init)
    orientation, *others = covariances(tmp_path / "out.mcap")
    assert (orientation[:, 0, 0] == -1).all()  # as REP 145 says: no orientation here
    minimum = 0.9 if method == "static" else 0.5  # of a model that was made with less
    for covariance, noise in zip(others, (2.4e-3, 0.028), strict=True):
        assert (np.linalg.eigvalsh(covariance) > minimum * noise**2).all()
        np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), rtol=1e-9, atol=1e-15)


def test_the_bias_comes_with_its_covariance(target: Path) -> None:
    """Angular is the gyro's, linear the accelerometer's, and a message's is that of its bias and white noise."""
    with AnyReader([target]) as bag:
        found: dict[str, list[Any]] = {topic: [] for topic in NEW}
        for connection, _, raw in bag.messages([c for c in bag.connections if c.topic in NEW]):
            found[connection.topic].append(bag.deserialize(raw, connection.msgtype))
    for imu, gyro, accel, both in zip(*(found[topic] for topic in NEW), strict=True):
        twist, P = both.twist.twist, both.twist.covariance.reshape(6, 6)
        assert (twist.angular.x, twist.angular.z) == (gyro.vector.x, gyro.vector.z)
        assert (twist.linear.x, twist.linear.z) == (accel.vector.x, accel.vector.z)
        for covariance, unsure in (
            (imu.angular_velocity_covariance, P[3:, 3:]),
            (imu.linear_acceleration_covariance, P[:3, :3]),
        ):
            white = covariance.reshape(3, 3) - unsure
            np.testing.assert_allclose(white, np.diag(np.diag(white)), atol=1e-12)
            assert (np.diag(white) > 0).all()
    first = found["/imu0/bias"][0].twist.covariance.reshape(6, 6)
    assert (np.linalg.eigvalsh(first) > 0).all()


def test_the_provenance_says_what_it_takes_to_do_it_again(source: Path, target: Path, model_file: Path) -> None:
    before, after = metadata(source), metadata(target)
    assert after[: len(before)] == before  # the source's own records stand
    ((name, record),) = after[len(before) :]
    assert name == "imutool"
    assert record["source_topic"] == "/imu0"
    assert (record["model"], record["model_sha256"]) == ("m", sha256(model_file))
    assert (record["source_file"], record["source_sha256"]) == (source.name, sha256(source))
    assert record["source_size"] == str(source.stat().st_size)
    assert json.loads(record["settings"])["curve_width"] == 8
    assert (record["init"], record["causal"]) == ("auto", "true")
    assert "at rest" in record["init_how"]
    assert len(json.loads(record["rest"])) == len(json.loads(record["rest_std"])) == 6


def test_what_was_checked_stands_in_the_log_and_in_the_report(source: Path, model_file: Path, tmp_path: Path) -> None:
    for check in ("all", "imu", "none"):
        out = tmp_path / f"{check}.mcap"
        verified = debias(source, out, model=model_file, check=check).rewrite.verified
        assert json.loads(metadata(out)[-1][1]["verified"]) == msgspec.to_builtins(verified)
        assert verified.mode == check
        assert (verified.chunks_checked == verified.chunks) == (check == "all")
    with pytest.raises(ConfigError, match="check: unknown mode 'most'"):
        debias(source, tmp_path / "out.mcap", model=model_file, check="most")


def test_in_place_the_log_gains_its_channels_under_its_own_name(source: Path, target: Path, model_file: Path) -> None:
    before = sha256(source)
    source.chmod(0o600)
    debias(source, None, model=model_file)
    assert source.read_bytes() == target.read_bytes()
    assert metadata(source)[-1][1]["source_sha256"] == before
    assert source.stat().st_mode & 0o777 == 0o600
    with pytest.raises(LogError, match="debiased is in this log already"):
        debias(source, None, model=model_file, imus=["/imu0"])
    assert source.read_bytes() == target.read_bytes()


def test_the_static_bias_of_a_long_log_takes_no_more_memory(tmp_path: Path) -> None:
    peaks = []
    for seconds_long in (150.0, 300.0):  # both fill what is kept for the copy (`chunk_check.KEPT_BYTES`)
        recording = flight(1, duration_s=seconds_long)
        log = tmp_path / f"{seconds_long}.mcap"
        write(recording, log, compression="none")
        tracemalloc.start()
        try:
            debias(log, tmp_path / f"{seconds_long}.out.mcap")
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    samples = 150 * 200
    assert peaks[1] - peaks[0] < 0.5 * samples * 7 * 8  # of the samples themselves there is not even half; a minute is held
    assert peaks[1] < 40 << 20


def test_the_command_in_place_and_what_contradicts_it(
    source: Path, target: Path, tmp_path: Path, imutool: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    before = source.read_bytes()
    for words, said in (
        ([], "OUT is missing; expected a name for the new log. Give OUT, or --in-place"),
        (["x.mcap", "--in-place"], "--in-place and x.mcap"),
        (["--in-place", "--overwrite"], "--in-place and --overwrite"),
        (["x.mcap", "--verify", "some"], "'some'; expected all, imu, none"),
    ):
        done = imutool("debias", source, *words, cwd=tmp_path)
        assert done.returncode == 3
        assert said in done.stderr
    assert source.read_bytes() == before
    done = imutool(
        "debias", source, "--in-place", "--model", "/imu0=m.safetensors", "--verify", "all", "--json", "-", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["output"] == str(source)
    assert report["verified"]["mode"] == "all"
    assert report["verified"]["chunks_checked"] == report["verified"]["chunks"] > 0
    assert originals(source) == originals(target)


def test_images_and_user_metadata_pass_through(target: Path, recording: Recording) -> None:
    back = read(target, imu="/imu0")
    assert [*back.frames["/cam0/image_raw/compressed"].each()] == IMAGES
    assert back.metadata["sensor"] == recording.metadata["sensor"]
    assert (back.imu, back.truth) == (recording.imu, recording.truth)


def test_progress_ends_at_its_total(source: Path, model_file: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    debias(source, tmp_path / "out.mcap", model=model_file, progress=lambda done, total: told.append((done, total)))
    assert told == sorted(told)
    assert told[-1][0] == told[-1][1]


# ── starts and models ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("init", ["auto", "stationary", "prior", "truth", "0.01,0.02,0.03,0.1,0.2,0.3"])
def test_every_start_is_the_one_turn_on_finds(
    source: Path, recording: Recording, model_file: Path, tmp_path: Path, init: str
) -> None:
    report = debias(source, tmp_path / "out.mcap", model=model_file, init=init)
    model = load(model_file)
    expected = {
        "auto": lambda: auto(model, recording.imu),
        "stationary": lambda: at_rest(model, recording.imu),
        "prior": lambda: prior(model),
        "truth": lambda: from_truth(model, recording),
    }.get(init, lambda: from_numbers(init))()
    start = report.starts["/imu0"]
    assert start.how == expected.how
    np.testing.assert_allclose(start.rest, expected.rest, rtol=0, atol=1e-12)
    assert dict(report.models) == {"/imu0": "m"}


@pytest.mark.parametrize("method", ["static", "linear", "neural_ode"])
def test_smoothing_takes_the_whole_log_and_says_so(source: Path, recording: Recording, tmp_path: Path, method: str) -> None:
    path: str | Path = method
    model = static.Network().frozen() if method == "static" else make_model(method)
    if method != "static":
        path = tmp_path / "m.safetensors"
        save(model, path)
        model = load(path)
    report = debias(source, tmp_path / "out.mcap", model=path, smooth=True)
    imu = recording.imu
    start = smoothed_start(model, [(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)], bias_prior(model))
    made = read(tmp_path / "out.mcap", imu="/imu0/debiased").imu
    np.testing.assert_allclose(made.gyro, apply(model, start, imu).imu.gyro, rtol=0, atol=1e-12)
    assert report.starts["/imu0"].how == start.how
    assert start.how.endswith("forward and backward")
    record = metadata(tmp_path / "out.mcap")[-1][1]
    assert (record["smooth"], record["causal"], record["init"]) == ("true", "false", "auto")
    assert metadata_of(source, tmp_path, path)["smooth"] == "false"


def metadata_of(source: Path, tmp_path: Path, model: str | Path) -> dict[str, str]:
    debias(source, tmp_path / "causal.mcap", model=model)
    return metadata(tmp_path / "causal.mcap")[-1][1]


def test_smoothing_finds_its_own_start(source: Path, model_file: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"smooth: `smooth` with `init=prior`; expected `init=auto`"):
        debias(source, tmp_path / "out.mcap", model=model_file, init="prior", smooth=True)
    assert not (tmp_path / "out.mcap").exists()


def test_without_a_model_the_static_bias_is_the_mean_at_rest(source: Path, recording: Recording, tmp_path: Path) -> None:
    report = debias(source, tmp_path / "out.mcap")
    assert dict(report.models) == {"/imu0": "static"}
    bias = recording.imu.gyro[:600].mean(axis=0)
    np.testing.assert_allclose(report.starts["/imu0"].rest[:3], bias, atol=2e-4)
    made = read(tmp_path / "out.mcap", imu="/imu0/debiased").imu
    assert np.abs(made.gyro[:600].mean(axis=0)).max() < 2e-4
    assert np.abs(recording.imu.gyro[:600].mean(axis=0)).max() > 5e-3
    assert metadata(tmp_path / "out.mcap")[-1][1]["causal"] == "false"  # rest later in the log has its say, too


def test_without_a_model_the_one_the_logs_metadata_names_is_used(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shelf = tmp_path / "shelf"
    shelf.mkdir()
    save(make_model("linear"), shelf / "adis.safetensors")
    monkeypatch.setattr("imutool.bias.model_file.library", lambda: shelf)
    log = tmp_path / "log.mcap"
    write(Recording("r", recording.imu, metadata={"imutool": {"model": "adis"}}), log)
    assert dict(debias(log, tmp_path / "out.mcap").models) == {"/imu0": "adis"}
    other = tmp_path / "other.mcap"
    write(Recording("r", recording.imu, metadata={"imutool": {"model": "adsi"}}), other)
    with pytest.raises(ModelError, match=r"no model 'adsi'.*Did you mean 'adis'"):
        debias(other, tmp_path / "out2.mcap")


@pytest.mark.parametrize("name", ["{}/adis.safetensors", "{}/adis", "physics.toml", "/dev/zero"])
def test_a_log_cannot_name_a_file_as_its_model(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    save(make_model("linear"), tmp_path / "adis.safetensors")
    (tmp_path / "physics.toml").touch()
    log = tmp_path / "log.mcap"
    write(Recording("r", recording.imu, metadata={"imutool": {"model": name.format(tmp_path)}}), log)
    with pytest.raises(ModelError, match=r"no model .*expected a file, or one of"):
        debias(log, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def moving(tmp_path: Path) -> Path:
    log = tmp_path / "moving.mcap"
    write(flight(2, duration_s=8.0, still_s=0.0), log)
    return log


def test_no_model_and_no_rest_is_a_refusal_that_says_what_to_do(tmp_path: Path) -> None:
    log = moving(tmp_path)
    for model in (None, "static", Path("static")):
        with pytest.raises(
            ModelError,
            match=r"moving.mcap: the log holds no stretch at rest.*trained `model`, or at least 1.5 s.*: `init` truth",
        ):
            debias(log, tmp_path / "out.mcap", model=model)
        with pytest.raises(ModelError, match=r"moving.mcap: the log holds no stretch at rest"):
            debias(log, tmp_path / "out.mcap", model=model, smooth=True)
    assert ModelError.exit_code == 6
    assert [path.name for path in tmp_path.iterdir()] == ["moving.mcap"]


def test_a_model_for_another_rate_is_refused(source: Path, tmp_path: Path) -> None:
    path = tmp_path / "slow.safetensors"
    save(make_model("linear", 100.0), path)
    with pytest.raises(ModelError, match=r"flight.mcap: IMU at 200.0 Hz; expected 100.0 Hz.*'slow'.* with `force`"):
        debias(source, tmp_path / "out.mcap", model=path)
    assert not (tmp_path / "out.mcap").exists()
    fit = debias(source, tmp_path / "out.mcap", model=path, force=True).fits["/imu0"]
    assert fit.verdict == "doubtful"
    assert "samples at 200.00 Hz, in the training logs at 100.00 Hz" in fit.reasons
    save(make_model("linear", 200.0), tmp_path / "fast.safetensors")
    debias(source, tmp_path / "same.mcap", model=tmp_path / "fast.safetensors", force=True)
    forced, same = (read(tmp_path / name, imu="/imu0/debiased").imu for name in ("out.mcap", "same.mcap"))
    np.testing.assert_array_equal(forced.gyro, same.gyro)


def test_another_imu_of_a_known_log_is_not_the_known_sensor(tmp_path: Path) -> None:
    """The metadata name the sensor of one topic; a camera's own IMU has no model that ships."""
    log, known = (
        tmp_path / "two.mcap",
        {"sensor": "adis16448", "dataset": "euroc", "sequence": "MH_01_easy", "imu_topic": "/imu0"},
    )
    both = write_two_imus(flight(3, duration_s=6.0, still_s=3.0), log, known, other=0.01)
    report = debias(log, tmp_path / "out.mcap", imus=both, force=True)
    assert dict(report.models) == {"/imu0": "euroc-adis16448-hybrid", "/imu1": "static"}
    sensors = [read(tmp_path / "out.mcap", imu=topic).metadata["imutool"].get("sensor") for topic in (*both, "/imu0/debiased")]
    assert sensors == ["adis16448", None, "adis16448"]


def test_several_imus_each_get_their_own(recording: Recording, tmp_path: Path, model_file: Path) -> None:
    log = tmp_path / "two.mcap"
    both = write_two_imus(recording, log)
    with pytest.raises(LogError, match=r"2 IMU topics: /imu0, /imu1. Choose one with `imu`"):
        debias(log, tmp_path / "out.mcap", model=model_file)
    report = debias(log, tmp_path / "out.mcap", model=model_file, imus=["/imu0", "/imu1"])
    assert set(report.rewrite.added) == {
        f"{imu}{name}" for imu in both for name in ("/debiased", "/bias/gyro", "/bias/accel", "/bias")
    }
    assert [name for name, _ in metadata(tmp_path / "out.mcap")] == ["imutool/imu0", "imutool/imu1"]
    a, b = (read(tmp_path / "out.mcap", imu=f"{imu}/debiased").imu for imu in both)
    assert not np.array_equal(a.gyro, b.gyro)


def test_two_imus_with_a_model_each_are_what_each_alone_would_be(recording: Recording, tmp_path: Path) -> None:
    log, out = tmp_path / "two.mcap", tmp_path / "out.mcap"
    models = {}
    for topic, method in zip(write_two_imus(recording, log), ("linear", "neural_ode"), strict=True):
        models[topic] = tmp_path / f"{method}.safetensors"
        save(make_model(method), models[topic])
    report = debias(log, out, model=models)
    assert dict(report.models) == {"/imu0": "linear", "/imu1": "neural_ode"}
    for topic, path in models.items():
        alone = tmp_path / f"alone{topic[-1]}.mcap"
        debias(log, alone, model=path, imus=[topic])
        names = [f"{topic}{name}" for name in ("/debiased", "/bias/gyro", "/bias/accel", "/bias")]
        assert columns(out, *names) == columns(alone, *names)
    found = dict(metadata(out))
    assert [found[f"imutool{topic}"]["model"] for topic in models] == ["linear", "neural_ode"]
    mixed = debias(
        log, tmp_path / "mixed.mcap", model={"": "static", "/imu1": models["/imu1"]}, imus=["/imu0", "/imu1", "/imu0"]
    )
    assert dict(mixed.models) == {"/imu0": "static", "/imu1": "neural_ode"}


def test_an_imu_does_not_get_the_model_that_the_log_names_for_another(
    recording: Recording, tmp_path: Path, model_file: Path
) -> None:
    log, first, out = tmp_path / "two.mcap", tmp_path / "first.mcap", tmp_path / "out.mcap"
    write_two_imus(recording, log)
    debias(log, first, model=model_file, imus=["/imu1"])
    assert dict(debias(first, out, imus=["/imu0"]).models) == {"/imu0": "static"}


def test_models_that_contradict_one_another_are_refused(recording: Recording, tmp_path: Path, model_file: Path) -> None:
    log, out = tmp_path / "two.mcap", tmp_path / "out.mcap"
    write_two_imus(recording, log)
    with pytest.raises(ConfigError, match=r"model: a model for /imu1, .* expected /imu0.*/imu1 to `imus`"):
        debias(log, out, model={"/imu1": model_file}, imus=["/imu0"])
    with pytest.raises(ConfigError, match="each has one"):
        debias(log, out, model={"": "static", "/imu0": model_file, "/imu1": model_file})
    with pytest.raises(LogError, match="there is no topic /imu7"):
        debias(log, out, model={"/imu7": model_file})
    assert not out.exists()


def test_models_on_the_command_line_are_for_all_or_for_a_topic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lr=0.1").mkdir()
    Path("lr=0.1/m.safetensors").touch()
    assert assigned([]) == {}
    assert assigned(["adis"]) == {"": "adis"}
    assert assigned(["/imu0=a", "/imu1=b=c", "d"]) == {"/imu0": "a", "/imu1": "b=c", "": "d"}
    assert assigned(["lr=0.1/m.safetensors"]) == {"": "lr=0.1/m.safetensors"}
    for words, said in (
        (["a", "b"], "a and b are both given for all IMUs"),
        (["/imu0=a", "/imu0=b"], "a and b are both given for /imu0"),
        (["=a"], "expected MODEL or TOPIC=MODEL"),
        (["/imu0="], "expected MODEL or TOPIC=MODEL"),
    ):
        with pytest.raises(ConfigError, match=said):
            assigned(words)


def test_poses_that_make_no_sense_are_no_business_of_an_imu(recording: Recording, tmp_path: Path, model_file: Path) -> None:
    """Odometry of a robot without orientation: zeros where a quaternion should be. It passes through as it is."""
    imu, few = recording.imu, recording.imu.t_ns[:50]
    log, out = tmp_path / "odd.mcap", tmp_path / "out.mcap"
    with log.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        for name, topic, rows, times in (
            (schemas.IMU, "/imu0", encode_imu(imu.t_ns, imu.gyro, imu.accel, "b"), imu.t_ns),
            (schemas.POSE, "/pose", encode_pose(few, np.zeros((50, 3)), np.zeros((50, 4)), "w"), few),
        ):
            kind = writer.register_schema(name, "ros2msg", schemas.definition(name).encode())
            channel = writer.register_channel(topic, "cdr", kind)
            for k, (stamp, payload) in enumerate(zip(times.tolist(), rows, strict=True)):
                writer.add_message(channel, stamp, payload.tobytes(), stamp, k)
        writer.finish()
    for model in (None, model_file):
        debias(log, out, model=model, overwrite=True)
        assert originals(out) == originals(log)
    with pytest.raises(LogError, match="/pose"):
        debias(log, out, model=model_file, init="truth", overwrite=True)


# ── refusals ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_of_a_truncated_log_what_is_left_is_debiased_and_without_anything_left_nothing(
    source: Path, model_file: Path, tmp_path: Path
) -> None:
    whole = source.read_bytes()
    folder = tmp_path / "out"
    folder.mkdir()
    for length in (0, 10):
        source.write_bytes(whole[:length])
        for model in (None, model_file):
            with pytest.raises(LogError):
                debias(source, folder / "out.mcap", model=model)
            assert list(folder.iterdir()) == []
    source.write_bytes(whole[:-30])  # the end of the summary
    report = debias(source, folder / "out.mcap", model=model_file)
    assert not report.losses
    assert report.losses.harmless
    assert [path.name for path in folder.iterdir()] == ["out.mcap"]


def test_a_debiased_log_is_not_debiased_again(target: Path, model_file: Path, tmp_path: Path) -> None:
    for model in (model_file, None):  # the log names a model that does not ship
        with pytest.raises(LogError, match="debiased is in this log already"):
            debias(target, tmp_path / "twice.mcap", model=model, imus=["/imu0"])
    assert not (tmp_path / "twice.mcap").exists()


def test_an_existing_target_and_the_source_itself_are_kept(source: Path, target: Path, model_file: Path) -> None:
    before = sha256(target), sha256(source)
    with pytest.raises(ConfigError, match="exists"):
        debias(source, target, model=model_file)
    with pytest.raises(ConfigError, match="the target is the source"):
        debias(source, source, model=model_file, overwrite=True)
    assert (sha256(target), sha256(source)) == before
    debias(source, target, model=model_file, overwrite=True, init="prior")
    assert sha256(target) != before[0]


@pytest.mark.parametrize("count", [0, 1])
def test_a_log_with_hardly_a_sample_is_refused(recording: Recording, model_file: Path, tmp_path: Path, count: int) -> None:
    log = tmp_path / "short.mcap"
    write(Recording("short", recording.imu.rows(slice(0, count))), log)
    for model in (None, model_file):
        with pytest.raises(LogError, match=f"short.mcap: /imu0 holds {count} messages; expected at least 2"):
            debias(log, tmp_path / "out.mcap", model=model)
    assert not (tmp_path / "out.mcap").exists()


def test_a_topic_that_is_no_imu_is_refused(source: Path, model_file: Path, tmp_path: Path) -> None:
    for topic in ("/imu9", "/ground_truth/pose"):
        with pytest.raises(LogError, match=topic):
            debias(source, tmp_path / "out.mcap", model=model_file, imus=[topic])
    with pytest.raises(ConfigError, match="init"):
        debias(source, tmp_path / "out.mcap", model=model_file, init="sometimes")
    assert not (tmp_path / "out.mcap").exists()


def test_a_log_that_grows_meanwhile_is_refused_and_not_taken_for_a_damaged_one(
    source: Path, model_file: Path, tmp_path: Path
) -> None:
    def grow(done: int, total: int) -> None:
        with source.open("ab") as log:
            log.write(b"no record")

    with pytest.raises(LogError, match="changed while it was copied"):
        debias(source, tmp_path / "out.mcap", model=model_file, progress=grow)
    assert not (tmp_path / "out.mcap").exists()


def test_ctrl_c_in_the_middle_leaves_nothing(source: Path, model_file: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done > total // 4:
            raise KeyboardInterrupt

    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        debias(source, tmp_path / "out.mcap", model=model_file, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("first_s", [0.0, -100.0, -1.0])
def test_stamps_before_1970_change_no_bias(recording: Recording, first_s: float) -> None:
    """Of a clock that counts down to a start, as in ROS 2, whose seconds have a sign; in several batches."""
    model, imu, out = make_model("neural_ode"), recording.imu.rows(slice(0, 1500)), list[np.ndarray]()
    imu = replace(imu, t_ns=imu.t_ns - imu.t_ns[0] + round(1e9 * first_s))
    start = tracked_from_prior(model)
    debiaser = Debiaser("/imu0", model, start, watch=lambda block: out.append(block.bias))
    for part in cut(batch_of(imu), [400, 700, 1100]):
        debiaser(part)
    np.testing.assert_allclose(np.concatenate(out), apply(model, start, imu).bias, rtol=0, atol=ONLINE)


# ── one sample at a time ─────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("method", ["static", "linear", "neural_ode"])
def test_one_sample_at_a_time_gives_the_batchs_numbers(recording: Recording, method: str) -> None:
    model, imu = make_model(method), recording.imu.rows(slice(0, 1500))
    start = prior(model)
    batch, online = apply(model, start, imu), OnlineDebiaser(model, start)
    for k in range(len(imu)):
        gyro, accel, bias = online(int(imu.t_ns[k]), imu.gyro[k], imu.accel[k])
        np.testing.assert_allclose(gyro, batch.imu.gyro[k], rtol=0, atol=ONLINE)
        np.testing.assert_allclose(accel, batch.imu.accel[k], rtol=0, atol=ONLINE)
        np.testing.assert_allclose(bias, batch.bias[k], rtol=0, atol=ONLINE)


@pytest.mark.parametrize("method", ["linear", "neural_ode"])
def test_a_live_node_follows_the_rest_bias_as_a_log_does(recording: Recording, method: str) -> None:
    """From the prior on, without a look at what is to come."""
    model, imu = make_model(method), recording.imu.rows(slice(0, 1500))
    online, batch = OnlineDebiaser(model), apply(model, tracked_from_prior(model), imu)
    found = np.array([online(int(t), w, a)[2] for t, w, a in zip(imu.t_ns, imu.gyro, imu.accel, strict=True)])
    np.testing.assert_allclose(found, batch.bias, rtol=0, atol=ONLINE)
    still = recording.imu.gyro[:600].mean(axis=0)
    left = still - found[500:600, :3].mean(axis=0)
    assert np.abs(left).max() < 0.1 * np.abs(still).max()


def test_the_batch_path_is_the_models_forward_pass(recording: Recording) -> None:
    model, imu = make_model("neural_ode"), recording.imu
    t = torch.from_numpy(seconds(imu.t_ns, int(imu.t_ns[0])))[None]
    gyro, accel = (torch.from_numpy(u.copy())[None] for u in (imu.gyro, imu.accel))
    expected = make_network("neural_ode")(Segment(t, gyro, accel, torch.zeros(1, 6, dtype=torch.float64)))[0]
    start = InitialBias(np.zeros(6), np.zeros(6), "zero")
    np.testing.assert_allclose(apply(model, start, imu).bias, expected, rtol=0, atol=ONLINE)


def test_the_static_estimate_is_a_model_and_its_start(recording: Recording) -> None:
    model, start = estimate_at_rest(recording.imu, "here")
    assert model.method == "static"
    np.testing.assert_array_equal(apply(model, start, recording.imu).bias, np.tile(start.rest, (len(recording.imu), 1)))
    counts = replace(recording.imu, accel=1e9 * recording.imu.accel)
    with pytest.raises(DataError, match=r"^counts\.mcap: 0 of \d+ samples are a measurement"):
        estimate_at_rest(counts, "counts.mcap")


# ── a real recording ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_real_log_keeps_every_message_and_opens_elsewhere(data: Path, tmp_path: Path) -> None:
    convert(data / "euroc" / "MH_04_difficult.zip", tmp_path / "MH_04.mcap", workers=1)
    log, out, model = tmp_path / "MH_04.mcap", tmp_path / "out.mcap", tmp_path / "m.safetensors"
    save(make_model("neural_ode"), model)
    before = sha256(log)
    report = debias(log, out, model=model)
    assert sha256(log) == before
    assert originals(out) == originals(log)
    assert dict(report.rewrite.added) == dict.fromkeys(NEW, 20320)
    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == report.rewrite.copied + 4 * 20320
    with AnyReader([out]) as bag:
        found = {c.topic: c.msgcount for c in bag.connections}
        assert {found[topic] for topic in NEW} == {20320}
        (connection,) = [c for c in bag.connections if c.topic == NEW[0]]
        made = [bag.deserialize(raw, connection.msgtype) for _, _, raw in bag.messages([connection])]
    expected = read(out, imu=NEW[0]).imu
    for name, values in (("angular_velocity", expected.gyro), ("linear_acceleration", expected.accel)):
        np.testing.assert_array_equal([[getattr(getattr(m, name), axis) for axis in "xyz"] for m in made], values)
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in made]
    np.testing.assert_array_equal(stamps, expected.t_ns)


# ── one open log ──


class Opens:
    """Counts the sources that are opened of one log, and the indexes that are read of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
        self.sources = self.summaries = 0

        def open_source(source: Source, path: Any, *words: Any) -> None:
            self.sources += path.name == name
            original_open(source, path, *words)

        def read_summary(index: LogIndex) -> Any:
            self.summaries += index.source.path.name == name
            return original_read(index)

        original_open, original_read = Source.__init__, LogIndex._read_summary
        monkeypatch.setattr(Source, "__init__", open_source)
        monkeypatch.setattr(LogIndex, "_read_summary", read_summary)


@pytest.mark.parametrize("options", [{}, {"smooth": True}, {"init": "truth"}, {"clean": CleaningSettings()}], ids=str)
def test_a_log_is_opened_once_and_once_more_for_its_checksum(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    (tmp_path / "in.mcap").write_bytes((logs / "flight_1.mcap").read_bytes())
    opens = Opens(monkeypatch, "in.mcap")
    debias(tmp_path / "in.mcap", tmp_path / "out.mcap", model=logs / "linear.safetensors", **options)
    assert (opens.sources, opens.summaries) == (2, 2)  # the summary once to look for damage, once to read: from one open file
