"""A training on a GPU mixes nothing of the CPU into it, as far as that can be seen without one (`devices`)."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from support.fake_gpu import OnGpu, simulated_gpu
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from imutool.bias import model_file
from imutool.bias.networks import neural_ode
from imutool.bias.networks.network import Segment
from imutool.bias.neural_ode import Config
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.training.checkpoint import checkpoint_path
from imutool.training.fit import Epoch, Training
from imutool.training.objectives.objective import AdamW
from imutool.training.run import train
from imutool.training.settings import TrainSettings, settings_of

pytestmark = pytest.mark.usefixtures("one_start")  # left-out logs are scored in numpy, on whatever device was trained

THREE = torch.tensor([1.0, 2.0, 3.0])


# ── the simulation ───────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def gpu() -> Iterator[Tensor]:
    """Three numbers on it."""
    with simulated_gpu():
        yield THREE.to("cuda")


@pytest.mark.parametrize(
    "mixed",
    [
        lambda x: x + THREE,
        lambda x: THREE * x,
        lambda x: x @ THREE,
        lambda x: torch.where(x > 1, x, THREE),
        lambda x: torch.lerp(x, x, THREE),
        lambda x: torch.cat([x, THREE]),
        lambda x: torch.stack([x[0], THREE[0]]),
        lambda x: torch.einsum("i,i->", x, THREE),
        lambda x: torch.linalg.solve(torch.eye(3, device=x.device), THREE),
        lambda x: torch.searchsorted(x, THREE),
        lambda x: THREE[x.long() - 1],
        lambda x: THREE.clone().add_(x),
        lambda x: THREE.clone().sum().add_(x[0]),
        lambda x: THREE + x[0],
        lambda x: x.clone().index_put_((x.long() - 1,), THREE),
        nn.Linear(3, 1),
        lambda x: nn.functional.conv1d(x[None, None], THREE[None, None]),
        lambda x: torch._foreach_add([x], [THREE]),
    ],
)
def test_two_devices_in_one_operation_are_refused(gpu: Tensor, mixed: Callable[[Tensor], Any]) -> None:
    with pytest.raises(RuntimeError, match="same device"):
        mixed(gpu)


@pytest.mark.parametrize("array", [lambda x: x.numpy(), np.asarray, lambda x: np.stack([x])])
def test_no_array_is_made_of_a_tensor_on_the_gpu(gpu: Tensor, array: Callable[[Tensor], Any]) -> None:
    with pytest.raises(TypeError, match="to numpy"):
        array(gpu)
    assert array(gpu.cpu()).sum() == 6.0


def test_nothing_is_drawn_there_with_a_generator_of_the_cpu(gpu: Tensor) -> None:
    with pytest.raises(RuntimeError, match="generator"):
        torch.randint(3, (2,), generator=torch.Generator(), device=gpu.device)
    with pytest.raises(RuntimeError, match="generator"):
        gpu.clone().normal_(generator=torch.Generator())
    assert torch.randint(3, (2,), generator=torch.Generator()).to(gpu.device).is_cuda


@pytest.mark.parametrize(
    "allowed",
    [
        lambda x: x * torch.tensor(2.0),
        lambda x: torch.where(x > 0, x, torch.tensor(9.0)) * 2,
        lambda x: x[[0, 1, 2]] * 2,
        lambda x: x[torch.tensor([0, 1, 2])] * 2,
        lambda x: x[torch.tensor([True, True, True])] + x,
        lambda x: x.new_tensor([2.0, 4.0, 6.0]),
        lambda x: torch.tensor([2.0, 4.0, 6.0], device=x.device),
        lambda x: torch.as_tensor(np.array([2.0, 4.0, 6.0]), device="cuda"),
        lambda x: torch.from_numpy(np.array([2.0, 4.0, 6.0])).to(x),
        lambda x: torch.arange(2, 7, 2, device=x.device),
        lambda x: x.clone().copy_(2 * THREE),
    ],
)
def test_what_a_gpu_does_is_done_there(gpu: Tensor, allowed: Callable[[Tensor], Tensor]) -> None:
    found = allowed(gpu)
    assert found.device == torch.device("cuda", 0)
    assert found.tolist() == [2.0, 4.0, 6.0]


def test_numbers_come_from_it_one_by_one_and_by_copies(gpu: Tensor) -> None:
    assert (float(gpu[1]), gpu[1].item(), int(gpu[1]), bool(gpu[1] > 1)) == (2.0, 2.0, 2, True)
    assert type(gpu.cpu()) is Tensor
    assert type(torch.zeros(3).copy_(gpu)) is Tensor
    assert torch.zeros(3).copy_(gpu).tolist() == [1.0, 2.0, 3.0]


def test_a_copy_is_apart_and_a_view_is_not(gpu: Tensor) -> None:
    gpu[1:] = torch.tensor([7.0, 8.0])
    gpu[[0]] = 6.0
    gpu[:1].mul_(0.5)
    assert gpu.tolist() == [3.0, 7.0, 8.0]
    assert gpu[None].squeeze_(0).shape == gpu.shape
    assert THREE.tolist() == [1.0, 2.0, 3.0]


def test_all_that_is_made_of_it_stays_there(gpu: Tensor) -> None:
    made = [gpu[:, None].mT, gpu.detach(), gpu.data, gpu.double(), *gpu.split(1), *gpu.sort(), gpu.sum(), torch.zeros_like(gpu)]
    assert all(isinstance(one, OnGpu) and one.is_cuda for one in made)
    assert not gpu.cpu().is_cuda


def test_models_and_their_gradients_and_copies_are_there_and_come_back(gpu: Tensor) -> None:
    model = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2)).to("cuda")
    mean = AveragedModel(copy.deepcopy(model), multi_avg_fn=get_ema_multi_avg_fn(0.5), use_buffers=True)  # type: ignore[no-untyped-call]
    optimizer = AdamW([(list(model.parameters()), 0.0)])
    model(torch.stack([gpu, gpu**2])).square().sum().backward()
    optimizer.step(1e-3)
    mean.update_parameters(model)
    mean.update_parameters(model)
    parameters = list(model.parameters())
    assert all(isinstance(one, nn.Parameter) and one.is_leaf and one.requires_grad for one in parameters)
    assert all(one.grad is not None and one.grad.is_cuda for one in parameters)
    assert all(one.is_cuda for one in (*model.state_dict().values(), *mean.module.state_dict().values()))
    assert not any(one.is_cuda for one in model.cpu().state_dict().values())


def test_a_gradient_is_the_same_as_on_the_cpu(gpu: Tensor) -> None:
    grads = []
    for x in (gpu.clone(), THREE.clone()):
        y = torch.linalg.cross(x.requires_grad_(), x.flip(0)).exp().norm() + x[[0, 0, 2]].square().sum()
        grads += torch.autograd.grad(y, x)
    assert torch.equal(grads[0].cpu(), grads[1])


def test_afterwards_it_is_gone() -> None:
    before = torch.cuda.is_available()
    with simulated_gpu():
        assert torch.cuda.is_available()
    assert torch.cuda.is_available() is before
    assert torch.zeros(2, device="meta").is_meta


# ── whole trainings ──────────────────────────────────────────────────────────────────────────────────────────────────

SMALL_ODE = {"curve_width": 8, "drift_step_s": 0.25}
EFFECTS = {"gyro_effects": ["gyro_scale", "gyro_misalignment"], "accel_effects": ["accel_scale"]}
CHOOSING = {"remainder": False, "accel_effects": ["accel_scale"]}  # the gyro alone, of two sensors that choose alike
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "linear": ("linear", {}),
    "neural_ode": ("neural_ode", {**SMALL_ODE, "loads": ["gyro_rate_load"]}),
    "conv": ("conv", {"channels": [4, 8], "dilations": [1, 4]}),
    "hybrid": ("hybrid", {**EFFECTS, "ode": SMALL_ODE}),
    "hybrid that chooses its effects": ("hybrid", CHOOSING),
}


def settings(method: str, model: dict[str, Any]) -> TrainSettings:
    """Few steps on short windows; left-out logs are scored where effects are chosen, which is what they are for."""
    tiny = {"gyro_window_s": (0.25,), "accel_window_s": (0.25,), "steps": 2, "validate_every": 1, "samples": 100}
    rest = {"increments": {"stretch_s": 1.0}, "compare": model == CHOOSING, "model": model}
    return msgspec.convert(tiny | rest, settings_of(method))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / f"{seed}.mcap" for seed in (1, 2)]
    for seed, path in zip((1, 2), paths, strict=True):
        write(flight(seed, duration_s=7.0, still_s=0.5, rate_hz=50.0), path)
    return paths


@pytest.fixture(scope="module")
def on_the_cpu(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], bytes]:
    """The model file that a training on the CPU writes."""

    @functools.cache
    def trained(name: str) -> bytes:
        out = tmp_path_factory.mktemp("cpu") / "m.safetensors"
        method, model = METHODS[name]
        train(logs, out, method=method, settings=settings(method, model))
        return out.read_bytes()

    return trained


@pytest.fixture(autouse=True)
def any_ode_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What two steps do to made-up flights is not the question here."""
    monkeypatch.setattr("imutool.training.run.helps", lambda before, after: True)


