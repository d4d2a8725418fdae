"""The rest bias a run starts from: measured at rest or from the truth, weighed against what the sensor's other runs had.

Every way gives a value and how sure it is; a measurement and the prior are combined by their variances, axis by axis (for a
measurement along one direction, as a Kalman update). With a model that adds a motion-dependent part C(u), what is
measured is what is left of the samples after that part.

`auto` and `truth` are a start and more: from there on the rest bias is followed, by every stop and by gravity in motion
(`imutool.bias_start.bias_tracking`), so that the bias of a sample depends on that sample and earlier ones. The one exception
is what the
start was measured on, the stop that a log begins with or the first seconds of truth: its samples get what the whole of it says.
`smooth` takes the whole log for each sample.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from imutool.bias.model import BiasModel, RestBiasEstimator, Stream, Vector6
from imutool.bias_start.bias_from_truth import bias_from_truth
from imutool.bias_start.bias_tracking import (
    USUAL_WALK,
    BiasPrior,
    BiasTrajectory,
    ConstantBiasStream,
    FilteredBlock,
    Samples,
    TrackedBiasStream,
    TrajectoryBiasStream,
    filter_blocks,
    smooth_bias,
)
from imutool.errors import ConfigError, DataError
from imutool.geometry import so3
from imutool.inertial.stationary import Blocks, rest_stretches, resting_blocks, white_noise
from imutool.inertial.strapdown import with_velocity
from imutool.recording import GRAVITY_M_S2, Imu, Recording, nanoseconds, seconds

TRUTH_S = 15.0  # how much of the truth a start takes: of 3, 5, 8, 10 and 15 s the best on training logs left out in turn
LEAST_TRUTH_S = 1.0
WORLD_TILT_STD = np.array([0.0] * 3 + [0.1] * 3)  # m/s²: half a degree, as of EuRoC's second Vicon room (docs/diagnosis.md)
AT_REST_STD = np.array([1e-4] * 3 + [0.03] * 3)  # earth's rotation; local gravity and what a tilt hides
REST_BEGINS_WITHIN_S = 5.0  # later, its bias would be one of the future
MAD_TO_STD = 1.4826
LEAST_STD = np.array([1e-6] * 3 + [1e-4] * 3)  # a prior without any doubt would leave nothing to estimate
TRACKED_BY = "gravity in motion and every stop"

METHODS = ("auto", "stationary", "prior", "truth")


class NoRestError(DataError):
    """Nothing is known of the sensor, and nothing is shown by the log."""


@dataclass(frozen=True)
class InitialBias:
    """A rest bias (gyro rad/s, accel m/s²), its standard deviation, and how it came about in a few words.

    It holds for the whole log, or is where something begins: `track`, the rest bias in time, or what the samples show from
    `hold_s` on (s from the first sample), given that `follows` was known before them.
    """

    rest: Vector6
    std: Vector6
    how: str
    noise: Vector6 = field(default_factory=lambda: np.zeros(6))  # of a sample, where it could be measured
    track: BiasTrajectory | None = None
    follows: BiasPrior | None = None
    hold_s: float = 0.0

    def stream(self, model: BiasModel) -> Stream:
        """The model at work from this start on."""
        if self.track is not None:
            return TrajectoryBiasStream(model, self.track)
        if self.follows is not None:
            return TrackedBiasStream(model, self.follows, self.rest, self.hold_s)
        return model.stream(self.rest)

    def estimator(self, model: BiasModel) -> RestBiasEstimator:
        """The model at work from this start on, with the covariance of the rest bias."""
        if self.track is not None:
            return TrajectoryBiasStream(model, self.track)
        if self.follows is not None:
            return TrackedBiasStream(model, self.follows, self.rest, self.hold_s)
        return ConstantBiasStream(model, self.rest, self.std)

    @property
    def tracked(self) -> bool:
        """Whether the rest bias follows the samples, or stays constant over the whole log."""
        return self.track is not None or self.follows is not None


def find(way: str, model: BiasModel, recording: Recording) -> InitialBias:
    """The start that `--init WAY` asks for.

    Raises:
        ConfigError: an unknown way, or six numbers that are none.
        DataError: `stationary` on a log that does not start at rest, `truth` without truth at its start, or `auto` with an
            untrained model and no stationary stretch.
    """
    if way == "prior":
        return prior(model)
    if way == "truth" or way.startswith("truth:"):
        return from_truth(model, recording, _truth_s(way))
    if way == "stationary":
        return at_rest(model, recording.imu)
    if way == "auto":
        return auto(model, recording.imu)
    return from_numbers(way)


def auto(model: BiasModel, imu: Imu) -> InitialBias:
    """The stop that the log begins with, weighed against the training runs; from there on the rest bias is followed.

    Only the samples up to the end of that stop are used.

    Raises:
        DataError: an untrained model, and the log does not start at rest.
    """
    rested: list[FilteredBlock] = []
    before = bias_prior(model)
    for block in filter_blocks(model, [_samples(imu)], before, ahead=True):
        if not block.resting:
            break
        rested.append(block)
    if not rested:
        if not model.card:
            raise _no_rest()
        return tracked_from_prior(model)
    end, state = rested[-1].end_s, rested[-1].step.after
    std = np.sqrt(np.diag(state.covariance(False)))  # in motion, where it is to serve
    still = imu.rows(slice(0, int(np.searchsorted(imu.t_ns, imu.t_ns[0] + nanoseconds(end)))))
    noise = white_noise(np.concatenate([still.gyro, still.accel], axis=1))
    used = f"{end - rested[0].start_s:.1f} s at rest from 0.0 s on"
    if model.card:
        used = f"{used}, {_from_training(model)}"
    return InitialBias(
        state.rest_bias(True), std, f"{used}, {_accuracy(std)}, then {TRACKED_BY}", noise, follows=before, hold_s=end
    )


def tracked_from_prior(model: BiasModel) -> InitialBias:
    """The prior, and from the first sample on what the samples show: for a live node, which cannot look ahead."""
    start = prior(model)
    return InitialBias(
        start.rest, start.std, f"{_from_training(model)}, {_accuracy(start.std)}, then {TRACKED_BY}", follows=bias_prior(model)
    )


def smoothed_start(model: BiasModel, batches: Iterable[Samples], where: str = "") -> InitialBias:
    """The rest bias in time from the whole of a log: all its stops, gravity in motion, and the training runs.

    `batches` are seconds since the first sample, gyro and accel.

    Raises:
        DataError: less than half a second of samples.
        NoRestError: an untrained model, and a log that never rests.
    """
    track, rested_s = smooth_bias(model, batches, bias_prior(model))
    if not len(track.t_s):
        raise DataError("too short to be smoothed", where=where, expected="at least half a second of samples")
    if not model.card and not rested_s:
        raise NoRestError("the log never rests", where=where, expected="1.5 s or more without motion")
    std = np.median(track.std, axis=0)
    parts = [f"{rested_s:.1f} s at rest in all"] * (rested_s > 0) + ["gravity in motion"]
    parts += [_from_training(model)] * bool(model.card)
    return InitialBias(track.rest[0], std, f"{', '.join(parts)}, {_accuracy(std)}, forward and backward", track=track)


def bias_prior(model: BiasModel) -> BiasPrior:
    """What the training runs say of the next run's biases; how far they walk is alike for the axes of a sensor."""
    ground = np.maximum(_numpy(model.rest_std), AT_REST_STD)
    walk = np.repeat(np.sqrt(np.mean(_numpy(model.walk_std).reshape(2, 3) ** 2, axis=1)), 3)
    walk = np.where(walk > 0, walk, USUAL_WALK)
    return BiasPrior(_numpy(model.prior_mean), np.maximum(_numpy(model.prior_std), LEAST_STD), ground, walk)


