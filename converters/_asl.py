"""Recording of an ASL sequence (`mav0/imu0/data.csv` and the other sensor folders).

Repairs: a true pose whose stamp repeats the one before is dropped, the first is kept, and the number is written to the
metadata record `imutool/repairs`. Nothing of the IMU is ever repaired: a defect there stops the sequence at its line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import PurePosixPath

import numpy as np

from imutool.array_types import Float64
from imutool.errors import DataError
from imutool.recording import Frames, Imu, Poses, Recording, Scalars, unit_quaternions

from . import Sequence, _asl_table
from ._source import Tree

IMU = "imu0"
IMU_TOPIC = "/imu0"
QUATERNION_TOLERANCE = 1e-2  # printed with six decimals the norm is off by 3e-4 at most in EuRoC; more is not a rotation
REPEATED = "{} poses with a repeated stamp dropped, the first kept"
MOUNT_TOLERANCE = 1e-3  # m, and of a rotation's matrix
OF_DATASETS = "leica", "pointcloud", "vicon"  # sensors that EuRoC's folders have in addition to IMU, poses and cameras
NO_POSES = "not read: holds no full poses"
OTHER_SENSOR = f"is left out: of such a folder {IMU}, poses and cameras are read; its data.csv can be converted by itself"
MOUNTED = (
    "its T_BS is not that of the poses, and moves neither; imutool convert LOG OUT --fix turns the poses to the IMU's axes"
)
T_BS = re.compile(rb"T_BS:.*?data:\s*\[([^\]]*)\]", re.DOTALL)  # pose of a sensor on the body, in its sensor.yaml
IMAGE_FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def float_stamps(tree: Tree) -> bool:
    """Whether the IMU's stamps are in scientific notation; only FETCH writes them so."""
    return b"e" in _asl_table.first_row(tree.head(f"{IMU}/data.csv")).partition(b",")[0].lower()


def identity(format: str, sequence: Sequence, sensor: str, known: bool) -> dict[str, str]:
    """Metadata on a sequence's origin; data set and sensor only where it shows them."""
    origin = {"dataset": format} if known else {}
    return {"format": format, "sequence": sequence.name, **origin, **({"sensor": sensor} if sensor else {})}


def recording(sequence: Sequence, *, dataset: str, sensor: str, known: bool, truths: dict[str, str], images: bool) -> Recording:
    """Recording of a sequence; `truths` maps sensor folders to pose topics, truth first.

    `known` states whether the sequence is really of the data set, and not only in its format; `sensor` may be empty.

    Velocity and biases are kept where the table has them; rows of unknown bias (nan) are left out of the bias channels.

    Raises:
        DataError: no IMU table, or a defect in a table, with file and line.
    """
    tree = Tree(sequence)
    if f"{IMU}/data.csv" not in tree:
        raise DataError("is missing", where=tree.where(f"{IMU}/data.csv"), expected="the IMU's table")
    by_topic = {truths[folder]: folder for folder in reversed(truths) if f"{folder}/data.csv" in tree}
    folders = [folder for folder in truths if folder in by_topic.values()]
    tables = {folder: f"{folder}/data.csv" for folder in (IMU, *folders)}
    cameras = [name for name in tree.sensors() if name.startswith("cam")] if images else []
    lists = {camera: f"{camera}/data.csv" for camera in cameras}
    texts = [name for name in tree.sizes if name == "body.yaml" or (name.count("/") == 1 and name.endswith("/sensor.yaml"))]
    content = tree.load([*tables.values(), *lists.values(), *texts])

    metadata: dict[str, dict[str, str]] = {
        "imutool": identity(dataset, sequence, sensor, known),
    }
    metadata.update({name: {"text": content[name].decode("utf-8", "backslashreplace")} for name in texts})
    notes: dict[str, dict[str, str]] = {"imutool/repairs": {}, "imutool/skipped": {}, "imutool/losses": {}}
    samples = imu(_asl_table.parse(content.pop(tables[IMU]), tree.where(tables[IMU]), "imu"))
    poses: dict[str, Poses] = {}
    scalars: dict[str, Scalars] = {}
    for folder in folders:
        table = _asl_table.parse(content.pop(tables[folder]), tree.where(tables[folder]), "truth")
        repeated = add_truth(table, truths[folder], poses, scalars)
        if repeated:
            notes["imutool/repairs"][truths[folder]] = REPEATED.format(repeated)
    mounts = [_mount(content.get(f"{folder}/sensor.yaml", b"")) for folder in (IMU, *folders[:1])]
    if len(mounts) > 1 and not np.allclose(mounts[0], mounts[1], atol=MOUNT_TOLERANCE):
        notes["imutool/skipped"][f"{IMU}/sensor.yaml"] = MOUNTED
    frames = {}
    for camera, name in lists.items():
        found = _frames(tree, camera, content[name])
        if isinstance(found, str):
            notes["imutool/skipped"][camera] = found
        else:
            frames[f"/{camera}/image_raw/compressed"] = found
    for other in sorted(set(tree.sensors()) - {IMU, *folders, *cameras}):
        if images or not other.startswith("cam"):
            of_dataset = other.startswith(("cam", *OF_DATASETS))
            notes["imutool/skipped" if of_dataset else "imutool/losses"][other] = NO_POSES if of_dataset else OTHER_SENSOR
    metadata.update({name: note for name, note in notes.items() if note})
    return Recording(sequence.name, samples, poses, scalars, frames, metadata, IMU_TOPIC, sequence.path.name)


