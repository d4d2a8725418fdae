"""A log as it was recorded and as a model corrects it: in a viewer, or where no window opens as an .rrd; and a page to send on.

python examples/view_a_log.py log.mcap [model]      a file, a name of `imutool models`, or static
"""

from __future__ import annotations

import sys
from pathlib import Path

from imutool.viewing.html import report
from imutool.viewing.model.runs import load
from imutool.viewing.rerun import viewer


def main(log: Path, model: str = "static") -> None:
    data = load(log, models=[model])
    for trace in data.traces:
        if trace.errors is not None:  # without truth there are none
            print(f"{trace.name}: at the end {trace.errors.orientation_total_deg[-1]:.2f} deg off")
    for event in data.events:
        print(f"{(event.start_ns - data.start_ns) * 1e-9:.3f} s  {event.kind}: {event.text}")

    page = Path(f"{log.stem}.html")
    report.write_page([data], page, overwrite=True)
    print(f"Wrote {page}: it needs no viewer and asks nobody for anything.")
    print(viewer.show([data], overwrite=True).said)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *sys.argv[2:])
