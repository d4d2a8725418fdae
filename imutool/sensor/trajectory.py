"""Smooth motion behind measured poses: penalised splines, and the ideal IMU signals.

Poses of motion capture or of an estimator are noisy (0.1 to 5 mm, 0.05 to 0.5 degrees), have holes, glitches and steps, and
are differentiated twice here. So: no curve across a hole; steps of the position (an estimator that takes in a fix) are
levelled and let back in over seconds; glitches lose their weight; the samples themselves say how smooth the curve is
(`imutool.sensor.smoothing`); and the ends, where a derivative rests on one side alone, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import ClassVar

import numpy as np
from scipy.ndimage import median_filter, percentile_filter

from imutool.array_types import Bool, Float64, Int64
from imutool.errors import ConfigError, DataError
from imutool.inertial.kinematics import Trajectory, continuous
from imutool.processes.forked import Forked
from imutool.recording import GRAVITY_M_S2, Poses, seconds
from imutool.sensor.samples import IdealMotion
from imutool.sensor.smoothing import Penalised, Samples

MAX_GAP_S = 0.1  # a longer hole ends a stretch: nothing is invented across it
KNOT_PERIODS = 2.0  # between knots: half the poses' own bandwidth, which noise never leaves
MIN_KNOT_S = 1e-3  # also where stamps come in bursts
MAX_KNOT_S = 0.02  # but for slow poses a knot each: 25 Hz is what a body moves with
MIN_POSES = 25
MIN_S = 0.5  # a shorter stretch is all ends
PASSES = 4  # fits, each with the weights of the one before
FIRST_CUTOFF_HZ = 12.0  # of the first pass: higher, it would follow the glitches that it is to find
HUMP = 3.0  # residuals of this many sigmas count half; of GLITCH they are dropped
GLITCH = 8.0
ANGLE = 2.0 * np.sqrt(4.0 / 3.0)  # a unit quaternion errs by half the angle, in three of its four coordinates
WEIGHED = 0.8196  # root of the mean of r² / 3 / (1 + r² / 9) for three unit normal numbers: weights make noise look smaller
USUAL_S = 2.0  # time that says what residual is usual: poses err more in motion (their stamps) than at rest
USUAL_PERCENTILE = 75.0  # of it: a motion that begins is no glitch, and a quarter of a second in two may be one
USUAL_NORM = 2.0269  # that percentile of the length of three unit normal numbers; a unit quaternion, too, errs in three
MIN_NOISE = 3e-6  # m, or half of rad: what is less is rounding, and no measure of a glitch
END_WORSE = 1.15  # where a derivative's standard deviation is this many times that amid the data, it is an end
END_KNOTS = 5  # and no less: as far as a basis function at the end reaches, and a time constant of the smoothing
MIN_GYRO, MIN_ACCEL = 1e-5, 1e-4  # rad/s (half), m/s²: exact poses have no ends worth leaving out
STEP = 10.0  # median sizes by which a sample's step must differ from its neighbours'
STEP_WINDOW = 10  # samples on either side that say how large a step is
STEP_SMOOTH_HZ = 0.15  # the levelled steps come back this slowly: a centimetre adds 0.01 m/s²
GLITCH_SAMPLES, NOT_BACK = 4, 0.3  # steps so close together that leave less than this share of the largest are a glitch
EXPLAINED = 0.3  # of what is odd about it must be left, or it is no step
LOCAL = 101  # samples whose median says what size is usual
MAX_STEPS = 0.1  # of the samples; more are no steps but noise
MAX_RATE_HZ = 100_000.0

Times = Float64[np.ndarray, " n"]
Values = Float64[np.ndarray, "n d"]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Stretch of motion without a hole, trusted from `start_s` to `end_s` after the first pose."""

    trajectory: Trajectory
    start_s: float
    end_s: float
    noise_m: float  # of a pose, by coordinate
    noise_rad: float  # the same
    cutoff_hz: tuple[float, float]  # where smoothing halves a motion, of position and rotation
    gyro_std: float  # of the ideal signal (rad/s), by axis, as noise and smoothing explain it
    accel_std: float  # the same (m/s²)

    @property
    def duration_s(self) -> float:
        """Trusted time (s)."""
        return self.end_s - self.start_s

    @property
    def measured(self) -> bool:
        """Whether poses have more noise than rounding."""
        return bool(self.noise_m > MIN_NOISE or self.noise_rad > 2.0 * MIN_NOISE)


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Stretches of a smooth motion, timed from `start_ns`; dropped glitches, levelled steps."""

    start_ns: int
    stretches: tuple[Stretch, ...]
    glitches: int
    steps: int

    @property
    def duration_s(self) -> float:
        """Trusted time of all stretches (s)."""
        return sum(stretch.duration_s for stretch in self.stretches)

    @property
    def gyro_std(self) -> float:
        """Root mean square over the trusted time (rad/s, by axis)."""
        return self._mean([stretch.gyro_std for stretch in self.stretches])

    @property
    def accel_std(self) -> float:
        """Root mean square over the trusted time (m/s², by axis)."""
        return self._mean([stretch.accel_std for stretch in self.stretches])

    def _mean(self, std: list[float]) -> float:
        return float(np.sqrt(np.average(np.square(std), weights=[stretch.duration_s for stretch in self.stretches])))

    def covers(self, t_ns: Int64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Which instants lie in a trusted stretch."""
        t_s = seconds(t_ns, self.start_ns)
        return np.asarray(np.any([(t_s >= stretch.start_s) & (t_s <= stretch.end_s) for stretch in self.stretches], axis=0))

    def ideal_motions(self, rate_hz: float) -> list[IdealMotion]:
        """Ideal IMU signals of the tracked point in each stretch, at k / rate from `start_ns`.

        A stretch too short for four samples of that clock is left out.

        Raises:
            ConfigError: a rate that is not above 0 and up to 100 kHz.
        """
        if not 0.0 < rate_hz <= MAX_RATE_HZ:
            raise ConfigError(f"a rate of {rate_hz:g} Hz", where="rate", expected=f"above 0, up to {MAX_RATE_HZ:g} Hz")
        found = []
        for stretch in self.stretches:
            first, last = int(np.ceil(stretch.start_s * rate_hz)), int(np.floor(stretch.end_s * rate_hz))
            if last - first >= 3:
                found.append(self._ideal(stretch, np.arange(first, last + 1) / rate_hz))
        return found

    def _ideal(self, stretch: Stretch, t_s: Times) -> IdealMotion:
        from scipy.spatial.transform import Rotation

        at = stretch.trajectory.at(self.start_ns + np.round(t_s * 1e9).astype(np.int64))
        R_wb = np.ascontiguousarray(Rotation.from_quat(at.q_wb_wxyz, scalar_first=True).as_matrix())
        return IdealMotion(t_s, at.omega_b, at.specific_force(), at.alpha_b, R_wb)


