"""Simulated stereo camera: EuRoC's rectified pair, and feature tracks of made-up landmarks.

Landmarks lie on the walls, the floor and the ceiling of a room that encloses the trajectory. At each keyframe tracks go on
while they can be seen and are not too old, and new ones begin until there are as many as asked for. A landmark that comes back
into view is a new track: a front end closes no loops. There are no outliers; pixels carry white noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from imutool.array_types import Bool, Float64, Int64
from imutool.recording import Poses

Points = Float64[np.ndarray, "n 3"]
Landmarks = Float64[np.ndarray, "m 3"]

MARGIN_M = 3.0  # from the trajectory's extent to each wall
LANDMARKS = 6000  # so many that a camera facing a corner still sees more than it tracks
NEAR_M, FAR_M = 0.5, 12.0  # nearer is blur; further, a baseline of 0.11 m gives less than 4.2 px of disparity
LONGEST_TRACK = 10  # keyframes


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two equal pinhole cameras side by side; camera frame.

    x right, y down, z forward, origin in the left one.

    `R_bc`, `p_bc` take points of the left camera's frame to the body's (the IMU's); the right camera sits `baseline_m` along
    the left one's x.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    baseline_m: float
    R_bc: Float64[np.ndarray, "3 3"]
    p_bc: Float64[np.ndarray, "3"]
    name: str = ""

    def project(self, p_c: Points) -> Points:
        """Pixels (u left, u right, v) of points before the camera.

        u = cx + fx x / z, u right = u - fx baseline / z, v = cy + fy y / z. What lies behind (z <= 0) comes out as NaN.
        """
        z = np.where(p_c[:, 2] > 0.0, p_c[:, 2], np.nan)
        u_left = self.cx + self.fx * p_c[:, 0] / z
        return np.stack([u_left, u_left - self.fx * self.baseline_m / z, self.cy + self.fy * p_c[:, 1] / z], axis=1)

    def back_project(self, pixels: Points) -> Points:
        """Points in the camera frame that project to some pixels; the disparity must be positive."""
        z = self.fx * self.baseline_m / (pixels[:, 0] - pixels[:, 1])
        return np.stack([(pixels[:, 0] - self.cx) / self.fx * z, (pixels[:, 2] - self.cy) / self.fy * z, z], axis=1)

    def in_view(self, pixels: Points) -> Bool[np.ndarray, " n"]:
        """Whether a point falls inside both images; false for NaN."""
        with np.errstate(invalid="ignore"):
            columns = (pixels[:, :2] >= 0.0) & (pixels[:, :2] <= self.width - 1.0)
            return np.asarray(columns.all(axis=1) & (pixels[:, 2] >= 0.0) & (pixels[:, 2] <= self.height - 1.0))


def _fixed(rows: list[list[float]] | list[float]) -> np.ndarray:
    values = np.array(rows, dtype=np.float64)
    values.flags.writeable = False
    return values


# sensor.yaml of cam0 of the EuRoC data set (T_BS and intrinsics), Burri et al. 2016; the other camera 0.11 m to its right.
EUROC = StereoRig(
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    width=752,
    height=480,
    baseline_m=0.11,
    R_bc=_fixed(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    ),
    p_bc=_fixed([-0.0216401454975, -0.064676986768, 0.00981073058949]),
    name="EuRoC's cam0 as a rectified stereo pair, 0.11 m apart",
)


@dataclass(frozen=True, eq=False)
class Frame:
    """Sight at one keyframe: each track's number and its pixels (u left, u right, v)."""

    tracks: Int64[np.ndarray, " m"]
    pixels: Float64[np.ndarray, "m 3"]


def room(p_wb: Points, rng: Generator, count: int = LANDMARKS, margin_m: float = MARGIN_M) -> Landmarks:
    """Landmarks (m, world) on the six sides of the box `margin_m` around a trajectory."""
    low, high = p_wb.min(axis=0) - margin_m, p_wb.max(axis=0) + margin_m
    size = high - low
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]]).repeat(2)
    side = rng.choice(6, size=count, p=area / area.sum())
    points: Landmarks = low + size * rng.uniform(size=(count, 3))
    axis, upper = side // 2, side % 2 == 1
    points[np.arange(count), axis] = np.where(upper, high[axis], low[axis])
    return points


def observe(
    poses: Poses,
    sighted: Bool[np.ndarray, " n"],
    landmarks_w: Landmarks,
    rng: Generator,
    *,
    features: int,
    pixel_noise: float,
    longest: int = LONGEST_TRACK,
) -> tuple[list[Frame], Int64[np.ndarray, " tracks"]]:
    """The frames at some true poses, and which landmark each track is.

    A frame that is not `sighted` is empty and ends every track. Visible is what lies between `NEAR_M` and `FAR_M`, inside both
    images before noise. Which landmarks are taken, and the noise (px, per coordinate), come from `rng` alone.
    """
    R_wb = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True).as_matrix()
    frames: list[Frame] = []
    landmark_of: list[int] = []
    live: list[tuple[int, int]] = []  # track, and how many keyframes have seen it
    for k in range(len(poses)):
        if not sighted[k]:
            live = []
            frames.append(Frame(np.zeros(0, np.int64), np.zeros((0, 3))))
            continue
        pixels, visible = _look(landmarks_w, R_wb[k], poses.p_wb[k])
        live = [(track, age + 1) for track, age in live if age < longest and visible[landmark_of[track]]]
        free = visible.copy()
        free[[landmark_of[track] for track, _ in live]] = False
        wanted = min(features - len(live), int(free.sum()))
        for landmark in rng.choice(np.flatnonzero(free), size=max(wanted, 0), replace=False).tolist():
            live.append((len(landmark_of), 1 + _head_start(rng, longest, first=k == 0 or not sighted[k - 1])))
            landmark_of.append(landmark)
        tracks = np.array([track for track, _ in live], dtype=np.int64)
        exact = pixels[[landmark_of[track] for track, _ in live]] if live else np.zeros((0, 3))
        frames.append(Frame(tracks, exact + pixel_noise * rng.normal(size=exact.shape)))
    return frames, np.array(landmark_of, dtype=np.int64)


def blackouts(t_s: Float64[np.ndarray, " n"], length_s: float, every_s: float) -> Bool[np.ndarray, " n"]:
    """Marks the times at which the camera sees nothing.

    These are the last `length_s` of every `every_s` seconds, so that the start is seen.
    """
    return np.asarray(t_s % every_s >= every_s - length_s) if length_s > 0.0 else np.zeros(len(t_s), bool)


def _look(
    landmarks_w: Landmarks, R_wb: Float64[np.ndarray, "3 3"], p_wb: Float64[np.ndarray, "3"]
) -> tuple[Landmarks, Bool[np.ndarray, " m"]]:
    """Pixels of every landmark from one body pose (NaN behind the camera), and which are visible."""
    p_c = ((landmarks_w - p_wb) @ R_wb - EUROC.p_bc) @ EUROC.R_bc
    pixels = EUROC.project(p_c)
    return pixels, EUROC.in_view(pixels) & (p_c[:, 2] >= NEAR_M) & (p_c[:, 2] <= FAR_M)


def _head_start(rng: Generator, longest: int, *, first: bool) -> int:
    """Tracks that begin together would all end together; those of a first frame are taken as being of all ages."""
    return int(rng.integers(0, longest - 1)) if first and longest > 1 else 0


def seen(frames: Sequence[Frame]) -> float:
    """Mean number of tracks over the frames that see anything."""
    counts = [len(frame.tracks) for frame in frames if len(frame.tracks)]
    return float(np.mean(counts)) if counts else 0.0
