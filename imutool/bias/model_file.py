"""Model files: safetensors with a JSON header; sizes and shapes are checked, no code runs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as save_bytes

from imutool import registry
from imutool.bias.model import BiasModel, check_card
from imutool.config import build, plain
from imutool.errors import ImutoolError, ModelError, did_you_mean
from imutool.file_location import local
from imutool.mcap_io.storage.target import Target

FORMAT = "imutool.model/1"
MAX_BYTES = 64 << 20  # the shipped models are under 2 MB
MAX_RATE_HZ = 1e6
MAX_WEIGHT = 1e6  # the largest of the shipped models is 10
MIN_SCALE = 1e-9  # of an input that a network divides by
MAX_TOML = 1 << 20  # bytes of a physics.toml; usual files have a few thousand
MAX_SETTINGS = 16 << 10  # characters; usual settings have a few hundred
WITH_RATE = ("conv", "hybrid", "neural_ode")  # their filters need it
BEST_FIRST = ("hybrid", "neural_ode", "linear", "conv")  # by published results and docs/accuracy.md
_OF_FETCH = r"0[1-8]_(square|um|eight|random|right_turn|left_turn|origin)"
UNITS = {  # sensor and data set of the shipped models: the names of the sequences that this one unit recorded
    ("adis16448", "euroc"): r"(MH_0[1-5]|V[12]_0[1-3])(_(easy|medium|difficult))?",
    ("bmi160", "tum_vi"): r"(room|corridor|magistrale|outdoors|slides|calib-cam|calib-imu)[1-9]?",
    ("fetch", "fetch"): _OF_FETCH,
    ("fetch, axes corrected", "fetch"): _OF_FETCH,  # as `convert --fix` writes its logs: the gyro's y reversed
}


def save(model: BiasModel, path: Path, *, overwrite: bool = False) -> None:
    """Write a model and its card to a file, whole or not at all.

    Raises:
        ConfigError: the target exists, or cannot be written.
    """
    header = {
        "format": FORMAT,
        "method": model.method,
        "rate_hz": repr(model.rate_hz),
        "settings": json.dumps(plain(model.config)),
        "card": json.dumps(dict(model.card)),
    }
    weights = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in model.tensors.items()}
    write_tensors(weights, header, path, overwrite)


def write_tensors(tensors: Mapping[str, np.ndarray], header: Mapping[str, str], path: Path, overwrite: bool) -> None:
    """Write tensors and a header of strings to a temporary file, then rename it.

    Raises:
        ConfigError: the target exists, or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        target.write(_in_order(save_bytes(dict(tensors), metadata=dict(header))))


