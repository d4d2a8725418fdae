"""Makes the pictures of what is seen: `python tests/bench/pictures.py LOG [--model M] [--init auto] [-o docs/images]`.

Every tab in Rerun's own viewer (dark: the theme of a viewer without a window) and in its web viewer (light), and the report in
both, each as it comes up of a real log; PNGs of at most 256 colours. Takes Chromium and a Vulkan driver (`make viewers`).
"""

from __future__ import annotations

import argparse
import http.server
import runpy
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

from PIL import Image

from imutool.viewing.html import report
from imutool.viewing.model.load_view import load
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, scene
from imutool.viewing.rerun.entities.styles import MODEL_COLORS, RAW_COLOR
from imutool.viewing.rerun.web import export

VIEWERS = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "support" / "viewers.py")))

SIZE = (1280, 720)
COLORS = 256
MIN = 300  # pixels of a curve in a viewer that has drawn it
TABS = ("Signals", "Bias", "Spectrum", "Errors", "Events", "Report")
TOLD_S = 10.0  # for which a viewer tells of itself in a corner


def in_front(tab: str) -> Any:
    """Every layout made meanwhile has a tab in front."""
    made = layout.blueprint

    def blueprint(*logs: Any, **settings: Any) -> Any:
        done = made(*logs, **settings)
        right = done.root_container.contents[1]
        right.active_tab = next(k for k, part in enumerate(right.contents) if part.name == tab)
        return done

    return mock.patch.object(layout, "blueprint", blueprint)


def native(logs: list[RunData]) -> Any:
    """Rerun's own viewer with the cursor at the end."""

    def look(viewer: Any) -> Any:
        viewer.show(lambda to: scene.log(logs, to, source=False), layout.blueprint(logs))
        time.sleep(TOLD_S)
        return viewer.picture()

    return VIEWERS.seen(look, SIZE)


def web(browser: Any, folder: Path) -> Any:
    """The exported folder in a light Chromium."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page(color_scheme="light", viewport={"width": SIZE[0], "height": SIZE[1]})
        page.goto(f"http://127.0.0.1:{server.server_port}/")
        picture = VIEWERS.steady(page.screenshot, draws, 300.0)
        page.close()
        server.shutdown()
    return picture


def paper(browser: Any, page_path: Path, scheme: str) -> Any:
    """The first screen of the report."""
    page = browser.new_page(color_scheme=scheme, viewport={"width": SIZE[0], "height": 2 * SIZE[1]})
    page.goto(page_path.as_uri())
    picture = VIEWERS.pixels(page.screenshot())
    page.close()
    return picture


def draws(picture: Any) -> bool:
    """Whether the errors of both paths are drawn, which are next to every tab. The viewer itself has blue."""
    return min(VIEWERS.drawn(picture, color) for color in (RAW_COLOR, MODEL_COLORS[0])) >= MIN


def save(picture: Any, path: Path) -> None:
    """A small PNG."""
    rare_too = Image.Quantize.MAXCOVERAGE  # the median cut would make a thin orange line red
    image = Image.fromarray(picture).quantize(COLORS, method=rare_too, kmeans=2, dither=Image.Dither.NONE)
    image.save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--model", default="static")
    parser.add_argument("--init", default="auto", help="initial bias, as of imutool view")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    logs = [load(options.log, models=[options.model], init=options.init)]
    duration_s = logs[0].duration_s
    with tempfile.TemporaryDirectory() as folder, VIEWERS.chromium(webgl=True) as browser:
        for tab in TABS:
            with in_front(tab):
                export(logs, Path(folder) / tab, source=False, at_s=duration_s)
                save(native(logs), options.output / f"viewer-{tab.lower()}-dark.png")
            save(web(browser, Path(folder) / tab), options.output / f"viewer-{tab.lower()}-light.png")
        report.write_page(logs, Path(folder) / "report.html")
        for scheme in ("light", "dark"):
            save(paper(browser, Path(folder) / "report.html", scheme), options.output / f"report-{scheme}.png")


if __name__ == "__main__":
    main()
