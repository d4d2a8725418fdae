"""Initial bias of a model in a log, its change over time, and whether the model fits."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

from imutool.errors import ModelError
from imutool.report import Section

SUFFIX = "/debiased"  # of the topic of a debiased IMU
DEBIASED_BY = "debiased_by"  # in the record `imutool`: the log's own IMU is a debiased one, from `imutool.debias` of arrays
Verdict = Literal["fits", "doubtful", "unfit"]

logger = logging.getLogger(__name__)


class Fitness(Section, frozen=True):
    """Verdict on a model for a log, and the reasons."""

    verdict: Verdict
    reasons: tuple[str, ...]

    def sentence(self, model: str) -> str:
        """Verdict on a model and the reasons, in words."""
        return f"{model} {'fits' if self.verdict == 'fits' else f'is {self.verdict}'}: {'; '.join(self.reasons)}."

    def beside(self, contradictions: Sequence[str]) -> Fitness:
        """Verdict on samples whose axes the motion contradicts: a model fits none of them for certain."""
        if not contradictions:
            return self
        return Fitness("doubtful" if self.verdict == "fits" else self.verdict, (*contradictions, *self.reasons))

    def report(self, name: str, where: str, *, force: bool) -> Fitness:
        """Warn of a doubtful model, refuse an unfit one.

        Raises:
            ModelError: it is unfit, and `force` is not given.
        """
        reasons = "; ".join(self.reasons)
        if self.verdict == "unfit" and not force:
            raise ModelError(
                f"the model {name!r} does not fit this log: {reasons}",
                where=where,
                expected="a model of this unit of the sensor, and samples in rad/s and m/s²",
                fix="Correct wrong units with imutool convert LOG OUT --fix; else give `model=static` or one trained on logs "
                "of this sensor, or use it anyway with `force`",
            )
        if self.verdict != "fits":
            logger.warning("%s: %s", where, self.sentence(f"the model {name}"))
        return self
