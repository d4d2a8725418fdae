"""Show a log, raw and as a model corrects it: a viewer (without a window an .rrd), and a page to send on.

python examples/view_a_log.py log.mcap [model]      a file, a name of `imutool models`, or static
"""

from __future__ import annotations

import sys
from pathlib import Path

import imutool


def main(log: Path, model: str = "static") -> None:
    run = imutool.load_run(log, models=[model])
    for trace in run.traces:
        if trace.errors is not None:  # only with true poses
            print(f"{trace.name}: at the end {trace.errors.orientation_total_deg[-1]:.2f} deg off")
    for event in run.events:
        print(f"{(event.start_ns - run.start_ns) * 1e-9:.3f} s  {event.kind}: {event.text}")

    for output in (*imutool.view(run, html=f"{log.stem}.html", overwrite=True), *imutool.view(run, overwrite=True)):
        print(output.said)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *sys.argv[2:])