def rest_spread(model: BiasModel, logs: Sequence[Samples], rest: Float64[np.ndarray, "logs 6"]) -> Vector6:
    """How far the bias at rest lies from the log's rest bias in motion, as a robust standard deviation about zero.

    `rest` is each log's own, from its truth. The gyro's by axis; the accelerometer is seen along gravity alone, and its three
    axes get the same. Never below `AT_REST_STD`; that itself where no log rests.
    """
    away = []
    for (t_s, gyro, accel), own in zip(logs, rest, strict=True):
        t_ns = np.round(t_s * 1e9).astype(np.int64)
        left = np.concatenate([gyro, accel], axis=1) - model.stream(own)(t_s, gyro, accel)
        for first, last in rest_stretches(Imu(t_ns, gyro, accel)):
            mean = left[first:last].mean(axis=0)
            away.append([*mean[:3], *[np.linalg.norm(mean[3:]) - GRAVITY_M_S2] * 3])
    if not away:
        return AT_REST_STD.copy()
    spread: Vector6 = np.maximum(MAD_TO_STD * np.median(np.abs(away), axis=0), AT_REST_STD)
    return spread


def _samples(imu: Imu) -> Samples:
    return seconds(imu.t_ns, int(imu.t_ns[0]) if len(imu) else 0), imu.gyro, imu.accel


