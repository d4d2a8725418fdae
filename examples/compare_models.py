"""Several models on the same log, side by side: their figures as a table, and an .rrd in which each has its own curves.

python examples/compare_models.py log.mcap out.rrd static [model]...
"""

from __future__ import annotations

import sys

import imutool


def main(log: str, target: str, models: list[str]) -> None:
    run = imutool.load_run(log, models=models)
    print(f"{'figure':20}", *(f"{trace.name:>12}" for trace in run.traces))
    for label, values in run.table():
        print(f"{label:20}", *(f"{'' if value is None else f'{value:.4g}':>12}" for value in values))
    for trace in run.models():
        for window in trace.windows:
            drifts = f"{window.orientation_deg:.3f} deg, {window.position_m:.3f} m"
            print(f"{trace.name}: over {window.length_s:g} s from the truth it drifts by {drifts} ({window.count} windows)")
    for output in imutool.view(run, save=target, overwrite=True):
        print(output.said)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2], sys.argv[3:])
