"""Delay of `imutool live` at 1 kHz on one core: `python tests/bench/live.py [--seconds 20] [--core 0] [--first]`.

A made-up log at 1 kHz is replayed at its own speed, first without a view, then into an .rrd; prints the delay from the arrival
of a sample to its corrected value. `--first` schedules the command before all other work (`chrt -f 50`, as root).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

RATE_HZ = 1000.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--core", type=int, default=0)
    parser.add_argument("--first", action="store_true", help="schedule before other work")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.mcap"
        write(flight(1, duration_s=options.seconds, rate_hz=RATE_HZ), log)
        words = ["taskset", "-c", str(options.core), *(["chrt", "-f", "50"] if options.first else [])]
        words += [sys.executable, "-m", "imutool", "live", "--from", str(log), "--json", "-"]
        for view in (["--no-view"], ["--save", f"{folder}/live.rrd"]):
            done = subprocess.run([*words, *view], check=True, stdout=subprocess.PIPE, text=True)
            print(json.dumps({"view": view[0], **json.loads(done.stdout)["stream"]["delay_ms"]}))


if __name__ == "__main__":
    main()
