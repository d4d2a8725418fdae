"""Drawings without layout and letters, for tests that do not look at them: matplotlib takes most of the time of a page.

Axes and curves are made as always. The tests of tests/viewing, the demo and the examples draw in full.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from imutool.viewing.html import drawing

_IN_FULL = drawing._content


def draw_outlines() -> None:
    """Draw in outline from now on, in this process and its forks."""
    drawing._content = _outline


@contextmanager
def in_full() -> Iterator[None]:
    """Draw in full inside it."""
    with _by(_IN_FULL):
        yield


@contextmanager
def in_outline() -> Iterator[None]:
    """Draw in outline inside it."""
    with _by(_outline):
        yield


@contextmanager
def _by(content: Any) -> Iterator[None]:
    before, drawing._content = drawing._content, content
    try:
        yield
    finally:
        drawing._content = before


def _outline(figure: Any, *, format: str, **saving: Any) -> bytes:
    if format == "svg":
        curves = "".join(f'<g id="{gid}"></g>' for axes in figure.get_axes() for a in axes.lines if (gid := a.get_gid()))
        return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1">{curves}</svg>'.encode()
    for axes in list(figure.get_axes()):
        axes.remove()
    return _IN_FULL(figure, format=format, **saving)
