"""OUT/fleet.parquet: a row for each log, for whatever reads Parquet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

from imutool import __version__
from imutool.errors import ConfigError
from imutool.fleet.task import Result
from imutool.location import Location
from imutool.mcap_io.storage.target import Target

NAME = "fleet.parquet"
ROWS = 4096  # in a group; of a million logs no more are held
SCHEMA = "imutool.fleet-results/1"


def arrow() -> Any:
    """The library that writes Parquet.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise ConfigError("a fleet needs pyarrow, which is not installed", fix="pip install 'imutool[fleet]'") from error
    assert pq.__name__, "pyarrow.parquet is what is used of it"
    return pa


def write(results: Iterable[Result], path: Location) -> None:
    """Writes the rows, in the order in which they come; an earlier file is replaced once this one is whole.

    Raises:
        ConfigError: pyarrow is not installed, or the system refuses to write.
    """
    pa = arrow()
    schema = _schema(pa)
    with Target(path, overwrite=True) as target, pa.parquet.ParquetWriter(_Sink(target), schema, compression="zstd") as out:
        for rows in _batches(results):
            out.write_table(pa.Table.from_pylist(rows, schema))


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
    """A result as the values of its row; what a failed log has none of is null."""
    there = result.status != "failed"
    return {
        "source": result.source,
        "target": result.target or None,
        "status": result.status,
        "earlier": result.earlier,
        "error": result.error or None,
        "exit_code": result.exit_code,
        "losses": list(result.losses),
        "warnings": list(result.warnings),
        "score": result.score,
        "seconds": result.seconds,
        "cpu_seconds": result.cpu_seconds,
        "source_bytes": result.source_bytes,
        "target_bytes": result.target_bytes if there else None,
        "target_sha256": result.target_sha256 or None,
        "messages": result.messages if there else None,
        "duration_s": result.duration_s,
        "biases": [
            {"topic": one.topic, "gyro_rad_s": list(one.gyro_bias), "accel_m_s2": list(one.accel_bias)} for one in result.imus
        ],
        "models": [one.model for one in result.imus],
        "init_how": [one.init_how for one in result.imus],
        "robot": result.robot or None,
        "effects": None if result.effects is None else list(result.effects),
        "parameters": [
            {"effect": one.effect, "name": one.name, "value": one.value, "std": one.std, "unit": one.unit}
            for one in result.parameters
        ],
        "peak_bytes": result.peak_bytes or None,
        "host": result.host or None,
        "key": result.key,
    }


def _batches(results: Iterable[Result]) -> Iterator[list[dict[str, Any]]]:
    waiting = iter(results)
    while rows := [row(one) for one in islice(waiting, ROWS)]:
        yield rows


class _Sink:
    """A target as pyarrow asks a file to be."""

    closed = False

    def __init__(self, target: Target) -> None:
        self._target = target

    def write(self, data: Any) -> int:
        """Appends bytes."""
        raw = memoryview(data)
        self._target.write(raw)
        return raw.nbytes

    def tell(self) -> int:
        """How many there are."""
        return self._target.position

    def flush(self) -> None:
        """The target does so when it is whole."""
