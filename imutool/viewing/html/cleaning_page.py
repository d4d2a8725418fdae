"""HTML page of a cleaning survey: verdict, findings and their times in the log, per IMU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from imutool.cleaning import Finding, Survey
from imutool.cleaning.unit_evidence import DEGREES
from imutool.mcap_io.storage.target import Target
from imutool.viewing.html.page import document, text

VERDICTS = {
    "good": "no sample has a fault",
    "usable": "usable",
    "quarantine": "not trustworthy; it is not cleaned",
}
FORCED = "not trustworthy; the clean channel is written because `force` asks for it, and leaves out invalid samples alone"
COLORS = {"note": "var(--held)", "warning": "var(--mark)", "error": "var(--before)"}
STRIP = "display: block; width: 100%; min-width: 300px; height: 14px; background: var(--panel)"
UNITS_OF_NAMES = {"s": "s", "hz": "Hz"}  # by the end of a value's name
MIN_WIDTH = 0.002  # of the strip, so that one sample in an hour is visible


def write(surveys: Sequence[Survey], path: Path, *, overwrite: bool) -> None:
    """Write the page as one file without requests (ConfigError: a bad target)."""
    with Target(path, overwrite=overwrite) as target:
        target.write(html(surveys).encode())


def html(surveys: Sequence[Survey]) -> str:
    """Text of the page of `write`."""
    logs = ", ".join(sorted({Path(survey.log).name for survey in surveys}))
    return document(logs, [f"<h1>{text(logs)}</h1>", *(line for survey in surveys for line in _imu(survey))])


def _imu(survey: Survey) -> Iterator[str]:
    yield f"<h2>{text(survey.topic)}: {survey.verdict}, score {survey.score:.3f}</h2>"
    yield f'<p class="conclusion">{text(_sentence(survey))}</p>'
    yield from (f"<p>{text(reason)}</p>" for reason in survey.reasons)
    if survey.findings:
        head = "".join(
            f"<th>{title}</th>" for title in ("Rule", "Count", "What was found", "Action", "Confidence", "Where in the log (s)")
        )
        yield f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>'
        yield from (_row(finding, survey) for finding in survey.findings)
        yield "</tbody></table></div>"


def _sentence(survey: Survey) -> str:
    seconds = (survey.end_ns - survey.start_ns) * 1e-9
    counts = f"{survey.valid} of {survey.messages} samples in {seconds:.1f} s are valid, {survey.missing} are missing"
    forced = survey.verdict == "quarantine" and survey.settings.force
    parts = [f"{counts}: {FORCED if forced else VERDICTS[survey.verdict]}"]
    if survey.verdict == "usable" and survey.valid < survey.messages:
        parts.append("the clean channel leaves out the samples listed below as dropped")
    if survey.scale[3] != 1.0:
        parts.append(f"accel is multiplied by {survey.scale[3]:.6g}")
    if survey.scale[0] != 1.0:
        parts.append("gyro is turned from degrees into radians" if survey.scale[0] == 1.0 / DEGREES else "gyro is converted")
    return "; ".join(parts) + "."


def _row(finding: Finding, survey: Survey) -> str:
    values = f'<div class="note">{text(_as_text(finding.values))}</div>' if finding.values else ""
    short = [text(finding.rule), str(finding.count), finding.action, f"{finding.confidence:.2f}"]
    rule, count, action, sure = (f'<td class="number">{cell}</td>' for cell in short)
    return f"<tr>{rule}{count}<td>{text(finding.what)}{values}</td>{action}{sure}<td>{_strip(finding, survey)}</td></tr>"


def _as_text(value: Any) -> str:
    """Values as text, numbers to five digits."""
    if isinstance(value, dict):
        return ", ".join(map(_named, value.items()))
    if isinstance(value, list | tuple):
        return ", ".join(map(_as_text, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _named(entry: tuple[str, Any]) -> str:
    """Name and value, with the unit that ends the name: longest 0.999 s."""
    name, _, unit = entry[0].rpartition("_")
    name, unit = (name, UNITS_OF_NAMES[unit]) if name and unit in UNITS_OF_NAMES else (entry[0], "")
    return f"{name.replace('_', ' ')} {_as_text(entry[1])} {unit}".rstrip()


def _strip(finding: Finding, survey: Survey) -> str:
    """Intervals of a finding, drawn along the log."""
    length = max(survey.end_ns - survey.start_ns, 1)
    when = finding.when(survey.start_ns)
    if not finding.intervals_ns:
        return when
    marks = []
    for first, last in finding.intervals_ns:
        at = min(max((first - survey.start_ns) / length, 0.0), 1.0 - MIN_WIDTH)
        width = min(max((last - first) / length, MIN_WIDTH), 1.0 - at)
        marks.append(f'<rect x="{1000 * at:.2f}" width="{1000 * width:.2f}" height="14" fill="{COLORS[finding.severity]}"/>')
    svg = f'<svg aria-hidden="true" viewBox="0 0 1000 14" preserveAspectRatio="none" style="{STRIP}">{"".join(marks)}</svg>'
    return f'{svg}<div class="note">{when}</div>'
