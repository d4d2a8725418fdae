"""What several commands print: a line of training, and evaluation results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from imutool.cli.terminal import table

if TYPE_CHECKING:
    from imutool.training.fit import Epoch


def epoch_line(epoch: Epoch) -> tuple[int, int, str]:
    """A line of training as progress: steps done, steps in all, the figures in words."""
    if epoch.note:
        return 0, 1, epoch.note
    scale, unit = (180.0 / math.pi, "°") if epoch.sensor == "gyro" else (1.0, " m/s")
    held_out, before = epoch.held_out * scale, epoch.before * scale
    minutes, seconds = divmod(round(epoch.left_s), 60)
    loss = "" if math.isnan(epoch.loss) else f"loss {epoch.loss:.3f}, "  # before the first step there is none
    text = f"{epoch.sensor} {epoch.step}/{epoch.steps}: {loss}held out {held_out:.3f}{unit} (closed form {before:.3f})"
    return epoch.step, max(epoch.steps, 1), f"{text}, {minutes}:{seconds:02d} left" if epoch.step else text


def figures(results: Sequence[dict[str, Any]]) -> None:
    """Evaluation results as two tables: over the whole path, and per metres flown."""

    def number(value: float | None) -> str:
        return "–" if value is None else format(value, ".2f")

    distances = list(results[0]["roe_deg"])
    names = ("aoe_deg", "aoe_aligned_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s")
    whole = [("log", "model", "AOE\n°", "aligned\n°", "APE\nm", "aligned\nm", "velocity\nm/s")]
    roe = [("log", "model", *(f"ROE °\n{d} m" for d in distances))]
    rpe = [("log", "model", *(f"RPE m\n{d} m" for d in distances))]
    for one in results:
        whole.append((one["log"], one["model"], *(number(one[name]) for name in names)))
        roe.append((one["log"], one["model"], *(number(one["roe_deg"][d]) for d in distances)))
        rpe.append((one["log"], one["model"], *(number(one["rpe_m"][d]) for d in distances)))
    for rows in (whole, roe, rpe):
        table(rows, keys=2)
