"""The convolutional correction: what it looks at, what it takes for the time before, and one map however it is computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from imutool.array_types import Float64
from imutool.bias.conv import BLOCK, Config
from imutool.bias.model_file import load, save
from imutool.bias.networks.conv import MIN_SCALE, Layer, Net, Network
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.neural_stream import gelu
from imutool.errors import ConfigError
from imutool.units import COLUMNS, SENSORS, Sensor

MakeSegment = Callable[..., Segment]
CONTEXT = 510  # (7 - 1) * (1 + 4 + 16 + 64)
SAME = 1e-12  # rad/s and m/s²: one sum in another order
MOVED = 1e-9  # what a sample within reach moves the answer by, at least
WORTH_SHIPPING = 2 << 20


@pytest.fixture
def model(build: Callable[..., BiasNetwork]) -> Network:
    """A model whose batch norms have seen something: neither zero means nor unit variances."""
    return lively(build("conv"))


def lively(model: BiasNetwork, seed: int = 5) -> Network:
    assert isinstance(model, Network)
    generator = torch.Generator().manual_seed(seed)
    for sensor in SENSORS:
        net = part(model, sensor)
        net.centre.copy_(torch.tensor([0.1, -0.2, 0.3, 0.5, -0.5, 9.0]))
        net.scale.copy_(torch.tensor([0.3, 0.4, 0.5, 1.0, 1.5, 2.0]))
        for layer in net.layers:
            assert isinstance(layer, Layer)
            layer.mean.copy_(0.3 * torch.randn(layer.mean.shape, generator=generator))
            layer.var.copy_(0.5 + torch.rand(layer.var.shape, generator=generator))
    return model


def part(model: Network, sensor: Sensor) -> Net:
    net = model.net[sensor]
    assert isinstance(net, Net)
    return net


def six(seen: Segment) -> Tensor:
    return torch.cat([seen.gyro, seen.accel], dim=-1)


def unfolded(net: Net, u: Tensor) -> Tensor:
    """N(x) layer by layer in float64, batch norm and all."""
    x = ((u - net.centre) / net.scale).mT
    for layer in net.layers:
        x = layer(x)
    return (net.unit * (net.out @ x)).mT


def streamed(model: Network, seen: Segment, cuts: list[int]) -> np.ndarray:
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    stream, edges = model.frozen().stream(seen.rest[0].numpy()), [0, *cuts, len(t)]
    return np.concatenate([stream(t[a:b], gyro[a:b], accel[a:b]) for a, b in pairwise(edges)])


# ── what it is ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_batch_norm_folded_is_batch_norm(model: Network, segment: MakeSegment) -> None:
    """rest + W u - (N(x) - N(0)) with N as written; N(0) from a segment that never moved."""
    seen = segment(1, 2, 700)
    for sensor in SENSORS:
        net, (u, rest) = part(model, sensor), seen.of(sensor)
        never = unfolded(net, torch.zeros(1, 1, 6, dtype=torch.float64))[0, 0]
        torch.testing.assert_close(net.at_rest(), never, rtol=0, atol=SAME)
        expected = rest[:, None] + u @ model.W[sensor].mT - (unfolded(net, six(seen)) - never)
        torch.testing.assert_close(model.sensor_bias(sensor, seen), expected, rtol=0, atol=SAME)
        assert (unfolded(net, six(seen)) - never).abs().max() > 1e-3, "the network must be part of the comparison"


def test_a_rest_bias_of_training_is_another_at_work_and_the_sum_is_the_same(model: Network, segment: MakeSegment) -> None:
    seen = segment(2, 1, 600)
    for sensor in SENSORS:
        u, rest = seen.of(sensor)
        in_training = rest[:, None] + u @ model.W[sensor].mT - unfolded(part(model, sensor), six(seen))
        converted = seen.rest.clone()
        converted[:, COLUMNS[sensor]] = model.rest_at_work(sensor, rest)
        assert not torch.allclose(converted, seen.rest, atol=1e-4)
        at_work = model.sensor_bias(sensor, replace(seen, rest=converted))
        torch.testing.assert_close(at_work, in_training, rtol=0, atol=SAME)


def test_a_fresh_model_adds_nothing_and_a_begun_one_its_matrix(segment: MakeSegment) -> None:
    model, seen = Network().double().eval(), segment(3, 1, 50)
    W = torch.arange(9, dtype=torch.float64).reshape(3, 3) / 100
    assert torch.equal(model(seen), seen.rest[:, None].expand(1, 50, 6))
    model.begin_at("gyro", W)
    torch.testing.assert_close(model(seen)[..., :3], seen.rest[:, None, :3] + seen.gyro @ W.T, rtol=0, atol=1e-15)
    original = Network(Config(start="identity")).double().eval()
    original.begin_at("gyro", W)
    assert torch.equal(original(seen), seen.rest[:, None].expand(1, 50, 6))


def test_it_takes_mean_and_spread_from_what_it_sees(segment: MakeSegment) -> None:
    model, seen = Network().double(), segment(4, 1, 1000)
    gyro = seen.gyro[0].clone()
    gyro[:, 1] = 0.25  # an axis about which the training never turned
    model.see(gyro, seen.accel[0])
    for sensor in SENSORS:
        net = part(model, sensor)
        torch.testing.assert_close(net.centre[:3], gyro.mean(0), rtol=1e-6, atol=0)
        torch.testing.assert_close(net.scale[3:], seen.accel[0].std(0), rtol=1e-6, atol=0)
        assert net.scale[1] == pytest.approx(MIN_SCALE[1])


def test_dropout_and_batch_statistics_are_trainings_alone(model: Network, segment: MakeSegment) -> None:
    seen = segment(5, 2, 300)
    at_work = model(seen)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    assert torch.equal(model(seen), at_work)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    model.train()
    assert not torch.equal(model(seen), model(seen))
    moved = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert moved == {f"net.{s}.layers.{i}.{what}" for s in SENSORS for i in range(4) for what in ("mean", "var")}


# ── what it looks at ─────────────────────────────────────────────────────────────────────────────────────────────────


def test_it_looks_back_over_its_context_and_no_further(model: Network, segment: MakeSegment) -> None:
    """The slope of output 900 with respect to every sample: from 390 to 900, and nowhere else."""
    assert model.context == CONTEXT
    seen, k = segment(6, 1, 1200), 900
    gyro, accel = seen.gyro.clone().requires_grad_(True), seen.accel.clone().requires_grad_(True)
    for sensor in SENSORS:
        bias = model.sensor_bias(sensor, replace(seen, gyro=gyro, accel=accel))
        slopes = torch.autograd.grad(bias[0, k].sum(), (gyro, accel))
        for slope in slopes:  # all six channels, whichever sensor is corrected
            felt = torch.nonzero(slope[0].abs().sum(1))[:, 0]
            assert (int(felt.min()), int(felt.max())) == (k - CONTEXT, k)


def test_a_later_sample_changes_nothing_before_it(model: Network, segment: MakeSegment) -> None:
    seen, k = segment(7, 1, 1500), 700
    gyro = seen.gyro.clone()
    gyro[:, k] += 1.0
    change = (model(replace(seen, gyro=gyro)) - model(seen)).abs()[0]
    assert not change[:k].any()
    assert (change[k].max(), change[k + CONTEXT].max()) > (MOVED, MOVED)
    assert change[k + CONTEXT + 1 :].max() == 0.0


def test_the_time_before_is_the_first_sample_for_ever(model: Network, segment: MakeSegment) -> None:
    """Held for 700 samples before the segment, it changes nothing; any other past does, for as long as it is in reach."""
    seen = segment(8, 1, 900)

    def preceded(gyro: Tensor, accel: Tensor) -> Tensor:
        n = gyro.shape[1]
        t = torch.arange(n + 900, dtype=torch.float64)[None] * 0.005
        longer = Segment(t, torch.cat([gyro, seen.gyro], dim=1), torch.cat([accel, seen.accel], dim=1), seen.rest)
        return model(longer)[:, n:]

    held = preceded(seen.gyro[:, :1].expand(1, 700, 3), seen.accel[:, :1].expand(1, 700, 3))
    torch.testing.assert_close(held, model(seen), rtol=0, atol=SAME)
    other = segment(9, 1, 700)
    change = (preceded(other.gyro, other.accel) - model(seen)).abs()[0].amax(1)
    assert change[:100].min() > MOVED
    assert change[CONTEXT:].max() < SAME


# ── at work ──────────────────────────────────────────────────────────────────────────────────────────────────────────


@given(cuts=st.lists(st.integers(0, 2 * BLOCK + 900), max_size=6).map(sorted))
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_stream_is_the_forward_pass_over_more_than_its_buffers(
    model: Network, cuts: list[int], segment: MakeSegment
) -> None:
    seen = segment(10, 1, 2 * BLOCK + 900)
    np.testing.assert_allclose(streamed(model, seen, cuts), model(seen)[0].numpy(), rtol=0, atol=1e-11)


def test_single_samples_are_the_forward_pass_past_the_end_of_the_buffers(model: Network, segment: MakeSegment) -> None:
    n = BLOCK + CONTEXT + 50
    seen = segment(11, 1, n)
    np.testing.assert_allclose(streamed(model, seen, list(range(1, n))), model(seen)[0].numpy(), rtol=0, atol=1e-11)


def test_a_sample_costs_one_row_of_each_layer(model: Network, segment: MakeSegment, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many came before: what a layer reaches is kept, not convolved again."""
    seen, rows = segment(12, 1, 400), list[int]()

    def counted(x: Float64[np.ndarray, "n c"]) -> Float64[np.ndarray, "n c"]:
        rows.append(len(x))
        return gelu(x)

    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    stream = model.frozen().stream(np.zeros(6))
    monkeypatch.setattr("imutool.bias.conv.gelu", counted)
    for k in range(400):
        stream(t[k : k + 1], gyro[k : k + 1], accel[k : k + 1])
    assert rows == [1] * (400 * len(SENSORS) * len(model.config.channels))


def test_its_file_is_small_and_gives_the_same_answer(model: Network, segment: MakeSegment, tmp_path: Path) -> None:
    save(model.frozen(), tmp_path / "m.safetensors")
    assert (tmp_path / "m.safetensors").stat().st_size < WORTH_SHIPPING
    back, seen = load(tmp_path / "m.safetensors"), segment(13, 1, 800)
    t, gyro, accel, rest = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel, seen.rest))
    np.testing.assert_allclose(back.stream(rest)(t, gyro, accel), model(seen)[0].numpy(), rtol=0, atol=1e-5)  # seven digits


def test_sizes_can_be_chosen_and_must_fit_each_other(segment: MakeSegment) -> None:
    small = Network(Config(channels=(4, 8), dilations=(1, 3), kernel=3)).double().eval()
    assert small.context == 2 * 4
    assert small(segment(14, 1, 20)).shape == (1, 20, 6)
    with pytest.raises(ConfigError, match=r"model.channels: 3 channels and 4 dilations; expected one of each per layer"):
        Network(Config(channels=(4, 8, 16)))
