"""Training of the neural ODE as the paper describes it.

`--method neural_ode --set scheme=paper`. Fields start at random, and Adam's learning rate halves on the way. First the gyro's,
then the accelerometer's along attitudes of the gyro's. No closed form, no robust loss and no bias of a log are fitted: what
belongs to a run goes into the field, too. What differs from the released code stands in docs/paper.md.

The loss is the mean of squares over short segments of poses (equations 16 and 17). A segment starts at a true pose, and at the
bias that this pose and the next one give (its section on hierarchical training).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from imutool.array_types import Bool, Float, Int
from imutool.bias.networks.network import BiasNetwork
from imutool.bias.networks.neural_ode import Network
from imutool.bias.networks.paper_ode import BiasOde
from imutool.bias.networks.threads import of_each
from imutool.errors import ConfigError, DataError
from imutool.geometry import so3
from imutool.inertial.strapdown import GRAVITY_W
from imutool.inertial.windows import step_means
from imutool.training.fit import Stage, Training
from imutool.training.objectives.objective import BATCH_SAMPLES, AdamW, Objective
from imutool.training.training_windows import Part, Pool
from imutool.units import COLUMNS, Sensor

LOSS_UNITS = 1e6  # mrad² and mm², as in the released code: in rad² gradients would be as small as Adam's epsilon
CUBIC = 3  # order of the smoothing polynomial
SEGMENTS = 250  # at a time, side by side on as many cores as there are
Biases = Float[Tensor, "n 6"]


class PaperLoss(Objective):
    """Mean squares of what integration misses at each sample of a segment, all segments alike."""

    model: Network

    def _choose(self) -> None:
        chosen = self.settings.paper
        if 1 < chosen.smoothed_samples <= CUBIC:
            raise ConfigError(
                "no cubic smooths so few samples",
                where="paper.smoothed_samples",
                expected=f"1 for none, or {CUBIC + 1} and more",
            )
        self.n = chosen.samples
        first = self._starts("train")
        self.first_by_log = [own for i in range(len(self.pool.names)) if len(own := first[self.pool.log[first] == i])]
        self.start, _ = biases_from_poses(self.pool, chosen.smoothed_samples)

    def _starts(self, part: Part) -> Int[Tensor, " m"]:
        """First samples of the segments of a part; the sample before each gives the path its first slope."""
        first = self.pool.starts(self.n + 1, part) + 1
        if not len(first):
            raise DataError(
                f"no segment of {self.n} samples of truth without a gap",
                where=", ".join(self.pool.names),
                expected="truth that covers some segments, in the last fifth of the logs too",
                fix="Lower the setting paper.samples, or give logs with more truth",
            )
        return first

    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        return {}  # squares have no width

    def terms(self, generator: torch.Generator) -> Sequence[Callable[[], Float[Tensor, ""]]]:
        """Terms of some segments each, all from one log that is drawn for this step."""
        count = self.settings.paper.segments
        first = self.first_by_log[int(torch.randint(len(self.first_by_log), (1,), generator=generator))]
        chosen = torch.randint(len(first), (count,), generator=generator).to(first.device)
        return [partial(self._term, some, len(some) / count) for some in torch.split(first[chosen], SEGMENTS)]

    def _term(self, first: Int[Tensor, " b"], share: float) -> Float[Tensor, ""]:
        return share * LOSS_UNITS * self.squares(first).mean()

    def held_out(self) -> float:
        """Root of the mean square over the held-out parts."""
        parts = torch.split(self._starts("held_out"), max(1, BATCH_SAMPLES // self.n))
        with torch.no_grad():
            return float(torch.cat(of_each(self.squares, parts), dim=1).mean().sqrt())

    def squares(self, first: Int[Tensor, " b"]) -> Float[Tensor, "n b"]:
        """Squared error at each later sample: rad² for the gyro, m² plus m²/s² for the accelerometer."""
        index = first[:, None] + torch.arange(self.n + 1, device=first.device)
        if self.sensor == "gyro":
            missed = so3.log(self._attitudes(index) @ self.pool.R_wb[index].transpose(0, 1).mT)
            return missed[1:].square().sum(-1)
        with torch.no_grad():
            R_wb = self._attitudes(index)
        ode = self._ode("accel", index)
        config = self.model.config
        accel = ode.u - ode.bias(self.start[first, 3:], config.solver, adjoint=config.adjoint)
        a_w = (R_wb.transpose(0, 1) @ accel[..., None])[..., 0] + accel.new_tensor(GRAVITY_W)
        over_step: Callable[[Tensor], Tensor] = (lambda x: x[:, :-1]) if config.solver == "euler" else step_means
        dt = torch.diff(self.pool.t[index], dim=1)[..., None]
        v = _sums(self.pool.v_w[first], over_step(a_w) * dt)
        p = _sums(self.pool.p_wb[first], over_step(v) * dt)
        missed = torch.cat([v - self.pool.v_w[index], p - self.pool.p_wb[index]], dim=-1)
        return missed[:, 1:].square().sum(-1).T

    def _attitudes(self, index: Int[Tensor, "b n"]) -> Float[Tensor, "n b 3 3"]:
        first, config = index[:, 0], self.model.config
        ode = self._ode("gyro", index)
        return ode.attitudes(self.start[first, :3], self.pool.R_wb[first], config.solver, adjoint=config.adjoint)

    def _ode(self, sensor: Sensor, index: Int[Tensor, "b n"]) -> BiasOde:
        u = self.pool.gyro if sensor == "gyro" else self.pool.accel
        return self.model.paper_ode(sensor, self.pool.t[index], u[index], u[index[:, 0] - 1])

    def settle(self) -> None:
        """Nothing: the rest biases take no part."""


def biases_from_poses(pool: Pool, smoothed: int) -> tuple[Biases, Bool[Tensor, " n"]]:
    """Bias at each sample from its true pose and the next one, and where there is one.

    b = omega - Log(R_k^T R_k+1) / dt, and b = a - R_k^T ((v_k+1 - v_k) / dt - g). A cubic of so many samples around each
    smooths them (Savitzky and Golay), where there are as many without a gap.
    """
    dt = torch.diff(pool.t)[:, None]
    turned = so3.log(pool.R_wb[:-1].mT @ pool.R_wb[1:]) / dt
    force_w = torch.diff(pool.v_w, dim=0) / dt - pool.v_w.new_tensor(GRAVITY_W)
    force = (pool.R_wb[:-1].mT @ force_w[..., None])[..., 0]
    biases = torch.cat([pool.gyro[:-1] - turned, pool.accel[:-1] - force], dim=1)
    biases = torch.cat([biases, torch.zeros_like(biases[:1])])
    known = torch.zeros_like(pool.trusted)
    known[pool.starts(1, "all")] = True
    biases = torch.where(known[:, None], biases, torch.zeros_like(biases))
    if smoothed > CUBIC:
        from scipy.signal import savgol_filter  # half a second to import

        for first, end in itertools.pairwise([0, *(torch.nonzero(~known)[:, 0] + 1).tolist()]):
            if end - 1 - first >= smoothed:
                some = biases[first : end - 1].cpu().numpy()
                biases[first : end - 1] = torch.from_numpy(savgol_filter(some, smoothed, CUBIC, axis=0)).to(biases)
    return biases, known


def _sums(start: Float[Tensor, "b 3"], steps: Float[Tensor, "b n 3"]) -> Float[Tensor, "b _ 3"]:
    """A quantity at each sample from its start and its steps."""
    return torch.cumsum(torch.cat([start[:, None], steps], dim=1), dim=1)


class PaperTraining(Training):
    """Training of the paper's scheme, whose fields compute in float32."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.model.get_submodule("drift").float()

    def store_statistics(self, pool: Pool | None = None) -> None:
        """Store priors, spreads and noise of what the logs add to the model's bias."""
        self.model.prior_mean.copy_(self.tracks.per_log().detach().mean(0))
        super().store_statistics(pool)

    def held_out(self, sensor: Sensor, model: BiasNetwork) -> float:
        """Root of the mean square over segments of the held-out part, as in the paper."""
        return self._loss(sensor, model).held_out()

    def begin(self, sensor: Sensor) -> Stage:
        """Fresh stage from the current model, which moves the sensor's field."""
        chosen = self.settings.paper
        adam = AdamW([(list(self.model.get_submodule(f"drift.{sensor}").parameters()), chosen.weight_decay)])
        last = get_ema_multi_avg_fn(0.0)  # type: ignore[no-untyped-call]  # torch gives it no type
        mean = AveragedModel(self.model.eval(), multi_avg_fn=last, use_buffers=True)
        return Stage(sensor, adam, mean, self._loss(sensor, self.model))

    def _loss(self, sensor: Sensor, model: BiasNetwork) -> PaperLoss:
        return PaperLoss(model, sensor, self.pool, self.tracks, self.settings)

    def _closed_form(self, sensor: Sensor) -> None:
        """No closed form; each log's mean bias from poses."""
        biases, known = biases_from_poses(self.pool, 1)
        learnt = known & ~self.pool.held_out
        logs = range(len(self.pool.names))
        self.tracks.set(sensor, torch.stack([biases[learnt & (self.pool.log == i)].mean(0) for i in logs])[:, COLUMNS[sensor]])

    def _steps(self, sensor: Sensor) -> int:
        chosen = self.settings.paper
        return chosen.gyro_steps if sensor == "gyro" else chosen.accel_steps

    def _rate_at(self, stage: Stage) -> float:
        chosen = self.settings.paper
        halved: float = chosen.rate * 0.5 ** (stage.step // chosen.halve_every)
        return halved
