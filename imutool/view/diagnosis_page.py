"""One page about a diagnosis that a person reads in a minute: the conclusion, what was found, where, before and after."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape
from pathlib import Path

from imutool import __version__
from imutool.mcap_io.target import Target
from imutool.physics.conclusion import (
    WITH_ALL,
    before_after,
    came_closer,
    conclusion,
    does,
    measured,
    name,
    p_value,
    percent,
    remains,
    unseen,
    where,
)
from imutool.physics.diagnosis import SCHEMA, UNITS, Diagnosis, Finding, Traces
from imutool.physics.quantity import SHOWN, each, grouped, symbol
from imutool.view import diagnosis_figures as figures
from imutool.view import diagnosis_paths

BAR_PIXELS = 80.0
MOST_LOGS = 4  # that are drawn one by one; what is pooled takes all
# Okabe and Ito's palette, on dark a little lighter; red, green and blue are the axes as in the viewer
STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1a1a1a; --soft: #666; --grid: #ddd; --panel: #f4f5f7;
  --before: #d55e00; --after: #0072b2; --mark: #e6a700; --held: #7a7a7a; --x: #d33; --y: #2a9d4a; --z: #36c; }
@media (prefers-color-scheme: dark) { :root { --paper: #15181c; --ink: #e6e6e6; --soft: #a0a4aa; --grid: #3a3f46;
  --panel: #20242a; --before: #ff8c3a; --after: #56b4e9; --mark: #f0c040; --held: #9a9a9a; } }
@media print { :root { --paper: #fff; --ink: #000; --soft: #444; --grid: #ccc; --panel: #fff; --before: #d55e00;
  --after: #0072b2; --mark: #e6a700; --held: #7a7a7a; } main { max-width: none; padding: 0; }
  .findings { min-width: 0 !important; font-size: 11px; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1200px; margin: 0 auto; padding: 20px 25px 60px; }
h1 { font-size: 15px; font-weight: 600; color: var(--soft); margin: 0 0 6px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 34px 0 6px; break-after: avoid; }
.conclusion { font-size: 20px; line-height: 1.4; margin: 0 0 14px; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; vertical-align: top; padding: 6px 12px 6px 0; border-bottom: 1px solid var(--grid);
  overflow-wrap: anywhere; }
th { font-weight: 600; color: var(--soft); white-space: nowrap; }
.findings { table-layout: fixed; min-width: 900px; }
.findings th:nth-child(1) { width: 26%; } .findings th:nth-child(2) { width: 19%; }
.findings th:nth-child(4) { width: 15%; } .findings th:nth-child(5) { width: 13%; }
td.number, .entry { white-space: nowrap; font-variant-numeric: tabular-nums; }
code { font: 13px/1.4 ui-monospace, "DejaVu Sans Mono", monospace; }
figure { margin: 10px 0 0; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
figcaption, .note { color: var(--soft); font-size: 13px; margin: 4px 0; overflow-wrap: anywhere; }
.key { display: inline-block; width: 14px; height: 10px; border-radius: 2px; margin: 0 5px 0 10px; }
.bar { display: inline-block; height: 8px; background: var(--after); border-radius: 2px; margin-left: 8px; }
.bar, .key { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 18px; font-size: 14px; margin: 6px 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
"""
POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # the page asks nobody for anything, whatever a log is called
BEFORE = '<span class="key" style="background: var(--before)"></span>before'
AFTER = '<span class="key" style="background: var(--after)"></span>with what was found'
DIFFERENCE = '<span class="key" style="background: var(--before)"></span>real minus expected'
HELD = '<span class="key" style="background: var(--held); opacity: 0.5"></span>time that no fit has seen'


def write(d: Diagnosis, path: Path, *, overwrite: bool = False) -> None:
    """Writes the page: one file without any request to elsewhere, for light and dark screens and for paper.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(html(d).encode())


def html(d: Diagnosis) -> str:
    """The page of `write` as text.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    logs = ", ".join(Path(one).name for one in d.real)
    against = (
        f"against {Path(d.sim).name}"
        if d.sim is not None
        else f"against {'its' if len(d.real) == 1 else 'their'} own true poses"
    )
    body = [
        f"<h1>{text(logs)} {text(against)}</h1>",
        f'<p class="conclusion">{text(conclusion(d))}</p>',
        *(f'<p class="note">{text(one)}</p>' for one in d.remarks),
        *_findings(d),
        *_places(d),
        *_before_and_after(d),
        *_curves(d),
        *_left(d),
        *_provenance(d),
    ]
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Diagnosis of {text(logs)}</title><style>{STYLE}</style>"
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body><main>\n' + "\n".join(body) + "\n</main></body></html>\n"
    )


