"""Correct a sensor while it measures and show it live: a made-up sensor at 200 Hz, to a viewer or into an .rrd.

rerun &  python examples/live_stream.py 127.0.0.1:9876 [seconds]
         python examples/live_stream.py out.rrd [seconds]             as fast as it goes, because nobody waits
"""

from __future__ import annotations

import sys
import time

import numpy as np

import imutool

REST_S = 2.0  # the sensor stands still for this long after it is switched on
BATCH = 100  # samples shown together: half a second


def main(where: str, duration_s: float = 20.0) -> None:
    sensor, model = imutool.example_recording(duration_s=duration_s).imu, imutool.load_model("static")
    start = imutool.bias_at_rest(model, sensor.rows(slice(0, round(REST_S / sensor.period_s))))
    online = imutool.OnlineDebiaser(model, start)
    to_file = where.endswith(".rrd")
    output = {"save": where} if to_file else {"connect": where}

    began = time.monotonic()
    with imutool.watch("live", **output, overwrite=True) as live:
        for first in range(0, len(sensor), BATCH):
            samples = sensor.rows(slice(first, first + BATCH))
            bias = np.stack(
                [online(*sample)[2] for sample in zip(samples.t_ns.tolist(), samples.gyro, samples.accel, strict=True)]
            )
            live.add(samples, bias, np.tile(start.std, (len(samples), 1)))
            if not to_file:  # the time that the sensor would have taken
                time.sleep(max(0.0, began + (first + len(samples)) * sensor.period_s - time.monotonic()))
    print(f"{len(sensor)} samples in batches of {BATCH}, bias at the end {bias[-1].round(4)}")
    for shown in live.outputs:
        print(shown.said)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(sys.argv[1], *map(float, sys.argv[2:]))
