"""Network of the neural ODE, integrated by torchdiffeq (`imutool.bias.neural_ode`).

The drift is integrated along a causal Hermite path through the samples filtered over half a second, so the step of the solver
changes the solution only by its own error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from imutool.array_types import Float, Int
from imutool.bias.networks.network import BiasNetwork, LastLayer, Segment
from imutool.bias.networks.ode import HermitePath, solve
from imutool.bias.networks.paper_ode import BiasOde
from imutool.bias.networks.perceptron import Drift, asinh, by_rows
from imutool.bias.neural_ode import DRIFT_FILTER_S, HIDDEN, NEAR_ZERO, SLOW_S, Config, Model
from imutool.config import Settings
from imutool.errors import NumericsError
from imutool.units import SENSORS, Sensor

NEGLIGIBLE = 1e-15
DRAWN = 512  # units of a layer of which a training keeps some
ROWS = 4_096  # samples at which they are compared
TINY = 1e-12  # share of the largest pivot below which a unit follows from others
PAPER_WEIGHTS = 1e-3  # standard deviation at the start, as in the released code


class Curve(nn.Module):
    """Curve C(u, s) = W u + curve (N(u, s) - N(0, 0)), zero without motion.

    Inputs of N: its arguments in units of the scale, and asinh(10 x) of them, which resolves small motion.
    """

    def __init__(self, width: int, scale: float, curve: float) -> None:
        super().__init__()
        self.scale, self.curve, self.precision = scale, curve, torch.float64  # of N, whatever that of its weights
        self.W = nn.Parameter(torch.zeros(3, 3))
        layers = nn.Linear(9, width), nn.Linear(width, width), nn.Linear(width, 3, bias=False)
        for layer in layers:
            nn.init.normal_(layer.weight, 0.0, layer.in_features**-0.5)
        nn.init.zeros_(layers[2].weight)
        self.net = nn.Sequential(layers[0], nn.GELU(), layers[1], nn.Tanh(), layers[2])
        self.prior_root = width**-0.5 * torch.eye(width, dtype=torch.float64)
        self.requires_grad_(False)  # the layers below stay as drawn, W and the last one are solved for in closed form

    @torch.no_grad()
    def keep_spanning(self, u: Float[Tensor, "n 3"], slow: Float[Tensor, "n 3"]) -> None:
        """Draw wide hidden layers, and keep the units from which a linear map nearly gives all others at some samples.

        So the curve hardly depends on the draw, and its prior is that of all units.

        Raises:
            NumericsError: samples that are too large.
        """
        some = slice(None, None, -(-len(u) // ROWS))
        seen = self._inputs(u[some], slow[some], torch.float64).cpu()
        x = torch.cat([seen.new_zeros(1, 9), seen])  # the first row is no motion
        if not bool(x.isfinite().all()):
            raise NumericsError(
                "samples overflow as inputs of the curve",
                where="neural ODE",
                expected="rates (gyro, rad/s) and forces (accel, m/s²) of a sensor",
                fix="Look for absurd values in the logs with imutool info",
            )
        first, second = _part(self.net, "0", nn.Linear), _part(self.net, "2", nn.Linear)
        width = max(DRAWN, len(self.prior_root))
        wide_first, wide_second = nn.Linear(9, width).to(x), nn.Linear(width, width).to(x)
        for layer in (wide_first, wide_second):
            nn.init.normal_(layer.weight, 0.0, layer.in_features**-0.5)
        bent = nn.functional.gelu(wide_first(x))
        kept, by_kept = _spanning(bent - bent[0], bent - bent[0], first.out_features)
        first.weight.copy_(wide_first.weight[kept])
        first.bias.copy_(wide_first.bias[kept])
        weight = wide_second.weight @ by_kept.mT
        bias = wide_second.bias + wide_second.weight @ bent[0] - weight @ bent[0, kept]
        units, all_units = torch.tanh(bent[:, kept] @ weight.mT + bias), torch.tanh(wide_second(bent))
        kept, by_kept = _spanning(units - units[0], all_units - all_units[0], second.out_features)
        second.weight.copy_(weight[kept])
        second.bias.copy_(bias[kept])
        self.prior_root = torch.linalg.qr(width**-0.5 * by_kept.mT).R.mT

    def forward(self, u: Float[Tensor, "*batch 3"], slow: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Motion-dependent bias: `u` the samples, `slow` the filtered ones."""
        inputs = self._inputs(u, slow, self.precision)
        bend = by_rows(self.net, inputs) - by_rows(self.net, inputs.new_zeros(9))
        return u @ self.W.mT + self.curve * bend.to(u)

    def hidden(self, u: Float[Tensor, "*batch 3"], slow: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch width"]:
        """Inputs of the last layer, zero without motion, in the unit of the curve."""
        below, inputs = self.net[:-1], self._inputs(u, slow, u.dtype)
        units: Tensor = below(inputs) - below(inputs.new_zeros(9))
        return self.curve * units

    def _inputs(self, u: Tensor, slow: Tensor, precision: torch.dtype) -> Float[Tensor, "*batch 9"]:
        x, s = u.to(precision) / self.scale, slow.to(precision) / self.scale
        return torch.cat([x, asinh(NEAR_ZERO * torch.cat([x, s], dim=-1))], dim=-1)


class Network(BiasNetwork):
    """Network of `imutool.bias.neural_ode`."""

    method: ClassVar[str] = Model.method
    config: Config

    def __init__(self, config: Settings | None = None, rate_hz: float = 200.0) -> None:
        chosen = config or Config()
        assert isinstance(chosen, Config)
        Model.shapes(chosen)  # refuses settings that do not fit each other
        super().__init__(chosen, rate_hz)
        self.stride = chosen.stride(rate_hz)
        if chosen.loads:
            self.take_loads(chosen.loads, torch.zeros(Model.shapes(chosen)["theta_loads"]))
        scales = {sensor: chosen.units(sensor) for sensor in SENSORS}
        curves: dict[str, nn.Module] = {
            sensor: Curve(chosen.curve_width, scale, curve) for sensor, (scale, curve, _) in scales.items()
        }
        drifts = {sensor: Drift(HIDDEN[sensor], *scales[sensor]) for sensor in SENSORS}
        if chosen.paper:
            curves, self.forgets = {}, True
            for layer in (layer for drift in drifts.values() for layer in drift.modules() if isinstance(layer, nn.Linear)):
                nn.init.normal_(layer.weight, 0.0, PAPER_WEIGHTS)
                nn.init.zeros_(layer.bias)
        self.curve = nn.ModuleDict(curves)
        self.drift = nn.ModuleDict({sensor: drift for sensor, drift in drifts.items() if sensor in chosen.drifting})

    def see(self, gyro: Float[Tensor, "n 3"], accel: Float[Tensor, "n 3"]) -> None:
        """Choose the units of N, and compute it in float32 from now on, which takes two fifths of the time."""
        for sensor, u in zip(self.curve, (gyro, accel), strict=not self.config.paper):
            curve = _part(self.curve, sensor, Curve)
            curve.keep_spanning(u, self._filtered(u[None], SLOW_S)[0])
            curve.precision = torch.float32

    def take_loads(self, names: Sequence[str], theta: Float[Tensor, " p"]) -> None:
        """Take over a drift behind the load, fitted before; the samples of the training are corrected for it."""
        self.config = msgspec.structs.replace(self.config, loads=tuple(names))
        self.register_buffer("theta_loads", theta.clone())

    def paper_ode(
        self, sensor: Sensor, t: Float[Tensor, "b n"], u: Float[Tensor, "b n 3"], before: Float[Tensor, "b 3"] | None = None
    ) -> BiasOde:
        """ODE of the paper's scheme along some samples; `before` is the sample before the first."""
        return BiasOde(_part(self.drift, sensor, Drift), t, u, before)

    def motion_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """C(u) at each sample; the paper's scheme has no such part."""
        u, _ = segment.of(sensor)
        if self.config.paper:
            return torch.zeros_like(u)
        curve = _part(self.curve, sensor, Curve)
        if _skipped(curve.net[-1]):
            return u @ curve.W.mT
        motion: Float[Tensor, "batch n 3"] = curve(u, self._filtered(u, SLOW_S))
        return motion

    def last_layer(self, sensor: Sensor) -> LastLayer | None:
        """Last layer of the curve; the paper's scheme has none."""
        if self.config.paper:
            return None
        curve = _part(self.curve, sensor, Curve)
        last = _part(curve.net, "4", nn.Linear)

        def inputs(segment: Segment) -> Float[Tensor, "batch n width"]:
            u, _ = segment.of(sensor)
            return curve.hidden(u, self._filtered(u, SLOW_S))

        return LastLayer(curve.W, last.weight, inputs, curve.prior_root)

    def rest_bias(self, sensor: Sensor, segment: Segment) -> Float[Tensor, "batch n 3"]:
        """beta at each sample, linear between the steps of the drift; in the paper's scheme the whole bias."""
        u, rest = segment.of(sensor)
        if self.config.paper:
            return self.paper_ode(sensor, segment.t, u).bias(rest, self.config.solver, adjoint=self.config.adjoint)
        if sensor not in self.config.drift or _skipped(_part(self.drift, sensor, Drift).out):
            return super().rest_bias(sensor, segment)
        return self._rest_path(segment.t, u, rest, _part(self.drift, sensor, Drift))

    def begin_at(self, sensor: Sensor, W: Float[Tensor, "3 3"]) -> None:
        """Set the linear part of the curve."""
        with torch.no_grad():
            _part(self.curve, sensor, Curve).W.copy_(W)

    def _rest_path(
        self, t: Float[Tensor, "b n"], u: Float[Tensor, "b n 3"], rest: Float[Tensor, "b 3"], drift: Drift
    ) -> Float[Tensor, "b n 3"]:
        """beta at each sample; the ODE's time is the index on a grid of `stride` samples."""
        n, stride = u.shape[1], self.stride
        if n == 1:
            return rest[:, None]
        steps = math.ceil((n - 1) / stride)
        whole = (n - 1) // stride
        knots = self._filtered(u, DRIFT_FILTER_S)[:, : whole * stride + 1 : stride][:, :steps]
        step_s = ((t[:, -1] - t[:, 0]) / (n - 1) * stride)[:, None]
        if self.config.solver == "euler":
            beta = drift.euler(knots, knots[:, 0], step_s, rest)
        else:
            path = HermitePath(torch.arange(steps + 1, device=u.device), torch.cat([knots, knots[:, -1:]], dim=1))
            grid = torch.arange(steps + 1, device=rest.device, dtype=rest.dtype)
            beta = solve(_OnGrid(drift, path, step_s), rest, grid, self.config.solver, adjoint=self.config.adjoint)
        index = torch.arange(n, device=u.device) / stride
        j = index.long().clamp(max=steps - 1)
        return torch.lerp(beta[j], beta[j + 1], (index - j)[:, None, None].to(u)).transpose(0, 1)

    def _filtered(self, u: Float[Tensor, "b n 3"], tau_s: float) -> Float[Tensor, "b n 3"]:
        """Samples filtered by dy/dt = (u - y) / tau, in log2(n) passes (a scan of the recurrence)."""
        keep = math.exp(-1.0 / (self.rate_hz * tau_s))
        y = torch.cat([u[:, :1], (1.0 - keep) * u[:, 1:]], dim=1)
        shift = 1
        while shift < u.shape[1] and keep > NEGLIGIBLE:
            y = torch.cat([y[:, :shift], y[:, shift:] + keep * y[:, :-shift]], dim=1)
            shift, keep = 2 * shift, keep * keep
        return y


class _OnGrid(nn.Module):
    """Drift as a field for torchdiffeq: time is the grid's index, the path gives the controls."""

    def __init__(self, drift: nn.Module, path: HermitePath, step_s: Float[Tensor, "b 1"]) -> None:
        super().__init__()
        self.drift, self.path, self.step_s = drift, path, step_s

    def forward(self, index: Float[Tensor, ""], beta: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3"]:
        u, du = self.path.value(index), self.path.derivative(index) / self.step_s
        rate: Tensor = self.drift(beta, u, du)
        return self.step_s * rate


def _spanning(
    units: Float[Tensor, "n k"], wanted: Float[Tensor, "n m"], number: int
) -> tuple[Int[Tensor, " number"], Float[Tensor, "number m"]]:
    """Columns of `units` that span them, by pivots, and the coefficients with which they come nearest to `wanted`.

    PyTorch's least squares have other last digits from call to call, scipy's factors do not.
    """
    from scipy.linalg import qr, solve_triangular  # a network that is only drawn needs no scipy

    columns = units.numpy()
    kept = np.sort(qr(columns, mode="r", pivoting=True)[1][:number])
    Q, R, order = qr(columns[:, kept], mode="economic", pivoting=True)
    rank = int((np.abs(R.diagonal()) > TINY * np.abs(R[0, 0])).sum())
    coefficients = np.zeros((number, wanted.shape[1]))
    if rank:
        coefficients[order[:rank]] = solve_triangular(R[:rank, :rank], Q[:, :rank].T @ wanted.numpy())
    return torch.from_numpy(kept).long(), torch.from_numpy(coefficients)


def _skipped(last: nn.Module) -> bool:
    """Whether a network need not run: its last layer is zero, as before its descent, and no derivative is asked for."""
    return not torch.is_grad_enabled() and not any(bool(weight.any()) for weight in last.parameters())


P = TypeVar("P", bound=nn.Module)


def _part(parts: nn.Module, name: str, kind: type[P]) -> P:
    part = parts.get_submodule(name)
    assert isinstance(part, kind)
    return part
