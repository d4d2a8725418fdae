"""VIO figures of a log and its models: the VIO columns of the paper's tables.

The IMU is the log's own, raw or as a model corrects it; the camera is EuRoC's stereo rig on every data set, its tracks are
simulated along the log's true poses (`imutool.vio.camera`). All runs of a log see the same tracks and the same settings; only
the samples differ. The estimate starts in the true state and is scored where the truth is known, at the keyframes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from imutool import config
from imutool.array_types import Bool, Int64
from imutool.errors import DataError, NumericsError
from imutool.evaluation import measured_once, runs
from imutool.inertial import metrics
from imutool.inertial.strapdown import StartPose, with_velocity
from imutool.log_info.convention_report import check_conventions
from imutool.mcap_io.read import read
from imutool.recording import Imu, Poses, Recording, nanoseconds, seconds
from imutool.report import NamedProgress, Progress, silent
from imutool.vio import camera, smoother
from imutool.vio.camera import Frame
from imutool.vio.smoother import Positive, SmootherSettings

SCHEMA = "imutool.vio/1"
ON, OFF = "on", "off"
ABSOLUTE = ("aoe_deg", "ape_m", "aoe_aligned_deg", "ape_aligned_m", "velocity_rmse_m_s")
RELATIVE = ("roe_deg", "rpe_m")
FIGURES = ("samples", "duration_s", *ABSOLUTE, *RELATIVE, "gyro_bias_end", "accel_bias_end")


class VioSettings(config.Settings, frozen=True, kw_only=True):
    """Camera, tracks and smoother of one comparison."""

    keyframes_hz: Annotated[float, Meta(gt=0.0, le=1000.0)] = 4.0  # rate of the images that are used
    features: Annotated[int, Meta(ge=1)] = 30  # tracks at a keyframe
    pixel_noise: Positive = 1.0  # px, of each coordinate; the smoother knows it
    blackout_s: Annotated[float, Meta(ge=0.0)] = 0.0  # the camera sees nothing this long ...
    blackout_every_s: Positive = 15.0  # ... out of every so many seconds
    duration_s: Positive | None = None  # of the stretch with truth; all of it by default
    seed: Annotated[int, Meta(ge=0)] = 0  # of the landmarks and the noise of pixels
    smoother: SmootherSettings = SmootherSettings()


class VioProblem(NamedTuple):
    """Keyframes of a log with the true poses and the camera's frames, shared by all runs."""

    rows: slice  # of the IMU, from the first keyframe to the last
    keyframes: Int64[np.ndarray, " k"]  # counted from the first
    true: Poses
    valid: Bool[np.ndarray, " k"]
    frames: list[Frame]


def vio(
    log: Path,
    *,
    models: Sequence[str | Path] = (),
    init: str = "auto",
    truth: str | None = None,
    imu: str | None = None,
    bias_states: Sequence[bool] = (True, False),
    settings: VioSettings | None = None,
    progress: NamedProgress = silent,
) -> list[dict[str, Any]]:
    """One result for the raw samples and each model, with bias states and without.

    Of a run that diverged, `failed` says why and the figures are null; the other runs go on.

    Raises:
        ConfigError: GTSAM is not installed.
        LogError, DataError: no IMU, no truth, the two share no time, or contradict each other (`check_conventions`).
        ModelError: a model that cannot be used with this log.
    """
    smoother.load()
    chosen = settings or VioSettings()
    recording = measured_once(read(log, imu=imu, truth=truth), log)
    check_conventions([recording])
    if truth is None and recording.truths:
        recording = recording.with_truth(next(iter(recording.truths)))
    problem = plan(recording, chosen)
    total = (1 + len(models)) * len(bias_states)
    results: list[dict[str, Any]] = []
    for name, debiased, start in runs(recording, models, init, log):
        for states in bias_states:
            tell = _within(progress, len(results), total, f"{recording.name} {name}, bias states {ON if states else OFF}")
            results.append(
                {
                    "log": recording.name,
                    "model": name,
                    "init": init if start else None,
                    "init_how": start.how if start else None,
                    "bias_states": states,
                    **score(debiased.imu, problem, chosen, bias_states=states, progress=tell),
                    "camera": camera.EUROC.name,
                    "tracks": round(camera.seen(problem.frames), 1),
                    "settings": msgspec.to_builtins(chosen),
                }
            )
    return results


