"""Terms of an equation: their Python computes what they add, and they bear the message's own names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.aligned_signal import AlignedSignal, aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.sparsest_equation import Term, channels, python, terms
from imutool.mcap_io.fields import Fields

T = np.arange(2000) / 100.0
STAMPS = np.round(1e9 * T).astype(np.int64)
EXACT = 1e-12  # the same operations in the same order


def wave(seed: int, derivative: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    w, phase = rng.uniform(0.5, 4.0, 6), rng.uniform(0.0, 6.0, 6)
    return np.asarray((w**derivative * np.sin(np.outer(T, w) + phase + 0.5 * np.pi * derivative)).sum(axis=1))


def number(name: str) -> AlignedSignal:
    """A single number beside other topics, one of which has the `x` of an unnamed channel in its name."""
    pair = SignalPair.of_fields(Fields(STAMPS, 1.1 * wave(1)), Fields(STAMPS, wave(1)), name)
    others = {"/motor/2d.x": Fields(STAMPS, 3.0 + wave(2)), "/odom.speed": Fields(STAMPS, wave(3))}
    return aligned(pair, others, DiagnoseSettings())


def arm(*indices: int) -> AlignedSignal:
    """Links that do not touch each other, at these places of the message: joints that stand still are left out."""

    def side(seed: int) -> tuple[dict[str, Fields], dict[str, Fields]]:
        efforts, state = dict[str, Fields](), dict[str, Fields]()
        for n, k in enumerate(indices):
            q, dq, ddq = (wave(seed + n, order) for order in range(3))
            efforts[f"effort[{k}]"] = Fields(STAMPS, (0.5 + 0.3 * n) * ddq + (2.0 - n) * np.sin(q))
            state |= {f"q{n}": Fields(STAMPS, q), f"dq{n}": Fields(STAMPS, dq)}
        return efforts, state

    (real, state), (sim, sim_state) = side(1), side(11)
    names, units = tuple(real), ("N m",) * len(indices)
    return aligned(SignalPair.of_columns("/j", names, "efforts", units, real, sim, state, sim_state), {}, DiagnoseSettings())


@pytest.mark.parametrize("make", [lambda: number("/odom.v"), lambda: arm(0, 12)], ids=["number", "arm"])
def test_the_python_of_each_term_is_what_it_adds(make: Callable[[], AlignedSignal]) -> None:
    """A channel of another topic stood in it under its topic's name, which Python cannot read."""
    signal = make()
    for k in range(signal.columns):
        by_name, seen = channels(signal.sampled, k), set[str]()
        for effect in terms(signal, k):
            assert isinstance(effect.forward, Term)
            defined: dict[str, object] = {"np": np}
            exec(python(effect, signal.names[k].rpartition(".")[2]), defined)
            (function,) = (value for name, value in defined.items() if name.endswith("_added"))
            theta = np.array([0.7, 0.3])[: len(effect.parameters)]
            computed = function(*(by_name[name] for name in effect.forward.names), *theta)  # type: ignore[operator]
            added = effect.forward(signal.sampled, theta).y - signal.sampled.y
            np.testing.assert_allclose(added[:, k], computed, rtol=EXACT, atol=EXACT * np.abs(signal.sampled.y).max())
            assert not np.delete(added, k, axis=1).any()
            seen.add(effect.variable)
        assert len(seen) > 20


def test_a_number_in_an_array_has_the_terms_of_any_other() -> None:
    """Its index was taken for that of a joint, so that it had none."""
    alone, in_array = ([effect.variable for effect in terms(number(name), 0)] for name in ("/odom.v", "/odom.data[0]"))
    assert in_array == alone
    assert {"x^3", "dx/dt^2", "x dx/dt", "x /odom.speed"} <= set(alone)


def test_terms_of_a_joint_are_of_its_own_motion_also_behind_a_joint_that_stands_still() -> None:
    """Those of the second moving joint were taken for the first one's, and a tenth one's speed for the second one's."""
    signal = arm(1, 12)
    for k, joint in enumerate((1, 12)):
        found = {effect.variable: effect.forward for effect in terms(signal, k)}
        assert {variable for variable in found if variable.endswith("^3")} == {f"position[{joint}]^3", f"velocity[{joint}]^3"}
        added = found[f"velocity[{joint}]^3"](signal.sampled, np.ones(1)).y[:, k] - signal.sampled.y[:, k]
        np.testing.assert_allclose(added, signal.sampled.state[f"dq{k}"] ** 3, rtol=1e-9, atol=1e-9)
    speeds = {name: values for name, (_, values) in signal.variables().items() if name.startswith("speed of joint")}
    assert list(speeds) == ["speed of joint 1", "speed of joint 12"]
    np.testing.assert_allclose(speeds["speed of joint 12"], np.abs(signal.sampled.state["dq1"]), rtol=0, atol=0)
