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
    starts = effect.starts(None, SimpleNamespace(y=command[:, None], x=command[:, None]))
    assert min(abs(np.log(float(start[0]) / 3.0)) for start in starts) < 0.3


def test_a_limit_is_searched_for_where_it_acts_when_the_controller_winds_up() -> None:
    """Commands a hundred times the limit, as of an integrator, so that no size of them is near."""
    command = 100.0 * np.sin(T) + np.random.default_rng(0).normal(0.0, 0.5, len(T))
    needed = np.clip(100.0 * np.sin(T), -0.8, 0.8)
    scale = Scale((NAME,), ("N m",), (float(command.std()),), (1.0,), 0.0, 20.0, {})
    (effect,) = (e for e in actuator_effects(scale) if e.name == "torque_saturation")
    assert effect.starts is not None
    starts = effect.starts(None, SimpleNamespace(y=command[:, None], x=needed[:, None]))
    assert min(abs(np.log(float(start[0]) / 0.8)) for start in starts) < 0.05


def test_a_limit_explains_commands_that_are_read_with_noise() -> None:
    """What acts is unlike what is needed by the noise of the command alone."""
    needed = np.sin(T)
    command = needed + np.random.default_rng(0).normal(0.0, 0.45, len(T))
    assert not np.array_equal(behind("torque_saturation", 0.9, command, needed), needed)


def test_a_limit_does_not_explain_a_command_that_is_noise() -> None:
    """The last joint of a wrist needs nothing that can be read."""
    needed = 1e-5 * np.sin(T)
    command = needed + np.random.default_rng(0).normal(0.0, 2e-3, len(T))
    assert np.array_equal(behind("torque_saturation", 2e-5, command, needed), needed)
