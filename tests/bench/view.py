"""What it costs to make a log ready to be looked at: `python tests/bench/view.py [--minutes 60] [--profile]`.

A made-up log of that length at 200 Hz, truth at 200 Hz too and a debiased channel in it, in a temporary folder. Prints seconds
of `load` and `build` of `imutool.viewing.model.load_view` (all of it, and its last part: paths, errors, drift, windows,
spectra, events), and how much memory the process took at most beyond what the imports take. On one core, the log in the page
cache.

Then the viewer, Rerun's own without a window and drawing in software (the slowest that there is): seconds until everything is
sent (`sent_s`), and until gyro and accel, raw and debiased, stand on the screen and stay (`drawn_s`, from the same moment: the
data being ready); what the viewer's process has taken then, in seconds of a core (`viewer_cpu_s`: other work on the machine
does not make it longer) and in memory (`viewer_mb`).
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import re
import runpy
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.viewing.model import load_view
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, scene

TESTS = Path(__file__).parents[1]
VIEWERS = SimpleNamespace(**runpy.run_path(str(TESTS / "support" / "viewers.py")))
VIEWS = SimpleNamespace(**runpy.run_path(str(TESTS / "support" / "saved_rrd.py")))

RATE_HZ = 200.0
GIVE_UP_S = 120.0
DRAWN = 5000  # pixels in colour, of a plot of some 400 000: an hour of six curves fills much of it


def write_long(folder: Path, minutes: float) -> Path:
    """A made-up log so long, debiased by its means at rest."""
    from imutool.debiasing import debias

    write(flight(1, duration_s=60.0 * minutes, rate_hz=RATE_HZ, truth_rate_hz=RATE_HZ), folder / "raw.mcap")
    debias(folder / "raw.mcap", folder / "long.mcap", model="static")
    return folder / "long.mcap"


def peak_mb() -> float:
    """The most memory this process has held."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


def measure(log: Path, profile: bool) -> dict[str, float]:
    """Seconds and memory, in a process that has done nothing else but import."""
    before, profiler = peak_mb(), cProfile.Profile()
    began = time.perf_counter()
    if profile:
        profiler.enable()
    data = load_view.load(log)
    profiler.disable()
    loaded_s, more_mb = time.perf_counter() - began, peak_mb() - before
    if profile:
        pstats.Stats(profiler).sort_stats("cumulative").print_stats(45)
    read_only = [trace.run for trace in data.traces]
    recording = read(log)
    began = time.perf_counter()
    load_view.build(recording, read_only)
    built_s = time.perf_counter() - began
    costs = {"samples": len(recording.imu), "runs": len(read_only), "load_s": loaded_s, "build_s": built_s, "more_mb": more_mb}
    return costs | look(data)


def look(data: RunData) -> dict[str, float]:
    """Seconds and memory of the viewer; nothing where there is no driver to draw with."""
    if VIEWERS.driver() is None:
        print(f"no viewer: apt-get install {' '.join(VIEWERS.PACKAGES['driver'])}", file=sys.stderr)
        return {}
    blueprint = layout.blueprint([data])
    signals = [view.id for view in VIEWS.views(blueprint) if VIEWS.held(view, ["/imu/gyro/raw", "/imu/accel/raw"])]

    def time_it(viewer: Any) -> dict[str, float]:
        began = time.perf_counter()
        viewer.show(lambda to: scene.log([data], to, source=False), blueprint)
        sent_s = time.perf_counter() - began
        while min(map(VIEWERS.saturated, viewer.pictures(signals))) < DRAWN:
            if time.perf_counter() - began > GIVE_UP_S:
                raise SystemExit(f"not drawn within {GIVE_UP_S:g} s")
        drawn_s = time.perf_counter() - began
        return {"sent_s": sent_s, "drawn_s": drawn_s, "viewer_cpu_s": viewer.cpu_s, "viewer_mb": viewer.resident_mib}

    found: dict[str, float] = VIEWERS.seen(time_it, (1920, 1080))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--profile", action="store_true", help="also say where the time of `load` goes")
    parser.add_argument("--log", type=Path, help="measure this log instead")
    options = parser.parse_args()
    if options.log is not None:
        print(json.dumps(measure(options.log, options.profile)))
        return
    with tempfile.TemporaryDirectory() as folder:
        log = write_long(Path(folder), options.minutes)
        words = [sys.executable, __file__, "--log", str(log), *(["--profile"] if options.profile else [])]
        print(subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout, end="")


if __name__ == "__main__":
    main()
