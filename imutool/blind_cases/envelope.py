"""An envelope that holds the truth of a case until it is opened: a seal, not security.

The truth is JSON, padded to a multiple of 16 KiB so that its length says nothing, XORed with SHAKE-256 of a random key that
lies in a file beside it. The commitment, a SHA-256 over a random salt, the truth and the logs, shows whether any of them was
changed. Whoever has the folder can open the envelope at once; nobody can change it unnoticed, nor read it by accident.
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

from imutool.errors import DataError

SCHEMA = "imutool.envelope/1"
BLOCK = 16384
LARGEST = 1 << 24  # bytes of an envelope that anybody would read


def sealed(truth: Mapping[str, Any], logs: Mapping[str, Path]) -> tuple[dict[str, Any], str]:
    """The envelope (as plain JSON values) and its key in hexadecimal digits."""
    text = json.dumps(truth, sort_keys=True, allow_nan=False).encode()
    text += b" " * (-len(text) % BLOCK)
    key, salt = secrets.token_bytes(32), secrets.token_bytes(32)
    digests = {name: digest(path) for name, path in sorted(logs.items())}
    envelope = {
        "schema": SCHEMA,
        "salt": salt.hex(),
        "commitment": _commitment(salt, text, digests),
        "logs": digests,
        "sealed": base64.b64encode(_veil(text, key)).decode(),
    }
    return envelope, key.hex()


def unsealed(envelope: Path, key: Path) -> dict[str, Any]:
    """The truth in an envelope.

    Raises:
        DataError: no envelope or key, one of another case, or anything in it or in the logs was changed.
    """
    held = read_json(envelope)
    if held.get("schema") != SCHEMA:
        raise DataError(f"schema {held.get('schema')!r}", where=envelope, expected=SCHEMA)
    try:
        secret = bytes.fromhex(_text(key).strip())
        salt, hidden = bytes.fromhex(held["salt"]), base64.b64decode(held["sealed"], validate=True)
        digests = {str(name): str(value) for name, value in held["logs"].items()}
    except (KeyError, AttributeError, TypeError, ValueError, binascii.Error) as error:
        raise DataError(f"the envelope is damaged ({error})", where=envelope, expected="one that conceal wrote") from error
    text = _veil(hidden, secret)
    if not secrets.compare_digest(_commitment(salt, text, digests), str(held.get("commitment"))):
        raise DataError("the envelope was changed, or the key is another's", where=envelope, expected="its commitment")
    for name, value in digests.items():
        if digest(envelope.parent / Path(name).name) != value:
            raise DataError(
                "the log was changed since it was sealed", where=envelope.parent / name, expected=f"SHA-256 {value}"
            )
    truth: dict[str, Any] = json.loads(text)
    return truth


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

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
        raise DataError(f"cannot be read ({error.strerror})", where=path, expected="a file of the sealed case") from error


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST:
            raise DataError(f"{path.stat().st_size} bytes", where=path, expected=f"at most {LARGEST}")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot be read ({error})", where=path, expected="a file of the sealed case") from error


def _veil(data: bytes, key: bytes) -> bytes:
    stream = hashlib.shake_256(key).digest(len(data))
    return (int.from_bytes(data, "big") ^ int.from_bytes(stream, "big")).to_bytes(len(data), "big")


def _commitment(salt: bytes, text: bytes, digests: Mapping[str, str]) -> str:
    logs = json.dumps(dict(sorted(digests.items()))).encode()
    return hashlib.sha256(salt + hashlib.sha256(text).digest() + hashlib.sha256(logs).digest()).hexdigest()
