"""Sizes of chosen effects in one recording, whether significant or not, to compare units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from imutool.diagnosis.diagnose import candidates_for
from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.noise_estimate import whitened
from imutool.diagnosis.estimation.observability import unobservable, with_free
from imutool.diagnosis.estimation.significance import scatter
from imutool.diagnosis.held_out import gains, with_constant
from imutool.diagnosis.reference import align, without_unusable
from imutool.diagnosis.result import Closer
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.location import Location
from imutool.mcap_io.read import read as read_log
from imutool.sensor import catalogue

EVERY_UNIT = (
    "mount_rotation",
    "gyro_scale",
    "accel_scale",
    "lever_arm",
    "clock_offset",
)  # of these every unit has a little


class EffectSizes(NamedTuple):
    """Effects with their parameters, by effect how sure those are (as blocks of time scatter), and the stretches' biases.

    `information` is the noise's alone, of all parameters in order.
    """

    chosen: Chosen
    std: dict[str, Float64[np.ndarray, " p"]]
    information: Float64[np.ndarray, "q q"]
    bias: Float64[np.ndarray, "stretches 6"]


def effect_sizes(
    real: Location,
    sim: Location | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    effects: Sequence[str] = EVERY_UNIT,
    settings: DiagnoseSettings | None = None,
) -> EffectSizes:
    """Sizes of some effects of the catalogue, fitted together to a recording, significant or not.

    Parameters that the motion cannot show are left out: the scale of a gyro's axis that never turns.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`; or an effect that has nothing to be fitted to here.
    """
    simulated = None if sim is None else read_log(sim, imu=imu)
    pairs = [without_unusable(pair) for pair in align(read_log(real, imu=imu, truth=truth), simulated, truth)]
    candidates = candidates_for(pairs)
    settings = settings or DiagnoseSettings()
    logs = [whitened(pair, candidates, settings.band) for pair in pairs]
    asked = catalogue.diagnosed(effects)
    hidden = set(unobservable(logs, asked, settings.search))
    shown = []
    for one in asked:
        free = [k for k, number in enumerate(one.parameters) if not {one.name, f"{one.name}.{number.name}"} & hidden]
        shown += [with_free(one, free)] if free else []
    found = fit(logs, tuple((one, one.null_value.astype(float)) for one in shown), part="all")
    std = scatter(logs, found, "all", settings.search.robust_block_s).std if shown else {}
    return EffectSizes(found.chosen, {name: np.asarray(one) for name, one in std.items()}, found.information, found.bias)


def residual_to_truth(
    real: Location, chosen: Chosen = (), *, imu: str | None = None, truth: str | None = None
) -> dict[str, Closer]:
    """Residual of a whole recording against its own true poses, by signal, without and with effects.

    The best constant of its own is in both; compared is as far up in frequency as the poses are known.

    Raises:
        ConfigError, LogError, DataError: as `diagnose`.
    """
    pairs = [without_unusable(pair) for pair in align(read_log(real, imu=imu, truth=truth), None, truth)]
    candidates = candidates_for(pairs)
    logs = []
    for log in (whitened(pair, candidates, DiagnoseSettings().band) for pair in pairs):
        unobservable = replace(log.pair, fitted=np.zeros_like(log.pair.fitted), held_out=log.pair.fitted | log.pair.held_out)
        logs.append(replace(log, pair=unobservable))
    before, after = ([with_constant(log.pair, expected(log.pair, one)) for log in logs] for one in ((), chosen))
    return gains(logs, before, after)
