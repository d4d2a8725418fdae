"""Blind cases of another generator: MuJoCo moves a body, and reads its own gyro and accelerometer on it.

A heavy body flies under smooth random forces and torques. A site at its origin is what a simulation believes: an ideal IMU. The
real one is another site: off the origin (a lever arm), turned (a mount rotation), on a small mass on springs and dampers (a
compliant mount), read late (a delay) or through a first-order filter. Nothing of our forward models takes part but the
filter's formula; MuJoCo integrates the rest. A mass on springs does a little more than the catalogue's resonance: it moves, so
that its lever arm does (0.01 of 0.15 m/s² at 14 Hz).

Used by `diagnose.py --mujoco`; on its own, one case of each kind: `python tests/bench/mujoco_cases.py DIR`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.random import Generator, default_rng
from scipy.interpolate import make_interp_spline

from imutool.blind_cases import case_log, catalogue, write_case
from imutool.blind_cases.detectability import achievable_rms, location
from imutool.blind_cases.envelope import ConcealedEffect, ConcealedTruth, TrueParameter
from imutool.blind_cases.scene import POSE_RATE_HZ, RATE_HZ, SIM_SHARE, stamps_ns
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Scalars

STEP_S = 0.5e-3
EVERY = round(1.0 / RATE_HZ / STEP_S)
SETTLE_S = 3.0
MASS, INERTIA, SMALL_MASS = 1e5, 1e5, 1e-4  # kg, kg m²: what sits on the springs must not move the body
NOISE = np.array([2e-3] * 3 + [0.02] * 3)  # rad/s, m/s²: a sample's
KINDS = ("null", "lever_arm", "mount_rotation", "mount_resonance", "clock_offset", "low_pass", "lever_arm+clock_offset")
RINGING = ("mount_rings", "lever_arm+mount_rings")  # by name alone: a mount that shocks excite, faster than the samples
SHOCK_M_S2, SHOCK_S, EVERY_S = 150.0, 2e-3, 3.0

Six = Float64[np.ndarray, "n 6"]


@dataclass(frozen=True)
class Mounted:
    """How the real sensor sits and is read; the defaults are the ideal one."""

    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    f0_hz: float = 0.0
    zeta: float = 0.0
    delay_s: float = 0.0
    shocked: bool = False
    cutoff_hz: float = 0.0


@dataclass(frozen=True, eq=False)
class Flown:
    """What MuJoCo gives, every half millisecond."""

    t_s: Float64[np.ndarray, " n"]
    p_wb: Float64[np.ndarray, "n 3"]
    q_wb_wxyz: Float64[np.ndarray, "n 4"]
    ideal: Six
    real: Six


def conceal_mujoco(folder: Path, *, seed: int, kind: str | None = None, duration_s: float = 60.0) -> None:
    """Writes a sealed case as `imutool conceal` does; `kind` is drawn, or one of `KINDS`."""
    rng = default_rng([seed, 4711])
    what = kind or KINDS[seed % len(KINDS)]
    mounted, effects = drawn(what, rng)
    flown = fly(mounted, duration_s, rng)
    first = round(SETTLE_S / STEP_S)
    ideal = flown.ideal[first::EVERY]
    real = _read(flown, mounted)[first::EVERY]
    bias = np.concatenate([0.03 * rng.standard_normal(3), 0.3 * rng.standard_normal(3)])
    poses_every = round(1.0 / POSE_RATE_HZ / STEP_S)
    p, q = flown.p_wb[first::poses_every], flown.q_wb_wxyz[first::poses_every]
    truth = Poses(stamps_ns(np.arange(len(p)) / POSE_RATE_HZ), np.ascontiguousarray(p), np.ascontiguousarray(q))
    channel_t = np.arange(int(duration_s * catalogue.RATE_HZ) + 1) / catalogue.RATE_HZ
    motion = ideal[np.minimum((channel_t * RATE_HZ).astype(int), len(ideal) - 1)]
    values = catalogue.channels(rng, channel_t, motion)
    scalars = {t: Scalars(stamps_ns(channel_t), values[t][:, None].copy(), unit) for t, unit in catalogue.TOPICS.items()}
    sim = _imu(ideal + SIM_SHARE * NOISE * rng.standard_normal(ideal.shape))
    noisy = _imu(real + bias + NOISE * rng.standard_normal(real.shape))
    sigma = NOISE * np.hypot(1.0, SIM_SHARE)
    case = ConcealedTruth(
        seed=seed,
        generator="mujoco",
        trajectory="mujoco",
        noise="mujoco",
        kind={0: "null", 1: "single", 2: "pair"}[len(effects)],
        size="middle",
        effects=tuple(effects),
        came_to={},
        bias={"gyro": tuple(bias[:3].tolist()), "accel": tuple(bias[3:].tolist())},
        noise_std={"real": tuple(NOISE.tolist()), "sim": tuple((SIM_SHARE * NOISE).tolist())},
        duration_s=duration_s,
        place=location(real - ideal, sigma),
        achievable=achievable_rms(real - ideal, sigma),
    )
    write_case(folder, case_log(sim, truth, scalars), case_log(noisy, truth, scalars), case)


def drawn(kind: str, rng: Generator) -> tuple[Mounted, list[ConcealedEffect]]:
    """A mount, and what it is in the catalogue's words."""
    settings: dict[str, Any] = {}
    effects = []
    for name in [] if kind == "null" else kind.split("+"):
        if name == "lever_arm":
            settings["lever_m"] = tuple(rng.uniform(0.03, 0.15, 3) * rng.choice([-1.0, 1.0], 3))
            effects.append(
                _effect(name, "accel", {f"{axis}": (v, "m") for axis, v in zip("xyz", settings["lever_m"], strict=True)})
            )
        elif name == "mount_rotation":
            settings["rotation_rad"] = tuple(rng.uniform(0.02, 0.08, 3) * rng.choice([-1.0, 1.0], 3))
            told = {axis: (v, "rad") for axis, v in zip("xyz", settings["rotation_rad"], strict=True)}
            effects.append(_effect(name, "both", told))
        elif name == "mount_resonance":
            settings |= {"f0_hz": rng.uniform(12.0, 18.0), "zeta": rng.uniform(0.05, 0.2)}
            told = {"f0": (settings["f0_hz"], "Hz"), "zeta": (settings["zeta"], "-")}
            effects.append(_effect(name, "accel", told | {f"share_{axis}": (1.0, "-") for axis in "xyz"}))
        elif name == "mount_rings":
            settings |= {"f0_hz": 18.1, "zeta": 0.06, "shocked": True}
            effects.append(_effect("mount_resonance", "accel", {"f0": (18.1, "Hz"), "zeta": (0.06, "-")}))
        elif name == "clock_offset":
            settings["delay_s"] = float(rng.integers(4, 40)) * STEP_S * 2.0
            effects.append(_effect(name, "both", {"tau": (-settings["delay_s"], "s")}))
        else:
            settings["cutoff_hz"] = rng.uniform(8.0, 25.0)
            effects.append(_effect("low_pass", "both", {"f_c": (settings["cutoff_hz"], "Hz")}))
    return Mounted(**settings), effects


