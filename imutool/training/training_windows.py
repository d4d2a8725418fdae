"""Windows of training logs: truth on the IMU's clock, gaps masked, the last part held out.

All logs lie end to end in one set of tensors, and a window is the index of its first sample; a batch is one gather over
as many logs as it happens to touch, so that every step of a training mixes all sequences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Bool, Float, Int
from imutool.bias.networks import static
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias_start.stretches import StretchClock
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.stationary import GAP_PERIODS
from imutool.inertial.strapdown import with_velocity
from imutool.inertial.windows import rotation_residual
from imutool.log_info.convention_report import check_one_sensor
from imutool.recording import Recording, seconds
from imutool.training.settings import PoseFloors
from imutool.units import SENSORS, Sensor

HELD_OUT = 0.2  # the last fifth of every training log validates, as in the paper
MAX_RATE_SPREAD = 0.05

MIN_S = 10.0  # of truth without gaps, in all logs together
MIN_TURN_RAD_S = 0.02  # of the rate about its own mean, over a second: less is a sensor on a table
TURNING = 0.9  # share of the seconds in which a car on a straight road, or a robot that waits, may turn by less
WINDOW_S = 1.0
WORST_MISS = 0.2  # of a log's largest turns; EuRoC, TUM-VI, FETCH and BROAD miss by at most 3 %, inverse quaternions by 40 %

Part = Literal["train", "held_out", "all"]
SAMPLED = ("gyro", "accel", "R_wb", "v_w", "p_wb")  # columns of a pool
FLAGS = ("trusted", "held_out", "late")


@dataclass(frozen=True)
class Windows:
    """Windows of n samples, the true poses at both ends, and the log of each."""

    segment: Segment
    dt: Float[Tensor, "batch steps"]
    R_start: Float[Tensor, "batch 3 3"]
    R_end: Float[Tensor, "batch 3 3"]
    v_start: Float[Tensor, "batch 3"]
    v_end: Float[Tensor, "batch 3"]
    p_start: Float[Tensor, "batch 3"]
    p_end: Float[Tensor, "batch 3"]
    log: Int[Tensor, " batch"]


@dataclass(frozen=True)
class Pool:
    """Every sample of the training logs, end to end, with the truth at each."""

    names: tuple[str, ...]
    rate_hz: float
    t: Float[Tensor, " n"]  # s from the start of its log
    gyro: Float[Tensor, "n 3"]
    accel: Float[Tensor, "n 3"]
    R_wb: Float[Tensor, "n 3 3"]
    v_w: Float[Tensor, "n 3"]
    p_wb: Float[Tensor, "n 3"]
    log: Int[Tensor, " n"]
    trusted: Bool[Tensor, " n"]
    held_out: Bool[Tensor, " n"]
    late: Bool[Tensor, " n"]  # samples are missing just before this one
    spans_ns: tuple[tuple[int, int], ...]  # stamps of the first and last sample of each log
    floors: Float[Tensor, "logs 2"]  # least residual of each log's windows: gyro (rad), accel (m/s)
    sensors: tuple[Sensor, ...] = SENSORS  # those that the truth shows: the gyro alone where a log's poses have no positions

    @classmethod
    def of(
        cls,
        recordings: Sequence[Recording],
        dtype: torch.dtype = torch.float64,
        device: str = "cpu",
        floors: PoseFloors | None = None,
    ) -> Pool:
        """All recordings of one sensor.

        Raises:
            DataError: no truth, logs sampled at different rates, or no log long enough to hold anything.
        """
        pools = [cls._of_log(recording, dtype, device, floors or PoseFloors()) for recording in recordings]
        rates = [pool.rate_hz for pool in pools]
        if max(rates) / min(rates) - 1 > MAX_RATE_SPREAD:
            listed = ", ".join(f"{pool.names[0]} {pool.rate_hz:.1f}" for pool in pools)
            wanted, fix = "logs of one sensor at one rate", "Train a model for each rate, or restamp logs whose stamps jitter"
            raise DataError(f"training logs at different rates ({listed} Hz)", expected=wanted, fix=fix)
        if len(pools) == 1:
            return pools[0]
        columns = {name: torch.cat([getattr(pool, name) for pool in pools]) for name in ("t", *SAMPLED, *FLAGS, "floors")}
        return cls(
            names=tuple(pool.names[0] for pool in pools),
            rate_hz=float(np.median(rates)),
            log=torch.cat([pool.log + i for i, pool in enumerate(pools)]),
            spans_ns=tuple(pool.spans_ns[0] for pool in pools),
            sensors=min((pool.sensors for pool in pools), key=len),
            **columns,
        )

    @classmethod
    def _of_log(cls, recording: Recording, dtype: torch.dtype, device: str, floors: PoseFloors) -> Pool:
        """One recording, on its IMU's clock."""
        try:
            both = recording.overlap()
        except DataError as error:
            raise error.at(recording.name) from error
        imu, (poses, trusted) = both.imu, with_velocity(both.truth).at(both.imu.t_ns)
        t = seconds(StretchClock()(imu.t_ns), int(imu.t_ns[0]))
        flags = (trusted, t > (1 - HELD_OUT) * t[-1], np.diff(t, prepend=t[0]) > GAP_PERIODS * imu.period_s)
        sampled = {"gyro": imu.gyro, "accel": imu.accel, "v_w": poses.v_w, "p_wb": poses.p_wb}
        return cls(
            names=(recording.name,),
            rate_hz=1.0 / imu.period_s,
            spans_ns=((int(imu.t_ns[0]), int(imu.t_ns[-1])),),
            sensors=SENSORS if both.truth.has_positions else sensors_up_to("gyro"),
            t=torch.tensor(t, dtype=dtype, device=device),
            log=torch.zeros(len(t), dtype=torch.long, device=device),
            floors=torch.tensor([floors.of(recording.kind_of(next(iter(recording.truths))))], dtype=dtype, device=device),
            R_wb=so3.matrices_from_rows_wxyz(poses.q_wb_wxyz).to(device, dtype),
            **{name: torch.tensor(x, dtype=dtype, device=device) for name, x in sampled.items()},
            **{name: torch.tensor(x, device=device) for name, x in zip(FLAGS, flags, strict=True)},
        )

    def of_sensor(self, sensor: Sensor) -> Float[Tensor, "n 3"]:
        """The samples of a sensor."""
        return self.gyro if sensor == "gyro" else self.accel

    def minimum(self, sensor: Sensor) -> Float[Tensor, " logs"]:
        """Least residual of each log's windows."""
        return self.floors[:, SENSORS.index(sensor)]

    def samples(self, window_s: float) -> int:
        """How many steps a window of this length takes."""
        return max(1, round(window_s * self.rate_hz))

    def starts(self, n: int, part: Part, *, hop: int = 1, ends_only: bool = False) -> Int[Tensor, " m"]:
        """First samples of all windows of n steps that stay in one log and one part, and touch no gap in truth or samples.

        Of every `hop` one is kept. With `ends_only` the truth is asked for at the two ends alone: for validation over times
        longer than its gaps are apart.
        """
        first = torch.arange(0, max(len(self.t) - n, 0), hop, device=self.t.device)
        last = first + n
        keep = self.log[first] == self.log[last]
        if part != "all":
            wanted = part == "held_out"
            keep &= (self.held_out[first] == wanted) & (self.held_out[last] == wanted)
        keep &= self.trusted[first] & self.trusted[last]
        breaks = torch.cumsum(self.late, dim=0)
        keep &= breaks[last] == breaks[first]
        if not ends_only:
            holes = torch.cumsum(~self.trusted, dim=0)
            keep &= holes[last] == holes[first]
        return first[keep]

    def around(self, first: Int[Tensor, " batch"], before: int, after: int) -> Int[Tensor, "batch _"]:
        """Indices from `before` to `after` samples about some; the first and last of their log repeat."""
        log = self.log[first]
        begin, end = torch.searchsorted(self.log, log), torch.searchsorted(self.log, log, right=True) - 1
        index = first[:, None] + torch.arange(-before, after + 1, device=first.device)
        return torch.minimum(torch.maximum(index, begin[:, None]), end[:, None])

    def windows(self, first: Int[Tensor, " batch"], n: int, rest: Float[Tensor, "batch 6"]) -> Windows:
        """The windows of n steps that start at some samples, each from its own rest bias."""
        return self.at(first[:, None] + torch.arange(n + 1, device=first.device), rest)

    def at(self, index: Int[Tensor, "batch samples"], rest: Float[Tensor, "batch 6"]) -> Windows:
        """The windows of these samples: all between their ends, or some."""
        first, last, t = index[:, 0], index[:, -1], self.t[index]
        return Windows(
            segment=Segment(t - t[:, :1], self.gyro[index], self.accel[index], rest),
            dt=torch.diff(t, dim=1),
            R_start=self.R_wb[first],
            R_end=self.R_wb[last],
            v_start=self.v_w[first],
            v_end=self.v_w[last],
            p_start=self.p_wb[first],
            p_end=self.p_wb[last],
            log=self.log[first],
        )


