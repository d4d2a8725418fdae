"""Robots from logs to names: an arm in MuJoCo, a vehicle on wheels, one in flight, each against a poorer simulation."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.robot_cases.cases import conceal_robot
from support.robot_cases.log import write

from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.result import Diagnosis
from imutool.diagnosis.signals.pairing import paired

Run = Callable[..., subprocess.CompletedProcess[str]]
SURE = 4.0  # standard deviations within which a planted value lies
JOINTS = "sensor_msgs/msg/JointState"


def within(d: Diagnosis, truth: Path) -> None:
    """Each planted effect is found on its column with its values, and no other."""
    planted = json.loads(truth.read_text())["effects"]
    assert {(f.effect, f.signal) for f in d.findings} == {(e["effect"], e["column"]) for e in planted}
    for effect in planted:
        (finding,) = (f for f in d.findings if (f.effect, f.signal) == (effect["effect"], effect["column"]))
        for name, value in effect["parameters"].items():
            estimate = finding.parameters[name]
            assert abs(estimate.value - value) < SURE * estimate.std, (name, value, estimate)


CASES = (
    ("wheels", "single", "wheel_radius"),
    ("flight", "single", "hard_iron"),
    ("flight", "single", "low_pass"),
    ("flight", "single", "gnss_lever_arm"),
    ("flight", "none", ""),
)


@pytest.mark.parametrize(("robot", "kind", "effect"), CASES)
def test_a_vehicle_lacks_what_was_planted_and_nothing_else(robot: str, kind: str, effect: str, tmp_path: Path) -> None:
    conceal_robot(tmp_path, 11, robot, kind, effect)
    within(diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap"), tmp_path / "truth.json")


def test_a_pressure_that_is_mostly_its_own_physics_is_aligned_as_the_other_signals_are(tmp_path: Path) -> None:
    conceal_robot(tmp_path, 79, "flight", "single", "dynamic_pressure")
    within(diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap"), tmp_path / "truth.json")


def test_a_ripple_up_to_the_end_of_the_band_leaves_spectrum_for_the_noise(tmp_path: Path) -> None:
    """27 waves a turn: the efforts' power reaches to where joints are compared."""
    conceal_robot(tmp_path, 12003, "arm", "single", "gear_ripple")
    (finding,) = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap").findings
    assert finding.effect == "gear_ripple"


def test_a_channel_that_drives_without_a_lag_gets_its_name_beside_a_slow_barometer(tmp_path: Path) -> None:
    """What the temperature adds to a pressure is `pressure_temperature`, no drive without a name and with a lag of nothing."""
    conceal_robot(tmp_path, 24032, "flight", "pair")
    within(diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap"), tmp_path / "truth.json")


def test_a_slow_barometer_is_slow_for_the_dynamic_pressure_too(tmp_path: Path) -> None:
    conceal_robot(tmp_path, 41068, "flight", "pair")  # both effects
    within(diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap"), tmp_path / "truth.json")


def test_an_arm_is_diagnosed_from_the_command_line_with_its_page(imutool: Run, tmp_path: Path) -> None:
    """A dry friction in MuJoCo: the command finds topics and fields by itself, and the page draws them.

    The joint rests for a fifth of the time, held by less than the friction's level.
    """
    conceal_robot(tmp_path, 12036, "arm", "single", "coulomb_friction")
    done = imutool("diagnose", tmp_path / "real.mcap", "--sim", tmp_path / "sim.mcap", "-o", tmp_path / "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "out" / "findings.json").read_text())
    (planted,) = json.loads((tmp_path / "truth.json").read_text())["effects"]
    (finding,) = found["findings"]
    assert (finding["effect"], finding["signal"]) == ("coulomb_friction", planted["column"])
    level = finding["parameters"]["level"]
    assert abs(level["value"] - planted["parameters"]["level"]) < SURE * level["std"] < 0.02 * level["value"]
    assert found["bias"] == {"gyro": None, "accel": None}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "lacks dry friction" in page
    assert "+nan" not in page


def test_physics_without_a_name_is_an_equation_of_the_right_form(tmp_path: Path) -> None:
    conceal_robot(tmp_path, 29, "arm", "unnamed", "velocity[0] |velocity[0]|")
    d = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap")
    (finding,) = d.findings
    assert (finding.effect, finding.variable) == ("unknown", "velocity[0] |velocity[0]|")
    assert finding.python == "def effort_0_added(velocity_0, c):\n    return c * velocity_0 * np.abs(velocity_0)"


def wave(t: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(np.sin(np.outer(t, rng.uniform(0.5, 4.0, 6)) + rng.uniform(0.0, 6.0, 6)).sum(axis=1))


def test_fields_are_paired_by_topic_message_and_joint_and_the_rest_is_left_out(tmp_path: Path) -> None:
    """Joints in another order, an angle that wraps, degrees, an enumeration, a constant, a topic of another name."""
    t = np.arange(2000) / 100.0
    a, b = wave(t, 1), 2.0 * wave(t, 2)
    turning = 0.9 * t
    mode, still = np.floor(t / 5.0), np.ones(len(t))
    numbers = "std_msgs/msg/Float64"
    both = {"/mode": (numbers, t, mode[:, None]), "/still": (numbers, t, still[:, None])}
    joints = np.stack([a, np.mod(turning, 2 * np.pi), *np.zeros((2, len(t))), *np.zeros((2, len(t)))], axis=1)
    swapped = np.stack([1.01 * turning, 1.1 * a, *np.zeros((2, len(t))), *np.zeros((2, len(t)))], axis=1)
    degrees = (numbers, t, np.degrees(b)[:, None])
    real = {**both, "/arm/joint_states": (JOINTS, t, joints), "/angle": degrees, "/copy": (numbers, t, a[:, None])}
    write(tmp_path / "real.mcap", real, ("hip", "knee"))
    radians, copy = (numbers, t, 1.001 * b[:, None]), (numbers, t[50:], a[50:, None])
    sim = {**both, "/joint_states": (JOINTS, t, swapped), "/angle": radians, "/copy": copy}
    write(tmp_path / "sim.mcap", sim, ("knee", "hip"))
    pairing = paired(tmp_path / "real.mcap", tmp_path / "sim.mcap")
    pairs = {pair.name: pair for pair in pairing.pairs}
    assert set(pairs) == {"/arm/joint_states.position[0]", "/arm/joint_states.position[1]", "/angle.data"}
    assert np.allclose(pairs["/arm/joint_states.position[0]"].sim[:, 0], 1.1 * a)
    assert np.allclose(pairs["/arm/joint_states.position[1]"].real[:, 0], turning)
    assert np.allclose(pairs["/angle.data"].real[:, 0], b)
    assert any("degrees" in remark for remark in pairing.remarks)
    assert any("The same in both logs" in remark and "/copy.data" in remark for remark in pairing.remarks)
