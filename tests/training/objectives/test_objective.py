"""The errors that train a model are those of a known motion with a known bias."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from imutool.bias.networks import static
from imutool.bias.networks.network import Segment
from imutool.recording import Recording
from imutool.training.objectives.objective import AdamW, error, motion_error, orientation_error
from imutool.training.training_windows import Pool, Windows

N, PERIOD_S = 100, 0.005
# Exact samples and poses: the rule's second order over half a second, here of at most 6 rad/s² and 30 m/s³.
RULE = {"gyro": 1e-4, "accel": 1e-3}


def windows(perfect: Callable[..., Recording], rest: list[float]) -> Windows:
    pool = Pool.of([perfect(1, duration_s=8.0, still_s=0.5)])
    first = pool.starts(N, "train", hop=37)
    return pool.windows(first, N, torch.tensor(rest, dtype=torch.float64).expand(len(first), 6))


def test_steps_are_those_of_pytorchs_class_without_the_import_of_its_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    def weights() -> list[torch.Tensor]:
        return [torch.linspace(-1.0, 1.0, size, dtype=torch.float64).requires_grad_() for size in (7, 3, 2)]

    def descend(some: list[torch.Tensor], step: Callable[[float], None]) -> None:
        for k in range(5):
            for weight in some[:2]:  # the last has no gradient, and must not decay
                weight.grad = weight.detach().exp() * (-1.0) ** k
            step(0.1 / (k + 1))

    def step_of_theirs(rate: float) -> None:
        for group in theirs.param_groups:
            group["lr"] = rate
        theirs.step()

    expected, found = weights(), weights()
    theirs = torch.optim.AdamW([{"params": expected[::2], "weight_decay": 0.1}, {"params": expected[1:2], "weight_decay": 0.0}])
    descend(expected, step_of_theirs)
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)
    descend(found, AdamW([(found[::2], 0.1), (found[1:2], 0.0)]).step)
    assert all(map(torch.equal, expected, found))


def test_an_exact_sensor_has_no_error(perfect: Callable[..., Recording]) -> None:
    model, seen = static.Network().double(), windows(perfect, [0.0] * 6)
    assert error(model, "gyro", seen).max() < RULE["gyro"]
    assert error(model, "accel", seen).max() < RULE["accel"]


def test_a_bias_turns_by_itself_times_the_window(perfect: Callable[..., Recording]) -> None:
    """|b| T, less what turning about other axes takes back; seen from the body it is exact for a body that hardly turns."""
    bias = [0.01, -0.02, 0.02]
    found = orientation_error(static.Network().double(), windows(perfect, [*bias, 0.0, 0.0, 0.0]))
    assert found.max() == pytest.approx(0.03 * N * PERIOD_S, rel=0.02)
    assert (found <= 0.03 * N * PERIOD_S + RULE["gyro"]).all()
    assert found.min() > 0.7 * 0.03 * N * PERIOD_S


def test_a_force_bias_is_an_error_of_velocity_and_of_position_over_the_window(perfect: Callable[..., Recording]) -> None:
    """|b| T of velocity and |b| T / 2 of position over T; a body that turns spreads it, never adds to it."""
    found = motion_error(static.Network().double(), windows(perfect, [0.0, 0.0, 0.0, 0.1, -0.2, 0.2]))
    expected = 0.3 * N * PERIOD_S * 1.25**0.5
    assert found.max() == pytest.approx(expected, rel=0.02)
    assert (found <= expected + RULE["accel"]).all()


def test_the_accelerometers_error_teaches_the_gyro_nothing(perfect: Callable[..., Recording]) -> None:
    model, seen = static.Network().double(), windows(perfect, [0.0] * 6)
    rest = seen.segment.rest.clone().requires_grad_(True)
    motion_error(model, replace(seen, segment=replace(seen.segment, rest=rest))).sum().backward()
    assert rest.grad is not None
    assert not rest.grad[:, :3].any()
    assert rest.grad[:, 3:].abs().max() > 0


def test_its_gradient_is_finite_where_there_is_no_error() -> None:
    """A body that never moves and a sensor that says so: the length of zero has no slope of its own."""
    t = torch.arange(5, dtype=torch.float64)[None] * PERIOD_S
    up = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    rest = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    segment = Segment(t, torch.zeros(1, 5, 3, dtype=torch.float64), up.expand(1, 5, 3), rest)
    eye, nothing = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    still = Windows(segment, torch.diff(t), eye, eye, nothing, nothing, nothing, nothing, torch.zeros(1, dtype=torch.int64))
    for found in (orientation_error(static.Network().double(), still), motion_error(static.Network().double(), still)):
        assert found.item() < 1e-11
        (slope,) = torch.autograd.grad(found.sum(), rest)
        assert torch.isfinite(slope).all()
