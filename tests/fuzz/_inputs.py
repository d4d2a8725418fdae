"""What the generators of small inputs share: a whole sequence, random damage to text, and the folder before and after."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read

START_NS = 1_403_636_579_758_560_000
STEP_NS = 5_000_000
IMU, TRUTH = "mav0/imu0/data.csv", "mav0/state_groundtruth_estimate0/data.csv"
MOCAP = "mav0/mocap0/data.csv"
TOKENS = (
    *("nan", "NaN", "inf", "-inf", "", " ", "0", "-0.0", "1e308", "1e309", "-1e308", "1e-320", "5e-324", "0x10", "1_000"),
    *(
        "9" * 400,
        "1e99999",
        "é",
        "\u202e1",
        "\ufeff0",
        "１",
        "oops",
        '"',
        '"1,2"',
        "True",
        "1;2",
        "1.5.2",
        "--1",
        "\0",
        "\x1b[31m",
    ),
)
STAMPS = ("0", "-1", "9223372036854775807", "9223372036854775808", "1e18", "1.403636579758560000e+18", "nan", "", "1" * 40)


def sequence(rng: random.Random) -> dict[str, bytes]:
    """Files of a sequence as EuRoC, TUM-VI or FETCH writes it, by name."""
    kind, rows = rng.choice(("euroc", "tum_vi", "fetch")), rng.randrange(1, 60)
    stamps = [START_NS + n * STEP_NS for n in range(rows)]
    shown = [f"{stamp:.18e}" if kind == "fetch" else str(stamp) for stamp in stamps]
    imu = ["#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z"]
    imu += [f"{stamp},{rng.gauss(0, 1):.6f},0.01,0.02,0.1,0.2,{9.81 + rng.gauss(0, 0.1):.5f}" for stamp in shown]
    truth = ["#timestamp,p_RS_R_x [m],p_RS_R_y,p_RS_R_z,q_RS_w [],q_RS_x,q_RS_y,q_RS_z"]
    truth += [f"{stamp},{0.01 * n},1,2,1,0,0,0" for n, stamp in enumerate(shown)]
    return {IMU: _lines(imu), TRUTH if kind == "euroc" else MOCAP: _lines(truth)}


def _lines(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def damaged(rng: random.Random, raw: bytes) -> bytes:
    """A table with some fields, lines or bytes replaced."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        raw = rng.choice((_field, _field, _stamp, _row, _order, _bytes, _ends, _column))(rng, raw)
    return raw


def _split(raw: bytes) -> list[bytes]:
    return raw.split(b"\n")


def _field(rng: random.Random, raw: bytes) -> bytes:
    lines = _split(raw)
    row = rng.randrange(len(lines))
    cells = lines[row].split(b",")
    cells[rng.randrange(len(cells))] = rng.choice(TOKENS).encode()
    lines[row] = b",".join(cells)
    return b"\n".join(lines)


def _stamp(rng: random.Random, raw: bytes) -> bytes:
    lines = _split(raw)
    row = rng.randrange(len(lines))
    step = rng.choice((-1, 0, 86_400 * 10**9, -(10**18), STEP_NS))
    new = rng.choice((*STAMPS, str(START_NS + step)))
    lines[row] = b",".join([new.encode(), *lines[row].split(b",")[1:]])
    return b"\n".join(lines)


def _row(rng: random.Random, raw: bytes) -> bytes:
    lines = _split(raw)
    row = rng.randrange(len(lines))
    new = rng.choice(
        (b"", b",,,,,,", b"," * 100, lines[row] + b",1", lines[row][: len(lines[row]) // 2], b"#", lines[row], b"x" * 70_000)
    )
    return b"\n".join([*lines[:row], *([new] * rng.choice((1, 2))), *lines[row + rng.choice((0, 1)) :]])


def _order(rng: random.Random, raw: bytes) -> bytes:
    head, *lines = _split(raw)
    rng.choice((rng.shuffle, list.reverse, list.sort))(lines)  # type: ignore[operator]
    return b"\n".join([head, *lines])


def _bytes(rng: random.Random, raw: bytes) -> bytes:
    at, size = rng.randrange(len(raw) + 1), rng.choice((1, 3, 60))
    new = rng.choice((bytes(size), rng.randbytes(size), b"\xff" * size, b""))
    return raw[:at] + new + raw[at + rng.choice((0, size)) :]


def _ends(rng: random.Random, raw: bytes) -> bytes:
    return rng.choice(
        (
            raw.replace(b"\n", b"\r\n"),
            raw.replace(b"\n", b"\r"),
            b"\xef\xbb\xbf" + raw,
            raw.rstrip(b"\n"),
            raw[: len(raw) // 2],
            b"",
            raw.decode("utf-8", "replace").encode("utf-16"),
        )
    )


def _column(rng: random.Random, raw: bytes) -> bytes:
    column = rng.randrange(8)
    return b"\n".join(b",".join(cell for k, cell in enumerate(line.split(b",")) if k != column) for line in _split(raw))


def put(folder: Path, files: dict[str, bytes]) -> None:
    """Writes files below a folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, with its content."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@contextmanager
def only_below(folder: Path, *allowed: str) -> Iterator[list[str]]:
    """In the list: files that were changed in a folder, or that came where none may come."""
    before, wrong = listing(folder), list[str]()
    yield wrong
    after = listing(folder)
    wrong += [f"{name} was changed" for name in before if after.get(name) != before[name]]
    wrong += [f"{name} was left" for name in after.keys() - before.keys() if not name.startswith(allowed) or ".partial" in name]


def finite_log(path: Path) -> Iterator[str]:
    """What is wrong with the numbers of a log."""
    with Log(path) as log:
        topics = [name for name, topic in log.topics.items() if topic.schema_name == "sensor_msgs/msg/Imu"]
    for topic in topics:
        recording = read(path, imu=topic)
        if not (np.isfinite(recording.imu.gyro).all() and np.isfinite(recording.imu.accel).all()):
            yield f"{topic} of {path.name} holds numbers that are not finite"
        if (np.diff(recording.imu.t_ns) < 0).any():
            yield f"{topic} of {path.name} is not in order of time"
