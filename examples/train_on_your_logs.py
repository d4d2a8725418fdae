"""Train a bias model on logs of your own sensor; each needs an IMU and true poses (motion capture, a good SLAM, RTK).

python examples/train_on_your_logs.py mine.safetensors run1.mcap run2.mcap [steps=300 gyro_window_s=[1,4,15] ...]
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Sequence
from typing import Any

import imutool


def show(epoch: Any) -> None:
    step = f"{epoch.sensor:>5} {epoch.step:4d}/{epoch.steps}: held out {epoch.held_out:.4f}, closed form {epoch.before:.4f}"
    print(epoch.note or step)


def main(model: str, logs: Sequence[str], settings: dict[str, Any]) -> None:
    for log in logs:
        for warning in imutool.info(log).warnings:
            print(f"{log}: {warning}")
    trained = imutool.train(logs, model, settings=settings, overwrite=True, progress=show)
    for sensor, figures in trained.card["held_out"].items():
        print(f"{model}: {sensor} held-out error {figures['error']:.4f} {figures['unit']}")


if __name__ == "__main__":
    words = sys.argv[2:]
    if not words:
        sys.exit(__doc__)
    main(
        sys.argv[1],
        [word for word in words if "=" not in word],
        tomllib.loads("\n".join(word for word in words if "=" in word)),
    )
