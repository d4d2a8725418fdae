"""The neural ODE at work in numpy: torch's overhead for one sample is twenty times its arithmetic."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.special import erf
from torch import Tensor, nn

from imutool.bias._base import COLUMNS, Sensor, Vector6
from imutool.physics.signals import low_pass

ROWS = 64  # at a time: they stay in the cache, and a product this small is never handed to threads that must be woken first
HALF_ROOT = math.sqrt(0.5)

Array = Float64[np.ndarray, "..."]
DriftRate = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class CurveWeights:
    """One sensor's C(u, s) = W u + size (N(u, s) - N(0, 0)); N sees u, asinh(near_zero u) and asinh(near_zero s)."""

    W: Float64[np.ndarray, "3 3"]
    layers: tuple[nn.Linear, nn.Linear, nn.Linear]
    scale: float
    near_zero: float
    size: float


class Curves:
    """The curves of gyro and accelerometer side by side: networks of one shape cost half the calls when stacked.

    GELU(h) = h (1 + erf(h / sqrt 2)) / 2; its constants, the layers' own and N(0, 0) are folded into the matrices, each with a
    row for an input that is always one.
    """

    def __init__(self, gyro: CurveWeights, accel: CurveWeights) -> None:
        both = (gyro, accel)
        self._linear = np.zeros((6, 6))
        self._linear[:3, :3], self._linear[3:, 3:] = gyro.W.T, accel.W.T
        self._bent = any(bool(one.layers[2].weight.any()) for one in both)
        self._width = width = gyro.layers[0].out_features
        self._units = np.array([one.near_zero / one.scale for one in both])[:, None, None]
        self._first = np.stack([self._first_layer(one) for one in both])
        self._second = np.stack([_with_constant(one.layers[1]) for one in both])
        self._second[:, :width] *= HALF_ROOT
        last = [np.concatenate([one.size * _array(one.layers[2].weight).T, one.W.T, np.zeros((1, 3))]) for one in both]
        self._last = np.stack(last)
        self._room: dict[int, tuple[Array, ...]] = {}
        self._last[:, -1] -= self(np.zeros((1, 6)), np.zeros((1, 6))).reshape(2, 3)

    @staticmethod
    def _first_layer(one: CurveWeights) -> Array:
        weight = _with_constant(one.layers[0])
        weight[:3] /= one.scale
        return HALF_ROOT * weight

    def __call__(self, u: Float64[np.ndarray, "n 6"], slow: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
        """What the motion adds to both biases."""
        if not self._bent:
            return np.asarray(np.dot(u, self._linear))
        if len(u) <= ROWS:
            return self._rows(u, slow)
        starts = range(0, len(u), ROWS)
        return np.concatenate([self._rows(u[k : k + ROWS], slow[k : k + ROWS]) for k in starts])

    def _make_room(self, n: int) -> tuple[Array, ...]:
        """Inputs of the layers with their constant one, the parts of them that change, and what lies between, for n rows."""
        x, h, g = (np.ones((2, n, size + 1)) for size in (9, self._width, self._width + 3))
        a, b, y = (np.empty((2, n, size)) for size in (self._width, self._width, 3))
        parts = g[:, :, : self._width], g[:, :, self._width : -1]
        self._room[n] = room = (x, x[:, :, 3:9], h, h[:, :, : self._width], g, *parts, a, b, y)
        return room

    def _rows(self, u: Float64[np.ndarray, "n 6"], slow: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "n 6"]:
        n = len(u)
        x, near, h, bent, g, flat, tail, a, b, y = self._room.get(n) or self._make_room(n)
        by_sensor = u.reshape(n, 2, 3).transpose(1, 0, 2)
        x[:, :, :3] = near[:, :, :3] = tail[:] = by_sensor
        near[:, :, 3:] = slow.reshape(n, 2, 3).transpose(1, 0, 2)
        near *= self._units
        np.arcsinh(near, out=near)
        np.matmul(x, self._first, out=a)
        erf(a, out=b)
        b += 1.0
        np.multiply(a, b, out=bent)
        np.matmul(h, self._second, out=a)
        np.tanh(a, out=flat)
        np.matmul(g, self._last, out=y)
        return y.transpose(1, 0, 2).copy().reshape(n, 6)


class NeuralStream:
    """Curves on the samples, and the drift's rest bias by one Euler step every `stride` samples.

    Remembers the rest bias, its rate, the filtered samples, and how many there were since the drift's last step.
    """

    def __init__(
        self,
        curves: Curves,
        drifts: Mapping[Sensor, DriftRate],
        stride: int,
        rate_hz: float,
        tau_s: tuple[float, float],
        rest: Vector6,
    ) -> None:
        self._curves, self._drifts, self._stride = curves, drifts, stride
        self._rest, self._slope = rest.astype(np.float64), np.zeros(6)
        self._gain = np.array([-math.expm1(-1.0 / (rate_hz * tau)) for tau in tau_s])[:, None]
        self._state, self._step_by = np.zeros((2, 6)), np.zeros((2, 6))  # what curve and drift see, and how it moves
        self._before, self._t_step, self._count = np.zeros(6), 0.0, -1  # -1: nothing seen yet

    def __call__(
        self, t_s: Float64[np.ndarray, " n"], gyro: Float64[np.ndarray, "n 3"], accel: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 6"]:
        n = len(t_s)
        u = np.empty((n, 6))
        u[:, :3], u[:, 3:] = gyro, accel
        if not n:
            return u
        began = self._count >= 0
        if not began:
            self._state[:] = u[0]
        slow, seen = self._one(u) if n == 1 else self._many(u)
        bias = self._curves(u, slow)
        if not began:
            self._start(float(t_s[0]), seen[0])
        bias += self._rest_path(t_s, seen, 0 if began else 1) if self._drifts else self._rest
        return bias

    def _one(self, u: Float64[np.ndarray, "1 6"]) -> Float64[np.ndarray, "2 1 6"]:
        step = self._step_by
        np.subtract(u, self._state, out=step)
        step *= self._gain
        self._state += step
        return self._state[:, None]

    def _many(self, u: Float64[np.ndarray, "n 6"]) -> Float64[np.ndarray, "2 n 6"]:
        both = np.stack([low_pass(u, float(g), y) for g, y in zip(self._gain[:, 0], self._state, strict=True)])
        self._state = both[:, -1].copy()
        return both

    def _rest_path(
        self, t_s: Float64[np.ndarray, " n"], seen: Float64[np.ndarray, "n 6"], k: int
    ) -> Float64[np.ndarray, "_ 6"] | Vector6:
        """The rest bias at each sample, the first `k` of them where the drift began."""
        if len(t_s) == 1 and not k and self._count + 1 < self._stride:  # nothing but a straight line
            self._count += 1
            return self._rest + (float(t_s[0]) - self._t_step) * self._slope
        rest = np.empty((len(t_s), 6))
        rest[:k] = self._rest
        while k < len(t_s):
            last = min(len(t_s), k + self._stride - self._count)
            rest[k:last] = self._rest + (t_s[k:last, None] - self._t_step) * self._slope
            self._count += last - k
            if self._count == self._stride:
                self._step(float(t_s[last - 1]), rest[last - 1], seen[last - 1])
            k = last
        return rest

    def _start(self, t_s: float, u: Array) -> None:
        self._t_step, self._before, self._count = t_s, u.copy(), 0
        self._set_slope(u, np.zeros(6))

    def _step(self, t_s: float, rest: Array, u: Array) -> None:
        du = (u - self._before) / max(t_s - self._t_step, 1e-9)
        self._t_step, self._rest, self._before, self._count = t_s, rest.copy(), u.copy(), 0
        self._set_slope(u, du)

    def _set_slope(self, u: Array, du: Array) -> None:
        for sensor, rate in self._drifts.items():
            half = COLUMNS[sensor]
            self._slope[half] = rate(self._rest[half], u[half], du[half])


def perceptron(module: nn.Module) -> Callable[[Array], Array]:
    """Linear layers with tanh and GELU between them, as a numpy function."""
    steps: list[Callable[[Array], Array]] = []
    for layer in module if isinstance(module, nn.Sequential) else [module]:
        if isinstance(layer, nn.Linear):
            steps.append(_affine(_array(layer.weight).T.copy(), _array(layer.bias)))
        elif isinstance(layer, nn.Tanh):
            steps.append(np.tanh)
        else:
            assert isinstance(layer, nn.GELU)
            steps.append(_gelu)

    def run(x: Array) -> Array:
        for step in steps:
            x = step(x)
        return x

    return run


def _affine(W: Array, b: Array) -> Callable[[Array], Array]:
    return lambda x: np.asarray(np.dot(x, W) + b)


def _gelu(x: Array) -> Array:
    y: Array = 0.5 * x * (1.0 + erf(x * HALF_ROOT))
    return y


def _with_constant(layer: nn.Linear) -> Array:
    """A layer's matrix for rows from the left, and its constant as one more row."""
    return np.concatenate([_array(layer.weight).T, _array(layer.bias)[None]])


def _array(tensor: Tensor) -> Array:
    out: Array = tensor.detach().to("cpu", torch.float64).numpy()
    return out
