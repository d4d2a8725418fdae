"""Trajectory errors over time, drift since a reset, and drift over windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Bool, Float64
from imutool.errors import ConfigError, DataError
from imutool.geometry import quaternion
from imutool.inertial.scoring.alignment import align
from imutool.inertial.scoring.path_blocks import pieces_in_memory
from imutool.inertial.strapdown import drift_windows, window_drift
from imutool.recording import Poses, Times, nanoseconds

Alignment = Literal["none", "origin", "yaw", "se3"]
ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)
RESET_S = 10.0
WINDOWS_S = (1.0, 5.0, 10.0, 30.0)
WINDOWS_NOTE = (
    "Root mean squares at the ends of windows that each start from the truth, by the Euler rule, which lags by half a sample. "
    "imutool evaluate prints the drift by the trapezoidal rule."
)


def alignment(name: str) -> Alignment:
    """Alignment by name.

    Raises:
        ConfigError: there is none.
    """
    for known in ALIGNMENTS:
        if known == name:
            return known
    raise ConfigError(f"unknown alignment {name!r}", where="align", expected=", ".join(ALIGNMENTS))


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of an estimate at its own stamps; NaN where the truth does not know them."""

    t_ns: Times
    orientation_deg: Float64[np.ndarray, "n 3"]  # Log(R_true^T R_estimated), in the true body frame
    roll_pitch_yaw_deg: Float64[np.ndarray, "n 3"]  # of R_estimated R_true^T: about the world's x, y and z (yaw: heading)
    position_m: Float64[np.ndarray, "n 3"]  # estimated minus true, world

    @property
    def orientation_total_deg(self) -> Float64[np.ndarray, " n"]:
        """Angle of the orientation error, 0 to 180 degrees."""
        return quaternion.length(self.orientation_deg)

    @property
    def position_total_m(self) -> Float64[np.ndarray, " n"]:
        """Length of the position error."""
        return quaternion.length(self.position_m)

    @property
    def horizontal_m(self) -> Float64[np.ndarray, " n"]:
        """Length of the position error in the world's horizontal plane."""
        return quaternion.length(self.position_m[:, :2])

    @property
    def vertical_m(self) -> Float64[np.ndarray, " n"]:
        """Signed position error upwards."""
        return self.position_m[:, 2]


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift since the last reset to the truth, every `reset_s`; NaN where the truth is unknown."""

    reset_s: float
    t_ns: Times
    since_s: Float64[np.ndarray, " n"]  # time since the reset
    orientation_deg: Float64[np.ndarray, " n"]
    velocity_m_s: Float64[np.ndarray, " n"]
    position_m: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Window:
    """Root mean square drift over windows of one length that each start from the truth."""

    length_s: float
    count: int
    orientation_deg: float
    velocity_m_s: float
    position_m: float


def row_of_largest(values: Float64[np.ndarray, " n"]) -> int | None:
    """Row of the largest value; None where no value is finite."""
    return int(np.nanargmax(values)) if np.isfinite(values).any() else None


def errors(estimate: Poses, truth: Poses, valid: Bool[np.ndarray, " n"]) -> Errors:
    """Error of an estimate against the truth at the same stamps; NaN where `valid` is false."""
    turned, roll_pitch_yaw, distance = (np.empty((len(truth), 3)) for _ in range(3))
    unknown = 0.0 if truth.has_positions else np.nan
    for first in range(0, len(truth), quaternion.ROWS_AT_ONCE):
        rows = slice(first, first + quaternion.ROWS_AT_ONCE)
        q_wxyz, back = estimate.q_wb_wxyz[rows], quaternion.inverse(truth.q_wb_wxyz[rows])
        hole = np.where(valid[rows], 0.0, np.nan)[:, None]
        turned[rows] = np.rad2deg(quaternion.log(quaternion.multiply(back, q_wxyz))) + hole
        roll_pitch_yaw[rows] = np.rad2deg(quaternion.roll_pitch_yaw(quaternion.multiply(q_wxyz, back))) + hole
        distance[rows] = estimate.p_wb[rows] - truth.p_wb[rows] + (hole + unknown)
    return Errors(estimate.t_ns, turned, roll_pitch_yaw, distance)


class RigidMotion(NamedTuple):
    """Rigid motion of an alignment: a rotation, then a shift, both in the world frame."""

    rotation: Rotation
    shift_m: Float64[np.ndarray, "3"]


def aligned(estimate: Poses, truth: Poses, valid: Bool[np.ndarray, " n"], alignment: Alignment) -> tuple[Poses, RigidMotion]:
    """Align an estimate with the truth by one rigid motion.

    `origin`: its first pose becomes the true one. `yaw`: positions are nearest by least squares among turns about the vertical,
    theta = atan2(sum (p x p_true)_z, sum (p . p_true)_xy) about the means, the four directions an inertial sensor cannot know.
    `se3`: among all rigid motions (Umeyama 1991, `alignment.align`).

    Raises:
        DataError: no row has truth, or positions that leave the motion of `se3` open.
        NumericsError: positions overflow.
    """
    if not valid.any():
        raise DataError("the truth is known at none of the estimate's stamps", expected="some overlap")
    if alignment == "none":
        return estimate, RigidMotion(Rotation.identity(), np.zeros(3))
    motion = _motion(estimate, truth, valid, alignment)
    R = motion.rotation.as_matrix()
    v_w = None if estimate.v_w is None else estimate.v_w @ R.T
    q_wb_wxyz = quaternion.multiply(motion.rotation.as_quat(scalar_first=True)[None], estimate.q_wb_wxyz)
    return Poses(estimate.t_ns, estimate.p_wb @ R.T + motion.shift_m, q_wb_wxyz, v_w), motion


def _motion(estimate: Poses, truth: Poses, valid: Bool[np.ndarray, " n"], alignment: Alignment) -> RigidMotion:
    if alignment == "origin":
        row = int(np.argmax(valid))
        start, true = (Rotation.from_quat(poses.q_wb_wxyz[row], scalar_first=True) for poses in (estimate, truth))
        return _about(true * start.inv(), estimate.p_wb[row], truth.p_wb[row])
    p, p_true = estimate.p_wb[valid], truth.p_wb[valid]
    centre, centre_true = p.mean(axis=0), p_true.mean(axis=0)
    if alignment == "yaw":
        (x, y, _), (x_true, y_true, _) = (p - centre).T, (p_true - centre_true).T
        angle = np.arctan2(x @ y_true - y @ x_true, x @ x_true + y @ y_true)
        return _about(Rotation.from_rotvec([0.0, 0.0, angle]), centre, centre_true)
    motion = align(p, p_true)
    if motion is None:
        raise DataError(
            "positions lie on a line and leave the turn about it open", where="align", fix="Use yaw, origin or none for `align`"
        )
    R, shift_m = motion
    return RigidMotion(Rotation.from_matrix(R), shift_m)


def _about(rotation: Rotation, centre: Float64[np.ndarray, "3"], goal: Float64[np.ndarray, "3"]) -> RigidMotion:
    """Rotation about a centre that moves it to another point."""
    return RigidMotion(rotation, goal - rotation.as_matrix() @ centre)


def drift_since_reset(path: Poses, truth: Poses, valid: Bool[np.ndarray, " n"], reset_s: float = RESET_S) -> Drift:
    """Drift of `path` at every sample, with a reset to the truth every `reset_s`.

    Where the truth is unknown, the reset waits until it is known again.
    """
    known = np.flatnonzero(valid)
    resets = known[np.diff((path.t_ns[known] - path.t_ns[0]) // nanoseconds(reset_s), prepend=-1) > 0]
    since_s, *errors = (np.full(len(path), np.nan) for _ in range(4))
    spans = np.stack([resets, np.append(resets[1:] - 1, len(path) - 1)[: len(resets)]], axis=1)  # from each reset to the next
    for piece in pieces_in_memory(path, truth, spans):
        first = piece.windows[:, 0]
        start = int(np.searchsorted(path.t_ns, piece.path.t_ns[0]))
        rows = np.flatnonzero(valid[start : start + len(piece.path)])
        last_reset = first[np.searchsorted(first, rows, side="right") - 1]
        since_s[start + rows] = (piece.path.t_ns[rows] - piece.path.t_ns[last_reset]) * 1e-9
        drifted = window_drift(piece.path, piece.truth, last_reset, rows)
        for column, values in zip(errors, drifted._replace(orientation_rad=np.rad2deg(drifted.orientation_rad)), strict=True):
            column[start + rows] = values
    if not truth.has_positions:
        errors[1:] = [np.full(len(path), np.nan)] * 2
    return Drift(reset_s, path.t_ns, since_s, *errors)


def windows(path: Poses, truth: Poses, valid: Bool[np.ndarray, " n"]) -> tuple[Window, ...]:
    """Drift over windows of each length in `WINDOWS_S` that fits (`strapdown.drift_windows`)."""
    rows, known = [], truth.has_positions
    for length_s in WINDOWS_S:
        of_length = drift_windows(path.t_ns, valid, length_s)
        found = [window_drift(part, true, *local.T) for part, true, local in pieces_in_memory(path, truth, of_length)]
        if found:
            turned, *moved = (float(np.sqrt(np.mean(np.concatenate(column) ** 2))) for column in zip(*found, strict=True))
            rows.append(Window(length_s, len(of_length), float(np.rad2deg(turned)), *(moved if known else [np.nan] * 2)))
    return tuple(rows)
