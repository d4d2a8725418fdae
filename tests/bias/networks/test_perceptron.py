"""Hand-written derivatives and activations are those of PyTorch."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imutool.bias.networks.perceptron import ROWS, asinh, by_rows, euler_steps, perceptron

ROUNDINGS = 1e-13  # relative: sums of a thousand products in another order


def random(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def gradients(value: Tensor, weights: list[Tensor]) -> list[Tensor]:
    """Of a sum whose terms all count differently."""
    torch.manual_seed(5)
    return list(torch.autograd.grad((value * random(*value.shape)).sum(), weights))


def close(some: list[Tensor], others: list[Tensor]) -> bool:
    return all((a - b).abs().max() <= ROUNDINGS * b.abs().max() for a, b in zip(some, others, strict=True))


def test_asinh_keeps_its_digits_at_every_size() -> None:
    x = torch.cat([torch.tensor([0.0], dtype=torch.float64), torch.logspace(-300, 100, 500, dtype=torch.float64)])
    torch.testing.assert_close(asinh(torch.cat([x, -x])), torch.cat([x, -x]).asinh(), rtol=4e-16, atol=0.0)


def test_rows_by_parts_are_the_network() -> None:
    torch.manual_seed(1)
    net = nn.Sequential(nn.Linear(9, 16), nn.GELU(), nn.Linear(16, 16), nn.Tanh(), nn.Linear(16, 3, bias=False)).double()
    x = random(3, ROWS - 7, 9)
    by_parts, whole = by_rows(net, x), net(x)
    assert by_parts.shape == whole.shape
    assert close([by_parts], [whole])
    assert not by_parts.requires_grad


def test_rows_that_need_a_gradient_get_it() -> None:
    torch.manual_seed(2)
    net = nn.Sequential(nn.Linear(9, 4), nn.GELU(), nn.Linear(4, 4), nn.Tanh(), nn.Linear(4, 3, bias=False)).double()
    x = random(5, 9).requires_grad_()
    assert close(gradients(by_rows(net, x), [x]), gradients(net(x), [x]))


def test_eulers_steps_have_the_values_and_gradients_of_the_plain_loop() -> None:
    torch.manual_seed(3)
    blocks = [perceptron((8, 6)).double(), perceptron((5,)).double(), perceptron((4, 4, 4)).double()]
    out, motion, rest = nn.Linear(9, 3).double(), random(7, 2, 6), random(2, 3).requires_grad_()
    centre, unit, step = random(3), random(3).abs() + 0.5, 0.1 * random(2, 1).abs()
    states = [rest]
    for controls in motion:
        x = torch.cat([(states[-1] - centre) / unit, controls], dim=1)
        for block in blocks:
            x = x + block(x)
        states.append(states[-1] + step * out(x))
    plain, weights = torch.stack(states), [rest, *(w for part in (*blocks, out) for w in part.parameters())]
    fast = euler_steps(blocks, out, motion, rest, centre, unit, step)
    assert close([fast], [plain])
    assert close(gradients(fast, weights), gradients(plain, weights))
