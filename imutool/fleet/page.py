"""HTML page about a fleet: intact logs, the others with the reason, and histograms."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from imutool import __version__
from imutool.array_types import Float64
from imutool.file_location import Location, is_file
from imutool.fleet.results import MAX_ROWS, TROUBLE, Statistics
from imutool.fleet.robots import FEWEST, Comparison, Outlier
from imutool.fleet.task import Result, Settings
from imutool.mcap_io.storage.target import Target
from imutool.units import UNITS
from imutool.viewing.html.drawing import figure_of, svg
from imutool.viewing.html.page import AFTER, AXIS_COLORS, cards, document, text

MAX_NAMED = 10  # robots with an effect
EQUAL = 1e-6  # of the largest of several values, by which they may differ
BINS = 30
OWN_STYLE = """
.failed, .quarantined, .lost { font-weight: 600; border-left: 4px solid var(--mark); padding-left: 8px; white-space: nowrap; }
.failed { border-left-color: var(--before); } td.log { min-width: 9em; } td.log + td { min-width: 16em; }
@media (min-width: 900px) { td.log { min-width: 24em; } }
"""


@dataclass(frozen=True)
class Links:
    """Links from the page to files below OUT.

    They are relative if both are on one disk, so that both can move together.
    """

    page: Location
    out: Location

    def to(self, name: str) -> str:
        """URL of a file, escaped."""
        if isinstance(self.page, Path) and isinstance(self.out, Path):
            return quote(Path(os.path.relpath(self.out / name, self.page.parent.absolute())).as_posix())
        return quote(str(self.out / name), safe="/:")


def write(
    results: Iterable[Result],
    settings: Settings,
    path: Location,
    *,
    out: Location,
    seconds: float,
    source: str,
    comparison: Comparison | None = None,
    overwrite: bool = False,
) -> None:
    """Write the page as one HTML file without external requests.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:
        link = Links(path, out)
        target.write(html(results, settings, link=link, seconds=seconds, source=source, comparison=comparison).encode())


def is_page(path: Location) -> bool:
    """Whether a file is a page about a fleet."""
    if not is_file(path):
        return False
    with path.open("rb") as file:
        return b"<title>Fleet " in file.read(4096)


def html(
    results: Iterable[Result],
    settings: Settings,
    *,
    seconds: float,
    source: str,
    link: Links | None = None,
    comparison: Comparison | None = None,
) -> str:
    """HTML text of the page; with `link` it has links to the pages of the logs."""
    statistics = Statistics()
    for result in results:
        statistics.add(result)
    conclusion = [*([] if comparison is None else [comparison.summary]), _how_whole(statistics)]
    body = [
        f"<h1>imutool fleet {text(settings.command)} of {text(source)}</h1>",
        f'<p class="conclusion">{text(" ".join(conclusion))}</p>',
        *_numbers(statistics, seconds),
        *(_outliers(comparison) if comparison is not None else ()),
        *_trouble(statistics),
        *(_logs(statistics, link) if link is not None else ()),
        *_warnings(statistics),
        *_spread(statistics),
        *_provenance(settings),
    ]
    return document(f"Fleet {settings.command}: {source}", body, OWN_STYLE)


def _how_whole(statistics: Statistics) -> str:
    logs = statistics.statuses.total() - statistics.statuses["skipped"]
    cells = [f"{statistics.statuses[name]} {name}" for name in TROUBLE if statistics.statuses[name]]
    if not cells:
        return f"All {logs} logs are whole." if logs != 1 else "The log is whole."
    lost = " (the rest of each was kept)" if statistics.statuses["lost"] else ""
    return f"Of {logs} logs {statistics.statuses['ok']} are whole; {', '.join(cells)}{lost}."


def _numbers(statistics: Statistics, seconds: float) -> Iterator[str]:
    cells = [
        (f"{statistics.statuses.total() - statistics.statuses['skipped']:,}", "logs"),
        (size(statistics.bytes_in), "read"),
        (size(statistics.bytes_out), "written"),
        (duration(seconds), "this run"),
    ]
    if statistics.messages:
        cells.append((f"{statistics.messages:,}", "messages"))
    if statistics.statuses["skipped"]:
        cells.append((f"{statistics.statuses['skipped']:,}", "done by an earlier run"))
    if statistics.seconds:
        cells.append((f"{np.median(statistics.speeds):.3g} MB/s", "median speed of a worker"))
    if statistics.peak_bytes:
        cells.append((size(statistics.peak_bytes), "most memory of a worker"))
    yield cards(cells)