def smooth_motion(poses: Poses, *, robust: bool = True) -> SmoothMotion:
    """Smooth motion behind some poses, and where it can be trusted.

    Position and quaternion are quintic splines, so that rate, angular acceleration and specific force follow in closed form
    (`kinematics.Trajectory`). A stretch ends at a hole of more than 0.1 s; glitches are dropped, and where that leaves such a
    hole the stretch ends too. If not `robust`, all poses count alike. Trusted is the part so far from the ends that rate and
    acceleration err at most a seventh more than amid the data (half as much again at most on synthetic flights).

    Raises:
        DataError: no stretch of at least half a second and 25 poses can be trusted.
        NumericsError: stamps so uneven that no curve is defined.
    """
    motions = _Last.motions[1] if _Last.motions[0] is poses else {}
    motions[robust] = motions.get(robust) or _smoothed(poses, PASSES if robust else 1)
    _Last.motions = poses, motions
    return motions[robust]


class _Last:
    """The last poses, and their motions by `robust`: the second simulation and the audit ask for the same."""

    motions: ClassVar[tuple[Poses | None, dict[bool, SmoothMotion]]] = (None, {})


def _smoothed(poses: Poses, passes: int) -> SmoothMotion:
    t_s = seconds(poses.t_ns, int(poses.t_ns[0])) if len(poses) else np.zeros(0)
    columns, stretches, glitches, steps = (poses.p_wb, continuous(poses.q_wb_wxyz)), list[Stretch](), 0, 0
    waiting = [np.arange(a, b) for a, b in _unbroken(t_s)][::-1]
    while waiting:
        rows = waiting.pop()
        if len(rows) < MIN_POSES or t_s[rows[-1]] - t_s[rows[0]] < MIN_S:
            continue
        rotation = Forked(partial(_fitted, t_s[rows], columns[1][rows], passes))
        position, count = _levelled(t_s[rows], columns[0][rows])
        fits = [_fitted(t_s[rows], position, passes), rotation.result()]
        sound = np.all([weights > 0.0 for _, weights in fits], axis=0)
        if len(parts := _unbroken(t_s[rows][sound])) > 1:  # a glitch so long that it is a hole
            kept = rows[sound]
            waiting += [kept[a:b] for a, b in reversed(parts)]
            glitches += int((~sound).sum())
            continue
        stretch = _stretch(int(poses.t_ns[0]), t_s[rows][sound], fits[0][0], fits[1][0])
        if stretch.duration_s > 0.0:
            stretches.append(stretch)
            glitches, steps = glitches + int((~sound).sum()), steps + count
    if not stretches:
        step_s = np.diff(t_s)
        holes = int((step_s > MAX_GAP_S).sum())
        rate = f" at {1.0 / np.median(step_s):.3g} Hz, with {holes} steps above {MAX_GAP_S:g} s," if len(step_s) else ""
        raise DataError(
            f"no stretch of the {len(poses)} poses{rate} can be differentiated",
            expected=f"poses at 40 Hz or more: {MIN_POSES} over {MIN_S:g} s and more, without a step above {MAX_GAP_S:g} s",
        )
    return SmoothMotion(int(poses.t_ns[0]), tuple(stretches), glitches, steps)


