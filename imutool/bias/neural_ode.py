"""Bias dynamics learned from poses alone: db/dt = f(b, u, du/dt), a neural ODE driven by the measured samples.

The paper writes db_g/dt = f_g(b_g, gyro, dgyro/dt; theta) with one network for everything (eq. 10, 31), and likewise for
accel. Trained that way the network forgets its state within two samples and holds for one step size only. Here the same field
is written in two parts whose time scales differ by four orders of magnitude::

    db/dt = dC(u)/dt + g(b - C(u), u, du/dt)

*C*, the curve, is what the motion adds at once: scale, misalignment, curvature. Its term is the one the paper derives
for a linear sensor, (I - A^{-1}) du/dt (after eq. 31), for any smooth sensor; being a total derivative it integrates to
C(u(t)) exactly, with every solver and step. *g*, the drift, moves the rest bias beta = b - C(u), the turn-on bias
that a run starts with, and is slow by its scale; it is a residual perceptron of the paper's size, integrated by torchdiffeq
along a causal Hermite path through means of the samples. So b(t) = beta(t) + C(u(t)).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint

from imutool.bias._base import COLUMNS, SENSORS, BiasModel, Segment, Sensor, Stream, Vector6
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.ode import HermitePath

Positive = Annotated[float, msgspec.Meta(gt=0)]
Width = Annotated[int, msgspec.Meta(ge=1, le=4096)]
Array = Float64[np.ndarray, "..."]


class Config(Settings, frozen=True):
    """Sizes and solver. The scales set where a unit of network input or output lies; they are not limits."""

    curve_width: Width = 64
    drift: bool = True
    drift_step_s: Positive = 0.25
    solver: Literal["euler", "rk4", "dopri5"] = "euler"
    adjoint: bool = False
    gyro_scale_rad_s: Positive = 0.2
    gyro_curve_rad_s: Positive = 0.02
    gyro_drift_rad_s2: Positive = 1e-4
    accel_scale_m_s2: Positive = 10.0
    accel_curve_m_s2: Positive = 0.2
    accel_drift_m_s3: Positive = 1e-3


class Curve(nn.Module):
    """C(u) = W u + curve (N(u / scale) - N(0)), zero without motion; N a perceptron that starts at zero."""

    def __init__(self, width: int, scale: float, curve: float) -> None:
        super().__init__()
        self.scale, self.curve = scale, curve
        self.W = nn.Parameter(torch.zeros(3, 3))
        self.net = nn.Sequential(
            nn.Linear(3, width), nn.GELU(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, 3, bias=False)
        )
        for layer in self.net:
            if isinstance(layer, nn.Linear):
                nn.init.normal_(layer.weight, 0.0, layer.in_features**-0.5)
        nn.init.zeros_(self.net[-1].weight)  # type: ignore[arg-type]  # Sequential is typed to hold any module

    def forward(self, u: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """What the motion `u` adds to the bias."""
        bend: Tensor = self.net(u / self.scale) - self.net(u.new_zeros(3))
        return u @ self.W.mT + self.curve * bend

    def numpy(self) -> Callable[[Array], Array]:
        """The same curve in float64 numpy."""
        W, net = _array(self.W), _numpy(self.net)
        at_rest = net(np.zeros(3))

        def curve(u: Array) -> Array:
            c: Array = u @ W.T + self.curve * (net(u / self.scale) - at_rest)
            return c

        return curve


class Drift(nn.Module):
    """g: the slow rate of the rest bias, a perceptron with two residual blocks (the released networks' sizes)."""

    def __init__(self, hidden: tuple[tuple[int, ...], tuple[int, ...]], scale: float, curve: float, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.block1, self.block2 = _perceptron(hidden[0]), _perceptron(hidden[1])
        self.out = nn.Linear(9, 3)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        # the state is seen from the prior's mean, in units of the curve; motion in its own
        self.centre: Tensor
        self.units: Tensor
        self.register_buffer("centre", torch.zeros(3))
        self.register_buffer("units", torch.tensor([curve] * 3 + [scale] * 6))

    def forward(self, beta: Float[Tensor, "b 3"], u: Float[Tensor, "b 3"], du: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        """dbeta/dt per second."""
        x = torch.cat([beta - self.centre, u, du], dim=-1) / self.units
        x = x + self.block1(x)
        x = x + self.block2(x)
        y: Tensor = self.rate * self.out(x)
        return y

    def numpy(self) -> Callable[[Array, Array, Array], Array]:
        """The same rate in float64 numpy."""
        block1, block2, out = _numpy(self.block1), _numpy(self.block2), _numpy(self.out)
        centre, units = _array(self.centre), _array(self.units)

        def rate(beta: Array, u: Array, du: Array) -> Array:
            x = np.concatenate([beta - centre, u, du]) / units
            x = x + block1(x)
            y: Array = self.rate * out(x + block2(x))
            return y

        return rate


class Model(BiasModel):
    """b(t) = beta(t) + C(u(t)) for gyro and accel apart; see the module's head.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", eq. 6, 10, 31 and spline.
    """

    method: ClassVar[str] = "neural_ode"
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        if chosen.adjoint and chosen.solver == "euler":
            raise ConfigError(
                "the adjoint of Euler's coarse steps is off by its own order of error",
                where="model.adjoint",
                fix="Use model.solver=rk4 or dopri5 with it, or backpropagation",
            )
        super().__init__(chosen, rate_hz)
        c = chosen
        self.stride = max(1, round(c.drift_step_s * rate_hz))
        self.curve = nn.ModuleDict(
            {
                "gyro": Curve(c.curve_width, c.gyro_scale_rad_s, c.gyro_curve_rad_s),
                "accel": Curve(c.curve_width, c.accel_scale_m_s2, c.accel_curve_m_s2),
            }
        )
        self.drift = nn.ModuleDict(
            {
                "gyro": Drift(((128, 128), (512,)), c.gyro_scale_rad_s, c.gyro_curve_rad_s, c.gyro_drift_rad_s2),
                "accel": Drift(((256, 512), (256, 256)), c.accel_scale_m_s2, c.accel_curve_m_s2, c.accel_drift_m_s3),
            }
        )

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """beta + C(u) at each sample; beta goes on straight between the drift's steps."""
        u, rest = segment.of(sensor)
        motion: Float[Tensor, "batch n 3"] = self.curve[sensor](u)
        if not self.config.drift:
            return rest[:, None] + motion
        return self._rest_path(segment.t, u, rest, self.drift[sensor]) + motion

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """The linear part of the curve."""
        with torch.no_grad():
            _part(self.curve, sensor, Curve).W.copy_(W)

    def _rest_path(
        self, t: Float[Tensor, "b n"], u: Float[Tensor, "b n 3"], rest: Float[Tensor, "b 3"], drift: nn.Module
    ) -> Float[Tensor, "b n 3"]:
        """beta at each sample: the ODE is solved on a grid of `stride` samples, whose index is its time."""
        n, stride = u.shape[1], self.stride
        if n == 1:
            return rest[:, None]
        steps = math.ceil((n - 1) / stride)
        whole = (n - 1) // stride
        means = u[:, 1 : 1 + whole * stride].reshape(len(u), whole, stride, 3).mean(2)
        means = torch.cat([u[:, :1], means], dim=1)[:, :steps]
        path = HermitePath(torch.arange(steps + 1, device=u.device), torch.cat([means, means[:, -1:]], dim=1))
        step_s = ((t[:, -1] - t[:, 0]) / (n - 1) * stride)[:, None]

        beta = _solve(_OnGrid(drift, path, step_s), rest, steps, self.config.solver, self.config.adjoint)
        place = torch.arange(n, device=u.device) / stride
        j = place.long().clamp(max=steps - 1)
        return torch.lerp(beta[j], beta[j + 1], (place - j)[:, None, None].to(u)).transpose(0, 1)

    def stream(self, rest: Vector6) -> Stream:
        """The same in numpy, one Euler step of the drift every `stride` samples."""
        curves = tuple(_part(self.curve, sensor, Curve).numpy() for sensor in SENSORS)
        drifts = tuple(_part(self.drift, sensor, Drift).numpy() for sensor in SENSORS) if self.config.drift else None
        return _Stream(curves, drifts, self.stride, rest)


class _OnGrid(nn.Module):
    """The drift as torchdiffeq wants it: time is the grid's index, controls come from the path."""

    def __init__(self, drift: nn.Module, path: HermitePath, step_s: Float[Tensor, "b 1"]) -> None:
        super().__init__()
        self.drift, self.path, self.step_s = drift, path, step_s

    def forward(self, index: Float[Tensor, ""], beta: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        u, du = self.path.value(index), self.path.derivative(index) / self.step_s
        rate: Tensor = self.drift(beta, u, du)
        return self.step_s * rate


def _solve(field: nn.Module, rest: Float[Tensor, "b 3"], steps: int, solver: str, adjoint: bool) -> Float[Tensor, "m b 3"]:
    grid = torch.arange(steps + 1, device=rest.device, dtype=rest.dtype)
    solved: Tensor = (odeint_adjoint if adjoint else odeint)(field, rest, grid, method=solver, rtol=1e-6, atol=1e-9)
    return solved


class _Stream:
    """Remembers the rest bias, its rate, and the running sum of samples since the last step of the drift."""

    def __init__(
        self,
        curves: tuple[Callable[[Array], Array], ...],
        drifts: tuple[Callable[[Array, Array, Array], Array], ...] | None,
        stride: int,
        rest: Vector6,
    ) -> None:
        self.curves, self.drifts, self.stride = curves, drifts, stride
        self.beta, self.rate = rest.astype(np.float64), np.zeros(6)
        self.mean, self.sum, self.count = np.zeros(6), np.zeros(6), -1  # -1: nothing seen yet
        self.t_step = 0.0

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        motion = np.concatenate([self.curves[0](gyro), self.curves[1](accel)], axis=1)
        if self.drifts is None or not len(t_s):
            motion += self.beta
            return motion
        u, rest, k = np.concatenate([gyro, accel], axis=1), np.empty_like(motion), 0
        if self.count < 0:
            self._start(t_s[0], u[0])
            rest[0], k = self.beta, 1
        while k < len(t_s):
            last = min(len(t_s), k + self.stride - self.count)
            rest[k:last] = self.beta + (t_s[k:last, None] - self.t_step) * self.rate
            self.sum += u[k:last].sum(axis=0)
            self.count += last - k
            if self.count == self.stride:
                self._step(t_s[last - 1], rest[last - 1])
            k = last
        rest += motion
        return rest

    def _start(self, t: float, u: Array) -> None:
        self.t_step, self.mean, self.count = t, u, 0
        self._set_rate(u, np.zeros(6))

    def _step(self, t: float, beta: Array) -> None:
        mean = self.sum / self.stride
        du = (mean - self.mean) / max(t - self.t_step, 1e-9)
        self.t_step, self.beta, self.mean = t, beta.copy(), mean
        self.sum, self.count = np.zeros(6), 0
        self._set_rate(mean, du)

    def _set_rate(self, u: Array, du: Array) -> None:
        assert self.drifts is not None
        halves = zip(self.drifts, COLUMNS.values(), strict=True)
        self.rate = np.concatenate([g(self.beta[half], u[half], du[half]) for g, half in halves])


P = TypeVar("P", bound=nn.Module)


def _part(parts: nn.ModuleDict, sensor: Sensor, kind: type[P]) -> P:
    """One sensor's part, with its type (a ModuleDict only knows modules)."""
    part = parts[sensor]
    assert isinstance(part, kind)
    return part


def _perceptron(hidden: tuple[int, ...]) -> nn.Sequential:
    """9 -> hidden -> 9, GELU between hidden layers and tanh before the last."""
    layers: list[nn.Module] = []
    before = 9
    for i, width in enumerate(hidden):
        layers += [nn.Linear(before, width), nn.Tanh() if i == len(hidden) - 1 else nn.GELU()]
        before = width
    return nn.Sequential(*layers, nn.Linear(before, 9))


def _array(tensor: Tensor) -> Array:
    out: Array = tensor.detach().cpu().double().numpy()
    return out


def _numpy(module: nn.Module) -> Callable[[Array], Array]:
    """A perceptron as a numpy function: torch's overhead for one sample is twenty times its arithmetic."""
    from scipy.special import erf

    steps: list[Callable[[Array], Array]] = []
    for layer in module if isinstance(module, nn.Sequential) else [module]:
        if isinstance(layer, nn.Linear):
            W, b = _array(layer.weight).T.copy(), 0.0 if layer.bias is None else _array(layer.bias)
            steps.append(lambda x, W=W, b=b: x @ W + b)  # type: ignore[misc]  # the defaults bind this layer
        elif isinstance(layer, nn.Tanh):
            steps.append(np.tanh)
        else:
            assert isinstance(layer, nn.GELU)
            steps.append(lambda x: 0.5 * x * (1.0 + erf(x * math.sqrt(0.5))))

    def run(x: Array) -> Array:
        for step in steps:
            x = step(x)
        return x

    return run
