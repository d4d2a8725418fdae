"""Initial bias measured at rest.

True rate zero, specific force g along an unknown direction.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias import static
from imutool.bias.model import BiasModel, Vector6
from imutool.bias_start.bias_tracking import BiasFilter, FilteredBlock, Samples, filter_blocks, filter_together, without_motion
from imutool.bias_start.initial_bias import (
    AT_REST_STD,
    TRACKED_BY,
    InitialBias,
    accuracy,
    bias_prior,
    prior,
    relative_samples,
    smooth_bias,
    tracked_from_prior,
    tracked_in_motion,
    training_source,
)
from imutool.bias_start.prior_width import MAX_DEVIATIONS, MAX_UNKNOWN, BiasPrior, supported_std, widened
from imutool.errors import DataError
from imutool.inertial.inertial_filter import MIN_FORCE_M_S2
from imutool.inertial.innovations import MIN_DRIVEN_M_S, SURPRISING, innovations
from imutool.inertial.stationary import CALM, MAX_SHAKING, Blocks, rest_stretches, resting_blocks, white_noise
from imutool.recording import GRAVITY_M_S2, Imu, nanoseconds
from imutool.recording.columns import true_ranges

LOOK_AHEAD_S = 60.0  # in which a log that begins in motion may stop: what the start of a command reads
REST_BEGINS_WITHIN_S = 5.0  # a later stop would give a bias from the future
UNTRAINED = BiasPrior(np.zeros(6), np.full(6, np.inf), np.full(6, MAX_UNKNOWN))  # of the change from stop to stop
UNKNOWN_STD = np.array([0.1] * 3 + [1.5] * 3)  # rad/s and m/s²: bias of a sensor nobody calibrated (BMI160 of TUM-VI: 1.3)
CLEAR = 0.01  # rad/s, of a bias by gravity in motion: a wrong unit's has 0.03, the own from 0.001 to 0.006
REFUTED, SURE, UNUSUAL = 15.0, 3.0, 2.0  # log-likelihood and deviations that refute a stop; deviations that ask for both
MAX_SURPRISING = 0.05  # share of such innovations; training logs 0.00, other sensors at least 0.05 where bias is no evidence
PIECE = 512  # samples, of which the search for a stop takes no more than it needs


def auto(model: BiasModel, imu: Imu) -> InitialBias:
    """Bias from the first stop of the first minute and the training logs, then tracked.

    Samples up to the end of that stop get the bias that all of them show, smoothed where it moves. Later ones get that of the
    samples before them.

    Raises:
        DataError: an untrained model, and the log does not start at rest.
    """
    first_ns = int(imu.t_ns[0]) if len(imu) else 0
    imu = imu.rows(slice(0, int(np.searchsorted(imu.t_ns, first_ns + nanoseconds(LOOK_AHEAD_S)))))
    before = bias_prior(model, first_ns)
    blocks = _up_to_first_stop(model, imu, before)
    if not model.card and not (blocks and blocks[0].resting):
        raise _no_rest()
    if not blocks:
        return tracked_in_motion(model, imu)
    begin_s, end_s = next(block.start_s for block in blocks if block.resting), blocks[-1].end_s
    t_s, gyro, accel = relative_samples(imu.rows(slice(0, int(np.searchsorted(imu.t_ns, first_ns + nanoseconds(end_s))))))
    u, at_stop = np.concatenate([gyro, accel], axis=1), t_s >= begin_s
    difference = (u - model.stream(before.mean)(t_s, gyro, accel))[at_stop].mean(axis=0)
    if np.linalg.norm(difference[:3] / before.std[:3]) > UNUSUAL and refuted_stops(relative_samples(imu), model):
        if not model.card:
            raise _no_rest()
        start = tracked_from_prior(model, first_ns)
        return replace(start, how=f"{start.how}; its stops are steady turns", follows=replace(before, stops=False))
    wide = widened(before.std, difference, _at_rest_variance(model, u[at_stop]))
    if (wide > before.std).any():
        before = replace(before, std=wide)
        # a stop of a single block ends before the filter closes it: take as many blocks of the log itself
        blocks = list(itertools.islice(filter_blocks(model, _pieces(imu), before), len(blocks)))
    constant = blocks[0].resting and not _drifts(gyro[at_stop])
    track = None if constant else smooth_bias(model, [(t_s, gyro, accel)], before).track
    (rest, _), (_, P) = before.supported([blocks[-1].step.after] * 2, np.full(2, end_s), np.array([True, False]))
    std = np.sqrt(np.diag(P))  # in motion, where the bias is used
    source = f"{end_s - begin_s:.1f} s at rest from {begin_s:.1f} s on" + f", {training_source(model)}" * bool(model.card)
    how = f"{source}, {accuracy(std)}, then {TRACKED_BY}"
    return InitialBias(rest, std, how, CALM * white_noise(u[at_stop]), track, before, end_s)


def _up_to_first_stop(model: BiasModel, imu: Imu, before: BiasPrior) -> list[FilteredBlock]:
    """Filtered blocks of some samples up to the end of their first stop; none if they never rest."""
    found: list[FilteredBlock] = []
    for block in filter_blocks(model, _pieces(imu), before):
        if found and found[-1].resting and not block.resting:
            return found
        found.append(block)
    return found if found and found[-1].resting else []


def _pieces(imu: Imu) -> Iterator[Samples]:
    """Samples in pieces, so that the model sees few beyond a stop."""
    t_s, gyro, accel = relative_samples(imu)
    for first in range(0, len(t_s), PIECE):
        rows = slice(first, first + PIECE)
        yield t_s[rows], gyro[rows], accel[rows]


def _drifts(gyro: Vectors) -> bool:
    """Whether the mean of a gyro at rest moves from the first third of a stop to the last, as while it warms up."""
    first, _, last = np.array_split(gyro, 3)
    noise = np.sqrt(2.0 * gyro.var(axis=0) / max(len(first), 1))
    return bool((np.abs(last.mean(axis=0) - first.mean(axis=0)) > MAX_UNKNOWN + MAX_DEVIATIONS * noise).any())


def _at_rest_variance(model: BiasModel, samples: Rows6) -> Vector6:
    """Variance of the mean of samples at rest about the gyro's bias in motion; nothing of the accelerometer's."""
    variance: Vector6 = bias_prior(model).ground_std ** 2 + samples.var(axis=0) / len(samples)
    variance[3:] = np.inf
    return variance


def at_rest(model: BiasModel, imu: Imu) -> InitialBias:
    """Bias from the rest stretch at the log's start, combined with the prior.

    Raises:
        DataError: there is no such stretch.
    """
    latest = np.searchsorted(imu.t_ns, imu.t_ns[0] + nanoseconds(REST_BEGINS_WITHIN_S)) if len(imu) else 0
    bounds = next((bounds for bounds in rest_stretches(imu) if bounds[0] <= latest), None)
    if bounds is None:
        raise _no_rest()
    start, samples = prior(model, int(imu.t_ns[0])), imu.rows(slice(*bounds))
    u = np.concatenate([samples.gyro, samples.accel], axis=1)
    residual = u - model.stream(start.rest)(*relative_samples(samples)) + start.rest
    mean = residual.mean(axis=0)
    squares = ((residual - mean) ** 2).sum(axis=0)
    stretch = _RestStretch(mean, squares, len(samples), int(samples.t_ns[0]), int(samples.t_ns[-1]))
    supported = supported_std(start.std, start.minimum, mean - start.rest, _at_rest_variance(model, residual))
    start = replace(start, std=supported)
    return _combined(start, [stretch], int(imu.t_ns[0]))


def over_all_rest(model: BiasModel, blocks: Blocks) -> InitialBias:
    """Bias from all calm rest in a log: for a model with a constant bias only.

    It uses only the block statistics of `stationary.block_statistics`, not the samples. What shakes more than the calmest stop
    may be a steady drive, or a drone whose motors move its bias.

    Raises:
        DataError: the log never rests.
    """
    stops = resting_blocks(blocks)
    if not stops:
        raise DataError("the log never rests", expected="1.5 s or more without motion")
    stretches, calm = [], _calm(blocks, stops)
    for first, last in calm:
        part, mean = slice(first, last), blocks.mean[first:last].mean(axis=0)
        squares = (blocks.k - 1) * blocks.var[part] + blocks.k * (blocks.mean[part] - mean) ** 2
        ends_ns = int(blocks.first_ns[first]), int(blocks.last_ns[last - 1])
        stretches.append(_RestStretch(mean, squares.sum(axis=0), (last - first) * blocks.k, *ends_ns))
    start = _combined(prior(model), stretches, int(blocks.first_ns[0]))
    return start if list(calm) == stops else replace(start, how=f"the calmest {start.how}")


def _calm(blocks: Blocks, ranges: Sequence[tuple[int, int]]) -> Sequence[tuple[int, int]]:
    """Parts of ranges at rest whose seconds shake little more than the calmest; all where none does by both sensors."""
    block_s, calm = blocks.k * blocks.period_s, np.zeros(len(blocks.late), bool)
    counts = [min(b - a, max(1, round((b - a) * block_s))) for a, b in ranges]  # at 1 Hz a block has two seconds
    pieces = [piece for (a, b), n in zip(ranges, counts, strict=True) for piece in np.array_split(np.arange(a, b), n)]
    noise = np.sqrt([blocks.var[piece].mean(axis=0).reshape(2, 3).sum(axis=1) for piece in pieces]).reshape(-1, 2)
    for piece in itertools.compress(pieces, (noise <= MAX_SHAKING * noise.min(axis=0, initial=np.inf)).all(axis=1)):
        calm[piece] = True
    return true_ranges(calm) if calm.any() else ranges


def rest_differences(
    model: BiasModel,
    logs: Sequence[Samples],
    rest: Float64[np.ndarray, "logs 6"],
    velocities: Sequence[Float64[np.ndarray, "_ 3"]] | None = None,
) -> list[Float64[np.ndarray, "_ 6"]]:
    """Bias at each stop of each log minus the log's bias in motion, `rest`.

    Rest shows the accelerometer's bias along gravity only, so its three columns are the same. With true `velocities` a
    steady drive is no stop.
    """
    out = []
    for log, ((t_s, gyro, accel), in_motion) in enumerate(zip(logs, rest, strict=True)):
        t_ns = np.round(t_s * 1e9).astype(np.int64)
        residual = np.concatenate([gyro, accel], axis=1) - model.stream(in_motion)(t_s, gyro, accel)
        stands = np.ones(len(t_s), bool) if velocities is None else np.linalg.norm(velocities[log], axis=1) < MIN_DRIVEN_M_S
        stops = [np.arange(first, last)[stands[first:last]] for first, last in rest_stretches(Imu(t_ns, gyro, accel))]
        means = [residual[stop].mean(axis=0) for stop in stops if len(stop)]
        out.append(np.array([[*m[:3], *[np.linalg.norm(m[3:]) - GRAVITY_M_S2] * 3] for m in means]).reshape(-1, 6))
    return out


def stops_in(samples: Samples) -> list[tuple[float, float]]:
    """Beginning and end (s) of each stop in samples."""
    t_s = samples[0]
    stops = rest_stretches(Imu(np.round(t_s * 1e9).astype(np.int64), *samples[1:]))
    return [(float(t_s[first]), float(t_s[last - 1])) for first, last in stops]


def refuted_stops(samples: Samples, model: BiasModel) -> tuple[Vector6, Vector6] | None:
    """Bias and its deviation by gravity in motion, where this refutes the first stop.

    A turn about gravity looks like rest. The innovations after it are likelier where all is taken for motion, and the bias
    about gravity is another one: of a trained model, clearly that of its prior (a wrong unit's correction refutes real stops).
    Of logs of EuRoC, FETCH, BROAD, RepoIMU and a car their log-likelihood is larger by 4 at most.
    """
    own = bias_prior(model)
    known = replace(UNTRAINED, mean=own.mean, std=UNKNOWN_STD, settings=own.settings)
    filters = [BiasFilter(each, ahead=True) for each in (known, replace(known, stops=False))]
    runs = zip(*filter_together(filters, [without_motion(model, samples, own.mean)] * 2), strict=True)
    later = list(itertools.dropwhile(lambda blocks: not blocks[0].resting, runs))
    moving = list(zip(*(blocks for blocks in later if not blocks[0].resting), strict=True))
    if not moving:
        return None
    stopped, moved = (innovations(block.step for block in blocks) for blocks in moving)
    calm = (moved.chi_square > SURPRISING).mean() <= MAX_SURPRISING  # gravity contradicts a clipped gyro in any case
    last = moving[1][-1].step.after
    ends = samples[0].searchsorted((later[0][0].start_s, later[0][0].end_s))
    rate, force = (u[slice(*ends)].mean(axis=0) for u in samples[1:])
    up, P = force / np.linalg.norm(force), last.covariance(False)
    turn, std = up @ (rate - last.bias[:3]), np.sqrt(up @ P[:3, :3] @ up)
    refuted = moved.log_likelihood.sum() - stopped.log_likelihood.sum() > REFUTED and abs(turn) > SURE * std
    off, clear = up @ (last.bias - own.mean)[:3], SURE * np.hypot(std, np.linalg.norm(up * own.std[:3]))
    own_unit = not model.card or (std < CLEAR and abs(off) < clear)
    return (last.bias, np.sqrt(np.diag(P))) if calm and refuted and own_unit else None


def changed_at_rest(samples: Samples, stops: Sequence[tuple[float, float]], prior: BiasPrior) -> Iterator[str]:
    """Sentence on a gyro whose mean at rest moves further than its walk by the prior."""
    t_s, gyro, _ = samples
    within = [gyro[slice(*np.searchsorted(t_s, stop))] for stop in stops]
    for (stop, first), (later, last) in itertools.pairwise(zip(stops, within, strict=True)):
        noise = sum(part.var(axis=0) / len(part) for part in (first, last))
        apart_s = 0.5 * (sum(later) - sum(stop))
        std = np.sqrt(prior.walk[:3] ** 2 * apart_s + 2.0 * prior.ground_std[:3] ** 2 + noise)
        change = last.mean(axis=0) - first.mean(axis=0)
        axis = int(np.argmax(np.abs(change) / std))
        if abs(change[axis]) > MAX_DEVIATIONS * std[axis]:
            yield (
                f"the gyro's bias about {'xyz'[axis]} moves by {change[axis]:+.2g} rad/s in {apart_s:.0f} s, from stop to stop,"
                f" {abs(change[axis]) / std[axis]:.0f} standard deviations of its usual walk: it warms up, or drifts"
            )
            return


def shown_at_rest(samples: Samples) -> tuple[Vector6, Vector6]:
    """Bias of the gyro at stops, and its deviation: infinite for what stops do not show."""
    (at_stops,) = rest_differences(static.Model(), [samples], np.zeros((1, 6)))
    shown, std = np.zeros(6), np.full(6, np.inf)
    if len(at_stops):
        shown[:3], std[:3] = at_stops[:, :3].mean(axis=0), np.hypot(at_stops[:, :3].std(axis=0), MAX_UNKNOWN)
    return shown, std


class _RestStretch(NamedTuple):
    """Rest stretch: mean of the samples, sum of squared deviations, count, and stamps of both ends."""

    mean: Vector6
    squares: Vector6
    samples: int
    start_ns: int
    end_ns: int


def _combined(start: InitialBias, stretches: Sequence[_RestStretch], first_ns: int) -> InitialBias:
    """Bias from the prior and some rest stretches; gravity shows the accelerometer's along itself only."""
    rest, var = start.rest.copy(), start.std**2
    count = sum(stretch.samples for stretch in stretches)
    noise = np.sqrt(np.sum([stretch.squares for stretch in stretches], axis=0) / count)
    mean = np.sum([stretch.mean * stretch.samples for stretch in stretches], axis=0) / count
    gain = var[:3] / (var[:3] + AT_REST_STD[:3] ** 2 + noise[:3] ** 2 / count)
    rest[:3] += gain * (mean[:3] - start.rest[:3])
    var[:3] *= 1 - gain
    for stretch in stretches:  # attitude may differ from stop to stop: each shows another direction
        force = stretch.mean[3:] - rest[3:]
        size = float(np.linalg.norm(force))
        if size < MIN_FORCE_M_S2:  # no direction, hence nothing along it
            continue
        up = force / size
        gain = var[3:] * up / (up @ (var[3:] * up) + AT_REST_STD[3] ** 2)
        rest[3:] += gain * (size - GRAVITY_M_S2)
        var[3:] *= 1 - gain * up
    total_s = 1e-9 * sum(stretch.end_ns - stretch.start_ns for stretch in stretches)
    first_s = 1e-9 * (stretches[0].start_ns - first_ns)
    return InitialBias(rest, np.sqrt(var), f"{total_s:.1f} s at rest from {first_s:.1f} s on", noise)


def _no_rest() -> DataError:
    return DataError(
        "the log does not start at rest",
        expected=f"1.5 s or more without motion in the first {REST_BEGINS_WITHIN_S:g} s",
        fix="Give `init=prior` with a trained `model`, or six numbers",
    )
