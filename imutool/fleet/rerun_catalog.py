"""Fleet as a Rerun catalog: a dataset with a segment for each log, in layers.

The server listens to this machine alone.

https://rerun.io/docs/concepts/query-and-transform/catalog-object-model
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from imutool.errors import ConfigError, not_installed
from imutool.fleet.rerun_layers import APPLICATION, LAYERS, PROPERTIES, Layers
from imutool.report import Report, Section

if TYPE_CHECKING:
    from rerun.catalog import DatasetEntry

DATASET = "fleet"
FOLDER = "catalog"  # below the fleet's folder, for the layers' files


class Measure(NamedTuple):
    """Measure of a log: its property, the meaning, and whether a larger value is worse."""

    column: str
    meaning: str
    larger_is_worse: bool = True


MEASURES = {
    "aoe": Measure("aoe_deg", "orientation error of the debiased path (°)"),
    "score": Measure("score", "score of the cleaning", larger_is_worse=False),
    "bias": Measure("gyro_bias_deg_s", "size of the gyro's bias (°/s)"),
    "effects": Measure("effects", "number of effects that the diagnosis found"),
    "losses": Measure("losses", "number of lost stretches"),
}


class WorstLog(Section, frozen=True):
    """Log of a catalog with the address that a viewer opens, its layers and properties."""

    name: str
    url: str
    layers: list[str]
    values: dict[str, float | str]


class NotShown(Section, frozen=True):
    """Log without a segment, and the reason."""

    name: str
    reason: str


class CatalogReport(Report, frozen=True, tag="imutool.catalog/1"):
    """Report of `imutool fleet view`: address, number of segments, and the worst logs."""

    url: str
    segments: int
    by: str
    worst: list[WorstLog]
    not_shown: list[NotShown]


def require_catalog() -> None:
    """Check that Rerun's catalog can be used.

    Raises:
        ConfigError: Rerun or datafusion is not installed.
    """
    missing = [name for name in ("rerun", "datafusion") if find_spec(name) is None]
    if missing:
        raise not_installed(missing[0], "catalog,fleet", where="view", user="the catalog")


class Catalog:
    """Server of a fleet on this machine, as a context manager.

    Raises:
        ConfigError: Rerun's catalog is not installed, or `port` is in use.
    """

    def __init__(self, logs: Sequence[Layers], cache: Path, port: int | None = None) -> None:
        from rerun.server import Server

        try:
            self._server = Server(host="127.0.0.1", port=port)
        except (RuntimeError, ValueError, OSError) as error:
            raise ConfigError(f"port {port} cannot be used ({error})", where="port", fix="Choose another port") from error
        self.dataset: DatasetEntry = self._server.client().create_dataset(DATASET)
        files = [(layer, path) for log in logs for layer, path in log.files.items()]
        if files:
            uris = [path.absolute().as_uri() for _, path in files]
            self.dataset.register(uris, layer_name=[layer for layer, _ in files]).wait()
        self._register_layout(cache)

    @property
    def url(self) -> str:
        """Address of the dataset, for a viewer and for `rerun.catalog.CatalogClient`."""
        return f"{self._server.url()}/entry/{self.dataset.id}"

    @property
    def origin(self) -> str:
        """Address at which the server listens, as a browser names it."""
        return self._server.url().removeprefix("rerun+")

    def worst(self, by: str | None, count: int) -> tuple[str, list[WorstLog]]:
        """Measure and worst logs by it, from a query of the segments' table; a log without a value comes last.

        Without `by` the measure is the first of `MEASURES` that a log has.

        Raises:
            ConfigError: no such measure, or no log has it.
        """
        from datafusion import col

        table = self.dataset.segment_table()
        prefix = f"property:{PROPERTIES}:"
        own = {name.removeprefix(prefix): name for name in table.schema().names if name.startswith(prefix)}
        known = [name for name, measure in MEASURES.items() if measure.column in own]
        if by is None:
            by = next(iter(known), "losses")
        if by not in known:
            raise ConfigError(f"no log has a value for {by!r}", where="by", expected=", ".join(known))
        measure = MEASURES[by]
        columns = [col(f'"{name}"')[0].alias(short) for short, name in own.items()]
        names = [col("rerun_segment_id").alias("segment"), col("rerun_layer_names").alias("layers")]
        order = col(measure.column).sort(ascending=not measure.larger_is_worse, nulls_first=False)
        rows = table.select(*names, *columns).sort(order, col("segment").sort()).limit(count).to_pylist()
        return by, [self._segment(row) for row in rows]

    def _segment(self, row: dict[str, Any]) -> WorstLog:
        name, layers_of = row.pop("segment"), row.pop("layers")
        values = {key: value for key, value in row.items() if value is not None}
        return WorstLog(name, self.dataset.segment_url(name), [layer for layer in LAYERS if layer in layers_of], values)

    def _register_layout(self, cache: Path) -> None:
        from imutool.viewing.rerun.layout import fleet_blueprint

        path = cache / "layout.rbl"
        fleet_blueprint().save(APPLICATION, str(path))
        self.dataset.register_blueprint(path.absolute().as_uri())

    def __enter__(self) -> Catalog:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
