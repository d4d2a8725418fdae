"""Neural ODE of the bias dynamics, learned from poses: db/dt = f(b, u, du/dt).

The paper writes db_g/dt = f_g(b_g, gyro, dgyro/dt; theta) with one network (eq. 10, 31), and likewise for accel. Trained that
way the network forgets its state within two samples and is valid for one step size only. Here the field has two parts whose
time scales differ by four orders of magnitude::

    db/dt = dC(u)/dt + g(b - C(u), u, du/dt)

*C*, the curve, is the part that the motion adds: scale, misalignment, curvature. Its term generalizes the paper's term for a
linear sensor, (I - A^{-1}) du/dt (after eq. 31), to any smooth sensor. As a total derivative it integrates to C exactly, with
every solver and step. Its hidden layers are drawn: of many units those stay from which a linear map nearly gives the others
at the samples, so that another draw hardly changes the model. What follows them is least squares
(`imutool.training.calibration.last_layer`). C also depends on the samples filtered over 0.1 s (ds/dt = (u - s) / tau, solved
exactly), for sensors whose error lags their motion. *g*, the drift, moves the rest bias beta = b - C, the turn-on bias of a
run; its scale makes it slow. It is a residual perceptron of the paper's size, integrated along the samples filtered over half a
second, so the step of the solver changes the solution only by its own error. So b(t) = beta(t) + C(t).

A drift that lags behind what warms or strains the sensor (`gyro_rate_load` and others of `imutool.sensor.effects`) has its own
states, dz/dt = (g(u) - z) / tau: of the rest bias alone a field cannot tell what stays from what decays. They are fitted in
closed form, where left-out logs bear them out, and C and g see the samples without them.

The scheme `paper` is the paper's own: one field f(b, u, du/dt) a sensor, in rad/s and m/s², with a step at each sample.

Inference takes Euler steps of `drift_step_s`; `imutool.bias.networks.neural_ode` trains with any solver of torchdiffeq.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.effects_stream import EffectsStream
from imutool.bias.model import Array, BiasModel, DriftStream, Shapes, Vector6
from imutool.bias.neural_stream import HALF_ROOT, Curves, CurveWeights, NeuralStream, erf, gelu
from imutool.bias.temperature import columns_of, forms, samples_alone
from imutool.config import Settings
from imutool.errors import ConfigError
from imutool.sensor.linear_form import compiled
from imutool.units import COLUMNS, SENSORS, Sensor

SLOW_S, DRIFT_FILTER_S = 0.1, 0.5  # filter time constants of the inputs of curve and drift
NEAR_ZERO = 10.0
HIDDEN = {"gyro": ((128, 128), (512,)), "accel": ((256, 512), (256, 256))}  # both residual blocks of the released networks
INPUTS = 9
NORMAL_PEAK = (2.0 * np.pi) ** -0.5

Positive = Annotated[float, msgspec.Meta(ge=1e-9, le=1e9)]
Width = Annotated[int, msgspec.Meta(ge=1, le=4096)]


class Config(Settings, frozen=True):
    """Scheme, sizes, solver, sensors with a drift; scales are units, not limits.

    By default the accelerometer's rest bias does not drift. Attitude errors limit its training windows to five seconds, and a
    drift of a hundredth in five seconds is far off after a minute (0.3 m/s² on FETCH).
    """

    scheme: Literal["split", "paper"] | msgspec.UnsetType = msgspec.UNSET  # paper: as written there (`networks.paper_ode`)
    curve_width: Width = 64  # units of each hidden layer of the curve
    drift: tuple[Sensor, ...] = ("gyro",)  # sensors whose rest bias drifts
    drift_step_s: Positive = 0.25  # step of the solver
    solver: Literal["euler", "rk4", "dopri5"] = "euler"  # of the drift's ODE
    adjoint: bool = False  # whether derivatives come from the adjoint ODE, which needs less memory
    loads: tuple[str, ...] | msgspec.UnsetType = msgspec.UNSET  # drifts of the gyro behind its load; unset: training chooses
    temperature: str | msgspec.UnsetType = msgspec.UNSET  # channel that the load gyro_temperature follows
    gyro_scale_rad_s: Positive = 0.2  # rate that is 1 at the networks' input
    gyro_curve_rad_s: Positive = 0.02  # bias that is 1 at the curve's output
    gyro_drift_rad_s2: Positive = 1e-4  # change of the bias that is 1 at the drift's output
    accel_scale_m_s2: Positive = 10.0  # specific force that is 1 at the networks' input
    accel_curve_m_s2: Positive = 0.2  # bias that is 1 at the curve's output
    accel_drift_m_s3: Positive = 1e-3  # change of the bias that is 1 at the drift's output

    @property
    def paper(self) -> bool:
        """Whether the scheme is the paper's."""
        return self.scheme == "paper"

    @property
    def drifting(self) -> tuple[Sensor, ...]:
        """Sensors whose bias has a field: in the paper's scheme both."""
        return SENSORS if self.paper else self.drift

    def units(self, sensor: Sensor) -> tuple[float, float, float]:
        """Units of a sensor's samples, of its curve and of its drift."""
        if self.paper:
            return 1.0, 1.0, 1.0
        if sensor == "gyro":
            return self.gyro_scale_rad_s, self.gyro_curve_rad_s, self.gyro_drift_rad_s2
        return self.accel_scale_m_s2, self.accel_curve_m_s2, self.accel_drift_m_s3

    def stride(self, rate_hz: float) -> int:
        """Samples from one step of the drift to the next."""
        return max(1, round(self.drift_step_s * rate_hz))


