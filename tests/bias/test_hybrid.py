"""A hybrid is its effects, then the neural ODE on what they leave, and nothing besides."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from imutool.bias import hybrid
from imutool.bias.model import BiasModel, SampleStream
from imutool.bias.model_file import load, save
from imutool.bias.networks import hybrid as network
from imutool.bias.networks import neural_ode
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias_start.correction import OnlineDebiaser, apply
from imutool.bias_start.initial_bias import prior
from imutool.config import build as build_settings
from imutool.errors import ConfigError, ModelError
from imutool.recording import Imu
from imutool.sensor import catalogue
from imutool.sensor.linear_form import compiled
from imutool.sensor.signals import SignalFilter
from imutool.units import COLUMNS, SENSORS, Sensor

MakeModel, MakeSegment = Callable[..., BiasNetwork], Callable[..., Segment]
RATE_HZ = 200.0
NAMES: dict[Sensor, tuple[str, ...]] = {
    "gyro": ("clock_offset", "gyro_misalignment", "rate_curve", "vibration_rectification"),
    "accel": ("lever_arm", "accel_scale"),
}
SAME = 1e-12  # two orders of the same sums
FORGOTTEN = 1e-4  # exp(-10), and a little


def theta_of(sensor: Sensor, names: tuple[str, ...]) -> np.ndarray:
    plausible = np.concatenate([np.zeros(0), *(effect.plausible for effect in catalogue.trained(sensor, names))])
    return plausible * np.random.default_rng(5).normal(size=len(plausible))


def model_of(build: MakeModel, names: dict[Sensor, tuple[str, ...]] | None = None, **settings: object) -> network.Network:
    """A hybrid with effects taken over, as a training leaves it."""
    model = build("hybrid", 3, **settings)
    assert isinstance(model, network.Network)
    for sensor, chosen in (names or NAMES).items():
        theta = torch.from_numpy(theta_of(sensor, chosen))
        model.take(sensor, chosen, theta, torch.diag(theta**2))
    return model


def by_hand(sensor: Sensor, seen: Segment) -> np.ndarray:
    """E of the first element of a batch."""
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    error: np.ndarray = compiled(catalogue.trained(sensor, NAMES[sensor]), theta_of(sensor, NAMES[sensor]))(
        SignalFilter(RATE_HZ)(t, gyro, accel)
    )
    return error


def streamed(model: BiasModel, seen: Segment) -> np.ndarray:
    """The stream's answer over the first element of a batch."""
    t, gyro, accel, rest = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel, seen.rest))
    return model.stream(rest)(t, gyro, accel)


@pytest.fixture
def seen(segment: MakeSegment) -> Segment:
    return segment(31, 1, 500)


def test_without_a_remainder_it_is_rest_and_effects(build: MakeModel, seen: Segment) -> None:
    model = model_of(build, remainder=False)
    assert model.ode is None
    bias = model(seen)[0].numpy()
    for sensor in SENSORS:
        columns = COLUMNS[sensor]
        np.testing.assert_allclose(bias[:, columns], seen.rest[0, columns].numpy() + by_hand(sensor, seen), rtol=0, atol=SAME)


def test_with_one_the_ode_is_shown_what_the_effects_leave(build: MakeModel, seen: Segment) -> None:
    """For all sensors at once in the stream, for the sensor asked for in the forward pass: the ODE keeps them apart."""
    model = model_of(build)
    assert isinstance(model.ode, neural_ode.Network)
    errors = {sensor: torch.from_numpy(by_hand(sensor, seen))[None] for sensor in SENSORS}
    left = Segment(seen.t, seen.gyro - errors["gyro"], seen.accel - errors["accel"], seen.rest)
    expected = model.ode(left) + torch.cat([errors[sensor] for sensor in SENSORS], dim=-1)
    torch.testing.assert_close(model(seen), expected, rtol=0, atol=SAME)
    assert float((model.ode(left) - model.ode(seen)).abs().max()) > 1e-4, "the order must matter for this test to mean anything"
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    streamed = model.frozen().stream(seen.rest[0].numpy())(t, gyro, accel)
    np.testing.assert_allclose(streamed, expected[0].numpy(), rtol=0, atol=1e-10)  # the curve's asinh is steep


@pytest.mark.parametrize("remainder", [True, False])
def test_one_sample_at_a_time_is_the_whole(build: MakeModel, seen: Segment, remainder: bool) -> None:
    """The contract's tests see a hybrid without effects; this one has them."""
    model = model_of(build, remainder=remainder)
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    whole = model.frozen().stream(seen.rest[0].numpy())(t + 7.0, gyro, accel)  # the first stamp need not be zero
    stream = model.frozen().stream(seen.rest[0].numpy())
    singles = [stream(t[k : k + 1] + 7.0, gyro[k : k + 1], accel[k : k + 1]) for k in range(len(t))]
    np.testing.assert_allclose(np.concatenate(singles), whole, rtol=0, atol=SAME)
    np.testing.assert_allclose(whole, model(seen)[0].numpy(), rtol=0, atol=1e-9)  # seconds since 7 are rounded


