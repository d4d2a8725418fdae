"""The rest bias followed through a log: by each sample from what came before it, or from the whole log.

Samples, less what the model says the motion adds, go through `imutool.inertial.inertial_filter` in blocks of half a second.
`Following`
and `Along` are streams (`imutool.bias.model.Stream`) like the one a model gives for a constant rest bias.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from imutool.bias.model import BiasModel, Vector6
from imutool.inertial import inertial_filter
from imutool.inertial.inertial_filter import FilterSettings, State, Step
from imutool.inertial.preintegration import integrate
from imutool.inertial.stationary import GAP_PERIODS, Stillness

BLOCK_S = 0.5
USUAL_WALK = np.array([1e-4] * 3 + [2e-3] * 3)  # of a sensor nobody trained a model for
LOST_S = 1.0  # without samples for longer, attitude and velocity are anybody's guess
CHUNK_S, LOOK_AHEAD_S = 600.0, 600.0  # of smoothing: a bias has walked away from what it was ten minutes ago

Samples = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]


@dataclass(frozen=True)
class Known:
    """What is known of a run's biases before it: b in motion, by how much it differs at rest (mean zero), how far b walks.

    `walk` is in rad/s and m/s² per second^1/2.
    """

    mean: Vector6
    std: Vector6
    ground_std: Vector6
    walk: Vector6 = field(default_factory=USUAL_WALK.copy)


class Track(NamedTuple):
    """A rest bias in time (s from the first sample): each row holds until the next."""

    t_s: Float64[np.ndarray, " m"]
    rest: Float64[np.ndarray, "m 6"]
    std: Float64[np.ndarray, "m 6"]

    def at(self, t_s: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
        """The rest bias at some times."""
        return np.asarray(self.rest[self._row(t_s)])

    def std_at(self, t_s: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 6"]:
        """How sure it is at some times, as a standard deviation."""
        return np.asarray(self.std[self._row(t_s)])

    def _row(self, t_s: Float64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        row = np.searchsorted(self.t_s, t_s, side="right") - 1
        return np.clip(row, 0, len(self.rest) - 1)


class Passed(NamedTuple):
    """A block that went through the filter: when it began and ended, whether at rest, and the step (none: it only levels)."""

    start_s: float
    end_s: float
    resting: bool
    step: Step


class _Block(NamedTuple):
    """Samples from one boundary to the next, both included; at rest the last is left to the next block."""

    t_s: Float64[np.ndarray, " n"]
    u: Float64[np.ndarray, "n 6"]
    longest_s: float
    missing_s: float


class RestFilter:
    """The filter over samples as they arrive, in batches of any size: the borders of batches change nothing.

    With `ahead`, blocks wait until it is known whether a stop begins with them, which takes `Stillness` 1.5 s.
    """

    def __init__(self, known: Known, settings: FilterSettings | None = None, *, ahead: bool = False) -> None:
        self.settings = settings or FilterSettings()
        self.state: State | None = None
        self._known, self._still = known, Stillness()
        self._wait = self._still.blocks_needed - 1 if ahead else 0
        self._waiting: deque[tuple[_Block, bool]] = deque()
        self._left: list[tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, "n 6"]]] = []
        self._close_s = -np.inf

    def feed(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Iterator[Passed]:
        """The blocks that these samples bring to an end."""
        if not len(t_s):
            return
        if not self._left:
            self._close_s = float(t_s[0]) + BLOCK_S
        self._left.append((t_s, np.concatenate([gyro, accel], axis=1)))
        if t_s[-1] < self._close_s:
            return
        t, u = (np.concatenate(parts) for parts in zip(*self._left, strict=True))
        first = 0
        while t[-1] >= self._close_s:
            last = int(np.searchsorted(t, self._close_s))
            yield from self._arrived(t[first : last + 1], u[first : last + 1])
            first, self._close_s = last, float(t[last]) + BLOCK_S
        self._left = [(t[first:].copy(), u[first:].copy())]

    def finish(self) -> Iterator[Passed]:
        """The blocks that still waited."""
        while self._waiting:
            yield self._pass(*self._waiting.popleft())

    def _arrived(self, t: Float64[np.ndarray, " n"], u: Float64[np.ndarray, "n 6"]) -> Iterator[Passed]:
        dt = np.diff(t)
        late = dt > GAP_PERIODS * np.median(dt) if len(dt) > 1 else dt > BLOCK_S * 1.5
        block = _Block(t, u, float(dt.max()), float(dt[late].sum()))
        rests = self._still(u[:-1, :3], u[:-1, 3:], whole=not late.any())
        self._waiting.append((block, rests))
        if rests:
            for i in range(max(0, len(self._waiting) - 1 - self._wait), len(self._waiting)):
                self._waiting[i] = (self._waiting[i][0], True)
        if len(self._waiting) > self._wait:
            yield self._pass(*self._waiting.popleft())

    def _pass(self, block: _Block, rests: bool) -> Passed:
        t, u, s = block.t_s, block.u, self.settings
        if self.state is None:
            k = self._known
            P = np.diag(np.concatenate([k.std, k.ground_std]) ** 2)
            self.state = inertial_filter.level(u[:, 3:].mean(axis=0), k.mean, np.zeros(6), P, s)
        x = self.state
        if block.longest_s > LOST_S:
            step = inertial_filter.again(x, u[-1, 3:], s)
        elif rests:
            still = u[:-1]
            variance = still[:, :3].var(axis=0) / len(still)
            step = inertial_filter.stand(x, still.mean(axis=0), variance, float(t[-1] - t[0]), self._known.walk, s)
        else:
            motion = integrate(t, u[:, :3] - x.bias[:3], u[:, 3:] - x.bias[3:])
            step = inertial_filter.move(x, motion, block.missing_s, self._known.walk, s)
        self.state = step.after
        return Passed(float(t[0]), float(t[-1]), rests, step)


class Following:
    """A model with a rest bias that is followed causally: row k depends on samples up to k, and on the start.

    Until `hold_s` the start's own rest bias stands: the stop that the log begins with, seen whole.
    """

    def __init__(self, model: BiasModel, known: Known, rest: Vector6, hold_s: float) -> None:
        self._motion, self._mean = model.stream(known.mean), known.mean
        self.filter = RestFilter(known)
        self._rest, self._now, self._hold_s = rest, rest, hold_s
        self._sure = np.diag(known.std**2)
        self.covariance = np.zeros((0, 6, 6))  # of the rest bias, at each of the samples given last

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        """The bias at each sample."""
        bias = self._motion(t_s, gyro, accel) - self._mean
        rest, covariance = np.empty_like(bias), np.empty((len(bias), 6, 6))
        done = 0
        for block in self.filter.feed(t_s, gyro - bias[:, :3], accel - bias[:, 3:]):
            known_from = int(np.searchsorted(t_s, block.end_s))
            rest[done:known_from], covariance[done:known_from] = self._now, self._sure
            done, self._now = known_from, block.step.after.rest_bias(block.resting)
            self._sure = block.step.after.covariance(block.resting)
        rest[done:], covariance[done:] = self._now, self._sure
        self.covariance = covariance
        rest[t_s < self._hold_s] = self._rest
        total: Float64[np.ndarray, "n 6"] = bias + rest
        return total


class Along:
    """A model with a rest bias that is known in time, on the clock of the samples."""

    def __init__(self, model: BiasModel, track: Track) -> None:
        self.track, self._mean = track, track.rest.mean(axis=0)
        self._motion = model.stream(self._mean)

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        """The bias at each sample."""
        total: Float64[np.ndarray, "n 6"] = self._motion(t_s, gyro, accel) - self._mean + self.track.at(t_s)
        return total


def followed(model: BiasModel, batches: Iterable[Samples], known: Known, *, ahead: bool = False) -> Iterator[Passed]:
    """Every block of some samples, with what the model says of the motion taken off."""
    motion = model.stream(known.mean)
    filter_ = RestFilter(known, ahead=ahead)
    for t_s, gyro, accel in batches:
        bias = motion(t_s, gyro, accel) - known.mean
        yield from filter_.feed(t_s, gyro - bias[:, :3], accel - bias[:, 3:])
    yield from filter_.finish()


def smoothed(blocks: Iterable[Passed]) -> Iterator[tuple[Passed, State]]:
    """Each block with the estimate that holds over it, given everything up to at least `LOOK_AHEAD_S` later."""
    kept: deque[Passed] = deque()
    for block in blocks:
        kept.append(block)
        if kept[-1].end_s - kept[0].start_s >= CHUNK_S + LOOK_AHEAD_S:
            states = inertial_filter.smooth([one.step for one in kept])
            until_s = kept[0].start_s + CHUNK_S
            for state in states:
                if kept[0].start_s >= until_s:
                    break
                yield kept.popleft(), state
    if kept:
        states = inertial_filter.smooth([one.step for one in kept])
        yield from zip(kept, states, strict=False)  # the last is the end's


def smooth(model: BiasModel, batches: Iterable[Samples], known: Known) -> tuple[Track, float]:
    """The rest bias over a log from all of it, and how long the sensor rested (s). Memory: thirteen numbers a block.

    The track is empty for a log shorter than a block.
    """
    rows, rested_s = [], 0.0
    for block, state in smoothed(followed(model, batches, known, ahead=True)):
        std = np.sqrt(np.diag(state.covariance(block.resting)))
        rows.append(np.concatenate([[block.start_s], state.rest_bias(block.resting), std]))
        rested_s += (block.end_s - block.start_s) * block.resting
    table = np.array(rows).reshape(-1, 13)
    return Track(table[:, 0], table[:, 1:7], table[:, 7:]), rested_s
