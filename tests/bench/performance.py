"""Every command on small, large and many logs against its peers: `python tests/bench/performance.py [--gb 0.4] [--in FOLDER]`.

A line a command: CPU and wall seconds and memory of the whole process, the least of `--rounds` after one round that does not
count, and the ratio of its CPU time to that of a peer in the same run. Peers: python importing what a command cannot do
without, `cp` of the log, a shell loop of `cp`. The small log is a made-up flight of 90 s with true poses; the large one has
images and IMU messages in every chunk (`tests/bench/rewrite.py`); many are logs of 2 MB of that kind
(`tests/bench/fleet.py`). The long one is a made-up flight of `--hours`. Its commands run once, as do diagnosis and training:
of the flight against its simulation, and of each of `--recordings LOG...` alone and against its simulation; one training of all
of them (on EuRoC: MH_01, MH_03, MH_05, V1_02, V2_01, V2_03).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import fleet
import rewrite

from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

IMUTOOL = str(Path(sys.executable).with_name("imutool"))
MODEL = "euroc-adis16448-hybrid"
PARTS = ("start", "small", "large", "many", "long", "diagnose", "train")
TERMINAL = [sys.executable, "-c", "import typer, rich"]
NUMERIC = [sys.executable, "-c", "import numpy, scipy.signal"]
FLIGHT = "import imutool, sys; imutool.write(sys.argv[2], imutool.example_recording(2, duration_s=float(sys.argv[1])))"


class Row(NamedTuple):
    """A command, its peer, and the outputs to remove before each run."""

    name: str
    words: list[str]
    peer: str
    outputs: tuple[Path, ...] = ()
    once: bool = False  # so long that one run says enough


def start() -> Iterator[Row]:
    """The start of a command."""
    yield Row("typer, rich", TERMINAL, "typer, rich")
    yield Row("--help", [IMUTOOL, "--help"], "typer, rich")


def small(folder: Path) -> Iterator[Row]:
    """Commands on a flight of 90 s."""
    log, out, sim = folder / "flight.mcap", folder / "out.mcap", folder / "sim.mcap"
    page, found = folder / "page.html", folder / "found"
    write(flight(2, duration_s=90.0), log)
    simulate = simulated(log, sim)
    lines: list[tuple[str, list[object], tuple[Path, ...]]] = [
        ("info", ["info", log], ()),
        ("clean", ["clean", log, out], (out,)),
        ("repair", ["repair", log, out], (out,)),
        ("debias, linear", ["debias", log, out, "-q", "--force", "--model", MODEL.replace("hybrid", "linear")], (out,)),
        ("debias, hybrid", ["debias", log, out, "-q", "--force", "--model", MODEL], (out,)),
        ("evaluate", ["evaluate", log, "--model", MODEL, "-q"], ()),
        ("simulate", [*simulate[:2], out, *simulate[3:]], (out,)),
        ("view --html", ["view", log, "--html", page], (page,)),
        ("diagnose, files and pages", ["diagnose", log, "--sim", sim, "-o", found, "-q"], (found,)),
    ]
    yield Row("numpy, scipy.signal", NUMERIC, "numpy, scipy.signal")
    for name, words, outputs in lines:
        yield Row(name, [IMUTOOL, *map(str, words)], "numpy, scipy.signal", outputs)


def simulated(log: Path, sim: Path) -> list[object]:
    """The words of a simulation along a log's poses, which is made."""
    words: list[object] = ["simulate", log, sim, "--noise", "adis16448", "--seed", "1", "-q", "--overwrite"]
    subprocess.run([IMUTOOL, *map(str, words)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return words


def diagnosed(folder: Path, recordings: Sequence[Path]) -> Iterator[Row]:
    """Diagnoses without files: pairs, and recordings alone."""
    log, sim = folder / "flight.mcap", folder / "sim.mcap"
    write(flight(2, duration_s=90.0), log)
    for path in (log, *recordings):
        simulated(path, sim)
        yield Row(f"diagnose {path.stem}, a pair", [IMUTOOL, "diagnose", str(path), "--sim", str(sim), "-q"], "", once=True)
    for path in recordings:
        yield Row(f"diagnose {path.stem} alone", [IMUTOOL, "diagnose", str(path), "-q"], "", once=True)


def trained(folder: Path, recordings: Sequence[Path]) -> Iterator[Row]:
    """One training."""
    out = folder / "model.safetensors"
    words = [IMUTOOL, "train", *map(str, recordings), "-o", str(out), "--method", "hybrid", "-q"]
    if recordings:
        yield Row(f"train hybrid, {len(recordings)} logs", words, "", (out,), once=True)


def large(folder: Path, gb: float) -> Iterator[Row]:
    """Commands on a log of images and IMU, in three compressions."""
    log, out = folder / "large.mcap", folder / "large.out.mcap"
    for packing in ("none", "lz4", "zstd"):
        rewrite.write_mixed(log, gb, packing)
        yield Row(f"cp, {packing}", ["cp", str(log), str(out)], "cp", (out,))
        for command in ("info", "repair", "debias"):
            words = [command, log] if command == "info" else [command, log, out]
            words += ["-q", "--force", "--model", MODEL] if command == "debias" else []
            yield Row(f"{command}, {packing}", [IMUTOOL, *map(str, words)], "cp", (out,))
        log.unlink()


def many(folder: Path, logs: int, mb: float) -> Iterator[Row]:
    """A fleet on two workers."""
    source, out = folder / "logs", folder / "fleet"
    source.mkdir()
    fleet.make(source / "0.mcap", mb, "lz4")
    for k in range(1, logs):
        shutil.copy(source / "0.mcap", source / f"{k}.mcap")
    loop = ["sh", "-c", 'mkdir "$1"; for f in "$0"/*.mcap; do cp "$f" "$1"/; done', str(source), str(out)]
    yield Row("cp in a loop", loop, "cp in a loop", (out,))
    for command, words in (("debias", ["--force", "--model", MODEL]), ("info", []), ("repair", [])):
        line = [IMUTOOL, "fleet", command, str(source), str(out), "--workers", "2", "-q", *words]
        yield Row(f"fleet {command}", line, "cp in a loop", (out,))


def long(folder: Path, hours: float) -> Iterator[Row]:
    """Commands on a flight of hours."""
    log, out, report = folder / "long.mcap", folder / "out.mcap", folder / "report.json"
    page, scene, asl = folder / "page.html", folder / "scene.rrd", folder / "asl"
    subprocess.run([sys.executable, "-c", FLIGHT, str(3600.0 * hours), str(log)], check=True, env=rewrite.INSTALLED)
    lines: list[tuple[str, list[object], tuple[Path, ...]]] = [
        ("info", ["info", log, "--json", report], (report,)),
        ("info --noise", ["info", log, "--noise", "--json", report], (report,)),
        ("clean", ["clean", log, out, "-q", "--force"], (out,)),
        ("debias, hybrid", ["debias", log, out, "-q", "--force", "--model", MODEL], (out,)),
        ("debias --smooth, hybrid", ["debias", log, out, "-q", "--force", "--smooth", "--model", MODEL], (out,)),
        ("evaluate", ["evaluate", log, "--model", MODEL, "--json", report], (report,)),
        ("view --html", ["view", log, "--html", page, "-q"], (page,)),
        ("view --save", ["view", log, "--save", scene, "-q"], (scene,)),
        ("export", ["export", log, asl, "--format", "euroc", "-q"], (asl,)),
        ("diagnose", ["diagnose", log, "--json", report], (report,)),
    ]
    yield Row("numpy, scipy.signal", NUMERIC, "numpy, scipy.signal")
    for name, words, outputs in lines:
        yield Row(name, [IMUTOOL, *map(str, words)], "numpy, scipy.signal", outputs, once=True)


def taken(row: Row, rounds: int) -> rewrite.Spent:
    """The least of each figure over rounds; the first run fills the caches."""
    runs = []
    for count in range(int(row.once), 2 if row.once else rounds + 1):
        for path in row.outputs:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        spent = rewrite.timed(row.words)
        if count:
            runs.append(spent)
    for path in row.outputs:
        shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
    return rewrite.Spent(*(min(column) for column in zip(*runs, strict=True)))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--gb", type=float, default=0.4, help="size of the large log")
    parser.add_argument("--logs", type=int, default=100, help="how many small logs a fleet has")
    parser.add_argument("--mb", type=float, default=2.0, help="size of each")
    parser.add_argument("--hours", type=float, default=2.0, help="duration of the long log")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--in", dest="folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument(
        "--recordings", nargs="*", type=Path, default=(), metavar="LOG", help="logs with poses, to diagnose and train on"
    )
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    args = parser.parse_args()
    print(f"{args.rounds} rounds in {args.folder}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{'':34}{'CPU s':>8}{'wall s':>9}{'MB':>8}{'CPU / peer':>12}  peer")
    with tempfile.TemporaryDirectory(dir=args.folder) as name:
        folder = Path(name)
        parts = {
            "start": start,
            "small": lambda: small(folder),
            "large": lambda: large(folder, args.gb),
            "many": lambda: many(folder, args.logs, args.mb),
            "long": lambda: long(folder, args.hours),
            "diagnose": lambda: diagnosed(folder, args.recordings),
            "train": lambda: trained(folder, args.recordings),
        }
        for part in args.only:
            print(part)
            peer = 1.0
            for row in parts[part]():
                spent = taken(row, args.rounds)
                peer = spent.cpu if row.peer and row.name.startswith(row.peer) else peer
                ratio = f"{spent.cpu / peer:12.2f}  {row.peer}" if row.peer else ""
                print(f"  {row.name:32}{spent.cpu:8.2f}{spent.wall:9.2f}{spent.peak_mb:8.0f}{ratio}", flush=True)


if __name__ == "__main__":
    main()
