"""Results of a fleet: the rows of OUT/fleet.parquet, one for each log, and their statistics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import msgspec

from imutool import __version__
from imutool.errors import required
from imutool.file_location import Location
from imutool.fleet.robots import FleetDiagnosis
from imutool.fleet.task import Result
from imutool.mcap_io.storage.target import Target
from imutool.report import UNSET, Report, Section, UnsetType

NAME = "fleet.parquet"
ROWS = 4096  # in a group; of a million logs no more are held
SCHEMA = "imutool.fleet-results/1"
MAX_ROWS = 500  # in a table: more is for the Parquet file
# columns that are null where they are empty
MAY_LACK = ("target", "error", "target_sha256", "target_digest", "robot", "peak_bytes", "host")
TROUBLE = ("failed", "quarantined", "lost")


class LogProblem(Section, frozen=True):
    """Log with a problem."""

    source: str
    status: str
    error: str
    losses: list[str]
    exit_code: int


class FleetSummary(Report, frozen=True, kw_only=True, tag="imutool.fleet/1"):
    """Report of `imutool fleet`; `not_whole` lists the first 1000 logs with a problem."""

    command: str
    source: str
    output: str
    results: str
    logs: int
    statuses: dict[str, int]
    bytes: int
    seconds: float
    mb_per_s: float
    exit_code: int
    not_whole: list[LogProblem]
    comparison: FleetDiagnosis | UnsetType = UNSET


def arrow() -> Any:
    """Module pyarrow, with its Parquet writer.

    Raises:
        ConfigError: it is not installed.
    """
    required("pyarrow.parquet", "fleet", user="a fleet")
    import pyarrow

    return pyarrow


def write(results: Iterable[Result], path: Location) -> None:
    """Write the rows in their order; an earlier file is replaced once this one is whole.

    Raises:
        ConfigError: pyarrow is not installed, or the system refuses to write.
    """
    pa = arrow()
    schema = _schema(pa)
    waiting = iter(results)
    with Target(path, overwrite=True) as target, pa.parquet.ParquetWriter(_Sink(target), schema, compression="zstd") as out:
        while rows := [row(result) for result in islice(waiting, ROWS)]:
            out.write_table(_table(rows, schema, pa))


def _table(rows: list[dict[str, Any]], schema: Any, pa: Any) -> Any:
    """Table with the columns of the schema, by way of JSON: for Python objects pyarrow imports pandas, which takes a second."""
    from pyarrow.json import ParseOptions, ReadOptions, read_json

    lines = b"\n".join(msgspec.json.encode({name: values[name] for name in schema.names}) for values in rows)
    columns = ParseOptions(explicit_schema=pa.schema([(column.name, _without_lengths(column.type, pa)) for column in schema]))
    return read_json(pa.BufferReader(lines), ReadOptions(block_size=len(lines) + 1), columns).cast(schema)


def _without_lengths(kind: Any, pa: Any) -> Any:
    """Type with lists of any length, since JSON knows no others."""
    if isinstance(kind, pa.StructType):
        return pa.struct([(part.name, _without_lengths(part.type, pa)) for part in kind])
    return pa.list_(_without_lengths(kind.value_type, pa)) if hasattr(kind, "value_type") else kind


def _schema(pa: Any) -> Any:
    text, whole, real, texts = pa.string(), pa.int64(), pa.float64(), pa.list_(pa.string())
    three = pa.list_(real, 3)
    columns = {
        "source": text,
        "target": text,
        "status": text,
        "earlier": text,  # of a log that was skipped: what it was when it was done
        "error": text,
        "exit_code": pa.int32(),
        "losses": texts,
        "warnings": texts,
        "score": real,
        "seconds": real,
        "cpu_seconds": real,
        "source_bytes": whole,
        "target_bytes": whole,
        "target_sha256": text,
        "target_digest": text,  # of a log above 4 MiB, in place of it
        "messages": whole,
        "duration_s": real,
        "biases": pa.list_(pa.struct([("topic", text), ("gyro_rad_s", three), ("accel_m_s2", three)])),
        "models": texts,  # in the order of `biases`, as is what follows
        "init_how": texts,
        "robot": text,
        "effects": texts,
        "parameters": pa.list_(pa.struct([("effect", text), ("name", text), ("value", real), ("std", real), ("unit", text)])),
        "peak_bytes": whole,
        "host": text,
        "key": text,
    }
    return pa.schema(list(columns.items()), {"imutool": __version__, "schema": SCHEMA})


def row(result: Result) -> dict[str, Any]:
    """Row of a result; what it lacks is null."""
    lacking = [name for name in MAY_LACK if not getattr(result, name)]
    lacking += ["target_bytes", "messages"] if result.status == "failed" else []
    biases = [{"topic": imu.topic, "gyro_rad_s": imu.gyro_bias, "accel_m_s2": imu.accel_bias} for imu in result.imus]
    models, starts = [imu.model for imu in result.imus], [imu.init_how for imu in result.imus]
    found = {"biases": biases, "models": models, "init_how": starts, **dict.fromkeys(lacking)}
    return {**msgspec.to_builtins(result), **found}


@dataclass
class Statistics:
    """Statistics of all results in one pass: counts, histogram values, and table rows."""

    statuses: Counter[str] = field(default_factory=Counter)
    bytes_in: int = 0
    bytes_out: int = 0
    messages: int = 0
    seconds: list[float] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    biases: dict[str, list[tuple[float, ...]]] = field(default_factory=lambda: {"gyro": [], "accel": []})
    warnings: Counter[str] = field(default_factory=Counter)
    first_warned: dict[str, str] = field(default_factory=dict)  # name of the first log with each warning
    trouble: list[Result] = field(default_factory=list)
    peak_bytes: int = 0
    drawn: list[Result] = field(default_factory=list)
    pages: int = 0

    def add(self, result: Result) -> None:
        """Add a result."""
        status = result.earlier if result.status == "skipped" and result.earlier else result.status
        self.statuses[status] += 1
        self.statuses["skipped"] += result.status == "skipped"
        self.peak_bytes = max(self.peak_bytes, result.peak_bytes)
        if status in TROUBLE and len(self.trouble) < MAX_ROWS:
            self.trouble.append(result)
        if status == "failed":
            return
        self.bytes_in, self.bytes_out = self.bytes_in + result.source_bytes, self.bytes_out + result.target_bytes
        self.messages += result.messages or 0
        self.pages += bool(result.page)
        if result.page and len(self.drawn) < MAX_ROWS:
            self.drawn.append(result)
        self.seconds.append(result.seconds)
        self.speeds.append(result.source_bytes / 1e6 / max(result.seconds, 1e-9))
        if result.score is not None:
            self.scores.append(result.score)
        for imu in result.imus:
            self.biases["gyro"].append(imu.gyro_bias)
            self.biases["accel"].append(imu.accel_bias)
        for warning in {_without_topic(warning) for warning in result.warnings}:
            self.warnings[warning] += 1
            name = result.target.rpartition(".")[0] or result.source.rpartition("/")[2]  # of robots, all may have a log.mcap
            self.first_warned.setdefault(warning, name)


def _without_topic(warning: str) -> str:
    """Words of a warning about a topic, so that equal ones of many logs count together."""
    topic, _, words = warning.partition(": ")
    return words if words and " " not in topic else warning


class _Sink:
    """File interface of a target for pyarrow."""

    closed = False

    def __init__(self, target: Target) -> None:
        self._target = target

    def write(self, data: Any) -> int:
        """Append bytes."""
        raw = memoryview(data)
        self._target.write(raw)
        return raw.nbytes

    def tell(self) -> int:
        """Number of bytes so far."""
        return self._target.position

    def flush(self) -> None:
        """Do nothing: the target flushes at its end."""
