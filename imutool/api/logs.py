"""Read, write, convert, inspect and export MCAP logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from imutool.api import checked
from imutool.conversion import run as conversion
from imutool.conversion.corrections import CONVENTIONS, STAMPS
from imutool.conversion.user_labels import Labels, parse_kinds, parse_pair
from imutool.conversion.workers import ConvertReport, Job
from imutool.errors import ConfigError, DataError, LogError, did_you_mean
from imutool.exporting import ExportReport
from imutool.file_location import LogPath, local, location, several
from imutool.log_info.report import LogInfo
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import longest_recording, read_recordings
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.mcap_io.temperature import with_temperatures
from imutool.mcap_io.write import write as write_log
from imutool.recording import Recording
from imutool.report import NamedProgress, silent


@checked
def read(
    path: LogPath,
    *,
    imu: str | None = None,
    truth: str | None = None,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Recording:
    """Read a log as numpy arrays; `read(write(recording)) == recording`, bit for bit.

    A log of another program gets the file's name. Its pose topics become `truths`. Its Float64 and Vector3Stamped topics become
    `scalars`, and so does the field `temperature` of any other message, as `TOPIC.temperature`, at most twice a second.

    Args:
        path: MCAP log: a file, or a URL such as `s3://bucket/log.mcap`.
        imu: IMU topic; needed where the log has several.
        truth: The only pose topic to read; by default all of them.
        start_ns: First log time to read, in nanoseconds.
        end_ns: Last log time to read, in nanoseconds.

    Raises:
        ConfigError: The file cannot be opened.
        LogError: No IMU, several without `imu`, an unknown topic, no sample between `start_ns` and `end_ns`, NaN, decreasing
            stamps, or damage.

    Examples:
        >>> import imutool
        >>> recording = imutool.read("flight_1.mcap")
        >>> recording.imu.gyro.shape, recording.imu.t_ns.dtype
        ((4001, 3), dtype('int64'))
        >>> list(recording.truths)
        ['/ground_truth/pose']
    """
    with Log(location(path)) as log:
        found = read_recordings(log, imu=imu, truth=truth, start_ns=start_ns, end_ns=end_ns)
        recording = longest_recording(with_temperatures(found, log, start_ns, end_ns))
        blocks = log.index.blocks
    if not len(recording.imu) and blocks and (start_ns, end_ns) != (None, None):
        what = f"no sample of the IMU from `start_ns` {start_ns} to `end_ns` {end_ns}"
        first_ns, last_ns = min(block.start_ns for block in blocks), max(block.end_ns for block in blocks)
        raise LogError(what, where=path, expected=f"times within {first_ns} to {last_ns}")
    return recording


@checked
def write(path: LogPath, recording: Recording, *, compression: str = "zstd", overwrite: bool = False) -> None:
    """Write a recording as an MCAP log. The log appears whole or not at all.

    Args:
        path: MCAP log to write: a file or a URL.
        recording: Arrays to write.
        compression: `zstd`, `lz4` or `none`.
        overwrite: Replace an existing log.

    Raises:
        ConfigError: The log exists without `overwrite`, cannot be written, or the compression is unknown.
        DataError: No recording, two topics of one name, times before 1970, or an IMU whose times are not in nanoseconds.

    Examples:
        >>> import imutool
        >>> import numpy as np
        >>> t_ns = 1_700_000_000_000_000_000 + 5_000_000 * np.arange(200)
        >>> gyro, accel = np.zeros((200, 3)), np.tile([0.0, 0.0, 9.81], (200, 1))
        >>> recording = imutool.Recording("bench", imutool.Imu(t_ns, gyro, accel))
        >>> imutool.write("bench.mcap", recording)
        >>> imutool.read("bench.mcap") == recording
        True
    """
    check_outputs([OutputFile("path", path, output_conflicts.LOG)], overwrite=overwrite)
    given: object = recording
    if not isinstance(given, Recording):
        raise DataError(f"is of type {type(given).__name__}", where="recording", expected="a Recording")
    recording.imu.check_rate(recording.name)
    write_log(recording, location(path), compression=compression, overwrite=overwrite)


@checked
def convert(
    source: str | Path,
    out: str | Path,
    *,
    format: str = "auto",
    sequences: str | Sequence[str] = (),
    compression: str = "zstd",
    images: bool = True,
    overwrite: bool = False,
    sensor: str = "",
    kinds: str | Sequence[str] = (),
    mapping: str | Path | Mapping[str, Any] | None = None,
    imu: str = "",
    fix: bool = False,
    restamp: bool = False,
    workers: int | None = None,
    progress: NamedProgress | None = None,
) -> ConvertReport:
    """Convert recordings of any format to MCAP logs, one log per sequence.

    Args:
        source: Bag, log, table, sequence folder, archive (.zip, .tar, .tar.gz), or a folder of these.
        out: Log file for one sequence, folder for several; `logs/` is a folder for one too.
        format: Converter (`euroc`, `tum_vi`, `fetch`, ...), or `auto` to recognise it.
        sequences: Names of the sequences to convert; by default all.
        compression: `zstd`, `lz4` or `none`.
        images: Copy camera frames as well.
        overwrite: Replace existing logs.
        sensor: Name of the IMU, where the recording does not state it.
        kinds: Kind of the poses by topic, as `TOPIC=truth|estimate|odometry|unknown`.
        mapping: Meaning and units of a table's columns: a TOML file, or entries of one such as `{"gyro_unit": "deg/s"}`.
        imu: Two topics that become one IMU: `gyro=TOPIC,accel=TOPIC`.
        fix: Correct units, axes and frames that the motion shows to be wrong.
        restamp: Put late stamps on the clock of the IMU.
        workers: Processes; by default one per core.
        progress: Callback with sequences done, sequences in all, and the name of the last one.

    Raises:
        ImutoolError: Unknown format, no sequence, an existing log; of several sequences the report has failures.

    Examples:
        >>> import imutool
        >>> [log.name for log in imutool.convert("raw", "logs", format="euroc").written]
        ['flight_1.mcap', 'flight_2.mcap']
    """
    check_outputs([OutputFile("out", out, files=("*.mcap",), keeps=True)], [source], overwrite=overwrite)
    template = Job(
        compression=compression,
        images=images,
        overwrite=overwrite,
        labels=Labels(sensor, parse_kinds(several(kinds)), parse_pair(imu)),
        mapping=mapping if mapping is None or isinstance(mapping, Mapping) else local(mapping, "mapping"),
        correct=tuple(name for name, asked in ((CONVENTIONS, fix), (STAMPS, restamp)) if asked),
    )
    place, names = f"{local(out, 'out')}/" if str(out).endswith("/") else local(out, "out"), several(sequences)
    convert_all = partial(conversion.convert, local(source, "source"), place, template, format=format, sequences=names)
    return convert_all(workers=workers, progress=progress or silent)


@checked
def info(path: LogPath, *, check: bool = True, max_chunk: int | None = None) -> LogInfo:
    """Report on a log: topics, rates, gaps, saturation, time at rest, truth coverage, damage.

    Args:
        path: MCAP log: a file or a URL.
        check: Compare the CRC of every chunk; otherwise only of chunks with IMU messages.
        max_chunk: Largest chunk in bytes, packed or unpacked, to read into memory (256 MiB).

    Returns:
        `topics`, `imu` and `truth`, one entry per topic, `warnings` and `losses`; `to_dict()` gives plain values.

    Raises:
        ConfigError: The file cannot be opened.
        LogError: It is not an MCAP log, or no part of it is sound.

    Examples:
        >>> import imutool
        >>> report = imutool.info("flight_1.mcap")
        >>> report.imu[0].topic, round(report.imu[0].rate_hz)
        ('/imu0', 200)
    """
    from imutool.log_info import inspection

    return inspection.inspect(location(path), check=check, max_chunk=max_chunk)


@checked
def export(
    log: str | Path,
    out: str | Path,
    *,
    format: str,
    imu: str | None = None,
    noise: str | Path | None = None,
    overwrite: bool = False,
    progress: NamedProgress | None = None,
) -> ExportReport:
    """Write a log as a EuRoC (ASL) or rosbag2 folder, or a sensor for a simulator.

    Args:
        log: MCAP log. For a simulator: the folder of a diagnosis, or a folder of several; their spread gives the ranges.
        out: Folder to make.
        format: `euroc` or `rosbag2`; `mujoco`, `gazebo`, `isaac` or `toml` for a diagnosed sensor.
        imu: IMU topic for a EuRoC folder; by default the debiased one.
        noise: Data sheet (`adis16448`, `bmi160`) or TOML file for `sensor.yaml` or a simulator; by default as diagnosed.
        overwrite: Replace an earlier export of the same format.
        progress: Callback with steps done, steps in all, and the current step.

    Raises:
        ConfigError: Unknown format, an option that the format does not use, an existing folder.
        LogError: The log is damaged, or holds data that the format cannot represent.
        DataError: Units, axes or poses are not those that a EuRoC folder states.

    Examples:
        >>> import imutool
        >>> report = imutool.export("flight_1.mcap", "flight_1_euroc", format="euroc")
        >>> report.imu
        '/imu0'
    """
    from imutool.exporting import euroc, rosbag2, simulators

    formats = ("euroc", "rosbag2", *simulators.FORMATS)
    if format not in formats:
        fix = did_you_mean(format, formats)
        raise ConfigError(f"unknown format {format!r}", where="format", expected=" or ".join(formats), fix=fix)
    source, folder = local(log, "log"), local(out, "out")
    check_outputs([OutputFile("out", folder, files=("*",), keeps=True)], [source, noise], overwrite=overwrite)
    tell = progress or silent
    if format == "euroc":
        return euroc.write(source, folder, imu, noise, overwrite, tell)
    if format in simulators.FORMATS and imu is None:
        return simulators.write(source, folder, format, noise, overwrite)
    if imu is not None or noise is not None:
        what = "a rosbag2 folder holds the whole log" if format == "rosbag2" else "a diagnosis is of one IMU"
        raise ConfigError(what, where="imu, noise" if format == "rosbag2" else "imu", fix="Leave it out")
    return rosbag2.write(source, folder, overwrite, tell)
