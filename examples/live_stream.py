"""A sensor that is corrected while it measures, seen as it happens: a made-up one at 200 Hz, to a viewer or into an .rrd.

rerun &  python examples/live_stream.py 127.0.0.1:9876 [seconds]
         python examples/live_stream.py out.rrd [seconds]             as fast as it goes, since nobody waits
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

from imutool.bias import static
from imutool.bias_start.initial_bias import at_rest
from imutool.debiasing import Block, OnlineDebiaser
from imutool.mcap_io.batches import ImuBatch
from imutool.recording import Imu, nanoseconds
from imutool.sensor.flight import flight
from imutool.viewing.rerun.live import live_view

REST_S = 2.0  # how long the sensor is known to stand still after it is switched on
BATCH = 100  # samples that are shown together: half a second


def main(where: str, duration_s: float = 20.0) -> None:
    sensor, model = flight(1, duration_s=duration_s).imu, static.Model()
    still = sensor.between(int(sensor.t_ns[0]), int(sensor.t_ns[0]) + nanoseconds(REST_S))
    start = at_rest(model, still)
    online = OnlineDebiaser(model, start)
    std = np.tile(start.std, (BATCH, 1))

    file = Path(where) if where.endswith(".rrd") else None
    began = time.monotonic()
    with live_view("live", connect_to=None if file else where, save=file, instead=Path("live.rrd"), overwrite=True) as live:
        for first in range(0, len(sensor), BATCH):
            samples = sensor.rows(slice(first, first + BATCH))
            bias = np.stack(
                [online(*sample)[2] for sample in zip(samples.t_ns.tolist(), samples.gyro, samples.accel, strict=True)]
            )
            live(Block("/imu0", as_batch(samples, first), bias, std[: len(samples)]))
            if file is None:  # the time that the sensor would have taken
                time.sleep(max(0.0, began + (first + len(samples)) * sensor.period_s - time.monotonic()))
    print(f"{len(sensor)} samples in batches of {BATCH}, bias at the end {bias[-1].round(4)}")
    for shown in live.shown:
        print(shown.said)


def as_batch(imu: Imu, first: int) -> ImuBatch:
    """The samples as messages that were logged when they were measured."""
    sequence = np.arange(first, first + len(imu), dtype=np.uint32)
    return ImuBatch(imu.t_ns, imu.t_ns, sequence, imu.t_ns, imu.gyro, imu.accel, "imu")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(sys.argv[1], *map(float, sys.argv[2:]))
