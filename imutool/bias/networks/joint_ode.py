"""Joint ODE of attitude and gyro bias on SO(3): the paper's own scheme of the neural ODE.

One vector field drives attitude and bias together (paper, eq. 3, 10, 15 and 31)::

    dR/dt = R [u(t) - b]x,    db/dt = W du/dt + f(b, u, du/dt),    b(0) = rest + W u(0)

with u(t) the causal Hermite path through the gyro samples and f the residual perceptron of the paper's size. W du/dt is the
term that the paper derives for a linear sensor (after eq. 31); it carries the calibration that was solved in closed form.
Training integrates both states from sample to sample with the chosen solver in charts of SO(3)
(`imutool.bias.networks.ode.integrate`), and its loss is the attitude error at the end of a window (eq. 16). f does not
depend on R: inference integrates only the bias, by Euler, which is the solver of the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint

from imutool.array_types import Float
from imutool.bias.networks.network import Segment
from imutool.bias.networks.ode import HermitePath, Method, integrate

WINDOW_S = 1.0  # longest training window: with a solver step at every sample, a longer one costs minutes


class JointField(nn.Module):
    """Vector field db/dt = W du/dt + f(b, u, du/dt), with f the perceptron `drift`."""

    def __init__(self, drift: nn.Module) -> None:
        super().__init__()
        self.drift, self.W = drift, nn.Parameter(torch.zeros(3, 3))

    def forward(self, bias: Float[Tensor, "b 3"], u: Float[Tensor, "b 3"], du: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Bias rate db/dt per second."""
        rate: Tensor = du @ self.W.mT + self.drift(bias, u, du)
        return rate


class JointPath(nn.Module):
    """Joint vector field over the samples of some windows.

    Time is the index of a sample, for all windows alike.
    """

    def __init__(self, field: nn.Module, segment: Segment) -> None:
        super().__init__()
        u, n = segment.gyro, segment.gyro.shape[1]
        self.field = field
        self.path = HermitePath(torch.arange(n, device=u.device, dtype=u.dtype), u)
        self.step_s = ((segment.t[:, -1] - segment.t[:, 0]) / (n - 1))[:, None]
        self.grid = self.path.t

    def controls(self, index: Float[Tensor, ""]) -> tuple[Float[Tensor, "b 3"], Float[Tensor, "b 3"]]:
        """Controls u and du/dt (per second)."""
        return self.path.value(index), self.path.derivative(index) / self.step_s

    def forward(self, index: Float[Tensor, ""], bias: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """Bias rate db / d(index)."""
        rate: Tensor = self.field(bias, *self.controls(index))
        return self.step_s * rate


class _JointField(nn.Module):
    """(omega_b, db/dt) per step, as `integrate` takes them."""

    def __init__(self, joint: JointPath) -> None:
        super().__init__()
        self.joint = joint

    def forward(self, index: Tensor, R_wb: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        u, du = self.joint.controls(index)
        step_s = self.joint.step_s
        return step_s * (u - bias), step_s * self.joint.field(bias, u, du)


def bias_path(
    field: nn.Module, segment: Segment, start: Float[Tensor, "b 3"], solver: Method, *, adjoint: bool
) -> Float[Tensor, "b n 3"]:
    """Bias at each sample, integrated from `start` at the first."""
    if segment.gyro.shape[1] == 1:
        return start[:, None]
    joint = JointPath(field, segment)
    solved: Tensor = (odeint_adjoint if adjoint else odeint)(joint, start, joint.grid, method=solver, rtol=1e-6, atol=1e-9)
    return solved.transpose(0, 1)


def end_attitude(
    field: nn.Module,
    segment: Segment,
    start: Float[Tensor, "b 3"],
    R_start: Float[Tensor, "b 3 3"],
    solver: Method,
    *,
    adjoint: bool,
) -> Float[Tensor, "b 3 3"]:
    """Attitude at the last sample: attitude and bias integrated together on SO(3)."""
    joint = JointPath(field, segment)
    rotations, _ = integrate(_JointField(joint), start, joint.grid, R_start, method=solver, adjoint=adjoint)
    return rotations[-1]