def _in_order(raw: bytes) -> bytes:
    """Sort the header of a safetensors file: the library's order is random, and equal models get equal files."""
    size = int.from_bytes(raw[:8], "little")
    header = json.dumps(json.loads(raw[8 : 8 + size]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # the format's alignment
    return len(header).to_bytes(8, "little") + header + raw[8 + size :]


def read_tensors(path: Path, kind: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Tensors and header of a file of format `kind`.

    Raises:
        ModelError: no such file, too large, not safetensors, or of another format.
    """
    try:
        _refuse_size(path, MAX_BYTES)
        with path.open("rb"), safe_open(path, framework="np") as file:  # safe_open takes a locked file for a missing one
            header = file.metadata() or {}
            if header.get("format") != kind:
                raise ModelError(
                    f"format {header.get('format')!r}",
                    where=path,
                    expected=f"{kind!r}",
                    fix="Train it again with this version of imutool",
                )
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118  not a dict
    except OSError as error:
        raise ModelError(
            f"cannot be read ({error.strerror or error})", where=path, expected="safetensors by imutool train"
        ) from error
    except (SafetensorError, TypeError, AttributeError) as error:  # numpy knows fewer kinds of numbers than the format
        raise ModelError(f"is not a model file ({error})", where=path, expected="safetensors by imutool train") from error


def _refuse_size(path: Path, maximum: int) -> None:
    """Refuse a path that is not a regular file, or is larger than `maximum` bytes; reading a pipe would block."""
    size = path.stat().st_size
    if not path.is_file():
        raise ModelError(
            "is not a model file (it is a folder, a pipe or a device)", where=path, expected="safetensors by imutool train"
        )
    if size > maximum:
        raise ModelError(f"{size} bytes", where=path, expected=f"a model of at most {maximum}")


def load(path: Path) -> BiasModel:
    """Model from a file.

    Raises:
        ModelError: damaged, of another version or unknown method, or with tensors that do not fit its settings.
    """
    tensors, raw = read_tensors(path, FORMAT)
    header = _header(raw, path)
    try:
        kind: type[BiasModel] = registry.load("imutool.bias", header.method).Model
        settings = build(registry.load("imutool.bias", header.method).Config, header.settings)
        expected = {name: (shape, np.dtype(np.float32)) for name, shape in kind.shapes(settings).items()}
    except (ValueError, OverflowError, ImutoolError) as error:
        raise ModelError(f"has an invalid header ({error})", where=path) from error
    layout = {name: (value.shape, value.dtype) for name, value in tensors.items()}
    if layout != expected:
        wrong = sorted(name for name in expected.keys() | layout.keys() if expected.get(name) != layout.get(name))
        raise ModelError(f"tensors {', '.join(wrong[:5])} do not fit", where=path, expected=f"those of {header.method}")
    if any(not np.isfinite(value).all() for value in tensors.values()):
        raise ModelError("holds numbers that are not finite", where=path)
    if any((np.abs(value) > MAX_WEIGHT).any() for value in tensors.values()):
        raise ModelError("holds numbers that no training gives", where=path, expected=f"at most {MAX_WEIGHT:g}")
    minimum = {".scale": MIN_SCALE, ".units": MIN_SCALE, ".var": 0.0}  # divisors
    if any((value < minimum.get(Path(name).suffix, -MAX_WEIGHT)).any() for name, value in tensors.items()):
        raise ModelError("holds scales that no training gives", where=path, expected=f"at least {MIN_SCALE:g}")
    model = kind(settings, header.rate_hz, tensors)
    model.card = {**header.card, "name": path.stem, "sha256": digest(path)}
    return model


def library() -> Path:
    """Folder of the shipped models: inside the installed package, or next to it in a checkout."""
    inside = Path(__file__).parents[1] / "_models"
    return inside if inside.is_dir() else Path(__file__).parents[2] / "models"


def find_model(name: str | Path, rate_hz: float | None = None) -> BiasModel:
    """Model from a file or a shipped model by name.

    The file may be a physics.toml, for samples at `rate_hz`.

    Raises:
        ModelError: neither (the message names the nearest); a physics.toml without `rate_hz`, or with no effect to correct.
        ConfigError: an unreadable physics.toml.
    """
    path = model_file(name)
    if path.suffix.lower() == ".toml":
        if rate_hz is None:
            raise ModelError("a physics.toml has no rate", where=path, expected="a trained model, or `rate_hz` in Python")
        from imutool.bias import physics

        with suppress(OSError):  # the reader reports it
            _refuse_size(path, MAX_TOML)
        return physics.load(path, rate_hz)
    return load(path)


def shared_model(name: str | Path, rate_hz: float) -> BiasModel:
    """As `find_model`, read again only if the file has changed, and not to be altered.

    To read and check a model takes a worker an eighth of its time for a log of 2 MB.
    """
    path = model_file(name)
    if path.suffix.lower() == ".toml" or not path.is_file():
        return find_model(path, rate_hz)
    status = path.stat()
    return _load_once(path.absolute(), status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=8)
def _load_once(path: Path, size: int, changed_ns: int) -> BiasModel:
    return load(path)


def model_file(name: str | Path) -> Path:
    """File of a model: the one of that name, or a shipped one.

    Raises:
        ModelError: neither.
        ConfigError: a URL of an object store.
    """
    if not isinstance(name, str | Path):
        raise ModelError(f"a model of type {type(name).__name__}", expected="a file, or the name of a model")
    path = local(name, "model")
    return path if path.suffix.lower() in (".toml", ".safetensors") or path.exists() else shipped(str(name))


def shipped(name: str, where: object = None) -> Path:
    """File of a shipped model by name only: a name from a log cannot reach other files.

    Raises:
        ModelError: no such model (the message names the nearest).
    """
    files = {model.stem: model for model in library().glob("*.safetensors")}
    if name not in files:
        raise ModelError(
            f"no model {name[:200]!r}",
            where=where,
            expected=f"a file, or one of {', '.join(sorted(files)) or '(none ship)'}",
            fix=did_you_mean(name, files, "{!r}"),
        )
    return files[name]


def shipped_for(about: Mapping[str, str]) -> list[str]:
    """Names of the shipped models for the very unit of a log, best method first.

    A calibration belongs to one unit of a sensor, not to its type: another ADIS16448 needs its own model. `about` is what
    the log says of its origin; the unit is known by sensor, data set, and the name of one of the data set's sequences.
    """
    names = UNITS.get((about.get("sensor", ""), about.get("dataset", "")))
    if names is None or not re.fullmatch(names, about.get("sequence", "")):
        return []
    found = {}
    for path in library().glob("*.safetensors"):
        card = header_of(path)
        if (card.get("sensor"), card.get("dataset")) == (about["sensor"], about["dataset"]):
            found[card["method"]] = path.stem
    return [found[method] for method in BEST_FIRST if method in found]


def digest(path: Path) -> str:
    """SHA-256 of a model file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def header_of(path: Path) -> dict[str, Any]:
    """Method, rate, settings and card of a model file, without building it.

    Raises:
        ModelError: as `read_tensors`, or an invalid header.
    """
    header = _header(read_tensors(path, FORMAT)[1], path)
    return {**header.card, "method": header.method, "rate_hz": header.rate_hz}


class _Header(NamedTuple):
    """Header of a model file."""

    method: str
    rate_hz: float
    settings: dict[str, Any]
    card: dict[str, Any]


def _header(raw: Mapping[str, str], path: Path) -> _Header:
    """Validated header of a model file from an unknown source."""
    try:
        if len(raw["settings"]) > MAX_SETTINGS:
            raise ValueError(f"{len(raw['settings'])} characters of settings, at most {MAX_SETTINGS}")
        rate_hz, settings, card = float(raw["rate_hz"]), json.loads(raw["settings"]), json.loads(raw["card"])
        if not 0.0 <= rate_hz <= MAX_RATE_HZ or (rate_hz == 0.0 and raw["method"] in WITH_RATE):
            raise ValueError(f"rate_hz {rate_hz}")
        if not isinstance(settings, dict) or not isinstance(card, dict):
            raise ValueError("settings and card are tables")
        check_card(card)
        return _Header(raw["method"], rate_hz, settings, card)
    except KeyError as error:
        raise ModelError(f"has an invalid header (no {error})", where=path) from error
    except (ValueError, RecursionError) as error:
        raise ModelError(f"has an invalid header ({error})", where=path) from error
