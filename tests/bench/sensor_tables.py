"""What several recordings of one sensor, each fitted apart, say together: consistency, tables in Markdown, one picture.

Uncertainties are those that were stated. How far they can be believed, the recordings tell of each other: z is Birge's ratio,
the root mean square of a parameter's deviations from its weighted mean, each in its own sigmas (1 where they are honest).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SHOWN_IN = {"-": ("%", 1e2), "m": ("mm", 1e3), "s": ("ms", 1e3), "rad": ("mrad", 1e3)}  # by unit: what a table shows
UNSEEN = 4.0  # times the plausible size: a number that no motion showed
MAX, ALL = 0.5, 1.0  # of the sequences
COLORS = ("#c23b3b", "#2f8f4e", "#2f62b5")  # x, y, z
PICTURED = ("gyro_scale", "accel_scale", "lever_arm", "clock_offset")


class Value(NamedTuple):
    """A parameter of one sequence: in its unit, with its stated standard deviation and the plausible size."""

    value: float
    std: float
    unit: str
    plausible: float

    @property
    def seen(self) -> bool:
        """Whether the motion showed it at all."""
        return abs(self.value) <= UNSEEN * self.plausible and self.std < self.plausible


@dataclass(frozen=True)
class Consistency:
    """Weighted mean with the deviation that z implies, the spread (standard deviation) of the values, and Birge's z."""

    mean: float
    std: float
    spread: float
    z: float
    count: int


def consistency(values: Iterable[tuple[float, float]]) -> Consistency:
    """Of values with their standard deviations; the mean's own is widened by z where that is above 1.

    One value has no spread: both are then not a number, as everything is where there is none.
    """
    pairs = np.array(list(values), dtype=np.float64).reshape(-1, 2)
    x, weight = pairs[:, 0], 1.0 / pairs[:, 1] ** 2
    if not len(x):
        return Consistency(np.nan, np.nan, np.nan, np.nan, 0)
    mean, std = float(weight @ x / weight.sum()), float(weight.sum() ** -0.5)
    if len(x) == 1:
        return Consistency(mean, std, np.nan, np.nan, 1)
    z = float(np.sqrt(weight @ (x - mean) ** 2 / (len(x) - 1)))
    return Consistency(mean, std * max(1.0, z), float(x.std(ddof=1)), z, len(x))


