"""What every file of imutool/bias must hold; a new one is tested by being there."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import save_file

from imutool import registry
from imutool.bias import model_file
from imutool.bias.log_binding import at_rate
from imutool.bias.model import BiasModel
from imutool.bias.model_file import MAX_BYTES, find_model, header_of, load, save
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.errors import ConfigError, ModelError
from imutool.units import SENSORS

MakeSegment = Callable[..., Segment]
RATE_HZ = 200.0
METHODS = registry.names("imutool.bias")
STREAM = 1e-6  # rad/s and m/s²: the contract's own figure, a thousandth of what one sample's noise is
BLOCKS = 1e-12  # block borders and batch sizes may only change the order of sums
ADDITIVE = 0.05  # of a change of the rest bias may have been forgotten or amplified after five seconds
"""For a start to be solved for with any model, its error must still be there at the end of the seconds it is measured over."""


@pytest.fixture(params=METHODS, scope="module")
def network(request: pytest.FixtureRequest, build: Callable[..., BiasNetwork]) -> BiasNetwork:
    return build(request.param)


@pytest.fixture(scope="module")
def model(network: BiasNetwork) -> BiasModel:
    return network.frozen()


def streamed(model: BiasModel, seen: Segment, cuts: list[int]) -> np.ndarray:
    """The stream's answer over the first element of a batch, fed in blocks that end at the cuts."""
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    stream = model.stream(seen.rest[0].numpy())
    edges = [0, *cuts, len(t)]
    return np.concatenate([stream(t[a:b], gyro[a:b], accel[a:b]) for a, b in pairwise(edges)])


def test_its_name_is_its_files_and_its_docstring_names_a_source(network: BiasNetwork, model: BiasModel) -> None:
    module = registry.load("imutool.bias", model.method)
    assert registry.names("imutool.networks") == METHODS
    assert type(network) is registry.load("imutool.networks", model.method).Network
    assert model.method == network.method
    assert model.method in METHODS
    assert type(model) is module.Model
    assert isinstance(model.config, module.Config)
    assert registry.summary("imutool.bias", model.method).endswith(".")


@pytest.mark.parametrize(("batch", "n"), [(1, 1), (3, 2), (2, 137)])
def test_one_bias_of_six_for_every_sample(network: BiasNetwork, batch: int, n: int, segment: MakeSegment) -> None:
    seen = segment(1, batch, n)
    bias = network(seen)
    assert bias.shape == (batch, n, 6)
    assert bias.dtype == torch.float64
    assert torch.isfinite(bias).all()
    for sensor, part in zip(SENSORS, (bias[..., :3], bias[..., 3:]), strict=True):
        assert torch.equal(network.sensor_bias(sensor, seen), part)


def test_elements_of_a_batch_do_not_see_one_another(network: BiasNetwork, segment: MakeSegment) -> None:
    seen = segment(2, 3, 120)
    alone = Segment(seen.t[1:2], seen.gyro[1:2], seen.accel[1:2], seen.rest[1:2])
    torch.testing.assert_close(network(seen)[1:2], network(alone), rtol=0, atol=1e-12)  # batched sums round differently


@pytest.mark.parametrize("k", [0, 1, 49, 50, 51, 130, 198])
def test_it_is_causal(network: BiasNetwork, k: int, segment: MakeSegment) -> None:
    """Sample k + 1 and all after it change; the bias at samples up to k does not."""
    seen = segment(3, 2, 200)
    later = torch.randn(2, 199 - k, 3, generator=torch.Generator().manual_seed(k), dtype=torch.float64)
    gyro, accel = seen.gyro.clone(), seen.accel.clone()
    gyro[:, k + 1 :] += later
    accel[:, k + 1 :] += later
    moved = network(replace(seen, gyro=gyro, accel=accel))
    torch.testing.assert_close(moved[:, : k + 1], network(seen)[:, : k + 1], rtol=0, atol=1e-13)