def _mount(settings: bytes) -> Float64[np.ndarray, "16"]:
    """Pose of a sensor on the body as its settings state it, row by row; the identity where they do not."""
    match = T_BS.search(settings)
    try:
        numbers = np.array([float(number) for number in match[1].split(b",")]) if match else np.zeros(0)
    except ValueError:
        numbers = np.zeros(0)
    return numbers if len(numbers) == 16 else np.eye(4).reshape(-1)


def imu(table: _asl_table.Table) -> Imu:
    """IMU samples.

    Raises:
        DataError: a value that is no finite number, or time not increasing, with its line.
    """
    table.require("gyro", "accel")
    table.check_clock()
    return Imu(table.t_ns, table.columns["gyro"], table.columns["accel"])


def add_truth(table: _asl_table.Table, topic: str, poses: dict[str, Poses], scalars: dict[str, Scalars]) -> int:
    """Add poses and bias channels under their topics; count dropped repeated stamps.

    Raises:
        DataError: a value that is no finite number, time going back, or a quaternion that is none, with its line.
    """
    velocity = table.columns.get("v_w")
    known = velocity is not None and not np.isnan(velocity).all()
    table.require("p_wb", "q_wb_wxyz", *(("v_w",) if known else ()))
    q_wb_wxyz = table.columns["q_wb_wxyz"]
    norm = np.linalg.norm(q_wb_wxyz, axis=1)
    bad = np.abs(norm - 1.0) > QUATERNION_TOLERANCE
    if bad.any():
        row = int(np.argmax(bad))
        raise table.fault(row, f"quaternion {q_wb_wxyz[row].tolist()} has norm {norm[row]:.6g}", "norm 1")
    new = np.concatenate([[True], np.diff(table.t_ns) != 0])
    kept = _asl_table.Table(table.where, table.t_ns[new], {k: v[new] for k, v in table.columns.items()}, table.lines[new])
    kept.check_clock()
    columns = kept.columns
    poses[topic] = Poses(kept.t_ns, columns["p_wb"], unit_quaternions(columns["q_wb_wxyz"]), columns["v_w"] if known else None)
    for name, end, unit in (("b_g", "gyro", "rad/s"), ("b_a", "accel", "m/s^2")):
        if name in columns and (finite := np.isfinite(columns[name]).all(axis=1)).any():
            scalars[f"{topic.removesuffix('/pose')}/bias/{end}"] = Scalars(kept.t_ns[finite], columns[name][finite], unit)
    return int(len(new) - new.sum())


def _frames(tree: Tree, camera: str, content: bytes) -> Frames | str:
    """Camera frames by reference, or the reason why there are none.

    Raises:
        DataError: some images of the list are missing, listed twice, or of an unknown kind, with the line of the list.
    """
    where = tree.where(f"{camera}/data.csv")
    stamps: dict[str, int] = {}
    missing: tuple[int, str] | None = None
    for t_ns, file, line in _asl_table.pairs(content, where):
        name = f"{camera}/data/{file}"
        if name in stamps:
            raise DataError(f"{file} is listed twice", where=f"{where}:{line}")
        if PurePosixPath(file).suffix.lower() not in IMAGE_FORMATS:
            raise DataError(f"{file} is no image", where=f"{where}:{line}", expected=f"one of {', '.join(IMAGE_FORMATS)}")
        if name not in tree and missing is None:
            missing = line, file
        stamps[name] = t_ns
    if not any(name in tree for name in stamps):
        return "the source has none of the listed images"
    if missing is not None:
        line, file = missing
        raise DataError(f"{file} is not in the source", where=f"{where}:{line}", fix="Leave images out with `images=False`")
    formats = {IMAGE_FORMATS[PurePosixPath(name).suffix.lower()] for name in stamps}
    if len(formats) > 1:
        raise DataError(f"lists {' and '.join(sorted(formats))} images", where=where, expected="one kind")
    return Frames(formats.pop(), len(stamps), partial(_each, tree.sequence, stamps))


def _each(sequence: Sequence, stamps: dict[str, int]) -> Iterator[tuple[int, bytes]]:
    for name, image in Tree(sequence).each(stamps):
        yield stamps[name], image
