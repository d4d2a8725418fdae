"""Whether debiasing knows how sure it is: errors of bias, attitude and velocity, and what their covariances say.

    python tests/bench/consistency.py --model M.safetensors|static LOG... [--start truth|auto|smooth] [--each-log]
    python tests/bench/consistency.py --left-out TRAINING_LOG...
    python tests/bench/consistency.py --made-up SENSORS [--rest 0|8] [--known rest walk prior speed]

The bias: every `TRUTH_S` of a log the gyro's rest bias is measured from the truth around (the slope, in time, of what
integration misses), and the difference to the bias in use is weighed by its covariance plus that of the measurement. Attitude
and velocity: the debiased samples are integrated from a true pose for `WINDOWS_S`, and the errors at the end are weighed by
the stated covariance of the bias, carried over the window, the white noise of the samples and the poses' own errors
(`tests/support/error_growth.py`). Each has three degrees of freedom: honest covariances give a mean of 3; the bounds are
chi-square's. The coverage is the share of windows within the ellipsoids that should hold 68, 95 and 99.7 % of them. With
`--left-out` each log is judged by the closed form of all others. `--made-up` draws sensors, each with its own size of errors
and noise, learns each from `TRAINING` logs of one switching-on, and judges it by the exact poses of `TESTS` logs of others:
here the poses have no error, and there are windows enough to see a few points, and the rate of a debiased message is compared
with the exact one. With `--known` the filter is told what such a sensor is like: no offset at rest, its own walk, the size of
its turn-on bias, the speed of the body. V1_01 is compared with its recomputed truth. With `--factor` a second coverage stands
next to the first: each log's covariance of the bias times a factor by which the other logs' 68 % ellipsoids hold 68 % of their
windows (split conformal prediction, with the logs as the sample). With `--learned` the logarithm of that factor is a linear
function of a window's motion (`support.covariance_factors`), learned from the other logs by the likelihood of their errors: a
covariance as one more head of the model, as AirIMU has (Qiu et al., arXiv 2310.04874).

The calibration's share of a window's covariance is that of the slope: its unknowns are the same at every sample, and what goes
with the motion mostly cancels over 15 s, which the samples' covariances one by one do not show. What a measurement is worth is
seen in the log itself, for truths differ by a factor of eight from log to log: how far half windows differ from the next ones
(Allan's variance), carried over to whole ones as errors of an attitude go, with T^-3/2. Where the truth's errors last for
seconds that is too little, and too much is never forgiven. Errors of a rest bias last longer than a window: the bounds, for
independent windows, are a little narrow. The poses' errors at the ends of a window come from second differences over a second;
after one second they are most of the error, so that only the made-up sensors say something there. The lean of a truth's world
is fitted to each log.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from copy import copy
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from jaxtyping import Float64

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.benchmarks import recordings
from support.covariance_factors import Judgement, coverage, features_of, with_factor, with_head
from support.error_growth import Judged, Motion
from support.nees import consistency
from support.switchings_on import Switchings, log

from imutool.bias import static
from imutool.bias.model import BiasModel
from imutool.bias.model_file import load
from imutool.bias_start import initial_bias
from imutool.bias_start.bias_from_truth import TRUTH_S, bias_from_truth
from imutool.bias_start.initial_bias import MIN_STD, InitialBias
from imutool.bias_start.model_choice import estimate_at_rest, find_initial_bias, smooth_in_memory
from imutool.geometry import so3
from imutool.inertial.inertial_filter import FilterSettings
from imutool.inertial.windows import running_product, step_means
from imutool.recording import Poses, Recording
from imutool.sensor.made_up_flight import ACCEL

STARTS = ("truth", "auto", "smooth")
WINDOWS_S = (1.0, 5.0, 15.0)
TRAINING, TESTS, RESTS_S = 4, 3, (0.0, 8.0)
ERRORS = ("truth_noise", "turn_on_rad_s", "scale", "misalignment_rad", "noise_rad_s_rthz", "walk_rad_s2_rthz")  # of a gyro
KNOWN, CORRELATION_S = ("rest", "walk", "prior", "speed"), FilterSettings().speed_correlation_s


class Case(NamedTuple):
    """A log, the model that judges it, and of a made-up sensor the exact poses, the exact rate and its kind."""

    recording: Recording
    model: BiasModel
    exact: Poses | None = None
    rate: Float64[np.ndarray, "n 3"] | None = None
    kind: Switchings | None = None


def main() -> None:
    """One line a start and quantity for all logs together, and with `--each-log` for every one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="*")
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--model", type=Path)
    which.add_argument("--left-out", action="store_true")
    which.add_argument("--made-up", type=int, metavar="SENSORS")
    parser.add_argument("--rest", type=float, choices=RESTS_S, help="only made-up sensors with such a stop (s)")
    parser.add_argument("--known", nargs="+", choices=KNOWN, default=[], help="what the filter is told of made-up sensors")
    parser.add_argument("--start", action="append", choices=STARTS)
    parser.add_argument("--each-log", action="store_true")
    parser.add_argument("--factor", action="store_true")
    parser.add_argument("--learned", action="store_true")
    parser.add_argument("--turn-error", type=float, help="share of a turn, in place of the calibration's own")
    options = parser.parse_args()
    if not options.made_up and (options.known or options.rest is not None):
        parser.error("--known and --rest are of made-up sensors: give --made-up")
    found: dict[tuple[str, str], list[Judgement]] = defaultdict(list)
    starts = options.start or STARTS
    cases = made_up(options.made_up, options.rest) if options.made_up else recorded(options.logs, options.model)
    for case in cases:
        if options.turn_error:
            case.model.card = {**case.model.card, "turn_error": options.turn_error}
        for start in starts:
            for quantity, one in judged_knowing(case, start, options.known):
                found[start, quantity].append(one)
                if options.each_log and len(one.error):
                    print(f"{start:7}{quantity:16}{case.recording.name:24}", told([one]), flush=True)
    if not found:
        parser.error("no log to judge")
    for start in starts:
        for (of, quantity), logs in found.items():
            if of == start:
                also = with_factor(logs) if options.factor else with_head(logs) if options.learned else ""
                print(f"{start:7}{quantity:16}{'all':24}", told(logs), also)


