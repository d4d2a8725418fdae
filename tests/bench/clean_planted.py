"""How many planted defects a survey finds in real logs, and what else it says: `python tests/bench/clean_planted.py LOG...`.

First what is found where nothing was planted, log by log. Then, for each defect: how many were planted over all logs, how many
counted, and in how many logs another rule spoke up too.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.imu_defects import late, messages, repeated, survey, with_values, without

from imutool.cleaning.survey import examine
from imutool.cleaning.truth import read_truth
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.log import Log

HOUR_NS, HALF_A_SECOND_NS, DELAY_NS, JITTER_NS = 3_600_000_000_000, 500_000_000, 3_000_000, 200_000


def plants(made: ImuBatch, rng: np.random.Generator) -> Iterator[tuple[str, ImuBatch, str, int]]:
    """Name, messages, rule and count of each defect."""
    n, u, stamp_ns = len(made.stamp_ns), np.concatenate([made.gyro, made.accel], axis=1), made.stamp_ns
    largest = np.abs(np.diff(u, axis=0)).max(axis=0)
    some = np.sort(rng.choice(np.arange(200, n - 200, 40), 7, replace=False))
    late_half, chosen = np.arange(n) >= n // 2, np.isin(np.arange(n), some)
    yield "sent again at once", repeated(made, some.tolist()), "duplicates", 7
    yield "sent again later", repeated(made, some.tolist(), 30), "duplicates", 7
    yield "late", late(made, some.tolist()), "time_back", 7
    yield "an hour ahead", made._replace(stamp_ns=stamp_ns + HOUR_NS * chosen), "time_back", 7
    yield "first quarter an hour off", made._replace(stamp_ns=stamp_ns + HOUR_NS * (np.arange(n) < n // 4)), "time_back", n // 4
    yield "37 missing", without(made, slice(n // 2, n // 2 + 37)), "gaps", 37
    yield "single ones missing", without(made, some), "gaps", 7
    yield "stuck", with_values(made, slice(1001, 1051), slice(None), u[1000]), "stuck", 50
    yield "not finite", with_values(made, some, 2, np.nan), "not_finite", 7
    for width in (1, 2, 3):
        for times in (3, 10):
            spiked = made
            for i in some:
                spiked = with_values(spiked, slice(i, i + width), i % 6, times * largest[i % 6], add=True)
            yield f"spikes of {width}, {times} x the largest step", spiked, "spikes", 7 * width
    for axis in (0, 5):
        limit = float(np.quantile(u[:, axis], 0.99))
        clipped = with_values(made, slice(None), axis, np.minimum(u[:, axis], limit))
        yield f"axis {axis} clipped", clipped, "saturation", int((u[:, axis] >= limit).sum())
    yield "half the rate", without(made, np.arange(n // 3, n // 3 + 1800, 2)), "changed_rate", 900
    yield "stamps jump", made._replace(stamp_ns=stamp_ns + HALF_A_SECOND_NS * late_half), "clock_jumps", 1
    yield "recorder's clock jumps", made._replace(log_time=made.log_time + HALF_A_SECOND_NS * late_half), "clock_jumps", 1


def main() -> None:
    """Prints both tables."""
    rng = np.random.default_rng(0)
    counted: dict[str, list[int]] = {}
    for path in map(Path, sys.argv[1:]):
        plain = survey(path)
        print(
            f"{path.stem}: {plain.verdict}, score {plain.score:.3f}", *(f"| {one.rule}: {one.what}" for one in plain.findings)
        )
        made, known = messages(path), {one.rule for one in plain.findings}
        log_ns = made.stamp_ns + DELAY_NS + rng.integers(0, JITTER_NS, len(made.stamp_ns))
        with Log(path) as log:
            truth = read_truth(log)
        for name, batch, rule, count in plants(made._replace(log_time=log_ns), rng):
            findings = examine(lambda batch=batch: [batch], truth).findings  # type: ignore[misc]  # a default binds it now
            found = sum(one.count for one in findings if one.rule == rule)
            others = bool({one.rule for one in findings} - known - {rule})
            row = counted.setdefault(name, [0, 0, 0])
            row[:] = row[0] + count, row[1] + found, row[2] + others
    print(f"{'planted':40} {'planted':>8} {'found':>8} {'logs with more':>15}")
    for name, (planted, found, more) in counted.items():
        print(f"{name:40} {planted:8} {found:8} {more:15}")


if __name__ == "__main__":
    main()
