"""Folder or zip with a table for each sensor: Sensor Logger, phyphox, KITTI raw OXTS.

Sensor Logger and phyphox record an accelerometer with gravity, or acceleration and gravity apart, in tables of their own.
Sensor Logger's `Accelerometer`, which has a column `seconds_elapsed`, is without gravity. The
layouts are those of github.com/tszheichoi/awesome-sensor-logger (UNITS.md, COORDINATES.md) and of phyphox's export.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import DataError
from imutool.recording import Imu, Poses, Scalars, interpolate
from imutool.recording.joined_imu import joined, unit_by_gravity
from imutool.recording.message_log import MessageLog, Remarks
from imutool.recording.sample_order import in_order, lost_to_set_back

from . import Sequence
from ._archive import list_members, read_bounded, refusing
from ._oxts import OXTS, read_oxts
from ._source import each_path, find_folders, name, named_folder, with_suffix
from ._tables.columns.times import begun_at_zero
from ._tables.columns.units import GRAVITY_BAND, GYRO_SI, STANDARD_GRAVITY, unit_doubts
from ._tables.text.delimited import Columns, read_csv
from ._tables.text.names import split_name

GENERAL = True
IMU_TOPIC = "/imu0"
GYRO = "gyroscope", "gyroscopeuncalibrated"  # tables by falling preference, names without spaces in lower case
ACCEL = "totalacceleration", "accelerometeruncalibrated"
LINEAR = "linearaccelerometer", "linearacceleration"  # of phyphox, without gravity; Sensor Logger's `accelerometer` may be
PLACE = r"/?(meta/|oxts/(data/)?)?[^/]+$"  # of a file below the folder of its recording
HIDDEN = r"(^|/)(__MACOSX/|\.)"
NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
FIX = "Record the acceleration with gravity, or gravity too"
NO_PLATFORM = (
    "no Metadata.csv of Sensor Logger names the phone: the accelerometer counts as Android's, which reads +g upwards. "
    "An iPhone's reads -g; a Metadata.csv of two lines, `platform` and `ios`, turns its sign"
)
MIN_GRAVITY, MAX_IN_G = 0.5, 2.0  # median lengths, in m/s² of nothing but motion, and of readings in g


@dataclass(frozen=True)
class _Files:
    """Text files of a folder or zip, by their names."""

    names: list[str]
    load: Callable[[str], bytes]

    def text(self, wanted: str) -> str:
        """Content of a file."""
        return self.load(wanted).decode("utf-8-sig", "replace")

    def tables(self) -> dict[str, str]:
        """Files of sensors by their plain names: `linearaccelerometer` for `Linear Accelerometer.csv`."""
        found = {}
        for path in sorted(self.names):
            folder, _, file = path.rpartition("/")
            if file.lower().endswith(".csv") and folder.rpartition("/")[2] != "meta":
                found[re.sub(r"[^a-z0-9]", "", file[:-4].lower())] = path
        return found


def sequences(source: Path) -> list[Sequence]:
    """Folders, also of a zip, with tables of gyroscope and accelerometer, or with OXTS."""
    if not source.is_dir():
        return _in_zip(source) if zipfile.is_zipfile(source) else []
    packed = [path for path in each_path(named_folder(source)) if path.suffix.lower() == ".zip" and zipfile.is_zipfile(path)]
    return [*find_folders(source, is_phone, lambda _: False), *(found for path in packed for found in _in_zip(path))]


def _in_zip(path: Path) -> list[Sequence]:
    """Folders of a zip that have such tables; a zip that cannot be read is none."""
    with suppress(DataError):
        folders = sorted({re.sub(PLACE, "", member) for member in list_members(path).sizes if not re.search(HIDDEN, member)})
        return [Sequence(PurePosixPath(f).name or name(path), path, f) for f in folders if is_phone(path, f)]
    return []


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of the tables.

    Raises:
        DataError: a table is damaged, or the acceleration has no gravity in it.
    """
    files, remarks = _files(sequence.path, sequence.inside), Remarks()
    is_oxts = any(map(OXTS.fullmatch, files.names))
    where = Path(str(sequence))
    imu, poses, scalars = read_oxts(files.names, files.text, where, remarks) if is_oxts else _phone(files, where, remarks)
    log = MessageLog(
        sequence.name,
        sequence.path.name,
        imus={IMU_TOPIC: imu},
        poses=poses,
        kinds=dict.fromkeys(poses, "estimate"),
        scalars=scalars,
        metadata={"imutool": {"format": "sensor_tables", "sequence": sequence.name}},
        remarks=remarks,
    )
    return begun_at_zero(log)


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all sequences of the source, one after the other."""
    return map(read_sequence, sequences(source))


def is_phone(path: Path, inside: str = "") -> bool:
    """Whether a folder, or one of a zip, has OXTS, or a phone's tables of a time and x, y, z."""
    files = _files(path, inside)
    tables = files.tables()
    gyro = next((tables[table] for table in GYRO if table in tables), "")
    return any(map(OXTS.fullmatch, files.names)) or (
        bool(gyro)
        and any(table in tables for table in (*ACCEL, *LINEAR, "accelerometer"))
        and all(re.search(rf"\b{word}\b|_{word}\b", files.text(gyro).partition("\n")[0].lower()) for word in ("time", *"xyz"))
    )


