"""Layers of a log in Rerun's catalog: raw, debiased and diagnosis, each in an .rrd file."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from imutool import __version__
from imutool.errors import ConfigError, ImutoolError, LogError
from imutool.file_location import to_location
from imutool.fleet import results
from imutool.fleet.one_log import UnitReport
from imutool.processes.system import processors
from imutool.processes.worker_pool import WorkerPool

if TYPE_CHECKING:
    from imutool.viewing.model.run_data import RunData

APPLICATION, PROPERTIES = "imutool fleet", "imutool"
LAYERS = ("raw", "debiased", "diagnosis")
REMARKS = "diagnosis"  # entity of a diagnosis' table
PENDING = ".partial"


@dataclass(frozen=True)
class FleetLog:
    """Log of a fleet: name, place, the JSON of its diagnosis, and facts from fleet.parquet.

    Of several fleets the log of the highest `rank` is shown: 2 is debiased, 1 otherwise written, 0 a source.
    """

    name: str
    place: str
    digest: str
    diagnosis: Path | None = None
    facts: Mapping[str, float | str] = field(default_factory=dict)
    rank: int = 0


class Layers(NamedTuple):
    """Files of a log's layers by layer, or the reason why there are none."""

    name: str
    files: Mapping[str, Path]
    trouble: str = ""


def logs_of(folders: Sequence[Path]) -> list[FleetLog]:
    """Logs in the results of fleets, by name; a log of several fleets has the facts of all.

    Raises:
        ConfigError: a folder without fleet.parquet.
    """
    pa = results.arrow()
    logs: dict[str, FleetLog] = {}
    for folder in folders:
        table = folder / results.NAME
        try:
            rows = pa.parquet.read_table(table).to_pylist()
        except (OSError, pa.ArrowInvalid) as error:
            why = "no such file" if isinstance(error, FileNotFoundError) else str(error).partition(". Detail")[0]
            raise ConfigError(
                f"cannot be read ({why})",
                where=table,
                expected="the OUT of a fleet",
                fix="Run `imutool fleet debias SRC OUT` first",
            ) from error
        for row in rows:
            if row.get("target"):
                if Path(row["target"]).is_absolute() or ".." in Path(row["target"]).parts:  # layers are named by it
                    what, expected = f"names the target {row['target']}", "a file in the folder of the fleet"
                    raise ConfigError(what, where=table, expected=expected)
                log = _log(folder, row)
                logs[log.name] = _joined(logs.get(log.name), log)
    return list(logs.values())


def _log(folder: Path, row: Mapping[str, Any]) -> FleetLog:
    """Log of a row: the debiased one where the fleet wrote it, else its source."""
    target = folder / row["target"]
    failed = (row["earlier"] or row["status"]) in {"failed", "quarantined"}  # what lies there is from an earlier run
    written = target.is_file() and not failed
    is_log = written and target.suffix.lower() == ".mcap"
    diagnosis = target if row["effects"] is not None and written else None
    place = str(target) if is_log else row["source"]
    name = str(Path(row["target"]).with_suffix("").as_posix())
    digest = f"{row['target_sha256'] or row.get('target_digest')}{row['key']}"
    return FleetLog(name, place, digest, diagnosis, _facts(row), is_log + bool(is_log and row["models"]))


def _facts(row: Mapping[str, Any]) -> dict[str, float | str]:
    """Facts of a row: status, score, robot, counts, and the sizes of the first IMU's biases."""
    facts = {name: row[name] for name in ("status", "score", "robot", "duration_s") if row[name] is not None}
    facts |= {name: len(row[name]) for name in ("losses", "effects") if row[name] is not None}
    for bias in row["biases"][:1]:
        gyro, accel = (float(np.linalg.norm(bias[name])) for name in ("gyro_rad_s", "accel_m_s2"))
        facts |= {"gyro_bias_deg_s": float(np.rad2deg(gyro)), "accel_bias_m_s2": accel}
    return facts


def _joined(before: FleetLog | None, log: FleetLog) -> FleetLog:
    """Log with the facts of two fleets."""
    if before is None:
        return log
    first, second = (before, log) if before.rank > log.rank else (log, before)
    diagnosis, facts = second.diagnosis or first.diagnosis, {**second.facts, **first.facts}
    return FleetLog(first.name, first.place, first.digest + second.digest, diagnosis, facts, first.rank)


