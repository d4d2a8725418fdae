"""Blind cases of robots: an arm, a vehicle on wheels, or one in flight."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from support.robot_cases import arm as robot_arm
from support.robot_cases import vehicle as robot_vehicle
from support.robot_cases.log import write

Generator = np.random.Generator
Planted = tuple[str, str, Mapping[str, float]]  # effect, column, parameters that the diagnosis should find
KINDS = ("single", "pair", "unnamed", "none")
ROBOTS = ("arm", "wheels", "flight")
JOINTS, NAMES = "/joint_states", ("shoulder", "elbow")
ARM_EFFECTS = (
    *("coulomb_friction", "viscous_friction", "rotor_inertia", "gear_ripple", "payload", "actuator_delay", "actuator_gain"),
    *("actuator_dead_band", "torque_saturation", "encoder_offset"),
)
WHEEL_EFFECTS = ("wheel_radius", "track_width", "wheel_slip")
FLIGHT_EFFECTS = (
    *("hard_iron", "soft_iron", "magnetometer_misalignment", "declination", "low_pass", "dynamic_pressure"),
    *("pressure_temperature", "gnss_lever_arm", "latency", "gain", "offset"),
)
EFFECTS = {"arm": ARM_EFFECTS, "wheels": WHEEL_EFFECTS, "flight": FLIGHT_EFFECTS}
Torque = Callable[[Any, Any], Any]
UNNAMED: Mapping[str, tuple[str, Callable[[float], Torque]]] = {
    "velocity[0] |velocity[0]|": ("square drag", lambda c: lambda q, dq: np.array([c * dq[0] * abs(dq[0]), 0.0])),
    "sin(3 position[0])": ("detent", lambda c: lambda q, dq: np.array([c * np.sin(3.0 * q[0]), 0.0])),
    "position[0]^3": ("hardening spring", lambda c: lambda q, dq: np.array([c * q[0] ** 3, 0.0])),
    "velocity[0]^3": ("cubic drag", lambda c: lambda q, dq: np.array([c * dq[0] ** 3, 0.0])),
    "position[0] velocity[0]": ("drag by angle", lambda c: lambda q, dq: np.array([c * q[0] * dq[0], 0.0])),
    "1/(1 + (velocity[0]/s)^2)": ("lubrication", lambda c: lambda q, dq: np.array([2.0 * c / (1.0 + dq[0] ** 2), 0.0])),
}


def conceal_robot(folder: Path, seed: int, robot: str, kind: str, effect: str = "") -> None:
    """Write `real.mcap`, `sim.mcap` and `truth.json` of a case."""
    rng = np.random.default_rng([seed, 7])
    wanted = [] if kind in ("none", "unnamed") else [effect or str(rng.choice(EFFECTS[robot]))]
    if kind == "pair":
        wanted.append(str(rng.choice([name for name in EFFECTS[robot] if name not in wanted])))
    folder.mkdir(parents=True, exist_ok=True)
    if robot == "arm":
        planted = _arm(folder, seed, rng, wanted, kind, effect)
    elif robot == "wheels":
        on_wheels, planted = _on_wheels(rng, wanted)
        for name, own, noise in (("real", on_wheels, 1), ("sim", robot_vehicle.OnWheels(), 2)):
            course = np.random.default_rng([seed, 3])
            write(
                folder / f"{name}.mcap",
                robot_vehicle.driven(own, course, np.random.default_rng([seed, noise])),
                ("left", "right"),
            )
    else:
        in_flight, planted = _in_flight(rng, wanted)
        for name, fly, noise in (("real", in_flight, 1), ("sim", robot_vehicle.InFlight(), 2)):
            course = np.random.default_rng([seed, 3])
            write(folder / f"{name}.mcap", robot_vehicle.flown(fly, course, np.random.default_rng([seed, noise])))
    effects = [{"effect": name, "column": column, "parameters": dict(values)} for name, column, values in planted]
    (folder / "truth.json").write_text(json.dumps({"robot": robot, "kind": kind, "seed": seed, "effects": effects}, indent=1))


def _arm(folder: Path, seed: int, rng: Generator, wanted: list[str], kind: str, form: str) -> list[Planted]:
    lengths, masses = tuple(rng.uniform(0.25, 0.45, 2).tolist()), tuple(rng.uniform(0.8, 2.5, 2).tolist())
    arm = robot_arm.Arm(lengths, masses, tuple(rng.uniform(0.02, 0.1, 2).tolist()))
    left_out, planted = robot_arm.LeftOut(), list[Planted]()
    load = 9.81 * masses[1] * lengths[1] * 0.5
    if kind == "unnamed":
        name = form or str(rng.choice(list(UNNAMED)))
        left_out = replace(left_out, unnamed=UNNAMED[name][1](0.4 * load))
        planted.append(("unknown", f"{JOINTS}.effort[0]", {name: 0.4 * load}))
    for name in wanted:
        left_out, entry = _joint_effect(left_out, name, int(rng.integers(2)), load, arm, rng)
        planted.append(entry)
    for name, own, noise in (("real", left_out, 1), ("sim", None, 2)):
        course = robot_arm.course(np.random.default_rng([seed, 3]), 40.0)
        t_s, rows = robot_arm.moved(arm, own, course, np.random.default_rng([seed, noise]))
        write(folder / f"{name}.mcap", {JOINTS: ("sensor_msgs/msg/JointState", t_s, rows)}, NAMES)
    return planted


def _joint_effect(
    own: robot_arm.LeftOut, name: str, k: int, load: float, arm: robot_arm.Arm, rng: Generator
) -> tuple[robot_arm.LeftOut, Planted]:
    size, column = float(rng.uniform(0.1, 0.25)) * load, f"{JOINTS}.effort[{k}]"

    def on(value: Any, other: Any) -> Any:
        return (value, other) if k == 0 else (other, value)

    inertia, teeth = float(rng.uniform(0.02, 0.06)), float(rng.integers(10, 30))
    mass, z = float(rng.uniform(0.2, 0.8)), float(rng.uniform(-0.05, 0.05))
    x, angle = arm.lengths[1] * float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.02, 0.06))
    delay, gain = round(float(rng.uniform(0.006, 0.025)), 3), float(rng.uniform(0.8, 0.95))
    limit = load * (1.1 if k else 1.6 * (1.0 + arm.masses[0] / arm.masses[1]))
    ripple = {"sine": size, "cosine": 0.5 * size, "per_turn": teeth}
    draws: dict[str, tuple[dict[str, Any], str, dict[str, float]]] = {
        "coulomb_friction": ({"coulomb": on(size, 0.0)}, column, {"level": size}),
        "viscous_friction": ({"viscous": on(size, 0.0)}, column, {"coefficient": size}),
        "rotor_inertia": ({"rotor": on(inertia, 0.0)}, column, {"inertia": inertia}),
        "gear_ripple": ({"ripple": on(tuple(ripple.values()), (0.0, 0.0, 1.0))}, column, ripple),
        "payload": ({"payload": (mass, x, z)}, JOINTS, {"mass": mass, "x": x, "y": z}),
        "actuator_delay": ({"delay_s": delay}, JOINTS, {"delay": delay}),
        "actuator_gain": ({"gain": on(gain, 1.0)}, column, {"gain": gain}),
        "actuator_dead_band": ({"dead_band": on(size, 0.0)}, column, {"width": size}),
        "torque_saturation": ({"limit": on(limit, 1e9)}, column, {"limit": limit}),
        "encoder_offset": ({"encoder": on(angle, 0.0)}, column, {"offset": angle}),
    }
    changed, where, values = draws[name]
    return replace(own, **changed), (name, where, values)


def _on_wheels(rng: Generator, wanted: list[str]) -> tuple[robot_vehicle.OnWheels, list[Planted]]:
    own, planted = robot_vehicle.OnWheels(), list[Planted]()
    for name in wanted:
        size = float(rng.uniform(0.01, 0.05)) * float(rng.choice([-1.0, 1.0]))
        if name == "wheel_radius":
            other = float(rng.uniform(-0.03, 0.03))
            own = replace(own, radius=(size, other))
            planted.append((name, "/odom", {"wheel_0": size, "wheel_1": other}))
        elif name == "track_width":
            own = replace(own, track=size)
            planted.append((name, "/odom.twist.twist.angular.z", {"change": size}))
        else:
            own = replace(own, slip=abs(size))
            planted.append((name, "/odom.twist.twist.linear.x", {"slip": abs(size)}))
    return own, planted


def _in_flight(rng: Generator, wanted: list[str]) -> tuple[robot_vehicle.InFlight, list[Planted]]:
    own, planted = robot_vehicle.InFlight(), list[Planted]()
    vector = {name: tuple(rng.uniform(-1.0, 1.0, 3).tolist()) for name in ("hard", "turned", "arm")}
    soft = tuple((0.08 * rng.uniform(-1.0, 1.0, 6)).tolist())
    hard, turned, arm = (
        tuple(scale * v for v in vector[name]) for name, scale in (("hard", 8e-6), ("turned", 0.08), ("arm", 0.8))
    )
    draws: dict[str, tuple[dict[str, Any], str, dict[str, float]]] = {
        "hard_iron": ({"hard": hard}, "/mag", dict(zip("xyz", hard, strict=True))),
        "soft_iron": ({"soft": soft}, "/mag", dict(zip(("xx", "yy", "zz", "xy", "xz", "yz"), soft, strict=True))),
        "magnetometer_misalignment": ({"turned": turned}, "/mag", dict(zip("xyz", turned, strict=True))),
        "declination": ({"declination": 0.12}, "/mag", {"angle": 0.12}),
        "low_pass": ({"lag_s": 0.25}, "/baro.fluid_pressure", {"f_c": 1.0 / (2.0 * np.pi * 0.25)}),
        "dynamic_pressure": ({"dynamic": 0.6}, "/baro.fluid_pressure", {"coefficient": 0.6}),
        "pressure_temperature": ({"per_kelvin": 8.0}, "/baro.fluid_pressure", {"slope": 8.0}),
        "gnss_lever_arm": ({"arm": arm}, "/gnss", dict(zip("xyz", arm, strict=True))),
        "latency": ({"latency_s": 0.12}, "/gnss", {"delay": 0.12}),
        "gain": ({"range_gain": 1.03}, "/range.range", {"gain": 1.03}),
        "offset": ({"range_offset": 0.15}, "/range.range", {"offset": 0.15}),
    }
    for name in wanted:
        changed, column, values = draws[name]
        own = replace(own, **changed)
        planted.append((name, column, values))
    return own, planted
