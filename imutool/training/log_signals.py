"""Signals of training logs, and the load that the sensor bore before each log.

The states z of a drift K z begin at zero in a cold sensor. A sensor that was in use before begins with what its load left,
z_0 exp(-t / tau). As for a log to debias (`imutool.bias_start.earlier_load`), z_0 is what the mean load of the log would have
left after a time T, so that T is the only new unknown of a log. The times are those of the largest likelihood of all logs
together, with every other unknown integrated out; the sensor of a log is as likely cold as not.

With the times given the decay is linear in K, as the drift is. So one linearisation with a free decay serves for all times, and
a small matrix for each log and time puts K z_0 in the place of its amplitude.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from imutool.array_types import Float, Float64, Int
from imutool.bias import temperature
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.temperature import online_signals
from imutool.bias_start.earlier_load import EARLIER_S, PRIOR, loads_after
from imutool.bias_start.fitness import head
from imutool.bias_start.stretches import measured_recording, read_stretches
from imutool.geometry import so3
from imutool.inertial.strapdown import truth_velocity
from imutool.recording import Poses, Recording, nanoseconds, seconds
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.linear_form import LinearForm, linear_form
from imutool.sensor.samples import SensorSamples
from imutool.sensor.signals import LOAD, LOAD_TAU_S, LOADS, Load, SignalFilter, Signals
from imutool.training.calibration.closed_form import Solution
from imutool.training.calibration.log_scatter import CLOCK, LEVER, ROTATION, Integrated, integrated, minus_log_likelihood
from imutool.training.calibration.normal_equations import Seen, Terms, linearise
from imutool.training.calibration.shared_parameters import Problem
from imutool.training.settings import SensorPrior
from imutool.training.training_windows import Pool
from imutool.units import AXES, Sensor

MIN_PART_S = 60.0  # of each log, where all are too much
TRIADS_RAD = 5e-3  # plausible rotation between the gyro and the accelerometer of one chip
OFF_DIAGONAL, DIAGONAL = (1, 2, 3, 5, 6, 7), (0, 4, 8)  # of a 3x3 matrix, row by row
COLD = 0  # index of the time zero
SWEEPS = 5
CLEAR = 10.0  # of twice the log-likelihood, by which different times beat one for all (as BIC: Kass and Raftery 1995)

logger = logging.getLogger(__name__)


def read_parts(
    logs: Sequence[Path], max_samples: int, *, imu: str | None = None, truth: str | None = None
) -> list[tuple[Path, Recording]]:
    """Measurements of logs, and of each stretch of their clocks, of at most so many samples.

    Of the longest only the first seconds are kept. Where a minute of each would be too much, every other log is left out.

    Raises:
        ConfigError, LogError, DataError: a log without IMU or measurements.
    """
    unread, parts, cut = list(logs), list[tuple[Path, Recording]](), set[Path]()
    while unread:
        log = unread.pop(0)
        parts += [(log, measured_recording(part)) for part in read_stretches(log, imu=imu, truth=truth)]
        maximum = _max_of_each(parts, max_samples)
        while maximum * parts[0][1].imu.period_s < MIN_PART_S and len(parts) > 1:
            unread, parts = unread[len(parts) % 2 :: 2], parts[::2]
            maximum = _max_of_each(parts, max_samples)
        for k, (path, part) in enumerate(parts):
            if len(part.imu) > maximum:
                first = part.between(int(part.imu.t_ns[0]), int(part.imu.t_ns[maximum - 1]))
                parts[k] = path, copy.deepcopy(first)  # without the rest in memory
                cut.add(path)
    used = {path: part.imu.duration_s for path, part in parts}
    remarks = [f"only {len(used)} of {len(logs)} logs are used"] * (len(used) < len(set(logs)))
    if shorter := [used[path] for path in cut & used.keys()]:
        remarks.append(f"only the first {max(shorter):.0f} s of long logs")
    if remarks:
        logger.warning("%s: a sample takes 3 kB of memory; --set most_samples=N takes more", ", and ".join(remarks))
    return parts


def _max_of_each(parts: Sequence[tuple[Path, Recording]], maximum: int) -> int:
    """Number of samples to which longer parts have to be cut for a sum of at most `maximum`."""
    remaining = maximum
    for k, count in enumerate(sorted(len(part.imu) for _, part in parts)):
        level = remaining // (len(parts) - k)
        if count > level:
            return level
        remaining -= count
    return maximum


def turned_alike(
    W: Float[Tensor, "3 3"], covariance: Float[Tensor, "9 9"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "9 9"]]:
    """Matrix of an accelerometer that is turned as a gyro with the matrix W, and its covariance.

    Poses without positions show the gyro alone. The rotation in W, the orthogonal factor of I - W, is mostly the mount of the
    poses' body, which turns both sensors: an accelerometer that stayed behind would contradict the gyro.
    """
    left, _, right = torch.linalg.svd(torch.eye(3).to(W) - W)
    R = left @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(left @ right).sign())]).to(W)) @ right
    swapped = torch.eye(9).to(W).reshape(3, 3, 9).transpose(0, 1).reshape(9, 9)
    J = (torch.eye(9).to(W) - swapped) / 2.0  # the antisymmetric part
    turns = so3.hat(torch.eye(3).to(W)).reshape(3, 9)
    return torch.eye(3).to(W) - R, J @ covariance @ J.mT + TRIADS_RAD**2 * turns.mT @ turns


def begin_at(network: BiasNetwork, sensor: Sensor, solution: Solution, trained: Sequence[Sensor]) -> None:
    """Start a network from a closed form; where the gyro alone is trained, turn both sensors."""
    solved = {sensor: (solution.W, solution.covariance)}
    if (*trained,) == ("gyro",):
        solved["accel"] = turned_alike(*solved["gyro"])
    for each, (W, covariance) in solved.items():
        network.begin_at(each, W)
        network.take_covariance(each, covariance)


def matrix_covariance(covariance: Float[Tensor, "9 9"]) -> Float[Tensor, "9 9"]:
    """Covariance of a matrix, row by row, from that of misalignment and scale."""
    place = torch.tensor([*OFF_DIAGONAL, *DIAGONAL]).argsort()
    return covariance[place][:, place]


def effects_turned_alike(
    names: Sequence[str], theta: Float[Tensor, " p"], covariance: Float[Tensor, "p p"]
) -> tuple[tuple[str, ...], Float[Tensor, " q"], Float[Tensor, "q q"]]:
    """Effects of an accelerometer turned as the gyro is, their parameters and covariance."""
    if "gyro_misalignment" not in names:
        return (), theta[:0], covariance[:0, :0]
    entries = {"gyro_misalignment": OFF_DIAGONAL, "gyro_scale": DIAGONAL}
    places = [
        entries[form.name][k] if form.name in entries else None
        for form in temperature.forms("gyro", tuple(names))
        for k in range(len(form.parameters))
    ]
    S = torch.stack([torch.eye(9).to(theta)[place] if place is not None else theta.new_zeros(9) for place in places], dim=1)
    W, C = turned_alike((S @ theta).reshape(3, 3), S @ covariance @ S.mT)
    order = [*OFF_DIAGONAL, *DIAGONAL]
    return ("accel_misalignment", "accel_scale"), W.flatten()[order], C[order][:, order]


def without_nuisances(
    log: Recording, gyro: Float64[np.ndarray, " o"], accel: Float64[np.ndarray, " u"] | None = None
) -> Recording:
    """Recording whose poses are those of the sensor, by each sensor's own unknowns of this log.

    The gyro's turn and shift them, the accelerometer's lever arm moves them.
    """
    late_s, truth = gyro[CLOCK["gyro"]].item(), log.truth
    R_wb = Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * Rotation.from_rotvec(-gyro[ROTATION["gyro"]])
    q_wb_wxyz = np.ascontiguousarray(R_wb.as_quat(scalar_first=True))
    poses = Poses(truth.t_ns - nanoseconds(late_s), truth.p_wb, q_wb_wxyz, truth.v_w)
    if accel is not None:
        arm = replace(poses, p_wb=R_wb.apply(accel[LEVER["accel"]]), v_w=None)
        v_w = None if poses.v_w is None else poses.v_w - truth_velocity(arm)
        poses = replace(poses, p_wb=poses.p_wb - arm.p_wb, v_w=v_w)
    return replace(log, truths={next(iter(log.truths)): poses})


def with_poses_of_sensor(recordings: Sequence[Recording], own: Iterable[Float[Tensor, "logs _"]]) -> list[Recording]:
    """Recordings without the nuisances of their poses, by each sensor's fit.

    A network would take what belongs to a log for the sensor's.
    """
    of_logs = zip(recordings, *(of_sensor.cpu().numpy() for of_sensor in own), strict=True)
    return [without_nuisances(*of_log) for of_log in of_logs]


def _decayed(samples: SensorSamples, theta: Theta) -> SensorSamples:
    z = np.exp(-samples.stamp_s[:, None] / LOAD_TAU_S)
    return samples.with_added("gyro", z @ theta.reshape(3, len(LOAD_TAU_S)).T)


DECAY = Effect(
    "gyro_decay",
    Stage.SENSOR,
    ("gyro",),
    "gyro += sum_k A_k exp(-t / tau_k)",
    tuple(Parameter(f"{axis}_{tau_s:g}s", "rad/s", 0.01) for axis in AXES for tau_s in LOAD_TAU_S),
    "the log is longer than tau",
    _decayed,
    diagnosed=False,
)


def _behind_load(form: LinearForm) -> bool:
    """Whether an effect is a drift behind the load."""
    return form.columns is not None and int(form.columns.min()) >= LOAD.start


def signals_of(pool: Pool) -> Signals:
    """Signals of all logs, end to end; filters start at each log's first sample in the pool."""
    parts = []
    for log in range(len(pool.names)):
        rows = pool.log == log
        t, gyro, accel = (x[rows].cpu().double().numpy() for x in (pool.t, pool.gyro, pool.accel))
        parts.append(SignalFilter(pool.rate_hz)(t, gyro, accel))
    return Signals(np.concatenate([part.t_s for part in parts]), np.concatenate([part.columns for part in parts]))


