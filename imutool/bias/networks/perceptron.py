"""Perceptrons of the neural ODE, by parts and in Euler's steps, with their derivatives.

PyTorch takes tanh and asinh of float64 from a library that is four to twenty times slower on some processors than what
is here (AMD EPYC: 4.3 and 22 ns a number, 1.1 and 4 ns here). Both agree with it to two roundings of numbers about one.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from imutool.array_types import Float

gelu_backward, tanh_backward = torch.ops.aten.gelu_backward, torch.ops.aten.tanh_backward


def asinh(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Inverse hyperbolic sine, for samples by sign(x) log1p(|x| + x² / (1 + sqrt(1 + x²)))."""
    if x.requires_grad:
        return x.asinh()
    square = x * x
    return torch.copysign((square / ((square + 1.0).sqrt() + 1.0) + x.abs()).log1p(), x)


ROWS = 1_000  # samples at a time, so that what they need stays in a core's cache


def by_rows(net: nn.Sequential, x: Float[Tensor, "*batch i"]) -> Float[Tensor, "*batch o"]:
    """Perceptron linear, GELU, linear, tanh, linear without bias; `ROWS` rows at a time.

    It is computed in the precision of `x`, and gives its weights no gradient. Where `x` are no samples, and need a gradient of
    their own, it is left to PyTorch, in the precision of the weights.
    """
    first, second, last = (layer for layer in net if isinstance(layer, nn.Linear))
    if x.requires_grad:
        whole: Tensor = net(x.to(first.weight))
        return whole
    rows = x.reshape(-1, x.shape[-1])
    y = rows.new_empty(len(rows), last.out_features)
    with torch.no_grad():
        W1, b1, W2, b2, W3 = (w.to(x) for w in (first.weight, first.bias, second.weight, second.bias, last.weight))
        for some, out in zip(torch.split(rows, ROWS), torch.split(y, ROWS), strict=True):
            h = nn.functional.gelu(torch.addmm(b1, some, W1.T))
            torch.mm(_tanh_(torch.addmm(b2, h, W2.T)), W3.T, out=out)
    return y.reshape(*x.shape[:-1], y.shape[-1])


def perceptron(hidden: Sequence[int]) -> nn.Sequential:
    """Perceptron 9 -> hidden -> 9: GELU between hidden layers, tanh before the last."""
    layers: list[nn.Module] = []
    for i, (before, width) in enumerate(pairwise((9, *hidden))):
        layers += [nn.Linear(before, width), nn.Tanh() if i == len(hidden) - 1 else nn.GELU()]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], 9))