def build(logs: Sequence[FleetLog], cache: Path, *, workers: int | None = None) -> Iterator[Layers]:
    """Write the layers of each log as .rrd files, in worker processes; complete ones stay.

    Raises:
        ConfigError: `cache` cannot be written.
    """
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=cache, fix="Choose another `cache`") from error
    waiting = []
    for log in logs:
        found = _files(log, cache)
        if found:
            yield Layers(log.name, found)
        else:
            waiting.append(log)
    with WorkerPool(partial(layers, cache=cache), min(workers or processors(), max(len(waiting), 1))) as pool:
        for outcome in pool.run(waiting):
            yield Layers(outcome.item.name, {}, str(outcome.error)) if outcome.error is not None else outcome.value


def layers(log: FleetLog, cache: Path) -> Layers:
    """Layers of one log, each in a file; without an IMU there are none."""
    from imutool.viewing.rerun.importer import load_first_imu

    try:
        data = load_first_imu(to_location(log.place), log.diagnosis)
        if data is None:
            raise LogError("the log holds no IMU", where=log.place)
        _write(log, data, cache)
    except ImutoolError as error:
        return Layers(log.name, {}, str(error))
    return Layers(log.name, _files(log, cache))


def layer_of(entity: str) -> str:
    """Layer of an entity."""
    first, *rest = entity.strip("/").split("/")
    if first == REMARKS or (first, *rest) == ("events", "finding"):
        return "diagnosis"
    of_model = first == "legend" or "debiased" in rest or (first == "bias" and rest[-1:] != ["true"]) or rest == ["error_vec"]
    return "debiased" if of_model else "raw"


def _write(log: FleetLog, data: RunData, cache: Path) -> None:
    """Write the files of a log, raw last: it stands for all."""
    from rerun.chunk import LazyChunkStream, RrdReader

    from imutool.viewing.rerun import rr, scene, sdk

    whole = sdk.new_stream(log.name, application=APPLICATION, recording=log.name)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "whole.rrd"
        whole.save(path)
        scene.log([data], whole, source=False)
        whole.send_property(PROPERTIES, rr.AnyValues(**_properties(log, data)))
        if log.diagnosis is not None:
            text = rr.TextDocument(_diagnosis_text(log.diagnosis), media_type="text/markdown")
            whole.log(REMARKS, text, static=True, strict=True)
        whole.flush(timeout_sec=sdk.FLUSH_S)
        whole.disconnect()
        chunks = list(RrdReader(path).stream())
        for layer in reversed(LAYERS):
            own = [chunk for chunk in chunks if layer_of(chunk.entity_path) == layer]
            if own:
                file = _file(log, cache, layer)
                file.parent.mkdir(parents=True, exist_ok=True)
                partial_file = file.with_suffix(PENDING)
                LazyChunkStream.from_iter(own).write_rrd(partial_file, application_id=APPLICATION, recording_id=log.name)
                partial_file.replace(file)


def _file(log: FleetLog, cache: Path, layer: str) -> Path:
    """File of a layer; its name changes with the log, its diagnosis and the versions."""
    from imutool.viewing.rerun.sdk import rerun_version

    digest = hashlib.sha256(f"{log.digest} {__version__} {rerun_version()}".encode()).hexdigest()[:12]
    return cache / f"{log.name}.{digest}.{layer}.rrd"


def _files(log: FleetLog, cache: Path) -> dict[str, Path]:
    """Files of a log that are complete."""
    files = {layer: _file(log, cache, layer) for layer in LAYERS}
    return {layer: file for layer, file in files.items() if file.is_file()} if files["raw"].is_file() else {}


def _properties(log: FleetLog, data: RunData) -> dict[str, Any]:
    """Facts of a log, and the orientation errors of raw and of the model."""
    errors = {"aoe_deg": data.models()[-1:], "aoe_raw_deg": data.traces[:1]}
    figures = {name: float(trace.figures["aoe_deg"]) for name, traces in errors.items() for trace in traces if trace.figures}
    return {**log.facts, "duration_s": data.duration_s, **figures}


def _diagnosis_text(path: Path) -> str:
    """Markdown about the diagnosis of one log."""
    from imutool.viewing.rerun.entities.report import escape, table

    unit = msgspec.json.decode(path.read_bytes(), type=UnitReport)
    rows = [[escape(p.effect), escape(p.name), f"{p.value:.4g} ± {p.std:.2g} {escape(p.unit)}"] for p in unit.parameters]
    found = [] if isinstance(unit.diagnosis, msgspec.UnsetType) else unit.diagnosis.get("findings", [])
    names = ", ".join(escape(str(finding.get("effect"))) for finding in found) or "no effect above the noise"
    shared = "Parameters that the fleet is compared by:"
    parameters = "\n".join(table(["effect", "parameter", "value"], rows))
    return "\n\n".join([f"# Diagnosis of {escape(unit.robot)}", f"Found: {names}.", shared, parameters])
