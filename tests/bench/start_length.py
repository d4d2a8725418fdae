"""How much truth a start should take, asked of the training sequences: `python tests/bench/start_length.py FOLDER`.

FOLDER is what `python tests/bench/accuracy.py DATA --seeds 1 --swap --keep FOLDER` left: logs, and models trained on the
other half. Prints the mean AOE in degrees over the training sequences, started from 2, 5 and 10 s of truth.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from accuracy import TRAIN

from imutool import metrics, turn_on
from imutool.bias._file import load
from imutool.debias import apply
from imutool.mcap_io.read import read
from imutool.strapdown import along_truth

LENGTHS_S = (2.0, 5.0, 10.0)


def main() -> None:
    """One line a data set and method."""
    folder = Path(sys.argv[1])
    for name, sequences in TRAIN.items():
        recordings = [read(folder / name / f"{sequence}.mcap", truth="/ground_truth/pose") for sequence in sequences]
        for method in ("linear", "neural_ode"):
            model = load(folder / f"{name}-{method}-0-swapped.safetensors")
            line = f"{name:8}{method:12}"
            for turn_on.TRUTH_S in LENGTHS_S:
                aoe = []
                for recording in recordings:
                    debiased = apply(model, turn_on.from_truth(model, recording), recording.imu).imu
                    aoe.append(metrics.evaluate(*along_truth(debiased, recording.truth, recording.name))["aoe_deg"])
                line += f"{turn_on.TRUTH_S:6.0f} s: {np.mean(aoe):.2f}"
            print(line, flush=True)


if __name__ == "__main__":
    main()
