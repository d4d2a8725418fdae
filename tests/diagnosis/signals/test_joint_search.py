"""How far the efforts of an arm are searched, and its units, on two joints in closed form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.result import Estimate
from imutool.diagnosis.settings import DiagnoseSettings, SearchSettings
from imutool.diagnosis.signals import signal_diagnosis
from imutool.diagnosis.signals.aligned_signal import aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair, band_hz
from imutool.diagnosis.signals.noise import LEARNT_ERROR, SMALL_GAIN, learnt_errors, whitened
from imutool.diagnosis.signals.quantities import continuous, in_radians
from imutool.diagnosis.signals.signal_constants import as_torques
from imutool.diagnosis.signals.signal_diagnosis import diagnose_signal
from imutool.errors import DataError
from imutool.mcap_io.fields import Fields

JOINTS, RATE_HZ, DURATION_S = 2, 100.0, 30.0
SURE = 4.0  # standard deviations within which a planted value lies
LENGTH, MASSES, G, DAMPING = 0.4, (2.0, 1.0), 9.81, 0.3


def efforts(q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, load: float = 0.0) -> np.ndarray:
    """Two links in a vertical plane with their masses at the ends (Craig, Introduction to Robotics, eq. 6.58)."""
    (m1, m2), c, s = (MASSES[0], MASSES[1] + load), np.cos(q[1]), np.sin(q[1])
    square, both = LENGTH**2, np.cos(q[0] + q[1])
    second = m2 * square * (ddq[0] * (1.0 + c) + ddq[1] + s * dq[0] ** 2) + m2 * LENGTH * G * both
    first = m2 * square * (ddq.sum(0) + c * (2.0 * ddq[0] + ddq[1]) - s * (dq[1] ** 2 + 2.0 * dq[0] * dq[1]))
    first += (m1 + m2) * square * ddq[0] + m2 * LENGTH * G * both + (m1 + m2) * LENGTH * G * np.cos(q[0])
    return np.stack([first, second], axis=1) + DAMPING * dq.T


def moved(
    seed: int, *, unit: float = 1.0, friction: float = 0.0, load: float = 0.0
) -> tuple[np.ndarray, dict[str, Fields], np.ndarray]:
    """Stamps, state and efforts, with angles in radians over `unit`."""
    rng, t = np.random.default_rng(seed), np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    w, phase = 2.0 * np.pi * rng.uniform(0.05, 0.8, (JOINTS, 5)), rng.uniform(0.0, 6.0, (JOINTS, 5, 1))
    waves = (((w**n)[:, :, None] * np.sin(w[:, :, None] * t + phase + 0.5 * np.pi * n)).sum(1) / 4.0 for n in range(3))
    q, dq, ddq = waves
    tau = efforts(q, dq, ddq, load) + friction * np.tanh(dq.T / 0.005)
    dq = dq + 5e-4 * rng.normal(size=dq.shape)
    t_ns, state = np.round(1e18 + t * 1e9).astype(np.int64), dict[str, Fields]()
    for k in range(JOINTS):
        state |= {f"q{k}": Fields(t_ns, q[k] / unit), f"dq{k}": Fields(t_ns, dq[k] / unit)}
    return t_ns, state, tau + 0.02 * rng.normal(size=tau.shape)


def pair(units: tuple[float, float] = (1.0, 1.0), friction: float = 0.0, load: float = 0.0) -> SignalPair:
    real_ns, state, real = moved(1, unit=units[0], friction=friction, load=load)
    sim_ns, sim_state, sim = moved(2, unit=units[1])
    names = tuple(f"/joints.effort[{k}]" for k in range(JOINTS))
    return SignalPair("/joints", names, ("N m",) * JOINTS, real_ns, real, sim_ns, sim, "efforts", state, sim_state)


def pendulum(seed: int, friction: float) -> tuple[np.ndarray, dict[str, Fields], np.ndarray]:
    """The second joint alone, as if the first stood level."""
    t_ns, state, _ = moved(seed)
    q, dq = state["q1"].values, state["dq1"].values
    ddq = np.gradient(dq, 1.0 / RATE_HZ)
    tau = MASSES[1] * LENGTH**2 * ddq + MASSES[1] * LENGTH * G * np.cos(q) + friction * np.tanh(dq / 0.005)
    return t_ns, {"q0": state["q1"], "dq0": state["dq1"]}, tau[:, None]


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
    settings = DiagnoseSettings(search=SearchSettings(max_effects=3))
    with pytest.raises(EnoughError):
        signal_diagnosis.diagnose_signal(pair(), {}, settings)
    (search,) = asked
    assert search.max_effects == usual.effects_each_column * JOINTS == 4
    assert search.negligible_share == SMALL_GAIN == 0.003


def test_friction_may_be_more_than_all_that_the_simulation_needs() -> None:
    scale = aligned(pair(friction=20.0), {}, DiagnoseSettings()).scale
    assert min(scale.size) > 10.0


CONSTANTS = np.array([0.06, 4.0])  # N m/A


def found(given: SignalPair) -> dict[tuple[str, str], dict[str, Estimate]]:
    """Parameters by effect and column, or topic."""
    return {(f.effect, f.signal.removeprefix("/joints.")): dict(f.parameters) for f in diagnose_signal(given, {}).findings}


def test_efforts_in_amperes_get_a_gain_of_each_joint_and_leave_a_friction_its_name() -> None:
    """The friction is a two hundredth of the misfit that the amperes make."""
    torques = pair(friction=0.4)
    effects = found(replace(torques, real=torques.real / CONSTANTS))
    gains = {("actuator_gain", f"effort[{k}]") for k in range(JOINTS)}
    assert set(effects) == gains | {("coulomb_friction", f"effort[{k}]") for k in range(JOINTS)}
    for (effect, column), parameters in effects.items():
        (estimate,) = parameters.values()
        wanted = CONSTANTS[int(column[-2])] if effect == "actuator_gain" else 0.4
        assert abs(estimate.value - wanted) < SURE * estimate.std < 0.02 * wanted


def test_currents_become_torques_in_steps_with_the_commands_that_a_limit_is_of() -> None:
    signal = aligned(pair(), {}, DiagnoseSettings())
    once = as_torques(as_torques(signal, np.array([2.0, 3.0])), np.array([1.1, 0.9]))
    assert np.allclose(once.constants, (2.2, 2.7))
    assert np.allclose(once.real, signal.real * (2.2, 2.7))
    for name, constant in zip(signal.names, once.constants, strict=True):
        assert np.allclose(once.ideal.channels[name][1], constant * signal.ideal.channels[name][1])


def test_a_gain_is_as_unsure_as_the_dynamics_and_less_sure_beside_a_load() -> None:
    signal = aligned(pair(), {}, DiagnoseSettings())
    by_key = {effect.key: effect for effect in signal_diagnosis.catalogue(signal)}
    gain, load = by_key["actuator_gain:/joints.effort[1]"], by_key["payload"]
    log = whitened(signal, signal.real - signal.sampled.x, [0.0] * JOINTS)
    alone = learnt_errors(log, fit([log], ((gain, np.ones(1)),)))[gain.key][0]
    assert 0.5 * LEARNT_ERROR < alone < 1.5 * LEARNT_ERROR  # of two parts that move together
    both = learnt_errors(log, fit([log], ((gain, np.ones(1)), (load, np.array([0.3, 0.3, 0.0])))))[gain.key][0]
    assert both > alone


def test_a_shape_that_no_form_has_is_a_curve_without_parameters() -> None:
    given = pair()
    angle = given.state["q1"].values
    steps = 1.5 * np.tanh((angle - 0.3) / 0.08) - 1.1 * np.tanh((angle + 0.5) / 0.05) + 0.9 * np.tanh((angle - 0.9) / 0.1)
    findings = diagnose_signal(replace(given, real=given.real + np.stack([0.0 * steps, steps], axis=1)), {}).findings
    assert any(finding.curve is not None and not finding.parameters for finding in findings)


def test_a_heavy_load_is_no_current() -> None:
    """The load makes the efforts of the last joint three times as large."""
    given = pair(load=2.0)
    effects = found(given)
    assert set(effects) == {("payload", "/joints")}
    mass = effects["payload", "/joints"]["mass"]
    assert abs(mass.value - 2.0) < SURE * mass.std < 0.1


def test_a_dead_band_that_acts_only_next_to_a_load_is_found() -> None:
    """Without the load the needed effort is unlike the command, so that a dead band of any width does nothing."""
    given = pair(load=1.0)
    effects = found(replace(given, real=given.real + np.sign(given.real) * [0.0, 1.5]))
    assert set(effects) == {("payload", "/joints"), ("actuator_dead_band", "effort[1]")}
    width = effects["actuator_dead_band", "effort[1]"]["width"]
    assert abs(width.value - 1.5) < SURE * width.std < 0.1


def test_friction_of_a_single_joint_has_a_name() -> None:
    """A pendulum, whose findings name no joint among several."""
    (real_ns, state, real), (sim_ns, sim_state, sim) = (pendulum(seed, friction) for seed, friction in ((1, 0.5), (2, 0.0)))
    alone = SignalPair("/joint", ("/joint.effort[0]",), ("N m",), real_ns, real, sim_ns, sim, "efforts", state, sim_state)
    effects = found(alone)
    ((_, level),) = ((name, parameters["level"]) for name, parameters in effects.items())
    assert next(iter(effects))[0] == "coulomb_friction"
    assert abs(level.value - 0.5) < SURE * level.std


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


@pytest.mark.parametrize("log", ["recording", "simulation"])
def test_an_arm_whose_velocity_is_no_rate_of_its_position_is_refused(log: str) -> None:
    """A motor turns on at a velocity of its own, as that of a slipping joint does: no dynamics join the two."""
    given, part = pair(), "state" if log == "recording" else "sim_state"
    state = dict(getattr(given, part))
    state["dq1"] = replace(state["dq1"], values=state["dq1"].values - 80.0)
    with pytest.raises(DataError, match=rf"effort\[1\] is not the rate of the position in the {log}"):
        aligned(replace(given, **{part: state}), {}, DiagnoseSettings())


def test_a_hole_in_a_log_is_no_contradiction_of_position_and_velocity() -> None:
    given = pair()
    kept = np.ones(len(given.real_ns), bool)
    kept[len(kept) // 3 : len(kept) // 2] = False
    state = {name: Fields(own.t_ns[kept], own.values[kept]) for name, own in given.state.items()}
    with_hole = replace(given, state=state, real_ns=given.real_ns[kept], real=given.real[kept])
    assert aligned(with_hole, {}, DiagnoseSettings()).columns == aligned(given, {}, DiagnoseSettings()).columns


def test_a_velocity_that_is_late_and_filtered_is_the_rate_of_its_position() -> None:
    given = pair()
    late = {
        name: replace(own, values=np.interp(np.arange(len(own)) - 5.0, np.arange(len(own)), own.values))
        if name.startswith("dq")
        else own
        for name, own in given.state.items()
    }
    assert aligned(replace(given, state=late), {}, DiagnoseSettings()).columns == JOINTS


def test_angles_that_wrap_are_continuous_and_others_stay() -> None:
    turning = 0.05 * np.arange(400)
    assert np.allclose(continuous(np.mod(turning, 2.0 * np.pi)), turning)
    assert continuous(turning) is turning


def oscillating(f_hz: float, size: float) -> SignalPair:
    """The arm whose recorded motion oscillates, at efforts that fit it."""
    given, state = pair(), dict[str, Fields]()
    w, t = 2.0 * np.pi * f_hz, np.arange(len(given.real_ns)) / RATE_HZ
    for name, own in given.state.items():
        wave = np.sin(w * t) if name.startswith("q") else w * np.cos(w * t)
        state[name] = replace(own, values=own.values + size * wave)
    return replace(given, state=state)


def test_a_motion_is_compared_as_far_as_it_goes_where_samples_can_be_differentiated() -> None:
    settings, fast = DiagnoseSettings().signal, oscillating(19.0, 0.1).state
    assert band_hz(pair().state, 200.0, settings) == settings.motion_band_hz
    assert band_hz(fast, 2.0 * RATE_HZ, settings) == settings.motion_band_share * 2.0 * RATE_HZ


def test_an_arm_that_oscillates_too_fast_for_its_samples_is_refused() -> None:
    with pytest.raises(DataError, match="faster than 15 Hz, as where a controller oscillates"):
        aligned(oscillating(30.0, 0.1), {}, DiagnoseSettings())
    assert aligned(oscillating(30.0, 1e-4), {}, DiagnoseSettings()).columns == JOINTS


def test_efforts_that_oscillate_and_act_late_are_no_currents() -> None:
    """A delay of a quarter of a period: commands are unlike what the motion needs, and no gain of theirs is."""
    given, late_s = pair(), 0.028
    t, w = np.arange(len(given.real_ns)) / RATE_HZ, 2.0 * np.pi * 9.0
    q, dq, ddq = (0.3 * w**n * np.sin(w * t + 0.5 * np.pi * n) for n in range(3))
    both = np.stack([q, -0.7 * q]), np.stack([dq, -0.7 * dq]), np.stack([ddq, -0.7 * ddq])
    state = {
        f"{kind}{k}": Fields(given.real_ns, values[k]) for kind, values in zip(("q", "dq"), both, strict=False) for k in (0, 1)
    }
    tau = efforts(*both)
    ahead = np.stack([np.interp(t + late_s, t, column) for column in tau.T], axis=1)
    found_effects = found(replace(given, state=state, real=ahead))
    assert list(found_effects) == [("actuator_delay", "/joints")]
    assert abs(found_effects["actuator_delay", "/joints"]["delay"].value - late_s) < 0.003


def stuck(seed: int, coulomb: float, stribeck: float, slow: float) -> tuple[np.ndarray, dict[str, Fields], np.ndarray]:
    """A pendulum that sticks where it turns round: dry friction takes a part of its impulse, or all of it."""
    rng, h, each = np.random.default_rng(seed), 0.001, round(1000.0 / RATE_HZ)
    w, phase = 2.0 * np.pi * rng.uniform(0.05, 0.5, 5), rng.uniform(0.0, 6.0, 5)
    inertia, weight = MASSES[1] * LENGTH**2, MASSES[1] * LENGTH * G
    t = h * np.arange(round(DURATION_S / h))
    wanted, speed, rate = ((w**n * np.sin(np.outer(t, w) + phase + 0.5 * np.pi * n)).sum(axis=1) / 3.0 for n in range(3))
    q, v, rows = float(wanted[0]), float(speed[0]), []
    for k in range(len(t)):
        tau = inertia * (rate[k] + 300.0 * (wanted[k] - q) + 30.0 * (speed[k] - v)) + weight * np.cos(q)
        if k % each == 0:
            rows.append((q, v, tau))
        free = v + h * (tau - weight * np.cos(q)) / inertia
        level = h * (coulomb + stribeck * np.exp(-((v / slow) ** 2))) / inertia
        v = float(np.sign(free) * max(abs(free) - level, 0.0))
        q += h * v
    (q_, v_, tau_), t_ns = np.array(rows).T, np.round(1e18 + t[::each] * 1e9).astype(np.int64)
    noisy = [values + size * rng.normal(size=len(values)) for values, size in ((v_, 5e-4), (tau_, 0.004))]
    return t_ns, {"q0": Fields(t_ns, q_), "dq0": Fields(t_ns, noisy[0])}, noisy[1][:, None]


def test_what_a_joint_that_sticks_leaves_is_no_delay() -> None:
    """The effort runs from one level to the other while the joint rests, as if it acted late."""
    (real_ns, state, real), (sim_ns, sim_state, sim) = stuck(1, 1.0, 0.8, 0.1), stuck(2, 0.0, 0.0, 0.1)
    names, units = ("/joints.effort[0]",), ("N m",)
    effects = found(SignalPair("/joints", names, units, real_ns, real, sim_ns, sim, "efforts", state, sim_state))
    assert {name for name, _ in effects} == {"coulomb_friction", "stribeck_friction"}
    levels = {name: parameters["level"].value for (name, _), parameters in effects.items()}
    assert levels == {"coulomb_friction": pytest.approx(1.0, abs=0.02), "stribeck_friction": pytest.approx(0.8, abs=0.05)}
