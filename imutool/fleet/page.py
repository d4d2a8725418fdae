"""One page about a fleet: how much of it is whole, which logs are not and why, and how what was found is spread."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jaxtyping import Float64

from imutool import __version__
from imutool.fleet.robots import FEWEST, Compared, Outlier
from imutool.fleet.task import Result, Settings
from imutool.location import Location
from imutool.mcap_io.storage.target import Target
from imutool.units import UNITS
from imutool.viewing.html.drawing import prefix_ids, svg
from imutool.viewing.html.page import AFTER, AXIS_COLORS, cards, document, text

MOST_ROWS = 500  # in a table: more is for the Parquet file
MOST_NAMED = 10  # robots with an effect
BINS = 30
TROUBLE = ("failed", "quarantined", "lost")
OWN_STYLE = """
.failed { color: var(--before); font-weight: 600; } .quarantined, .lost { color: var(--mark); font-weight: 600; }
"""


@dataclass(frozen=True)
class Links:
    """The way from the page to what lies below OUT: relative where both are on one disk, so that both can be moved together."""

    page: Location
    out: Location | None

    def to(self, name: str) -> str:
        """An address that a browser takes as it is, whatever the log is called."""
        if isinstance(self.page, Path) and isinstance(self.out, Path):
            there = os.path.relpath(self.out / name, self.page.parent.absolute())
            return quote(Path(there).as_posix())
        return quote(str(self.out / name if self.out is not None else name), safe="/:")


@dataclass
class _Seen:
    """What one pass over the results gathers: numbers for the pictures, and the rows that are told."""

    statuses: Counter[str] = field(default_factory=Counter)
    bytes_in: int = 0
    bytes_out: int = 0
    messages: int = 0
    seconds: list[float] = field(default_factory=list)
    speeds: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    biases: dict[str, list[tuple[float, ...]]] = field(default_factory=lambda: {"gyro": [], "accel": []})
    warnings: Counter[str] = field(default_factory=Counter)
    trouble: list[Result] = field(default_factory=list)
    peak_bytes: int = 0
    drawn: list[Result] = field(default_factory=list)
    pages: int = 0

    def take(self, one: Result) -> None:
        status = one.earlier if one.status == "skipped" and one.earlier else one.status
        self.statuses[status] += 1
        self.statuses["skipped"] += one.status == "skipped"
        self.peak_bytes = max(self.peak_bytes, one.peak_bytes)
        if status in TROUBLE and len(self.trouble) < MOST_ROWS:
            self.trouble.append(one)
        if status == "failed":
            return
        self.bytes_in, self.bytes_out = self.bytes_in + one.source_bytes, self.bytes_out + one.target_bytes
        self.messages += one.messages
        self.pages += bool(one.page)
        if one.page and len(self.drawn) < MOST_ROWS:
            self.drawn.append(one)
        self.seconds.append(one.seconds)
        self.speeds.append(one.source_bytes / 1e6 / max(one.seconds, 1e-9))
        if one.score is not None:
            self.scores.append(one.score)
        for imu in one.imus:
            self.biases["gyro"].append(imu.gyro_bias)
            self.biases["accel"].append(imu.accel_bias)
        self.warnings.update({warning.partition(": ")[2] or warning for warning in one.warnings})


def write(
    results: Iterable[Result],
    settings: Settings,
    path: Location,
    *,
    out: Location | None = None,
    seconds: float,
    source: str,
    compared: Compared | None = None,
    overwrite: bool = False,
) -> None:
    """Writes the page: one file without any request to elsewhere, for light and dark screens and for paper.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        link = Links(path, out)
        target.write(html(results, settings, link=link, seconds=seconds, source=source, compared=compared).encode())


def html(
    results: Iterable[Result],
    settings: Settings,
    *,
    seconds: float,
    source: str,
    link: Links | None = None,
    compared: Compared | None = None,
) -> str:
    """The page of `write` as text; with `link` it leads to the pages of the logs."""
    seen = _Seen()
    for one in results:
        seen.take(one)
    body = [
        f"<h1>imutool fleet {text(settings.command)} of {text(source)}</h1>",
        f'<p class="conclusion">{text(_conclusion(seen, compared))}</p>',
        *_numbers(seen, seconds),
        *(_outliers(compared) if compared is not None else ()),
        *_trouble(seen),
        *(_logs(seen, link) if link is not None else ()),
        *_warnings(seen),
        *_spread(seen),
        *_provenance(settings),
    ]
    return document(f"Fleet {settings.command}: {source}", body, OWN_STYLE)


