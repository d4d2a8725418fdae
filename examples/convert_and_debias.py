"""From a data set to a debiased log and its error figures, without the command line.

python examples/convert_and_debias.py MH_04_difficult.zip out [model.safetensors]
"""

from __future__ import annotations

import sys

import imutool


def main(source: str, folder: str, model: str = "static") -> None:
    for log in imutool.convert(source, f"{folder}/").written:  # with a slash it is a folder, also for one log
        debiased = log.with_name(f"{log.stem}_debiased.mcap")
        report = imutool.debias(log, debiased, model=model)
        for topic, start in report.starts.items():
            print(f"{debiased}: {topic} with {report.models[topic]}, initial bias from {start.how}")
        if not any(poses.kind == "truth" for poses in imutool.info(log).truth):
            print("  without true poses there are no errors to show")
            continue
        for result in imutool.evaluate(log, models=[model]):
            print(f"  {result['model']:>12}: orientation {result['aoe_deg']:8.2f} deg, position {result['ape_m']:8.2f} m")


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