def _from_training(model: BiasModel) -> str:
    if "prior" in model.card:  # a file that was not trained says itself where its bias is from
        return str(model.card["prior"])
    logs = model.card.get("logs", ())
    return f"prior of {len(logs)} runs" if len(logs) > 1 else "prior of the training runs"


def _accuracy(std: Vector6) -> str:
    """The least sure axis of the gyro."""
    return f"±{std[:3].max():.1g} rad/s"


def from_numbers(text: str) -> InitialBias:
    """Six numbers from the command line: gx,gy,gz in rad/s, ax,ay,az in m/s².

    Raises:
        ConfigError: not six finite numbers, and not one of the ways either.
    """
    try:
        rest = np.array([float(word) for word in text.split(",")])
    except ValueError:
        rest = np.zeros(0)
    if rest.shape != (6,) or not np.isfinite(rest).all():
        raise ConfigError(f"{text!r}", where="--init", expected=f"{', '.join(METHODS)} or gx,gy,gz,ax,ay,az")
    return InitialBias(rest, np.zeros(6), "given")


def _truth_s(way: str) -> float:
    """Seconds of `truth:SECONDS`.

    Raises:
        ConfigError: not a positive number.
    """
    text = way.partition(":")[2] or str(TRUTH_S)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{way!r}", where="--init", expected="truth:SECONDS, for instance truth:5")
    return value


def prior(model: BiasModel) -> InitialBias:
    """What the sensor had in its training runs."""
    return InitialBias(_numpy(model.prior_mean), _numpy(model.prior_std), "prior of the training runs")


def at_rest(model: BiasModel, imu: Imu) -> InitialBias:
    """From the stretch at rest that the log starts with.

    Raises:
        DataError: there is none.
    """
    starts_by = np.searchsorted(imu.t_ns, imu.t_ns[0] + nanoseconds(REST_BEGINS_WITHIN_S)) if len(imu) else 0
    found = [stretch for stretch in rest_stretches(imu) if stretch[0] <= starts_by]
    if not found:
        raise _no_rest()
    return _from_rest(model, imu, found[0])


def _no_rest() -> DataError:
    return DataError(
        "the log does not start at rest",
        expected=f"1.5 s or more without motion in the first {REST_BEGINS_WITHIN_S:g} s",
        fix="Give --init prior with a trained model, or six numbers",
    )


def over_all_rest(model: BiasModel, blocks: Blocks) -> InitialBias:
    """From all the time at rest in a log, also what comes after the motion: a constant has no before and after.

    For a model that takes nothing off but a constant: of the samples there is only what `stationary.block_statistics` keeps.

    Raises:
        DataError: the log never rests.
    """
    found = resting_blocks(blocks)
    if not found:
        raise DataError("the log never rests", expected="1.5 s or more without motion")
    stills = []
    for first, last in found:
        part, mean = slice(first, last), blocks.mean[first:last].mean(axis=0)
        apart = (blocks.k - 1) * blocks.var[part] + blocks.k * (blocks.mean[part] - mean) ** 2
        ends_ns = int(blocks.first_ns[first]), int(blocks.last_ns[last - 1])
        stills.append(_RestStretch(mean, apart.sum(axis=0), (last - first) * blocks.k, *ends_ns))
    return _combined(prior(model), stills, int(blocks.first_ns[0]))


class _RestStretch(NamedTuple):
    """A stretch at rest: what the samples are on average, their squared distance from that in all, and how many there are."""

    mean: Vector6
    apart: Vector6
    samples: int
    start_ns: int
    end_ns: int


def _from_rest(model: BiasModel, imu: Imu, found: tuple[int, int]) -> InitialBias:
    """From one stretch at rest, with what the model says of the motion taken off."""
    start, still = prior(model), imu.rows(slice(*found))
    left = np.concatenate([still.gyro, still.accel], axis=1) - _bias(model, still, start.rest) + start.rest
    mean = left.mean(axis=0)
    apart = ((left - mean) ** 2).sum(axis=0)
    return _combined(start, [_RestStretch(mean, apart, len(still), int(still.t_ns[0]), int(still.t_ns[-1]))], int(imu.t_ns[0]))


