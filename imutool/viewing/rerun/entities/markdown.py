"""Words for the viewer: what a log, a topic or a model is called never becomes markup."""

from __future__ import annotations

import re
from collections.abc import Sequence


def escape(text: str) -> str:
    """The text as it stands, on one line, in Markdown."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([\\`*_{}\[\]<>#|!~&])", r"\\\1", plain)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table; its cells must be escaped already."""
    return [_row(head), _row(["---"] * len(head)), *map(_row, rows)]


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
