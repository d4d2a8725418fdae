"""Logs of a vehicle with aids of its IMU: wheel odometry and a barometer, as ROS 2 messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer
from scipy.spatial.transform import Rotation

from imutool.inertial.kinematics import fit_trajectory
from imutool.mcap_io.codec import schemas
from imutool.recording import Imu, Poses
from support.robot_cases.log import DEFINITIONS, HEADER, SEPARATOR, VECTOR

START_NS = 1_700_000_000_000_000_000
R_VB = Rotation.from_euler("ZYX", [35.0, 4.0, -3.0], degrees=True)  # of the IMU in the vehicle
LEVER_B = np.array([0.25, -0.1, -0.15])  # from the IMU to the vehicle's point
BIAS = np.array([2e-3, -1e-3, 3e-3, 0.05, -0.04, 0.03])
STILL_S = 2.0
KINDS = {
    **DEFINITIONS,
    schemas.IMU: schemas.definition(schemas.IMU),
    "geometry_msgs/msg/TwistStamped": (
        "std_msgs/Header header\ngeometry_msgs/Twist twist\n"
        f"{SEPARATOR}\nMSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n{VECTOR}{HEADER}"
    ),
}
Topic = tuple[str, np.ndarray, Sequence[dict[str, Any]]]  # message, stamps, and fields without a header


@dataclass(frozen=True)
class Drive:
    """A drive in the plane: samples with a bias, true poses of the IMU, and the vehicle's poses and twist at 50 Hz."""

    imu: Imu
    truth: Poses
    vehicle: Poses
    speed: np.ndarray
    turn: np.ndarray


def drive(
    seed: int = 0, duration_s: float = 60.0, lever_b: np.ndarray = LEVER_B, mount: Rotation = R_VB, usual_m_s: float = 1.0
) -> Drive:
    """Drive that rests, then accelerates, brakes and turns."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration_s * 500) + 1) / 500.0
    moving = np.clip((t - STILL_S) / 1.0, 0.0, 1.0) ** 3
    waves = [np.sin(2 * np.pi * rng.uniform(0.05, 0.25, 4)[:, None] * t + rng.uniform(0, 6, (4, 1))).sum(axis=0) for _ in "vw"]
    speed, turn = moving * usual_m_s * (1.0 + 0.4 * waves[0]), moving * 0.35 * waves[1]
    yaw = np.cumsum(turn) / 500.0
    p = np.cumsum(speed[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(t))]), axis=0) / 500.0
    R_wv = Rotation.from_euler("z", yaw[:, None])
    q_wv, q_wb = (R.as_quat(scalar_first=True) for R in (R_wv, R_wv * mount))
    t_ns = START_NS + np.round(t * 1e9).astype(np.int64)
    p_wb = p - (R_wv * mount).apply(lever_b)
    path = fit_trajectory(Poses(t_ns[::10], p_wb[::10], q_wb[::10]))
    ideal, truth = path.imu(t_ns[:-10:5]), path.poses(t_ns[:-10:5])
    noise = rng.normal(size=(len(ideal), 6)) * np.repeat([2e-3, 2e-2], 3)
    imu = Imu(ideal.t_ns, ideal.gyro + BIAS[:3] + noise[:, :3], ideal.accel + BIAS[3:] + noise[:, 3:])
    return Drive(imu, truth, Poses(t_ns[::10], p[::10], q_wv[::10]), speed[::10], turn[::10])


def odometry(vehicle: Poses, twist: np.ndarray | None = None) -> Topic:
    """`nav_msgs/Odometry` with the vehicle's poses, and its twist (forward speed, turn)."""
    twist = np.zeros((len(vehicle), 2)) if twist is None else twist
    poses = zip(map(_pose, vehicle.p_wb, vehicle.q_wb_wxyz), map(_twist, twist[:, 0], twist[:, 1]), strict=True)
    rows = [
        {
            "child_frame_id": "base_link",
            "pose": {"pose": p, "covariance": [0.0] * 36},
            "twist": {"twist": v, "covariance": [0.0] * 36},
        }
        for p, v in poses
    ]
    return "nav_msgs/msg/Odometry", vehicle.t_ns, rows


