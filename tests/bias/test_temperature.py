"""A bias follows the temperature of its log: its terms, its range, and what a log without it gets."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.writer import Writer as Ros2Writer
from support.robot_cases.log import DEFINITIONS

import imutool
from imutool.bias.log_binding import OnlineDrift
from imutool.bias.model import BiasModel
from imutool.bias.model_file import load, save
from imutool.bias.networks import hybrid
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.temperature import temperature_scale, temperature_tensors
from imutool.bias.temperature import FORMS, Scale, TemperatureFilter, channel_of
from imutool.bias_start.correction import apply
from imutool.bias_start.initial_bias import prior, tracked_from_prior
from imutool.bias_start.model_choice import bound_to, find_initial_bias
from imutool.bias_start.stretches import read_stretches
from imutool.debiasing import debias
from imutool.mcap_io.read import read
from imutool.mcap_io.temperature import thinned
from imutool.recording import Imu, Recording, Scalars
from imutool.sensor.signals import LOAD_TAU_S, TEMPERATURE_TERMS
from imutool.viewing.model.load_view import load as load_view
from imutool.viewing.stream import sources
from imutool.viewing.stream.samples import Malformed, decoded

MakeModel = Callable[..., BiasNetwork]
RATE_HZ, START_NS = 50.0, 1_700_000_000_000_000_000
CENTRE, HALF = 30.0, 10.0
CHANNEL = "/imu0/temperature"
SAME = 1e-12  # rounding of sums
STORED = 1e-6  # a model file holds float32
TEMPERATURE = DEFINITIONS["sensor_msgs/msg/Temperature"].replace("===", 80 * "=")
SIZE = 0.01  # rad/s from the centre to the end of the range


def scalars(t_s: np.ndarray, celsius: np.ndarray, unit: str = "degC") -> Scalars:
    return Scalars(START_NS + np.round(1e9 * t_s).astype(np.int64), np.asarray(celsius, float)[:, None], unit)


def recording(channel: Scalars | None, seconds: float = 100.0, name: str = CHANNEL) -> Recording:
    """A sensor at rest, turned by nothing but its bias."""
    t_ns = START_NS + np.round(1e9 * np.arange(round(seconds * RATE_HZ)) / RATE_HZ).astype(np.int64)
    rng = np.random.default_rng(0)
    noise = 1e-4 * rng.normal(size=(len(t_ns), 6))
    imu = Imu(t_ns, noise[:, :3], noise[:, 3:] + [0.0, 0.0, 9.81])
    return Recording("warm", imu, scalars={} if channel is None else {name: channel})


def warming(seconds: float = 100.0, every_s: float = 1.0) -> Scalars:
    t_s = np.arange(0.0, seconds, every_s)
    return scalars(t_s, CENTRE - HALF + 2.0 * HALF * t_s / seconds)


@pytest.fixture
def model(build: MakeModel, tmp_path: Path) -> BiasModel:
    """Gyro about x that follows the temperature at once, linearly, as a model file has it."""
    network = build("hybrid", 0, remainder=False)
    assert isinstance(network, hybrid.Network)
    theta = np.zeros(3 * TEMPERATURE_TERMS)
    theta[0] = SIZE
    covariance = torch.zeros(len(theta), len(theta), dtype=torch.float64)
    covariance[0, 0] = (0.1 * SIZE) ** 2
    network.take(
        "gyro",
        ("gyro_scale", "gyro_temperature"),
        torch.from_numpy(np.append(np.zeros(3), theta)),
        torch.block_diag(torch.zeros(3, 3), covariance),
    )
    scale = Scale(CHANNEL, CENTRE, HALF, np.zeros(TEMPERATURE_TERMS))
    tensors = temperature_tensors(scale, [recording(warming())], {"gyro": theta})
    network.take_temperature(CHANNEL, tensors)
    network.rate_hz = RATE_HZ
    network.prior_mean.zero_()
    network.prior_std.fill_(1e-3)
    network.walk_std.fill_(1e-6)
    network.noise_std.fill_(1e-4)
    save(network.frozen(), tmp_path / "warm.safetensors")
    return load(tmp_path / "warm.safetensors")


# the terms


def test_the_states_lag_behind_a_step_by_their_time_constants() -> None:
    follow = TemperatureFilter(CENTRE, HALF)
    first = follow(0, CENTRE)
    np.testing.assert_allclose(first.reshape(-1, 3), np.tile([0.0, -0.5, 0.0], (4, 1)), atol=SAME)
    follow(1_000_000_000, CENTRE + HALF)
    later = follow(21_000_000_000, CENTRE + HALF).reshape(-1, 3)
    np.testing.assert_allclose(later[0], [1.0, 1.0, 1.0], atol=SAME)
    np.testing.assert_allclose(later[1:, 0], -np.expm1(-20.0 / LOAD_TAU_S), atol=SAME)


def test_the_polynomials_are_those_of_legendre_and_go_on_straight_beyond_the_range() -> None:
    basis = [np.polynomial.legendre.Legendre.basis(n) for n in (1, 2, 3)]
    inside = TemperatureFilter(CENTRE, HALF)(0, CENTRE + 0.4 * HALF)[:3]
    np.testing.assert_allclose(inside, [p(0.4) for p in basis], atol=SAME)
    for end in (-1.0, 1.0):
        beyond = TemperatureFilter(CENTRE, HALF)(0, CENTRE + 1.3 * end * HALF)
        np.testing.assert_allclose(beyond[:3], [p(end) + 0.3 * end * p.deriv()(end) for p in basis], atol=1e-12)


# a log's channel


def test_the_channel_of_an_imu_is_the_one_named_then_its_own_then_the_only_one() -> None:
    a, b = warming(), warming()
    assert channel_of({"/motor/temperature": a}, "/imu0") is not None
    assert channel_of({"/motor/temperature": a, CHANNEL: b}, "/imu0") is not None
    found = channel_of({"/motor/temperature": a, CHANNEL: b}, "/imu0")
    assert found is not None
    assert found[0] == CHANNEL
    found = channel_of({"/motor/temperature": a, CHANNEL: b}, "/imu0", "/motor/temperature")
    assert found is not None
    assert found[0] == "/motor/temperature"
    assert channel_of({"/a/temperature": a, "/b.temperature": b}, "/imu0") is None
    assert channel_of({"/imu0/rate": a}, "/imu0") is None


@pytest.mark.parametrize("unit", ["K", ""])
def test_kelvin_is_known_by_its_unit_or_its_size(unit: str) -> None:
    plain = warming()
    found = channel_of({CHANNEL: Scalars(plain.t_ns, plain.values + 273.15, unit)}, "/imu0")
    assert found is not None
    np.testing.assert_allclose(found[1].values, plain.values, atol=1e-9)


# the drift of a log


def expected(log: Recording, channel: Scalars) -> np.ndarray:
    """Rate about x from the number that holds, clamped to the range."""
    row = np.maximum(np.searchsorted(channel.t_ns, log.imu.t_ns, side="right") - 1, 0)
    return SIZE * np.clip((channel.values[row, 0] - CENTRE) / HALF, -1.0, 1.0)


def planted() -> Recording:
    """Recording whose gyro has the drift."""
    log, channel = recording(warming()), warming()
    return replace(log, imu=Imu(log.imu.t_ns, log.imu.gyro + expected(log, channel)[:, None] * [1.0, 0.0, 0.0], log.imu.accel))


@pytest.mark.parametrize("shift_s", [0.0, 30.0])
def test_the_drift_is_that_of_the_last_number(model: BiasModel, shift_s: float) -> None:
    channel = warming()
    channel = Scalars(channel.t_ns + round(1e9 * shift_s), channel.values, channel.unit)
    log = recording(channel)
    drift = bound_to(model, log).log_drift
    assert drift is not None
    np.testing.assert_allclose(drift(log.imu.t_ns)[:, 0], expected(log, channel), atol=STORED)
    assert not drift(log.imu.t_ns)[:, 1:].any()


@pytest.mark.parametrize("smooth", [False, True])
def test_a_model_in_memory_and_on_a_log_subtract_the_same(model: BiasModel, tmp_path: Path, smooth: bool) -> None:
    log, parts = planted(), list[np.ndarray]()
    init = "auto" if smooth else "prior"
    imutool.write(tmp_path / "log.mcap", log)
    in_memory = imutool.debias(log, model, init=init, smooth=smooth)
    report = debias(
        tmp_path / "log.mcap",
        tmp_path / "out.mcap",
        model=tmp_path / "warm.safetensors",
        init=init,
        smooth=smooth,
        watch=lambda block: parts.append(block.std),
    )
    on_log = read(tmp_path / "out.mcap", imu="/imu0/debiased").imu
    np.testing.assert_array_equal(on_log.gyro, in_memory.imu.gyro)
    np.testing.assert_array_equal(on_log.accel, in_memory.imu.accel)
    np.testing.assert_array_equal(np.concatenate(parts), in_memory.std)
    assert report.fits["/imu0"].verdict == in_memory.fitness.verdict != "unfit"
    np.testing.assert_allclose(in_memory.bias[:, 0], expected(log, warming()), atol=2e-4 if smooth else STORED)
    if not smooth:  # of the rest bias alone about y, and of the drift about x: half the range from its mean so far
        assert in_memory.std[-1, 0] == pytest.approx(np.hypot(in_memory.std[-1, 1], 0.1 * SIZE), rel=0.02)


def test_the_rest_bias_is_measured_without_the_drift(model: BiasModel) -> None:
    """A stop of the whole log: with the drift in it no constant would fit."""
    log = planted()
    start = find_initial_bias("auto", bound_to(model, log), log)
    assert np.abs(start.rest[:3]).max() < 1e-4
    debiased = imutool.debias(log, model)
    assert np.abs(debiased.imu.gyro).mean() < 2e-4
    assert debiased.fitness.reasons[-1] == f"its bias follows {CHANNEL}"


def test_the_covariance_of_the_drift_grows_with_the_way_from_its_mean(model: BiasModel) -> None:
    log = recording(warming())
    drift = bound_to(model, log).log_drift
    assert drift is not None
    std = np.sqrt(drift.covariance(log.imu.t_ns)[:, 0, 0])
    assert std[0] == 0.0
    assert std[-1] == pytest.approx(0.1 * SIZE, rel=0.05)  # half the range, 1 in units of it, from the mean so far


# what is told


def test_without_a_temperature_it_says_so_and_is_less_sure(model: BiasModel) -> None:
    log = recording(None)
    bound = bound_to(model, log)
    assert bound.log_drift is None
    assert "there is no temperature" in bound.remarks[0]
    assert CHANNEL in bound.remarks[0]
    rms = SIZE / np.sqrt(3.0)
    assert prior(bound).std[0] == pytest.approx(np.hypot(1e-3, rms), rel=0.05)
    assert prior(bound).std[1] == pytest.approx(1e-3)
    assert bound.walk_std[0] > 10.0 * model.walk_std[0]
    debiased = imutool.debias(log, model)
    assert debiased.fitness.verdict == "doubtful"
    assert "there is no temperature" in debiased.fitness.reasons[0]
    assert debiased.std[0, 0] > imutool.debias(recording(warming()), model).std[0, 0]


def test_several_that_may_be_meant_are_named(model: BiasModel) -> None:
    log = replace(recording(None), scalars={"/a/temperature": warming(), "/b/temperature": warming()})
    assert "/a/temperature, /b/temperature" in bound_to(model, log).remarks[0]


def test_training_says_that_several_may_be_meant(caplog: pytest.LogCaptureFixture) -> None:
    log = replace(recording(None), scalars={"/a/temperature": warming(), "/b/temperature": warming()})
    assert temperature_scale([log]) is None
    assert "/a/temperature, /b/temperature" in caplog.text
    scale = temperature_scale([log], "/b/temperature")
    assert scale is not None
    assert scale.channel == "/b/temperature"


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_beyond_the_range_the_drift_goes_on_and_the_rest_bias_varies_as_far(model: BiasModel, sign: float) -> None:
    t_s = np.arange(100.0)
    channel = scalars(t_s, CENTRE + sign * HALF * (1.0 + 0.02 * t_s))
    bound = bound_to(model, log := recording(channel))
    assert "goes on straight" in bound.remarks[0]
    assert bound.log_drift is not None
    np.testing.assert_allclose(bound.log_drift(channel.t_ns)[:, 0], sign * SIZE * (1.0 + 0.02 * t_s), atol=STORED)
    assert not bound.log_drift.covariance(channel.t_ns)[:, 1:, 1:].any()
    beyond = 0.02 * np.arange(0.0, float(log.imu.t_ns[-1] - log.imu.t_ns[0]) * 1e-9, 10.0)
    assert bound.walk_std[0] == pytest.approx(SIZE * 0.2 / np.sqrt(10.0), rel=1e-3)
    assert prior(bound).std[0] == pytest.approx(np.hypot(1e-3, SIZE * np.sqrt(np.mean(beyond**2))), rel=0.1)
    assert bound.walk_std[1] == model.walk_std[1]
    far = bound_to(model, recording(scalars(t_s, CENTRE + sign * HALF * (1.0 + t_s)))).log_drift
    assert far is not None
    assert far(channel.t_ns[-1:])[0, 0] == pytest.approx(sign * 6.0 * SIZE)  # five half ranges on


def test_a_long_silence_is_told(model: BiasModel) -> None:
    channel = warming(200.0)
    kept = (channel.t_ns < START_NS + 20_000_000_000) | (channel.t_ns > START_NS + 150_000_000_000)
    gapped = Scalars(channel.t_ns[kept], channel.values[kept], "degC")
    assert "silent for 132 s" in bound_to(model, recording(gapped, 200.0)).remarks[0]
    assert not bound_to(model, recording(channel, 200.0)).remarks


def test_a_model_without_it_is_the_same_object(build: MakeModel) -> None:
    (network := build("linear")).rate_hz = RATE_HZ
    plain = network.frozen()
    assert bound_to(plain, recording(warming())) is plain
    assert FORMS["gyro"].name == "gyro_temperature"


# a message of another writer


def with_message(own: Path, out: Path, celsius: Scalars) -> None:
    """The log with its temperature as `sensor_msgs/Temperature` on /imu/temperature, by the library of MCAP, at 10 Hz."""
    alone = out.with_suffix(".alone.mcap")
    with alone.open("wb") as file, Ros2Writer(file) as ros:
        kind = ros.register_msgdef("sensor_msgs/msg/Temperature", TEMPERATURE)
        for t_ns, T in zip(celsius.t_ns.tolist(), celsius.values[:, 0].tolist(), strict=True):
            stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
            ros.write_message(
                "/imu/temperature", kind, {"header": {"stamp": stamp, "frame_id": ""}, "temperature": T}, t_ns, t_ns
            )
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for path in (own, alone):
            for schema, channel, message in make_reader(BytesIO(path.read_bytes())).iter_messages():
                if channel.topic not in channels and schema is not None:
                    of = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(channel.topic, "cdr", of, dict(channel.metadata))
                at = channels[channel.topic]
                writer.add_message(at, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()


def test_every_way_in_reads_a_temperature_message(model: BiasModel, tmp_path: Path) -> None:
    log, file = recording(None), tmp_path / "warm.safetensors"
    imutool.write(tmp_path / "own.mcap", log)
    with_message(tmp_path / "own.mcap", tmp_path / "ros.mcap", warming(100.0, 0.1))
    wanted = expected(log, Scalars(*(column[::5] for column in (warming(100.0, 0.1).t_ns, warming(100.0, 0.1).values))))
    path = tmp_path / "ros.mcap"
    (stretch,), opened = read_stretches(path), imutool.read(path)
    assert list(opened.scalars) == list(stretch.scalars) == ["/imu/temperature.temperature"]
    np.testing.assert_allclose(imutool.debias(opened, model, init="prior").bias[:, 0], wanted, atol=STORED)
    for command in (["debias", str(path), str(tmp_path / "out.mcap")], ["fleet", "debias", str(path), str(tmp_path / "fleet")]):
        subprocess.run([sys.executable, "-m", "imutool", *command, "--model", str(file), "--init", "prior", "-q"], check=True)
    for out in (tmp_path / "out.mcap", next((tmp_path / "fleet").glob("*.mcap"))):
        rate = read(out, imu="/imu0/debiased").imu.gyro
        np.testing.assert_allclose(log.imu.gyro[:, 0] - rate[:, 0], wanted, atol=STORED)
    (run,) = [run for run in (trace.run for trace in load_view(path, models=[file], init="prior").traces) if run.name == "warm"]
    np.testing.assert_allclose(run.gyro_bias[:, 0], wanted, atol=STORED)


# a live stream


def test_a_live_stream_has_the_drift_of_the_log(model: BiasModel) -> None:
    log = planted()
    bound, online = bound_to(model, log), imutool.OnlineDebiaser(model)
    whole = apply(bound, tracked_from_prior(bound, START_NS), log.imu)
    numbers = dict(zip(warming().t_ns.tolist(), warming().values[:, 0].tolist(), strict=True))
    rows = [online(t, *u, numbers.get(t)) for t, *u in zip(log.imu.t_ns.tolist(), log.imu.gyro, log.imu.accel, strict=True)]
    np.testing.assert_allclose([rate for rate, _, _ in rows], whole.imu.gyro, rtol=0, atol=1e-9)
    np.testing.assert_allclose([bias for _, _, bias in rows], whole.bias, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("first_s", "back_s"), [(-1000.0, 0.0), (1000.0, 500.0)])
def test_a_live_stream_follows_the_temperature_on_any_clock(model: BiasModel, first_s: float, back_s: float) -> None:
    """On one that starts below zero, and on one that is set back in the middle."""
    drift, last = OnlineDrift(model), np.zeros(6)
    for k in range(40):
        t_ns = round(1e9 * (first_s + k - back_s * (k >= 20)))
        last = drift(t_ns, CENTRE + HALF * (k / 39.0)).copy()
    np.testing.assert_allclose(last, [SIZE, 0.0, 0.0, 0.0, 0.0, 0.0], atol=STORED)


@pytest.mark.parametrize("first_ns", [0, -(10**10), START_NS])
def test_of_each_half_second_the_first_number_is_kept_on_any_clock(first_ns: int) -> None:
    t_ns = first_ns + 100_000_000 * np.arange(20)
    np.testing.assert_array_equal(thinned(t_ns, np.arange(20.0), "degC").values[:, 0], [0.0, 5.0, 10.0, 15.0])


def test_a_live_stream_without_temperature_is_told(model: BiasModel, caplog: pytest.LogCaptureFixture) -> None:
    online = imutool.OnlineDebiaser(model)
    for k in range(3):
        online(START_NS + k * 20_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    assert [record.message for record in caplog.records if "there is no temperature" in record.message] != []
    assert len(caplog.records) == 1


def test_a_replayed_log_brings_its_temperature(model: BiasModel, tmp_path: Path) -> None:
    log = recording(warming(10.0), 10.0)
    imutool.write(tmp_path / "log.mcap", log)
    replayed = sources.open_source(str(tmp_path / "log.mcap"), Malformed(), speed=1e6, temperature=CHANNEL)
    seen = {sample.stamp_ns: sample.temperature for sample in replayed if sample is not None and sample.temperature is not None}
    assert seen == dict(zip(warming(10.0).t_ns.tolist(), warming(10.0).values[:, 0].tolist(), strict=True))
    imutool.write(tmp_path / "planted.mcap", planted())
    command = ["live", str(tmp_path / "planted.mcap"), "--model", str(tmp_path / "warm.safetensors"), "--speed", "1e6"]
    printed = subprocess.run(
        [sys.executable, "-m", "imutool", *command, "--no-view", "--print"], check=True, capture_output=True
    )
    rates = [json.loads(line)["gyro"][0] for line in printed.stdout.splitlines()]
    assert len(rates) == 5000
    assert np.abs(rates).mean() < 2e-4, "of a drift of a hundredth"
    line = b'{"t_ns": 1, "gyro": [0, 0, 0], "accel": [0, 0, 9.8], "temperature": 21.5}'
    assert next(decoded(line, 0.0, Malformed())).temperature == 21.5
