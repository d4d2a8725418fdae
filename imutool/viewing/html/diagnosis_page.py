"""HTML page of a diagnosis: conclusion, findings, locations, figures before and after."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from imutool import __version__
from imutool.diagnosis.result import SCHEMA, Diagnosis, Finding, Traces
from imutool.diagnosis.wording.conclusion import (
    chance_text,
    gain_source,
    gain_text,
    headline,
    held_out_time,
    improvement,
    location_text,
    notes,
    residual_text,
    unobservable,
)
from imutool.diagnosis.wording.effect_sentences import effect_sentence, has_gain, label
from imutool.diagnosis.wording.quantity import SHOWN, distinguished, each, grouped, percent, symbol
from imutool.mcap_io.storage.target import Target
from imutool.units import ASCII_UNITS
from imutool.viewing.html import diagnosis_figures as figures
from imutool.viewing.html import diagnosis_paths
from imutool.viewing.html.drawing import figure_of
from imutool.viewing.html.page import document, text

BAR_PIXELS = 80.0
MAX_LOGS = 4  # with figures of their own; pooled figures use all logs
BEFORE = '<span class="key" style="background: var(--before)"></span>before'
AFTER = '<span class="key" style="background: var(--after)"></span>with the findings'
DIFFERENCE = '<span class="key" style="background: var(--before)"></span>real minus expected'
HELD = '<span class="key" style="background: var(--held); opacity: 0.5"></span>time unseen by any fit'


def write(
    d: Diagnosis, path: Path, *, logs: str | None = None, first: Diagnosis | None = None, overwrite: bool = False
) -> None:
    """Write the page as one file from which no request leaves, for screens and paper.

    With `first`, the diagnosis before its physics was simulated, the figures compare that simulation with the one of `d`.

    Raises:
        ConfigError: matplotlib is not installed, or the file exists (without `overwrite`) or cannot be written.
    """
    with Target(path, overwrite=overwrite) as target:  # refuses before the work is done, leaves nothing after a failure
        target.write(html(d, logs=logs, first=first).encode())


def html(d: Diagnosis, *, logs: str | None = None, first: Diagnosis | None = None) -> str:
    """Text of the page of `write`; `logs` names a page about the logs in the same folder.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    names = ", ".join(Path(real).name for real in d.real)
    against = (
        f"against {Path(d.sim).name}"
        if d.sim is not None
        else f"against {'its' if len(d.real) == 1 else 'their'} own true poses"
    )
    body = [
        f"<h1>{text(names)} {text(against)}</h1>",
        f'<p class="conclusion">{text(headline(d))}</p>',
        *(f'<p class="note">{text(line)}</p>' for line in notes(d)),
        *(f'<p class="note">{text(line)}</p>' for line in d.remarks),
        *([f'<p><a href="{text(logs)}">The recordings themselves</a>: signals, spectra, events.</p>'] if logs else []),
        *_findings(d),
        *_locations(d),
        *_before_and_after(d if first is None else _closed(first, d)),
        *_curves(d),
        *_left(d),
        *_provenance(d),
    ]
    return document(f"Diagnosis of {names}", body)


def _findings(d: Diagnosis) -> Iterator[str]:
    if not d.findings:
        return
    head = "".join(f"<th>{title}</th>" for title in ("Effect", "Equation", "Removes", "By chance"))
    yield "<h2>Unmodelled effects</h2>"
    yield f'<div class="scroll"><table class="findings"><thead><tr>{head}</tr></thead><tbody>'
    for finding in d.findings:
        python = f"<pre>{text(finding.python)}</pre>" if finding.python else ""
        similar = f"<br>could as well be {text(' or '.join(finding.similar))}" if finding.similar else ""
        cells = [
            f"<strong>{text(label(finding))}</strong> {text(finding.signal)}<br>{text(effect_sentence(d, finding))}{similar}",
            f"<code>{text(finding.equation)}</code>{python}{_entries(finding)}",
            _gain(finding),
            f"<span class=entry>{text(chance_text(finding.false_discovery_rate, short=True))}</span>",
        ]
        yield f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    yield "</tbody></table></div>"


def _gain(finding: Finding) -> str:
    """Share of the misfit as a number and a bar, with the root mean squares."""
    if not has_gain(finding):
        return "–"
    width = 0 if math.isnan(finding.share) else round(BAR_PIXELS * min(max(finding.share, 0.0), 1.0))
    unseen = text(gain_text(finding.held_out).removesuffix(" of unseen data"))
    return f'{percent(finding.share)}<span class="bar" style="width: {width}px"></span><br>{unseen}'


