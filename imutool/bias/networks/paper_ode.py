"""ODE of attitude and bias as the paper writes it: the scheme `paper` of the neural ODE.

One vector field a sensor (paper, eq. 10, 15 and 31), with u(t) the causal Hermite path through the samples::

    dR/dt = R [u - b]x,    db/dt = f(b, u, du/dt),    b(0) given

f is a perceptron with residual connections, of the size of the released one; none of its inputs is scaled. The solver steps
from sample to sample, and attitudes are integrated in charts of SO(3) (`imutool.bias.networks.ode.integrate`). f does not
depend on R: Euler's steps, the paper's solver, give the bias before the attitude.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from imutool.array_types import Float
from imutool.bias.networks.ode import HermitePath, Method, integrate, solve
from imutool.bias.networks.perceptron import Drift

Samples = Float[Tensor, "b n 3"]
Start = Float[Tensor, "b 3"]


class BiasOde(nn.Module):
    """ODE of the bias along the samples of some windows.

    Time is the index of a sample, for all windows alike. `before` is the sample before the first one, which gives the path its
    first slope; without it that is zero. The field computes in the precision of its weights.
    """

    def __init__(self, drift: Drift, t: Float[Tensor, "b n"], u: Samples, before: Start | None = None) -> None:
        super().__init__()
        self.drift, self.u = drift, u
        self.step_s = ((t[:, -1] - t[:, 0]) / max(1, u.shape[1] - 1))[:, None]
        self.before = u[:, 0] if before is None else before
        knots = torch.cat([self.before[:, None], u], dim=1)
        self.path = HermitePath(torch.arange(-1, u.shape[1], device=u.device, dtype=u.dtype), knots)
        self.grid = self.path.t[1:]

    def controls(self, index: Float[Tensor, ""]) -> tuple[Start, Start]:
        """Controls u and du/dt (per second)."""
        return self.path.value(index), self.path.derivative(index) / self.step_s

    def forward(self, index: Float[Tensor, ""], bias: Start) -> Start:
        """Bias rate db / d(index)."""
        rate: Tensor = self.drift(*(x.to(self.drift.units) for x in (bias, *self.controls(index))))
        return self.step_s * rate.to(bias)

    def bias(self, start: Start, solver: Method, *, adjoint: bool) -> Samples:
        """Bias at each sample, integrated from `start` at the first."""
        if len(self.grid) == 1:
            return start[:, None]
        if solver == "euler":
            known = (x.to(self.drift.units) for x in (self.u[:, :-1], self.before, self.step_s, start))
            return self.drift.euler(*known).to(start).transpose(0, 1)
        return solve(self, start, self.grid, solver, adjoint=adjoint).transpose(0, 1)

    def attitudes(
        self, start: Start, R_start: Float[Tensor, "b 3 3"], solver: Method, *, adjoint: bool
    ) -> Float[Tensor, "n b 3 3"]:
        """Attitude at each sample: attitude and the gyro's bias integrated together on SO(3)."""
        if solver == "euler":
            turns = (self.step_s[:, None] * (self.u - self.bias(start, solver, adjoint=adjoint))).unbind(1)
            known = integrate(lambda index, _, none: (turns[round(float(index))], none), start[:, :0], self.grid, R_start)
            return known[0]
        rotations, _ = integrate(_Joint(self), start, self.grid, R_start, method=solver, adjoint=adjoint)
        return rotations


class _Joint(nn.Module):
    """(omega_b, db/dt) per step, as `integrate` takes them."""

    def __init__(self, ode: BiasOde) -> None:
        super().__init__()
        self.ode = ode

    def forward(self, index: Tensor, R_wb: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        u, _ = self.ode.controls(index)
        return self.ode.step_s * (u - bias), self.ode(index, bias)
