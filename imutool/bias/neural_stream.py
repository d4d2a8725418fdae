"""Bias stream of the neural ODE in numpy, for whole logs and single samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import Array, Vector6
from imutool.sensor.signals import low_pass
from imutool.units import COLUMNS, Sensor

ROWS = 64  # per product: they fit in the cache, and BLAS starts no threads for such a small product
HALF_ROOT = math.sqrt(0.5)
CONSTANT = 8.0  # its erf is exactly one: GELU maps a constant to a constant

DriftRate = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class CurveWeights:
    """Curve weights of one sensor: C(u, s) = W u + size (N(u, s) - N(0, 0)).

    Inputs of N: u, asinh(near_zero u) and asinh(near_zero s).
    """

    W: Float64[np.ndarray, "3 3"]
    layers: tuple[tuple[Array, Array], tuple[Array, Array], Array]  # weight and bias; the last layer has no bias
    scale: float
    near_zero: float
    size: float


class Curves:
    """Curves of gyro and accelerometer, stacked: two networks of one shape need half the calls.

    GELU(h) = h (1 + erf(h / sqrt 2)) / 2; its constants, the layers' biases and N(0, 0) are folded into the matrices. Features
    are rows and samples columns (a single sample has no column axis): every part of a layer is contiguous in memory. Rows of
    the hidden layer: gyro, a constant, accel; each sensor's second matrix uses its own rows and the constant. For a single
    sample the last matrix also contains the rest bias.
    """

    def __init__(self, gyro: CurveWeights, accel: CurveWeights) -> None:
        both = (gyro, accel)
        self._width = width = len(gyro.layers[2].T)
        self._units = np.repeat([curve.near_zero / curve.scale for curve in both], 3)
        self._bent = any(bool(curve.layers[2].any()) for curve in both)
        self._first = np.zeros((2 * width + 1, 19))
        self._first[width, 6] = CONSTANT
        self._second = np.empty((2, width, width + 1))
        self._last = np.zeros((6, 2 * width + 8))
        for k, curve in enumerate(both):
            unit, own = k * (width + 1), slice(3 * k, 3 * k + 3)
            (first, first_bias), (second, second_bias), last = curve.layers
            for part, start in enumerate((0, 7, 13)):  # u, asinh of u, asinh of s
                columns = first[:, 3 * part : 3 * part + 3] / (1.0 if part else curve.scale)
                self._first[unit : unit + width, start + 3 * k : start + 3 * k + 3] = HALF_ROOT * columns
            self._first[unit : unit + width, 6] = HALF_ROOT * first_bias
            constant = second_bias[:, None] / (2.0 * CONSTANT)
            self._second[k] = np.concatenate([HALF_ROOT * second, constant][:: 1 - 2 * k], axis=1)
            self._last[own, k * width : (k + 1) * width] = curve.size * last
            self._last[own, 2 * width + 1 :][:, own] = curve.W
        self._buffers: dict[int, _Buffers] = {}
        self._erf_of_one: Callable[[Array, Array], Array] | None = None
        self._last_and_rest = self._last.copy()
        self._last[:, -1] -= self(np.zeros((1, 6)), np.zeros((1, 6)))[0]
        self.add_line(np.zeros(6), np.zeros(6))

    def __call__(self, u: Rows6, slow: Rows6) -> Rows6:
        """Motion-dependent bias of both sensors."""
        out = np.empty((len(u), 6))
        for k in range(0, len(u), ROWS):
            rows = slice(k, k + ROWS)
            out[rows] = self._last.dot(self._bend(u[rows].T, slow[rows].T, self._buffers_of(len(u[rows])), erf)).T
        return out

    def add_line(self, rest: Vector6, slope: Vector6) -> None:
        """Set the line rest + since_s slope that `one` adds."""
        self._last_and_rest[:, -1] = self._last[:, -1] + rest
        self._last_and_rest[:, 2 * self._width] = slope

    def one(self, u: Vector6, slow: Vector6, since_s: float) -> Vector6:
        """Bias at one sample: motion-dependent part plus rest bias."""
        if self._erf_of_one is None:
            from scipy.special import erf as erf_of_one  # 2 µs for a single sample, and ours 15

            self._erf_of_one = erf_of_one
        buffers = self._buffers_of(0)
        buffers.z[2 * self._width] = since_s
        out: Vector6 = self._last_and_rest.dot(self._bend(u, slow, buffers, self._erf_of_one))
        return out

    def _buffers_of(self, n: int) -> _Buffers:
        """Buffers for n samples, or for a single one without the sample axis (n = 0)."""
        buffers = self._buffers.get(n)
        if buffers is None:
            buffers = self._buffers[n] = _Buffers(self._width, (n,) if n else (), self._units)
        return buffers

    def _bend(self, u: Array, slow: Array, buffers: _Buffers, erf: Callable[[Array, Array], Array]) -> Array:
        """Input of the last layer."""
        buffers.u[:] = u
        if not self._bent:
            return buffers.outs
        a, b = buffers.a, buffers.b
        np.multiply(u, buffers.units, buffers.near_u)
        np.multiply(slow, buffers.units, buffers.near_slow)
        np.arcsinh(buffers.near, buffers.near)
        self._first.dot(buffers.seen, a)
        erf(a, b)
        b *= a
        b += a
        self._second[0].dot(buffers.b_gyro, buffers.c_gyro)
        self._second[1].dot(buffers.b_accel, buffers.c_accel)
        np.tanh(buffers.c, buffers.flat)
        return buffers.outs


class _Buffers:
    """Buffers of the layers and views of their parts, made once: numpy takes as long to slice as to add.

    Rows of `z`: outputs of tanh (gyro, accel), seconds on the line of the rest bias, u, 1, asinh of u, asinh of s.
    """

    def __init__(self, width: int, samples: tuple[int, ...], units: Vector6) -> None:
        self.z, self.c, u = np.zeros((2 * width + 20, *samples)), np.empty((2 * width, *samples)), 2 * width + 1
        self.z[u + 6] = 1.0
        self.flat, self.u, self.outs, self.seen = self.z[: u - 1], self.z[u : u + 6], self.z[: u + 7], self.z[u:]
        self.near, self.near_u, self.near_slow = self.z[-12:], self.z[-12:-6], self.z[-6:]
        self.a, self.b = np.empty((2, 2 * width + 1, *samples))
        self.b_gyro, self.b_accel = self.b[: width + 1], self.b[width:]
        self.c_gyro, self.c_accel = self.c[:width], self.c[width:]
        self.units = units.reshape(6, *(1 for _ in samples))
        self._made_of = width, samples, units

    def __reduce__(self) -> tuple[object, ...]:
        """Copy and pickle as new buffers: copied one by one, the views would no longer share their memory."""
        return type(self), self._made_of


class NeuralStream:
    """Bias stream of the curves and of the drift.

    The rest bias takes one Euler step of the drift every `stride` samples.

    State: the rest bias, its rate, the filtered samples, and the count of samples since the last step of the drift.
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
        self._state, self._step_by = (
            np.zeros((2, 6)),
            np.zeros((2, 6)),
        )  # filtered inputs of curve and drift, and their increments
        self._cut()
        self._before, self._t_step, self._count, self._began = np.zeros(6), 0.0, -1, False

    def _cut(self) -> None:
        """Views of the state."""
        self._slow, self._drift_input = self._state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Cut the views anew: a copy or a pickle has copied them, too."""
        self.__dict__.update(state)
        self._cut()

    @property
    def rest(self) -> Vector6:
        """Latest rest bias: that of the last step of the drift."""
        return self._rest

    def __call__(self, t_s: Float64[np.ndarray, " n"], gyro: Vectors, accel: Vectors) -> Rows6:
        """Bias at each sample of a block, gyro (rad/s) then accel (m/s²)."""
        if len(t_s) == 1:
            return self.one(float(t_s[0]), np.concatenate([gyro[0], accel[0]]))[None]
        u = np.concatenate([gyro, accel], axis=1)
        if not len(u):
            return u
        if not self._began:
            self._begin(float(t_s[0]), u[0])
        slow, seen = (low_pass(u, float(g), y) for g, y in zip(self._gain[:, 0], self._state, strict=True))
        self._slow[:], self._drift_input[:] = slow[-1], seen[-1]
        bias = self._curves(u, slow)
        bias += self._rest_path(t_s, seen) if self._drifts else self._rest
        return bias

    def one(self, t_s: float, u: Vector6) -> Vector6:
        """Bias at one sample."""
        if not self._began:
            self._begin(t_s, u)
        step = self._step_by
        np.subtract(u, self._state, step)
        step *= self._gain
        self._state += step
        since_s = t_s - self._t_step
        bias = self._curves.one(u, self._slow, since_s)
        if self._drifts:
            self._count += 1
            if self._count == self._stride:
                self._step(t_s, self._rest + since_s * self._slope, self._drift_input)
        return bias

    def _rest_path(self, t_s: Float64[np.ndarray, " n"], seen: Rows6) -> Rows6:
        """Rest bias at each sample."""
        rest, k = np.empty((len(t_s), 6)), 0
        while k < len(t_s):
            last = min(len(t_s), k + self._stride - self._count)
            rest[k:last] = self._rest + (t_s[k:last, None] - self._t_step) * self._slope
            self._count += last - k
            if self._count == self._stride:
                self._step(float(t_s[last - 1]), rest[last - 1], seen[last - 1])
            k = last
        return rest

    def _begin(self, t_s: float, u: Array) -> None:
        """Start the drift at the first sample, which does not count towards the next step."""
        self._began, self._state[:] = True, u
        self._t_step, self._before = t_s, u.copy()
        self._set_slope(u, np.zeros(6))

    def _step(self, t_s: float, rest: Array, u: Array) -> None:
        du = (u - self._before) / max(t_s - self._t_step, 1e-9)
        self._t_step, self._rest, self._before, self._count = t_s, rest.copy(), u.copy(), 0
        self._set_slope(u, du)

    def _set_slope(self, u: Array, du: Array) -> None:
        for sensor, rate in self._drifts.items():
            half = COLUMNS[sensor]
            self._slope[half] = rate(self._rest[half], u[half], du[half])
        self._curves.add_line(self._rest, self._slope)


def _erf_table() -> Array:
    """Taylor coefficients of erf at each node, a row for each order.

    Derivatives of erf are Hermite polynomials times a Gaussian (DLMF 7.10.1).
    """
    nodes = np.arange(-ERF_END, ERF_END + 0.5 / ERF_NODES, 1.0 / ERF_NODES)
    rows, before, hermite = [np.array([math.erf(x) for x in nodes])], np.zeros_like(nodes), np.ones_like(nodes)
    for order in range(1, ERF_ORDER + 1):
        rows.append(2.0 / math.sqrt(math.pi) * hermite * np.exp(-(nodes**2)) / math.factorial(order) * (-1.0) ** (order - 1))
        before, hermite = hermite, 2.0 * nodes * hermite - 2.0 * (order - 1) * before
    return np.array(rows)


def erf(x: Array, out: Array | None = None) -> Array:
    """Error function to 3e-16, from Taylor series at the nodes of a table.

    As fast as scipy's, whose import takes 0.2 s of CPU.
    """
    steps = np.clip(x, -ERF_END, ERF_END)
    steps *= ERF_NODES
    nearest = np.rint(steps)
    steps -= nearest
    steps *= 1.0 / ERF_NODES
    node = nearest.astype(np.intp)
    node += round(ERF_END * ERF_NODES)
    *lower, highest = ERF_TABLE
    y: Array = highest.take(node, out=out, mode="clip")  # all are inside; to make sure of it takes a copy
    for row in reversed(lower):
        y *= steps
        y += row.take(node)
    return y


ERF_NODES, ERF_END, ERF_ORDER = 64, 6.0, 6  # nodes a unit; where erf is 1 to the last bit; terms of the series
ERF_TABLE = _erf_table()


def gelu(x: Array) -> Array:
    """GELU x (1 + erf(x / sqrt 2)) / 2."""
    y: Array = 0.5 * x * (1.0 + erf(x * HALF_ROOT))
    return y