def recorded(paths: list[Path], model: Path | None) -> Iterator[Case]:
    """Logs with a model, or each with the closed form of all others."""
    logs = recordings(paths)
    for one in logs:
        if model and str(model) == static.Model.method:
            yield Case(one, static.Model())
        else:
            yield Case(one, load(model) if model else learned_from([other for other in logs if other is not one]))


def made_up(sensors: int, rest_s: float | None = None) -> Iterator[Case]:
    """Logs of sensors of many sizes, each with a model of its own that other logs gave; `rest_s` chooses among them."""
    for seed in range(sensors):
        rng = np.random.default_rng([seed, 20])
        kind = Switchings(
            sensor_seed=seed,
            turn_on_rad_s=10.0 ** rng.uniform(-3.3, -2.0),
            turn_on_m_s2=10.0 ** rng.uniform(-2.0, -1.0),
            scale=10.0 ** rng.uniform(-3.0, -1.7),
            misalignment_rad=10.0 ** rng.uniform(-3.0, -1.7),
            noise_rad_s_rthz=10.0 ** rng.uniform(-4.3, -3.3),
            walk_rad_s2_rthz=10.0 ** rng.uniform(-5.5, -4.3),
            room_m=10.0 ** rng.uniform(-0.7, 0.3),
            mount_rad=0.0,
            clock_s=0.0,
            rest_s=float(rng.choice(RESTS_S)),
            duration_s=60.0,
        )
        if rest_s not in (None, kind.rest_s):
            continue
        first = 100 * seed
        model = learned_from([log(first + k, first, kind) for k in range(TRAINING)])
        for k in range(50, 50 + TESTS):
            test = log(first + k, first + k, kind)
            exact = log(first + k, first + k, replaced(kind, **dict.fromkeys(ERRORS, 0.0)))
            assert np.array_equal(test.imu.t_ns, exact.imu.t_ns)
            yield Case(test, model, exact.truth, exact.imu.gyro, kind)


