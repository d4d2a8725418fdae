"""Relation of two IMUs on one body: rotation, lever arm and clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64, Int64
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.estimation.time_alignment import with_simulation
from imutool.diagnosis.result import Estimate
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.wording.quantity import Quantity, value
from imutool.recording import Imu, Recording, interpolate, seconds
from imutool.sensor import catalogue
from imutool.units import AXES

STEP_RAD = 1e-6


def imu_relation(first: Recording, other: Recording, effects: Sequence[str], settings: DiagnoseSettings) -> dict[str, Estimate]:
    """Rotation, lever arm and clock of an IMU against the first, with robust deviations.

    `rotation_*` is the rotation vector of R, which takes vectors of the other to the first; `arm_*` is the other's place in the
    first's axes; the other's samples are taken `clock` after their stamps, by the first's clock. The start is Wahba's rotation
    (A least squares estimate of satellite attitude, SIAM Review 7, 1965); `effects` are fitted to the rest.

    Raises:
        DataError: too little shared time, or another motion.
    """
    a, b = first.imu, other.imu
    t_ns = b.t_ns[(b.t_ns >= a.t_ns[0]) & (b.t_ns <= a.t_ns[-1])]
    R = Rotation.identity() if len(t_ns) < 2 else Rotation.align_vectors(_vectors(b, t_ns), _vectors(a, t_ns))[0]
    back = R.inv().as_matrix()
    turned = replace(first, imu=replace(a, gyro=a.gyro @ back, accel=a.accel @ back), truths={})
    pairs = with_simulation(replace(other, truths={}), turned, settings)
    chosen = tuple((effect, effect.null_value.astype(float)) for effect in catalogue.diagnosed(effects))
    logs = [whitened(pair, [effect for effect, _ in chosen]) for pair in pairs]
    fitted = fit(logs, chosen, part="all")
    stds = scatter(fitted).std
    theta = {effect.name: values for effect, values in fitted.chosen}
    phi, arm = theta["mount_rotation"], theta["lever_arm"]

    def whole(phi: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        return np.asarray((R.inv() * Rotation.from_rotvec(phi)).as_rotvec())

    slope = np.stack([(whole(phi + step) - whole(phi - step)) / (2.0 * STEP_RAD) for step in STEP_RAD * np.eye(3)], axis=1)
    out = {"clock": Estimate(float(theta["clock_offset"][0]), float(stds["clock_offset"][0]), "s")}
    for name, unit, values, variance in (
        ("rotation", "rad", whole(phi), slope**2 @ stds["mount_rotation"] ** 2),
        ("arm", "m", back @ arm, back**2 @ stds["lever_arm"] ** 2),
    ):
        numbers = zip(AXES, values, np.sqrt(variance), strict=True)
        out |= {f"{name}_{axis}": Estimate(float(x), float(std), unit) for axis, x, std in numbers}
    return out


def _vectors(imu: Imu, t_ns: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "m 3"]:
    """Angular rates without their mean, then specific forces, at some times; both parts of one size."""
    t_s, own_s = (seconds(times, int(imu.t_ns[0])) for times in (t_ns, imu.t_ns))
    rates, forces = (interpolate(t_s, own_s, part) for part in (imu.gyro, imu.accel))
    rates = rates - rates.mean(axis=0)
    return np.concatenate([part / max(float(np.linalg.norm(part)), 1e-12) for part in (rates, forces)])


def imu_sentence(topic: str, first: str, relation: Mapping[str, Estimate]) -> str:
    """Relation of an IMU to the first, in a sentence."""
    rotation, arm = (Quantity("", AXES, tuple(relation[f"{name}_{axis}"] for axis in AXES)) for name in ("rotation", "arm"))
    return (
        f"{topic} sits at {arm} in the axes of {first}, is turned by {rotation}, "
        f"and its samples are taken {value(relation['clock'])} after their stamps"
    )
