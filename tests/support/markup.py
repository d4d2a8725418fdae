"""Pages as a test reads them: tags in balance, words, addresses, and what is in each drawing."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np

VOID = {"meta", "br", "img", "link", "input", "hr"}


class Page(HTMLParser):
    """Tags in balance, visible words, and everything that an address or an identifier could be in."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.words: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.handlers: list[str] = []
        self.feed(content)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        for name, value in attrs:
            self.handlers += [name] if name.startswith("on") else []
            self.ids += [value or ""] if name == "id" else []
            self.addresses += [value or ""] if name in {"src", "href", "xlink:href", "action", "data"} else []
            self.addresses += re.findall(r"url\(([^)]*)\)", value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def svgs(content: str) -> list[str]:
    return re.findall(r"<svg.*?</svg>", content, flags=re.DOTALL)


def curves(svg: str) -> dict[str, np.ndarray]:
    """The corners of every curve of a drawing that has a title, in points of the drawing."""
    found = {}
    for title, path in re.findall(r'<g id="[^"]*curve-\d+"><title>([^<]*)</title>\s*<path d="([^"]*)"', svg):
        assert title not in found, f"two curves are called {title}"
        found[title] = np.array([[float(n) for n in pair] for pair in re.findall(r"[ML] (\S+) (\S+)", path)])
    return found