@pytest.mark.parametrize("name", METHODS)
def test_a_training_on_a_gpu_is_the_one_on_the_cpu(
    logs: list[Path], on_the_cpu: Callable[[str], bytes], tmp_path: Path, name: str
) -> None:
    """All the way from logs to a model file; what is written is the same to the byte, and in the precision of a file."""
    method, model = METHODS[name]
    out = tmp_path / "m.safetensors"
    with simulated_gpu():
        train(logs, out, method=method, settings=settings(method, model), device="cuda")
    assert out.read_bytes() == on_the_cpu(name)
    assert {one.dtype for one in load_file(out).values()} == {torch.float32}
    assert model_file.load(out).method == method


def test_a_training_is_put_down_on_a_gpu_and_taken_up_there(
    logs: list[Path], on_the_cpu: Callable[[str], bytes], tmp_path: Path
) -> None:
    """By the method whose checkpoint holds most: batch statistics and the draws of its dropout."""
    name = "conv"
    method, model = METHODS[name]
    out, chosen = tmp_path / "m.safetensors", settings(method, model)

    def stop(epoch: Epoch) -> None:
        if epoch.step == 2:  # what is kept is from the line before
            raise KeyboardInterrupt

    with simulated_gpu():
        with pytest.raises(KeyboardInterrupt):
            train(logs, out, method=method, settings=chosen, device="cuda", progress=stop)
        assert checkpoint_path(out).exists()
        train(logs, out, method=method, settings=chosen, device="cuda", resume=True)
    assert out.read_bytes() == on_the_cpu(name)


