"""Envelope with the concealed truth of a blind case: a seal, not security.

The truth is JSON, padded to a multiple of 16 KiB so that its length reveals nothing, XORed with SHAKE-256 of a random key in a
file next to it. The commitment, a SHA-256 over a random salt, the truth and the logs, shows whether any of them was changed.
Whoever has the folder can open the envelope at once; nobody can change it unnoticed, nor read it by accident.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from imutool.errors import DataError
from imutool.report import Report, Section

SCHEMA = "imutool.envelope/1"
BLOCK = 16384
LARGEST = 1 << 24  # bytes of an envelope that anybody would read


class Marks(Section, frozen=True):
    """Marks of one sensor's misfit, by second and by axis: `#` clear, `?` doubtful, `.` nothing."""

    seconds: str
    axes: dict[str, str]
    localised: bool


class Location(Section, frozen=True):
    """Marks of the concealed misfit by sensor."""

    window_s: float
    gyro: Marks
    accel: Marks


class Rms(Section, frozen=True):
    """Root mean square residual with the misfit, and without it."""

    rms_before: float
    rms_after: float


class TrueParameter(Section, frozen=True):
    """True value of a parameter, its scale, and the least deviation of an estimate, if any."""

    value: float
    unit: str
    scale: float
    smallest_std: float | None
    identifiable: bool


class ConcealedEffect(Section, frozen=True):
    """Effect of a blind case; `factor` is its size over the plausible one."""

    effect: str
    signal: str
    driver: str
    equation: str
    factor: float
    parameters: dict[str, TrueParameter]


class ConcealedTruth(Report, frozen=True, kw_only=True, omit_defaults=True, tag="imutool.sealed_truth/1"):
    """Truth of a blind case; `generator` names another program that made it."""

    seed: int
    trajectory: str
    noise: str
    kind: str
    size: str
    effects: tuple[ConcealedEffect, ...]
    came_to: dict[str, float]
    bias: dict[str, tuple[float, ...]]
    noise_std: dict[str, tuple[float, ...]]
    duration_s: float
    place: Location
    achievable: dict[str, Rms]
    generator: str = ""


class Envelope(Report, frozen=True, tag=SCHEMA):
    """Sealed truth with its salt, its commitment and the digests of the logs."""

    salt: str
    commitment: str
    logs: dict[str, str]
    sealed: str


def seal(truth: ConcealedTruth, logs: Mapping[str, Path]) -> tuple[Envelope, str]:
    """Envelope with a truth, and its key in hexadecimal digits."""
    text = json.dumps(msgspec.to_builtins(truth), sort_keys=True, allow_nan=False).encode()
    text += b" " * (-len(text) % BLOCK)
    key, salt = secrets.token_bytes(32), secrets.token_bytes(32)
    digests = {name: digest(path) for name, path in sorted(logs.items())}
    sealed = base64.b64encode(_xor(text, key)).decode()
    return Envelope(salt.hex(), _commitment(salt, text, digests), digests, sealed), key.hex()


def unseal(envelope: Path, key: Path) -> ConcealedTruth:
    """Truth in an envelope.

    Raises:
        DataError: no envelope or key, one of another case, or anything in it or in the logs was changed.
    """
    content = read_json(envelope)
    if content.get("schema") != SCHEMA:
        raise DataError(f"schema {content.get('schema')!r}", where=envelope, expected=SCHEMA)
    try:
        contents = msgspec.convert(content, Envelope)
        secret = bytes.fromhex(_text(key).strip())
        salt, hidden = bytes.fromhex(contents.salt), base64.b64decode(contents.sealed, validate=True)
    except (msgspec.ValidationError, ValueError, binascii.Error) as error:
        raise DataError(f"the envelope is damaged ({error})", where=envelope, expected="one that conceal wrote") from error
    text = _xor(hidden, secret)
    if not secrets.compare_digest(_commitment(salt, text, contents.logs), contents.commitment):
        raise DataError(
            "the envelope was changed, or the key belongs to another one", where=envelope, expected="its commitment"
        )
    for name, value in contents.logs.items():
        if digest(envelope.parent / Path(name).name) != value:
            raise DataError(
                "the log was changed since it was sealed", where=envelope.parent / name, expected=f"SHA-256 {value}"
            )
    return to_truth(json.loads(text), envelope)


def to_truth(values: Mapping[str, Any], where: Path) -> ConcealedTruth:
    """Truth from JSON values.

    Raises:
        DataError: a field is missing or of another type.
    """
    try:
        return msgspec.convert(values, ConcealedTruth)
    except msgspec.ValidationError as error:
        raise DataError(f"the truth cannot be read ({error})", where=where, expected="a case of this version") from error


def read_json(path: Path) -> dict[str, Any]:
    """JSON object in a file.

    Raises:
        DataError: no such file, too large, or no JSON object.
    """
    try:
        value = json.loads(_text(path))
    except ValueError as error:
        raise DataError(f"no JSON ({error})", where=path, expected="a JSON object") from error
    if not isinstance(value, dict):
        raise DataError(f"a JSON {type(value).__name__}", where=path, expected="a JSON object")
    return value


def digest(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})", where=path, expected="a file of the blind case") from error


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST:
            raise DataError(f"{path.stat().st_size} bytes", where=path, expected=f"at most {LARGEST}")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"cannot be read ({why})", where=path, expected="a file of the blind case") from error


def _xor(data: bytes, key: bytes) -> bytes:
    stream = hashlib.shake_256(key).digest(len(data))
    return (int.from_bytes(data, "big") ^ int.from_bytes(stream, "big")).to_bytes(len(data), "big")


def _commitment(salt: bytes, text: bytes, digests: Mapping[str, str]) -> str:
    logs = json.dumps(dict(sorted(digests.items()))).encode()
    return hashlib.sha256(salt + hashlib.sha256(text).digest() + hashlib.sha256(logs).digest()).hexdigest()
