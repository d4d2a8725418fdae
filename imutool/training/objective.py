"""What a stage descends on: an objective draws its own batches from the training part and says what they miss.

A model names the one it wants (`BiasModel.objective`); the training calls it without knowing which it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from imutool.bias.model import BiasModel
from imutool.training.closed_form import median_per_log
from imutool.training.loss import RobustLoss, error
from imutool.training.segments import Pool
from imutool.training.settings import TrainSettings
from imutool.training.tracks import Tracks
from imutool.units import Sensor

USUAL_SAMPLES = 200_000  # enough for a median
BATCH = 64  # windows at a time where no gradient is kept


class Objective(ABC):
    """Errors of one sensor over batches of the training part, made comparable by a robust loss.

    Attributes:
        loss: its widths are fixed from the model as it stands when the objective is made; a checkpoint keeps them.
    """

    def __init__(self, model: BiasModel, sensor: Sensor, pool: Pool, tracks: Tracks, settings: TrainSettings) -> None:
        self.model, self.sensor, self.pool, self.tracks, self.settings = model, sensor, pool, tracks, settings
        self._choose()
        with torch.no_grad():
            self.loss = RobustLoss(self._usual())

    @abstractmethod
    def _choose(self) -> None:
        """Chooses the lengths, and where in the training part they fit."""

    @abstractmethod
    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        """The median error of each log, for each length in samples."""

    @abstractmethod
    def terms(self, generator: torch.Generator) -> Iterator[Float[Tensor, ""]]:
        """The parts of one step's loss, on a batch drawn with the generator."""

    @abstractmethod
    def settle(self) -> None:
        """Leaves the tracks as they should be now that the stage is over and the model is the one kept."""


class WindowEnds(Objective):
    """What integration misses at the end of windows of several lengths (`imutool.training.loss`)."""

    def _choose(self) -> None:
        named = self.settings.gyro_window_s if self.sensor == "gyro" else self.settings.accel_window_s
        lengths = map(self.pool.samples, named)
        self.pools = [(n, first) for n in lengths if len(first := self.pool.starts(n, "train"))]

    def errors(self, first: Int[Tensor, " m"], n: int) -> Float[Tensor, " m"]:
        """The errors of the windows of n steps that start at some samples (rad or m/s)."""
        rest = self.tracks.at(self.pool.log[first], self.pool.t[first])
        return error(self.model, self.sensor, self.pool.windows(first, n, rest))

    def _usual(self) -> dict[int, Float[Tensor, " logs"]]:
        usual = {}
        for n, first in self.pools:
            some = first[:: max(1, -(-len(first) * n // USUAL_SAMPLES))]
            size = torch.cat([self.errors(part, n) for part in torch.split(some, BATCH)])
            usual[n] = median_per_log(size, self.pool.log[some], len(self.pool.names))
        return usual

    def terms(self, generator: torch.Generator) -> Iterator[Float[Tensor, ""]]:
        """One term a length, over windows drawn from all logs alike."""
        for n, first in self.pools:
            count = max(4, self.settings.samples // n)
            chosen = torch.randint(len(first), (count,), generator=generator).to(first.device)
            size = self.errors(first[chosen], n)
            yield self.loss(size, self.pool.log[first[chosen]], n)

    def settle(self) -> None:
        """Nothing: windows of many seconds have shown the rest biases as well as anything can."""
