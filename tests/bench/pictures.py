"""Makes the README's pictures of what is seen: `python tests/bench/pictures.py LOG [--model M] [--init auto] [-o docs/images]`.

Rerun's own viewer (dark: the theme of a viewer without a window), its web page in light and dark, the report in light and dark,
each as it comes up of a real log; PNGs of at most 256 colours. Takes Chromium and a Vulkan driver (`make viewers`).
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

from PIL import Image

from imutool.viewing.html import report
from imutool.viewing.model.run_data import RunData
from imutool.viewing.model.runs import load
from imutool.viewing.rerun import layout, scene
from imutool.viewing.rerun.entities.styles import RAW_FADE, XYZ, blend_to_grey
from imutool.viewing.rerun.web import export

VIEWERS = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "support" / "viewers.py")))

SIZE = (1280, 720)
COLORS = 256
LEAST = 200  # pixels of each axis' colour, in a viewer that has drawn curves
TOLD_S = 10.0  # for which a viewer tells of itself in a corner


def native(logs: list[RunData], tab: str | None) -> Any:
    """Rerun's own viewer with the cursor at the end, and a tab in front."""
    blueprint = layout.blueprint(logs)
    right = blueprint.root_container.contents[1]
    right.active_tab = next((k for k, part in enumerate(right.contents) if part.name == tab), 0)

    def look(viewer: Any) -> Any:
        viewer.show(lambda to: scene.log(logs, to, source=False), blueprint)
        time.sleep(TOLD_S)
        return viewer.picture()

    return VIEWERS.seen(look, SIZE)


def web(browser: Any, folder: Path, scheme: str) -> Any:
    """The exported folder in Chromium."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page(color_scheme=scheme, viewport={"width": SIZE[0], "height": SIZE[1]})
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
    """Whether curves of all three axes are there, faint or not."""
    return all(max(VIEWERS.drawn(picture, c) for c in (color, blend_to_grey(color, RAW_FADE))) >= LEAST for color in XYZ)


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
    parser.add_argument("--init", default="auto", help="start bias, as of imutool view")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    logs = [load(options.log, models=[options.model], init=options.init)]
    duration_s = logs[0].duration_s
    for tab in ("Signals", "Bias", "Errors", "Spectrum"):
        save(native(logs, tab), options.output / f"viewer-{tab.lower()}.png")
    with tempfile.TemporaryDirectory() as folder, VIEWERS.chromium() as browser:
        report.write_page(logs, Path(folder) / "report.html")
        export(logs, Path(folder) / "web", source=False, at_s=duration_s)
        for scheme in ("light", "dark"):
            save(paper(browser, Path(folder) / "report.html", scheme), options.output / f"report-{scheme}.png")
            save(web(browser, Path(folder) / "web", scheme), options.output / f"web-{scheme}.png")


if __name__ == "__main__":
    main()