class Model(BiasModel):
    """Bias b(t) = beta(t) + C(u(t)), for gyro and accel separately.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", eq. 6, 10, 31 and spline.
    """

    method: ClassVar[str] = "neural_ode"
    config: Config

    def __init__(self, config: Settings, rate_hz: float, tensors: Mapping[str, np.ndarray] | None = None) -> None:
        super().__init__(config, rate_hz, tensors)
        self.counts_samples = self.config.paper

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics, curves and drifts.

        Raises:
            ConfigError: the adjoint with Euler's steps.
        """
        assert isinstance(config, Config)
        if config.adjoint and config.solver == "euler":
            raise ConfigError(
                "the adjoint of Euler's coarse steps has an error of Euler's order",
                where="model.adjoint",
                fix="Use model.solver=rk4 or dopri5 with it, or backpropagation",
            )
        shapes, width = super().shapes(config), config.curve_width
        for sensor in () if config.paper else SENSORS:
            shapes |= {f"curve.{sensor}.W": (3, 3), f"curve.{sensor}.net.4.weight": (3, width)}
            shapes |= {f"curve.{sensor}.net.0.weight": (width, INPUTS), f"curve.{sensor}.net.0.bias": (width,)}
            shapes |= {f"curve.{sensor}.net.2.weight": (width, width), f"curve.{sensor}.net.2.bias": (width,)}
        for sensor in dict.fromkeys(config.drifting):
            shapes |= Drift.shapes(f"drift.{sensor}", HIDDEN[sensor])
        if config.loads:
            shapes["theta_loads"] = (sum(len(form.parameters) for form in forms("gyro", config.loads)),)
        return shapes

    def rest_dynamics(self) -> Float64[np.ndarray, "6 6"]:
        """Rest dynamics d g / d beta per second, without motion, at the prior; zero in the paper's scheme.

        There a start is forgotten, and what a log adds to the bias is not.
        """
        F, still = np.zeros((6, 6)), np.zeros(3)
        for sensor in () if self.config.paper else self.config.drift:
            columns = COLUMNS[sensor]
            F[columns, columns] = self.drift(sensor).by_rest(self.prior_mean[columns], still, still)
        return F

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> DriftStream:
        """Bias stream by Euler: a step every stride of samples, or every sample in the paper's scheme."""
        config = self.config
        drifts = {sensor: self.drift(sensor) for sensor in config.drifting}
        if config.paper:
            return PaperStream(drifts, rest, self.rate_hz)
        curves, stride = Curves(self._curve("gyro"), self._curve("accel")), config.stride(self.rate_hz)
        split = NeuralStream(curves, drifts, stride, self.rate_hz, (SLOW_S, DRIFT_FILTER_S), rest)
        of_samples = samples_alone(effects := forms("gyro", config.loads or ()))
        if not of_samples:
            return split
        loads = compiled(of_samples, self.tensors["theta_loads"][columns_of(effects, temperature=False)])
        return EffectsStream(self.rate_hz, loads, compiled((), np.zeros(0)), split, rest, start_s, self.load_before)

    def follows_load(self) -> bool:
        """Whether the gyro drifts behind its load."""
        return bool(samples_alone(forms("gyro", self.config.loads or ())))

    def temperature_parameters(self) -> Mapping[Sensor, tuple[Array, Array]]:
        """Parameters of the gyro's drift with a log's temperature; their covariance is not kept."""
        own = columns_of(forms("gyro", self.config.loads or ()), temperature=True)
        return {"gyro": (self.tensors["theta_loads"][own], np.zeros((len(own), len(own))))} if len(own) else {}

    def drift(self, sensor: Sensor) -> Drift:
        """Drift of one sensor's rest bias."""
        return Drift(self.tensors, f"drift.{sensor}", HIDDEN[sensor], self.config.units(sensor)[2])

    def _curve(self, sensor: Sensor) -> CurveWeights:
        scale, curve, _ = self.config.units(sensor)
        W, *layers = (
            self.tensors[f"curve.{sensor}.{name}"]
            for name in ("W", "net.0.weight", "net.0.bias", "net.2.weight", "net.2.bias", "net.4.weight")
        )
        return CurveWeights(W, ((layers[0], layers[1]), (layers[2], layers[3]), layers[4]), scale, NEAR_ZERO, curve)


