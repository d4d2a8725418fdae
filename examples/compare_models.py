"""Several models on the same log, side by side: their figures as a table, and an .rrd in which each has its own curves.

python examples/compare_models.py log.mcap out.rrd static [model]...
"""

from __future__ import annotations

import sys
from pathlib import Path

from imutool.cli import terminal
from imutool.viewing.model.runs import load
from imutool.viewing.rerun import scene


def main(log: Path, target: Path, models: list[str]) -> None:
    data = load(log, models=models)
    rows = [["figure", *(trace.name for trace in data.traces)]]
    rows += [[label, *("" if value is None else f"{value:.4g}" for value in values)] for label, values in data.table()]
    terminal.table(rows, keys=1)
    for trace in data.models():
        for window in trace.windows:
            drifts = f"{window.orientation_deg:.3f} deg, {window.position_m:.3f} m"
            print(f"{trace.name}: over {window.length_s:g} s from the truth it drifts by {drifts} ({window.count} windows)")
    print(scene.save([data], target, overwrite=True).said)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