def test_its_derivative_is_causal_too(network: BiasNetwork, segment: MakeSegment) -> None:
    seen = segment(4, 1, 180)
    gyro = seen.gyro.clone().requires_grad_(True)
    bias = network(replace(seen, gyro=gyro))
    if not bias.requires_grad:
        return  # a bias that does not look at the samples
    for k in (0, 60, 120):
        (slope,) = torch.autograd.grad(bias[0, k].sum(), gyro, retain_graph=True, allow_unused=True)
        assert slope is None or not slope[0, k + 1 :].any()


def test_a_change_of_the_rest_bias_is_a_change_of_the_bias(network: BiasNetwork, segment: MakeSegment) -> None:
    seen = segment(5, 4, 1000)
    change = torch.tensor([0.01, -0.02, 0.005, 0.1, -0.05, 0.02], dtype=torch.float64)
    moved = network(replace(seen, rest=seen.rest + change)) - network(seen)
    torch.testing.assert_close(moved[:, 0], change.expand(4, 6), rtol=0, atol=1e-15)
    assert ((moved - change).abs() <= ADDITIVE * change.abs()).all()


def test_the_first_bias_is_the_rest_bias_and_what_the_motion_adds(network: BiasNetwork, segment: MakeSegment) -> None:
    """With no motion at all (no rate, no force) nothing is added."""
    seen = segment(6, 2, 1)
    still = Segment(seen.t, torch.zeros_like(seen.gyro), torch.zeros_like(seen.accel), seen.rest)
    torch.testing.assert_close(network(still)[:, 0], seen.rest, rtol=0, atol=BLOCKS)


def test_the_stream_is_the_forward_pass(network: BiasNetwork, model: BiasModel, segment: MakeSegment) -> None:
    seen = segment(7, 1, 1000)
    np.testing.assert_allclose(streamed(model, seen, []), network(seen)[0].numpy(), rtol=0, atol=STREAM)


@given(cuts=st.lists(st.integers(0, 400), max_size=12).map(sorted))
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_streams_block_borders_change_nothing(model: BiasModel, cuts: list[int], segment: MakeSegment) -> None:
    seen = segment(8, 1, 400)
    np.testing.assert_allclose(streamed(model, seen, cuts), streamed(model, seen, []), rtol=0, atol=BLOCKS)


def test_the_stream_one_sample_at_a_time(model: BiasModel, segment: MakeSegment) -> None:
    seen = segment(9, 1, 300)
    one_by_one = streamed(model, seen, list(range(1, 300)))
    np.testing.assert_allclose(one_by_one, streamed(model, seen, []), rtol=0, atol=BLOCKS)


def test_the_stream_does_not_touch_what_it_is_given_and_two_streams_are_apart(model: BiasModel, segment: MakeSegment) -> None:
    seen = segment(10, 1, 120)
    t, gyro, accel, rest = (value[0].numpy().copy() for value in (seen.t, seen.gyro, seen.accel, seen.rest))
    for value in (t, gyro, accel, rest):
        value.flags.writeable = False
    first, second = model.stream(rest), model.stream(rest)
    half = first(t[:60], gyro[:60], accel[:60])
    kept = half.copy()
    second(t, gyro, accel)
    half += 1.0  # what came back belongs to the caller
    rest_of_it = first(t[60:], gyro[60:], accel[60:])
    expected = model.stream(rest)(t, gyro, accel)
    np.testing.assert_allclose(np.concatenate([kept, rest_of_it]), expected, rtol=0, atol=BLOCKS)


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda stream: pickle.loads(pickle.dumps(stream))], ids=["copy", "pickle"]
)
def test_a_copied_stream_goes_on_as_the_stream_does(
    model: BiasModel, segment: MakeSegment, duplicate: Callable[[Any], Any]
) -> None:
    """A copy of an array and of a view into it no longer share memory: the state of the filters stood still."""
    seen = segment(12, 1, 400)
    t, gyro, accel = (value[0].numpy() for value in (seen.t, seen.gyro, seen.accel))
    stream = model.stream(seen.rest[0].numpy())
    for k in range(0, 200):
        stream.one(float(t[k]), np.concatenate([gyro[k], accel[k]]))
    other = duplicate(stream)
    for k in range(200, 400):
        u = np.concatenate([gyro[k], accel[k]])
        np.testing.assert_array_equal(other.one(float(t[k]), u), stream.one(float(t[k]), u))