class Drift:
    """Drift g, the slow rate of the rest bias: a perceptron of two residual blocks."""

    def __init__(self, tensors: Mapping[str, Array], name: str, hidden: tuple[tuple[int, ...], ...], rate: float) -> None:
        self._rate, self._centre, self._units = rate, tensors[f"{name}.centre"], tensors[f"{name}.units"]
        layers = {key: (tensors[f"{name}.{key}.weight"].T.copy(), tensors[f"{name}.{key}.bias"]) for key in _layers(hidden)}
        self._out = layers.pop("out")
        self._blocks = [[layer for key, layer in layers.items() if key.startswith(block)] for block in ("block1", "block2")]

    @staticmethod
    def shapes(name: str, hidden: tuple[tuple[int, ...], ...]) -> Shapes:
        """Shapes of the tensors under a name."""
        shapes: Shapes = {f"{name}.centre": (3,), f"{name}.units": (INPUTS,)}
        for key, (before, after) in _layers(hidden).items():
            shapes |= {f"{name}.{key}.weight": (after, before), f"{name}.{key}.bias": (after,)}
        return shapes

    def __call__(self, beta: Array, u: Array, du: Array) -> Array:
        """Drift dbeta/dt per second."""
        x = np.concatenate([beta - self._centre, u, du]) / self._units
        for block in self._blocks:
            x = x + _perceptron(block, x)
        W, b = self._out
        rate: Array = self._rate * (np.dot(x, W) + b)
        return rate

    def by_rest(self, beta: Array, u: Array, du: Array) -> Float64[np.ndarray, "3 3"]:
        """Derivative of the drift with respect to the rest bias."""
        x = np.concatenate([beta - self._centre, u, du]) / self._units
        by_rest = np.eye(INPUTS)[:, :3] / self._units[:, None]
        for block in self._blocks:
            slope = _perceptron_slope(block, x, by_rest)
            x, by_rest = x + _perceptron(block, x), by_rest + slope
        return np.asarray(self._rate * self._out[0].T @ by_rest)


def _layers(hidden: tuple[tuple[int, ...], ...]) -> dict[str, tuple[int, int]]:
    """Inputs and outputs of a drift's linear layers; activations stand between them, hence every second index."""
    layers: dict[str, tuple[int, int]] = {}
    for block, widths in enumerate(hidden, 1):
        sizes = (INPUTS, *widths, INPUTS)
        layers |= {f"block{block}.{2 * k}": (sizes[k], sizes[k + 1]) for k in range(len(sizes) - 1)}
    return {**layers, "out": (INPUTS, 3)}


def _perceptron(layers: list[tuple[Array, Array]], x: Array) -> Array:
    """Output of a perceptron: GELU between hidden layers, tanh before the last."""
    *hidden, before, last = layers
    for W, b in hidden:
        x = gelu(np.dot(x, W) + b)
    x = np.tanh(np.dot(x, before[0]) + before[1])
    return np.asarray(np.dot(x, last[0]) + last[1])


def _perceptron_slope(layers: list[tuple[Array, Array]], x: Array, J: Array) -> Array:
    """Derivative of a perceptron's output, if J is that of its input."""
    *hidden, before, last = layers
    for W, b in hidden:
        h = np.dot(x, W) + b
        slope = 0.5 * (1.0 + erf(h * HALF_ROOT)) + h * NORMAL_PEAK * np.exp(-0.5 * h**2)
        x, J = gelu(h), slope[:, None] * (W.T @ J)
    x = np.tanh(np.dot(x, before[0]) + before[1])
    return np.asarray(last[0].T @ ((1.0 - x**2)[:, None] * (before[0].T @ J)))


class PaperStream:
    """Bias stream of the paper's scheme, by Euler, with the field at the sample before."""

    def __init__(self, drifts: Mapping[Sensor, Drift], rest: Vector6, rate_hz: float) -> None:
        self._drifts, self.rest, self._rate_hz = drifts, rest.astype(np.float64), rate_hz
        self._u, self._slope, self._t_s = np.zeros(6), np.zeros(6), math.nan

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample."""
        bias = np.empty((len(t_s), 6))
        for k, (t, u) in enumerate(zip(t_s.tolist(), np.concatenate([gyro, accel], axis=1), strict=True)):
            bias[k] = self.one(t, u)
        return bias

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample."""
        if not math.isnan(self._t_s):
            since_s = t_s - self._t_s
            steps = max(1, round(since_s * self._rate_hz))  # where samples are missing, as if the last had stayed
            for _ in range(steps):
                for sensor, rate in self._drifts.items():
                    half = COLUMNS[sensor]
                    self.rest[half] += since_s / steps * rate(self.rest[half], self._u[half], self._slope[half])
                self._slope = np.zeros(6)
            self._slope = (u - self._u) / max(since_s, 1e-9)
        self._t_s, self._u = t_s, u.copy()
        return self.rest.copy()
