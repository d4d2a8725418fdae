"""The rest bias a run starts from: measured at rest or from the truth, weighed against what the sensor's other runs had.

Every way gives a value and how sure it is; a measurement and the prior are combined by their variances, axis by axis (for a
measurement along one direction, as a Kalman update). With a model that adds a motion-dependent part C(u), what is
measured is what is left of the samples after that part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from imutool import so3
from imutool.bias._base import BiasModel, Vector6
from imutool.errors import ConfigError, DataError
from imutool.recording import GRAVITY_M_S2, Imu, Recording, nanoseconds, seconds
from imutool.stationary import stretches
from imutool.strapdown import GRAVITY_W, with_velocity
from imutool.windows import attitudes, rotation_residual, velocity_residual

TRUTH_S = 5.0  # how much of the truth a start takes: longer is surer, but less of a start
AT_REST_STD = np.array([1e-4] * 3 + [0.03] * 3)  # earth's rotation; local gravity and what a tilt hides
REST_BEGINS_WITHIN_S = 5.0  # later, its bias would be one of the future
ITERATIONS = 4

WAYS = ("auto", "stationary", "prior", "truth")


@dataclass(frozen=True)
class TurnOn:
    """A rest bias (gyro rad/s, accel m/s²), its standard deviation, and how it came about in a few words."""

    rest: Vector6
    std: Vector6
    how: str
    noise: Vector6 = field(default_factory=lambda: np.zeros(6))  # of a sample, where it could be measured


def find(way: str, model: BiasModel, recording: Recording) -> TurnOn:
    """The start that `--init WAY` asks for; `auto` is the first seconds at rest where there are any, else the prior.

    Raises:
        ConfigError: an unknown way, or six numbers that are none.
        DataError: `stationary` on a log that does not start at rest, `truth` without truth at its start, or `auto` with an
            untrained model and no stationary stretch.
    """
    if way == "prior":
        return prior(model)
    if way == "truth":
        return from_truth(model, recording)
    if way == "stationary":
        return at_rest(model, recording.imu)
    if way == "auto":
        try:
            return at_rest(model, recording.imu)
        except DataError:
            if not model.card:
                raise
            return prior(model)
    return given(way)


def given(text: str) -> TurnOn:
    """Six numbers from the command line: gx,gy,gz in rad/s, ax,ay,az in m/s².

    Raises:
        ConfigError: not six finite numbers, and not one of the ways either.
    """
    try:
        rest = np.array([float(word) for word in text.split(",")])
    except ValueError:
        rest = np.zeros(0)
    if rest.shape != (6,) or not np.isfinite(rest).all():
        raise ConfigError(f"{text!r}", where="--init", expected=f"{', '.join(WAYS)} or gx,gy,gz,ax,ay,az")
    return TurnOn(rest, np.zeros(6), "given")


def prior(model: BiasModel) -> TurnOn:
    """What the sensor had in its training runs."""
    return TurnOn(_numpy(model.prior_mean), _numpy(model.prior_std), "prior of the training runs")


def at_rest(model: BiasModel, imu: Imu) -> TurnOn:
    """From the stretch at rest that the log starts with.

    Raises:
        DataError: there is none.
    """
    starts_by = np.searchsorted(imu.t_ns, imu.t_ns[0] + nanoseconds(REST_BEGINS_WITHIN_S)) if len(imu) else 0
    found = [stretch for stretch in stretches(imu) if stretch[0] <= starts_by]
    if not found:
        raise DataError(
            "the log does not start at rest",
            expected=f"1.5 s or more without motion in the first {REST_BEGINS_WITHIN_S:g} s",
            fix="Give --init prior with a trained model, or six numbers",
        )
    return _from_rest(model, imu, found[:1])


def over_all_rest(model: BiasModel, imu: Imu) -> TurnOn:
    """From all the time at rest in a log, also what comes after the motion: a constant has no before and after.

    Raises:
        DataError: the log never rests.
    """
    found = stretches(imu)
    if not found:
        raise DataError("the log never rests", expected="1.5 s or more without motion")
    return _from_rest(model, imu, found)


def _from_rest(model: BiasModel, imu: Imu, found: Sequence[tuple[int, int]]) -> TurnOn:
    """True rate zero; specific force g along where it points, so the accelerometer's bias is seen along gravity only."""
    start = prior(model)
    rest, var = start.rest.copy(), start.std**2
    rows = [imu.rows(slice(*stretch)) for stretch in found]
    left = [np.concatenate([still.gyro, still.accel], axis=1) - _bias(model, still, start.rest) for still in rows]
    everything = np.concatenate(left)
    noise = np.concatenate([part - part.mean(axis=0) for part in left]).std(axis=0)

    gain = var[:3] / (var[:3] + AT_REST_STD[:3] ** 2 + noise[:3] ** 2 / len(everything))
    rest[:3] += gain * everything[:, :3].mean(axis=0)
    var[:3] *= 1 - gain
    for part in left:  # attitude may differ from stop to stop: each shows another direction
        force = part[:, 3:].mean(axis=0) - (rest[3:] - start.rest[3:])
        size = float(np.linalg.norm(force))
        up = force / size
        gain = var[3:] * up / (up @ (var[3:] * up) + AT_REST_STD[3] ** 2)
        rest[3:] += gain * (size - GRAVITY_M_S2)
        var[3:] *= 1 - gain * up
    total = sum(still.duration_s for still in rows)
    first = seconds(imu.t_ns[[found[0][0]]], int(imu.t_ns[0]))[0]
    return TurnOn(rest, np.sqrt(var), f"{total:.1f} s at rest from {first:.1f} s on", noise)