class Drift(nn.Module):
    """Drift g, the slow rate of the rest bias: a perceptron of two residual blocks."""

    def __init__(self, hidden: tuple[tuple[int, ...], tuple[int, ...]], scale: float, curve: float, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.block1, self.block2 = perceptron(hidden[0]), perceptron(hidden[1])
        self.out = nn.Linear(9, 3)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        # inputs: the state relative to the prior's mean in units of the curve; the motion in its own
        self.centre: Tensor
        self.units: Tensor
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("units", torch.tensor([curve] * 3 + [scale] * 6))

    def forward(self, beta: Float[Tensor, "b 3"], u: Float[Tensor, "b 3"], du: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Drift dbeta/dt per second."""
        x = torch.cat([beta - self.centre, u, du], dim=-1) / self.units
        x = x + self.block1(x)
        x = x + self.block2(x)
        y: Tensor = self.rate * self.out(x)
        return y

    def euler(
        self,
        u: Float[Tensor, "b steps 3"],
        before: Float[Tensor, "b 3"],
        step_s: Float[Tensor, "b 1"],
        start: Float[Tensor, "b 3"],
    ) -> Float[Tensor, "m b 3"]:
        """States of Euler's steps from `start` on, which see a causal path at its knots alone.

        There it is the sample, and its slope that to the one before. `before` stands before the first.
        """
        slopes = torch.diff(u, dim=1, prepend=before[:, None]) / step_s[:, None]
        motion = (torch.cat([u, slopes], dim=2) / self.units[3:]).transpose(0, 1)
        return euler_steps((self.block1, self.block2), self.out, motion, start, self.centre, self.units[:3], self.rate * step_s)


def euler_steps(
    blocks: Sequence[nn.Sequential],
    out: nn.Linear,
    motion: Float[Tensor, "m b 6"],
    rest: Float[Tensor, "b 3"],
    centre: Float[Tensor, "3"],
    unit: Float[Tensor, "3"],
    step: Float[Tensor, "b 1"],
) -> Float[Tensor, "k b 3"]:
    """States from `rest` on of b' = b + step out(x), x from residual blocks.

    The blocks begin with the state `(b - centre) / unit` and the motion. `blocks` are perceptrons of residual blocks. A step is
    so small that the gradient of each of its operations costs more than the arithmetic: here the derivative runs back through
    the states alone, and that by the weights is one product a layer. Gradients reach the weights and `rest`.
    """
    linear = [layer for block in blocks for layer in block if isinstance(layer, nn.Linear)]
    weights = [tensor for layer in (*linear, out) for tensor in (layer.weight, layer.bias)]
    sizes = tuple(len(block) // 2 + 1 for block in blocks)
    states: Tensor = _EulerSteps.apply(  # type: ignore[no-untyped-call]  # torch gives it no type
        sizes, motion, centre, unit, step, torch.is_grad_enabled(), rest, *weights
    )
    return states


class _EulerSteps(torch.autograd.Function):
    """`euler_steps`; `sizes` are the linear layers of each block."""

    @staticmethod
    def forward(
        ctx: Any,
        sizes: tuple[int, ...],
        motion: Tensor,
        centre: Tensor,
        unit: Tensor,
        step: Tensor,
        keep: bool,
        rest: Tensor,
        *weights: Tensor,
    ) -> Tensor:
        layers = [(W.T, b) for W, b in zip(weights[::2], weights[1::2], strict=True)]
        seen: list[list[Tensor]] = [[] for _ in layers]  # what enters each layer
        bent: list[list[Tensor]] = [[] for _ in layers]  # what a GELU turned into that
        states = [rest]
        for controls in motion:
            x, at = torch.cat([(states[-1] - centre) / unit, controls], dim=1), 0
            for size in sizes:
                y = before = x
                for k in range(at, at + size):
                    if k == at + size - 1:
                        y = _tanh_(before)
                    elif k > at:
                        y = nn.functional.gelu(before)
                        if keep:
                            bent[k].append(before)
                    if keep:
                        seen[k].append(y)
                    before = torch.addmm(layers[k][1], y, layers[k][0])
                x, at = x + before, at + size
            if keep:
                seen[-1].append(x)
            states.append(torch.addcmul(states[-1], step, torch.addmm(layers[-1][1], x, layers[-1][0])))
        ctx.sizes, ctx.unit, ctx.step, ctx.weights, ctx.seen, ctx.bent = sizes, unit, step, weights[::2], seen, bent
        return torch.stack(states)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        weights, seen, bent = ctx.weights, ctx.seen, ctx.bent
        derivatives: list[list[Tensor]] = [[] for _ in weights]  # derivative by what leaves each layer, last step first
        g = grad[-1]
        for i in range(len(grad) - 2, -1, -1):
            derivatives[-1].append(ctx.step * g)
            by_x, end = derivatives[-1][-1] @ weights[-1], len(weights) - 1
            for size in reversed(ctx.sizes):
                by_y = by_x
                for k in range(end - 1, end - size - 1, -1):
                    derivatives[k].append(by_y)
                    by_y = by_y @ weights[k]
                    if k == end - 1 and size > 1:
                        by_y = tanh_backward(by_y, seen[k][i])
                    elif k > end - size:
                        by_y = gelu_backward(by_y, bent[k][i])
                by_x, end = by_x + by_y, end - size
            g = grad[i] + g + by_x[:, :3] / ctx.unit
        by_weights: list[Tensor] = []
        for leaving, entering in zip(derivatives, seen, strict=True):
            d = torch.cat(leaving[::-1])
            by_weights += [d.mT @ torch.cat(entering), d.sum(0)]
        return None, None, None, None, None, None, g, *by_weights


def _tanh_(x: Tensor) -> Tensor:
    """Tanh in place."""
    return x.mul_(2.0).sigmoid_().mul_(2.0).sub_(1.0)