CHUNK = 8192  # samples at a time: what is in memory does not depend on how long a log is


@torch.no_grad()
def corrected(
    model: BiasNetwork, pool: Pool, part: Part = "all", sensors: Sequence[Sensor] = SENSORS
) -> tuple[BiasNetwork, Pool]:
    """A model and a pool that are scored over windows as the given ones at work over whole logs.

    A model that looks back (`BiasNetwork.context`) would be shown a window without the samples before it, and would be
    computed anew for every window that overlaps another. What it adds to the rest bias depends on the samples alone: here it
    is taken off them, with their real history, and a constant remains. Only the samples of `part` and the columns of
    `sensors` are corrected. Models that do not look back, and their pool, come back as they are.

    Of a model that forgets its start, what it adds to that start is taken off whole logs.
    """
    if model.forgets:
        return static.Network().to(pool.t), without_motion(model, pool)
    if not model.context:
        return model, pool
    columns = {"gyro": pool.gyro.clone(), "accel": pool.accel.clone()}
    nothing = pool.t.new_zeros(1, 6)
    wanted = torch.ones_like(pool.held_out) if part == "all" else pool.held_out == (part == "held_out")
    for log in range(len(pool.names)):
        for some in torch.split(torch.nonzero(wanted & (pool.log == log))[:, 0], CHUNK):
            index = pool.around(some[:1], model.context, len(some) - 1)[0]
            t = pool.t[index]
            segment = Segment((t - t[0])[None], pool.gyro[index][None], pool.accel[index][None], nothing)
            for sensor in sensors:
                columns[sensor][some] -= model.sensor_bias(sensor, segment)[0, model.context :]
    return static.Network().to(pool.t), replace(pool, gyro=columns["gyro"], accel=columns["accel"])