def _entries(finding: Finding) -> str:
    """All entries of a matrix, of which the sentence names only the clearest."""
    if finding.curve is not None:
        return f"<br>a curve of {text(finding.curve.variable)}, drawn below"
    out = []
    for quantity in grouped(distinguished(finding.parameters)[0]):
        if len(quantity.estimates) > SHOWN:
            entries, unit = each(quantity.estimates, quantity.axes)
            listed = "; ".join(f"<span class=entry>{text(entry)}</span>" for entry in entries)
            out.append(f"<br>{text(quantity.label)} {listed} {text(unit)}".rstrip())
    return "".join(out)


def _locations(d: Diagnosis) -> Iterator[str]:
    if not d.located:
        return
    yield "<h2>Location of the misfit</h2>"
    rows = "".join(
        f"<tr><td>{text(location_text(located, d))}</td><td class=number>{percent(located.share)}</td></tr>"
        for located in d.located
    )
    head = "<tr><th>Signal, regime, time</th><th>Share of the misfit</th></tr>"
    yield f'<div class="scroll"><table><thead>{head}</thead><tbody>{rows}</tbody></table></div>'
    for k, trace in enumerate(d.traces[:MAX_LOGS]):
        caption = (
            f"{text(trace.log)}: local size of the misfit{_band(trace)}, by axis (each sensor to its own largest). "
            '<span class="key" style="background: var(--mark)"></span>located misfit' + HELD
        )
        yield figure_of(figures.misfit_strip(d, trace), f"w{k}", caption)


def _closed(first: Diagnosis, second: Diagnosis) -> Diagnosis:
    """The first findings with samples of both: expected by the first simulation before, and by the second after.

    The ideal sensor is that of the first: samples of the second have the bias of physics.toml.
    """
    traces = []
    t_s, expected = (np.concatenate([getattr(trace, name) for trace in first.traces]) for name in ("t_s", "before"))
    ideals = [trace.ideal for trace in first.traces if trace.ideal is not None]
    ideal = np.concatenate(ideals) if len(ideals) == len(first.traces) else None
    for after in second.traces:
        of_before, of_after = np.isin(t_s, after.t_s), np.isin(after.t_s, t_s)
        if not of_after.any():
            continue
        traces.append(
            replace(
                after,
                t_s=after.t_s[of_after],
                real=after.real[of_after],
                before=expected[of_before],
                after=after.before[of_after],
                held_out=after.held_out[of_after],
                truth=None if after.truth is None else after.truth.rows(of_after),
                ideal=None if ideal is None else ideal[of_before],
            )
        )
    return replace(second, traces=tuple(traces), findings=first.findings, signals={})


def _before_and_after(d: Diagnosis) -> Iterator[str]:
    if not d.traces and not d.signals:
        return
    found = bool(d.findings)
    legend = BEFORE + AFTER if found else DIFFERENCE
    over = "all unseen time" if any(trace.held_out.any() for trace in d.traces) else "all time: none was held out"
    yield f"<h2>{'Before and after' if found else 'Difference'}</h2>"
    for k, trace in enumerate(d.traces[:MAX_LOGS]):
        drawn = figures.residual(trace, found=found)
        yield figure_of(drawn, f"r{k}", f"{text(trace.log)}: over time{_band(trace)}. {legend}{HELD}")
    found_in = {s: any(f"{s}.".startswith(f"{f.signal}.") for f in d.findings) for s in d.signals}  # or in a whole topic
    for k, signal in enumerate(sorted(d.signals, key=lambda signal: not found_in[signal])):
        drawn = figures.scalar_signal(d.signals[signal], found=found_in[signal])
        yield figure_of(drawn, f"g{k}", f"{text(signal)}: over time. {legend}{HELD}")
    if len(d.traces) > MAX_LOGS:
        yield f'<p class="note">The first {MAX_LOGS} of {len(d.traces)} stretches are drawn; all are in the .rrd.</p>'
    if not d.traces:
        return
    spectrum, rate, attitude = figures.spectrum(d), figures.residual_against_rate(d), figures.residual_against_attitude(d)
    if spectrum is not None:
        yield figure_of(
            spectrum,
            "s",
            f"Spectrum over {over} (Welch, one-sided, mean of the axes); "
            f"dashed: white noise as large as the noise floor. {legend}",
        )
    else:
        yield '<p class="note">Every unseen stretch is too short for a spectrum.</p>'
    paths = diagnosis_paths.paths(d)
    if paths is not None:
        true = '<span class="key" style="background: var(--ink); opacity: 0.4"></span>true'
        yield figure_of(
            paths, "p", f"Integrated from the true start of each stretch, {over}; drift as root mean square.{true}{legend}"
        )
    bands = "means in bins, with two standard errors"
    if rate is not None:
        yield figure_of(rate, "t", f"Against turning rate over {over}: {bands}. {legend}")
    if attitude is not None:
        yield figure_of(attitude, "a", f"Against attitude over {over}: {bands}. {legend}")
    else:
        yield '<p class="note">The attitude is unknown, so there is no figure against it.</p>'


