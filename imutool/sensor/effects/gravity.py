"""Gravity of another size, or a world frame that stands askew of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.recording import GRAVITY_M_S2
from imutool.sensor.effect import Effect, Parameter, Stage, Theta, attitude_of, starts_at
from imutool.sensor.samples import IdealMotion


def _forward(motion: IdealMotion, theta: Theta) -> IdealMotion:
    """Gravity g_w = Exp(tilt_x, tilt_y, 0) (0, 0, -(g + dg)).

    The specific force changes by -R_wb^T times g_w's change.
    """
    dg, tilt_x, tilt_y = theta.tolist()
    up = Rotation.from_rotvec([tilt_x, tilt_y, 0.0]).apply([0.0, 0.0, 1.0])
    more_w = (GRAVITY_M_S2 + dg) * up - np.array([0.0, 0.0, GRAVITY_M_S2])
    return replace(motion, accel=motion.accel + np.einsum("nji,j->in", attitude_of(motion, "gravity"), more_w, order="C").T)


EFFECT = Effect(
    "gravity",
    Stage.MOTION,
    ("accel",),
    "accel -= R_wb^T (g_w - (0, 0, -g)), g_w = Exp(tilt) (0, 0, -(g + dg))",
    (Parameter("magnitude", "m/s²", 0.05), Parameter("tilt_x", "rad", 0.05), Parameter("tilt_y", "rad", 0.05)),
    "the attitude varies (against the bias)",
    _forward,
    linear=False,
    starts=starts_at([0.0, 0.0, 0.0]),
    needs=("attitude",),
)
