"""Invalid values: NaN, infinity, or beyond the range of any sensor in any unit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.cleaning.finding import Finding, Intervals
from imutool.cleaning.rule import Rule, TopicSummary
from imutool.cleaning.samples import Samples

NO_SENSOR = 1e7  # 1000 g in mm/s², the smallest unit in use
AXES = tuple(f"{sensor}.{axis}" for sensor in ("gyro", "accel") for axis in "xyz")


class NotFinite(Rule):
    """Rule that drops a sample with an invalid value on any axis."""

    place = 30

    def __init__(self) -> None:
        super().__init__()
        self._places, self._by_axis = Intervals(), np.zeros(6, np.int64)

    def __call__(self, stream: Iterable[Samples]) -> Iterator[Samples]:
        """Yield the samples with six valid values."""
        for samples in stream:
            good = measured(samples.values)
            if not good.all():
                self._by_axis += (~(np.abs(samples.values) <= NO_SENSOR)).sum(axis=0)
                self._places.add(samples.number[~good], samples.stamp_ns[~good])
                self.dropped.append(samples.number[~good])
            yield samples.where(good)

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Finding with the count by axis."""
        if self._places.count:
            by_axis = {name: int(count) for name, count in zip(AXES, self._by_axis, strict=True) if count}
            what = "samples that are no measurement: not finite, or beyond any sensor"
            yield Finding("not_finite", "warning", what, **self._places.where(), values=by_axis, action="dropped")


def measured(values: Float64[np.ndarray, "n k"]) -> Bool[np.ndarray, " n"]:
    """Samples with valid values on every axis: finite, and within the range of some sensor."""
    return np.asarray((np.abs(values) <= NO_SENSOR).all(axis=1))  # false of NaN
