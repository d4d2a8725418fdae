"""The tests that draw seeds, with many more of them: false findings of `diagnose` on noise, effects missed or misnamed.

    python tests/bench/seeds.py --times 10

Tests of the files below run with that many times the seeds of the suite; pytest prints how many passed and which failed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SEEDED = (
    "tests/diagnosis/signals/test_signal_diagnosis.py",
    "tests/diagnosis/estimation/test_model_error.py",
    "tests/diagnosis/estimation/test_model_selection.py",
    "tests/diagnosis/audit/test_audit.py",
)


def main() -> int:
    """Exit code of pytest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10)
    options = parser.parse_args()
    line = [sys.executable, "-m", "pytest", "-q", "-n", "auto", *SEEDED]
    return subprocess.run(line, cwd=ROOT, env={**os.environ, "SEEDS": str(options.times)}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
