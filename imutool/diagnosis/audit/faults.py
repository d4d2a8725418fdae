"""Faults of simulated IMUs: equation, sentence, and the report of a simulator that had it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from imutool.diagnosis.result import Estimate
from imutool.report import Section


@dataclass(frozen=True)
class Fault:
    """Fault of a simulator: its equation, where it was reported, what would make it right."""

    sentence: str
    equation: str
    source: str
    unless: str = ""


CERTAIN = 6.0  # standard deviations
GITHUB = "https://github.com"
FAULTS: Mapping[str, Fault] = {
    "coordinate_acceleration": Fault(
        "reads the acceleration without gravity, not the specific force",
        "accel = R_wb^T a_w",
        f"{GITHUB}/ros-simulation/gazebo_ros_pkgs/issues/468",
    ),
    "gravity_doubled": Fault(
        "holds gravity twice", "accel = R_wb^T (a_w - 2 g_w)", f"{GITHUB}/cra-ros-pkg/robot_localization/pull/946"
    ),
    "gravity_sign": Fault(
        "holds gravity with the wrong sign: at rest it reads g down",
        "accel = R_wb^T (a_w + g_w)",
        f"{GITHUB}/Field-Robotics-Japan/UnitySensors/issues/116",
        unless="the z axis of the poses points down: name their frame NED (odom_ned)",
    ),
    "gravity_only": Fault(
        "holds gravity alone, no acceleration", "accel = -R_wb^T g_w", f"{GITHUB}/gazebosim/gz-sim/issues/2974"
    ),
    "transport_term": Fault(
        "is the derivative of the velocity in the body frame, without the transport term omega x v",
        "accel = d(R_wb^T v_w)/dt - R_wb^T g_w",
        f"{GITHUB}/isaac-sim/IsaacSim/issues/735",
    ),
    "lever_arm": Fault(
        "is that of another point than the one of the poses",
        "accel += alpha x r + omega x (omega x r)",
        f"{GITHUB}/isaac-sim/IsaacSim/issues/825",
        unless="the sensor sits there: state its mount on /tf_static",
    ),
    "body_centre": Fault(
        "is that of the body's centre; the recording's sensor sits off it",
        "accel lacks alpha x r + omega x (omega x r)",
        f"{GITHUB}/isaac-sim/IsaacLab/pull/619",
    ),
    "backward_difference": Fault(
        "is a backward difference, half a step late",
        "x(t) = (y(t) - y(t - T)) / T, late by T / 2",
        f"{GITHUB}/ethz-asl/rotors_simulator/pull/272",
        unless="the integrator is semi-implicit Euler: then the poses are half a step early",
    ),
    "step_delay": Fault(
        "comes late, by a step or more",
        "x(t) = x_true(t - T)",
        f"{GITHUB}/PegasusSimulator/PegasusSimulator/pull/147",
        unless="a filter of the sensor makes it so late",
    ),
    "early_stamps": Fault(
        "is stamped one step early: with the beginning of the step at whose end it was read",
        "x(t) = x_true(t + T)",
        f"{GITHUB}/gazebosim/gazebo-classic/issues/600",
    ),
    "other_clock": Fault(
        "has stamps of another clock than that of the physics",
        "gyro = s omega, accel = s^2 R_wb^T a_w - R_wb^T g_w, s seconds of the stamps in one of the physics",
        f"{GITHUB}/microsoft/AirSim/issues/4232",
    ),
    "world_frame": Fault(
        "is given in the world frame, not the body's", "x = R_wb x_body", f"{GITHUB}/carla-simulator/carla/pull/2998"
    ),
    "euler_rates": Fault(
        "holds the rates of roll, pitch and yaw, not the angular rate of the body",
        "gyro = d(roll, pitch, yaw)/dt",
        f"{GITHUB}/morse-simulator/morse/pull/667",
    ),
    "left_handed": Fault(
        "has left-handed axes", "x = P x_body, P a signed permutation, det P < 0", f"{GITHUB}/carla-simulator/carla/issues/4008"
    ),
    "permuted_axes": Fault(
        "has permuted axes",
        "x = P x_body, P a signed permutation, det P > 0",
        f"{GITHUB}/fsstudio-team/ZeroSimROSUnity/issues/9",
        unless="the sensor is mounted so: state its mount on /tf_static",
    ),
    "turned_axes": Fault(
        "is turned against the body of its poses",
        "x = R x_body, R a rotation",
        f"{GITHUB}/ArduPilot/ardupilot_gazebo/issues/139",
        unless="the sensor is mounted so: state its mount on /tf_static",
    ),
    "wrong_unit": Fault(
        "is not in SI units: a rate in deg/s, an acceleration in g",
        "gyro = 180 / pi x, accel = x / 9.80665",
        f"{GITHUB}/at-wat/mcl_3dl/issues/423",
    ),
    "noise_absent": Fault("has no noise", "x = x_true", f"{GITHUB}/PX4/PX4-gazebo-models/pull/33"),
    "noise_per_sample": Fault(
        "has the noise of a sample at another rate: its density changed with the rate",
        "std of a sample = density sqrt(rate)",
        f"{GITHUB}/microsoft/AirSim/issues/3498",
    ),
    "noise_density": Fault(
        "has another noise density", "density = std of a sample / sqrt(rate)", f"{GITHUB}/PX4/PX4-gazebo-models/pull/81"
    ),
    "bias_never_walks": Fault(
        "has a bias that never walks", "db = walk sqrt(dt) n", f"{GITHUB}/Aceinna/gnss-ins-sim/issues/23"
    ),
    "clipping_absent": Fault(
        "is not clipped at the sensor's limit", "x = min(max(x, -L), L)", f"{GITHUB}/gazebosim/gz-sensors/issues/7"
    ),
    "digits_absent": Fault("has no digits", "x = LSB round(x / LSB)", f"{GITHUB}/gazebosim/gz-sensors/issues/7"),
    "bandwidth_absent": Fault(
        "has white noise where the sensor's falls with frequency", "x = low-pass(x)", f"{GITHUB}/gazebosim/gz-sensors/issues/7"
    ),
    "step_lines": Fault(
        "has lines in its spectrum with which the body does not move, as the physics step makes them",
        "x += A sin(2 pi f t), f the physics rate or its alias",
        f"{GITHUB}/gazebosim/gazebo-classic/issues/666",
    ),
    "repeated_samples": Fault(
        "repeats samples: the physics step is longer than the sample period",
        "x(t) = x(t - T)",
        f"{GITHUB}/isaac-sim/IsaacLab/issues/7163",
    ),
}


class FaultFound(Section, frozen=True):
    """Fault of a simulator in one signal, with its numbers."""

    fault: str
    signal: str
    parameters: Mapping[str, Estimate]
    equation: str
    source: str

    @property
    def sentence(self) -> str:
        """`The accel reads ...`."""
        both = self.signal == "both"
        text = FAULTS[self.fault].sentence
        return f"{'Each of gyro and accel' if both else f'The {self.signal}'} {text}"

    @property
    def unless(self) -> str:
        """What would make it no fault; mostly empty."""
        return FAULTS[self.fault].unless


def clear(estimate: Estimate, ideal: float = 0.0) -> bool:
    """Whether an estimate differs from an ideal."""
    return abs(estimate.value - ideal) > CERTAIN * estimate.std


def found(fault: str, signal: str, **parameters: Estimate) -> FaultFound:
    """Fault with its equation and source."""
    return FaultFound(fault, signal, parameters, FAULTS[fault].equation, FAULTS[fault].source)
