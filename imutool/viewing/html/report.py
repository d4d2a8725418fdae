"""HTML report of logs as one self-contained page, or its pictures as PNG files."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from imutool import __version__
from imutool.errors import ConfigError
from imutool.file_location import Location
from imutool.mcap_io.storage.target import Target
from imutool.viewing.html import report_errors, report_paths, report_signals
from imutool.viewing.html.drawing import HALF_INCH, WIDTH_INCH, Panel, Picture, figure_of, png, require_matplotlib, svg
from imutool.viewing.html.page import cards, document, text
from imutool.viewing.html.report_wording import (
    conclusion,
    figure_label,
    format_number,
    index_of_best,
    key_numbers,
    summary_of_logs,
    worst_orientation_error,
)
from imutool.viewing.model.run_data import RunData
from imutool.viewing.model.trajectory_error import WINDOWS_NOTE

PICTURES: tuple[Callable[[RunData], Picture | None], ...] = (
    report_paths.paths,
    report_paths.error_map,
    report_errors.error_curves,
    report_errors.drift_curves,
    report_signals.signals,
    report_signals.zoom,
    report_signals.biases,
    report_signals.spectrum,
    report_signals.allan_deviation,
    report_errors.event_lanes,
)
EVENTS = "events"  # the picture of them
MAX_COLUMNS = 4  # of a table at half width
NOTHING: Mapping[str, str] = MappingProxyType({})
STYLE = """
h1 { font-size: 22px; color: var(--ink); margin: 0 0 8px; }
h2.log { font-size: 22px; border-top: 2px solid var(--grid); padding-top: 18px; }
h3 { font-size: 17px; margin: 30px 0 4px; break-after: avoid; }
nav { display: flex; flex-wrap: wrap; gap: 4px 16px; font-size: 14px; margin: 10px 0; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 14px 24px; }
.pair > * { min-width: 0; } .pair.wide { grid-template-columns: 1fr; }
.numeric th:not(:first-child), .numeric td:not(:first-child) { text-align: right; }
.numeric th { white-space: normal; vertical-align: bottom; overflow-wrap: anywhere; }
.numeric td:first-child { min-width: 130px; } @media screen { .numeric th:not(:first-child) { min-width: 5.5em; } }
 .numeric .word { text-align: left !important; }
@media screen and (min-width: 900px) { .numeric td:first-child { white-space: nowrap; } }
td.best { font-weight: 700; color: var(--after); }
summary { cursor: pointer; font-size: 15px; padding: 8px 0; color: var(--soft); }
@media (max-width: 600px) { main { padding: 14px 12px 40px; } .conclusion { font-size: 17px; } }
@media print { @page { size: A4; margin: 12mm; } body { font-size: 12px; } nav, summary { display: none; }
  .pair { grid-template-columns: 1fr 1fr; gap: 8px 12px; } h2.log { break-before: page; } .conclusion { font-size: 16px; }
  table, dl { font-size: 11px; } th, td { padding: 3px 8px 3px 0; } h3 { margin-top: 16px; }
  section > .note, section > h3 { break-after: avoid; } .note { font-size: 11px; }
  details::details-content { content-visibility: visible; display: block; block-size: auto; } a { color: inherit; } }
"""


def page(logs: Sequence[RunData], drawn: Mapping[str, str] = NOTHING) -> str:
    """HTML of the report; several logs are compared first.

    No request leaves the page, it needs no script, and text from the logs is escaped. Parts without data (truth, models,
    events) are left out. What is `drawn` already is not drawn again.

    Raises:
        ConfigError: no logs, or matplotlib is not installed.
    """
    if not logs:
        raise ConfigError("no log is given", where="report", expected="at least one")
    require_matplotlib()
    if len(logs) == 1:
        body = [f"<h1>{text(logs[0].name)}</h1>", *_log(logs[0], "log1", drawn, alone=True), *_made()]
        return document(logs[0].name, body, STYLE)
    body = [f"<h1>{len(logs)} logs</h1>", f'<p class="conclusion">{text(summary_of_logs(logs))}</p>', *_compared(logs)]
    for k, data in enumerate(logs, start=1):
        body += [f'<h2 class="log" id="log{k}">{text(data.name)}</h2>', *_log(data, f"log{k}", drawn, alone=False)]
    return document(f"{len(logs)} logs", [*body, *_made()], STYLE)


def drawings(logs: Sequence[RunData]) -> dict[str, str]:
    """Drawings of the page by identifier, but for those of events: a diagnosis adds some later."""
    return {
        name: _svg(panel, picture.name, k)
        for number, data in enumerate(logs, start=1)
        for picture in _pictures(data)
        if picture.name != EVENTS
        for k, panel in enumerate(picture.panels)
        for name in [f"log{number}-{picture.name}-{k}"]
    }


def write_page(logs: Sequence[RunData], path: Location, *, drawn: Mapping[str, str] = NOTHING, overwrite: bool = False) -> None:
    """Write the page (ConfigError: as `page`, or the file exists or cannot be written)."""
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(page(logs, drawn).encode())


def write_pngs(data: RunData, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Write every picture of the page as NAME-paths.png and so on, and return their paths.

    Raises:
        ConfigError: matplotlib is not installed, or a file exists (without `overwrite`) or cannot be written.
    """
    require_matplotlib()
    pictures = _pictures(data)
    paths = [folder / f"{file_name(data.name)}-{picture.name}.png" for picture in pictures]
    existing = [path for path in paths if path.exists()]
    if existing and not overwrite:  # before anything is drawn
        raise ConfigError("the target exists", where=existing[0], fix="Choose another folder, or add `overwrite`")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=folder, expected="a folder") from error
    for path, picture in zip(paths, pictures, strict=True):
        with Target(path, overwrite=overwrite) as target:
            target.write(png(picture, f"{data.name}: {picture.title}"))
    return paths