def from_truth(model: BiasModel, recording: Recording) -> TurnOn:
    """From the first `TRUTH_S` of true poses (gaps in between do no harm: only the ends are used), and the prior.

    Raises:
        DataError: no truth, or none that reaches that far.
    """
    both = recording.overlap()
    imu, truth = both.imu, both.truth
    poses, trusted = with_velocity(truth).at(imu.t_ns)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    usable = np.flatnonzero(trusted)
    ends = usable[t[usable] >= t[usable[0]] + TRUTH_S] if len(usable) else usable
    if not len(ends):
        raise DataError(f"less than {TRUTH_S:g} s of truth", where=recording.name, expected="truth at the start")
    first, last = int(usable[0]), int(ends[0])
    piece = imu.rows(slice(first, last + 1))
    assert poses.v_w is not None
    R = so3.matrix_from_quaternion_wxyz(torch.from_numpy(np.array(poses.q_wb_wxyz[[first, last]])))
    dv = torch.from_numpy(poses.v_w[last] - poses.v_w[first])[None]
    dt = torch.from_numpy(np.diff(t[first : last + 1]))[None]
    start = prior(model)
    offset = _solve_offset(piece, _bias(model, piece, start.rest), R[:1], R[1:], dv, dt)
    var, measured = start.std**2, _numpy(model.truth_std) ** 2
    gain = np.divide(var, var + measured, out=np.zeros(6), where=var > 0)  # a prior without doubt stays
    how = f"truth over {t[last] - t[first]:.1f} s, weighed against the training runs" if model.card else "truth"
    return TurnOn(start.rest + gain * offset, np.sqrt(gain * measured), how)


def _solve_offset(
    imu: Imu, bias: Float64[np.ndarray, "n 6"], R_start: Tensor, R_end: Tensor, dv: Tensor, dt: Tensor
) -> Vector6:
    """The constant that, taken off on top of `bias`, makes rotation and velocity end where the truth does."""
    rate, force = (torch.from_numpy(u)[None] for u in (imu.gyro - bias[:, :3], imu.accel - bias[:, 3:]))
    offset = torch.zeros(2, 3, dtype=torch.float64)
    for _ in range(ITERATIONS):
        e, A = rotation_residual(rate - offset[0], dt, R_start.mT @ R_end)
        offset[0] -= torch.linalg.solve(A.sum(1), e)[0]
    R_wb = attitudes(R_start, rate - offset[0], dt)
    e, A = velocity_residual(force, dt, R_wb, dv, torch.tensor(GRAVITY_W, dtype=torch.float64))
    offset[1] -= torch.linalg.solve(A.sum(1), e)[0]
    return offset.flatten().numpy()


def _bias(model: BiasModel, imu: Imu, rest: Vector6) -> Float64[np.ndarray, "n 6"]:
    """The model's bias over some samples from a rest bias."""
    return model.stream(rest)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)


def _numpy(buffer: Tensor) -> Vector6:
    value: Vector6 = buffer.detach().cpu().double().numpy().copy()
    return value
