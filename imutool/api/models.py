"""Load a bias model and apply it to a recording or a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np

from imutool import debiasing, evaluation
from imutool.api import Init, checked, init_text
from imutool.array_types import Float64
from imutool.bias import static
from imutool.bias.model import BiasModel
from imutool.bias.model_file import find_model, library, shipped_for
from imutool.bias_start import DEBIASED_BY, Fitness
from imutool.bias_start.correction import apply_with_std
from imutool.bias_start.earlier_load import switched_on_before
from imutool.bias_start.fitness import CHECKED_S
from imutool.bias_start.initial_bias import InitialBias
from imutool.bias_start.model_choice import find_initial_bias, fitness_in_memory
from imutool.bias_start.stretches import measured_imu, unusual_gravity
from imutool.debiasing import DebiasReport
from imutool.errors import ConfigError, DataError
from imutool.file_location import Location, LogPath, location, several
from imutool.log_info.convention_report import contradictions, warn_of_recordings
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.recording import Imu, Recording, nanoseconds
from imutool.report import Progress, silent

Model = str | Path | BiasModel


@checked
def load_model(name: str | Path, *, rate_hz: float | None = None, on_s: float | None = None) -> BiasModel:
    """Bias model from a file, by the name of a model that ships, or `static`.

    Args:
        name: `FILE.safetensors`, a name that `imutool models` lists, `static`, or a `physics.toml`.
        rate_hz: Sample rate; needed for a `physics.toml` alone.
        on_s: Seconds for which the sensor was on before its first sample, for a model with a warm-up. By default a recording
            shows it; an `OnlineDebiaser` cannot look ahead and assumes a cold sensor.

    Raises:
        ModelError: No such model (the message suggests the nearest name), or a damaged file.
        ConfigError: A `physics.toml` that cannot be read, or a negative time.

    Examples:
        >>> import imutool
        >>> model = imutool.load_model("linear.safetensors")
        >>> model.method, model.rate_hz
        ('linear', 200.0)
        >>> imutool.load_model("euroc-adis16448-hybrid").method
        'hybrid'
    """
    model = static.Model() if str(name) == static.Model.method else find_model(name, rate_hz)
    return model if on_s is None else switched_on_before(model, on_s)


def bias_at_rest(model: BiasModel, imu: Imu) -> InitialBias:
    """Initial bias from samples at rest.

    An `OnlineDebiaser` starts from it.

    Args:
        model: Bias model of the sensor.
        imu: Samples at rest, 1.5 s or more.

    Returns:
        `rest`, the bias (gyro in rad/s, accel in m/s²), its standard deviation `std`, and the method in words, `how`.

    Raises:
        ConfigError: `model` is not a loaded model, or `imu` not an `Imu`.
        DataError: The samples are not at rest, their accelerometer shows no gravity, or their times are not in nanoseconds.

    Examples:
        >>> import imutool
        >>> imu = imutool.read("flight_1.mcap").imu
        >>> start = imutool.bias_at_rest(imutool.load_model("static"), imu.rows(slice(0, 400)))
        >>> start.rest.shape
        (6,)
    """
    given: tuple[object, object] = (model, imu)
    if not isinstance(given[0], BiasModel) or not isinstance(given[1], Imu):
        what = f"are of type {type(given[0]).__name__}, {type(given[1]).__name__}"
        raise ConfigError(what, where="model, imu", expected="a model of `imutool.load_model`, and an `Imu`")
    imu.check_rate("imu")
    if wrong := unusual_gravity(imu.accel) if len(imu) else "":
        raise DataError(wrong, where="imu", expected="samples in rad/s and m/s²")
    try:
        return find_initial_bias("stationary", model, Recording("imu", imu))
    except DataError as error:  # of a log
        raise error.replaced(what="the samples do not begin at rest", where="imu", fix="") from None


@dataclass(frozen=True, eq=False, repr=False)
class DebiasedRecording:
    """Recording with debiased samples, and the bias that was subtracted.

    Attributes:
        recording: Input with the debiased IMU in place of the raw one; its metadata name the model, also in a log of it.
        bias: Subtracted bias at each sample: gyro (rad/s), then accel (m/s²).
        std: One standard deviation of `bias`.
        model: Name of the model.
        start: Initial bias: `rest`, `std` and, in words, `how`.
        fitness: Whether the model fits the recording: `verdict` (`fits`, `doubtful` or `unfit`) and `reasons`.
    """

    recording: Recording
    bias: Float64[np.ndarray, "n 6"]
    std: Float64[np.ndarray, "n 6"]
    model: str
    start: InitialBias
    fitness: Fitness

    def __repr__(self) -> str:
        mean = ["(" + ", ".join(f"{x:+.5f}" for x in part) + ")" for part in self.bias.mean(axis=0).reshape(2, 3)]
        bias = f"mean bias {mean[0]} rad/s, {mean[1]} m/s²" if len(self.bias) else "no samples"
        return f"Debiased by {self.model} ({self.start.how}): {bias}\n{self.recording!r}"

    @property
    def imu(self) -> Imu:
        """Debiased samples."""
        return self.recording.imu


@overload
def debias(
    source: Recording,
    target: Model | None = None,
    *,
    model: Model | None = None,
    init: Init = "auto",
    smooth: bool = False,
    force: bool = False,
) -> DebiasedRecording: ...


@overload
def debias(
    source: LogPath,
    target: LogPath | None = None,
    *,
    model: str | Path | Mapping[str, str | Path] | None = None,
    init: Init = "auto",
    smooth: bool = False,
    imus: str | Sequence[str] = (),
    in_place: bool = False,
    check: str = "imu",
    force: bool = False,
    encoding: str = "own",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> DebiasReport: ...


@checked
def debias(
    source: LogPath | Recording,
    target: LogPath | BiasModel | None = None,
    *,
    model: Model | Mapping[str, str | Path] | None = None,
    init: Init = "auto",
    smooth: bool = False,
    imus: str | Sequence[str] = (),
    in_place: bool = False,
    check: str = "imu",
    force: bool = False,
    encoding: str = "own",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> DebiasedRecording | DebiasReport:
    """Subtract the IMU's bias from a recording, or write a debiased log.

    `debias(recording, model)` returns arrays. `debias("in.mcap", "out.mcap", model=...)` writes a log with every record of the
    old one, `/imu0/debiased`, the bias and its covariance. Without `smooth` the bias of a sample depends on no later sample.

    Args:
        source: Recording, or MCAP log: a file or a URL.
        target: Log to write. With a recording, the second argument is the model.
        model: Model file, name of a model that ships, `static`, or a dictionary from IMU topic to model. By default the
            model that ships for this unit of the sensor, else the mean at rest. With a recording, also a loaded model.
        init: Initial bias: `auto`, `stationary`, `prior`, `truth`, `truth:SECONDS`, or six numbers (rad/s, m/s²).
        smooth: Estimate the initial bias from the whole log, forward and backward.
        imus: IMU topics of a log; by default the only one.
        in_place: Replace the log `source` instead of writing `target`.
        check: Chunks of a log whose CRC is compared: `imu`, `all` or `none`.
        force: Use a model although it does not fit the log.
        encoding: Encoding of the new IMU topic: `own`, as its source, or `cdr`.
        overwrite: Replace an existing `target`.
        progress: Callback with bytes done and bytes in all.

    Raises:
        ConfigError: A file cannot be opened, `target` is missing or exists, or options contradict each other.
        LogError, DataError: No such IMU, a log that is debiased already, damage, or times that are not in nanoseconds.
        ModelError: No model and no time at rest, a model for another rate or that does not fit the log, a damaged model file.

    Examples:
        >>> import imutool
        >>> recording = imutool.read("flight_2.mcap")
        >>> debiased = imutool.debias(recording, imutool.load_model("linear.safetensors"))
        >>> debiased.imu.gyro.shape, debiased.bias.shape
        ((4001, 3), (4001, 6))
        >>> report = imutool.debias("flight_2.mcap", "debiased.mcap", model="linear.safetensors")
        >>> report.rewrite.added["/imu0/debiased"]
        4001
    """
    start = init_text(init)
    if isinstance(source, Recording):
        for_logs = {"imus": imus, "in_place": in_place, "check": check != "imu", "encoding": encoding != "own"}
        _refuse(for_logs | {"overwrite": overwrite, "progress": progress, "target": model is not None and target})
        return _debias_recording(source, model if target is None else target, start, smooth, force)
    place, out, chosen = _log_to_debias(source, target, model, in_place=in_place, overwrite=overwrite)
    run = partial(debiasing.debias, place, out, model=chosen, imus=several(imus), init=start, smooth=smooth, check=check)
    return run(encoding=encoding, force=force, overwrite=overwrite, progress=progress or silent)


def _log_to_debias(
    source: object, target: object, model: Model | Mapping[str, str | Path] | None, *, in_place: bool, overwrite: bool
) -> tuple[Location, Location | None, str | Path | Mapping[str, str | Path] | None]:
    """Log, target and model, checked before any work."""
    place = location(source)
    if isinstance(model, BiasModel) or isinstance(target, BiasModel):
        raise ConfigError("this is a loaded model", where="model", expected="a model file, whose digest goes into the log")
    if target == static.Model.method or (library() / f"{target}.safetensors").is_file():
        raise ConfigError(f"{target!r} is a model", where="target", expected="the new log", fix="Give the model as `model`")
    if in_place == (target is not None):
        raise ConfigError("neither or both of `target` and `in_place` are given", where="debias", expected="one of the two")
    out, given = None if target is None else location(target), list(model.values()) if isinstance(model, Mapping) else model
    check_outputs([OutputFile("target", out, output_conflicts.LOG)], [place, given], overwrite=overwrite)
    return place, out, model


def _refuse(options: Mapping[str, object]) -> None:
    """Refuse options of a log, by name, that are given with a recording."""
    if names := ", ".join(name for name, given in options.items() if given):
        fix = "Leave it out, and write the result with `imutool.write(path, debiased.recording)`"
        raise ConfigError("a recording is debiased to arrays, with one model", where=names, fix=fix)


def _debias_recording(recording: Recording, model: object, init: str, smooth: bool, force: bool) -> DebiasedRecording:
    if not isinstance(model, Model | None):
        raise ConfigError(
            f"is of type {type(model).__name__}", where="model", expected="one model: a file, a name or a loaded model"
        )
    recording.imu.check_rate(recording.name)
    about = recording.metadata.get("imutool", {})
    if (by := evaluation.debiased_by(about, recording.imu_topic)) and not force:
        what = f"its IMU is debiased already, by {by}"
        raise DataError(what, where=recording.name, fix="Start from the raw recording, or set `force`")
    measured_imu(recording.imu, recording.name)  # warns of what is no measurement, and refuses a recording of nothing else
    first_ns = int(recording.imu.t_ns[0]) if len(recording.imu) else 0
    begun = recording.between(first_ns, first_ns + nanoseconds(CHECKED_S))  # as much as the command looks at
    wrong = [text for whole in warn_of_recordings([begun]) for text in contradictions(whole)]
    given = next(iter(shipped_for(about)), static.Model.method) if model is None else model
    ((name, chosen, start),) = evaluation.started(recording, [given], init, recording.name, smooth=smooth, force=force)
    fitness = fitness_in_memory(chosen, start, recording, wrong)
    fitness.report(name, recording.name, force=force)
    debiased, std = apply_with_std(chosen, start, recording.imu)
    marked = {**recording.metadata, "imutool": {**about, DEBIASED_BY: name}}
    return DebiasedRecording(replace(recording, imu=debiased.imu, metadata=marked), debiased.bias, std, name, start, fitness)
