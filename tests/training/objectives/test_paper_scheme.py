"""Training as the paper describes it, through the same command, files and checkpoints as any other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
import torch

import imutool
from imutool.bias import model_file
from imutool.bias_start import initial_bias
from imutool.bias_start.correction import apply
from imutool.recording import Imu, Recording
from imutool.training import checkpoint
from imutool.training.fit import Epoch, Training
from imutool.training.objectives.paper_scheme import PaperTraining
from imutool.training.settings import PaperSettings, settings_of

Make = Callable[..., Recording]
SCALED = np.array([0.10, -0.08, 0.05])  # of the gyro
PAPER = {"gyro_steps": 40, "accel_steps": 2, "segments": 100, "halve_every": 15}


def scaled(perfect: Make, seed: int) -> Recording:
    """A gyro with errors of scale and a bias, and noise."""
    exact = perfect(seed, duration_s=8.0, still_s=0.5, rate_hz=100.0)
    noise = np.random.default_rng(seed).normal(size=(len(exact.imu), 3))
    gyro = exact.imu.gyro * (1 + SCALED) + 0.02 + 2e-3 * noise
    return Recording(exact.name, Imu(exact.imu.t_ns, gyro, exact.imu.accel), exact.truths)


def training(perfect: Make, model: Mapping[str, Any] = MappingProxyType({}), **paper: Any) -> PaperTraining:
    settings = settings_of("neural_ode")(
        validate_every=10, model={"scheme": "paper", **model}, paper=PaperSettings(**{**PAPER, **paper})
    )
    return PaperTraining([scaled(perfect, 1), scaled(perfect, 2)], "neural_ode", settings)


def gyro_errors(epochs: list[Epoch]) -> list[float]:
    return [epoch.held_out for epoch in epochs if epoch.sensor == "gyro"]


def test_it_lowers_the_held_out_error_and_its_file_debiases_a_log(perfect: Make, tmp_path: Path) -> None:
    made = training(perfect)
    errors = gyro_errors(list(made.epochs()))
    assert errors[-1] < 0.5 * errors[0]
    model_file.save(made.model.frozen(), tmp_path / "paper.safetensors")
    model, unseen = model_file.load(tmp_path / "paper.safetensors"), scaled(perfect, 3)
    assert np.isfinite(apply(model, initial_bias.prior(model), unseen.imu).imu.gyro).all()
    assert (model.noise_std > 0).all()
    assert np.isfinite(model.prior_std).all()


def test_the_learning_rate_halves(perfect: Make) -> None:
    made = training(perfect, halve_every=2)
    made._closed_form("gyro")
    stage = made.begin("gyro")
    rates = []
    for stage.step in range(5):
        rates.append(made._rate_at(stage))
    assert rates == pytest.approx([5e-3, 5e-3, 2.5e-3, 2.5e-3, 1.25e-3])


def test_the_second_stage_leaves_the_gyros_field_alone(perfect: Make) -> None:
    made = training(perfect, gyro_steps=1, accel_steps=3)
    fields: dict[str, torch.Tensor] = {}
    for epoch in made.epochs(statistics=False):
        now = made.model.get_submodule("drift.gyro.out").get_parameter("weight").detach().clone()
        before = fields.setdefault(epoch.sensor, now)
        assert epoch.sensor == "gyro" or torch.equal(before, now)
    assert set(fields) == {"gyro", "accel"}


@pytest.mark.parametrize("adjoint", [False, True])
def test_solver_and_adjoint_are_a_choice(perfect: Make, adjoint: bool) -> None:
    """The adjoint's direction is that of backpropagation, as far as the solver has converged."""
    few = {"gyro_steps": 1, "accel_steps": 1, "segments": 20, "samples": 4}
    made = training(perfect, {"solver": "rk4", "adjoint": adjoint}, **few)
    direct = training(perfect, {"solver": "rk4"}, **few)
    for one in (made, direct):
        one._closed_form("gyro")
        one._descent_direction(one.begin("gyro"))
    gradients = [one.model.get_submodule("drift.gyro.out").get_parameter("weight").grad for one in (made, direct)]
    assert gradients[0] is not None
    assert gradients[1] is not None
    assert gradients[1].norm() > 0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-2, atol=1e-3 * float(gradients[1].norm()))


def test_an_interrupted_training_goes_on_to_the_same_model(perfect: Make, tmp_path: Path) -> None:
    def final(made: Training) -> dict[str, torch.Tensor]:
        for _ in made.epochs(statistics=False):
            pass
        return {name: value.clone() for name, value in made.model.state_dict().items() if name.startswith("drift")}

    few = {"gyro_steps": 6, "accel_steps": 2}
    whole = final(training(perfect, **few))
    first = training(perfect, **few)
    made = first.epochs(statistics=False)
    next(made)
    assert first.stage is not None
    for _ in range(3):
        first._one_step(first.stage)
    checkpoint.save(first, tmp_path / "kept")
    second = training(perfect, **few)
    checkpoint.restore(second, tmp_path / "kept")
    resumed = final(second)
    for name, value in whole.items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=0)


def test_a_methods_own_setting_needs_no_prefix(perfect: Make, tmp_path: Path) -> None:
    logs = []
    for seed in (1, 2):
        imutool.write(tmp_path / f"{seed}.mcap", scaled(perfect, seed))
        logs.append(tmp_path / f"{seed}.mcap")
    short = {"scheme": "paper", "paper": {**PAPER, "gyro_steps": 2}}
    model = imutool.train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=short)
    assert model.config.scheme == "paper"  # type: ignore[attr-defined]
    assert set(model.card["held_out"]) == {"gyro", "accel"}