def _files(path: Path, inside: str) -> _Files:
    """Files of a folder, or of one in a zip; those of KITTI lie two levels deeper."""
    if path.is_file():
        start = f"{inside}/" if inside else ""
        below = (member.removeprefix(start) for member in list_members(path).sizes if member.startswith(start))
        return _Files([file for file in below if not re.sub(PLACE, "", file)], lambda wanted: _member(path, start + wanted))
    found = [*with_suffix(path, ".csv"), *path.glob("meta/*.csv"), *path.glob("oxts/*.txt"), *path.glob("oxts/data/*.txt")]
    return _Files([file.relative_to(path).as_posix() for file in found], lambda wanted: (path / wanted).read_bytes())


def _member(path: Path, wanted: str) -> bytes:
    with refusing(path), zipfile.ZipFile(path) as archive, archive.open(wanted) as file:
        return read_bounded(file.read, f"{path}/{wanted}", wanted)


def _phone(files: _Files, where: Path, remarks: Remarks) -> tuple[Imu, dict[str, Poses], dict[str, Scalars]]:
    """IMU and further sensors of a phone."""
    tables = files.tables()
    clock = _clock(files)
    gyro_table = next(table for table in GYRO if table in tables)
    gyro_ns, gyro = _vector(files, tables[gyro_table], clock, where, remarks)
    accel_ns, accel, used = _acceleration(files, tables, clock, where, remarks)
    level = float(np.median(np.linalg.norm(accel, axis=1)))
    is_alone = used == ("accelerometer",) and _is_sensor_logger(files, tables["accelerometer"])
    if level <= MIN_GRAVITY or (is_alone and abs(level / STANDARD_GRAVITY - 1.0) > GRAVITY_BAND):
        raise DataError(f"the median acceleration is {level:.3g} m/s^2: gravity was taken out", where=where, fix=FIX)
    if is_alone and (steady := _steady_level(accel_ns, accel)) < STANDARD_GRAVITY / 2.0:
        raise DataError(
            f"the acceleration cancels out to {steady:.3g} m/s^2 in a second: gravity was taken out", where=where, fix=FIX
        )
    if in_g := level < MAX_IN_G:
        accel = accel * STANDARD_GRAVITY
        remarks.notes.append(f"the median acceleration is {level:.3g}: it was taken for g, and is now m/s^2")
    platform = (stated := _metadata(files)).get("platform", "").lower()
    is_ios = platform == "ios" and stated.get("standardisation", "").lower() != "true"
    if is_ios or (in_g and "accelerometeruncalibrated" in used):  # where Sensor Logger writes g on no other system
        accel = -accel
        remarks.notes.append("the phone is of Apple, whose accelerometer reads -g upwards: its sign was turned")
    elif not platform and "totalacceleration" not in used and _is_sensor_logger(files, tables[used[0]]):  # Android's alone
        remarks.doubt([NO_PLATFORM])
    remarks.notes.append(f"gyro from {tables[gyro_table]}, accel from {' + '.join(tables[table] for table in used)}")
    imu, _, notes = joined(gyro_ns, gyro, accel_ns, accel, IMU_TOPIC)
    remarks.notes.extend(notes)
    imu = _in_rad_s(imu, _stated_unit(files, tables[gyro_table]), remarks)
    scalars: dict[str, Scalars] = {}
    if others := [path for table, path in tables.items() if re.fullmatch(rf"({'|'.join(GYRO)})\d+", table)]:
        note = f"{', '.join(others)} of further gyroscopes or recordings become numbers and no IMU"
        remarks.notes.append(f"{note}: give each a folder of its own, with its accelerometer")
    for table, path in tables.items():
        if table not in (gyro_table, *used):
            scalars |= _others(files, path, clock, where, remarks)
    return imu, {}, scalars


