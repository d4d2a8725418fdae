"""Model files: headers, sizes, kinds of numbers, shapes, weights and cards that training never writes."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from fuzz import command, outside_contract
from fuzz._inputs import finite_log, only_below
from imutool.bias.model_file import library
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

LARGE = (0, 1, -1, 2**31, 2**63 - 1, 2**64, 10**400, 1e308, -0.5, True, None, "NaN", [], {}, "x" * 5000)
TEXTS = ("</script><script>alert(1)</script>", "\x1b[31m", "\u202e", "\0", "é" * 3000, "../../etc/passwd", "`init`", "[bold]")
DEEP = "[" * 100_000


@cache
def originals() -> tuple[bytes, ...]:
    """The models that ship."""
    return tuple(path.read_bytes() for path in sorted(library().glob("*.safetensors")))


@cache
def log() -> bytes:
    """A log of three seconds."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        write(flight(1, duration_s=3.0), Path(folder) / "log.mcap")
        return (Path(folder) / "log.mcap").read_bytes()


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Debiases with a hostile model: refused, or the log is finite."""
    raw = hostile(rng, rng.choice(originals()))
    (folder / "model.safetensors").write_bytes(raw)
    (folder / "in.mcap").write_bytes(log())
    with only_below(folder, "out.mcap") as wrong:
        done = command(folder, "debias", "in.mcap", "out.mcap", "--model", "model.safetensors", "-q")
    yield from wrong
    yield from outside_contract(done, (0, 3, 5, 6, 7))
    if len(done.stderr) > 4000:
        yield f"a message of {len(done.stderr)} letters: {done.stderr[:200]}"
    if any(not letter.isprintable() and letter != "\n" for letter in done.stderr + done.stdout):
        yield f"control characters in a message: {done.stderr!r}"
    if done.returncode == 0:
        yield from finite_log(folder / "out.mcap")
        yield from outside_contract(command(folder, "info", "out.mcap", "--json", "-"), (0, 3))


def hostile(rng: random.Random, raw: bytes) -> bytes:
    """A model file with something wrong in it."""
    (length,) = struct.unpack_from("<Q", raw)
    header, data = json.loads(raw[8 : 8 + length]), raw[8 + length :]
    what = rng.choice((_lengths, _bytes, _entry, _entry, _weights, _metadata, _metadata, _card, _text))
    return bytes(what(rng, raw, header, data))


def _packed(header: Any, data: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + data


def _lengths(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    return struct.pack("<Q", rng.choice((0, 1, 7, len(raw), 2**32, 2**63, 2**64 - 1))) + raw[8:]


def _bytes(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    at = rng.choice((rng.randrange(len(raw)), rng.randrange(min(4000, len(raw)))))
    return rng.choice((raw[:at], raw[:at] + rng.randbytes(4) + raw[at + 4 :], raw[:at] + raw[at + 1 :], raw + b"0" * 100, b""))


def _entry(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    name = rng.choice([name for name in header if name != "__metadata__"])
    what = rng.randrange(5)
    if what == 0:
        header[name]["dtype"] = rng.choice(("F64", "F16", "BF16", "I64", "BOOL", "F8_E4M3", "X", 5, None, [], "f32"))
    elif what == 1:
        header[name]["shape"] = rng.choice(
            ([], [0], [-1], [2**31, 2**31], [2**63], [1] * 1000, [1.5], "3", None, header[name]["shape"][::-1])
        )
    elif what == 2:
        header[name]["data_offsets"] = rng.choice(([0, 0], [0, 2**63], [5, 1], [-4, 0], [0], None, [0, len(data)]))
    elif what == 3:
        header[rng.choice(("new", "", "__proto__", "../x", "\0"))] = header.pop(name)
    else:
        header[name] = rng.choice(LARGE[4:])
    return _packed(header, data)


def _weights(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    values = np.frombuffer(data[: len(data) // 4 * 4], np.float32).copy()
    chosen = rng.choice((slice(None), rng.randrange(max(1, len(values)))))
    values[chosen] = rng.choice((np.nan, np.inf, -np.inf, 1e30, -3e38, 1e-45, 0.0, 1e4))
    return _packed(header, values.tobytes())


def _metadata(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    key = rng.choice(("format", "method", "rate_hz", "settings", "card"))
    value = rng.choice(
        (
            *(json.dumps(v) if abs(v if isinstance(v, (int, float)) else 0) < 1e300 else "1" * 5000 for v in LARGE),
            *TEXTS,
            DEEP,
            "nan",
            "inf",
            "1e400",
            "{",
        )
    )
    settings = json.loads(header["__metadata__"]["settings"])
    if key == "settings" and settings and rng.random() < 0.7:
        settings[rng.choice(sorted(settings))] = rng.choice((*LARGE[:5], *LARGE[7:]))
        value = json.dumps(settings)
    header["__metadata__"][key] = value if rng.random() < 0.9 else rng.choice((None, 5, {}))
    return _packed(header, data)


def _card(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    card = json.loads(header["__metadata__"]["card"])
    card[rng.choice([*sorted(card), "new"])] = rng.choice((*LARGE[:6], *LARGE[7:], *TEXTS))
    header["__metadata__"]["card"] = json.dumps(card)
    return _packed(header, data)


def _text(rng: random.Random, raw: bytes, header: Any, data: bytes) -> bytes:
    return _packed(
        rng.choice(
            (b"{}", b"[]", b"null", b"\xff\xfe", b'{"a":' * 30_000, b"{" + b" " * 1000, b'{"__metadata__":{}}', b"1" * 6000)
        ),
        data,
    )
