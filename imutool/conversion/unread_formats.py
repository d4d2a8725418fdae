"""Formats that are known by their first bytes but not read: what they are, and what to do."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from imutool.errors import DataError, ImutoolError
from imutool.file_location import compression, first_bytes

ENOUGH = 1024  # bytes of a file's start
MAX_FILES = 1000  # of a folder, which are looked at
MAX_NAMED = 3  # pointers
RECORDINGS = (  # endings of what may be a recording, or a part of one
    r"\.(bag|db3|mcap|ulg|bin|log|csv|tsv|txt|dat|tum|jsonl?|mat|np[yz]|parquet|feather|arrow|h5|hdf5|xlsx?|zip|tar|gz|xz|bz2|zstd?)$"
)
GIVE_RIGHT = "Give yourself the right to read it, and convert again"
POINTER, GET_FILES = rb"version https://git-lfs\.github\.com/spec/", "Get the files with git lfs pull, and convert again"
ARCHIVE, ZIPPED_TABLES = rb"PK\x03\x04|.{257}ustar", (".xlsx", ".xlsm", ".npz")
FORMATS = {  # what a file that begins like this is, and what to do
    rb"H Product:Blackbox": (
        "it is a blackbox log of Betaflight or INAV",
        "Decode it with blackbox_decode, and convert its CSV with a map of its columns",
    ),
    rb"\x00[\x03-\x07].{6}[\x55\xfd\xfe]": (  # a time in us of 1996 to 2041, then the first byte of a message
        "it is a telemetry log of MAVLink, which has a few samples of the IMU a second",
        "Convert the vehicle's own log, a .bin or .ulg. Without one, write HIGHRES_IMU, or SCALED_IMU2 in mg and mrad/s, as a"
        " CSV with pymavlink's mavlogdump.py --format csv --types HIGHRES_IMU, and convert that",
    ),
    rb"\xa3\x95\x80": (
        "it is an sdlog2 log of PX4 before 2017",
        "Make a CSV of it with sdlog2_dump.py of PX4, and convert that with a map of its columns",
    ),
    rb"[#%][A-Z0-9]{4,}A,[A-Z0-9_]+,\d|\xaa\x44[\x12\x13]": (  # with a long or a short header, as text or not
        "it is a log of a NovAtel receiver, whose RAWIMU holds counts of a scale that depends on the IMU",
        "Make a CSV of it in rad/s and m/s^2 with the scale that NovAtel's manual states for the IMU, and convert that",
    ),
    rb"MD\xfc\x03": (
        "it is a log of an Axivity sensor",
        "Export it as raw CSV with OmGUI, or with the tool cwa-convert, and convert that",
    ),
    rb"Device Identity\r?\n|GENEA/": (
        "it is a log of a GENEActiv or GENEA sensor, which has no gyro",
        "Convert a recording of a sensor with a gyro",
    ),
    rb".{8}\.FIT": (
        "it is a FIT file of a sports watch",
        "Export its gyroscope_data and accelerometer_data as CSV, and convert that",
    ),
    rb".{4}ftyp": (
        "it is a video",
        "Extract its telemetry as CSV or JSON, as gopro-telemetry or telemetry-parser do, and convert that",
    ),
    rb"(\xef\xbb\xbf)?<\?xml.{0,900}<(!DOCTYPE )?mvnx": (
        "it is a motion of Xsens MVN, which holds what its model of the body estimates",
        "Export what the sensors measured from the .mvn or .mtb as text, and convert that",
    ),
    rb"(.{0,200}?\xfa\xff\x36[\x01-\xfe]){4}": (  # messages MTData2 one behind another
        "it is a stream of messages (Xbus) of an Xsens sensor",
        "Export it as text with MT Manager, and convert that",
    ),
    rb"[\x02-\x05]P": (
        "it is a C3D file of a motion capture",
        "Export it as CSV or TRC, and convert it together with the table of the IMU",
    ),
    rb"\x80[\x02-\x05].*[()}\].]": (
        "it is a pickle of Python, which can run any program when it is read",
        "Load it where you trust its source, save the arrays with numpy.savez, and convert that",
    ),
    rb"(#[^\n]*\n)*(?=([^\n]*[,;\t]){2})([^\n]*[,;\t])?['\"]?(?i:_?value)['\"]?\s*[,;\t\n]": (  # as InfluxDB and Grafana export
        "it is a long table, with a row for each number",
        "Pivot it to a row for each time and a column for each axis, as pivot() of Flux and pivot_table() of pandas do",
    ),
    rb"\xed\xa1\xda\x01": (
        "it is a log of LCM, which does not hold the types of its messages",
        "Decode it with the Python module that lcm-gen made of the types, write a CSV of the IMU, and convert that",
    ),
    rb"\x00{4}.{4}[\x01-\xff][\x00-\x07]\x00{6}\x08\x01": (  # a section of type 0 with less than 2 kB, then its version
        "it is a record of Apollo (Cyber RT)",
        "Read its channel of the IMU with cyber_record, write a CSV, and convert that",
    ),
    rb"#ROSRECORD V1\.": (
        "it is a bag of ROS before 2010 (version 1)",
        "Bring it to version 2.0 with the rosbag of ROS 1: rosbag filter OLD.bag NEW.bag True",
    ),
    rb"VisionRe": (
        "it is a VRS recording, as of Project Aria",
        "Export its IMU as CSV with projectaria_tools or pyvrs, and convert that",
    ),
    rb"RRF\d|RRIO": (
        "it is a recording of Rerun, which imutool writes and does not read",
        "Convert the log that it was made of",
    ),
    rb"\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x4d\x3c\xb2\xa1|\x0a\x0d\x0d\x0a": (
        "it is a capture of a network (pcap), as of a lidar",
        "Replay it to the sensor's driver, record a bag of that, and convert the bag",
    ),
    rb"MDF {5}|UnFinMF |TDSm": (
        "it is a measurement file (MDF or TDMS)",
        "Export the channels of the IMU as CSV or HDF5, with asammdf or npTDMS, and convert that",
    ),
    POINTER: ("it is a pointer of Git LFS in place of the file", GET_FILES),
    ARCHIVE: (
        "it is an archive whose name does not end in .zip, .tar, .tar.gz or .tgz",
        "Give it the ending of its kind, or unpack it and convert the folder that is in it",
    ),
    rb"\x75\x65": (
        "it looks like a binary log of a MicroStrain sensor",
        "Export it as CSV with SensorConnect, and convert that",
    ),
}
ST_DATALOG = {"device_config.json", "deviceconfig.json"}
WITHOUT_NUMBERS = (
    "it is text without a row of four numbers, which are the least of a table: a time and a vector",
    "See whether the recorder wrote any rows, and how it separates their fields: by comma, semicolon, tab or blanks",
)


def nothing_found(source: Path, *, packed: bool) -> DataError:
    """Error of a source without a sequence; `packed` if it is what was unpacked."""
    what, fix = describe_folder(source) if source.is_dir() else describe_unread(first_bytes(source, ENOUGH))
    if packed and source.is_dir() and not what:
        what, fix = "nothing in the archive shows that it is a recording", f"Unpack it. {fix}"
    return DataError(
        f"no sequence found: {what}" if what else "no sequence found",
        where=source,
        expected="a ROS bag, an MCAP log, a PX4 or ArduPilot log, a table, a mav0 folder or its archive",
        fix=fix,
    )


def is_pointer(path: Path) -> bool:
    """Whether a file is a pointer of Git LFS, whatever its ending."""
    return path.is_file() and path.stat().st_size <= ENOUGH and re.match(POINTER, first_bytes(path, ENOUGH)) is not None


def left_out_below(folder: Path) -> list[str]:
    """Sentences on what is left out of a folder: pointers of Git LFS, and what may not be read."""
    found, closed = [path.name for path in pointers_in(folder)], _closed_in(folder)
    pointers = f"{_listed(found)}: pointers of Git LFS in place of the files are left out. {GET_FILES}"
    unread = f"{_listed(closed)} may not be read and is left out. {GIVE_RIGHT}"
    return [reason for reason, names in ((pointers, found), (unread, closed)) if names]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:MAX_NAMED]) + (f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else "")


def _closed_in(folder: Path) -> list[str]:
    """Folders and recordings below a folder that the user may not read."""
    found = []
    for inside, folders, files in os.walk(folder):
        paths = [Path(inside, name) for name in (*folders, *(file for file in files if re.search(RECORDINGS, file.lower())))]
        found += [str(p.relative_to(folder)) for p in paths if not os.access(p, os.R_OK | (os.X_OK if p.is_dir() else 0))]
    return sorted(found)


def blamed(error: ImutoolError, pointers: Sequence[Path]) -> ImutoolError:
    """The error of a recording, or one that names the pointers of Git LFS of which it consists."""
    if not isinstance(error, DataError) or not error.where:
        return error
    where = Path(error.where)
    return nothing_found(where, packed=False) if any(path.is_relative_to(where) for path in pointers) else error


def pointers_in(folder: Path) -> list[Path]:
    """Pointers of Git LFS among the first recordings in a folder."""
    paths = (Path(inside, name) for inside, _, files in os.walk(folder) for name in sorted(files))
    recorded = (path for path in paths if re.search(RECORDINGS, path.name.lower()))
    return [path for path in islice(recorded, MAX_FILES) if is_pointer(path)]


def describe_unread(start: bytes) -> tuple[str, str]:
    """What a file with these first bytes is, and what to do; empty where that is not known."""
    if not start:
        return "it is empty", "See whether the recorder was stopped properly"
    if program := compression(start):
        return f"it is compressed with {program}", f"Unpack it first, for instance with {program} -d"
    return _known(start) or (WITHOUT_NUMBERS if _is_text(start) else ("", ""))


def _known(start: bytes) -> tuple[str, str] | None:
    return next((description for pattern, description in FORMATS.items() if re.match(pattern, start, re.DOTALL)), None)


def describe_folder(folder: Path) -> tuple[str, str]:
    """What a folder is in which no recording was found, and what to do."""
    paths = [Path(inside, name) for inside, _, files in os.walk(folder) for name in sorted(files)]
    names = {path.name.lower() for path in paths}
    if names & ST_DATALOG and any(name.endswith(".dat") for name in names):
        return "it is an acquisition of ST's High Speed Datalog", "Export it as CSV with ST's stdatalog, and convert that"
    descriptions: dict[tuple[str, str], list[str]] = {}
    for path in paths[:MAX_FILES]:
        is_table = path.suffix.lower() in ZIPPED_TABLES  # that shows no IMU, and is no archive of recordings
        if path.is_file() and not is_table and (found := _known(first_bytes(path, ENOUGH))):
            descriptions.setdefault(found, []).append(path.name)
    if descriptions:
        (what, fix), alike = max(descriptions.items(), key=lambda each: len(each[1]))
        others = f" and {len(alike) - 1} other{'s' * (len(alike) > 2)}" if len(alike) > 1 else ""
        return f"of {alike[0]}{others}, {what}", fix
    if closed := _closed_in(folder):
        return f"{_listed(closed)} may not be read", GIVE_RIGHT
    tables = (str(path.relative_to(folder)) for path in paths if re.search(RECORDINGS, path.name.lower()))
    if names:
        shown = f", as {first}, " if (first := next(tables, "")) else " "
        named = "Name the file, or a folder nearer to it: four levels are searched"
        return "", f"{named}, and tables that show no IMU{shown}are left out"
    return "it holds no files", "See whether the recording lies elsewhere"


def _is_text(start: bytes) -> bool:
    return "".join(start.decode("utf-8-sig", "ignore").split()).isprintable() and b"\0" not in start