def judged_knowing(case: Case, start: str, known: Sequence[str]) -> list[tuple[str, Judgement]]:
    """Errors and their covariances by a filter that is told some of the sensor's own statistics."""
    if case.kind is None or case.exact is None or not known:
        return list(judged(case, start))
    model, kind, tensors = copy(case.model), case.kind, dict(case.model.tensors)
    if "rest" in known:
        tensors["rest_std"] = MIN_STD
    if "walk" in known:
        tensors["walk_std"] = np.array([kind.walk_rad_s2_rthz] * 3 + [ACCEL.walk_density] * 3)
    if "prior" in known:
        std = np.array([kind.turn_on_rad_s] * 3 + [kind.turn_on_m_s2] * 3)
        tensors |= {"prior_mean": np.zeros(6), "prior_std": std}
        model.card = {key: model.card[key] for key in model.card if key not in ("sessions", "turn_on_least_std")}
    if "speed" in known:
        assert case.exact.v_w is not None
        speed_m_s = float(np.sqrt((case.exact.v_w**2).mean()))
        model.card = {**model.card, "speed": {"speed_m_s": speed_m_s, "speed_correlation_s": CORRELATION_S}}
    model.tensors = tensors
    with patch.object(initial_bias, "AT_REST_STD", MIN_STD if "rest" in known else initial_bias.AT_REST_STD):
        return list(judged(case._replace(model=model), start))


def replaced(kind: Switchings, **changes: float) -> Switchings:
    """A kind with other settings."""
    return Switchings(**{name: getattr(kind, name) for name in kind.__struct_fields__} | changes)


def learned_from(recordings: list[Recording]) -> BiasModel:
    """Closed form of some logs."""
    from left_out import learned

    return learned(recordings, [])


def judged(case: Case, start: str) -> Iterator[tuple[str, Judgement]]:
    """Errors and their covariances, by quantity."""
    model, recording = case.model, case.recording
    imu, smooth = recording.imu, start == "smooth"
    if start == "auto" and isinstance(model, static.Model):  # as the command does
        model, begun = estimate_at_rest(imu, recording.name)
    else:
        begun = smooth_in_memory(model, imu, recording.name) if smooth else find_initial_bias(start, model, recording)
    from_s = TRUTH_S if start == "truth" else 0.0  # what it was found from proves nothing
    known = None if case.exact is None else np.zeros(6)
    one = Judged(model, begun, imu, case.exact or recording.truth, known)
    yield "bias", rest_bias(model, begun, one, from_s, recording)
    if case.rate is not None:
        yield "message", message(one, case.rate, from_s)
    for length_s in WINDOWS_S:
        grown = one.errors(length_s, from_s)
        for name, axes in (("attitude", slice(0, 3)), ("velocity", slice(3, 6))):
            if name == "velocity" and not (case.exact or recording.truth).has_positions:
                continue
            parts = (P[:, axes, axes] for P in grown[1:])
            features = features_of(one.motion, one.motion.windows(length_s, from_s))[: len(grown.error)]
            yield f"{name} {length_s:g} s", Judgement(grown.error[:, axes], *parts, features)


def message(one: Judged, rate: Float64[np.ndarray, "n 3"], from_s: float) -> Judgement:
    """Errors of the debiased rate at the beginning of each second, and the covariance of its message."""
    seconds = one.motion.windows(1.0, from_s)
    rows = [second.start for second in seconds]
    S, white = one.stated.roots[rows, :3], np.tile(np.diag(one.noise[:3] ** 2), (len(rows), 1, 1))
    P = one.stated.rest[rows, :3, :3] + S @ S.transpose(0, 2, 1)
    return Judgement(one.motion.samples[rows, :3] - rate[rows], P, white, features_of(one.motion, seconds))


