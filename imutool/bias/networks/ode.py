"""Neural ODEs on SO(3): a causal path through sampled controls, and integration in charts.

A rotation is R = R_0 Exp(xi) with dxi/dt = J_r^{-1}(xi) omega (paper, theorem 1, eq. 15): the state of the solver is
Euclidean, so torchdiffeq and its adjoint apply unchanged. Where |xi| exceeds pi the chart changes: R_0 <- R_0 Exp(xi),
xi <- 0 (algorithm 1), for each element of the batch separately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from imutool.array_types import Bool, Float, Num
from imutool.errors import DataError, NumericsError
from imutool.geometry import so3

Method = Literal["euler", "rk4", "dopri5"]
Field = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

TOLERANCES = {"rtol": 1e-6, "atol": 1e-9}
FIXED_STEP: tuple[Method, ...] = ("euler", "rk4")
FIRST_STRETCH, LONGEST_STRETCH = 32, 128  # outputs per call of a fixed-step solver. A call costs a third of a step, and
# a chart change wastes the rest of its stretch: stretches double without chart changes, and end at the next one
MAX_STEPS_PER_OUTPUT = 10_000  # an adaptive solver that needs more steps is at a singularity
REDUCE = "Reduce the step, or ask for output more often"


def solve(
    field: nn.Module,
    start: Float[Tensor, "*batch m"],
    times: Float[Tensor, " n"],
    method: Method,
    *,
    adjoint: bool = False,
    **how: Any,
) -> Float[Tensor, "n *batch m"]:
    """States at the times by torchdiffeq; `how` are its options."""
    import torchdiffeq  # half a second

    solver = torchdiffeq.odeint_adjoint if adjoint else torchdiffeq.odeint
    states: Tensor = solver(field, start, times, method=method, **TOLERANCES | how)
    return states


class HermitePath:
    """Causal cubic Hermite spline of sampled controls, with backward differences.

    As in the paper; Morrill 2022.

    S(t_i) = u_i and dS/dt(t_i) = (u_i - u_{i-1}) / (t_i - t_{i-1}); the slope at the first knot, which has no
    predecessor, is 0. Causal: up to t_{i+1} the path depends on samples up to i+1 only, and its slope at t_i on samples
    up to i. Outside its knots it is linear with the slope of the end knot (a solver may evaluate just past the end).

    Args:
        t: knot times in s, strictly increasing, best float64 (float32 seconds lose the spacing of samples within a
            minute); integers, an index used as time, become float64.
        u: samples at the knots; gradients flow back to them.

    Raises:
        DataError: fewer than two knots, or times that do not increase.
    """

    def __init__(self, t: Num[Tensor, " n"], u: Float[Tensor, "*batch n k"]) -> None:
        if len(t) < 2 or not bool((t[1:] > t[:-1]).all()):
            raise DataError(f"a control path of {len(t)} knots", expected="at least 2, strictly increasing in time")
        self.t, self.u = (t if t.is_floating_point() else t.to(torch.float64)), u
        step = torch.diff(self.t)
        self._rise = torch.diff(u, dim=-2)  # u_{i+1} - u_i
        slope = self._rise / step.to(u.dtype).unsqueeze(-1)
        self._slope = torch.cat([torch.zeros_like(u[..., :1, :]), slope], dim=-2)

    def value(self, t: Float[Tensor, "*m"]) -> Float[Tensor, "*batch_m_k"]:
        """Values S(t): for one time [*batch, k], for m times [*batch, m, k]."""
        i, s, h = self._locate(t)
        start_rise, rise = self._slope[..., i, :] * h, self._rise[..., i, :]
        inside = self.u[..., i, :] + s * (1 - s) ** 2 * start_rise + s**2 * (2 - s) * rise
        past = (t - self.t[-1]).clamp(min=0).to(self.u.dtype).unsqueeze(-1)
        return inside + past * (self._slope[..., -1, :] if t.ndim == 0 else self._slope[..., -1:, :])

    def derivative(self, t: Float[Tensor, "*m"]) -> Float[Tensor, "*batch_m_k"]:
        """Slopes dS/dt, shaped as `value`."""
        i, s, h = self._locate(t)
        start_rise, rise = self._slope[..., i, :] * h, self._rise[..., i, :]
        return ((1 - s) * (1 - 3 * s) * start_rise + s * (4 - 3 * s) * rise) / h

    def _locate(self, t: Float[Tensor, "*m"]) -> tuple[Tensor, Float[Tensor, "*m 1"], Float[Tensor, "*m 1"]]:
        """Interval index, position in the interval from 0 to 1, and its length, by binary search."""
        inside = t.to(self.t.dtype).clamp(self.t[0], self.t[-1])
        i = (torch.searchsorted(self.t, inside, right=True) - 1).clamp(0, len(self.t) - 2)
        h = self.t[i + 1] - self.t[i]
        s = (inside - self.t[i]) / h
        return i, s.to(self.u.dtype).unsqueeze(-1), h.to(self.u.dtype).unsqueeze(-1)


def integrate(
    field: Field,
    state0: Float[Tensor, "*batch m"],
    t: Float[Tensor, " n"],
    R0: Float[Tensor, "*batch 3 3"],
    *,
    method: Method = "euler",
    adjoint: bool = False,
    max_angle: float = math.pi,
    rtol: float = 1e-6,
    atol: float = 1e-8,
    parameters: Iterable[Tensor] = (),
) -> tuple[Float[Tensor, "n *batch 3 3"], Float[Tensor, "n *batch m"]]:
    """Rotations and Euclidean states at the times `t`, from `R0` and `state0` at `t[0]`.

    Solves dR_wb/dt = R_wb [omega_b]x together with the Euclidean states, from output to output. Gradients reach
    `state0`, `R0` and the field's parameters, also through chart changes: a change only renames the same rotation.

    Args:
        field: `field(t, R_wb, state) -> (omega_b, dstate/dt)`; t is a scalar in the dtype of `t`.
        state0: states at `t[0]`; m may be 0.
        t: output times in s, strictly increasing, best float64.
        R0: rotation at `t[0]`, body to world.
        method: `euler` and `rk4` take one step from each output to the next; `dopri5` chooses its own, never over one.
        adjoint: gradients from the adjoint equation, in memory that does not grow with the steps between outputs. They
            equal those of the discrete steps as far as the solver has converged.
        max_angle: the chart changes at the first output where |xi| exceeds this; less than 2 pi, where a chart ends.
        rtol: relative tolerance of `dopri5`, on the root mean square over the batch.
        atol: absolute tolerance of `dopri5`, likewise.
        parameters: for the adjoint, tensors the field depends on beyond its own as an `nn.Module`, none computed from
            another.

    Raises:
        NumericsError: |xi| reached 2 pi within a step, a state is not finite, or dopri5 could not keep its tolerance.
    """
    solve = _Solver(field, tuple(parameters), method, adjoint, rtol, atol)
    rotations, states = [R0.unsqueeze(0)], [state0.unsqueeze(0)]
    xi0, done, stretch = torch.zeros_like(R0[..., 0]), 0, solve.first_stretch
    while done < len(t) - 1:
        times = t[done : done + stretch + 1]
        y = solve(times, R0, xi0, state0)
        leave, end = _first_leaving(y, max_angle)
        if end == len(times) - 1:
            stretch = solve.next_stretch(stretch)
        else:  # outputs past the change are dropped, and must not enter a backward solution either
            stretch, times = end, times[: end + 1]
            y = solve(times, R0, xi0, state0) if adjoint else y[: end + 1]
        _check(y, times)
        R = R0 @ so3.exp(y[1:, ..., :3])
        rotations.append(R)
        states.append(y[1:, ..., 3:])
        R0 = torch.where(leave[..., None, None], R[-1], R0)
        xi0 = torch.where(leave[..., None], torch.zeros_like(xi0), y[-1, ..., :3])
        state0, done = y[-1, ..., 3:], done + end
    return torch.cat(rotations), torch.cat(states)


class _Chart(nn.Module):
    """Right-hand side in one chart: state (xi, Euclidean states), time from the start of the stretch.

    Time is local because torchdiffeq casts it to the state's dtype, and float32 seconds blur the samples of a long log.

    For the adjoint, R0 is nine constant states. It cannot be one of the adjoint's parameters: after a chart change it depends
    on the field's parameters, and torch.autograd.grad would count those twice.
    """

    def __init__(self, field: Field, start: Float[Tensor, ""], R0: Float[Tensor, "*batch 3 3"] | None) -> None:
        super().__init__()
        self.field, self.start, self.R0 = field, start, R0

    def forward(self, t: Float[Tensor, ""], y: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        if self.R0 is not None:
            R0, xi, state, carried = self.R0, y[..., :3], y[..., 3:], []
        else:
            R0, xi, state = y[..., -9:].reshape(*y.shape[:-1], 3, 3), y[..., :3], y[..., 3:-9]
            carried = [torch.zeros_like(y[..., -9:])]
        omega_b, dstate = self.field(self.start + t.to(self.start.dtype), R0 @ so3.exp(xi), state)
        return torch.cat([so3.chart_rate(xi, omega_b), dstate, *carried], dim=-1)


@dataclass(frozen=True)
class _Solver:
    """Solver of torchdiffeq with the options for one chart; its failures become NumericsError."""

    field: Field
    parameters: tuple[Tensor, ...]
    method: Method
    adjoint: bool
    rtol: float
    atol: float

    @property
    def first_stretch(self) -> int:
        """Outputs of the first call: one for an adaptive solver, which must not reach the end of a chart."""
        return FIRST_STRETCH if self.method in FIXED_STEP else 1

    def next_stretch(self, stretch: int) -> int:
        """Outputs of the call after one without a chart change."""
        return min(2 * stretch, LONGEST_STRETCH) if self.method in FIXED_STEP else 1

    def __call__(
        self,
        times: Float[Tensor, " n"],
        R0: Float[Tensor, "*batch 3 3"],
        xi0: Float[Tensor, "*batch 3"],
        state0: Float[Tensor, "*batch m"],
    ) -> Float[Tensor, "n *batch k"]:
        """States (xi, state) at the times, in the chart at R0."""
        local = times - times[0]
        options, backward = self._options(local)
        how: dict[str, Any] = {"rtol": self.rtol, "atol": self.atol, "options": options}
        try:
            if not self.adjoint:
                chart, y0 = _Chart(self.field, times[0], R0), torch.cat([xi0, state0], dim=-1)
                return solve(chart, y0, local, self.method, **how)
            chart = _Chart(self.field, times[0], None)
            y0 = torch.cat([xi0, state0, R0.flatten(-2)], dim=-1)
            how |= {"adjoint_options": backward, "adjoint_params": (*chart.parameters(), *self.parameters)}
            solution = solve(chart, y0, local, self.method, adjoint=True, **how)
        except AssertionError as error:  # torchdiffeq: the step underflowed, or the state is not finite
            raise NumericsError(
                f"{self.method} failed after t = {float(times[0]):.6g} s ({str(error).splitlines()[0][:80]})",
                expected="a solution within tolerance",
                fix=REDUCE,
            ) from error
        return solution[..., :-9]

    def _options(self, local: Float[Tensor, " n"]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Options of the forward and backward solution: try the whole interval first, stop at its end."""
        if self.method in FIXED_STEP:
            return {}, {}
        limit = {"max_num_steps": MAX_STEPS_PER_OUTPUT}
        forward = {**limit, "first_step": float(local[-1]), "step_t": local[-1:]}
        return ({**forward, "norm": _norm_without_chart}, limit) if self.adjoint else (forward, limit)


