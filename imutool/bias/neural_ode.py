"""Neural ODE of the bias dynamics, learned from poses: db/dt = f(b, u, du/dt).

The paper writes db_g/dt = f_g(b_g, gyro, dgyro/dt; theta) with one network (eq. 10, 31), and likewise for accel. Trained that
way the network forgets its state within two samples and is valid for one step size only. Here the field has two parts whose
time scales differ by four orders of magnitude::

    db/dt = dC(u)/dt + g(b - C(u), u, du/dt)

*C*, the curve, is the part that the motion adds: scale, misalignment, curvature. Its term generalizes the paper's term for a
linear sensor, (I - A^{-1}) du/dt (after eq. 31), to any smooth sensor. As a total derivative it integrates to C exactly, with
every solver and step. C also depends on the samples filtered over 0.1 s (ds/dt = (u - s) / tau, solved exactly), for sensors
whose error lags their motion. *g*, the drift, moves the rest bias beta = b - C, the turn-on bias of a run; its scale makes it
slow. It is a residual perceptron of the paper's size. torchdiffeq integrates it along a causal Hermite path through the
samples filtered over half a second, so the step of the solver changes the solution only by its own error. So
b(t) = beta(t) + C(t).
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, TypeVar

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn
from torchdiffeq import odeint, odeint_adjoint

from imutool.bias import joint_ode
from imutool.bias.joint_ode import JointField
from imutool.bias.model import COLUMNS, BiasModel, SampleStream, Segment, Vector6
from imutool.bias.neural_stream import Array, Curves, CurveWeights, DriftRate, NeuralStream, perceptron
from imutool.bias.ode import HermitePath
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.units import SENSORS, Sensor

SLOW_S, DRIFT_FILTER_S = 0.1, 0.5  # filter time constants of the inputs of curve and drift
NEAR_ZERO = 10.0
GYRO_HIDDEN = (128, 128), (512,)  # of both residual blocks, as in the released networks
NEGLIGIBLE = 1e-15

Positive = Annotated[float, msgspec.Meta(gt=0)]
Width = Annotated[int, msgspec.Meta(ge=1, le=4096)]


class Config(Settings, frozen=True):
    """Scheme, sizes, solver, sensors with a drift; scales are units, not limits.

    By default the accelerometer's rest bias does not drift. Attitude errors limit its training windows to five seconds, and a
    drift of a hundredth in five seconds is far off after a minute (0.3 m/s² on FETCH).
    """

    scheme: Literal["split", "joint"] | msgspec.UnsetType = msgspec.UNSET  # joint: the paper's (`joint_ode`)
    curve_width: Width = 64
    drift: tuple[Sensor, ...] = ("gyro",)
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
    """Curve C(u, s) = W u + curve (N(u, s) - N(0, 0)), zero without motion.

    Inputs of N: its arguments in units of the scale, and asinh(10 x) of them, which resolves small motion.
    """

    def __init__(self, width: int, scale: float, curve: float) -> None:
        super().__init__()
        self.scale, self.curve = scale, curve
        self.W = nn.Parameter(torch.zeros(3, 3))
        layers = nn.Linear(9, width), nn.Linear(width, width), nn.Linear(width, 3, bias=False)
        for layer in layers:
            nn.init.normal_(layer.weight, 0.0, layer.in_features**-0.5)
        nn.init.zeros_(layers[2].weight)
        self.net = nn.Sequential(layers[0], nn.GELU(), layers[1], nn.Tanh(), layers[2])

    def forward(self, u: Float[Tensor, "*batch 3"], slow: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Motion-dependent bias: `u` the samples, `slow` the filtered ones."""
        x, s = u / self.scale, slow / self.scale
        inputs = torch.cat([x, torch.asinh(NEAR_ZERO * x), torch.asinh(NEAR_ZERO * s)], dim=-1)
        bend: Tensor = self.net(inputs) - self.net(u.new_zeros(9))
        return u @ self.W.mT + self.curve * bend

    def weights(self) -> CurveWeights:
        """Curve weights for numpy."""
        first, second, last = (layer for layer in self.net if isinstance(layer, nn.Linear))
        return CurveWeights(self.W.detach().cpu().double().numpy(), (first, second, last), self.scale, NEAR_ZERO, self.curve)