def test_a_model_goes_to_another_process(model: BiasModel, segment: MakeSegment) -> None:
    seen = segment(13, 1, 200)
    back = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(streamed(back, seen, [70]), streamed(model, seen, [70]))


# ── at rest, in a file ───────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def saved(model: BiasModel, tmp_path: Path) -> Path:
    path = tmp_path / f"{model.method}.safetensors"
    save(model, path)
    return path


def altered(
    path: Path,
    tensors: Callable[[dict[str, torch.Tensor]], object] = lambda tensors: None,
    **header: str | None,
) -> Path:
    """A copy of a model file with something else in it; a header entry set to None is left out."""
    with safe_open(path, framework="pt") as file:
        about = file.metadata() | header
        held = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  not a dict
    tensors(held)
    out = path.with_name("altered.safetensors")
    save_file(held, out, metadata={k: v for k, v in about.items() if v is not None})
    return out


def test_it_comes_back_from_its_file_in_single_precision(model: BiasModel, saved: Path, segment: MakeSegment) -> None:
    back = load(saved)
    assert type(back) is type(model)
    assert (back.rate_hz, back.config) == (model.rate_hz, model.config)
    assert back.tensors.keys() == model.tensors.keys() == model.shapes(model.config).keys()
    for name, value in model.tensors.items():
        kept = back.tensors[name]
        assert kept.dtype == np.float64
        assert np.array_equal(kept, value.astype(np.float32).astype(np.float64)), name
    assert (back.card["name"], back.card["sha256"]) == (model.method, model_file.digest(saved))
    assert find_model(saved.as_uri()).card == back.card
    seen = segment(11, 2, 300)
    np.testing.assert_allclose(streamed(back, seen, []), streamed(model, seen, []), rtol=1e-5, atol=1e-6)  # seven digits


def test_the_file_is_single_precision_and_says_what_it_is(model: BiasModel, saved: Path) -> None:
    with safe_open(saved, framework="pt") as file:
        assert {file.get_tensor(name).dtype for name in file.keys()} == {torch.float32}  # noqa: SIM118
    about = header_of(saved)
    assert (about["method"], about["rate_hz"]) == (model.method, RATE_HZ)


def test_its_card_comes_back(model: BiasModel, tmp_path: Path) -> None:
    model.card = {"sensor": "adis16448", "training": {"steps": 3, "seed": 0}, "held_out": [1.5, None]}
    try:
        save(model, tmp_path / "a.safetensors")
    finally:
        card, model.card = model.card, {}
    back = load(tmp_path / "a.safetensors").card
    assert {k: back[k] for k in card} == card
    assert set(back) == {*card, "name", "sha256"}


def test_an_existing_file_is_kept_unless_told_otherwise(model: BiasModel, saved: Path) -> None:
    before = saved.read_bytes()
    with pytest.raises(ConfigError, match="exists"):
        save(model, saved)
    assert saved.read_bytes() == before
    save(model, saved, overwrite=True)
    assert sorted(path.name for path in saved.parent.iterdir()) == [saved.name]


