"""Ripple of a gear: where a search for it begins, whatever the number of turns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from imutool.sensor.robot_effects.joint_dynamics import Dynamics
from imutool.sensor.robot_effects.joint_transmission import effects, play, position_effects
from imutool.sensor.robot_effects.signal_samples import IdealSignal
from imutool.sensor.robot_effects.signal_sizes import Scale

RATE_HZ = 100.0
T = np.arange(6000) / RATE_HZ
PER_TURN, SINE = 31.0, 0.4


def at(angle: np.ndarray, real: np.ndarray) -> tuple[IdealSignal, SimpleNamespace]:
    """An ideal signal of zero effort at some angles, and the recording."""
    speed = np.gradient(angle, T)
    state = {"q0": angle, "dq0": speed, "ddq0": np.gradient(speed, T)}
    return IdealSignal(0.0, RATE_HZ, np.zeros((len(T), 1)), {}, state), SimpleNamespace(stamp_s=T, y=real[:, None])


@pytest.mark.parametrize("turns", [0.3, 3.0, 300.0, 30_000.0])
def test_a_ripple_is_searched_for_where_it_is(turns: float) -> None:
    """A wheel that turns ever on takes no more memory than a joint that turns to and fro."""
    angle = 2.0 * np.pi * turns * (T / T[-1] + 0.02 * np.sin(3.0 * T))
    (effect,) = (
        e for e in effects(Scale(("/x.effort[0]",), ("N m",), (1.0,), (1.0,), 0.0, 60.0, {})) if e.name == "gear_ripple"
    )
    assert effect.starts is not None
    sine, cosine, per_turn = effect.starts(*at(angle, SINE * np.sin(PER_TURN * angle)))[0]
    assert abs(per_turn - PER_TURN) < 0.5 / turns + 1e-3
    if turns < 10.0:  # of very many turns a part is looked at
        assert np.hypot(sine, cosine) > 0.5 * SINE


@pytest.mark.parametrize("gap", [0.002, 0.02, 0.2])
def test_a_play_is_searched_for_where_it_is(gap: float) -> None:
    """From a tenth of a degree on, whatever the angle that the joint turns through."""
    angle = 2.0 * np.sin(0.7 * T) + 0.5 * np.sin(2.3 * T)
    scale = Scale(("/x.position[0]",), ("rad",), (1.5,), (1.5,), 0.0, 60.0, {})
    (effect,) = (e for e in position_effects(scale) if e.name == "backlash")
    ideal = IdealSignal(0.0, RATE_HZ, angle[:, None], {})
    assert effect.starts is not None
    starts = effect.starts(ideal, SimpleNamespace(stamp_s=T, y=play(angle, gap)[:, None]))
    assert min(abs(np.log(float(start[0]) / gap)) for start in starts) < 0.5


@pytest.mark.parametrize("per_turn", [3.0, 4.0])
def test_a_ripple_of_a_few_waves_a_turn_is_searched_for_where_a_joint_turns_through_two(per_turn: float) -> None:
    angle = 2.1 * np.sin(0.7 * T)
    (effect,) = (
        e for e in effects(Scale(("/x.effort[0]",), ("N m",), (1.0,), (1.0,), 0.0, 60.0, {})) if e.name == "gear_ripple"
    )
    assert effect.starts is not None
    assert min(abs(start[2] - per_turn) for start in effect.starts(*at(angle, SINE * np.sin(per_turn * angle)))) < 0.7


def test_an_eccentric_disc_is_taken_out_of_angle_speed_and_acceleration_exactly() -> None:
    """A disc a tenth of a radian off its centre; the joint itself moves by a sine."""
    w, a, b = 1.3, 0.08, -0.06
    true = {"q0": 1.2 * np.sin(w * T), "dq0": 1.2 * w * np.cos(w * T), "ddq0": -1.2 * w**2 * np.sin(w * T)}
    sin, cos = np.sin(true["q0"]), np.cos(true["q0"])
    slope, bend = a * cos - b * sin, -a * sin - b * cos
    read = {
        "q0": true["q0"] + a * sin + b * cos,
        "dq0": true["dq0"] * (1.0 + slope),
        "ddq0": true["ddq0"] * (1.0 + slope) + bend * true["dq0"] ** 2,
    }
    chain = Dynamics(1, (1,), np.array([[1.0, 2.0, 0.5, 0.1, 0.2, 0.0, 0.0]]), (0.0,), (0,))
    steady = {"v0": true["dq0"]}
    scale = Scale(("/x.effort[0]",), ("N m",), (1.0,), (1.0,), 0.0, 60.0, {}, chain)
    (effect,) = (e for e in effects(scale) if e.name == "eccentricity")
    ideal = IdealSignal(0.0, RATE_HZ, chain({**read, **steady}), {}, {**read, **steady}, chain)
    found = effect.forward(ideal, np.array([a, b]))
    for name, values in true.items():
        assert np.abs(found.state[name] - values).max() < 3e-5 * np.abs(values).max()
    far = effect.forward(ideal, np.array([0.03, -1.5]))  # no disc is so far off its centre
    assert far is ideal