def _conclusion(seen: _Seen, compared: Compared | None) -> str:
    whole = _how_whole(seen)
    return whole if compared is None else f"{compared.summary} {whole}"


def _how_whole(seen: _Seen) -> str:
    logs = seen.statuses.total() - seen.statuses["skipped"]
    told = [f"{seen.statuses[name]} {name}" for name in TROUBLE if seen.statuses[name]]
    if not told:
        return f"All {logs} logs are whole." if logs != 1 else "The log is whole."
    lost = " (the rest of each was kept)" if seen.statuses["lost"] else ""
    return f"Of {logs} logs {seen.statuses['ok']} are whole; {', '.join(told)}{lost}."


def _numbers(seen: _Seen, seconds: float) -> Iterator[str]:
    told = [
        (f"{seen.statuses.total() - seen.statuses['skipped']:,}", "logs"),
        (size(seen.bytes_in), "read"),
        (size(seen.bytes_out), "written"),
        (duration(seconds), "this run"),
    ]
    if seen.messages:
        told.append((f"{seen.messages:,}", "messages"))
    if seen.statuses["skipped"]:
        told.append((f"{seen.statuses['skipped']:,}", "done by an earlier run"))
    if seen.seconds:
        told.append((f"{np.median(seen.speeds):.3g} MB/s", "of one worker, in the middle"))
    if seen.peak_bytes:
        told.append((size(seen.peak_bytes), "most memory of a worker"))
    yield cards(told)


def _trouble(seen: _Seen) -> Iterator[str]:
    if not seen.trouble:
        return
    yield "<h2>Not whole</h2>"
    rows = []
    order = {name: k for k, name in enumerate(TROUBLE)}
    for one in sorted(seen.trouble, key=lambda r: (order[r.earlier or r.status], r.source)):
        status = one.earlier or one.status
        why = one.error or "; ".join(one.losses) or "; ".join(one.warnings)
        rows.append(f'<tr><td class="{status}">{status}</td><td>{text(one.source)}</td><td>{text(why)}</td></tr>')
    yield f"<table><thead><tr><th>Status</th><th>Log</th><th>Why</th></tr></thead><tbody>{''.join(rows)}</tbody></table>"
    more = sum(seen.statuses[name] for name in TROUBLE) - len(seen.trouble)
    if more:
        yield f'<p class="note">{more:,} more are in fleet.parquet.</p>'


def _logs(seen: _Seen, link: Links) -> Iterator[str]:
    """A line for each log that has a page, and the way there."""
    if not seen.drawn:
        return
    yield "<h2>Logs</h2>"
    rows = "".join(
        f'<tr><td><a href="{text(link.to(one.page))}">{text(one.page.removesuffix(".html"))}</a></td>'
        f"<td>{text(one.page_says)}</td></tr>"
        for one in seen.drawn
    )
    yield f"<table><thead><tr><th>Log</th><th>What its page says</th></tr></thead><tbody>{rows}</tbody></table>"
    if seen.pages > len(seen.drawn):
        yield f'<p class="note">{seen.pages - len(seen.drawn):,} more pages lie beside their logs.</p>'


def _warnings(seen: _Seen) -> Iterator[str]:
    if not seen.warnings:
        return
    yield "<h2>What is said of logs</h2>"
    rows = "".join(
        f"<tr><td class=number>{count:,}</td><td>{text(words)}</td></tr>" for words, count in seen.warnings.most_common(50)
    )
    yield f"<table><thead><tr><th>Logs</th><th>Warning</th></tr></thead><tbody>{rows}</tbody></table>"


def _outliers(compared: Compared) -> Iterator[str]:
    yield "<h2>Robots unlike the others</h2>"
    if not compared.outliers:
        yield f'<p class="note">{"None." if compared.robots >= FEWEST else "Nobody can tell among so few."}</p>'
    else:
        head = "".join(f"<th>{one}</th>" for one in ("Robot", "What", "Here", "The others", "Distance", "False discovery"))
        rows = "".join(_outlier(one) for one in compared.outliers[:MOST_ROWS])
        yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    if compared.shared:
        yield "<h2>What all share</h2>"
        head = "".join(f"<th>{one}</th>" for one in ("Effect", "Middle of the robots ± their spread", "Robots"))
        rows = "".join(
            f"<tr><td>{text(one.label)}</td><td class=number>{text(one.told)}</td><td class=number>{one.robots}</td></tr>"
            for one in compared.shared
        )
        yield f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    if compared.effects:
        yield "<h2>What else was found</h2>"
        rows = "".join(
            f"<tr><td>{text(name.replace('_', ' '))}</td><td class=number>{len(robots)} of {compared.robots}</td>"
            f"<td>{text(', '.join(robots[:MOST_NAMED]))}{', …' if len(robots) > MOST_NAMED else ''}</td></tr>"
            for name, robots in compared.effects.items()
        )
        yield f"<table><thead><tr><th>Effect</th><th>Robots</th><th>Which</th></tr></thead><tbody>{rows}</tbody></table>"


