"""Bias models with weights as large as a training leaves them, and samples to show them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from support.small_tensors import one_thread  # noqa: F401  (a fixture)

from imutool import registry
from imutool.bias.networks.network import BiasNetwork, Segment

RATE_HZ = 200.0


def _build(method: str, seed: int = 0, **settings: object) -> BiasNetwork:
    """A network whose every number is moved from where it starts, so that no part of it is silent."""
    config = registry.load("imutool.bias", method).Config(**settings)
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    model: BiasNetwork = registry.load("imutool.networks", method).Network(config, RATE_HZ).double()
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.05 * torch.randn(value.shape, generator=generator, dtype=value.dtype))
        for value in (model.prior_mean, model.prior_std, model.truth_std, model.noise_std):
            value.copy_(0.01 * torch.rand(6, generator=generator))
    return model.requires_grad_(False).eval()


def _segment(seed: int, batch: int, n: int, rate_hz: float = RATE_HZ) -> Segment:
    """Samples of a moving body (rad/s, m/s²) that change smoothly, as measured ones do, with a little noise."""
    generator = torch.Generator().manual_seed(seed)
    t = (torch.arange(n, dtype=torch.float64) / rate_hz).expand(batch, n)
    phase, speed = (torch.rand(batch, 1, 6, generator=generator, dtype=torch.float64) for _ in range(2))
    wave = torch.sin(6.28 * (phase + 2.0 * speed * t[..., None]))
    u = wave + 0.02 * torch.randn(batch, n, 6, generator=generator, dtype=torch.float64)
    accel = 3.0 * u[..., 3:] + torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    rest = torch.randn(batch, 6, generator=generator, dtype=torch.float64) * torch.tensor([0.02] * 3 + [0.1] * 3)
    return Segment(t, u[..., :3].contiguous(), accel, rest)


@pytest.fixture(scope="session")
def build() -> Callable[..., BiasNetwork]:
    """`build(method, seed=0, **settings)`."""
    return _build


@pytest.fixture(scope="session")
def segment() -> Callable[..., Segment]:
    """`segment(seed, batch, n, rate_hz=200.0)`."""
    return _segment