def _unbroken(t_s: Times) -> list[tuple[int, int]]:
    """Row ranges between holes."""
    edges = np.flatnonzero(np.diff(t_s) > MAX_GAP_S) + 1
    return [(a, b) for a, b in pairwise([0, *edges.tolist(), len(t_s)]) if b > a]


def _fitted(t_s: Times, y: Values, passes: int) -> tuple[Penalised, Times]:
    """Robust fit, in which glitches count little and gross ones not at all; its last weights. One pass is a plain fit.

    Weights 1 / (1 + (r / 3 sigma)²), those of heavy tails, so that a fit with a few wild samples still converges.
    """
    period_s = float(np.median(np.diff(t_s)))
    knot_s = max(period_s, min(KNOT_PERIODS * period_s, MAX_KNOT_S), MIN_KNOT_S)
    weights, window = np.ones(len(t_s)), min(2 * round(0.5 * USUAL_S / period_s), len(t_s)) + 1
    near_hz = None
    for index in range(passes):
        samples = Samples(t_s, y, weights, knot_s)
        is_first_of_several = index == 0 and passes > 1
        fit = samples.fit(min(FIRST_CUTOFF_HZ, samples.highest_hz) if is_first_of_several else None, near_hz)
        near_hz = fit.cutoff_hz if index else None
        size = np.linalg.norm(fit.residual(), axis=1)
        local = percentile_filter(size, USUAL_PERCENTILE, window, mode="mirror")  # an end is not its own measure
        usual = np.maximum(np.maximum(local, np.median(size)) / USUAL_NORM, MIN_NOISE)
        if index < passes - 1:
            weights = 1.0 / (1.0 + (size / (HUMP * usual)) ** 2)
        if 0 < index < passes - 1:  # the first fit has an arbitrary cut-off: it drops nothing
            weights[size > GLITCH * usual] = 0.0
    return fit, weights