def test_a_place_that_cannot_be_written_is_said_and_nothing_is_left(model: BiasModel, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        save(model, tmp_path / "no such folder" / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_a_file_cut_short_anywhere_is_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for length in (0, 4, 8, 100, len(whole) // 2, len(whole) - 1):
        saved.write_bytes(whole[:length])
        with pytest.raises(ModelError, match="is not a model file"):
            load(saved)


def test_a_file_with_something_after_its_end_is_refused(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes() + b"\0")
    with pytest.raises(ModelError, match="is not a model file"):
        load(saved)


def test_another_format_is_refused_with_both_names(saved: Path) -> None:
    with pytest.raises(ModelError, match=r"format 'imutool.model/2'; expected 'imutool.model/1'.*Train it again"):
        load(altered(saved, format="imutool.model/2"))
    with pytest.raises(ModelError, match="format None"):
        load(altered(saved, format=None))


def test_an_unknown_method_is_refused_with_the_nearest(saved: Path) -> None:
    with pytest.raises(ModelError, match=r"'lineal' is not known.*Did you mean 'linear'"):
        load(altered(saved, method="lineal"))


def test_tensors_that_do_not_fit_are_named(model: BiasModel, saved: Path) -> None:
    changes: dict[str, Callable[[dict[str, torch.Tensor]], object]] = {
        "prior_mean": lambda held: held.update(prior_mean=torch.zeros(7)),
        "truth_std": lambda held: held.pop("truth_std"),
        "stowaway": lambda held: held.update(stowaway=torch.zeros(1)),
        "noise_std": lambda held: held.update(noise_std=torch.zeros(6, dtype=torch.float64)),
    }
    for name, value in model.tensors.items():
        changes[name] = lambda held, name=name, shape=value.shape: held.update({name: torch.zeros(*shape, 2)})  # type: ignore[misc]
    for name, change in changes.items():
        with pytest.raises(ModelError, match=f"tensors {name} do not fit"):
            load(altered(saved, change))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused(model: BiasModel, saved: Path, value: float) -> None:
    for name in (name for name, held in model.tensors.items() if held.size):
        with pytest.raises(ModelError, match="not finite"):
            load(altered(saved, lambda held, name=name: held[name].view(-1)[-1:].fill_(value)))  # type: ignore[misc]


@pytest.mark.parametrize(
    "header",
    [
        {"method": None},
        {"rate_hz": None},
        {"rate_hz": "fast"},
        {"rate_hz": "nan"},
        {"rate_hz": "inf"},
        {"rate_hz": "-200.0"},
        {"rate_hz": "1e308"},
        {"settings": "{"},
        {"settings": "[]"},
        {"settings": "null"},
        {"settings": '{"widht": 3}'},
        {"settings": "[" * 100_000},
        {"card": "[1]"},
        {"card": "null"},
        {"card": None},
        {"card": "{"},
        {"card": '{"sessions": "sessions"}'},
        {"card": '{"sessions": [{"start_ns": 0, "end_ns": 1, "mean": [0, 0, 0, 0, 0, 0], "std": [-1, 0, 0, 0, 0, 0]}]}'},
        {"card": '{"turn_on_least_std": "NaN"}'},
        {"card": '{"turn_on_least_std": [NaN, 0, 0, 0, 0, 0]}'},
        {"card": '{"speed": {"speed_m_s": 0, "speed_correlation_s": 1}}'},
        {"card": '{"turn_error": 2}'},
    ],
    ids=lambda header: "-".join(f"{k}={str(v)[:20]}" for k, v in header.items()),
)
def test_a_header_that_makes_no_sense_is_refused(saved: Path, header: dict[str, str | None]) -> None:
    path = altered(saved, **header)
    with pytest.raises(ModelError, match="has an invalid header"):
        load(path)


@pytest.mark.parametrize("header", [{"method": None}, {"rate_hz": "fast"}, {"card": "[1]"}, {"card": None}])
def test_a_header_that_makes_no_sense_is_refused_when_only_listed(saved: Path, header: dict[str, str | None]) -> None:
    with pytest.raises(ModelError, match="has an invalid header"):
        header_of(altered(saved, **header))


def test_a_text_file_a_folder_and_nothing_are_refused(tmp_path: Path) -> None:
    text, folder = tmp_path / "text.safetensors", tmp_path / "folder.safetensors"
    text.write_text("a model, honestly\n" * 100)
    folder.mkdir()
    for path in (text, folder):
        with pytest.raises(ModelError, match="is not a model file"):
            load(path)
    with pytest.raises(ModelError, match=r"cannot be read \(No such file or directory\)"):
        load(tmp_path / "nothing.safetensors")


def test_a_file_too_large_for_a_model_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "large.safetensors"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)  # a hole: it takes no room on the disk
    with pytest.raises(ModelError, match=f"{MAX_BYTES + 1} bytes; expected a model of at most {MAX_BYTES}"):
        load(path)


class Bomb:
    """What unpickling would call."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def test_a_pickle_is_refused_without_being_executed(tmp_path: Path) -> None:
    mark = tmp_path / "executed"
    plain, zipped = tmp_path / "plain.safetensors", tmp_path / "zipped.safetensors"
    plain.write_bytes(pickle.dumps(Bomb(mark)))
    torch.save({"weights": Bomb(mark)}, zipped)
    pickle.loads(plain.read_bytes())
    assert mark.exists(), "the bomb must be a live one for this test to mean anything"
    mark.unlink()
    for path in (plain, zipped):
        with pytest.raises(ModelError, match="is not a model file"):
            load(path)
        with pytest.raises(ModelError, match="is not a model file"):
            find_model(path)
    assert not mark.exists()


def test_a_header_cannot_name_a_module_outside_the_models(saved: Path) -> None:
    for method in ("_file", "_base", "os", "..config", "imutool.config"):
        with pytest.raises(ModelError, match="is not known"):
            load(altered(saved, method=method))


# ── finding and refusing ─────────────────────────────────────────────────────────────────────────────────────────────


def test_models_that_ship_are_found_by_name(saved: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(model_file, "library", lambda: saved.parent)
    monkeypatch.chdir("/")
    assert find_model(saved.stem).card["sha256"] == model_file.digest(saved)
    assert find_model(saved).card["name"] == saved.stem
    with pytest.raises(ModelError, match=f"no model '{saved.stem}x'.*Did you mean '{saved.stem}'"):
        find_model(f"{saved.stem}x")


def test_another_rate_is_refused_and_a_nearly_equal_one_is_not(model: BiasModel) -> None:
    for rate_hz in (RATE_HZ, 0.996 * RATE_HZ, 1.049 * RATE_HZ, 0.951 * RATE_HZ):
        assert at_rate(model, rate_hz, "log.mcap") is model
    for rate_hz in (100.0, 400.0, 1.051 * RATE_HZ, 0.949 * RATE_HZ):
        with pytest.raises(ModelError, match=rf"log.mcap: IMU at {rate_hz:.1f} Hz; expected 200.0 Hz"):
            at_rate(model, rate_hz, "log.mcap")


@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 1000.0])
def test_a_model_that_counts_in_seconds_goes_at_another_rate_by_force(
    network: BiasNetwork, model: BiasModel, rate_hz: float, segment: MakeSegment
) -> None:
    if model.counts_samples or rate_hz > 4.5 * RATE_HZ:
        with pytest.raises(ModelError, match="Choose or train"):
            at_rate(model, rate_hz, "log.mcap", force=True)
        return
    found = at_rate(model, rate_hz, "log.mcap", force=True)
    assert (found.rate_hz, model.rate_hz) == (rate_hz, RATE_HZ)
    assert found.remarks == (f"samples at {rate_hz:.2f} Hz, in the training logs at 200.00 Hz",)
    slow = type(network)(network.config, rate_hz).double()  # the same weights, made for that rate
    slow.load_state_dict(network.state_dict())
    seen = segment(5, 1, 200)
    np.testing.assert_array_equal(streamed(found, seen, [70]), streamed(slow.frozen(), seen, [70]))


def test_stamps_in_batches_are_named_and_not_another_sensor(model: BiasModel) -> None:
    number = np.arange(400)
    t_ns = number // 4 * 20_000_000 + number % 4 * 150_000  # four samples at once, every 20 ms
    with pytest.raises(ModelError, match=r"IMU at 6666.7 Hz by most of its steps, and 20\d.\d Hz in the mean.* --restamp"):
        at_rate(model, 1e9 / 150_000, "log.mcap", t_ns, force=True)
    with pytest.raises(ModelError, match="Choose or train a model for this sensor"):
        at_rate(model, 1e9 / 150_000, "log.mcap", 150_000 * number)


def test_the_settings_in_a_header_are_json(saved: Path) -> None:
    with safe_open(saved, framework="pt") as file:
        header = file.metadata()
    assert isinstance(json.loads(header["settings"]), dict)