@pytest.mark.parametrize("remainder", [True, False])
@pytest.mark.parametrize(
    "names",
    [
        NAMES,
        {"gyro": ("gyro_scale",), "accel": ("accel_misalignment",)},  # needs no filter
        {"gyro": ("vibration_rectification",), "accel": ()},  # needs no derivative
        {"gyro": ("rate_curve", "gyro_quadratic"), "accel": ("accel_bias_drift",)},  # without a short way of their own
        {"gyro": (), "accel": ("lever_arm", "accel_quadratic")},
    ],
)
def test_single_samples_and_blocks_mix(
    build: MakeModel, seen: Segment, names: dict[Sensor, tuple[str, ...]], remainder: bool
) -> None:
    """Each takes up what the other left, and what a single sample returned is its caller's."""
    model = model_of(build, names, remainder=remainder)
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    u = np.concatenate([gyro, accel], axis=1)
    whole, stream = model.frozen().stream(seen.rest[0].numpy())(t, gyro, accel), model.frozen().stream(seen.rest[0].numpy())
    assert isinstance(stream, SampleStream)
    singles: list[np.ndarray] = []
    for k in (0, 120, 240, 360):  # 50 samples of the drift's step do not divide them
        singles.extend(stream.one(float(t[i]), u[i]) for i in range(k, k + 70))
        singles.extend(stream(t[k + 70 : k + 120], gyro[k + 70 : k + 120], accel[k + 70 : k + 120]))
    np.testing.assert_allclose(np.array(singles), whole[: len(singles)], rtol=0, atol=SAME)


def test_a_live_node_gets_what_a_log_gets(build: MakeModel, seen: Segment) -> None:
    model = model_of(build).frozen()
    t_ns = 1_700_000_000_000_000_000 + np.round(seen.t[0].numpy() * 1e9).astype(np.int64)
    imu = Imu(t_ns, seen.gyro[0].numpy(), seen.accel[0].numpy())
    start = prior(model)
    log, online = apply(model, start, imu), OnlineDebiaser(model, start)
    lived = [online(int(stamp), gyro, accel) for stamp, gyro, accel in zip(t_ns, imu.gyro, imu.accel, strict=True)]
    expected = (log.imu.gyro, log.imu.accel, log.bias)
    for found, whole in zip(zip(*lived, strict=True), expected, strict=True):
        np.testing.assert_allclose(np.array(found), whole, rtol=0, atol=1e-10)  # seconds come from nanoseconds in two ways


@pytest.mark.parametrize("remainder", [True, False])
def test_it_comes_back_from_its_file_with_its_effects(build: MakeModel, seen: Segment, tmp_path: Path, remainder: bool) -> None:
    model = model_of(build, remainder=remainder)
    save(model.frozen(), tmp_path / "h.safetensors")
    back = load(tmp_path / "h.safetensors")
    assert isinstance(back, hybrid.Model)
    assert back.config == model.config
    assert (back.config.effects("gyro"), back.config.effects("accel")) == (NAMES["gyro"], NAMES["accel"])
    assert (back.ode is None) == (not remainder)
    for sensor in SENSORS:
        for name in (f"theta_{sensor}", f"covariance_{sensor}"):
            assert np.array_equal(back.tensors[name], getattr(model, name).float().double().numpy())
    np.testing.assert_allclose(streamed(back, seen), model(seen)[0].numpy(), rtol=1e-5, atol=1e-5)  # seven digits of 20 m/s²


def test_one_that_dropped_its_ode_is_saved_without_it(build: MakeModel, seen: Segment, tmp_path: Path) -> None:
    model = model_of(build)
    model.drop_remainder()
    save(model.frozen(), tmp_path / "small.safetensors")
    assert not any(name.startswith("ode.") for name in load(tmp_path / "small.safetensors").tensors)
    assert torch.equal(model(seen), model_of(build, remainder=False)(seen))


