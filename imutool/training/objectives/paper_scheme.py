"""Training of the neural ODE as the paper describes it.

`--method neural_ode --set scheme=paper`. Fields start at random, and Adam's learning rate halves on the way. First the gyro's,
then the accelerometer's along attitudes of the gyro's. No closed form, no robust loss and no bias of a log are fitted: what
belongs to a run goes into the field, too. What differs from the released code stands in docs/paper.md.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from imutool.bias.model import COLUMNS
from imutool.bias.networks.network import BiasNetwork
from imutool.training.fit import Stage, Training
from imutool.training.objectives.objective import AdamW
from imutool.training.objectives.paper_loss import PaperLoss, biases_from_poses
from imutool.training.training_windows import Pool
from imutool.units import Sensor


class PaperTraining(Training):
    """Training of the paper's scheme, in stages and with checkpoints as any other.

    The fields compute in float32.
    """

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
        field = self.model.get_submodule(f"drift.{sensor}")
        adam = AdamW([(list(field.parameters()), chosen.weight_decay)])
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