def wheels(driven: Drive, share: float = 0.0, noise_m_s: float = 0.01) -> Topic:
    """`geometry_msgs/TwistStamped` of wheels whose radius is wrong by a share."""
    rng = np.random.default_rng(7)
    speed = (1.0 + share) * driven.speed + noise_m_s * rng.normal(size=len(driven.speed))
    rows = [{"twist": _twist(v, w)} for v, w in zip(speed, driven.turn, strict=True)]
    return "geometry_msgs/msg/TwistStamped", driven.vehicle.t_ns, rows


def poses(path: Poses) -> Topic:
    """`geometry_msgs/PoseStamped`."""
    rows = [{"pose": _pose(p, q)} for p, q in zip(path.p_wb, path.q_wb_wxyz, strict=True)]
    return "geometry_msgs/msg/PoseStamped", path.t_ns, rows


def pressure(t_ns: np.ndarray, height_m: np.ndarray, factor: float = 1.0) -> Topic:
    """`sensor_msgs/FluidPressure` at heights, in pascals times a factor."""
    pascals = 101_325.0 * (1.0 - height_m / 44_330.8) ** (1.0 / 0.190263)
    return "sensor_msgs/msg/FluidPressure", t_ns, [{"fluid_pressure": factor * p, "variance": 0.0} for p in pascals.tolist()]


def write(
    path: Path, imu: Imu, truth: Poses, topics: Mapping[str, Topic], late_ns: int = 0, again_ns: int | None = None
) -> Path:
    """Write a log with the topics; every message arrives `late_ns` after its stamp.

    With `again_ns` all of it comes a second time behind the first, with stamps that differ by so much.
    """
    kind, t_ns, rows = poses(truth)
    every = {"/imu": _imu(imu), "/ground_truth/pose": (kind, t_ns, rows), **topics}
    messages = []
    for topic, (kind, stamps, values) in every.items():
        for stamp, row in zip(stamps.tolist(), values, strict=True):
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "odom"}
            messages.append(
                (stamp + late_ns, topic, kind, row if kind == "std_msgs/msg/Float64" else {"header": header, **row})
            )
    if again_ns is not None:
        length = max(entry[0] for entry in messages) - START_NS + 10**9
        messages += [(t + length, topic, kind, _shifted(row, again_ns)) for t, topic, kind, row in messages]
    with path.open("wb") as file:
        writer = Writer(file)
        known = {kind: writer.register_msgdef(kind, KINDS[kind]) for kind in {kind for _, _, kind, _ in messages}}
        for log_time, topic, kind, message in sorted(messages, key=lambda entry: entry[:2]):
            writer.write_message(topic, known[kind], message, log_time=log_time, publish_time=log_time)
        writer.finish()
    return path


def _shifted(row: dict[str, Any], by_ns: int) -> dict[str, Any]:
    stamp = row["header"]["stamp"]["sec"] * 10**9 + row["header"]["stamp"]["nanosec"] + by_ns
    return {**row, "header": {**row["header"], "stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}}}


def _imu(imu: Imu) -> Topic:
    still = {"orientation": _xyzw(np.array([1.0, 0, 0, 0])), "orientation_covariance": [-1.0, *[0.0] * 8]}
    empty = {"angular_velocity_covariance": [0.0] * 9, "linear_acceleration_covariance": [0.0] * 9}
    rows = [
        {**still, **empty, "angular_velocity": _xyz(w), "linear_acceleration": _xyz(f)}
        for w, f in zip(imu.gyro, imu.accel, strict=True)
    ]
    return schemas.IMU, imu.t_ns, rows


def _pose(p: np.ndarray, q_wxyz: np.ndarray) -> dict[str, Any]:
    return {"position": _xyz(p), "orientation": _xyzw(q_wxyz)}


def _twist(forward: float, turn: float) -> dict[str, Any]:
    return {"linear": _xyz(np.array([forward, 0.0, 0.0])), "angular": _xyz(np.array([0.0, 0.0, turn]))}


def _xyz(v: np.ndarray) -> dict[str, float]:
    return dict(zip("xyz", map(float, v), strict=True))


def _xyzw(q_wxyz: np.ndarray) -> dict[str, float]:
    return dict(zip("wxyz", map(float, q_wxyz), strict=True))
