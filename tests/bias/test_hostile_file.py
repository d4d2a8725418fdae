"""Model files that mean harm: refused with an error of ours, before their numbers are looked at and without their memory."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imutool.bias import linear
from imutool.bias.model_file import MAX_SETTINGS, find_model, header_of, library, load, save
from imutool.bias_start.initial_bias import training_source
from imutool.errors import ModelError

MEMORY_BOUND = 200 << 20  # of address space beyond what is used; the models asked for here would take gigabytes


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save(linear.Model(linear.Config(), 200.0), tmp_path / "linear.safetensors")
    return tmp_path / "linear.safetensors"


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    raw = path.read_bytes()
    size = int.from_bytes(raw[:8], "little")
    return json.loads(raw[8 : 8 + size]), raw[8 + size :]


def written(path: Path, header: object, data: bytes, length: int | None = None) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes((len(text) if length is None else length).to_bytes(8, "little") + text + data)
    return path


def first(header: dict[str, Any]) -> dict[str, Any]:
    """The entry of one tensor."""
    return next(entry for name, entry in header.items() if name != "__metadata__")


ENTRIES: dict[str, dict[str, Any]] = {
    "offsets beyond the end": {"data_offsets": [0, 2**40]},
    "offsets that go back": {"data_offsets": [8, 0]},
    "offsets below zero": {"data_offsets": [-8, 0]},
    "a shape beyond its bytes": {"shape": [2**20, 2**20]},
    "a shape that overflows": {"shape": [2**32, 2**32, 2**32]},
    "a shape below zero": {"shape": [-1]},
    "a shape that is no list": {"shape": "all"},
    "an unknown kind of number": {"dtype": "F1000"},
    "another kind of number": {"dtype": "I32"},
    "no kind of number": {"dtype": None},
}


@pytest.mark.parametrize("what", ENTRIES)
def test_a_tensor_whose_entry_does_not_fit_is_refused(saved: Path, what: str) -> None:
    header, data = parts(saved)
    first(header).update(ENTRIES[what])
    with pytest.raises(ModelError):
        load(written(saved, header, data))


@pytest.mark.parametrize("length", [0, 1, 2**20, 2**31, 2**63, 2**64 - 1])
def test_a_header_that_is_as_long_as_it_likes_is_refused(saved: Path, length: int) -> None:
    header, data = parts(saved)
    for read in (load, header_of):
        with pytest.raises(ModelError):
            read(written(saved, header, data, length))


@pytest.mark.parametrize(
    "header", [b"", b"[]", b"{", b"null", b"\xff" * 64, b"[" * 100_000, b'{"a":' * 100_000], ids=lambda h: str(h[:8])
)
def test_a_header_that_is_none_is_refused(saved: Path, header: bytes) -> None:
    with pytest.raises(ModelError):
        load(written(saved, header, bytes(64)))


def test_tensors_that_lie_on_one_another_are_refused(saved: Path) -> None:
    header, data = parts(saved)
    header["twin"] = first(header)
    with pytest.raises(ModelError):
        load(written(saved, header, data))


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("neural_ode", {"curve_width": 4096}),
        ("neural_ode", {"curve_width": 10**15}),
        ("neural_ode", {"drift_step_s": 1e308}),
        ("conv", {"channels": [512] * 8, "dilations": [1024] * 8, "kernel": 16}),
        ("conv", {"channels": [512] * 100_000}),
        ("linear", {"nonsense": "x" * (MAX_SETTINGS + 1)}),
    ],
    ids=str,
)
def test_settings_that_ask_for_a_giant_are_refused_without_its_memory(
    saved: Path, method: str, settings: dict[str, Any]
) -> None:
    header, data = parts(saved)
    header["__metadata__"] |= {"method": method, "settings": json.dumps(settings)}
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    path = written(saved, header, data)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BOUND, before[1]))
    try:
        with pytest.raises(ModelError):
            load(path)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize("name", ["model.safetensors", "physics.toml"])
def test_a_pipe_is_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(ModelError, match="a folder, a pipe or a device"):
        find_model(tmp_path / name, 200.0)


def test_a_physics_file_beyond_all_sense_is_refused_unread(tmp_path: Path) -> None:
    with (tmp_path / "physics.toml").open("wb") as file:
        file.truncate(10 << 30)  # a hole: it takes no room on the disk
    with pytest.raises(ModelError, match="10737418240 bytes"):
        find_model(tmp_path / "physics.toml", 200.0)


@pytest.mark.parametrize("weight", [1e30, -3e38, 2e6])
def test_weights_that_no_training_gives_are_refused(saved: Path, weight: float) -> None:
    header, data = parts(saved)
    with pytest.raises(ModelError, match="holds numbers that no training gives"):
        load(written(saved, header, np.full(len(data) // 4, weight, np.float32).tobytes()))


@pytest.mark.parametrize(
    ("method", "tensor", "value"),
    [("conv", "net.gyro.scale", 0.0), ("neural_ode", "drift.gyro.units", 1e-45), ("conv", "net.gyro.layers.0.var", -1.0)],
)
def test_inputs_are_divided_by_no_zero(tmp_path: Path, method: str, tensor: str, value: float) -> None:
    header, data = parts(library() / f"euroc-adis16448-{method}.safetensors")
    start, end = header[tensor]["data_offsets"]
    weights = np.full((end - start) // 4, value, np.float32).tobytes()
    with pytest.raises(ModelError, match="holds scales that no training gives"):
        load(written(tmp_path / "m.safetensors", header, data[:start] + weights + data[end:]))


@pytest.mark.parametrize("name", ["conv", "hybrid", "neural_ode"])
def test_a_network_without_a_rate_is_refused(name: str, tmp_path: Path) -> None:
    raw = next(path for path in sorted(library().glob("*.safetensors")) if header_of(path)["method"] == "hybrid")
    header, data = parts(raw)
    header["__metadata__"] |= {"rate_hz": "0.0", "method": name}
    with pytest.raises(ModelError, match=r"invalid header \(rate_hz 0\.0\)"):
        load(written(tmp_path / "m.safetensors", header, data))


@pytest.mark.parametrize("logs", [1e308, True, None, "x", {}])
def test_logs_of_a_card_that_are_no_list_are_not_counted(saved: Path, logs: object) -> None:
    model = load(saved)
    model.card = {**model.card, "logs": logs}
    assert training_source(model) == "prior of the training logs"