def file_name(name: str) -> str:
    """File name for a log: its name without separators, leading dots and unsafe characters."""
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".-")[:100] or "_"


def with_unique_names(logs: Sequence[RunData]) -> list[RunData]:
    """Number logs whose files would have one name, such as a raw log and the debiased one of it."""
    named: dict[str, RunData] = {}
    for data in logs:
        names = (data.name, *(f"{data.name[:80]} {number}" for number in range(2, len(logs) + 1)))
        name = next(name for name in names if file_name(name) not in named)
        named[file_name(name)] = replace(data, name=name)
    return list(named.values())


def name_by_topic(logs: Sequence[RunData], topics: Sequence[str]) -> list[RunData]:
    """Name several IMUs of one log by their topics too; a single one keeps the log's name."""
    if len(logs) < 2:
        return list(logs)
    return [replace(data, name=f"{data.name} {topic}") for data, topic in zip(logs, topics, strict=True)]


def check_target(path: Location, *, overwrite: bool = False) -> None:
    """Check before the work that a page can be written (else a ConfigError)."""
    require_matplotlib()
    Target(path, overwrite=overwrite).abandon()


def _pictures(data: RunData) -> list[Picture]:
    return [picture for make in PICTURES if (picture := make(data)) is not None]


def _log(data: RunData, key: str, drawn: Mapping[str, str], *, alone: bool) -> Iterator[str]:
    """Section of one log; among several logs its pictures are folded on screen."""
    pictures = _pictures(data)
    yield f'<p class="conclusion">{text(conclusion(data))}</p>'
    yield cards(key_numbers(data))
    entries = {picture.name: picture.title for picture in pictures}
    links = [("figures", "Figures")] * bool(data.table()) + list(entries.items()) + [("provenance", "Provenance")]
    yield f'<nav aria-label="Parts of the report about {text(data.name)}">'
    yield "".join(f'<a href="#{key}-{name}">{text(title)}</a>' for name, title in links) + "</nav>"
    width = "pair wide" if len(data.traces) > MAX_COLUMNS else "pair"
    yield f'<div class="{width}">{"".join((*_figures(data, key), *_windows(data)))}</div>'
    yield from (f'<p class="note">{text(note)}</p>' for note in (*data.notes, *report_signals.missing_pictures()))
    if not alone:
        yield "<details><summary>Pictures, events and provenance</summary>"
    for picture in pictures:
        yield from _drawn(picture, key, drawn)
        if picture.name == EVENTS:
            yield from report_errors.event_table(data)
    yield from _provenance(data, key)
    if not alone:
        yield "</details>"


def _drawn(picture: Picture, key: str, drawn: Mapping[str, str]) -> Iterator[str]:
    yield f'<section id="{key}-{picture.name}"><h3>{text(picture.title)}</h3>'
    if picture.caption:
        yield f'<p class="note">{text(picture.caption)}</p>'
    yield '<div class="pair">' if not picture.panels[0].wide else "<div>"
    for k, panel in enumerate(picture.panels):
        name = f"{key}-{picture.name}-{k}"
        yield figure_of(drawn.get(name) or _svg(panel, picture.name, k), name, label=panel.label)
    yield "</div></section>"


def _svg(panel: Panel, picture: str, number: int) -> str:
    width = WIDTH_INCH if panel.wide else HALF_INCH
    return svg(panel.draw, panel.height_inch, f"{picture}-{number}", width_inch=width)