def _combined(start: InitialBias, stills: Sequence[_RestStretch], first_ns: int) -> InitialBias:
    """True rate zero; specific force g along where it points, so the accelerometer's bias is seen along gravity only."""
    rest, var = start.rest.copy(), start.std**2
    count = sum(still.samples for still in stills)
    noise = np.sqrt(np.sum([still.apart for still in stills], axis=0) / count)
    mean = np.sum([still.mean * still.samples for still in stills], axis=0) / count

    gain = var[:3] / (var[:3] + AT_REST_STD[:3] ** 2 + noise[:3] ** 2 / count)
    rest[:3] += gain * (mean[:3] - start.rest[:3])
    var[:3] *= 1 - gain
    for still in stills:  # attitude may differ from stop to stop: each shows another direction
        force = still.mean[3:] - rest[3:]
        size = float(np.linalg.norm(force))
        up = force / size
        gain = var[3:] * up / (up @ (var[3:] * up) + AT_REST_STD[3] ** 2)
        rest[3:] += gain * (size - GRAVITY_M_S2)
        var[3:] *= 1 - gain * up
    total_s = 1e-9 * sum(still.end_ns - still.start_ns for still in stills)
    first_s = 1e-9 * (stills[0].start_ns - first_ns)
    return InitialBias(rest, np.sqrt(var), f"{total_s:.1f} s at rest from {first_s:.1f} s on", noise)


def from_truth(model: BiasModel, recording: Recording, truth_s: float = TRUTH_S) -> InitialBias:
    """From the first seconds of true poses, as many as there are up to `truth_s` (gaps do no harm), and the prior.

    They hold for as long as they last; from there on the rest bias is followed. What follows goes by gravity, from which the
    truth's world may lean: beside true poses that is a bias of the accelerometer, and afterwards it is an error.

    Raises:
        DataError: no truth, or less than a second of it.
    """
    both = recording.overlap()
    imu, truth = both.imu, both.truth
    poses, trusted = with_velocity(truth).at(imu.t_ns)
    t = seconds(imu.t_ns, int(imu.t_ns[0]))
    usable = np.flatnonzero(trusted)
    usable = usable[t[usable] <= t[usable[0]] + truth_s] if len(usable) else usable
    found_s = float(t[usable[-1]] - t[usable[0]]) if len(usable) else 0.0
    if found_s < LEAST_TRUTH_S:
        raise DataError(
            f"{found_s:.1f} s of truth", where=recording.name, expected=f"at least {LEAST_TRUTH_S:g} s of it at the start"
        )
    rows = slice(int(usable[0]), int(usable[-1]) + 1)
    piece, poses = imu.rows(rows), poses.rows(rows)
    assert poses.v_w is not None
    start = prior(model)
    left = np.concatenate([piece.gyro, piece.accel], axis=1) - _bias(model, piece, start.rest)
    R_wb = so3.matrix_from_quaternion_wxyz(torch.from_numpy(np.array(poses.q_wb_wxyz)))
    offset = bias_from_truth(t[rows], left, R_wb, torch.from_numpy(np.array(poses.v_w)), trusted[rows])
    measured = _numpy(model.truth_std) ** 2 * (TRUTH_S / found_s) ** 2
    rest, std = _updated(start, offset, measured)
    how = f"truth over {found_s:.1f} s{', weighed against the training runs' if model.card else ''}, {_accuracy(std)}"
    if not model.card:
        return InitialBias(rest, std, how)
    upright, unsure = _updated(start, offset, measured + WORLD_TILT_STD**2)
    before = replace(bias_prior(model), mean=upright, std=np.maximum(unsure, LEAST_STD))
    ends = seconds(piece.t_ns[-1:], int(recording.imu.t_ns[0]))[0]
    return InitialBias(rest, std, f"{how}, then {TRACKED_BY}", follows=before, hold_s=float(ends))


def _updated(start: InitialBias, offset: Vector6, variance: Vector6) -> tuple[Vector6, Vector6]:
    """A start moved towards where a measurement of this variance says it is off by `offset`: rest bias and its deviation."""
    var = start.std**2
    gain = np.divide(var, var + variance, out=np.zeros(6), where=var > 0)  # a prior without doubt stays
    return start.rest + gain * offset, np.sqrt(gain * variance)


def _bias(model: BiasModel, imu: Imu, rest: Vector6) -> Float64[np.ndarray, "n 6"]:
    """The model's bias over some samples from a rest bias."""
    return model.stream(rest)(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)


def _numpy(buffer: Tensor) -> Vector6:
    value: Vector6 = buffer.detach().cpu().double().numpy().copy()
    return value
