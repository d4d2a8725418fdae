"""The pages in a real browser: no error, no request to anybody, light, dark, narrow and on paper, every figure drawn."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import diagnoses, image_difference, imu_defects, viewers
from support.made_once import made_once
from support.processes import SOON_S

from imutool.cleaning.survey import examine
from imutool.fleet import page as fleet_page
from imutool.fleet.results import TROUBLE
from imutool.fleet.task import Imu, Result, Settings
from imutool.viewing.html import cleaning_page, diagnosis_page, drawing, report
from imutool.viewing.model.load_view import build

TESTS = Path(__file__).parents[1]

WIDE, NARROW, PAPER = 1280, 400, 794  # CSS pixels; the last is A4 at 96 dots per inch
HEIGHT = 720
SENTENCE = 60  # CSS pixels: in a narrower cell a sentence stands letter by letter
READABLE = 4.5  # contrast of text, the least that WCAG 2 calls AA
LETTER = 8.0  # CSS pixels: smaller letters cannot be read on a phone
INKED = 0.002  # of a figure's area: frame and labels alone reach it, an empty box does not
ADDRESSED = "http://127.0.0.1:9/elsewhere.png"  # nobody listens there
PAGES = ("one model", "nothing known", "two logs", "diagnosis", "fleet", "cleaning")
NAMELESS = """[...document.querySelectorAll('svg:not([aria-hidden])')].filter(svg => {
    const name = document.getElementById(svg.getAttribute('aria-labelledby'))?.textContent ?? svg.getAttribute('aria-label');
    return svg.getAttribute('role') !== 'img' || !name;
}).map(svg => svg.outerHTML.slice(0, 200))"""
WORDS = """[...document.querySelectorAll('main *')].filter(e => !e.closest('svg') && e.checkVisibility()
    && [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim())).map(e => {
        let box = e;
        while (box && getComputedStyle(box).backgroundColor === 'rgba(0, 0, 0, 0)') box = box.parentElement;
        return [e.textContent, getComputedStyle(e).color, getComputedStyle(box ?? document.body).backgroundColor];
    })"""
HOSTILE = "<img src=x onerror=alert(1)>"  # a log may be called anything


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with viewers.chromium() as running:
        yield running


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each page as NAME.html."""
    return made_once(tmp_path_factory, "pages", write_pages)


def write_pages(folder: Path) -> None:
    flights = [image_difference.recording(seed) for seed in (3, 4)]
    hostile = replace(flights[1], name=HOSTILE)
    logs = {
        "one model": [build(flights[0], image_difference.runs(flights[0]))],
        "nothing known": [build(replace(flights[0], truths={}, scalars={}), image_difference.runs(flights[0], models=0))],
        "two logs": [build(one, image_difference.runs(one)) for one in (flights[0], hostile)],
    }
    for name, shown in logs.items():
        report.write_page(shown, folder / f"{name}.html")
    diagnosis_page.write(diagnoses.LATE, folder / "diagnosis.html")
    write_fleet(folder / "fleet.html")
    messages = imu_defects.batch_of(flights[0].imu)
    kept = np.delete(np.arange(len(messages.stamp_ns)), slice(1000, 1040))
    cleaning_page.write([examine(lambda: [imu_defects.pick(messages, kept)], None)], folder / "cleaning.html", overwrite=False)


def write_fleet(path: Path) -> None:
    """A fleet of which some logs are whole and have a page, and others are not."""
    bias = {"gyro_bias": (0.01, -0.02, 0.03), "accel_bias": (0.1, 0.2, 0.3)}
    imus = [Imu("/imu0", "static", "at rest", **bias), Imu("/imu0", "static", "at rest", (0.0,) * 3, (0.0,) * 3)]
    said = "static cuts the orientation error from 37.2° to 0.560°."
    results = [
        Result(key=name, source=name, target=name, status="ok", imus=(imu,), score=rate, page=f"{name}.html", page_says=said)
        for name, rate, imu in zip(("warehouse_robot_01", "warehouse_robot_02"), (1.0, 0.8), imus, strict=True)
    ]
    results += [
        Result(key=name, source=f"/logs/{name}", target="", status=name, error="the file is empty", losses=("a chunk",))
        for name in TROUBLE
    ]
    fleet_page.write(results, Settings(command="debias"), path, out=path.parent, seconds=3.0, source="logs")