def text(words: str) -> str:
    """Words from anywhere, logs included, as text of the page: no markup, no letter that hides or turns others."""
    return escape("".join(c if c.isprintable() else repr(c)[1:-1] for c in words))


def _findings(d: Diagnosis) -> Iterator[str]:
    if not d.findings:
        return
    head = "".join(f"<th>{one}</th>" for one in ("What", "Equation", "Value", "Removes", "How sure"))
    yield "<h2>What was left out</h2>"
    yield f'<div class="scroll"><table class="findings"><thead><tr>{head}</tr></thead><tbody>'
    for one in d.findings:
        cells = [
            f"<strong>{text(name(one))}</strong> {text(one.signal)}<br>{text(does(d, one))}{_similar(one)}",
            f"<code>{text(one.equation)}</code>",
            _values(one),
            _gain(one),
            f"{text(p_value(one.p_value))}<br>false discovery <span class=entry>{percent(one.false_discovery_rate)}</span>",
        ]
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    yield "</tbody></table></div>"


def _gain(one: Finding) -> str:
    """The share of the misfit as a number and a bar, and the root mean squares behind it."""
    if not measured(one):
        return "–"
    width = 0 if math.isnan(one.share) else round(BAR_PIXELS * min(max(one.share, 0.0), 1.0))
    unseen = text(before_after(one.held_out).removesuffix(" of unseen data"))
    return f'{percent(one.share)}<span class="bar" style="width: {width}px"></span><br>{unseen}'


def _similar(one: Finding) -> str:
    return f"<br>could as well be {text(' or '.join(one.similar))}" if one.similar else ""


def _values(one: Finding) -> str:
    """Every parameter, all entries of a matrix too; a curve is drawn instead."""
    if one.curve is not None:
        return f"a curve of {text(one.curve.variable)}, drawn below"
    out = []
    for quantity in grouped(one.parameters):
        if len(quantity.estimates) <= SHOWN:
            out.append(text(quantity.labelled))
        else:
            entries, unit = each(quantity.estimates, quantity.axes)
            listed = "; ".join(f"<span class=entry>{text(entry)}</span>" for entry in entries)
            out.append(f"{text(quantity.label)} {listed} {text(unit)}".strip())
    return "<br>".join(out)


def _places(d: Diagnosis) -> Iterator[str]:
    if not d.located:
        return
    yield "<h2>Where it lies</h2>"
    rows = "".join(
        f"<tr><td>{text(where(one))}</td><td class=number>{percent(one.share)}</td>"
        f"<td class=number>{text(p_value(one.p_value))}</td></tr>"
        for one in d.located
    )
    head = "<tr><th>Signal, regime, time</th><th>Share of the misfit</th><th>Chance</th></tr>"
    yield f'<div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    for k, trace in enumerate(d.traces[:MOST_LOGS]):
        caption = (
            f"{text(trace.log)}: local size of the misfit, by axis (each sensor to its own largest). "
            '<span class="key" style="background: var(--mark)"></span>where it was located' + HELD
        )
        yield _figure(figures.where(d, trace), f"w{k}", caption)


