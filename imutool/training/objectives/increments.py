"""Increment loss of Brossard, Bonnabel and Barrau: every short increment of a long stretch.

"Denoising IMU Gyroscopes with Deep Learning for Open-Loop Attitude Estimation", RA-L 2020, arXiv:2002.10718, eq. 11 and 13:
Huber's function of Log(dR_hat^T dR) over 16 and 32 samples. A network that looks seconds back is evaluated once for a stretch
of many seconds and all its increments count, where windows one by one would evaluate it hundreds of times.

For the accelerometer the same with increments of velocity, its samples turned by the true attitude at each: over these few
samples there is nothing an integrated attitude would know better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from imutool.array_types import Bool, Float, Int
from imutool.bias.networks.network import Segment
from imutool.errors import DataError
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import step_means
from imutool.training.calibration import closed_form
from imutool.training.calibration.closed_form import median_per_log
from imutool.training.objectives.objective import USUAL_SAMPLES, Objective, length
from imutool.training.training_windows import corrected, sensors_up_to
from imutool.units import COLUMNS

USUAL_BATCH = 4  # stretches at a time


class IncrementErrors(NamedTuple):
    """How far increments are off (rad or m/s), and the log each is from."""

    size: Float[Tensor, " m"]
    log: Int[Tensor, " m"]


class IncrementObjective(Objective):
    """Errors of all increments of some lengths in stretches drawn from the training part.

    A stretch brings `model.context` samples from before it, which feed the model and are not scored; before a log's first
    sample that one is repeated, as models that look back do themselves. An increment counts where the truth is trusted at
    both ends and neither it nor the samples have a gap in between.
    """

    def _choose(self) -> None:
        chosen = self.settings.increments
        asked = sorted(set(chosen.gyro_samples if self.sensor == "gyro" else chosen.accel_samples))
        self.whole = {n: starts for n in asked if bool((starts := self._starts(n)).any())}
        self.lengths = list(self.whole)
        if not self.lengths:
            raise DataError(
                f"no increment of {', '.join(map(str, asked))} samples of truth without a gap",
                where=f"the training parts, for the {self.sensor}",
                expected="truth that covers at least one increment",
                fix=f"Lower the setting increments.{self.sensor}_samples to [16,32], or give logs with more truth",
            )
        # a stretch holds the longest increment at least; one that is longer than its log repeats the last sample, unscored
        self.stretch = max(self.pool.samples(chosen.stretch_s), self.lengths[-1])
        self.first = torch.nonzero(self.whole[self.lengths[0]])[:, 0]

    def _starts(self, n: int) -> Bool[Tensor, " samples"]:
        """Where an increment of n samples that counts begins."""
        whole = torch.zeros_like(self.pool.trusted)
        whole[self.pool.starts(n, "train")] = True
        return whole

    def errors(self, first: Int[Tensor, " batch"]) -> dict[int, IncrementErrors]:
        """The errors of all increments of the stretches that start at some samples, for each length."""
        pool, before = self.pool, self.model.context
        index = pool.around(first, before, self.stretch)
        log, t, seen = pool.log[first], pool.t[index], index[:, before:]
        rest = self.tracks.at(log, t[:, before + self.stretch // 2])
        segment = Segment(t - t[:, :1], pool.gyro[index], pool.accel[index], rest)
        measured, _ = segment.of(self.sensor)
        true_u = (measured - self.model.sensor_bias(self.sensor, segment))[:, before:]
        dt = torch.diff(t[:, before:], dim=1)
        missed = _rotation if self.sensor == "gyro" else _velocity
        errors = {}
        for n, size in missed(true_u, dt, pool.R_wb[seen], pool.v_w[seen], self.lengths).items():
            counts = self.whole[n][seen[:, :-n]]
            errors[n] = IncrementErrors(size[counts], log[:, None].expand_as(counts)[counts])
        return errors

    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        first = self.first[:: self.stretch]
        first = first[:: max(1, -(-len(first) * self.stretch // USUAL_SAMPLES))]
        first = torch.cat([first, *(torch.nonzero(whole)[:1, 0] for whole in self.whole.values())])  # one of each length
        parts = [self.errors(some) for some in torch.split(first, USUAL_BATCH)]
        minimum = self.pool.minimum(self.sensor)
        joined = {n: [torch.cat(column) for column in zip(*(part[n] for part in parts), strict=True)] for n in self.lengths}
        return {n: median_per_log(size, log, minimum) for n, (size, log) in joined.items()}

    def terms(self, generator: torch.Generator) -> Sequence[Callable[[], Float[Tensor, ""]]]:
        """One function for the sum of all lengths, each the mean over a few stretches, drawn from all logs alike."""
        count = max(1, self.settings.samples // self.stretch)
        chosen = torch.randint(len(self.first), (count,), generator=generator).to(self.first.device)

        def term() -> Float[Tensor, ""]:
            found = [self.loss(size, log, n) for n, (size, log) in self.errors(self.first[chosen]).items() if len(size)]
            return torch.stack(found).sum() if found else self.tracks.knots.sum() * 0.0

        return [term]

    def settle(self) -> None:
        """Solves for the rest biases over long windows: short increments hardly show them, and the model kept is older."""
        rest, settings = self.tracks.per_log().detach(), self.settings
        window_s = settings.window_s[self.sensor]
        columns = COLUMNS[self.sensor]
        rest[:, columns] = self.model.eval().rest_at_work(self.sensor, rest[:, columns])
        model, pool = corrected(self.model, self.pool, "train", sensors_up_to(self.sensor))
        self.tracks.set(self.sensor, closed_form.solve(model, self.sensor, pool, rest, window_s, matrix=False).rest)


Sizes = dict[int, Float[Tensor, "batch _"]]


def _rotation(
    gyro: Float[Tensor, "batch n 3"],
    dt: Float[Tensor, "batch n-1"],
    R_wb: Float[Tensor, "batch n 3 3"],
    v_w: Float[Tensor, "batch n 3"],
    lengths: list[int],
) -> Sizes:
    """|Log(dR_hat^T dR)| in rad, of the increments of some lengths that begin at each sample."""
    steps = so3.exp(step_means(gyro) * dt[..., None])
    sizes = {}
    for n in lengths:
        dR_hat, dR = products(steps, n), R_wb[:, :-n].mT @ R_wb[:, n:]
        sizes[n] = length(so3.log(dR_hat.mT @ dR))
    return sizes


def _velocity(
    accel: Float[Tensor, "batch n 3"],
    dt: Float[Tensor, "batch n-1"],
    R_wb: Float[Tensor, "batch n 3 3"],
    v_w: Float[Tensor, "batch n 3"],
    lengths: list[int],
) -> Sizes:
    """|dv_hat - dv| in m/s, of the increments of some lengths that begin at each sample; trapezoidal rule."""
    a_w = (R_wb @ accel[..., None])[..., 0] + accel.new_tensor(GRAVITY_W)
    off = torch.cumsum(step_means(a_w) * dt[..., None], dim=1) - (v_w[:, 1:] - v_w[:, :1])
    off = torch.cat([torch.zeros_like(off[:, :1]), off], dim=1)
    return {n: length(off[:, n:] - off[:, :-n]) for n in lengths}


def products(steps: Float[Tensor, "batch n 3 3"], n: int) -> Float[Tensor, "batch m 3 3"]:
    """All products `steps[k] @ ... @ steps[k + n - 1]` of n consecutive rotations, by doubling."""
    power, done, whole = steps, 0, None
    while True:
        if n & 1:  # what is done so far covers `done` rotations from each place on
            whole = power if whole is None else whole[:, : power.shape[1] - done] @ power[:, done:]
            done += (steps.shape[1] - power.shape[1]) + 1
        n >>= 1
        if not n:
            assert whole is not None
            return whole
        reach = steps.shape[1] - power.shape[1] + 1
        power = power[:, :-reach] @ power[:, reach:]
