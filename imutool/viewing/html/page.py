"""What every page has in common: one file of words and drawings that asks nobody for anything."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from imutool.location import Location
from imutool.viewing.html.theme import STYLE

GENERATOR = '<meta name="generator" content="imutool">'
POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # whatever a log is called, no request leaves the page


def document(title: str, body: Iterable[str], style: str = "") -> str:
    """A whole page of lines that are markup already, for light and dark screens and for paper; the title is escaped."""
    head = (
        f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"{GENERATOR}"
        f"<title>{text(title)}</title><style>{STYLE}{style}</style>"
    )
    lines = "\n".join(body)
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body><main>\n{lines}\n</main></body></html>\n'


def is_ours(path: Location) -> bool:
    """Whether a file begins like a page that imutool has written."""
    with path.open("rb") as file:
        return GENERATOR.encode() in file.read(1024)


def text(words: str) -> str:
    """Words from anywhere, logs included, as text of the page: no markup, no letter that hides or turns others."""
    return escape(plain(words))


def plain(words: str) -> str:
    """The same before it is markup: what cannot be printed is spelt out."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in words)


def cards(numbers: Iterable[tuple[str, str]]) -> str:
    """Numbers to be seen first, each with what it is of."""
    return (
        '<div class="numbers">' + "".join(f"<div><b>{text(n)}</b><span>{text(of)}</span></div>" for n, of in numbers) + "</div>"
    )
