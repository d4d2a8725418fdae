"""HTML page: document frame, colours, style sheet and escaping."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from imutool.file_location import Location

GENERATOR = '<meta name="generator" content="imutool">'
POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request leaves the page


def document(title: str, body: Iterable[str], style: str = "") -> str:
    """HTML document from lines of markup, for light and dark screens and paper."""
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{GENERATOR}"
        f"<title>{text(title)}</title><style>{STYLE}{style}</style>"
    )
    lines = "\n".join(body)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{lines}\n</main></body></html>\n'


def is_imutool_page(path: Location) -> bool:
    """Whether a file begins like a page that imutool wrote."""
    with path.open("rb") as file:
        return GENERATOR.encode() in file.read(1024)


def text(words: str) -> str:
    """Escape text from anywhere for a page, with control characters spelt out."""
    return escape(printable(words))


def printable(words: str) -> str:
    """Text with unprintable characters spelt out."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in words)


def cards(numbers: Iterable[tuple[str, str]]) -> str:
    """Row of key numbers, each with a caption."""
    return (
        '<div class="numbers">' + "".join(f"<div><b>{text(n)}</b><span>{text(of)}</span></div>" for n, of in numbers) + "</div>"
    )


# Okabe and Ito's palette, on dark a little lighter; red, green and blue are the axes as in the viewer. From e0 (none) to e6
# (the most) an error grows: blue, yellow and red differ for colour-blind eyes too.
LIGHT = {
    "paper": "#ffffff",
    "ink": "#1a1a1a",
    "soft": "#666666",
    "grid": "#dddddd",
    "panel": "#f4f5f7",
    "before": "#d55e00",
    "after": "#0072b2",
    "second": "#009e73",
    "third": "#cc79a7",
    "fourth": "#7a1fd1",
    "mark": "#e6a700",
    "held": "#7a7a7a",
    "x": "#dd3333",
    "y": "#2a9d4a",
    "z": "#3366cc",
    "e0": "#2c5fb6",
    "e1": "#1f93c4",
    "e2": "#2fa98c",
    "e3": "#b3a400",
    "e4": "#e89a1c",
    "e5": "#e0601a",
    "e6": "#c0182c",
}
DARK = LIGHT | {
    "paper": "#15181c",
    "ink": "#e6e6e6",
    "soft": "#a0a4aa",
    "grid": "#3a3f46",
    "panel": "#20242a",
    "before": "#ff8c3a",
    "after": "#56b4e9",
    "second": "#2cc79b",
    "third": "#e59cc6",
    "fourth": "#8b55f6",
    "mark": "#f0c040",
    "held": "#9a9a9a",
    "x": "#ff6b6b",
    "y": "#4cc26f",
    "z": "#7aa2ff",
    "e0": "#6f9bff",
    "e1": "#4cc4f0",
    "e2": "#4fd6b0",
    "e3": "#e0d24a",
    "e4": "#ffb84d",
    "e5": "#ff8a4c",
    "e6": "#ff5b6a",
}
PAPER = LIGHT | {"ink": "#000000", "soft": "#444444", "grid": "#cccccc", "panel": "#ffffff"}

# Names of colours for matplotlib: `svg` leaves them to the page, `png` takes the light ones. matplotlib knows them only
# while something is drawn (`drawing`).
INK, GRID, SOFT, BEFORE, AFTER, MARK, HELD, X, Y, Z = (
    f"imutool:{name}" for name in ("ink", "grid", "soft", "before", "after", "mark", "held", "x", "y", "z")
)
MODELS = tuple(f"imutool:{name}" for name in ("after", "second", "third", "fourth"))
LEVELS = tuple(f"imutool:e{level}" for level in range(7))
AXIS_COLORS = (X, Y, Z)
TITLES = {"gyro": "Gyro", "accel": "Accel"}


def _variables(colors: dict[str, str]) -> str:
    return " ".join(f"--{name}: {color};" for name, color in colors.items())


STYLE = (
    f"""
:root {{ color-scheme: light dark; {_variables(LIGHT)} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_variables(DARK)} }} }}
@media print {{ :root {{ color-scheme: light; {_variables(PAPER)} }} main {{ max-width: none; padding: 0; }}
  .findings {{ min-width: 0 !important; font-size: 11px; }} }}
"""
    + """
* { box-sizing: border-box; }
html { scroll-padding-top: 12px; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 15px/1.45 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1200px; margin: 0 auto; padding: 20px 25px 60px; }
a { color: var(--after); }
h1 { font-size: 15px; font-weight: 600; color: var(--soft); margin: 0 0 6px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 34px 0 6px; break-after: avoid; overflow-wrap: anywhere; }
.conclusion { font-size: 20px; line-height: 1.4; margin: 0 0 14px; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; vertical-align: top; padding: 6px 12px 6px 0; border-bottom: 1px solid var(--grid);
  overflow-wrap: anywhere; }
th { font-weight: 600; color: var(--soft); white-space: nowrap; }
.findings { table-layout: fixed; min-width: 900px; }
.findings th:nth-child(1) { width: 38%; } .findings th:nth-child(2) { width: 27%; } .findings th:nth-child(4) { width: 12%; }
td.sentence { min-width: 12em; }
td.number, .entry { white-space: nowrap; font-variant-numeric: tabular-nums; }
code { font: 13px/1.4 ui-monospace, "DejaVu Sans Mono", monospace; }
figure { margin: 10px 0 0; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; }
@media screen and (max-width: 600px) { figure { overflow-x: auto; } figure svg.wide { width: 770px; }
  figcaption { position: sticky; left: 0; } }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
figcaption, .note { color: var(--soft); font-size: 13px; margin: 4px 0; overflow-wrap: anywhere; }
.numbers { display: flex; flex-wrap: wrap; gap: 10px; margin: 12px 0; }
.numbers div { background: var(--panel); border: 1px solid var(--grid); border-radius: 6px; padding: 8px 14px; }
.numbers b { display: block; font-size: 20px; font-weight: 600; font-variant-numeric: tabular-nums; }
.numbers span { color: var(--soft); font-size: 13px; }
.key { display: inline-block; width: 14px; height: 10px; border-radius: 2px; margin: 0 5px 0 10px; }
.bar { display: inline-block; height: 8px; background: var(--after); border-radius: 2px; margin-left: 8px; }
.bar, .key { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
dl { display: grid; grid-template-columns: fit-content(40%) 1fr; gap: 4px 18px; font-size: 14px; margin: 6px 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 600px) { dl { display: block; } dd { margin-bottom: 4px; } }
@media print { tr { break-inside: avoid; } }
"""
)
