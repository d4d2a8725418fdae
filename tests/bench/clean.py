"""What a clean-up finds in real logs, and what its first pass costs on made-up ones without images.

`python tests/bench/clean.py --logs LOG...` says of each log what is found in it, by every rule, and at the end what of the
whole: notes are what was seen and called nothing wrong. The logs are those that `imutool convert` makes of EuRoC, TUM-VI and
FETCH.

`python tests/bench/clean.py [--minutes 10 60]` measures the cost.

For each length: CPU seconds of `imutool.cleaning.look`, next to a pass that only reads and decodes the same IMU messages, and
next to `imutool.log_info.inspection.inspect`, which reads the IMU several times; each in a process of its own, with the memory
it takes at most beyond what the imports take. The log is in the page cache. Poses stand next to the IMU at 20 Hz.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.imu_defects import survey

from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import flight

RATE_HZ = 200.0
PIECE_S = 60.0  # of motion, again and again

PASS = """
import json, re, sys, time
from pathlib import Path
from imutool.cleaning import look, raw_batches
from imutool.log_info.inspection import inspect
from imutool.mcap_io.log import Log
import scipy.spatial.transform, imutool.cleaning.rules.axes

def peak_mb():  # not ru_maxrss, which a process takes over from the one that started it
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024

def read(path):
    with Log(path) as log:
        for batch in raw_batches(log, "/imu0"):
            batch.gyro.sum()

def survey(path):
    with Log(path) as log:
        look(log, "/imu0")

run = {"read": read, "survey": survey, "info": inspect}[sys.argv[1]]
before, began = peak_mb(), time.process_time()
run(Path(sys.argv[2]))
print(json.dumps({"cpu_s": time.process_time() - began, "more_mb": peak_mb() - before}))
"""


def write_long(path: Path, minutes: float) -> int:
    """A log of so many minutes; returns its number of samples."""
    piece = flight(1, duration_s=PIECE_S, rate_hz=RATE_HZ)
    count = round(minutes * 60.0 * RATE_HZ)
    rows = np.arange(count) % (len(piece.imu) - 1)
    t_ns = piece.imu.t_ns[0] + np.arange(count) * round(1e9 / RATE_HZ)
    imu = Imu(t_ns, piece.imu.gyro[rows], piece.imu.accel[rows])
    poses = piece.truth.at(piece.imu.t_ns)[0]
    truth = Poses(t_ns[::10], poses.p_wb[rows[::10]], poses.q_wb_wxyz[rows[::10]])
    write(Recording("long", imu, {"/ground_truth/pose": truth}), path, compression="none")
    return count


def run(what: str, log: Path) -> dict[str, float]:
    """One pass in a process of its own."""
    done = subprocess.run([sys.executable, "-c", PASS, what, str(log)], check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def findings(logs: list[Path]) -> None:
    """Prints what is found in each log, and the sums."""
    told: Counter[str] = Counter()
    for path in sorted(logs):
        one = survey(path)
        told += Counter(finding.severity for finding in one.findings)
        found = [f"{finding.severity}: {finding.count} {finding.what} ({finding.rule})" for finding in one.findings]
        counts = f"{one.valid} of {one.messages} samples valid"
        print(
            f"{path.parent.name}/{path.stem}: {one.verdict}, score {one.score:.3f}, {counts}; {'; '.join(found) or 'nothing'}"
        )
    print(f"{len(logs)} logs: {told['error']} errors, {told['warning']} warnings, {told['note']} notes")


def main() -> None:
    """Prints one line a log, or one a length and pass."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--logs", type=Path, nargs="+", metavar="LOG", help="say what is found in these, and measure nothing")
    parser.add_argument("--minutes", type=float, nargs="+", default=[10.0, 60.0])
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    if options.logs:
        findings(options.logs)
        return
    print(f"{time.strftime('%Y-%m-%d')}, least of {options.rounds} rounds")
    with tempfile.TemporaryDirectory() as folder:
        for minutes in options.minutes:
            log = Path(folder) / "long.mcap"
            samples = write_long(log, minutes)
            found = {what: [run(what, log) for _ in range(options.rounds)] for what in ("read", "survey", "info")}
            minimum = {what: min(one["cpu_s"] for one in rounds) for what, rounds in found.items()}
            for what, rounds in found.items():
                memory = min(one["more_mb"] for one in rounds)
                ratio = minimum[what] / minimum["read"]
                print(
                    f"{minutes:6.0f} min  {what:6}  {minimum[what]:7.2f} s CPU  {ratio:5.1f} x read  "
                    f"{samples / minimum[what] / 1e3:7.0f} k samples/s  {memory:6.0f} MB more"
                )
            log.unlink()


if __name__ == "__main__":
    main()