def _stretch(start_ns: int, t_s: Times, position: Penalised, rotation: Penalised) -> Stretch:
    """The stretch and its trusted part."""
    end_s = 0.0
    for curve, derivative, minimum in ((position, 2, MIN_ACCEL), (rotation, 1, MIN_GYRO)):
        lag_s = 1.0 / (2.0 * np.pi * curve.cutoff_hz) if curve.std(derivative) > minimum else 0.0
        end_s = max(end_s, curve.end_s(derivative, END_WORSE, minimum), END_KNOTS * curve.samples.knot_s + lag_s)
    tilt = GRAVITY_M_S2 * ANGLE * rotation.std(0)
    return Stretch(
        trajectory=Trajectory(start_ns, position.spline, rotation.spline),
        start_s=float(t_s[0]) + end_s,
        end_s=float(t_s[-1]) - end_s,
        noise_m=position.noise / WEIGHED,
        noise_rad=ANGLE * rotation.noise / WEIGHED,
        cutoff_hz=(position.cutoff_hz, rotation.cutoff_hz),
        gyro_std=ANGLE * rotation.std(1),
        accel_std=float(np.hypot(position.std(2), tilt)),
    )


def _levelled(t_s: Times, y: Values) -> tuple[Values, int]:
    """Positions with steps between two samples spread over seconds; and the number of steps.

    A step is a difference that its neighbours' (through a cubic) do not explain. Its size is that of a cubic with a step
    fitted to the samples around it. Steps that soon go back are a glitch, and stay.
    """
    at = _steps(t_s, y)
    if not len(at) or len(at) > MAX_STEPS * len(t_s):
        return y, 0
    jump = np.zeros_like(y)
    runs = np.split(at, np.flatnonzero(np.diff(at) > GLITCH_SAMPLES) + 1)
    for run in runs:
        jump[run] = [_step_size(t_s, y, at, int(k)) for k in run]
    before, after = (
        np.linalg.norm(_unexplained_difference(t_s, values), axis=1) for values in (y, y - np.cumsum(jump, axis=0))
    )
    for run in runs:
        back = np.linalg.norm(jump[run].sum(axis=0)) < NOT_BACK * np.linalg.norm(jump[run], axis=1).max()
        near = slice(max(0, int(run[0]) - GLITCH_SAMPLES), int(run[-1]) + GLITCH_SAMPLES + 1)
        if back or after[near].max() > EXPLAINED * before[run].min():
            jump[run] = 0.0
    slow = Samples(t_s, np.cumsum(jump, axis=0), np.ones(len(t_s)), 0.25 / STEP_SMOOTH_HZ)
    return y - slow.fit(STEP_SMOOTH_HZ).residual(), int(np.count_nonzero(jump.any(axis=1)))


def _unexplained_difference(t_s: Times, y: Values) -> Values:
    """Difference of each position to the one before, less a cubic's through its neighbours."""
    dt = np.diff(t_s)[:, None]
    v = np.diff(y, axis=0) / dt
    difference = np.zeros_like(y)
    difference[3:-2] = (v[2:-2] - (4.0 * (v[1:-3] + v[3:-1]) - (v[:-4] + v[4:])) / 6.0) * dt[2:-2]
    return difference


def _steps(t_s: Times, y: Values) -> Int64[np.ndarray, " s"]:
    """Rows before which the position seems to step."""
    size = np.linalg.norm(_unexplained_difference(t_s, y), axis=1)
    usual = np.maximum(np.maximum(median_filter(size, LOCAL, mode="nearest"), np.median(size)), MIN_NOISE)
    around = np.max([np.roll(size, shift) for shift in (-2, -1, 1, 2)], axis=0)
    return np.asarray(np.flatnonzero((size > STEP * usual) & (size >= 0.9 * around)))


def _step_size(t_s: Times, y: Values, at: Int64[np.ndarray, " s"], k: int) -> Float64[np.ndarray, " d"]:
    """By least squares over the samples around row k, together with the other steps among them."""
    a, b = max(0, k - STEP_WINDOW), min(len(t_s), k + STEP_WINDOW)
    t = (t_s[a:b] - t_s[k]) / (t_s[b - 1] - t_s[a])
    near = [k, *[int(other) for other in at if a < other < b and other != k]]
    columns = [t**power for power in range(4)] + [(np.arange(a, b) >= row).astype(np.float64) for row in near]
    return np.asarray(np.linalg.lstsq(np.stack(columns, axis=1), y[a:b], rcond=None)[0][4])