def _before_and_after(d: Diagnosis) -> Iterator[str]:
    if not d.traces:
        return
    found = bool(d.findings)
    both = BEFORE + AFTER if found else DIFFERENCE
    over = "unseen time of all logs" if any(one.held_out.any() for one in d.traces) else "all time: none was held out"
    yield f"<h2>{'Before and after' if found else 'What separates the two'}</h2>"
    for k, trace in enumerate(d.traces[:MOST_LOGS]):
        yield _figure(figures.residual(trace, found=found), f"r{k}", f"{text(trace.log)}: over time. {both}{HELD}")
    if len(d.traces) > MOST_LOGS:
        yield f'<p class="note">The first {MOST_LOGS} of {len(d.traces)} logs are drawn; all are in the .rrd.</p>'
    spectrum, rate, attitude = figures.spectrum(d), figures.against_rate(d), figures.against_attitude(d)
    if spectrum is not None:
        yield _figure(
            spectrum, "s", f"Spectrum over {over} (Welch, mean of the axes); dashed: white noise of the floor's size. {both}"
        )
    else:
        yield '<p class="note">No unseen stretch is long enough for a spectrum.</p>'
    paths = diagnosis_paths.paths(d)
    if paths is not None:
        true = '<span class="key" style="background: var(--ink); opacity: 0.4"></span>true'
        yield _figure(
            paths, "p", f"Integrated from the true start of each stretch of {over}; drift as root mean square.{true}{both}"
        )
    bands = "means in bins, with two standard errors"
    if rate is not None:
        yield _figure(rate, "t", f"Against turning rate over {over}: {bands}. {both}")
    if attitude is not None:
        yield _figure(attitude, "a", f"Against attitude over {over}: {bands}. {both}")
    else:
        yield '<p class="note">No attitude is known, so nothing is drawn against it.</p>'


def _curves(d: Diagnosis) -> Iterator[str]:
    for k, one in enumerate(d.findings):
        if one.curve is not None:
            yield "<h2>A misfit without a name</h2>"
            caption = f"{text(one.equation)}: a smooth curve of {text(one.curve.variable)}, with one standard deviation"
            yield _figure(figures.curve(one.curve, one.signal), f"c{k}", caption)


def _left(d: Diagnosis) -> Iterator[str]:
    if d.unexplained:
        yield "<h2>What remains</h2>"
        head = "".join(f"<th>{one}</th>" for one in ("Signal", "Remains (rms)", "Noise (rms)", "Ratio", ""))
        units = {one.signal: one.held_out.unit for one in d.findings} | UNITS
        rows = []
        for signal, one in d.unexplained.items():
            unit = symbol(units.get(signal, ""))
            ratio = f"{one.rms / one.noise_floor:.2f}" if one.noise_floor > 0.0 else "–"
            numbers = (f"{one.rms:.3g} {unit}", f"{one.noise_floor:.3g} {unit}", ratio)
            cells = "".join(f"<td class=number>{text(number)}</td>" for number in numbers)
            rows.append(f"<tr><td>{text(signal)}</td>{cells}<td>{text(remains(one, unit))}</td></tr>")
        yield f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    if d.closer and d.findings:
        yield f"<h2>How much closer it comes</h2><p class=note>{text(WITH_ALL + unseen(d))}.</p><dl>"
        for signal, again in d.closer.items():
            yield f"<dt>{text(signal)}</dt><dd>{text(came_closer(again))}</dd>"
        yield "</dl>"


def _provenance(d: Diagnosis) -> Iterator[str]:
    yield "<h2>What this is about</h2><dl>"
    for real in d.real:
        yield f"<dt>real</dt><dd>{text(real)}</dd>"
    yield f"<dt>expected from</dt><dd>{text(d.sim) if d.sim is not None else 'the true poses of the recording itself'}</dd>"
    for trace in d.traces:
        yield f"<dt>samples</dt><dd>{text(_samples(trace))}</dd>"
    for bias in d.bias:
        gyro, accel = (", ".join(f"{b:+.4g}" for b in part) for part in (bias[:3], bias[3:]))
        yield f"<dt>constant bias</dt><dd>gyro ({gyro}) rad/s, accel ({accel}) m/s²</dd>"
    if d.not_identifiable:
        yield f"<dt>the motion cannot show</dt><dd>{text(', '.join(d.not_identifiable))}</dd>"
    yield f"<dt>made by</dt><dd>imutool {text(__version__)}, {SCHEMA}</dd></dl>"


def _samples(trace: Traces) -> str:
    unseen = float(trace.held_out.mean()) * float(trace.t_s[-1] - trace.t_s[0])
    span = f"{trace.t_s[0]:.1f} to {trace.t_s[-1]:.1f} s"
    return f"{trace.log}: {len(trace.t_s)} at {figures.rate_hz(trace):.0f} Hz, {span}, {unseen:.0f} s of it unseen by any fit"


def _figure(svg: str, prefix: str, caption: str) -> str:
    return f"<figure>{figures.apart(svg, prefix)}<figcaption>{caption}</figcaption></figure>"
