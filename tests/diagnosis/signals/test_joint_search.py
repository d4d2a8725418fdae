"""How far the efforts of an arm are searched, and its units, on two joints in closed form."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from imutool.diagnosis.settings import DiagnoseSettings, SearchSettings
from imutool.diagnosis.signals import signal_diagnosis
from imutool.diagnosis.signals.aligned_signal import aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.noise import SMALL_GAIN
from imutool.diagnosis.signals.quantities import in_radians
from imutool.mcap_io.fields import Fields

JOINTS, RATE_HZ, DURATION_S = 2, 100.0, 30.0
LENGTH, MASSES, G, DAMPING = 0.4, (2.0, 1.0), 9.81, 0.3


def efforts(q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Two links in a vertical plane with their masses at the ends (Craig, Introduction to Robotics, eq. 6.58)."""
    (m1, m2), c, s = MASSES, np.cos(q[1]), np.sin(q[1])
    square, both = LENGTH**2, np.cos(q[0] + q[1])
    second = m2 * square * (ddq[0] * (1.0 + c) + ddq[1] + s * dq[0] ** 2) + m2 * LENGTH * G * both
    first = m2 * square * (ddq.sum(0) + c * (2.0 * ddq[0] + ddq[1]) - s * (dq[1] ** 2 + 2.0 * dq[0] * dq[1]))
    first += (m1 + m2) * square * ddq[0] + m2 * LENGTH * G * both + (m1 + m2) * LENGTH * G * np.cos(q[0])
    return np.stack([first, second], axis=1) + DAMPING * dq.T


def moved(seed: int, *, unit: float = 1.0, friction: float = 0.0) -> tuple[np.ndarray, dict[str, Fields], np.ndarray]:
    """Stamps, state and efforts, with angles in radians over `unit`."""
    rng, t = np.random.default_rng(seed), np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    w, phase = 2.0 * np.pi * rng.uniform(0.05, 0.8, (JOINTS, 5)), rng.uniform(0.0, 6.0, (JOINTS, 5, 1))
    waves = (((w**n)[:, :, None] * np.sin(w[:, :, None] * t + phase + 0.5 * np.pi * n)).sum(1) / 4.0 for n in range(3))
    q, dq, ddq = waves
    tau = efforts(q, dq, ddq) + friction * np.tanh(dq.T / 0.005)
    dq = dq + 5e-4 * rng.normal(size=dq.shape)
    t_ns, state = np.round(1e18 + t * 1e9).astype(np.int64), dict[str, Fields]()
    for k in range(JOINTS):
        state |= {f"q{k}": Fields(t_ns, q[k] / unit), f"dq{k}": Fields(t_ns, dq[k] / unit)}
    return t_ns, state, tau + 0.02 * rng.normal(size=tau.shape)


def pair(units: tuple[float, float] = (1.0, 1.0), friction: float = 0.0) -> SignalPair:
    (real_ns, state, real), (sim_ns, sim_state, sim) = moved(1, unit=units[0], friction=friction), moved(2, unit=units[1])
    names = tuple(f"/joints.effort[{k}]" for k in range(JOINTS))
    return SignalPair("/joints", names, ("N m",) * JOINTS, real_ns, real, sim_ns, sim, "efforts", state, sim_state)


def test_an_arm_is_searched_for_two_effects_a_joint_and_not_beyond_the_error_of_its_dynamics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = list[SearchSettings]()

    class EnoughError(Exception):
        pass

    def select(logs, *_: object, **__: object) -> None:
        asked.append(logs[0].pair.settings.search)
        raise EnoughError

    monkeypatch.setattr(signal_diagnosis, "select_effects", select)
    usual = SearchSettings()
    settings = DiagnoseSettings(search=SearchSettings(most_effects=3))
    with pytest.raises(EnoughError):
        signal_diagnosis.diagnose_signal(pair(), {}, settings)
    (search,) = asked
    assert search.most_effects == usual.effects_each_column * JOINTS == 4
    assert search.negligible_share == SMALL_GAIN == 0.003


def test_friction_may_be_more_than_all_that_the_simulation_needs() -> None:
    scale = aligned(pair(friction=20.0), {}, DiagnoseSettings()).scale()
    assert min(scale.size) > 10.0


@pytest.mark.parametrize("units", [(1.0, 1.0), (np.pi / 180.0, 1.0), (1.0, np.pi / 180.0), (np.pi / 180.0, np.pi / 180.0)])
def test_angles_of_an_arm_in_degrees_are_converted(units: tuple[float, float]) -> None:
    given, expected = pair(units), pair()
    changed, remark = in_radians(given)

    def same(one: Mapping[str, Fields], other: Mapping[str, Fields]) -> bool:
        return all(np.allclose(one[name].values, other[name].values) for name in other)

    assert same(changed.state, expected.state)
    assert same(changed.sim_state, expected.sim_state)
    assert ("recording" in remark, "simulation" in remark) == (units[0] != 1.0, units[1] != 1.0)


def test_joints_that_turn_on_are_no_degrees() -> None:
    """Wheels with efforts, whose angles grow beyond any arm's."""
    given = pair()
    turning = {
        name: Fields(own.t_ns, own.values + 5.0 * np.arange(len(own)) / RATE_HZ * name.startswith("q"))
        for name, own in given.sim_state.items()
    }
    both = SignalPair(**{**vars(given), "state": turning, "sim_state": turning})
    changed, remark = in_radians(both)
    assert changed is both
    assert not remark


def test_angles_of_motors_before_their_gears_are_no_degrees() -> None:
    given = pair((1.0 / 80.0, 1.0 / 80.0))
    changed, remark = in_radians(given)
    assert changed is given
    assert not remark