def _stated_unit(files: _Files, path: str) -> str:
    """Unit of a gyro in the header of its table, or that which Sensor Logger documents; else empty."""
    header = files.text(path).partition("\n")[0]
    units = (split_name(field.strip(' "\r'))[1] for field in header.split(","))
    return next((unit for unit in units if unit in GYRO_SI), "rad/s" if "seconds_elapsed" in header else "")


def _in_rad_s(imu: Imu, stated: str, remarks: Remarks) -> Imu:
    """The IMU with its rates in rad/s.

    They are in the stated unit. Without one they are in that by which gravity turns, or in rad/s where it does not turn enough.
    """
    shown = None if stated else unit_by_gravity(imu.t_ns, imu.gyro, imu.accel, GYRO_SI)
    unit = stated or (shown[0] if shown else "rad/s")
    if unit != "rad/s":
        remarks.notes.append(f"the gyro is in {unit}, as {'its header says' if stated else 'gravity turns'}, and now in rad/s")
        imu = replace(imu, gyro=imu.gyro * GYRO_SI[unit])
    remarks.doubt(unit_doubts(imu, unit, "m/s^2"))
    return imu


def _steady_level(t_ns: Int64[np.ndarray, " n"], accel: Float64[np.ndarray, "n 3"]) -> float:
    """Median length of the acceleration's means over a second, in which steps and shakes cancel out and gravity does not."""
    starts = np.flatnonzero(np.diff((t_ns - t_ns[0]) // NS["s"], prepend=-1))
    means = np.add.reduceat(accel, starts) / np.diff(starts, append=len(accel))[:, None]
    return float(np.median(np.linalg.norm(means, axis=1)))


def _acceleration(
    files: _Files, tables: Mapping[str, str], clock: list[tuple[float, int]], where: Path, remarks: Remarks
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], tuple[str, ...]]:
    """Acceleration with gravity, and the tables it is from."""
    for table in ACCEL:
        if table in tables:
            return *_vector(files, tables[table], clock, where, remarks), (table,)
    named = next(table for table in ("accelerometer", *LINEAR) if table in tables)
    t_ns, accel = _vector(files, tables[named], clock, where, remarks)
    if "gravity" not in tables:
        if named in LINEAR:
            raise DataError(f"{tables[named]} has no gravity in it, and no other acceleration is there", where=where, fix=FIX)
        return t_ns, accel, (named,)
    other_ns, gravity = _vector(files, tables["gravity"], clock, where, remarks)
    steady = interpolate((t_ns - t_ns[0]).astype(float), (other_ns - t_ns[0]).astype(float), gravity)
    return t_ns, accel + steady, (named, "gravity")


def _is_sensor_logger(files: _Files, path: str) -> bool:
    """Whether a table has the times of Sensor Logger."""
    return "seconds_elapsed" in files.text(path).partition("\n")[0]


def _metadata(files: _Files) -> dict[str, str]:
    """What Sensor Logger states of its recording, by its names; empty without its table."""
    path = files.tables().get("metadata")
    names, _, values = files.text(path).strip().partition("\n") if path else ("", "", "")
    return {key.strip(): value.strip() for key, value in zip(names.split(","), values.split(","), strict=False)}


def _clock(files: _Files) -> list[tuple[float, int]]:
    """Experiment times (s) at which phyphox started, with the system time (ns) of each."""
    path = next((path for path in files.names if path.endswith("meta/time.csv")), None)
    rows = [] if path is None else [row.replace('"', "").split(",") for row in files.text(path).splitlines()]
    return [(float(row[1]), round(float(row[2]) * 1e9)) for row in rows if row[0] == "START" and len(row) > 2]


def _columns(
    files: _Files, path: str, clock: list[tuple[float, int]], where: Path, remarks: Remarks
) -> tuple[Int64[np.ndarray, " n"], dict[str, tuple[Float64[np.ndarray, " n"], str]]]:
    """Times of a table, and its other columns with their units, by plain names."""
    columns = Columns()
    read_csv(files.text(path), columns, Path(f"{where}/{path}"), minimum=2)
    remarks.notes.extend(columns.remarks.notes)
    remarks.losses.extend(f"{path}: {loss}" for loss in columns.remarks.losses)
    named = {split_name(column): column for column in columns.values}
    times = next((key for key in named if key[0] == "time"), None)
    if times is None:
        raise DataError("has no column `time`", where=f"{where}/{path}", expected=f"one of {', '.join(columns.values)}")
    t = columns.values[named[times]]
    if times[1]:
        t_ns = np.rint(t.astype(float) * NS[times[1]]).astype(np.int64)
        for start, system_ns in clock:
            later = t >= start
            t_ns[later] = system_ns + np.rint((t[later] - start) * 1e9).astype(np.int64)
    else:
        t_ns = t.astype(np.int64)
    rest = {key: column for key, column in named.items() if key[0] not in ("time", "seconds_elapsed")}
    return t_ns, {key[0]: (columns.values[column].astype(float), key[1]) for key, column in rest.items()}


def _vector(
    files: _Files, path: str, clock: list[tuple[float, int]], where: Path, remarks: Remarks
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Times and x, y, z of a sensor."""
    t_ns, columns = _columns(files, path, clock, where, remarks)
    axes = [[values for key, (values, _) in columns.items() if re.fullmatch(rf"(.*_)?{axis}", key)] for axis in "xyz"]
    if any(len(found) != 1 for found in axes):
        raise DataError("has no three columns x, y, z", where=f"{where}/{path}", expected=", ".join(columns))
    kept = in_order(t_ns, np.stack([found[0] for found in axes], axis=1), path)
    remarks.notes.extend(kept.notes)
    remarks.losses.extend(lost_to_set_back(t_ns, path))
    return kept.t_ns, kept.values


def _others(files: _Files, path: str, clock: list[tuple[float, int]], where: Path, remarks: Remarks) -> dict[str, Scalars]:
    """Columns of a further sensor; text and a table without time are a loss, a table without rows is none."""
    folder = re.sub(r"[^A-Za-z0-9_]+", "_", Path(path).stem).strip("_")
    if folder.lower() == "metadata" or len(files.text(path).split("\n", 1)[-1].strip()) == 0:
        return {}
    try:
        t_ns, columns = _columns(files, path, clock, where, remarks)
    except DataError as error:
        remarks.losses.append(f"{path} is left out: it {error.what}")
        return {}
    scalars = {}
    for key, (values, unit) in columns.items():
        kept = in_order(t_ns, values[:, None], path)
        if len(kept.t_ns):
            scalars[f"/{folder}/{key}"] = Scalars(kept.t_ns, kept.values, unit)
    return scalars