class Drift(nn.Module):
    """Drift g, the slow rate of the rest bias: a perceptron of two residual blocks."""

    def __init__(self, hidden: tuple[tuple[int, ...], tuple[int, ...]], scale: float, curve: float, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.block1, self.block2 = _perceptron(hidden[0]), _perceptron(hidden[1])
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

    def numpy(self) -> DriftRate:
        """Drift in float64 numpy."""
        block1, block2, out = perceptron(self.block1), perceptron(self.block2), perceptron(self.out)
        centre, units = (x.detach().cpu().double().numpy() for x in (self.centre, self.units))

        def rate(beta: Array, u: Array, du: Array) -> Array:
            x = np.concatenate([beta - centre, u, du]) / units
            x = x + block1(x)
            return self.rate * out(x + block2(x))

        return rate


class Model(BiasModel):
    """Bias b(t) = beta(t) + C(u(t)), for gyro and accel separately.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", eq. 6, 10, 31 and spline.
    """

    method: ClassVar[str] = "neural_ode"
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        if chosen.adjoint and chosen.solver == "euler":
            raise ConfigError(
                "the adjoint of Euler's coarse steps has an error of Euler's order",
                where="model.adjoint",
                fix="Use model.solver=rk4 or dopri5 with it, or backpropagation",
            )
        if chosen.scheme == "joint" and "gyro" not in chosen.drift:
            raise ConfigError("the joint scheme without a drift of the gyro", where="model.drift", expected="gyro among them")
        super().__init__(chosen, rate_hz)
        c = chosen
        self.stride = max(1, round(c.drift_step_s * rate_hz))
        gyro = Curve(c.curve_width, c.gyro_scale_rad_s, c.gyro_curve_rad_s)
        accel = Curve(c.curve_width, c.accel_scale_m_s2, c.accel_curve_m_s2)
        self.curve = nn.ModuleDict({"gyro": gyro, "accel": accel})
        drifts: dict[str, nn.Module] = {
            "gyro": Drift(GYRO_HIDDEN, c.gyro_scale_rad_s, c.gyro_curve_rad_s, c.gyro_drift_rad_s2),
            "accel": Drift(((256, 512), (256, 256)), c.accel_scale_m_s2, c.accel_curve_m_s2, c.accel_drift_m_s3),
        }
        if self.joint:
            del self.curve["gyro"]
            drifts["gyro"] = JointField(drifts["gyro"])
            self.longest_window_s = joint_ode.WINDOW_S
        self.drift = nn.ModuleDict({sensor: drift for sensor, drift in drifts.items() if sensor in c.drift})

    @property
    def joint(self) -> bool:
        """Whether attitude and gyro bias are integrated together; the accelerometer keeps the split scheme."""
        return self.config.scheme == "joint"

    def _joint_start(self, segment: Segment) -> tuple[JointField, Float[Tensor, "b 3"]]:
        """Joint field, and bias at the first sample."""
        field = _part(self.drift, "gyro", JointField)
        return field, segment.rest[:, :3] + segment.gyro[:, 0] @ field.W.mT

    def end_attitude(
        self, R_start: Float[Tensor, "b 3 3"], segment: Segment, dt: Float[Tensor, "b steps"]
    ) -> Float[Tensor, "b 3 3"]:
        """Attitude at the last sample; in the joint scheme by the joint ODE on SO(3)."""
        if not self.joint:
            return super().end_attitude(R_start, segment, dt)
        field, start = self._joint_start(segment)
        return joint_ode.end_attitude(field, segment, start, R_start, self.config.solver, adjoint=self.config.adjoint)

    def sensor_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """Bias beta + C(u) at each sample; beta is linear between the steps of the drift."""
        if self.joint and sensor == "gyro":
            field, start = self._joint_start(segment)
            return joint_ode.bias_path(field, segment, start, self.config.solver, adjoint=self.config.adjoint)
        u, rest = segment.of(sensor)
        motion: Float[Tensor, "batch n 3"] = self.curve[sensor](u, self._filtered(u, SLOW_S))
        if sensor not in self.config.drift:
            return rest[:, None] + motion
        return self._rest_path(segment.t, u, rest, self.drift[sensor]) + motion

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the linear part of the curve, or of the joint field."""
        joint = self.joint and sensor == "gyro"
        with torch.no_grad():
            (_part(self.drift, sensor, JointField) if joint else _part(self.curve, sensor, Curve)).W.copy_(W)

    def _rest_path(
        self, t: Float[Tensor, "b n"], u: Float[Tensor, "b n 3"], rest: Float[Tensor, "b 3"], drift: nn.Module
    ) -> Float[Tensor, "b n 3"]:
        """beta at each sample; the ODE's time is the index on a grid of `stride` samples."""
        n, stride = u.shape[1], self.stride
        if n == 1:
            return rest[:, None]
        steps = math.ceil((n - 1) / stride)
        whole = (n - 1) // stride
        knots = self._filtered(u, DRIFT_FILTER_S)[:, : whole * stride + 1 : stride][:, :steps]
        path = HermitePath(torch.arange(steps + 1, device=u.device), torch.cat([knots, knots[:, -1:]], dim=1))
        step_s = ((t[:, -1] - t[:, 0]) / (n - 1) * stride)[:, None]

        beta = _solve(_OnGrid(drift, path, step_s), rest, steps, self.config.solver, self.config.adjoint)
        index = torch.arange(n, device=u.device) / stride
        j = index.long().clamp(max=steps - 1)
        return torch.lerp(beta[j], beta[j + 1], (index - j)[:, None, None].to(u)).transpose(0, 1)

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics d g / d beta per second, without motion, at the prior."""
        F = np.zeros((6, 6))
        still = self.prior_mean.new_zeros(1, 3)
        for sensor in self.config.drift:
            columns, drift = COLUMNS[sensor], self.drift[sensor]
            by_rest = torch.autograd.functional.jacobian(  # type: ignore[no-untyped-call]  # torch gives it no type
                lambda beta, g=drift: g(beta, still, still)[0], self.prior_mean[None, columns]
            )
            F[columns, columns] = by_rest[:, 0].detach().cpu().double().numpy()
        return F

    def _filtered(self, u: Float[Tensor, "b n 3"], tau_s: float) -> Float[Tensor, "b n 3"]:
        """Samples filtered by dy/dt = (u - y) / tau, in log2(n) passes (a scan of the recurrence)."""
        keep = math.exp(-1.0 / (self.rate_hz * tau_s))
        y = torch.cat([u[:, :1], (1.0 - keep) * u[:, 1:]], dim=1)
        shift = 1
        while shift < u.shape[1] and keep > NEGLIGIBLE:
            y = torch.cat([y[:, :shift], y[:, shift:] + keep * y[:, :-shift]], dim=1)
            shift, keep = 2 * shift, keep * keep
        return y

    def stream(self, rest: Vector6) -> SampleStream:
        """Bias stream in numpy by Euler: a step every `stride` samples, or every sample in the joint scheme."""
        if self.joint:
            return self._joint_stream(rest)
        gyro, accel = (_part(self.curve, sensor, Curve).weights() for sensor in SENSORS)
        drifts = {sensor: _part(self.drift, sensor, Drift).numpy() for sensor in self.config.drift}
        return NeuralStream(Curves(gyro, accel), drifts, self.stride, self.rate_hz, (SLOW_S, DRIFT_FILTER_S), rest)

    def _joint_stream(self, rest: Vector6) -> SampleStream:
        field, accel = _part(self.drift, "gyro", JointField), _part(self.curve, "accel", Curve)
        without_motion = Curve(self.config.curve_width, 1.0, 0.0)  # of the gyro, whose calibration the joint field holds
        curves = Curves(without_motion.double().weights(), accel.weights())
        others: tuple[Sensor, ...] = tuple(sensor for sensor in self.config.drift if sensor != "gyro")
        drifts = {sensor: _part(self.drift, sensor, Drift).numpy() for sensor in others}
        own = NeuralStream(curves, drifts, self.stride, self.rate_hz, (SLOW_S, DRIFT_FILTER_S), rest)
        rate = _part(field, "drift", Drift).numpy()
        return joint_ode.JointStream(rate, field.W.detach().cpu().double().numpy(), rest, own)


class _OnGrid(nn.Module):
    """Drift as a field for torchdiffeq: time is the grid's index, the path gives the controls."""

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


P = TypeVar("P", bound=nn.Module)


def _part(parts: nn.Module, name: str, kind: type[P]) -> P:
    part = parts.get_submodule(name)
    assert isinstance(part, kind)
    return part


def _perceptron(hidden: tuple[int, ...]) -> nn.Sequential:
    """Perceptron 9 -> hidden -> 9: GELU between hidden layers, tanh before the last."""
    layers: list[nn.Module] = []
    for i, (before, width) in enumerate(zip((9, *hidden), hidden, strict=False)):
        layers += [nn.Linear(before, width), nn.Tanh() if i == len(hidden) - 1 else nn.GELU()]
    return nn.Sequential(*layers, nn.Linear(hidden[-1], 9))