def _norm_without_chart(y: Float[Tensor, "*batch m"]) -> Float[Tensor, ""]:
    return y[..., :-9].square().mean().sqrt()


def _first_leaving(y: Float[Tensor, "n *batch m"], max_angle: float) -> tuple[Bool[Tensor, "*batch"], int]:
    """Elements that must change their chart, at the first output where one must (else the last), and that output."""
    outside = y[..., :3].detach().square().sum(dim=-1) > max_angle**2
    some = outside.reshape(len(y), -1).any(dim=1)
    end = int(some.int().argmax()) if bool(some[1:].any()) else len(y) - 1
    return outside[end], end


def _check(y: Float[Tensor, "n *batch m"], times: Float[Tensor, " n"]) -> None:
    worst = y.detach()
    if not bool(torch.isfinite(worst).all()):
        raise NumericsError(
            f"the solution is not finite between t = {float(times[0]):.6g} and {float(times[-1]):.6g} s",
            expected="finite states",
            fix=REDUCE,
        )
    angle = float(worst[-1, ..., :3].square().sum(dim=-1).max().sqrt()) if worst[-1].numel() else 0.0
    if angle >= 2 * math.pi:
        raise NumericsError(
            f"the rotation reached {angle:.3g} rad in one chart by t = {float(times[-1]):.6g} s",
            expected="less than 2 pi between two outputs",
            fix=REDUCE,
        )