def together(thetas: Sequence[np.ndarray], informations: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean of parameter vectors weighted by their information, and its covariance: a joint fit's, as far as it is linear."""
    total = np.sum(informations, axis=0)
    covariance = np.linalg.pinv(total, hermitian=True)
    return covariance @ np.sum([N @ theta for N, theta in zip(informations, thetas, strict=True)], axis=0), covariance


def how_often(count: int, of: int) -> str:
    """All, most, some or one of the sequences."""
    if count == of:
        return "all"
    return "most" if count > MAX * of else "one" if count == 1 else "some"


def agreed(found: Mapping[str, Iterable[str]], lasting: Iterable[str]) -> tuple[str, ...]:
    """Effects, of those that last from one recording to the next, that came up in at least half the sequences."""
    effects = [set(names) for names in found.values()]
    return tuple(name for name in sorted(lasting) if sum(name in names for names in effects) >= MAX * len(effects))


# ── tables ──


def shown(value: float, std: float, unit: str) -> str:
    """A number with its deviation, in the unit that a table shows, to two digits of the deviation."""
    _, factor = SHOWN_IN.get(unit, (unit, 1.0))
    value, std = value * factor, std * factor
    if not np.isfinite(value):
        return "–"
    if not np.isfinite(std) or std <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    return f"{value:.{digits}f} ± {std:.{digits}f}"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def parameter_rows(measured: Mapping[str, Mapping[str, Value]]) -> dict[str, dict[str, Value]]:
    """By parameter instead of by sequence, only where the motion showed it."""
    out: dict[str, dict[str, Value]] = {}
    for sequence, values in measured.items():
        for name, value in values.items():
            if value.seen:
                out.setdefault(name, {})[sequence] = value
    return out


def consistency_table(measured: Mapping[str, Mapping[str, Value]], published: Mapping[str, float] | None = None) -> str:
    """A row a parameter: mean over the sequences, spread, z; against what is published, where something is."""
    head = ["parameter", "seen in", "mean", "spread", "stated ± (median)", "z", *(["published"] if published else [])]
    rows = []
    for name, values in parameter_rows(measured).items():
        unit = next(iter(values.values())).unit
        label, factor = SHOWN_IN.get(unit, (unit, 1.0))
        told = consistency([(one.value, one.std) for one in values.values()])
        stated = factor * float(np.median([one.std for one in values.values()]))
        cells = [f"{name} ({label})", f"{told.count} of {len(measured)}", shown(told.mean, told.std, unit)]
        cells += (
            [f"{factor * told.spread:.2g}", f"{stated:.2g}", f"{told.z:.1f}"] if told.count > 1 else ["–", f"{stated:.2g}", "–"]
        )
        if published:
            cells.append(f"{factor * published[name]:.2f}" if name in published else "–")
        rows.append(cells)
    return markdown(head, rows)


def values_table(measured: Mapping[str, Mapping[str, Value]]) -> str:
    """A row a parameter, a column a sequence."""
    rows = []
    for name, values in parameter_rows(measured).items():
        unit = next(iter(values.values())).unit
        cells = [shown(values[one].value, values[one].std, unit) if one in values else "–" for one in measured]
        rows.append([f"{name} ({SHOWN_IN.get(unit, (unit, 1.0))[0]})", *cells])
    return markdown(["parameter", *measured], rows)


def findings_table(diagnoses: Mapping[str, Mapping[str, Any]]) -> str:
    """A row an effect that was found: where, and the share of its signal's misfit that it removes on unseen time."""
    by_effect: dict[str, dict[str, float]] = {}
    for sequence, told in diagnoses.items():
        for one in told["findings"]:
            name = f"{one['effect']} ({one['signal']})" if one["effect"] in {"unknown", "driven"} else one["effect"]
            by_effect.setdefault(name, {})[sequence] = float(one["share"])
    rows = []
    for name, shares in sorted(by_effect.items(), key=lambda entry: (-len(entry[1]), entry[0])):
        where, lacking = how_often(len(shares), len(diagnoses)), [one for one in diagnoses if one not in shares]
        listed = {"all": "", "most": f"not {', '.join(lacking)}"}.get(where, ", ".join(shares))
        share = float(np.median(list(shares.values())))
        removed = f"{100.0 * share:.0f} %" if share > 0.0 else "–"  # digits and stamps take nothing off
        rows.append([name, f"{where} ({len(shares)} of {len(diagnoses)})", removed, listed])
    return markdown(["found", "in", "of the misfit (median)", "sequences"], rows)


def gain_table(gains: Mapping[str, Mapping[str, Any]]) -> str:
    """A row a test sequence: rms against its own poses and orientation, without and with what the training sequences showed."""
    head = ["test sequence", "gyro rms (rad/s)", "accel rms (m/s²)", "AOE raw → bias → physics (°)", "5 s windows (°)"]
    rows = []
    for name, one in gains.items():
        rms = [
            f"{one[signal]['before']:.4f} → {one[signal]['after']:.4f} ({change(one[signal])})" for signal in ("gyro", "accel")
        ]
        turned = [
            " → ".join(f"{one['orientation'][model][key]:.2f}" for model in ("raw", "static", "physics"))
            for key in ("aoe_deg", "roe_deg")
        ]
        rows.append([name, *rms, *turned])
    return markdown(head, rows)


def change(one: Mapping[str, float]) -> str:
    """From before to after, in per cent."""
    return f"{100.0 * (one['after'] / one['before'] - 1.0):+.0f} %"


# ── the picture ──


def picture(
    sensors: Mapping[str, Mapping[str, Mapping[str, Value]]],
    tests: Iterable[str],
    path: Path,
    published: Mapping[str, Mapping[str, float]],
) -> None:
    """Parameters by sequence with error bars, a column a sensor; test sequences hollow, what is published dashed."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    aside = set(tests)
    figure, axes = plt.subplots(len(PICTURED), len(sensors), figsize=(4.0 * len(sensors), 7.2), squeeze=False, sharex="col")
    for column, (sensor, measured) in enumerate(sensors.items()):
        rows = parameter_rows(measured)
        sequences = list(measured)
        for row, effect in enumerate(PICTURED):
            panel = axes[row][column]
            _panel(panel, {name: rows[name] for name in rows if name.startswith(f"{effect}.")}, sequences, aside)
            for k, axis in enumerate("xyz"):
                if f"{effect}.{axis}" in published.get(sensor, {}) and f"{effect}.{axis}" in rows:
                    panel.axhline(1e2 * published[sensor][f"{effect}.{axis}"], color=COLORS[k], lw=0.8, ls="--")
            panel.set_ylabel(
                f"{effect.replace('_', ' ')} ({ {'lever_arm': 'mm', 'clock_offset': 'ms'}.get(effect, '%') })", fontsize=7
            )
        axes[0][column].set_title(sensor, fontsize=9)
        axes[-1][column].set_xticks(
            range(len(sequences)), [name.split("_")[0] if sensor != "euroc" else name[:5] for name in sequences], fontsize=6
        )
    colored = [
        Line2D([], [], color=color, marker="o", ms=3.5, lw=0.8, label=axis) for axis, color in zip("xyz", COLORS, strict=True)
    ]
    axes[0][0].legend(handles=colored, fontsize=6, ncols=3, frameon=False)
    figure.tight_layout(pad=0.6)
    figure.savefig(path, dpi=85)
    plt.close(figure)
    _fewer_colors(path)


def _panel(panel: Any, rows: Mapping[str, Mapping[str, Value]], sequences: Sequence[str], aside: set[str]) -> None:
    for name, values in rows.items():
        k = "xyz".find(name[-1]) if name[-2] == "." else 0
        for sequence, one in values.items():
            factor = SHOWN_IN[one.unit][1]
            at = sequences.index(sequence) + 0.18 * (k - 1)
            fill = "white" if sequence in aside else COLORS[k]
            panel.errorbar(at, factor * one.value, 2.0 * factor * one.std, fmt="o", ms=3.5, color=COLORS[k], mfc=fill, lw=0.8)
    panel.axhline(0.0, color="0.7", lw=0.6)
    panel.tick_params(labelsize=6)


def _fewer_colors(path: Path) -> None:
    """32 colours: a third of the bytes."""
    from PIL import Image

    with Image.open(path) as drawn:
        drawn.convert("RGB").quantize(32).save(path, optimize=True)