def _trouble(statistics: Statistics) -> Iterator[str]:
    if not statistics.trouble:
        return
    yield "<h2>Not whole</h2>"
    alike = os.path.commonprefix([result.source for result in statistics.trouble])  # noqa: RUF071  commonpath takes no URL
    below, rows = alike[: alike.rfind("/") + 1], []
    yield f'<p class="note">Logs below {text(below)}</p>' if below else ""
    order = {name: k for k, name in enumerate(TROUBLE)}
    for result in sorted(statistics.trouble, key=lambda r: (order[r.earlier or r.status], r.source)):
        status = result.earlier or result.status
        why = result.error or "; ".join(result.losses) or "; ".join(result.warnings)
        name, why = result.source.removeprefix(below), why.removeprefix(result.source).lstrip(": ")
        rows.append(f'<tr><td class="{status}">{status}</td><td class="log">{text(name)}</td><td>{text(why)}</td></tr>')
    head = "<th>Status</th><th>Log</th><th>Why</th>"
    yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    more = sum(statistics.statuses[name] for name in TROUBLE) - len(statistics.trouble)
    if more:
        yield f'<p class="note">{more:,} more are in fleet.parquet.</p>'


def _logs(statistics: Statistics, link: Links) -> Iterator[str]:
    """Table of the logs that have a page, with links."""
    if not statistics.drawn:
        return
    yield "<h2>Logs</h2>"
    rows = "".join(
        f'<tr><td class="log"><a href="{text(link.to(result.page))}">{text(result.page.removesuffix(".html"))}</a></td>'
        f"<td>{text(result.page_says)}</td></tr>"
        for result in statistics.drawn
    )
    head = "<th>Log</th><th>What its page says</th>"
    yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    if statistics.pages > len(statistics.drawn):
        yield f'<p class="note">{statistics.pages - len(statistics.drawn):,} more pages are next to their logs.</p>'


def _warnings(statistics: Statistics) -> Iterator[str]:
    if not statistics.warnings:
        return
    yield "<h2>What is said of logs</h2>"
    rows = "".join(
        f"<tr><td class=number>{count:,}</td><td>{text(words)}</td><td>{text(statistics.first_warned[words])}</td></tr>"
        for words, count in statistics.warnings.most_common(50)
    )
    yield f"<table><thead><tr><th>Logs</th><th>Warning</th><th>The first of them</th></tr></thead><tbody>{rows}</tbody></table>"


def _outliers(comparison: Comparison) -> Iterator[str]:
    yield "<h2>Robots unlike the others</h2>"
    if not comparison.outliers:
        yield f'<p class="note">{"None." if comparison.robots >= FEWEST else "Nobody can tell among so few."}</p>'
    else:
        head = "".join(f"<th>{row}</th>" for row in ("Robot", "What", "Here", "The others", "Distance", "False discovery"))
        rows = "".join(_outlier(row) for row in comparison.outliers[:MAX_ROWS])
        yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    if comparison.shared:
        yield "<h2>What all share</h2>"
        head = "".join(f"<th>{row}</th>" for row in ("Effect", "Middle of the robots ± their spread", "Robots"))
        rows = "".join(
            f"<tr><td>{text(row.label)}</td><td class=number>{text(row.text)}</td><td class=number>{row.robots}</td></tr>"
            for row in comparison.shared
        )
        yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    if comparison.effects:
        yield "<h2>What else was found</h2>"
        rows = "".join(
            f"<tr><td>{text(name.replace('_', ' '))}</td><td class=number>{len(robots)} of {comparison.robots}</td>"
            f"<td>{text(', '.join(robots[:MAX_NAMED]))}{', …' if len(robots) > MAX_NAMED else ''}</td></tr>"
            for name, robots in comparison.effects.items()
        )
        yield f"<table><thead><tr><th>Effect</th><th>Robots</th><th>Which</th></tr></thead><tbody>{rows}</tbody></table>"


def _outlier(outlier: Outlier) -> str:
    cells = (outlier.robot, outlier.label, outlier.here, outlier.others)
    numbers = (f"{outlier.sigma:.1f} σ", f"{outlier.false_discovery_rate:.1g}")
    return (
        "<tr>"
        + "".join(f"<td>{text(cell)}</td>" for cell in cells)
        + "".join(f"<td class=number>{text(cell)}</td>" for cell in numbers)
        + "</tr>"
    )


