"""Debias sample by sample, as a live node would; a log stands in for the driver, and the time per sample is measured.

python examples/online_node.py log.mcap [model.safetensors]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np

import imutool

REST_S = 2.0  # the sensor stands still for this long after it is switched on


def driver(path: str) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Stamp (ns), angular rate (rad/s) and specific force (m/s²), one sample at a time."""
    with imutool.Log(path) as log:
        for batch in log.imu_batches(log.imu_topics[0]):
            yield from zip(batch.stamp_ns.tolist(), batch.gyro, batch.accel, strict=True)


def main(path: str, name: str = "static") -> None:
    model = imutool.load_model(name)
    imu = imutool.read(path).imu  # a live node would collect the first two seconds
    start = imutool.bias_at_rest(model, imu.rows(slice(0, round(REST_S / imu.period_s))))
    print(f"initial bias from {start.how}: gyro {start.rest[:3].round(5)} rad/s, accel {start.rest[3:].round(4)} m/s²")

    online, latency_s = imutool.OnlineDebiaser(model, start), []
    for stamp_ns, gyro, accel in driver(path):
        began = time.perf_counter()
        rate, force, bias = online(stamp_ns, gyro, accel)
        latency_s.append(time.perf_counter() - began)
    print(f"last sample: rate {rate.round(4)} rad/s, force {force.round(3)} m/s², bias {bias.round(4)}")
    median, slow = np.percentile(latency_s, [50, 99]) * 1e6
    print(f"{len(latency_s)} samples, {median:.0f} us each (99 % within {slow:.0f} us)")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
