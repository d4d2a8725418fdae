"""PX4 topics that ulog2csv wrote (LOG_sensor_combined_0.csv, …): as their ULog."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imutool.errors import DataError
from imutool.recording.message_log import MessageLog, Remarks

from . import Sequence
from ._px4_topics import Columns, log_of, poses_of
from ._source import find_folders, head
from ._tables.text.numbers import plain_columns

GENERAL = True
SENSORS = r"(?P<log>.*?)_?sensor_(combined|gyro(_fifo)?)_\d+\.csv"
TOPIC = r"(?P<topic>[a-z]\w*)_(?P<instance>\d{1,2})\.csv"
HEADER = rb"timestamp(?P<mark>[,;\t])"  # which ulog2csv puts first


def sequences(source: Path) -> list[Sequence]:
    """Logs whose topics are tables of a folder; the names of each log's tables begin alike."""
    found: dict[Path, list[str]] = {}

    def is_mine(folder: Path) -> bool:
        return bool(found.setdefault(folder, [*logs_in(folder)]))

    folders = find_folders(source, is_mine, lambda _: False) if source.is_dir() else []
    each = ((sequence.path, found[sequence.path]) for sequence in folders)
    return [Sequence(log or folder.name, folder, log) for folder, logs in each for log in logs]


def logs_in(folder: Path) -> dict[str, list[Path]]:
    """Tables of each log of a folder; none where another table is next to them."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".csv")
    names = {match["log"] for path in files if (match := re.fullmatch(SENSORS, path.name))}
    logs: dict[str, list[Path]] = {name: [] for name in sorted(names, key=len, reverse=True)}
    for path in files:
        of = next((name for name in logs if re.fullmatch(re.escape(f"{name}_" if name else "") + TOPIC, path.name)), None)
        if of is None or not re.match(HEADER, head(path)):
            return {}
        logs[of].append(path)
    return {name: logs[name] for name in sorted(logs)}


def read_sequence(sequence: Sequence, *, images: bool = True) -> MessageLog:
    """Message log of the tables.

    Raises:
        DataError: none of them can be read.
    """
    remarks, topics = Remarks(), dict[str, Columns]()
    paths = logs_in(sequence.path).get(sequence.inside, [])
    found = {path: match for path in paths if (match := re.fullmatch(rf"{re.escape(sequence.inside)}_?{TOPIC}", path.name))}
    several = {match["topic"] for match in found.values() if int(match["instance"])}
    for path, match in found.items():
        name = f"{match['topic']}/{match['instance']}" if match["topic"] in several else match["topic"]
        try:
            columns = _read(path, remarks)
        except DataError as error:
            remarks.losses.append(f"{path.name} is left out: it {error.what}")
        else:
            topics |= {name: columns} if len(columns["timestamp"]) else {}
    if not topics:
        raise DataError("holds no data", where=sequence.path, expected="tables with rows")
    first_us = min(int(stamps[stamps > 0].min(initial=2**62)) for stamps in (each["timestamp"] for each in topics.values()))
    return log_of(sequence, "px4_csv", topics, poses_of(topics, remarks), 1000 * first_us, remarks)


def read(source: Path) -> Iterator[MessageLog]:
    """Message logs of all such tables of the source, one after the other."""
    return map(read_sequence, sequences(source))


def _read(path: Path, remarks: Remarks) -> Columns:
    """Columns of numbers of a table; texts are left out.

    Raises:
        DataError: rows of different lengths, or a time that is no whole number.
    """
    lines = [line for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    mark = lines[0][len("timestamp")]
    names, found = [name.strip() for name in lines[0].split(mark)], plain_columns(lambda: [lines[1:]], mark)
    if len(lines) == 1:
        return {"timestamp": np.zeros(0, np.int64)}
    if found is None or len(found[0]) != len(names):
        raise DataError(f"has rows that are not of {len(names)} numbers", where=path)
    columns = {name: values for name, values in zip(names, found[0], strict=True) if values is not None}
    times = columns.get("timestamp", np.full(1, np.nan))
    if not (np.isfinite(times) & (times == np.rint(times))).all():
        raise DataError("has times that are no whole microseconds", where=path)
    columns["timestamp"] = times.astype(np.int64)
    if texts := [name for name in names if name not in columns]:
        remarks.losses.append(f"{path.name}: fields of text are left out: {', '.join(texts)}")
    return columns
