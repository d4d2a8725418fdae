"""Archives of sequences: names that lead elsewhere, links, devices, bombs, archives in archives, and damage."""

from __future__ import annotations

import gzip
import io
import os
import random
import struct
import tarfile
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

from fuzz import command, outside_contract
from fuzz._inputs import IMU, finite_log, only_below, sequence

ELSEWHERE = (
    "../escaped.csv",
    "/tmp/imutool-escaped.csv",
    "mav0/../../escaped.csv",
    "mav0/imu0/../../../escaped.csv",
    "C:\\escaped.csv",
)
BOMB_BYTES = 200 << 20
SUFFIX = {"zip": ".zip", "tar": ".tar", "gz": ".tar.gz"}


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Converts a hostile archive: nothing is written but the log, and memory stays bounded."""
    outside = Path("/tmp/imutool-escaped.csv")
    kind = rng.choice(tuple(SUFFIX))
    raw = zipped(rng) if kind == "zip" else tarred(rng, packed=kind == "gz")
    if rng.random() < 0.4:
        raw = _hit(rng, raw)
    source = folder / "in" / f"seq{SUFFIX[kind]}"
    source.parent.mkdir()
    source.write_bytes(raw)
    with only_below(folder, "out.mcap", "logs") as wrong:
        done = command(folder, "convert", *rng.choice(((f"in/{source.name}", "out.mcap"), ("in", "logs"))), "-q")
    yield from wrong
    yield from outside_contract(done, (0, 3, 4))
    if outside.exists():
        outside.unlink()
        yield f"{outside} was written"
    for log in folder.glob("**/*.mcap"):
        yield from finite_log(log)


def _members(rng: random.Random) -> list[tuple[str, bytes]]:
    members = [(f"{rng.choice(('', 'MH_01/'))}{name}", content) for name, content in sequence(rng).items()]
    what = rng.choice(("whole", "elsewhere", "twice", "bomb", "nested", "long", "odd"))
    if what == "elsewhere":
        members.append((rng.choice(ELSEWHERE), b"0" * 100))
    elif what == "twice":
        members += [(members[0][0], b"other"), (members[0][0].upper(), b"third")]
    elif what == "bomb":
        members[0] = members[0][0], bytes(BOMB_BYTES)
    elif what == "nested":
        members = [("inner.zip", zipped(rng)), *members[: rng.randrange(2)]]
    elif what == "long":
        members.append(("mav0/" + "x" * 300 + "/data.csv", b"1"))
    elif what == "odd":
        members.append(
            (
                rng.choice(
                    ("mav0/\x1b[31m/data.csv", "mav0/\u202egpj/data.csv", "mav0//data.csv", "./mav0/./cam0/data.csv", " ")
                ),
                b"1",
            )
        )
    rng.shuffle(members)
    return members


def zipped(rng: random.Random) -> bytes:
    """A zip archive."""
    file = io.BytesIO()
    with (
        warnings.catch_warnings(action="ignore"),
        zipfile.ZipFile(file, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)), compresslevel=1) as archive,
    ):
        for name, content in _members(rng):
            info = zipfile.ZipInfo(name)
            info.compress_type = archive.compression
            if rng.random() < 0.05:
                info.external_attr = 0o120777 << 16  # a link
            archive.writestr(info, b"/etc/passwd" if info.external_attr else content)
    raw = bytearray(file.getvalue())
    if rng.random() < 0.2:  # sizes in the directory that are not those of the members
        at = raw.rfind(b"PK\1\2")
        struct.pack_into("<I", raw, at + 24, rng.choice((0, 1, 2**31, 2**32 - 1)))
    return bytes(raw)


def tarred(rng: random.Random, *, packed: bool) -> bytes:
    """A tar archive, with links, devices and pipes among its members."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=rng.choice((tarfile.GNU_FORMAT, tarfile.PAX_FORMAT))) as archive:
        for name, content in _members(rng):
            size = len(content) if packed else min(len(content), 1 << 20)
            info = tarfile.TarInfo(name)
            info.size = size
            archive.addfile(info, io.BytesIO(content[:size]))
        if rng.random() < 0.4:
            odd = tarfile.TarInfo(rng.choice((IMU, "mav0/cam0/data.csv", "mav0/imu0")))
            odd.type = rng.choice((tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE, b"Z"))
            odd.linkname = rng.choice(("/etc/passwd", "../../../etc/passwd", IMU, "mav0/imu0"))
            archive.addfile(odd)
    raw = file.getvalue()
    return gzip.compress(raw, 1) if packed else raw


def _hit(rng: random.Random, raw: bytes) -> bytes:
    what = rng.randrange(4)
    if what == 0:
        return raw[: rng.randrange(len(raw))]
    if what == 1:
        return raw + rng.randbytes(100)
    changed = bytearray(raw)
    at = rng.randrange(len(raw)) if what == 2 else max(0, len(raw) - rng.randrange(1, 300))
    changed[at : at + 8] = rng.choice((bytes(8), b"\xff" * 8, os.urandom(0) + rng.randbytes(8)))
    return bytes(changed)
