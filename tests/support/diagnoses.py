"""Made-up diagnoses, of which everything is known: a lever arm, a late clock, a curve, nothing, a driver, three logs."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from imutool.diagnosis.result import Closer, Curve, Diagnosis, Estimate, Finding, HeldOut, Located, Traces, Unexplained
from imutool.geometry import quaternion
from imutool.inertial.strapdown import dead_reckon
from imutool.recording import Imu

RATE_HZ, DURATION_S, HELD_OUT_S = 200.0, 90.0, 30.0
GYRO_NOISE, ACCEL_NOISE = 0.004, 0.05
LEVER_ARM_M = np.array([0.213, -0.051, 0.120])
LAG_S = 0.0124
Value = TypeVar("Value")
HOSTILE = "</script><img src=x onerror=alert(1)>/imu&'\"$x^$"  # a log may be called anything


def replace(value: Value, **changes: Any) -> Value:
    """The same dataclass or Struct with other fields."""
    if isinstance(value, msgspec.Struct):
        return msgspec.structs.replace(value, **changes)
    return dataclasses.replace(value, **changes)  # type: ignore[type-var]


def motion(seed: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Angular rate, its derivative, specific force and attitude of a made-up motion that rests for the first ten seconds."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) / RATE_HZ
    gyro, alpha = np.zeros((count, 3)), np.zeros((count, 3))
    for axis in range(3):
        for f in rng.uniform(0.05, 0.8, 5):
            amplitude, phase = rng.uniform(0.1, 0.5), rng.uniform(0.0, 6.28)
            gyro[:, axis] += amplitude * np.sin(6.28 * f * t + phase)
            alpha[:, axis] += 6.28 * f * amplitude * np.cos(6.28 * f * t + phase)
    moving = np.clip((t - 10.0) / 2.0, 0.0, 1.0)[:, None]
    gyro, alpha = gyro * moving, alpha * moving
    q_wb_wxyz = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], quaternion.exp(gyro[:-1] / RATE_HZ)])
    shift = 1
    while shift < count:  # running products in log2(n) passes
        q_wb_wxyz = np.concatenate([q_wb_wxyz[:shift], quaternion.multiply(q_wb_wxyz[:-shift], q_wb_wxyz[shift:])])
        shift *= 2
    R_wb = Rotation.from_quat(quaternion.unit(q_wb_wxyz), scalar_first=True)
    up = R_wb.apply([0.0, 0.0, 9.81], inverse=True)
    accel = up + moving * np.sin(t)[:, None] * rng.normal(0.0, 0.8, 3)
    return gyro, alpha, accel, R_wb.as_quat(scalar_first=True)


def traces(
    log: str = "flight",
    *,
    arm: bool = False,
    late: bool = False,
    start_s: float = 0.0,
    seed: int = 1,
    duration_s: float = DURATION_S,
) -> Traces:
    """Samples with what is planted, and what was expected without and with it; held out is a third in the middle."""
    count = int(duration_s * RATE_HZ)
    t = np.arange(count) / RATE_HZ
    gyro, alpha, accel, q_wb_wxyz = motion(seed, count)
    before = np.concatenate([gyro, accel], axis=1)
    after = before.copy()
    if arm:
        after[:, 3:] += np.cross(alpha, LEVER_ARM_M) + np.cross(gyro, np.cross(gyro, LEVER_ARM_M))
    if late:
        after[:, :3] -= LAG_S * alpha
    rng = np.random.default_rng(seed + 100)
    noise = np.concatenate([rng.normal(0.0, GYRO_NOISE, (count, 3)), rng.normal(0.0, ACCEL_NOISE, (count, 3))], axis=1)
    held_out = (t >= duration_s / 3.0) & (t < 2.0 * duration_s / 3.0)
    t_ns = np.round((t + start_s) * 1e9).astype(np.int64)
    truth = dead_reckon(Imu(t_ns, gyro, accel), (q_wb_wxyz[0], np.zeros(3), np.zeros(3)))
    return Traces(log, t + start_s, after + noise, before, after, held_out, truth, before)


def unexplained(white: bool = True, accel_rms: float = ACCEL_NOISE) -> dict[str, Unexplained]:
    return {"gyro": Unexplained(GYRO_NOISE, GYRO_NOISE, True), "accel": Unexplained(accel_rms, ACCEL_NOISE, white)}


LEVER_ARM = Finding(
    "lever_arm",
    "accel",
    0.71,
    1e-12,
    0.01,
    {
        "x": Estimate(0.2131, 0.0043, "m"),
        "y": Estimate(-0.0512, 0.0041, "m"),
        "z": Estimate(0.1204, 0.0039, "m"),
    },
    "accel += alpha x r + omega x (omega x r)",
    HeldOut(0.52, 0.19, "m/s^2", HELD_OUT_S),
)
LAG = Finding(
    "clock_offset",
    "gyro",
    0.63,
    1e-9,
    0.01,
    {"tau": Estimate(-0.01243, 0.00031, "s")},
    "samples taken at t + tau",
    HeldOut(0.02, 0.0074, "rad/s", HELD_OUT_S),
)
DRIVEN = Finding(
    "driven",
    "accel",
    0.5,
    1e-6,
    0.02,
    {"gain": Estimate(0.31, 0.02, "m/s^2 per A"), "lag": Estimate(0.12, 0.01, "s")},
    "accel += gain current(t - lag)",
    HeldOut(0.3, 0.1, "m/s^2", HELD_OUT_S),
    driver="/motor.current",
    kind="driven",
    variable="/motor.current",
)
UNKNOWN = Finding(
    "unknown",
    "gyro",
    0.4,
    1e-7,
    0.02,
    {},
    "gyro += c(omega_z)",
    HeldOut(0.02, 0.01, "rad/s", HELD_OUT_S),
    kind="unknown",
    variable="angular rate z",
    curve=Curve.of_arrays(
        "angular rate z",
        "rad/s",
        np.linspace(-1.0, 1.0, 41),
        0.02 * np.stack([np.linspace(-1.0, 1.0, 41) ** 3, np.zeros(41), np.abs(np.linspace(-1.0, 1.0, 41))], axis=1),
        np.full((41, 3), 0.001),
    ),
)
TURNING = Located("gyro", ("x", "y", "z"), ((12.0, 48.5), (60.0, 89.0)), "when turning", 0.9, 1e-9)
FAST = Located("accel", ("x", "y"), ((12.0, 48.5),), "angular rate above 0.4 rad/s", 0.83, 1e-9)
BIAS = np.array([[0.01, -0.02, 0.003, 0.1, -0.2, 0.05]])

NOTHING = Diagnosis(("real.mcap",), "sim.mcap", (), (), BIAS, (), unexplained(), traces=(traces(),))
ARM = replace(NOTHING, located=(FAST,), findings=(LEVER_ARM,), traces=(traces(arm=True),))
LATE = replace(NOTHING, located=(TURNING,), findings=(LAG,), traces=(traces(late=True),))
BOTH = replace(
    NOTHING,
    sim=None,
    located=(FAST, TURNING),
    findings=(LEVER_ARM, LAG),
    not_identifiable=("gyro_scale.x", "gravity.tilt"),
    closer={"gyro": Closer(0.02, 0.0074, "rad/s", 90.0, 0.9), "accel": Closer(0.52, 0.19, "m/s^2", 90.0, 0.87)},
    remarks=("The truth ends 2 s before the log.",),
    traces=(traces(arm=True, late=True),),
)
BY_CURRENT = replace(NOTHING, located=(FAST,), findings=(DRIVEN,), unexplained=unexplained(False, 0.11))
NAMELESS = replace(LATE, findings=(UNKNOWN,))
UNEXPLAINED = replace(NOTHING, located=(FAST,), unexplained=unexplained(False, 0.2))
THREE = replace(
    BOTH,
    real=("one.mcap", "two.mcap", f"{HOSTILE}.mcap"),
    bias=np.concatenate([BIAS, 2.0 * BIAS, -BIAS]),
    traces=tuple(
        traces(name, arm=True, late=True, start_s=100.0 * k, seed=k + 1, duration_s=DURATION_S - 20.0 * k)
        for k, name in enumerate(("one", "two", HOSTILE))
    ),
)