def without_motion(model: BiasNetwork, pool: Pool) -> Pool:
    """Pool without what a model adds to its prior, as in `bias_start.bias_tracking`."""
    inference, samples = model.frozen(), torch.cat([pool.gyro, pool.accel], dim=1)
    start, residual = inference.prior_mean, samples.clone()
    for log in range(len(pool.names)):
        rows = pool.log == log
        t_s, u = (x[rows].cpu().double().numpy() for x in (pool.t, samples))
        residual[rows] -= torch.from_numpy(inference.stream(start)(t_s, u[:, :3], u[:, 3:]) - start).to(residual)
    return replace(pool, gyro=residual[:, :3].clone(), accel=residual[:, 3:].clone())


def sensors_up_to(sensor: Sensor) -> tuple[Sensor, ...]:
    """A sensor and those trained before it.

    The accelerometer's errors depend on the gyro, not the other way round.
    """
    return SENSORS[: SENSORS.index(sensor) + 1]


def check_trainable(recordings: Sequence[Recording], pool: Pool) -> None:
    """Refuses recordings that no model should be learned from.

    Raises:
        DataError: different sensors, too short, standing still, or a truth that does not follow the samples.
    """
    check_one_sensor(recordings)
    n = pool.samples(WINDOW_S)
    first = pool.starts(n, "all", hop=n)
    if len(first) * WINDOW_S < MIN_S:
        raise DataError(
            f"{len(first) * WINDOW_S:.0f} s of truth without gaps in all training logs",
            where=", ".join(pool.names),
            expected=f"at least {MIN_S:g} s, and minutes for a useful model",
            fix="Add logs, or look at their truth with imutool info",
        )
    rates = pool.gyro[first[:, None] + torch.arange(n)].mean(1)  # noise is no motion
    turning = float((rates - rates.mean(0)).norm(dim=1).quantile(TURNING))
    if turning < MIN_TURN_RAD_S:
        what = f"the sensor hardly turns: {TURNING:.0%} of the time by less than {turning:.3f} rad/s"
        expected = f"turns of more than {MIN_TURN_RAD_S:g} rad/s"
        fix = "Add logs in which it turns; for a sensor at rest, imutool debias needs no model"
        raise DataError(what, where=", ".join(pool.names), expected=expected, fix=fix)
    _truths_follow(pool, first, n)


def _truths_follow(pool: Pool, first: Tensor, n: int) -> None:
    """Compares what the samples and the true poses say of the same seconds, constants apart."""
    windows = pool.windows(first, n, pool.t.new_zeros(len(first), 6))
    R_true = windows.R_start.mT @ windows.R_end
    e, _ = rotation_residual(windows.segment.gyro, windows.dt, R_true)
    turned = so3.log(R_true).norm(dim=1)
    wrong = {}
    for log, name in enumerate(pool.names):
        of_log = windows.log == log
        if not bool(of_log.any()):
            continue
        missed = float((e[of_log] - e[of_log].median(0).values).norm(dim=1).median())
        largest = float(turned[of_log].quantile(0.9))
        if missed > WORST_MISS * max(largest, MIN_TURN_RAD_S * WINDOW_S):
            wrong[name] = f"{missed:.2f} rad a second, of {largest:.2f}"
    if wrong:
        raise DataError(
            f"the true poses do not follow the gyro: they miss turns by {'; '.join(wrong.values())}",
            where=", ".join(wrong),
            expected="poses of the IMU's own frame, on its clock",
            fix="Look at the frame and the time offset of the truth with imutool info, or leave these logs out",
        )