def loaded_signals(
    recordings: Sequence[Recording],
    pool: Pool,
    scale: temperature.Scale | None,
    names: Sequence[str] | None,
    sensors: SensorPrior,
) -> tuple[Signals, list[Load | None]]:
    """Signals of the samples in a pool, and the load before each log.

    None where its sensor is taken for cold. `names` are effects of the gyro that may explain it: every trained one by default.
    """
    counts = torch.bincount(pool.log).tolist()
    loads: list[Load | None] = [None] * len(recordings)
    signals = online_signals(recordings, counts, pool.rate_hz, scale, loads)
    forms = catalogue.trained("gyro", None if names is None else [name for name in names if name not in temperature.EFFECTS])
    if not any(_behind_load(form) for form in forms):
        return signals, loads
    terms = Terms.of((*forms, linear_form(DECAY, "gyro")), signals, sensors, pool)
    problem = linearise(Seen(pool, "gyro", pool.gyro), terms, "train")
    tried = [_loads(recording, pool.rate_hz) for recording in recordings]
    times = _likeliest(problem, [[_decay_matrix(forms, load) for load in some] for some in tried])
    loads = [some[time] if time != COLD else None for some, time in zip(tried, times, strict=True)]
    return (online_signals(recordings, counts, pool.rate_hz, scale, loads) if any(times) else signals), loads