def _spread(statistics: Statistics) -> Iterator[str]:
    if len(statistics.seconds) < 2:
        return
    yield "<h2>Distribution over the logs</h2>"
    for k, (signal, values) in enumerate(statistics.biases.items()):
        if len(values) > 1:
            rows = np.array(values)
            caption = f"Initial bias of the {signal} over {len(rows)} IMUs, by axis"
            yield figure_of(_axes(rows, f"{signal} bias ({UNITS[signal]})"), f"b{k}", text(caption))
    times = [(statistics.seconds, "seconds a log"), (statistics.speeds, "MB/s of one worker")]
    yield figure_of(_histograms(times, "times"), "t", "Time and speed by log")
    if len(statistics.scores) > 1 and min(statistics.scores) < max(statistics.scores):
        yield figure_of(_histograms([(statistics.scores, "quality score")], "scores"), "q", "Quality")


def _axes(rows: Float64[np.ndarray, "n 3"], label: str) -> str:
    def draw(figure: Any) -> None:
        for k, axes in enumerate(figure.subplots(1, 3)):
            _histogram(axes, rows[:, k], f"{'xyz'[k]}: {label}", AXIS_COLORS[k])
            axes.locator_params(axis="x", nbins=3)  # a bias such as -0.01995 takes a third of the width

    return svg(draw, 2.2, label)


def _histograms(columns: Sequence[tuple[Sequence[float], str]], name: str) -> str:
    def draw(figure: Any) -> None:
        for axes, (values, label) in zip(np.atleast_1d(figure.subplots(1, len(columns))), columns, strict=True):
            _histogram(axes, np.array(values), label, AFTER)
            axes.set_xlim(left=max(0.0, axes.get_xlim()[0]))  # no time, speed or score is negative

    return svg(draw, 2.2, name)


def _histogram(axes: Any, values: Float64[np.ndarray, " n"], label: str, color: str) -> None:
    span, largest = float(np.ptp(values)), float(np.abs(values).max())
    span = span if span > EQUAL * largest else largest or 1.0  # equal values: as wide as they are large
    first, last = values.min() - 0.05 * span, values.max() + 0.05 * span
    axes.hist(values, bins=min(BINS, max(5, len(values) // 2)), range=(first, last), color=color, alpha=0.7)
    axes.set(xlabel=label, ylabel="logs")
    axes.set_axisbelow(True)
    axes.locator_params(axis="x", nbins=5)
    axes.locator_params(axis="y", nbins=4, integer=True)


def _provenance(settings: Settings) -> Iterator[str]:
    yield "<h2>What was done</h2><dl>"
    entries = {
        "command": settings.command,
        "model": settings.model or "as each log says",
        "model sha256": settings.model_sha256 if settings.model else "",
    }
    if settings.command == "debias":
        words = {True: "yes", False: "no"}
        entries |= {"init": settings.init, "smooth": words[settings.smooth], "clean": words[settings.clean]}
        entries |= {"unfit models": "used" if settings.force else "refused"}
        entries["verified"] = f"structure, and contents: {settings.check}"
    if settings.command == "diagnose":
        entries |= {"robots": settings.robot_from or "by folder", "compared with": settings.sim or "the true poses"}
    entries |= {"IMU": ", ".join(settings.imus), "truth": settings.truth or ""}
    for name, value in entries.items():
        if value and (settings.command == "debias" or not name.startswith("model")):
            yield f"<dt>{text(name)}</dt><dd>{text(value)}</dd>"
    yield f"<dt>made by</dt><dd>imutool {text(__version__)}</dd></dl>"


def size(count: int) -> str:
    """File size with its unit: `52.6 MB`."""
    units = ("B", "kB", "MB", "GB", "TB", "PB")
    value, step = float(count), 0
    while value >= 999.5 and step < len(units) - 1:
        value, step = value / 1000.0, step + 1
    return f"{value:.3g} {units[step]}"


def duration(seconds: float) -> str:
    """Duration as text: `37.9 s`, `12:05 min`, `3:20 h`."""
    if seconds < 60.0:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    return f"{whole // 60}:{whole % 60:02d} min" if whole < 3600 else f"{whole // 3600}:{whole % 3600 // 60:02d} h"