def _figures(data: RunData, key: str) -> Iterator[str]:
    """Table of the errors of every run, the best of each marked."""
    rows = [(name, values) for name, values in data.table() if name not in ("samples", "duration_s")]
    rows = [(name, values) for name, values in rows if any(value is not None for value in values)]
    if not rows:
        return
    head = "".join(f"<th>{text(name)}</th>" for name in ("", *(trace.name for trace in data.traces)))
    yield f'<section id="{key}-figures"><h3>Figures</h3>'
    yield f'<div class="scroll"><table class="numeric"><thead><tr>{head}</tr></thead><tbody>'
    for name, values in rows:
        yield f"<tr><td>{text(figure_label(name))}</td>{_cells(values, index_of_best(values, name))}</tr>"
    counted = {trace.name: trace.figures for trace in data.traces if trace.figures}
    samples, seconds = next(((figures["samples"], figures["duration_s"]) for figures in counted.values()), (0, 0.0))
    yield f'</tbody></table></div><p class="note">Root mean squares over {samples:,} samples in {format_number(seconds)} s '
    yield "from the true start, and means over stretches of the true path; the best in bold.</p></section>"


def _cells(values: Sequence[float | None], marked: int | None) -> str:
    """Numbers as cells, with all digits in a tooltip."""
    out = []
    for k, value in enumerate(values):
        kind = 'class="number best"' if k == marked else 'class="number"'
        tooltip = "" if value is None else f' title="{value!r}"'
        out.append(f"<td {kind}{tooltip}>{format_number(value)}</td>")
    return "".join(out)


def _windows(data: RunData) -> Iterator[str]:
    """Table of the drift over windows that each start from the truth."""
    lengths = sorted({window.length_s for trace in data.traces for window in trace.windows})
    if not lengths:
        return
    runs = [trace for trace in data.traces if trace.windows]
    quantities = (("orientation_deg", "°"), ("velocity_m_s", "m/s"), ("position_m", "m"))
    head = "".join(f"<th>{text(name)}</th>" for name in ("", *(trace.name for trace in runs)))
    yield "<section><h3>Drift from a true start</h3>"
    yield f'<div class="scroll"><table class="numeric"><thead><tr>{head}</tr></thead><tbody>'
    for name, unit in quantities:
        for length in lengths:
            windows = [next((w for w in trace.windows if w.length_s == length), None) for trace in runs]
            values = [None if window is None else float(getattr(window, name)) for window in windows]
            values = [value if value is not None and np.isfinite(value) else None for value in values]
            if all(value is None for value in values):
                continue
            words = f"{name.split('_')[0].capitalize()} after {length:g} s ({unit})"
            yield f"<tr><td>{words}</td>{_cells(values, index_of_best(values, name))}</tr>"
    yield f'</tbody></table></div><p class="note">{WINDOWS_NOTE}</p>'
    yield "</section>"


def _compared(logs: Sequence[RunData]) -> Iterator[str]:
    """Table with one row for every run of every log."""
    head = ("Log", "Run", "Seconds", "Orientation error (°)", "Position error (m)", "Velocity error (m/s)", "Largest (°)")
    yield '<div class="scroll"><table class="numeric"><thead><tr>'
    yield "".join(f"<th{' class=word' * (title == 'Run')}>{title}</th>" for title in head) + "</tr></thead><tbody>"
    for k, data in enumerate(logs, start=1):
        best = index_of_best([trace.figures.get("aoe_deg") for trace in data.traces], "aoe_deg")
        for row, trace in enumerate(data.traces):
            worst = worst_orientation_error(trace, data)
            values = [trace.figures.get(name) for name in ("aoe_deg", "ape_m", "velocity_rmse_m_s")]
            cells = _cells([*values, None if worst is None else worst[0]], 0 if row == best else None)
            name = f'<td><a href="#log{k}">{text(data.name)}</a></td><td class=word>{text(trace.name)}</td>'
            yield f"<tr>{name}<td class=number>{format_number(data.duration_s)}</td>{cells}</tr>"
    yield "</tbody></table></div>"


def _provenance(data: RunData, key: str) -> Iterator[str]:
    yield f'<section id="{key}-provenance"><h3>Provenance</h3>'
    yield "<dl>"
    for name, words in data.provenance.items():
        yield f"<dt>{text(name)}</dt><dd>{text(words)}</dd>"
    for trace in data.models():
        gyro, accel = (
            ", ".join(f"{b:+.4g}" for b in bias.mean(axis=0)) for bias in (trace.run.gyro_bias, trace.run.accel_bias)
        )
        yield f"<dt>mean bias, {text(trace.name)}</dt><dd>gyro ({gyro}) rad/s, accel ({accel}) m/s²</dd>"
    yield "</dl></section>"


def _made() -> Iterator[str]:
    """Versions of the software that made the page."""
    drawn = f"numpy {np.__version__}, matplotlib {require_matplotlib().__version__}"
    yield f'<p class="note">Made by imutool {text(__version__)}, Python {platform.python_version()}, {drawn}.</p>'