def _loads(recording: Recording, rate_hz: float) -> Float64[np.ndarray, "t 3 11"]:
    """States that a log may begin with, for each of the times."""
    imu = recording.imu
    return loads_after(rate_hz, head([(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)]))


def _decay_matrix(forms: Sequence[LinearForm], load: Load) -> Float[Tensor, "d p"]:
    """Matrix from the parameters of effects to the decay that an earlier load leaves: A = D theta."""
    own = []
    for form in forms:
        D = np.zeros((len(AXES), len(LOAD_TAU_S), len(form.parameters)))
        if _behind_load(form):
            assert form.columns is not None
            place = form.columns - LOAD.start
            by_term = load.ravel()[place][:, None] * (place[:, None] // LOADS == np.arange(len(LOAD_TAU_S)))
            D = np.einsum("qk,iqp->ikp", by_term, form.pattern)
        own.append(D.reshape(-1, len(form.parameters)))
    return torch.from_numpy(np.concatenate(own, axis=1))


def _likeliest(problem: Problem, decays: Sequence[Sequence[Float[Tensor, "d p"]]]) -> list[int]:
    """Index of each log's time, the likeliest of all logs together: one log after the other, from every common time.

    One time for all is no news: a drift that every log has passed alike cannot be told from none. All are taken for cold then.
    """
    fit, logs = problem.fit.moved(-problem.theta), list(range(len(decays)))
    merged = [[_merged(fit.H[log], fit.g[log], D) for D in decays[log]] for log in logs]
    H, g = (torch.stack([torch.stack([of_time[part] for of_time in of_log]) for of_log in merged]) for part in (0, 1))
    prior = problem.prior[: decays[0][0].shape[1]]
    alone = integrated(H, g, problem.own[:, None], problem.own_prior, len(prior))  # by log and time
    alone = alone._replace(c=alone.c - 2.0 * torch.from_numpy(np.log(PRIOR)).to(alone.c))

    def minus_twice(times: Int[Tensor, "tried logs"]) -> Float[Tensor, " tried"]:
        return minus_log_likelihood(Integrated(*(part[logs, times] for part in alone)), torch.zeros_like(prior), prior)

    every = torch.arange(len(EARLIER_S), device=prior.device)
    best: list[tuple[float, list[int]]] = []
    for start in range(len(EARLIER_S)):
        times = every.new_full((len(logs),), start)
        for _ in range(SWEEPS):
            before = times
            for log in logs:
                tried = times.repeat(len(every), 1)
                tried[:, log] = every
                times = tried[minus_twice(tried).argmin()]
            if torch.equal(times, before):
                break
        best.append((float(minus_twice(times[None])), times.tolist()))
    common = float(minus_twice(every[:, None].expand(-1, len(logs))).min())
    likeliest, found = min(best)
    return found if likeliest < common - CLEAR else [COLD] * len(decays)


def _merged(
    H: Float[Tensor, "k k"], g: Float[Tensor, " k"], D: Float[Tensor, "d p"]
) -> tuple[Float[Tensor, "m m"], Float[Tensor, " m"]]:
    """Loss of a log with D theta in the place of its decay."""
    decay, parameters = D.shape
    others = len(g) - parameters - decay
    B = torch.zeros(len(g), parameters + others).to(g)
    B[:parameters, :parameters] = torch.eye(parameters).to(g)
    B[parameters : parameters + decay, :parameters] = D.to(g)
    B[parameters + decay :, parameters:] = torch.eye(others).to(g)
    return B.mT @ H @ B, B.mT @ g
