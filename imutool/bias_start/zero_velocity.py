"""Zero-velocity updates.

Dead reckoning of debiased samples through the inertial filter, from a known pose.

At every stop velocity and rate are zero, in between speed is bounded (`imutool.inertial.inertial_filter`). Each correction of
the velocity also corrects the position for its drift. Without a stop, only the bound on the speed acts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.bias.model import Vector6
from imutool.bias_start.bias_tracking import BiasFilter, FilteredBlock, smooth_blocks
from imutool.bias_start.initial_bias import relative_samples
from imutool.bias_start.prior_width import BiasPrior
from imutool.geometry import quaternion
from imutool.inertial.inertial_filter import SIZE, State
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.recording import Imu, Poses

START_STD = np.array([1e-3] * 3 + [1e-2] * 3 + [1e-3] * 3)  # rad, m/s, m: of the start pose


def zero_velocity_trajectory(imu: Imu, start: StartPose, prior: BiasPrior, *, smooth: bool = False) -> Poses:
    """Trajectory at the IMU's stamps from `start` at the first.

    With `smooth` each pose uses all samples.

    `imu` is debiased; `prior` is that of the residual bias. Between the filter's blocks of half a second, and in a recording
    shorter than a block, samples are integrated as in pure integration.

    Raises:
        DataError: no samples.
        NumericsError: the numbers overflow.
    """
    filter_ = BiasFilter(prior, ahead=smooth)
    filter_.state = _state(start, prior)
    t_s = relative_samples(imu)[0]
    estimates = _estimates(filter_, imu, t_s, smooth)
    pieces, first, state = [], 0, filter_.state
    for end_s, resting, over, after in estimates:
        last = int(np.searchsorted(t_s, end_s))
        pieces.append(_between(imu.rows(slice(first, last + 1)), over, resting).rows(slice(0, last - first)))
        first, state = last, after
    pieces.append(_between(imu.rows(slice(first, len(imu))), state, False))
    columns = [np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("p_wb", "q_wb_wxyz", "v_w")]
    return Poses(imu.t_ns, *columns)


def _estimates(filter_: BiasFilter, imu: Imu, t_s: np.ndarray, smooth: bool) -> Iterator[tuple[float, bool, State, State]]:
    """End of each block, whether it is at rest, and the estimates at its start and end."""

    def blocks() -> Iterator[FilteredBlock]:
        yield from filter_.feed(t_s, imu.gyro, imu.accel)
        yield from filter_.finish()

    if not smooth:
        for block in blocks():
            yield block.end_s, block.resting, block.step.before, block.step.after
        return
    previous: tuple[FilteredBlock, State] | None = None
    for block, state in smooth_blocks(blocks()):
        if previous is not None:
            yield previous[0].end_s, previous[0].resting, previous[1], state
        previous = block, state
    if previous is not None:
        yield (
            previous[0].end_s,
            previous[0].resting,
            previous[1],
            previous[0].step.after,
        )  # the last block has no later estimate


def _state(start: StartPose, prior: BiasPrior) -> State:
    (R_wb,) = quaternion.matrix(quaternion.unit(start.q_wb_wxyz[None]))
    P = np.zeros((SIZE, SIZE))
    # invariant errors: an attitude error rotates velocity and position about the origin
    P[range(SIZE), range(SIZE)] = np.concatenate([START_STD, prior.std, prior.ground_std]) ** 2
    return State(R_wb, start.v_w.copy(), start.p_wb.copy(), prior.mean.copy(), np.zeros(6), P)


def _between(imu: Imu, state: State, resting: bool) -> Poses:
    """Pure integration over a block, with the filter's bias at its start."""
    bias: Vector6 = state.rest_bias(resting)
    from scipy.spatial.transform import Rotation

    q_wb_wxyz = Rotation.from_matrix(state.R_wb).as_quat(scalar_first=True)
    corrected = Imu(imu.t_ns, imu.gyro - bias[:3], imu.accel - bias[3:])
    return dead_reckon(corrected, (q_wb_wxyz, state.p_wb, state.v_w))
