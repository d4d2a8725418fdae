"""What each view of a layout is to show, from the file that the viewer gets, and which of it cannot be seen in a picture."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from support import saved_rrd

MIN = 200  # pixels of a curve; its sample in a legend has some fifty
WITHIN = 36.0  # in RGB: what an edge mixes of a line with its ground, and less than two colours of ours are apart
MAX_COLORS = 12  # of one path: its neighbours are near each other
MARKS = ("/worst", "/error_vec")  # no curves: a body may hide a mark, and where nothing is wrong a vector has no length
COLORS = ("SeriesLines:colors", "LineStrips3D:colors", "LineStrips2D:colors")


class Curve(NamedTuple):
    """A line of an entity, in one colour or, where its pieces have their own, in any of several."""

    entity: str
    name: str
    colors: np.ndarray


def curves(path: Path) -> list[Curve]:
    """Every line of a recording, by the styles in its .rrd."""
    found: dict[str, dict[str, list[Any]]] = {}
    reader = RrdReader(path)
    (store,) = reader.recordings()
    for chunk in reader.stream(store=store):
        entity, batch = found.setdefault(chunk.entity_path, {}), chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if name in COLORS or name == "SeriesLines:names":
                entity.setdefault(name, []).extend(flat(column))
    return [curve for entity, styles in found.items() if not entity.endswith(MARKS) for curve in of_entity(entity, styles)]


def flat(column: pa.Array) -> list[Any]:
    while pa.types.is_list(column.type):
        column = column.flatten()
    return list(column.to_pylist())


def of_entity(entity: str, styles: Mapping[str, list[Any]]) -> Iterator[Curve]:
    for name, values in styles.items():
        if name == "SeriesLines:colors":
            for series, color in zip(styles["SeriesLines:names"], unpacked(values), strict=True):
                yield Curve(entity, series, color[None])
        elif name in COLORS:
            yield Curve(entity, "line", np.unique(unpacked(values), axis=0))


def unpacked(rgba: Sequence[int]) -> np.ndarray:
    """Red, green and blue of packed colours."""
    packed = np.array(rgba, dtype=np.uint32)
    return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=-1)


# ── layouts ──


def faces(blueprint: Any) -> Iterator[list[Any]]:
    """Turns the tabs of a layout until every view has been in front, and each time names those that are new."""
    waiting = {leaf.id: leaf for leaf in saved_rrd.views(blueprint.root_container)}
    while waiting:
        front = turn(blueprint.root_container, waiting)
        new = [waiting.pop(leaf.id) for leaf in front if leaf.id in waiting]
        assert new, "a view that no tab brings to the front"
        yield new


def turn(part: Any, waiting: Mapping[Any, Any]) -> list[Any]:
    """Opens the first tab behind which something waits; the views that are in front then."""
    if hasattr(part, "class_identifier"):
        return [part]
    parts = list(part.contents)
    if type(part).__name__ == "Tabs":
        part.active_tab = next(
            (k for k, inner in enumerate(parts) if any(leaf.id in waiting for leaf in saved_rrd.views(inner))), 0
        )
        parts = [parts[part.active_tab]]
    return [leaf for inner in parts for leaf in turn(inner, waiting)]


def shown(view: Any, curves: Sequence[Curve]) -> list[Curve]:
    """The curves that a view holds, as it has them drawn: it may leave some of an entity out, and colour others anew."""
    found = []
    for entity in sorted(saved_rrd.held(view, [curve.entity for curve in curves])):
        mine = [curve for curve in curves if curve.entity == entity]
        style = view.visualizer_overrides.get(entity)
        visible, colors = (column(style, name) for name in ("visible_series", "colors"))
        for k, curve in enumerate(mine):
            if not visible or visible[k]:
                found.append(curve._replace(colors=unpacked(colors[k : k + 1])) if colors else curve)
    return found


def column(style: Any, name: str) -> list[Any]:
    """What a style says of each curve; nothing where it does not."""
    batch = getattr(style, name, None)
    return [] if batch is None else batch.as_arrow_array().to_pylist()


# ── pictures ──


def pictures(viewer: Any, blueprint: Any, log: Any, duration_s: float, maximum: int | None = None) -> dict[Any, np.ndarray]:
    """Views of a layout as they are drawn, the cursor at the end of the log, by identifier: all, or of so many tabs."""
    viewer.show(log, blueprint)
    found = {}
    for views in islice(faces(blueprint), maximum):
        viewer.lay_out(blueprint)
        _to_the_end(viewer, duration_s)
        found |= dict(zip([view.id for view in views], viewer.pictures([view.id for view in views]), strict=True))
    return found


def _to_the_end(viewer: Any, duration_s: float) -> None:
    """Moves the cursor; a busy viewer knows of no timeline until it has read what was sent."""
    for waits_left in reversed(range(20)):
        try:
            viewer.client.set_time("elapsed", duration=duration_s, play_state="paused")
            return
        except ConnectionError:
            if not waits_left:
                raise
            time.sleep(0.5)


def unseen(view: Any, picture: np.ndarray, curves: Sequence[Curve]) -> list[str]:
    """The curves that a view is to show and its picture does not."""
    counted = [(curve, pixels(picture, curve)) for curve in shown(view, curves)]
    return [f"{view.name}: {curve.entity} {curve.name} ({count} px)" for curve, count in counted if count < MIN]


def pixels(picture: np.ndarray, curve: Curve) -> int:
    """How many pixels have a curve's colour."""
    near = np.zeros(picture.shape[:2], dtype=bool)
    for color in curve.colors[:: 1 + len(curve.colors) // MAX_COLORS]:
        off = [picture[..., k].astype(np.int32) - int(color[k]) for k in range(3)]
        near |= sum(part * part for part in off) <= WITHIN**2
    return int(near.sum())