@pytest.mark.parametrize(("solver", "adjoint"), [("rk4", False), ("dopri5", True)])
def test_every_way_to_solve_the_drift_stays_on_the_gpu(solver: str, adjoint: bool) -> None:
    """Values and gradients."""
    found = []
    for device in ("cpu", "cuda"):
        with simulated_gpu():
            torch.manual_seed(0)
            given = {**SMALL_ODE, "drift": ["gyro", "accel"], "solver": solver, "adjoint": adjoint}
            model = neural_ode.Network(msgspec.convert(given, Config), rate_hz=50.0).double()
            for drift in model.drift.values():
                nn.init.normal_(drift.out.weight, 0.0, 1e-3)
            model.to(device)
            t = torch.arange(16, device=device, dtype=torch.float64).expand(2, -1) / 50.0
            u = torch.stack([t.sin(), t.cos(), t], dim=-1)
            bias = model(Segment(t, u, u * 9.0, u.new_zeros(2, 6)))
            bias.square().sum().backward()
            grads = [weight.grad for weight in model.parameters() if weight.grad is not None]
            assert all(one.is_cuda == (device == "cuda") for one in (bias, *grads))
            found.append([one.detach().cpu() for one in (bias, *grads)])
    assert len(found[0]) > 20
    assert all(torch.equal(here, there) for here, there in zip(*found, strict=True))


def test_the_samples_and_all_that_is_learnt_lie_on_the_gpu() -> None:
    """Else the tests above would hold of a training that never left the CPU."""
    with simulated_gpu():
        training = Training(
            [flight(1, duration_s=8.0, rate_hz=50.0)], "neural_ode", settings("neural_ode", SMALL_ODE), device="cuda"
        )
        next(iter(training.epochs()))
        assert training.stage is not None
        held = [training.pool.gyro, training.pool.log, training.tracks.knots, *training.model.state_dict().values()]
        held += [*training.stage.closed_form.values(), *training.stage.objective.loss.medians.values()]
        assert all(one.is_cuda for one in held)
