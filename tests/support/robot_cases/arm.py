"""Arms of two hinges in MuJoCo for blind cases, with and without what is left out.

Both follow one course by computed torque with the simulation's own model. A log holds angles, velocities and the commanded
efforts. What is left out is MuJoCo's own (`frictionloss`, `damping`, `armature`, a mass) or is put on by hand, at every step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64

STEP_S, EACH, SETTLING_S = 0.001, 10, 2.0  # integrated at 1 kHz, recorded at 100 Hz
ANGLE_NOISE, VELOCITY_NOISE, EFFORT_NOISE = 2e-5, 5e-4, 0.004  # rad, rad/s, of the efforts' size
BANDWIDTH = 9.0  # rad/s of the controller


@dataclass(frozen=True)
class Arm:
    """Two links: lengths (m), masses (kg), damping (N m s/rad) of both arms alike."""

    lengths: tuple[float, float]
    masses: tuple[float, float]
    damping: tuple[float, float]


@dataclass(frozen=True)
class LeftOut:
    """Physics of the real arm alone, by joint.

    `unnamed` is a torque of angle and velocity.
    """

    coulomb: tuple[float, float] = (0.0, 0.0)
    viscous: tuple[float, float] = (0.0, 0.0)
    stribeck: tuple[tuple[float, float], ...] = ((0.0, 1.0), (0.0, 1.0))
    rotor: tuple[float, float] = (0.0, 0.0)
    ripple: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    payload: tuple[float, float, float] = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    gain: tuple[float, float] = (1.0, 1.0)
    dead_band: tuple[float, float] = (0.0, 0.0)
    limit: tuple[float, float] = (1e9, 1e9)
    encoder: tuple[float, float] = (0.0, 0.0)
    eccentric: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.0, 0.0))
    unnamed: Callable[[Any, Any], Any] | None = field(default=None, compare=False)


def xml(arm: Arm, left_out: LeftOut | None = None) -> str:
    """The arm in MuJoCo; its axes are level, x is along the links where the angles are zero."""
    own = left_out or LeftOut()
    joints = [
        f'<joint name="j{k}" type="hinge" axis="0 -1 0" damping="{arm.damping[k] + own.viscous[k]}"'
        f' frictionloss="{own.coulomb[k]}" solreffriction="{2.2 * STEP_S} 1" armature="{own.rotor[k]}"/>'
        for k in range(2)
    ]
    links = [
        f'<geom type="capsule" fromto="0 0 0 {length} 0 0" size="0.03" mass="{mass}"/>'
        for length, mass in zip(arm.lengths, arm.masses, strict=True)
    ]
    mass, x, z = own.payload
    load = f'<geom type="sphere" size="0.001" pos="{x} 0 {z}" mass="{mass}"/>' if mass else ""
    return f"""<mujoco>
  <option timestep="{STEP_S}" gravity="0 0 -9.81" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody><body pos="0 0 1">{joints[0]}{links[0]}
    <body pos="{arm.lengths[0]} 0 0">{joints[1]}{links[1]}{load}</body></body></worldbody>
  <actuator><motor joint="j0"/><motor joint="j1"/></actuator></mujoco>"""


def moved(
    arm: Arm, left_out: LeftOut | None, course: Mapping[str, Float64[np.ndarray, "_ 2"]], noise: np.random.Generator
) -> tuple[Float64[np.ndarray, " _"], Float64[np.ndarray, "_ 6"]]:
    """Times (s) and rows of angles, velocities and efforts along a course."""
    import mujoco  # type: ignore[import-untyped]  # it has no stubs

    own = left_out or LeftOut()
    body, plan = (mujoco.MjModel.from_xml_string(xml(arm, own_physics)) for own_physics in (left_out, None))
    data, model = mujoco.MjData(body), mujoco.MjData(plan)
    data.qpos[:] = course["q"][0]
    waiting = deque([np.zeros(2)] * round(own.delay_s / STEP_S))
    rows, times = [], []
    encoder, (sine, cosine), acting, forces = np.array(own.encoder), np.array(own.eccentric).T, _acting(own), _forces(own)
    wanted, eccentric = course["ddq"] + BANDWIDTH**2 * course["q"] + 2.0 * BANDWIDTH * course["dq"], bool(np.any(own.eccentric))
    qpos, qvel, qacc, effort = model.qpos, model.qvel, model.qacc, model.qfrc_inverse  # views of what MuJoCo works on
    true_q, true_dq, given, applied = data.qpos, data.qvel, data.ctrl, data.qfrc_applied
    for k, ahead in enumerate(wanted):
        angle = true_q + encoder
        if eccentric:
            angle += sine * np.sin(true_q) + cosine * np.cos(true_q)
        qpos[:], qvel[:] = angle, true_dq
        qacc[:] = ahead - BANDWIDTH**2 * angle - 2.0 * BANDWIDTH * true_dq
        mujoco.mj_inverse(plan, model)
        command = effort.copy()
        if k % EACH == 0:
            rows.append(np.concatenate([angle, true_dq, command]))
            times.append(k * STEP_S)
        waiting.append(command)
        given[:] = acting(waiting.popleft())
        if forces is not None:
            applied[:] = forces(true_q, true_dq)
        mujoco.mj_step(body, data)
    return _noisy(np.array(times), np.array(rows), noise)


def _noisy(
    t_s: Float64[np.ndarray, " _"], rows: Float64[np.ndarray, "_ 6"], noise: np.random.Generator
) -> tuple[Float64[np.ndarray, " _"], Float64[np.ndarray, "_ 6"]]:
    kept = t_s >= SETTLING_S
    rows = rows[kept]
    std = np.concatenate([[ANGLE_NOISE] * 2, [VELOCITY_NOISE] * 2, EFFORT_NOISE * rows[:, 4:].std(axis=0)])
    return t_s[kept], rows + std * noise.normal(size=rows.shape)


def _acting(own: LeftOut) -> Callable[[Float64[np.ndarray, " 2"]], Float64[np.ndarray, " 2"]]:
    """What the motors give of a command; numbers are arrays once, for every step of a millisecond asks."""
    dead, gain, limit = np.array(own.dead_band), np.array(own.gain), np.array(own.limit)
    holds = bool(dead.any())

    def acting(command: Float64[np.ndarray, " 2"]) -> Float64[np.ndarray, " 2"]:
        if holds:
            command = command - np.clip(command, -dead, dead)
        return np.minimum(np.maximum(gain * command, -limit), limit)

    return acting


def _forces(own: LeftOut) -> Callable[[Any, Any], Float64[np.ndarray, " 2"]] | None:
    """Torques that are left out, of angles and velocities, if any are."""
    level, slow = np.array(own.stribeck).T
    sine, cosine, per_turn = np.array(own.ripple).T
    sticks, ripples = bool(level.any()), bool(sine.any() or cosine.any())
    if not sticks and not ripples and own.unnamed is None:
        return None

    def forces(q: Any, dq: Any) -> Float64[np.ndarray, " 2"]:
        out = np.zeros(2)
        if sticks:
            out -= level * np.exp(-((dq / slow) ** 2)) * np.tanh(dq / 1e-3)
        if ripples:
            out -= sine * np.sin(per_turn * q) + cosine * np.cos(per_turn * q)
        return out if own.unnamed is None else out - own.unnamed(q, dq)

    return forces


def course(rng: np.random.Generator, duration_s: float) -> dict[str, Float64[np.ndarray, "_ 2"]]:
    """Sums of five sines for each joint, with their derivatives."""
    t = np.arange(round((duration_s + SETTLING_S) / STEP_S)) * STEP_S
    out = {name: np.zeros((len(t), 2)) for name in ("q", "dq", "ddq")}
    for k in range(2):
        w, phase = 2.0 * np.pi * np.geomspace(0.08, 0.9, 5) * rng.uniform(0.85, 1.15, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
        size = rng.uniform(0.9, 1.3) / np.sqrt(w / w[0]) / 1.4
        for order, name in enumerate(("q", "dq", "ddq")):
            out[name][:, k] = (size * w**order * np.sin(np.outer(t, w) + phase + 0.5 * np.pi * order)).sum(axis=1)
    return out
