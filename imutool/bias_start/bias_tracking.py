"""Rest bias tracked through a log: causally, or smoothed from the whole log.

Samples, minus the model's motion-dependent bias, go through `imutool.inertial.inertial_filter` in blocks of half a second.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from imutool.array_types import Float64, Int64, Rows6, Vectors
from imutool.bias.model import GAP_S, BiasEstimate, BiasModel, Vector6
from imutool.bias_start.prior_width import MAX_CHANGE, MAX_DEVIATIONS, BiasPrior
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import FilterSettings, State, Step
from imutool.inertial.innovations import DriveDetector
from imutool.inertial.preintegration import integrate
from imutool.inertial.stationary import GAP_PERIODS, OnlineRestDetector
from imutool.recording.columns import quantile

BLOCK_S = 0.5
RATE_S = 0.1  # at the end of a block, over which the rate is a mean
CHUNK_S, LOOK_AHEAD_S = 600.0, 600.0  # of smoothing: a bias ten minutes later says nothing about the present one

Samples = tuple[Float64[np.ndarray, " _"], Float64[np.ndarray, "_ 3"], Float64[np.ndarray, "_ 3"]]  # logs differ in length


class BiasTrajectory(NamedTuple):
    """Rest bias in time (s from the first sample): each row holds until the next."""

    t_s: Float64[np.ndarray, " m"]
    rest: Float64[np.ndarray, "m 6"]
    std: Float64[np.ndarray, "m 6"]

    def at(self, t_s: Float64[np.ndarray, " n"]) -> Rows6:
        """Rest bias at some times."""
        return np.asarray(self.rest[self._row(t_s)])

    def std_at(self, t_s: Float64[np.ndarray, " n"]) -> Rows6:
        """Standard deviation of the rest bias at some times."""
        return np.asarray(self.std[self._row(t_s)])

    def _row(self, t_s: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        return np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.rest) - 1)


class FilteredBlock(NamedTuple):
    """Block after the filter: start, end, whether at rest, and the filter step."""

    start_s: float
    end_s: float
    resting: bool
    step: Step


class Aiding(NamedTuple):
    """Aids of a filter that keeps its pose: measurement per block, stops, walk of offsets."""

    measure: Callable[[State, float], State]  # of the state at a time (s)
    stops: bool
    walk: Float64[np.ndarray, " _"]


class _Block(NamedTuple):
    """Block of samples from one boundary to the next, both included; at rest the last belongs to the next block."""

    t_s: Float64[np.ndarray, " n"]
    u: Float64[np.ndarray, "n *filters 6"]
    longest_s: float
    missing_s: float


class BiasFilter:
    """Bias filter for a stream of samples in batches of any size; batch borders change nothing.

    With `ahead`, blocks wait until `OnlineRestDetector` knows whether a stop begins with them, which takes 1.5 s. Samples
    that look like a stop, at a rate that neither a bias of the sensor nor a usual one has, are a steady turn.
    """

    def __init__(
        self, prior: BiasPrior, settings: FilterSettings | None = None, *, ahead: bool = False, aiding: Aiding | None = None
    ) -> None:
        self.settings = settings or prior.settings
        self.state: State | None = None
        self._aiding = aiding
        self._walk = prior.walk if aiding is None else np.concatenate([prior.walk, aiding.walk])
        self._prior, self._rest_detector, self._drives = prior, OnlineRestDetector(), DriveDetector()
        self._wait = self._rest_detector.blocks_needed - 1 if ahead else 0
        self._waiting: deque[tuple[_Block, bool]] = deque()
        self._pending: list[tuple[Float64[np.ndarray, " n"], Rows6]] = []
        self._close_s = -np.inf

    def feed(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Iterator[FilteredBlock]:
        """Filtered blocks that these samples complete."""
        yield from itertools.starmap(self._pass, self._ready((t_s, gyro, accel)))

    def _ready(self, samples: Samples) -> Iterator[tuple[_Block, bool]]:
        """Blocks that wait no longer, and whether each looks like rest."""
        t_s, gyro, accel = samples
        if not len(t_s):
            return
        if not self._pending:
            self._close_s = float(t_s[0]) + BLOCK_S
        self._pending.append((t_s, np.concatenate([gyro, accel], axis=1)))
        if t_s[-1] < self._close_s:
            return
        t, u = (np.concatenate(parts) for parts in zip(*self._pending, strict=True))
        first = 0
        while t[-1] >= self._close_s:
            last = int(np.searchsorted(t, self._close_s))
            yield from self._arrived(t[first : last + 1], u[first : last + 1])
            first, self._close_s = last, float(t[last]) + BLOCK_S
        self._pending = [(t[first:].copy(), u[first:].copy())]

    def finish(self) -> Iterator[FilteredBlock]:
        """Filtered blocks that were still waiting."""
        while self._waiting:
            yield self._pass(*self._waiting.popleft())

    def _arrived(self, t: Float64[np.ndarray, " n"], u: Rows6) -> Iterator[tuple[_Block, bool]]:
        dt = t[1:] - t[:-1]
        maximum = GAP_PERIODS * float(quantile(dt, 0.5)) if len(dt) > 1 else BLOCK_S * 1.5
        whole = (longest := float(dt.max())) <= maximum
        block = _Block(t, u, longest, 0.0 if whole else float(dt[dt > maximum].sum()))
        rests = self._rest_detector(u[:-1, :3], u[:-1, 3:], whole=whole)
        rests = rests and (self._aiding is None or self._aiding.stops)
        self._waiting.append((block, rests))
        if rests:
            for i in range(max(0, len(self._waiting) - 1 - self._wait), len(self._waiting)):
                self._waiting[i] = (self._waiting[i][0], True)
        if len(self._waiting) > self._wait:
            yield self._waiting.popleft()

    def _rests(self, block: _Block) -> bool:
        """Whether a block that looks like rest has a rate that a bias can have."""
        rate, usual = block.u[:-1, :3].mean(axis=0), MAX_CHANGE[:3]
        own = np.abs(rate - self._prior.mean[:3]) < usual + MAX_DEVIATIONS * self._prior.std[:3]
        return self._prior.stops and bool(own.all() or (np.abs(rate) < usual).all())

    def _pass(self, block: _Block, rests: bool) -> FilteredBlock:
        t, u, s, prior, rests = block.t_s, block.u, self.settings, self._prior, rests and self._rests(block)
        if self.state is None:
            std = np.concatenate([prior.std, prior.ground_std])
            self.state = inertial_filter.start(u[:, 3:].mean(axis=0), prior.mean, std, s)
        x, T = self.state, float(t[-1] - t[0])
        if block.longest_s > GAP_S and self._aiding is not None:
            step = inertial_filter.pause_step(x, T, self._walk)
        elif block.longest_s > GAP_S:
            maximum = np.maximum(self._prior.std**2, np.diag(x.covariance(False)))
            step = inertial_filter.reset_pose(x, u[-1, 3:], T, self._prior.walk, maximum, s)
        else:
            step = _step(x, block, rests, self._walk, s)
            if rests and self._drives(block.u[:-1], step):
                rests, step = False, _step(x, block, False, self._walk, s)
        if self._aiding is not None:
            step = step._replace(after=self._aiding.measure(step.after, float(t[-1])))
        self.state = step.after
        return FilteredBlock(float(t[0]), float(t[-1]), rests, step)


def _step(x: State, block: _Block, resting: bool, walk: Float64[np.ndarray, " _"], s: FilterSettings) -> Step:
    """Filter step over a block, of one filter or of several at once."""
    t_s, u = block.t_s, block.u
    if resting:
        variance = u[:-1, ..., :3].var(axis=0) / (len(u) - 1)
        return inertial_filter.rest_step(x, u[:-1].mean(axis=0), variance, float(t_s[-1] - t_s[0]), walk, s)
    gyro, accel = u[..., :3] - x.bias[..., :3], u[..., 3:] - x.bias[..., 3:]
    last = gyro[t_s.searchsorted(t_s[-1] - RATE_S) :]
    rate = last.sum(axis=0) / len(last)
    return inertial_filter.motion_step(x, integrate(t_s, gyro, accel), rate, block.missing_s, walk, s)


def filter_together(filters: Sequence[BiasFilter], samples: Sequence[Samples]) -> list[list[FilteredBlock]]:
    """Filtered blocks of new filters of equal walk and settings, each of its own samples.

    The samples have the same times. Where all filters move, numpy takes half as long as for one after the other.
    """
    own = {id(of): (each, of) for each, of in zip(filters, samples, strict=True)}  # several may have the same samples
    ready = {key: [*each._ready(of), *each._waiting] for key, (each, of) in own.items()}
    out: list[list[FilteredBlock]] = [[] for _ in filters]
    for blocks in zip(*(ready[id(of)] for of in samples), strict=True):
        first, states = blocks[0][0], [each.state for each in filters if each.state is not None]
        rest = {rests and each._rests(block) for each, (block, rests) in zip(filters, blocks, strict=True)}
        if True in rest or len(states) < len(filters) or first.longest_s > GAP_S:
            found = [each._pass(*block) for each, block in zip(filters, blocks, strict=True)]
        else:
            x = State(*map(np.array, zip(*states, strict=True)))
            together = first._replace(u=np.stack([block.u for block, _ in blocks], axis=1))
            step = _step(x, together, False, filters[0]._walk, filters[0].settings)
            found = [FilteredBlock(first.t_s[0].item(), first.t_s[-1].item(), False, step.of(k)) for k in range(len(filters))]
        for each, so_far, block in zip(filters, out, found, strict=True):
            each.state = block.step.after
            so_far.append(block)
    return out


def stops_of(blocks: Sequence[FilteredBlock]) -> tuple[tuple[float, float], ...]:
    """Beginning and end of each row of blocks at rest."""
    rows = [list(row) for resting, row in itertools.groupby(blocks, lambda block: block.resting) if resting]
    return tuple((row[0].start_s, row[-1].end_s) for row in rows)


class TrackedBiasStream:
    """Bias stream with a causally tracked rest bias.

    Row k depends on samples up to k, and on the start. Until `hold_s` the rest bias is that of `held`, measured up to then.
    """

    def __init__(self, model: BiasModel, prior: BiasPrior, known: BiasTrajectory, hold_s: float) -> None:
        self._motion, self._mean = model.stream(prior.mean), prior.mean
        self.filter = BiasFilter(prior)
        self._held, self._now, self._hold_s, self._prior = known, known.rest[0], hold_s, prior
        self._covariance = np.diag(prior.std**2)

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample."""
        return self.estimate(t_s, gyro, accel).bias

    def estimate(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> BiasEstimate:
        """Bias at each sample, and the filter's covariance of the rest bias."""
        bias = self._motion(t_s, gyro, accel) - self._mean
        blocks = list(self.filter.feed(t_s, gyro - bias[:, :3], accel - bias[:, 3:]))
        rest, covariance = self._now[None], self._covariance[None]
        if blocks:
            end_s, resting = np.array([block.end_s for block in blocks]), np.array([block.resting for block in blocks])
            after, P = self._prior.supported([block.step.after for block in blocks], end_s, resting)
            rest, covariance = np.concatenate([rest, after]), np.concatenate([covariance, P])
            self._now, self._covariance = rest[-1], covariance[-1]
            row = np.searchsorted(end_s, t_s, side="right")  # a block's estimate holds from its last sample on
            rest, covariance = rest[row], covariance[row]
        else:
            rest, covariance = np.repeat(rest, len(bias), axis=0), np.repeat(covariance, len(bias), axis=0)
        if (early := t_s < self._hold_s).any():
            rest[early], covariance[early] = self._held.at(t_s[early]), _diagonal(self._held.std_at(t_s[early]) ** 2)
        return BiasEstimate(bias + rest, covariance)


class TrajectoryBiasStream:
    """Bias stream with a given rest bias in time, on the clock of the samples."""

    def __init__(self, model: BiasModel, track: BiasTrajectory) -> None:
        self.track, self._mean = track, track.rest.mean(axis=0)
        self._motion = model.stream(self._mean)

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample."""
        total: Rows6 = self._motion(t_s, gyro, accel) - self._mean + self.track.at(t_s)
        return total

    def estimate(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> BiasEstimate:
        """Bias at each sample, and the smoother's variances of the rest bias."""
        return BiasEstimate(self(t_s, gyro, accel), _diagonal(self.track.std_at(t_s) ** 2))


def _diagonal(variance: Rows6) -> Float64[np.ndarray, "n 6 6"]:
    covariance = np.zeros((len(variance), 6, 6))
    covariance[:, range(6), range(6)] = variance
    return covariance


def without_motion(model: BiasModel, samples: Samples, mean: Vector6) -> Samples:
    """Samples minus the model's motion-dependent bias, about a rest bias."""
    t_s, gyro, accel = samples
    bias = model.stream(mean)(t_s, gyro, accel) - mean
    return t_s, gyro - bias[:, :3], accel - bias[:, 3:]


def filter_blocks(model: BiasModel, batches: Iterable[Samples], prior: BiasPrior) -> Iterator[FilteredBlock]:
    """Filtered blocks of samples, minus the model's motion-dependent bias."""
    motion = model.stream(prior.mean)
    filter_ = BiasFilter(prior, ahead=True)
    for t_s, gyro, accel in batches:
        bias = motion(t_s, gyro, accel) - prior.mean
        yield from filter_.feed(t_s, gyro - bias[:, :3], accel - bias[:, 3:])
    yield from filter_.finish()


def smooth_blocks(blocks: Iterable[FilteredBlock]) -> Iterator[tuple[FilteredBlock, State]]:
    """Smoothed estimate of each block, given the samples up to at least `LOOK_AHEAD_S` later."""
    kept: deque[FilteredBlock] = deque()
    for block in blocks:
        kept.append(block)
        if kept[-1].end_s - kept[0].start_s >= CHUNK_S + LOOK_AHEAD_S:
            states = inertial_filter.smooth([block.step for block in kept])
            until_s = kept[0].start_s + CHUNK_S
            for state in states[:-1]:  # the last state is that of the end
                if kept[0].start_s >= until_s:
                    break
                yield kept.popleft(), state
    if kept:
        states = inertial_filter.smooth([block.step for block in kept])
        yield from zip(kept, states, strict=False)  # the last state is that of the end
