"""An actuator's limit and dead band, and the commands that they cannot explain."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from imutool.sensor.robot_effects.joint_actuator_and_load import actuator_effects
from imutool.sensor.robot_effects.signal_samples import SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale

T = np.arange(2000) / 100.0
NAME = "/x.effort[0]"


def behind(name: str, edge: float, command: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The commands that an actuator with a limit or a dead band would be given."""
    (effect,) = (e for e in actuator_effects(Scale((NAME,), ("N m",), (0.5,), (1.0,), 0.0, 20.0, {})) if e.name == name)
    y = needed[:, None]
    samples = SignalSamples(T, y, y, np.gradient(y, T, axis=0), {}, {NAME: (T, command)})
    return np.asarray(effect.forward(samples, np.array([edge])).y[:, 0])


@pytest.mark.parametrize(("name", "edge"), [("actuator_dead_band", 0.5), ("torque_saturation", 0.01)])
def test_a_command_does_not_explain_itself_where_friction_is_larger_than_what_a_motion_needs(name: str, edge: float) -> None:
    needed = 0.05 * np.sin(T)
    assert np.array_equal(behind(name, edge, needed + 0.5 * np.sign(np.cos(0.7 * T)), needed), needed)


def test_a_limit_and_a_dead_band_give_their_commands() -> None:
    command = np.sin(T)
    assert np.allclose(behind("torque_saturation", 0.8, command, np.clip(command, -0.8, 0.8)), command)
    assert np.allclose(behind("actuator_dead_band", 0.1, command, command - np.clip(command, -0.1, 0.1)), command)


def test_a_limit_that_a_motion_passes_for_a_moment_is_searched_for_near_it() -> None:
    """Twice in a minute the command is thrice its own deviation."""
    command = np.sin(T) + 4.0 * np.exp(-(((T - 7.0) / 0.1) ** 2)) + 4.0 * np.exp(-(((T - 15.0) / 0.1) ** 2))
    scale = Scale((NAME,), ("N m",), (0.5,), (1.0,), 0.0, 20.0, {})
    (effect,) = (e for e in actuator_effects(scale) if e.name == "torque_saturation")
    assert effect.starts is not None
    starts = effect.starts(None, SimpleNamespace(y=command[:, None]))
    assert min(abs(np.log(float(start[0]) / 3.0)) for start in starts) < 0.3
