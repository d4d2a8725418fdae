"""Linear bias model: scale and misalignment, bias = rest + W u.

W is solved in closed form; a direction that the motion does not excite keeps the identity.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import ClassVar

import numpy as np

from imutool.array_types import Float64, Rows6, Vectors
from imutool.bias.model import BiasModel, CovarianceModel, Shapes, Stream, Vector6, matrices
from imutool.config import Settings
from imutool.units import SENSORS, Sensor


class Config(Settings, frozen=True):
    """What the file holds; the training has its own settings."""

    covariance: bool = False  # of W, row by row; older files have none


class Model(BiasModel):
    """Linear model gyro_hat = (I - W_g) gyro - rest_g, likewise for accel.

    The paper's linear method with A = I - W.

    Source: "Debiasing 6-DOF IMU via Hierarchical Learning of Continuous Bias Dynamics", sec. V-C (method "Linear");
    Rehder et al., ICRA 2016, eq. 5 and 10 for the calibration it stands for.
    """

    method: ClassVar[str] = "linear"
    config: Config

    def __init__(
        self, config: Settings | None = None, rate_hz: float = 0.0, tensors: Mapping[str, np.ndarray] | None = None
    ) -> None:
        super().__init__(config or Config(), rate_hz, tensors)

    @classmethod
    def shapes(cls, config: Settings) -> Shapes:
        """Shapes of the statistics, and of W and its covariance for each sensor."""
        assert isinstance(config, Config)
        covariances: Shapes = {f"covariance.{sensor}": (9, 9) for sensor in SENSORS} if config.covariance else {}
        return super().shapes(config) | matrices() | covariances

    def stretch(self, rest: Vector6, start_s: float = math.nan) -> Stream:
        """Bias rest + W u at every sample."""
        return partial(_affine, rest, *(self.tensors[f"W.{sensor}"].T for sensor in SENSORS))

    def calibration_covariance(self) -> CovarianceModel | None:
        """Covariance of W u, from that of W."""
        if not self.config.covariance:
            return None
        roots: dict[Sensor, Float64[np.ndarray, "3 3 p"]] = {}
        for sensor in SENSORS:
            values, vectors = np.linalg.eigh(self.tensors[f"covariance.{sensor}"])
            roots[sensor] = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(3, 3, 9)
        return partial(_roots_at, roots)


def _affine(
    rest: Vector6,
    by_gyro: Float64[np.ndarray, "3 3"],
    by_accel: Float64[np.ndarray, "3 3"],
    t_s: Float64[np.ndarray, " n"],
    gyro: Vectors,
    accel: Vectors,
) -> Rows6:
    """Bias rest + W u; a function of the module, so that a stream can be pickled."""
    bias: Rows6 = rest + np.concatenate([gyro @ by_gyro, accel @ by_accel], axis=1)
    return bias


def _roots_at(
    roots: Mapping[Sensor, Float64[np.ndarray, "3 3 p"]],
    t_s: Float64[np.ndarray, " n"],
    gyro: Vectors,
    accel: Vectors,
) -> Mapping[Sensor, Float64[np.ndarray, "n 3 p"]]:
    """Roots at each sample; a function of the module, as `_affine`."""
    samples: dict[Sensor, Vectors] = {"gyro": gyro, "accel": accel}
    return {sensor: np.einsum("nj,ijp->nip", u, roots[sensor]) for sensor, u in samples.items()}