def plan(recording: Recording, settings: VioSettings) -> VioProblem:
    """Keyframes over the stretch with truth, and what the camera sees there.

    Where the truth has gaps it sees nothing.

    Raises:
        DataError: no truth, one without positions, or too little of it for two keyframes.
    """
    if not recording.truth.has_positions:
        what = "the true poses have no positions"
        raise DataError(what, where=recording.name, expected="positions, along which the camera is simulated")
    imu = recording.imu
    truth = with_velocity(recording.truth)
    known = np.flatnonzero(truth.at(imu.t_ns)[1])
    if len(known) < 2:
        raise DataError("IMU and true poses share fewer than two samples", where=recording.name, expected="an overlap")
    first, last = int(known[0]), int(known[-1])
    if settings.duration_s is not None:
        end_ns = int(imu.t_ns[first]) + nanoseconds(settings.duration_s)
        last = min(last, int(np.searchsorted(imu.t_ns, end_ns, side="right")) - 1)
    rows = slice(first, last + 1)
    keyframes = _keyframes(imu.t_ns[rows], settings.keyframes_hz)
    if len(keyframes) < 2:
        raise DataError(
            f"the truth covers {(imu.t_ns[last] - imu.t_ns[first]) * 1e-9:.2f} s",
            where=recording.name,
            expected=f"two keyframes at {settings.keyframes_hz:g} Hz",
        )
    true, valid = truth.at(imu.t_ns[rows][keyframes])
    t_s = seconds(true.t_ns, int(true.t_ns[0]))
    sighted = valid & ~camera.blackouts(t_s, settings.blackout_s, settings.blackout_every_s)
    rng = np.random.default_rng(settings.seed)
    landmarks_w = camera.room(true.p_wb[valid], rng)
    frames, _ = camera.observe(true, sighted, landmarks_w, rng, features=settings.features, pixel_noise=settings.pixel_noise)
    return VioProblem(rows, keyframes, true, valid, frames)


def score(
    imu: Imu,
    problem: VioProblem,
    settings: VioSettings,
    *,
    bias_states: bool,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Figures of one run, or why it failed.

    They are those of `imutool.inertial.metrics`, aligned in heading and position at the first keyframe.
    """
    began = time.process_time()
    start = StartPose.of(problem.true)
    try:
        estimate = smoother.estimate(
            imu.rows(problem.rows),
            problem.keyframes,
            problem.frames,
            start,
            settings.smoother,
            pixel_std=settings.pixel_noise,
            bias_states=bias_states,
            progress=progress,
        )
        figures = metrics.evaluate(from_first_pose(estimate.poses, problem.true), problem.true, problem.valid)
    except NumericsError as error:
        return {"failed": str(error), **dict.fromkeys(FIGURES), "cpu_s": time.process_time() - began}
    bias = {"gyro_bias_end": estimate.bias[-1, :3].tolist(), "accel_bias_end": estimate.bias[-1, 3:].tolist()}
    return {"failed": None, **figures, **bias, "cpu_s": time.process_time() - began}


def from_first_pose(estimate: Poses, truth: Poses) -> Poses:
    """Estimate with the heading and position of the truth at the first row.

    The heading is that of the turn between the two first attitudes (the twist about z of R_true R_est^T); tilt stays, for
    gravity makes it the estimate's own error.
    """
    R_true, R_est = (Rotation.from_quat(poses.q_wb_wxyz[0], scalar_first=True) for poses in (truth, estimate))
    w, _, _, z = (R_true * R_est.inv()).as_quat(scalar_first=True)
    turn = Rotation.from_rotvec([0.0, 0.0, 2.0 * np.arctan2(z, w)])
    turned = (turn * Rotation.from_quat(estimate.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    p_wb = (estimate.p_wb - estimate.p_wb[0]) @ turn.as_matrix().T + truth.p_wb[0]
    return Poses(estimate.t_ns, p_wb, turned, None if estimate.v_w is None else estimate.v_w @ turn.as_matrix().T)


def _keyframes(t_ns: Int64[np.ndarray, " n"], rate_hz: float) -> Int64[np.ndarray, " k"]:
    """Rows of the samples nearest to an even clock that starts with the first; in a hole of the IMU there are fewer."""
    count = int((t_ns[-1] - t_ns[0]) * 1e-9 * rate_hz + 1e-6) + 1
    wanted = t_ns[0] + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    after = np.clip(np.searchsorted(t_ns, wanted), 1, len(t_ns) - 1)
    return np.unique(np.where(wanted - t_ns[after - 1] <= t_ns[after] - wanted, after - 1, after))


def _within(progress: NamedProgress, done: int, total: int, word: str) -> Progress:
    """Progress of one run as a part of all."""
    progress(1000 * done, 1000 * total, word)
    return lambda k, n: progress(1000 * done + 1000 * k // n, 1000 * total, "")


def tabulate(results: Sequence[dict[str, Any]]) -> Iterator[list[tuple[str, ...]]]:
    """Results as tables of text: absolute errors, then relative ones.

    Of a failed run there is nothing to show, nor of a path shorter than the distances.
    """
    distances = next((list(result["roe_deg"]) for result in results if not result["failed"]), [])
    keys = ("log", "model", "bias\nstates")
    absolute: list[tuple[str, ...]] = [(*keys, "AOE\n°", "APE\nm", "aligned\n°", "aligned\nm", "velocity\nm/s", "CPU\ns")]
    relative: list[tuple[str, ...]] = [(*keys, *(f"ROE °\n{d} m" for d in distances), *(f"RPE m\n{d} m" for d in distances))]
    for result in results:
        row = (result["log"], result["model"], ON if result["bias_states"] else OFF)
        if result["failed"]:
            absolute.append((*row, *["–"] * 5, f"{result['cpu_s']:.1f}"))
            continue
        absolute.append((*row, *(_number(result[name]) for name in ABSOLUTE), f"{result['cpu_s']:.1f}"))
        relative.append((*row, *(_number(result[name][d]) for name in RELATIVE for d in distances)))
    yield absolute
    if any(cell != "–" for row in relative[1:] for cell in row[len(keys) :]):
        yield relative


def _number(value: float | None) -> str:
    return "–" if value is None else format(value, ".3f")
