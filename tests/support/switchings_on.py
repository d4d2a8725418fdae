"""Logs of one made-up sensor that is switched on anew: another bias, another clock, another mount of the marker frame."""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from imutool.config import Settings
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import ACCEL, EPOCH_NS, GYRO, flight

DAY_NS, TEN_MINUTES_NS = 86_400_000_000_000, 600_000_000_000


class Switchings(Settings, frozen=True, kw_only=True):
    """One sensor kind: sizes are standard deviations."""

    sensor_seed: int = 3
    turn_on_rad_s: float = 0.010  # gyro bias, drawn anew at each switching-on
    turn_on_m_s2: float = 0.05
    scale: float = 0.005
    misalignment_rad: float = 0.002
    mount_rad: float = np.radians(0.5)  # marker frame against sensor, from log to log
    clock_s: float = 0.004  # clock of the poses, from log to log
    truth_noise: float = 1e-3  # rad and m of a pose
    noise_rad_s_rthz: float = 2e-4
    walk_rad_s2_rthz: float = 1e-5
    room_m: float = 3.0  # a smaller room is crossed in the same time: less speed
    rest_s: float = 20.0
    duration_s: float = 50.0
    rate_hz: float = 100.0
    attitude_knot_s: float = 0.35
    turn_rad: float = 0.5  # change of heading from knot to knot


def log(seed: int, switching: int, kind: Switchings | None = None) -> Recording:
    """Log `seed` of switching-on `switching`: logs of one switching-on share their bias and their day."""
    kind = kind or Switchings()
    sensor = {"typical_bias": 0.0, "turn_on_bias": 0.0, "warm_up": 0.0}
    sensor |= {"scale": kind.scale, "misalignment_rad": kind.misalignment_rad}
    noise = {"noise_density": kind.noise_rad_s_rthz, "walk_density": kind.walk_rad_s2_rthz}
    exact = flight(
        seed,
        duration_s=kind.duration_s,
        still_s=kind.rest_s,
        rate_hz=kind.rate_hz,
        room_m=kind.room_m,
        attitude_knot_s=kind.attitude_knot_s,
        turn_rad=kind.turn_rad,
        sensor_seed=kind.sensor_seed,
        gyro=msgspec.structs.replace(GYRO, **sensor, **noise),
        accel=msgspec.structs.replace(ACCEL, **sensor),
        truth_noise_rad=kind.truth_noise,
        truth_noise_m=kind.truth_noise,
    )
    once, own = np.random.default_rng([switching, 1]), np.random.default_rng([seed, 2])
    bias = np.concatenate([kind.turn_on_rad_s * once.normal(size=3), kind.turn_on_m_s2 * once.normal(size=3)])
    shift_ns = EPOCH_NS + DAY_NS * switching + TEN_MINUTES_NS * seed - int(exact.imu.t_ns[0])
    imu = Imu(exact.imu.t_ns + shift_ns, exact.imu.gyro + bias[:3], exact.imu.accel + bias[3:])
    mount = Rotation.from_rotvec(kind.mount_rad * own.normal(size=3))
    truth = exact.truth
    turned = (Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * mount).as_quat(scalar_first=True)
    clock_ns = round(1e9 * kind.clock_s * own.normal())
    poses = Poses(truth.t_ns + shift_ns + clock_ns, truth.p_wb, np.ascontiguousarray(turned), truth.v_w)
    return Recording(f"switching_{switching}_log_{seed}", imu, {"/ground_truth/pose": poses})