def rest_bias(model: BiasModel, begun: InitialBias, one: Judged, from_s: float, recording: Recording) -> Judgement:
    """Differences of the gyro's rest bias to what the truth says, window by window, and what covariance they should have."""
    S = one.roots.get("gyro", np.zeros((len(one.bias), 3, 0)))
    measured = np.diag(measured_variance(model, one, recording))
    errors, covariances = [], []
    for rows in one.motion.windows(TRUTH_S, from_s):
        T = slope_of(one.motion, rows, S)
        errors.append(gyro_offset(one.motion, rows))
        covariances.append(one.stated.rest[rows, :3, :3].mean(axis=0) + T @ T.T)
    every, features = np.tile(measured, (len(errors), 1, 1)), features_of(one.motion, one.motion.windows(TRUTH_S, from_s))
    return Judgement(np.reshape(errors, (-1, 3)), np.reshape(covariances, (-1, 3, 3)), every, features)


def gyro_offset(motion: Motion, rows: slice) -> Float64[np.ndarray, "3"]:
    """What a bias leaves of the rest bias over a window."""
    return bias_from_truth(*(column[rows] for column in motion))[:3]


def slope_of(motion: Motion, rows: slice, S: Float64[np.ndarray, "n 3 p"]) -> Float64[np.ndarray, "3 p"]:
    """What errors S of a window's debiased rate look like as an offset: the slope of their integral, by least squares."""
    dt, seen = torch.from_numpy(np.diff(motion.t_s[rows])), motion.trusted[rows][1:]
    rate = torch.from_numpy(motion.samples[rows, :3].copy())
    R = running_product(so3.exp(step_means(rate[None]) * dt[None, :, None]))[0] * dt[:, None, None]
    integral = torch.cumsum(R @ step_means(torch.from_numpy(S[rows]).movedim(2, 0)).movedim(0, 2), dim=0)[seen]
    X = torch.cat([torch.cumsum(R, dim=0)[seen], torch.eye(3, dtype=R.dtype).expand(len(integral), 3, 3)], dim=2)
    return np.asarray(torch.linalg.lstsq(X.flatten(0, 1), integral.flatten(0, 1)).solution[:3])


def measured_variance(model: BiasModel, one: Judged, recording: Recording) -> Float64[np.ndarray, "3"]:
    """Of an offset from a window, by axis; the training logs' where a log is too short to show it."""
    imu, at_prior = recording.imu, one.motion
    bias = model.stream(model.prior_mean)(at_prior.t_s, imu.gyro, imu.accel)
    motion = at_prior._replace(samples=at_prior.samples + one.bias - bias)
    starts_s = np.arange(motion.t_s[np.argmax(motion.trusted)], motion.t_s[-1] - TRUTH_S / 2, TRUTH_S / 4)  # half overlapping
    half = [gyro_offset(motion, rows) if (rows := motion.window(t, TRUTH_S / 2)) else np.full(3, np.nan) for t in starts_s]
    change = np.reshape(half[2:], (-1, 3)) - np.reshape(half[:-2], (-1, 3))
    change = change[np.isfinite(change).all(axis=1)]
    if not len(change):
        return np.asarray(model.truth_std[:3] ** 2)
    return np.asarray(0.5 * (change**2).mean(axis=0) / 2.0**3)


def told(logs: list[Judgement]) -> str:
    """The figures of `support.nees` in a line."""
    error, bias, other, _ = (np.concatenate(parts) for parts in zip(*logs, strict=True))
    if not len(error):
        return "no window"
    found = consistency(error, bias + other)
    bounds = f"95 % bounds {found['nees_lower']:.2f} to {found['nees_upper']:.2f}"
    covered = coverage(np.concatenate([log.squares() for log in logs]))
    rms = np.sqrt((error**2).sum(axis=1).mean())
    return f"NEES {found['nees_mean']:6.2f}  {bounds}  windows {found['samples']:3.0f}  coverage {covered}  rms {rms:.2e}"


if __name__ == "__main__":
    main()
