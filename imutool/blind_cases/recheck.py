"""What findings explain of a concealed misfit, by our own forward models, whatever the findings say of themselves.

The true effects and the found ones are simulated along the simulation's own poses, both without noise. What of the true misfit
the found ones leave is what they do not explain; on all of the log, held out or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from imutool.blind_cases import unnamed
from imutool.blind_cases.effects import AXES, CATALOGUE, Model, Stage, Theta
from imutool.blind_cases.motion import DEGREE, Motion, smoother
from imutool.blind_cases.scene import RATE_HZ, Scene
from imutool.recording import Recording, seconds

EDGE_S = 1.0  # at both ends, where filters settle and shifted clocks leave the log
WITHOUT = {"quantization", "dropped_samples", "timestamp_jitter"}  # act on noise and stamps: nothing to be explained
CANNOT = {"reference_error", "vibration", "unknown"}  # not to be simulated from their parameters alone

Told = Mapping[str, float]


def explained(truth: Mapping[str, Any], found: Sequence[tuple[Mapping[str, Any], Told]], sim: Recording) -> float | None:
    """The share of the misfit's power over the noise that findings (each with its parameters by our names) explain.

    At most 1; below 0 where they make it worse. None where an effect cannot be simulated from what is told, or there is none.
    """
    true = [_model(effect, {k: one["value"] for k, one in effect["parameters"].items()}) for effect in truth["effects"]]
    acting = [_model(finding, told) for finding, told in found if finding["effect"] not in WITHOUT]
    known = [one for effect, one in zip(truth["effects"], true, strict=True) if effect["effect"] not in WITHOUT]
    if not known or None in known or None in acting:
        return None
    scene = _scene(truth, sim)
    t_s = scene.t_s
    inner = (t_s >= EDGE_S) & (t_s <= t_s[-1] - EDGE_S)

    def power(one: Sequence[Any], other: Sequence[Any]) -> float:
        difference = (scene.misfit(one, t_s) - scene.misfit(other, t_s))[inner]
        return float(np.sum(((difference - difference.mean(axis=0)) / scene.sigma) ** 2))

    return float(np.clip(1.0 - power(known, acting) / power(known, []), -1.0, 1.0))


def _model(effect: Mapping[str, Any], told: Told) -> tuple[Model, Theta] | None:
    """A forward model with its parameters; an amount that is not told is none, anything else must be told."""
    name = effect["effect"]
    if name == "driven":
        equation, driver = str(effect.get("equation", "")), str(effect.get("driver", ""))
        sensor, _, axis = equation.partition(" ")[0].partition(".")
        topic = next((topic for topic in unnamed.TOPICS if driver == topic or driver.startswith(f"{topic}.")), None)
        if topic is None or sensor not in ("gyro", "accel") or axis not in AXES or not {"gain", "lag"} <= set(told):
            return None
        return unnamed.follower(topic, AXES.index(axis) + 3 * (sensor == "accel")), np.array([told["gain"], told["lag"]])
    if name in CANNOT or name not in CATALOGUE:
        return None
    model = CATALOGUE[name]
    theta = np.array(
        [told.get(one.name, 0.0 if one.amount and model.stage != Stage.CONVERTER else np.nan) for one in model.parameters]
    )
    if name == "low_pass" and "f_c" not in told:
        return None
    return (model, theta) if np.isfinite(theta).all() else None


def _scene(truth: Mapping[str, Any], sim: Recording) -> Scene:
    """The scene of a case, its motion through the simulation's poses."""
    poses = sim.truth
    ready = smoother(poses)
    t_s = seconds(poses.t_ns, int(poses.t_ns[0]))
    position, quaternion = (make_interp_spline(t_s, y, k=DEGREE) for y in (poses.p_wb, ready.q_wb_wxyz))
    duration = (len(sim.imu) - 1) / RATE_HZ
    first = next(iter(sim.scalars.values()))
    return Scene(
        ready,
        Motion(position, quaternion, 0.0, float(t_s[-1])),
        0.0,
        duration,
        np.array(truth["noise_std"]["real"]),
        seconds(first.t_ns, int(first.t_ns[0])),
        {topic: scalars.values[:, 0] for topic, scalars in sim.scalars.items()},
    )
