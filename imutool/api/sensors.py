"""Simulate an IMU, diagnose its physics, and make up a flight."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

import msgspec

from imutool import diagnosis_output
from imutool.api import checked, given_logs
from imutool.diagnosis.compared_logs import ComparedLogs
from imutool.diagnosis.result import Diagnosis
from imutool.diagnosis.second_simulation import along_samples
from imutool.file_location import LogPath, local, several
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.processes.blas_threads import one_blas_thread
from imutool.recording import Recording
from imutool.report import NamedProgress, silent
from imutool.sensor.made_up_flight import FlightSettings, flight
from imutool.sensor.simulate import Simulation
from imutool.sensor.simulate import simulate as simulate_log


@checked
def example_recording(seed: int = 1, *, duration_s: float = 20.0) -> Recording:
    """Made-up flight with true poses and biases.

    The sensor is at rest for the first three seconds.

    Args:
        seed: Motion, turn-on bias and drift. The sensor's calibration is the same for all seeds.
        duration_s: Length of the flight in seconds.

    Raises:
        ConfigError: A negative or infinite duration.

    Examples:
        >>> import imutool
        >>> recording = imutool.example_recording(seed=7, duration_s=5.0)
        >>> recording.name, len(recording.imu)
        ('flight_7', 1001)
    """
    return flight(seed, msgspec.structs.replace(FlightSettings(), duration_s=duration_s))


@checked
def simulate(
    trajectory: str | Path,
    out: str | Path,
    *,
    physics: str | Path | None = None,
    noise: str | Path = "none",
    rate_hz: float | None = None,
    seed: int = 0,
    truth: str | None = None,
    imu: str | None = None,
    overwrite: bool = False,
    progress: NamedProgress | None = None,
) -> Simulation:
    """Simulate an IMU along the true poses of a log, or from a simulator's samples.

    Args:
        trajectory: MCAP log with poses.
        out: Log to write.
        physics: `physics.toml` with the effects of the sensor; by default an ideal sensor.
        noise: `none`, a data sheet (`adis16448`, `bmi160`), or a TOML file.
        rate_hz: Sample rate; by default that of the log's IMU, otherwise 200 Hz.
        seed: Seed of the noise.
        truth: Pose topic; by default the first.
        imu: Topic of a simulated IMU whose samples, without their white noise, are the ideal signals instead of the poses.
        overwrite: Replace an existing log.
        progress: Callback with steps done, steps in all, and the current step.

    Returns:
        `recording`, the smoothed `motion` (None with `imu`), and `remarks`.

    Raises:
        ConfigError: A setting, a settings file, or an existing log.
        LogError: No poses, or damage.
        DataError: Less than 2 s of usable motion, no input channel for an effect, or poses that the log's IMU contradicts.

    Examples:
        >>> import imutool
        >>> simulation = imutool.simulate("flight_1.mcap", "ideal.mcap")
        >>> len(simulation.recording.imu) > 3900
        True
    """
    check_outputs([OutputFile("out", out, output_conflicts.LOG)], [trajectory, physics, noise], overwrite=overwrite)
    return simulate_log(
        local(trajectory, "trajectory"),
        local(out, "out"),
        physics=None if physics is None else local(physics, "physics"),
        noise=noise,
        rate_hz=rate_hz,
        seed=seed,
        truth=truth,
        overwrite=overwrite,
        progress=progress or silent,
        along=None if imu is None else partial(along_samples, imu=imu),
    )


@checked
def diagnose(
    reals: LogPath | Recording | Iterable[LogPath | Recording],
    sim: LogPath | Recording | None = None,
    *,
    imu: str | None = None,
    truth: str | None = None,
    signals: str | Sequence[str] = (),
    output: str | Path | None = None,
    close: bool = False,
    metric: Callable[[Path], float] | None = None,
    overwrite: bool = False,
    progress: NamedProgress | None = None,
) -> Diagnosis:
    """Find the physics that a simulation lacks: name, size, uncertainty and place.

    Args:
        reals: MCAP logs, or recordings of arrays. Several share the physics, with one constant bias each.
        sim: A simulation, likewise; by default each recording is compared with its own true poses.
        imu: IMU topic; needed where a log has several.
        truth: Topic of the true poses; by default the first.
        signals: Other fields to compare, `TOPIC.field`; one recording and its simulation.
        output: Folder for `findings.json`, `physics.toml`, `noise.toml`, `report.html`, `log.html` and `view.rrd`.
        close: Simulate again with the physics that was found, diagnose again, and compare. It needs one recording and `output`.
        metric: Your own figure for `close`, from the path of a simulated log: of `sim`, and of the one with the physics.
        overwrite: Replace an earlier diagnosis in `output`.
        progress: Callback with steps done, steps in all, and the current step.

    Returns:
        `findings`, each with effect, parameters, uncertainty and gain, and `remarks`; with `close` also `closed`. `report` is
        the JSON of the command.

    Raises:
        ConfigError: A log cannot be read, `output` exists, or `close` or `metric` without what it needs.
        LogError: No such topic.
        DataError: No truth and no simulation, or too little shared time.

    Examples:
        >>> import imutool
        >>> diagnosis = imutool.diagnose("real.mcap", "sim.mcap")  # doctest: +SKIP
        >>> [finding.effect for finding in diagnosis.findings]  # doctest: +SKIP
        ['lever_arm']
    """
    folder = None if output is None else local(output, "output")
    given = given_logs(reals, "reals"), given_logs([] if sim is None else [sim], "sim", minimum=0)
    with given[0] as logs, given[1] as sims, one_blas_thread():
        inputs = logs.places + sims.places
        check_outputs([OutputFile("output", folder, files=diagnosis_output.FILES)], inputs, overwrite=overwrite)
        return diagnosis_output.diagnose(
            ComparedLogs(logs.places, next(iter(sims.places), None), imu, truth, several(signals)),
            folder,
            names=logs.names | sims.names,
            close=close,
            metric=metric,
            overwrite=overwrite,
            tell=progress or silent,
        )[0]