def _outlier(one: Outlier) -> str:
    cells = (one.robot, one.label, one.here, one.others)
    numbers = (f"{one.sigma:.1f} σ", f"{one.false_discovery_rate:.1g}")
    return (
        "<tr>"
        + "".join(f"<td>{text(cell)}</td>" for cell in cells)
        + "".join(f"<td class=number>{text(cell)}</td>" for cell in numbers)
        + "</tr>"
    )


def _spread(seen: _Seen) -> Iterator[str]:
    if len(seen.seconds) < 2:
        return
    yield "<h2>How it is spread</h2>"
    for k, (signal, values) in enumerate(seen.biases.items()):
        if len(values) > 1:
            rows = np.array(values)
            caption = f"Start bias of the {signal} over {len(rows)} IMUs, by axis"
            yield _figure(_axes(rows, f"{signal} bias ({UNITS[signal]})"), f"b{k}", caption)
    yield _figure(
        _one([(seen.seconds, "seconds a log"), (seen.speeds, "MB/s of one worker")], "times"), "t", "Time and speed by log"
    )
    if len(seen.scores) > 1 and min(seen.scores) < max(seen.scores):
        yield _figure(_one([(seen.scores, "quality score")], "scores"), "q", "Quality")


def _axes(rows: Float64[np.ndarray, "n 3"], label: str) -> str:
    def draw(figure: Any) -> None:
        for k, axes in enumerate(figure.subplots(1, 3)):
            _histogram(axes, rows[:, k], f"{'xyz'[k]}: {label}", AXIS_COLORS[k])

    return svg(draw, 2.2, label)


def _one(columns: Sequence[tuple[Sequence[float], str]], name: str) -> str:
    def draw(figure: Any) -> None:
        for axes, (values, label) in zip(np.atleast_1d(figure.subplots(1, len(columns))), columns, strict=True):
            _histogram(axes, np.array(values), label, AFTER)

    return svg(draw, 2.2, name)


def _histogram(axes: Any, values: Float64[np.ndarray, " n"], label: str, color: str) -> None:
    axes.hist(values, bins=min(BINS, max(5, len(values) // 2)), color=color, alpha=0.7)
    axes.set(xlabel=label, ylabel="logs")
    axes.set_axisbelow(True)
    axes.locator_params(axis="x", nbins=5)
    axes.locator_params(axis="y", nbins=4, integer=True)


def _figure(drawn: str, prefix: str, caption: str) -> str:
    return f"<figure>{prefix_ids(drawn, prefix)}<figcaption>{text(caption)}</figcaption></figure>"


def _provenance(settings: Settings) -> Iterator[str]:
    yield "<h2>What was done</h2><dl>"
    entries = {
        "command": settings.command,
        "model": settings.model or "as each log says",
        "model sha256": settings.model_sha256,
    }
    if settings.command == "debias":
        said = {True: "yes", False: "no"}
        entries |= {"init": settings.init, "smooth": said[settings.smooth], "clean": said[settings.clean]}
        entries["verified"] = f"structure, and contents: {settings.check}"
    for name, value in entries.items():
        if value and (settings.command == "debias" or not name.startswith("model")):
            yield f"<dt>{text(name)}</dt><dd>{text(value)}</dd>"
    yield f"<dt>made by</dt><dd>imutool {text(__version__)}</dd></dl>"


def size(count: int) -> str:
    """Bytes in a unit that suits them: `52.6 MB`."""
    units = ("B", "kB", "MB", "GB", "TB", "PB")
    value, step = float(count), 0
    while value >= 999.5 and step < len(units) - 1:
        value, step = value / 1000.0, step + 1
    return f"{value:.3g} {units[step]}"


def duration(seconds: float) -> str:
    """`37.9 s`, `12:05 min`, `3:20 h`."""
    if seconds < 60.0:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d} min" if whole < 3600 else f"{whole // 3600}:{whole % 3600 // 60:02d} h"