def _curves(d: Diagnosis) -> Iterator[str]:
    for k, finding in enumerate(d.findings):
        if finding.curve is not None:
            yield "<h2>Unnamed misfit</h2>"
            caption = f"{text(finding.equation)}: a smooth curve of {text(finding.curve.variable)}, with one standard deviation"
            yield figure_of(figures.curve(finding.curve, finding.signal), f"c{k}", caption)


def _left(d: Diagnosis) -> Iterator[str]:
    if d.unexplained:
        yield "<h2>Remaining misfit</h2>"
        head = "".join(f"<th>{title}</th>" for title in ("Signal", "Remains (rms)", "Noise (rms)", "Ratio", ""))
        units = {signal: traces.unit for signal, traces in d.signals.items()}
        units |= {finding.signal: finding.held_out.unit for finding in d.findings} | ASCII_UNITS
        rows = []
        for signal, residual in d.unexplained.items():
            unit = symbol(units.get(signal, ""))
            ratio = f"{residual.rms / residual.noise_floor:.2f}" if residual.noise_floor > 0.0 else "–"
            numbers = (f"{residual.rms:.3g} {unit}", f"{residual.noise_floor:.3g} {unit}", ratio)
            cells = "".join(f"<td class=number>{text(number)}</td>" for number in numbers)
            rows.append(f"<tr><td>{text(signal)}</td>{cells}<td class=sentence>{text(residual_text(residual, unit))}</td></tr>")
        yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    if d.closer and d.findings:
        yield f"<h2>Improvement</h2><p class=note>{text(gain_source(d) + held_out_time(d))}.</p><dl>"
        for signal, second in d.closer.items():
            yield f"<dt>{text(signal)}</dt><dd>{text(improvement(second))}</dd>"
        yield "</dl>"


def _provenance(d: Diagnosis) -> Iterator[str]:
    yield "<h2>Provenance</h2><dl>"
    for real in d.real:
        yield f"<dt>real</dt><dd>{text(real)}</dd>"
    yield f"<dt>expected from</dt><dd>{text(d.sim) if d.sim is not None else 'the true poses of the recording itself'}</dd>"
    for trace in d.traces:
        yield f"<dt>samples</dt><dd>{text(_samples(trace))}</dd>"
    for bias in (row for row in d.bias if not math.isnan(row.sum()) or d.traces):
        gyro, accel = (", ".join(f"{b:+.4g}" for b in part) for part in (bias[:3], bias[3:]))
        yield f"<dt>constant bias</dt><dd>gyro ({gyro}) rad/s, accel ({accel}) m/s²</dd>"
    if d.not_identifiable:
        yield f"<dt>these logs cannot show</dt><dd>{text(', '.join(unobservable(d)))}</dd>"
    yield f"<dt>made by</dt><dd>imutool {text(__version__)}, {SCHEMA}</dd></dl>"


def _samples(trace: Traces) -> str:
    unseen = float(trace.held_out.mean()) * float(trace.t_s[-1] - trace.t_s[0])
    span = f"{trace.t_s[0]:.1f} to {trace.t_s[-1]:.1f} s"
    return f"{trace.log}: {len(trace.t_s)} at {figures.rate_hz(trace):.0f} Hz, {span}, {unseen:.0f} s of it unseen by any fit"


def _band(trace: Traces) -> str:
    """Frequency up to which the expected signal is known."""
    return "" if trace.band_hz is None else f" below {trace.band_hz:.2g} Hz, up to where the poses know the motion"