@dataclass
class Visit:
    """A page that is open, and what it said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def numbers(self, script: str) -> list[float]:
        return list(self.page.evaluate(script))


@pytest.fixture(scope="module")
def visit(browser: Any) -> Iterator[Any]:
    """A page in some light and width; each is opened once, and all that it ever said and asked for is kept."""
    visits: dict[Path, Visit] = {}

    def look_at(path: Path, *, scheme: str = "light", width: int = WIDE, media: str = "screen") -> Visit:
        one = visits.get(path) or visits.setdefault(path, opened(path))
        one.page.set_viewport_size({"width": width, "height": HEIGHT})
        one.page.emulate_media(media=media, color_scheme=scheme)
        one.page.evaluate("document.querySelectorAll('details[data-opened]').forEach(d => d.open = false)")
        return one

    def opened(path: Path) -> Visit:
        context = browser.new_context()
        context.set_default_timeout(1e3 * SOON_S)
        one = Visit(context.new_page())
        one.page.on("console", lambda message: one.said.append(f"{message.type}: {message.text}"))
        one.page.on("pageerror", lambda error: one.said.append(str(error)))
        one.page.on("request", lambda request: one.asked.append(request.url))
        one.page.goto(path.as_uri(), wait_until="networkidle")
        return one

    yield look_at
    for one in visits.values():
        one.page.context.close()


def fits(one: Visit) -> bool:
    """Whether nothing has to be scrolled sideways for."""
    scroll, client = one.numbers("[document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    return scroll <= client


@pytest.mark.parametrize("name", PAGES)
@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_a_page_says_nothing_asks_for_nothing_and_fits(visit: Any, folder: Path, name: str, width: int) -> None:
    path = folder / f"{name}.html"
    one = visit(path, width=width)
    assert one.said == []
    assert one.asked == [path.as_uri()]
    assert fits(one)
    cells = "[...document.querySelectorAll('td')].filter(cell => cell.checkVisibility() && cell.textContent.length > 20)"
    assert min(one.numbers(f"{cells}.map(cell => cell.getBoundingClientRect().width)"), default=NARROW) > SENTENCE
    assert one.page.evaluate(NAMELESS) == []
    drawn = "[...document.querySelectorAll('figure svg')].filter(svg => svg.checkVisibility())"
    scale = f"{drawn}.map(svg => svg.getBoundingClientRect().width / svg.viewBox.baseVal.width)"
    assert min(one.numbers(scale), default=1.0) * drawing.STYLE["font.size"] > LETTER


def test_what_says_asks_and_does_not_fit_is_seen(visit: Any, tmp_path: Path) -> None:
    path = tmp_path / "bad.html"
    script = "<script>console.error('heard'); undefined_function()</script>"
    path.write_text(f"<div style='width: 3000px'>x</div><img src='{ADDRESSED}'>{script}")
    one = visit(path)
    assert any("heard" in line for line in one.said)
    assert any("undefined_function" in line for line in one.said)
    assert one.asked == [path.as_uri(), ADDRESSED]
    assert not fits(one)


@pytest.mark.parametrize(("scheme", "darkest", "lightest"), [("light", 0.8, 1.0), ("dark", 0.0, 0.1)])
@pytest.mark.parametrize("name", PAGES)
def test_its_words_can_be_read_and_every_figure_is_drawn(
    visit: Any, folder: Path, name: str, scheme: str, darkest: float, lightest: float
) -> None:
    one = visit(folder / f"{name}.html", scheme=scheme)
    ink, ground = (color(one, prop) for prop in ("color", "backgroundColor"))
    assert darkest <= luminance(ground) <= lightest
    assert contrast(ink, ground) > READABLE
    for words, *colors in one.page.evaluate(WORDS):
        assert contrast(*(np.array(re.findall(r"[\d.]+", shown)[:3], dtype=float) for shown in colors)) > READABLE, words
    one.page.evaluate("document.querySelectorAll('details:not([open])').forEach(d => { d.open = true; d.dataset.opened = 1 })")
    boxes = one.page.evaluate(
        "[...document.querySelectorAll('svg, img')].map(f => f.getBoundingClientRect())"
        ".map(b => [b.x + scrollX, b.y + scrollY, b.width, b.height])"
    )
    whole = viewers.pixels(one.page.screenshot(full_page=True)).astype(np.int16)
    np.testing.assert_array_equal(whole[2, 2], ground)  # it is painted as it says
    assert boxes
    for k, (x, y, width, height) in enumerate(boxes):
        figure = whole[round(y) : round(y + height), round(x) : round(x + width)]
        assert figure.size, f"figure {k} has no room"
        empty = np.median(figure[::5, ::5], axis=(0, 1))  # most of a figure is
        inked = (np.abs(figure - empty).max(axis=-1) > 40).mean()
        assert inked > INKED, f"figure {k} of {len(boxes)} is empty"


def color(one: Visit, prop: str) -> np.ndarray:
    """A colour of the page itself; a body without a ground shows the root's, and that without one is the browser's canvas."""
    script = f"['body', 'html'].map(n => getComputedStyle(document.querySelector(n)).{prop})"
    shown = next(text for text in one.page.evaluate(script) if text != "rgba(0, 0, 0, 0)")
    return np.array(re.findall(r"[\d.]+", shown)[:3], dtype=float)


def luminance(rgb: np.ndarray) -> float:
    """Relative luminance of WCAG 2."""
    part = rgb / 255.0
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """Contrast ratio of WCAG 2, 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("name", PAGES)
def test_it_prints_on_white_paper_and_nothing_is_cut_off(visit: Any, folder: Path, name: str) -> None:
    one = visit(folder / f"{name}.html", scheme="dark", width=PAPER, media="print")
    assert fits(one)
    assert luminance(color(one, "backgroundColor")) > 0.95
    printed = one.page.pdf(format="A4")
    assert printed.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) >= 1 + (name != "cleaning")
