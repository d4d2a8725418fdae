"""An independent engine agrees: MuJoCo's accelerometer and gyro on a moving body read what we say is felt along its poses."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from imutool.inertial.kinematics import fit_trajectory
from imutool.recording import Poses
from imutool.sensor.trajectory import smooth_motion

START_NS = 1_700_000_000_000_000_000
STEP_S, EACH, DURATION_S = 1e-4, 20, 8.0  # integrated at 10 kHz, recorded at 500 Hz
WORLD = f"""
<mujoco>
  <option timestep="{STEP_S}" integrator="RK4" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body pos="0 0 1">
      <joint type="hinge" axis="0 1 0" damping="0.02"/>
      <joint name="motor" type="hinge" axis="0 0 1" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" density="800"/>
      <body pos="0.4 0 0">
        <joint type="hinge" axis="1 0 0.3" damping="0.02"/>
        <geom type="box" size="0.1 0.05 0.02" pos="0.1 0 0" density="600"/>
        <site name="arm" pos="0.15 0.03 0.02" quat="0.9 0.3 0.2 0.1"/>
      </body>
    </body>
    <body pos="2 0 1">
      <freejoint/>
      <geom type="ellipsoid" size="0.1 0.06 0.03" density="700"/>
      <site name="free" pos="0.05 -0.04 0.02" quat="0.7 -0.1 0.5 0.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="motor" gear="0.6"/></actuator>
  <sensor>
    <accelerometer site="arm"/><gyro site="arm"/>
    <accelerometer site="free"/><gyro site="free"/>
  </sensor>
</mujoco>
"""
# What its integration leaves at this step h. The motor's torque is held over a step: 5e-8 rad/s (as h²) and 4e-4 m/s² (as h) on
# the arm. The free body has no motor: its force agrees to 1e-7, its rate to 3e-8 (as h²) in MuJoCo 3.17 and to 4e-13 in 4.0 at
# any step. Measured at 0.1 and 0.5 ms, in both versions.
GYRO, ACCEL = 2e-7, {"arm": 1e-3, "free": 3e-7}
# Smoothed as if the poses were noisy: root mean square, and the largest, which is where smoothing begins.
SMOOTH_GYRO, SMOOTH_ACCEL, WORST_GYRO, WORST_ACCEL = 3e-7, 4e-4, 2e-5, 2e-3


class Run(NamedTuple):
    poses: Poses
    gyro: np.ndarray
    accel: np.ndarray


@pytest.fixture(scope="module")
def runs() -> dict[str, Run]:
    """A swinging, driven double arm with damping, and a tumbling body in free fall, each with a sensor off its centre."""
    model = mujoco.MjModel.from_xml_string(WORLD)
    state = mujoco.MjData(model)
    state.qvel[:3] = 1.0, 2.0, 3.0
    state.qvel[3:] = 0.5, -0.3, 2.0, 2.0, -3.0, 4.0
    names = ("arm", "free")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    t_ns = []
    for k in range(int(DURATION_S / STEP_S)):
        state.ctrl[0] = np.sin(2.0 * np.pi * 0.7 * state.time)
        mujoco.mj_forward(model, state)  # sensors at this instant: mj_step leaves those of the one before
        if k % EACH == 0:
            t_ns.append(START_NS + round(state.time * 1e9))
            for site, name in enumerate(names):
                q_wb = np.zeros(4)
                mujoco.mju_mat2Quat(q_wb, state.site_xmat[site])
                rows[name].append(np.concatenate([state.site_xpos[site], q_wb, state.sensordata[6 * site : 6 * site + 6]]))
        mujoco.mj_step(model, state)
    found = {}
    for name in names:
        table = np.array(rows[name])
        poses = Poses(np.array(t_ns), np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3:7]))
        found[name] = Run(poses, table[:, 10:13], table[:, 7:10])
    return found


@pytest.mark.parametrize("name", ["arm", "free"])
def test_the_motion_is_worth_it(runs: dict[str, Run], name: str) -> None:
    assert (runs[name].gyro.std(axis=0) > 0.5).all()
    assert np.abs(np.linalg.norm(runs[name].accel, axis=1) - 9.81).max() > 2.0


@pytest.mark.parametrize("name", ["arm", "free"])
def test_kinematics_reads_what_its_sensors_read(runs: dict[str, Run], name: str) -> None:
    run = runs[name]
    inner = slice(50, -50)  # a spline through points rings at its ends
    motion = fit_trajectory(run.poses).at(run.poses.t_ns[inner])
    np.testing.assert_allclose(motion.omega_b, run.gyro[inner], rtol=0, atol=GYRO)
    np.testing.assert_allclose(motion.specific_force(), run.accel[inner], rtol=0, atol=ACCEL[name])


@pytest.mark.parametrize("name", ["arm", "free"])
def test_a_smoothed_motion_feels_what_its_sensors_read(runs: dict[str, Run], name: str) -> None:
    run = runs[name]
    motion = smooth_motion(run.poses)
    (felt,) = motion.ideal_motions(1.0 / (STEP_S * EACH))
    rows = np.round(felt.t_s / (STEP_S * EACH)).astype(int)
    for ours, theirs, usual, worst in (
        (felt.gyro, run.gyro[rows], SMOOTH_GYRO, WORST_GYRO),
        (felt.accel, run.accel[rows], SMOOTH_ACCEL, WORST_ACCEL),
    ):
        assert float(np.sqrt(np.mean((ours - theirs) ** 2))) < usual
        assert float(np.abs(ours - theirs).max()) < worst
