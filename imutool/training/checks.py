"""What would train without a word, and badly: logs of several sensors, too little motion, a truth that is not the IMU's."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from imutool.errors import ConfigError, DataError
from imutool.geometry import so3
from imutool.inertial.windows import rotation_residual
from imutool.recording import Recording
from imutool.training.segments import Pool

LEAST_S = 10.0  # of truth without gaps, in all logs together
LEAST_TURN_RAD_S = 0.02  # of the rate about its own mean: less is a sensor on a table
WINDOW_S = 1.0
WORST_MISS = 0.5  # of a log's largest turns; a scale error of a tenth misses by a tenth


def refuse_device(device: str) -> None:
    """Refuses a device that is not there.

    Raises:
        ConfigError: neither cpu nor cuda, or cuda where there is none.
    """
    if device.partition(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"{device!r} is no device", where="--device", expected="cpu or cuda")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError("no CUDA device here", where="--device", fix="Use --device cpu")


def refuse(recordings: Sequence[Recording], pool: Pool) -> None:
    """Refuses recordings that no model should be learned from.

    Raises:
        DataError: different sensors, too short, standing still, or a truth that does not follow the samples.
    """
    _one_sensor(recordings)
    n = pool.samples(WINDOW_S)
    first = pool.starts(n, "all", hop=n)
    if len(first) * WINDOW_S < LEAST_S:
        raise DataError(
            f"{len(first) * WINDOW_S:.0f} s of truth without gaps in all training logs",
            where=", ".join(pool.names),
            expected=f"at least {LEAST_S:g} s, and minutes for a useful model",
            fix="Add logs, or look at their truth with imutool info",
        )
    turning = float((pool.gyro - pool.gyro.mean(0)).norm(dim=1).median())
    if turning < LEAST_TURN_RAD_S:
        raise DataError(
            f"the sensor stands still: half of the time it turns by less than {turning:.3f} rad/s",
            where=", ".join(pool.names),
            expected=f"motion, more than {LEAST_TURN_RAD_S:g} rad/s",
            fix="Add logs in which it turns; for a sensor at rest, imutool debias needs no model",
        )
    _truths_follow(pool, first, n)


def _one_sensor(recordings: Sequence[Recording]) -> None:
    said = {r.name: str(r.metadata.get("imutool", {}).get("sensor", "")) for r in recordings}
    named = {sensor for sensor in said.values() if sensor}
    if len(named) > 1:
        listed = ", ".join(f"{name}: {sensor or 'not said'}" for name, sensor in said.items())
        raise DataError(f"training logs of different sensors ({listed})", expected="logs of one sensor")


def _truths_follow(pool: Pool, first: torch.Tensor, n: int) -> None:
    """Compares what the samples and the true poses say of the same seconds, constants apart."""
    windows = pool.windows(first, n, pool.t.new_zeros(len(first), 6))
    R_true = windows.R_start.mT @ windows.R_end
    e, _ = rotation_residual(windows.segment.gyro, windows.dt, R_true)
    turned = so3.log(R_true).norm(dim=1)
    for log, name in enumerate(pool.names):
        of_log = windows.log == log
        if not bool(of_log.any()):
            continue
        missed = float((e[of_log] - e[of_log].median(0).values).norm(dim=1).median())
        largest = float(turned[of_log].quantile(0.9))
        if missed > WORST_MISS * max(largest, LEAST_TURN_RAD_S * WINDOW_S):
            raise DataError(
                f"the true poses do not follow the gyro: they miss turns by {missed:.2f} rad a second, of {largest:.2f}",
                where=name,
                expected="poses of the IMU's own frame, on its clock",
                fix="Look at the frame and the time offset of the truth, or leave the log out",
            )
