"""Debiases sample by sample, as a live node would; a log stands in for the driver, and the time per sample is measured.

python examples/online_node.py log.mcap [model.safetensors]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from imutool.bias import static
from imutool.bias.io import find_model
from imutool.bias_start.initial_bias import at_rest
from imutool.debiasing import OnlineDebiaser
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.recording import nanoseconds

REST_S = 2.0  # how long the sensor is known to stand still after it is switched on


def driver(log: Path) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Stamp (ns), angular rate (rad/s) and specific force (m/s²), one sample at a time."""
    with Log(log) as opened:
        for batch in opened.imu_batches(opened.imu_topics[0]):
            yield from zip(batch.stamp_ns.tolist(), batch.gyro, batch.accel, strict=True)


def main(log: Path, name: str | None = None) -> None:
    model = find_model(name) if name else static.Model()
    whole = read(log).imu  # a live node would collect these two seconds
    still = whole.between(int(whole.t_ns[0]), int(whole.t_ns[0]) + nanoseconds(REST_S))
    start = at_rest(model, still)
    print(f"start bias from {start.how}: gyro {start.rest[:3].round(5)} rad/s, accel {start.rest[3:].round(4)} m/s^2")

    online, latency_s = OnlineDebiaser(model, start), []
    for stamp_ns, gyro, accel in driver(log):
        began = time.perf_counter()
        rate, force, bias = online(stamp_ns, gyro, accel)
        latency_s.append(time.perf_counter() - began)
    print(f"last sample: rate {rate.round(4)} rad/s, force {force.round(3)} m/s^2, bias {bias.round(4)}")
    median, slow = np.percentile(latency_s, [50, 99]) * 1e6
    print(f"{len(latency_s)} samples, {median:.0f} us each (99 % within {slow:.0f} us)")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), *sys.argv[2:])
