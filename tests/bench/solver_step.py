"""What the drift's step and solver do to the answer: `python tests/bench/solver_step.py MODEL.safetensors LOG...`.

Prints the AOE (degrees, start from the truth) of a neural_ode model, its drift stepped as trained, at a half and a quarter of
that, and with rk4 in place of Euler.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import torch
from thawed import thawed

from imutool.bias.model_file import load
from imutool.bias.networks.network import BiasNetwork, Segment
from imutool.bias.neural_ode import Model
from imutool.bias_start.bias_from_truth import from_truth
from imutool.bias_start.correction import apply
from imutool.bias_start.initial_bias import InitialBias
from imutool.inertial import metrics
from imutool.inertial.strapdown import along_truth
from imutool.mcap_io.read import read
from imutool.recording import Imu, Recording, seconds


def main() -> None:
    """One line a log."""
    path, *logs = map(Path, sys.argv[1:])
    for log in logs:
        recording, figures = read(log), []
        for part in (1.0, 0.5, 0.25):
            model = load(path)
            assert isinstance(model, Model)
            start = replace(from_truth(model, recording), follows=None)  # gravity would pull all answers to one
            model.config = msgspec.structs.replace(model.config, drift_step_s=part * model.config.drift_step_s)
            figures.append(aoe(recording, apply(model, start, recording.imu).imu))
        figures.append(aoe(recording, by_rk4(thawed(load(path)), start, recording.imu)))
        print(
            f"{recording.name:20} step 1: {figures[0]:.3f}  1/2: {figures[1]:.3f}  1/4: {figures[2]:.3f}  rk4: {figures[3]:.3f}"
        )


def aoe(recording: Recording, imu: Imu) -> float:
    """Orientation error of pure integration, in degrees."""
    return float(metrics.evaluate(*along_truth(imu, recording.truth, recording.name))["aoe_deg"])


@torch.no_grad()
def by_rk4(network: BiasNetwork, start: InitialBias, imu: Imu) -> Imu:
    """The debiased samples with the drift solved by rk4 over the whole log."""
    network.config = msgspec.structs.replace(network.config, solver="rk4")
    t = torch.from_numpy(seconds(imu.t_ns, int(imu.t_ns[0])))[None]
    gyro, accel = (torch.from_numpy(u.copy())[None] for u in (imu.gyro, imu.accel))
    bias = network(Segment(t, gyro, accel, torch.from_numpy(start.rest)[None]))[0].numpy()
    return Imu(imu.t_ns, imu.gyro - bias[:, :3], imu.accel - bias[:, 3:])


if __name__ == "__main__":
    main()