def _effect(name: str, signal: str, values: dict[str, tuple[float, str]]) -> ConcealedEffect:
    parameters = {key: TrueParameter(float(v), unit, abs(float(v)), None, True) for key, (v, unit) in values.items()}
    return ConcealedEffect(name, signal, "", "", 1.0, parameters)


def fly(mounted: Mounted, duration_s: float, rng: Generator) -> Flown:
    """MuJoCo's own integration (Runge-Kutta 4) of a body under smooth random forces, held near where it began."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(_xml(mounted))
    data = mujoco.MjData(model)
    count = int((duration_s + SETTLE_S) / STEP_S) + 1
    push, twist = _halved(_smooth(rng, count, 2.0, 6.0)), _halved(_smooth(rng, count, 4.0, 1.5))
    if mounted.shocked:
        push = push + _shocks(rng, len(push))
    p, q, sensors = np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 12))

    def force(_model: Any, now: Any) -> None:
        """At the beginning, in the middle and at the end of a step."""
        k = round(2.0 * now.time / STEP_S)
        attitude = now.qpos[3:7] * (1.0 if now.qpos[3] >= 0.0 else -1.0)
        now.qfrc_applied[:3] = MASS * (push[k] + [0.0, 0.0, GRAVITY_M_S2] - 0.5 * now.qpos[:3] - 0.8 * now.qvel[:3])
        now.qfrc_applied[3:6] = INERTIA * (twist[k] - 30.0 * attitude[1:] - 4.0 * now.qvel[3:6])

    mujoco.set_mjcb_control(force)
    try:
        for k in range(count):
            p[k], q[k] = data.qpos[:3], data.qpos[3:7]
            mujoco.mj_step(model, data)  # sensors are those of the state it began with
            sensors[k] = data.sensordata
    finally:
        mujoco.set_mjcb_control(None)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return Flown(np.arange(count) * STEP_S, p, q, sensors[:, :6], sensors[:, 6:])


def _shocks(rng: Generator, count: int) -> Float64[np.ndarray, "n 3"]:
    """Half sines of two milliseconds in a random direction, every few seconds, by half steps."""
    width = round(2.0 * SHOCK_S / STEP_S)
    out, shape = np.zeros((count, 3)), np.sin(np.pi * np.arange(width) / width)
    at = np.cumsum(rng.exponential(EVERY_S, count)) * 2.0 / STEP_S
    for k in at[at < count - width].astype(int):
        direction = rng.standard_normal(3)
        out[k : k + width] += SHOCK_M_S2 * shape[:, None] * direction / np.linalg.norm(direction)
    return out


def _halved(curves: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
    """With the middles of steps between, and the end of the last."""
    at = np.arange(len(curves), dtype=np.float64)
    return np.asarray(make_interp_spline(at, curves, k=3)(np.arange(2 * len(curves) + 1) / 2.0))


def _smooth(rng: Generator, count: int, size: float, fastest_hz: float) -> Float64[np.ndarray, "n 3"]:
    """Random curves with next to nothing above `fastest_hz`."""
    spectrum = np.zeros((count // 2 + 1, 3), dtype=complex)
    f_hz = np.fft.rfftfreq(count, STEP_S)
    band = (f_hz > 0.02) & (f_hz < 3.0 * fastest_hz)
    fall = 1.0 / (1.0 + (f_hz[band] / (0.2 * fastest_hz)) ** 2)
    spectrum[band] = (rng.standard_normal((band.sum(), 3)) + 1j * rng.standard_normal((band.sum(), 3))) * fall[:, None]
    curves = np.fft.irfft(spectrum, count, axis=0)
    return np.asarray(size * curves / curves.std(axis=0))


def _xml(mounted: Mounted) -> str:
    """The model; where there are springs, the site is put higher by what gravity pulls it down: level, it is at its place."""
    rotation = np.array(mounted.rotation_rad)
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle else np.array([1.0, 0.0, 0.0])
    quat = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
    joints, sag = "", 0.0
    if mounted.f0_hz:
        w = 2.0 * np.pi * mounted.f0_hz
        k, c = SMALL_MASS * w * w, 2.0 * mounted.zeta * w * SMALL_MASS
        sag = GRAVITY_M_S2 / (w * w)
        joints = "".join(f'<joint type="slide" axis="{a}" stiffness="{k}" damping="{c}"/>' for a in ("1 0 0", "0 1 0", "0 0 1"))
    x, y, z = mounted.lever_m
    return f"""<mujoco>
  <option timestep="{STEP_S}" integrator="RK4" gravity="0 0 {-GRAVITY_M_S2}"><flag contact="disable"/></option>
  <worldbody><body name="carrier"><freejoint/>
    <inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
    <site name="ideal"/>
    <body name="sensor" pos="{x} {y} {z + sag}">{joints}
      <inertial pos="0 0 0" mass="{SMALL_MASS}" diaginertia="1e-9 1e-9 1e-9"/>
      <site name="real" quat="{" ".join(map(repr, quat.tolist()))}"/>
    </body></body></worldbody>
  <sensor>
    <gyro site="ideal"/><accelerometer site="ideal"/><gyro site="real"/><accelerometer site="real"/>
  </sensor></mujoco>"""


def _read(flown: Flown, mounted: Mounted) -> Six:
    """What the real sensor says: filtered (trapezoidal rule at half a millisecond), then late by whole steps."""
    out = flown.real
    if mounted.cutoff_hz:
        from scipy.signal import lfilter, lfilter_zi

        a = np.pi * mounted.cutoff_hz * STEP_S
        b, den = np.array([a, a]) / (1.0 + a), np.array([1.0, (a - 1.0) / (1.0 + a)])
        out = lfilter(b, den, out, axis=0, zi=lfilter_zi(b, den)[:, None] * out[:1])[0]
    return np.roll(out, round(mounted.delay_s / STEP_S), axis=0)  # what comes around lies in the time it settles


def _imu(signal: Six) -> Imu:
    t_ns = stamps_ns(np.arange(len(signal)) / RATE_HZ)
    return Imu(t_ns, np.ascontiguousarray(signal[:, :3]), np.ascontiguousarray(signal[:, 3:]))


def main() -> None:
    """One case of each kind."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for k, kind in enumerate((*KINDS, *RINGING)):
        conceal_mujoco(options.out / f"{k:04d}", seed=options.seed * len(KINDS) + k, kind=kind)


if __name__ == "__main__":
    main()
