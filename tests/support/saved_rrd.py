"""What an .rrd holds, read back entity by entity, and the views of a layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import scene

TIMELINES = ("elapsed", "ros2_timestamp", "message_log_time")


def entities(path: Path) -> set[str]:
    """Entities on which a file has data."""
    reader = RrdReader(path)
    (store,) = reader.recordings()
    return {chunk.entity_path for chunk in reader.stream(store=store)}


@dataclass
class Entity:
    """All that a file says of one entity, temporal columns by their chunk's timelines, in the order of their rows."""

    static: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, list[pa.Array]] = field(default_factory=dict)
    stamps: dict[str, dict[str, list[pa.Array]]] = field(default_factory=dict)

    def rows(self, name: str) -> pa.Array:
        return pa.concat_arrays(self.columns[name])

    def numbers(self, name: str) -> np.ndarray:
        """A column of lists of one length, one row per instant, in the precision it is stored in."""
        values = flat = self.rows(name)
        while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
            flat = flat.flatten()
        return flat.to_numpy(zero_copy_only=False).reshape(len(values), -1)

    def times(self, name: str, timeline: str) -> np.ndarray:
        """Nanoseconds of the rows of a column on one timeline."""
        return pa.concat_arrays(self.stamps[name][timeline]).cast(pa.int64()).to_numpy()


def written(logs: Sequence[RunData], path: Path, *, source: bool = True) -> Path:
    path.write_bytes(scene.rrd(logs, source=source))
    return path


def read(path: Path) -> dict[str, Entity]:
    reader = RrdReader(path)
    (store,) = reader.recordings()
    entities: dict[str, Entity] = {}
    for chunk in reader.stream(store=store):
        entity, batch = entities.setdefault(chunk.entity_path, Entity()), chunk.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        columns.pop("rerun.controls.RowId", None)
        if chunk.is_static:
            entity.static |= {name: column.to_pylist()[0] for name, column in columns.items()}
            continue
        stamps = {name: columns.pop(name) for name in chunk.timeline_names}
        for name, column in columns.items():
            entity.columns.setdefault(name, []).append(column)
            for timeline, times in stamps.items():
                entity.stamps.setdefault(name, {}).setdefault(timeline, []).append(times)
    return entities


def views(part: Any) -> list[Any]:
    """The views of a layout or of a part of it."""
    if hasattr(part, "root_container"):
        return views(part.root_container)
    if hasattr(part, "class_identifier"):
        return [part]
    return [view for inner in part.contents for view in views(inner)]


def contents(view: Any) -> list[str]:
    """What a view names, from the root."""
    named = [view.contents] if isinstance(view.contents, str) else list(view.contents)
    return [name.replace("$origin", str(view.origin).rstrip("/")) for name in named]


def held(view: Any, paths: Sequence[str]) -> set[str]:
    """The entities among `paths` that a view holds."""
    found = set()
    for name in contents(view):
        base = name.removesuffix("/**")
        found |= {path for path in paths if path == base or (name.endswith("/**") and path.startswith(f"{base}/"))}
    return found


def names(part: Any) -> list[str]:
    """The names of the parts directly in a container, in their order."""
    return [str(inner.name) for inner in part.contents]
