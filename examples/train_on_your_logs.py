"""Trains a bias model on logs of your own sensor; each needs an IMU and true poses (motion capture, a good SLAM, RTK).

python examples/train_on_your_logs.py mine.safetensors run1.mcap run2.mcap [steps=300 gyro_window_s=[1,4,15] ...]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from imutool.config import load
from imutool.log_info import inspect
from imutool.training.fit import Epoch, TrainSettings
from imutool.training.run import train


def show(epoch: Epoch) -> None:
    print(f"{epoch.sensor:>5} {epoch.step:4d}/{epoch.steps}: held out {epoch.held_out:.4f}, closed form {epoch.before:.4f}")


def main(model: Path, logs: Sequence[Path], words: Sequence[str] = ()) -> None:
    for log in logs:
        for warning in inspect(log)["warnings"]:
            print(f"{log}: {warning}")
    trained = train(logs, model, settings=load(TrainSettings, None, words), overwrite=True, progress=show)
    for sensor, figures in trained.card["held_out"].items():
        print(f"{model}: {sensor} held-out error {figures['error']:.4f} {figures['unit']}")


if __name__ == "__main__":
    given = sys.argv[2:]
    if not given:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), [Path(word) for word in given if "=" not in word], [word for word in given if "=" in word])