def test_a_file_with_an_effect_nobody_knows_is_refused(build: MakeModel, tmp_path: Path) -> None:
    model = model_of(build).frozen()
    model.config = hybrid.Config(gyro_effects=("gyro_scal",))
    save(model, tmp_path / "odd.safetensors")
    with pytest.raises(ModelError, match="Did you mean 'gyro_scale'"):
        load(tmp_path / "odd.safetensors")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gyro_effects": ["gyro_scal"]}, r"'gyro_scal' is not known.*Did you mean 'gyro_scale'"),
        ({"accel_effects": ["gyro_scale"]}, "gyro_scale does not act on the accel"),
        ({"gyro_effect": ["gyro_scale"]}, r"gyro_effect is not a setting.*Did you mean gyro_effects"),
        ({"ode": {"curve_widht": 3}}, r"ode.curve_widht is not a setting.*Did you mean ode.curve_width"),
    ],
)
def test_a_slip_of_the_pen_is_told(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        network.Network(build_settings(hybrid.Config, settings))


def test_taking_other_effects_leaves_nothing_of_the_first(build: MakeModel, seen: Segment) -> None:
    model, other = model_of(build, remainder=False), {"gyro": ("gyro_scale",), "accel": ()}
    for sensor in SENSORS:
        theta = torch.from_numpy(theta_of(sensor, other[sensor]) if other[sensor] else np.zeros(0))
        model.take(sensor, other[sensor], theta, torch.zeros(len(theta), len(theta), dtype=torch.float64))
    scale = torch.from_numpy(theta_of("gyro", ("gyro_scale",)))
    expected = seen.rest[:, None] + torch.cat([seen.gyro * scale, torch.zeros_like(seen.accel)], dim=-1)
    torch.testing.assert_close(model(seen), expected, rtol=0, atol=SAME)


def test_the_context_is_as_long_as_the_filters_remember(build: MakeModel, segment: MakeSegment) -> None:
    """Shown only `context` samples before its end, the bias over the end is that of the whole, but for the filters' start."""
    names: dict[Sensor, tuple[str, ...]] = {"gyro": ("vibration_rectification", "rate_curve"), "accel": ("lever_arm",)}
    model = model_of(build, names, remainder=False)
    seen = segment(32, 1, 2500)
    assert model.context == 1000
    first = 2500 - 300 - model.context
    end = Segment(seen.t[:, first:] - seen.t[:, first, None], seen.gyro[:, first:], seen.accel[:, first:], seen.rest)
    whole, cut = model(seen)[:, -300:], model(end)[:, -300:]
    added = float((whole - seen.rest).abs().max())
    assert float((whole - cut).abs().max()) < FORGOTTEN * added
    half = first + model.context // 2
    shorter = Segment(seen.t[:, half:] - seen.t[:, half, None], seen.gyro[:, half:], seen.accel[:, half:], seen.rest)
    assert float((whole - model(shorter)[:, -300:]).abs().max()) > float((whole - cut).abs().max())
    assert build("hybrid").context == 0, "without effects there is nothing to remember"


def test_the_load_outlasts_a_gap(build: MakeModel, segment: MakeSegment) -> None:
    """A drift of minutes does not begin anew where the samples of some seconds are missing."""
    names: dict[Sensor, tuple[str, ...]] = {"gyro": ("gyro_warm_up", "gyro_rate_load"), "accel": ()}
    model, seen = model_of(build, names, remainder=False).frozen(), segment(33, 1, 2000)
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    rest, late = np.zeros(6), t + 5.0 * (t >= t[1000])
    whole, stream = model.stream(rest)(t, gyro, accel), model.stream(rest)
    np.testing.assert_allclose(stream(late, gyro, accel), whole, rtol=0, atol=SAME)
    fresh = model.stream(rest)(t[1000:], gyro[1000:], accel[1000:])
    assert np.abs(fresh - whole[1000:]).max() > 1e-4, "the load must matter for this test to mean anything"


def test_it_does_not_start_from_a_matrix(build: MakeModel) -> None:
    with pytest.raises(ConfigError, match=r"does not start from a matrix.*imutool.training.run.train"):
        build("hybrid").begin_at("gyro", torch.eye(3, dtype=torch.float64))


def test_every_known_effect_can_be_held_at_once(build: MakeModel, seen: Segment, tmp_path: Path) -> None:
    everything: dict[Sensor, tuple[str, ...]] = {
        sensor: tuple(effect.name for effect in catalogue.trained(sensor)) for sensor in SENSORS
    }
    model = model_of(build, everything)
    save(model.frozen(), tmp_path / "all.safetensors")
    assert np.isfinite(streamed(load(tmp_path / "all.safetensors"), seen)).all()
    assert (tmp_path / "all.safetensors").stat().st_size < 2 << 20
    loaded = load(tmp_path / "all.safetensors")
    for sent in (pickle.loads(pickle.dumps(loaded)), copy.deepcopy(loaded)):  # to another process
        np.testing.assert_array_equal(streamed(sent, seen), streamed(loaded, seen))


def test_a_copied_stream_keeps_its_own_filters(build: MakeModel, seen: Segment) -> None:
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    stream = model_of(build).frozen().stream(seen.rest[0].numpy())
    stream(t[:200], gyro[:200], accel[:200])
    copied = copy.deepcopy(stream)
    for k in range(200, len(t)):
        u = np.concatenate([gyro[k], accel[k]])
        np.testing.assert_array_equal(copied.one(float(t[k]), u), stream.one(float(t[k]), u))
