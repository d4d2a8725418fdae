"""How a command starts: `python tests/bench/start.py [LOG]`, beside named peers in the same run.

Each line is a whole command in a process of its own: user and system CPU seconds, the least of `--rounds`, and its ratio to a
peer that does nothing but import. LOG is a made-up flight of 100 s by default, debiased by a model that ships.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

COMMAND = "import sys; sys.argv[0] = 'imutool'; from imutool.cli import main; main()"
NUMERIC, TERMINAL = "import numpy, scipy.signal", "import typer, rich"
MODEL = "euroc-adis16448-hybrid"


def cpu_s(line: list[str], rounds: int) -> float:
    """Least CPU seconds of a process; one run before fills the caches."""

    def once() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(line, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, **ONE})
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime

    once()
    return min(once() for _ in range(rounds))


ONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main() -> None:
    """A line a command: CPU seconds, and the ratio to its peer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, nargs="?")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log = options.log or Path(folder) / "flight.mcap"
        if options.log is None:
            write(flight(1, duration_s=100.0), log)
        out = str(Path(folder) / "out.mcap")
        debias = ["debias", str(log), out, "--overwrite", "--quiet", "--force"]
        commands = {
            ("imutool debias, hybrid", NUMERIC): [*debias, "--model", MODEL],
            ("imutool debias, linear", NUMERIC): [*debias, "--model", MODEL.replace("hybrid", "linear")],
            ("imutool debias, static", NUMERIC): [*debias, "--model", "static"],
            ("imutool info", NUMERIC): ["info", str(log)],
            ("imutool --help", TERMINAL): ["--help"],
        }
        peers = {code: cpu_s([sys.executable, "-c", code], options.rounds) for code in (NUMERIC, TERMINAL)}
        for code, seconds in peers.items():
            print(f"{'python -c ' + repr(code):45} {seconds:6.3f} s")
        for (name, peer), words in commands.items():
            seconds = cpu_s([sys.executable, "-c", COMMAND, *words], options.rounds)
            print(f"{name:45} {seconds:6.3f} s  {seconds / peers[peer]:5.2f} of its peer")


if __name__ == "__main__":
    main()
