"""Coverage of a recording by its reference: alignment, unusable axes, checks without one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from imutool.array_types import Bool, Float64
from imutool.diagnosis.estimation import timestamps
from imutool.diagnosis.estimation.aligned_log import ClockDifference, Pair
from imutool.diagnosis.estimation.gauss_newton import Fit
from imutool.diagnosis.estimation.jacobians import Chosen, expected
from imutool.diagnosis.estimation.time_alignment import same_motion, with_simulation
from imutool.diagnosis.reference.own_poses import align_with_poses, band_hz
from imutool.diagnosis.reference.taken_samples import (
    batch_remark,
    filled,
    new_samples,
    on_own_clock,
    repeats,
    without_common_jitter,
)
from imutool.diagnosis.result import Diagnosis, Estimate, Finding, Located
from imutool.diagnosis.settings import AlignmentSettings, DiagnoseSettings
from imutool.diagnosis.wording.quantity import percent
from imutool.errors import DataError, ImutoolError, NumericsError
from imutool.inertial.stationary import white_noise
from imutool.recording import Recording, seconds
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect
from imutool.sensor.effects import saturation
from imutool.sensor.samples import IdealMotion
from imutool.sensor.simulate import MOTION_TOPIC
from imutool.sensor.trajectory import Stretch, smooth_motion
from imutool.units import AXES, SENSORS, UNITS

SOME = 0.05  # of the samples of an axis at its limit, from which it is reported
MOVES = 5.0  # times its noise: an axis should have moved so much to be called stuck
COPIED = 0.5  # share of a simulation's poses whose stamps the recording has, too: above, it may follow them
DRIFTING = frozenset({"clock_skew", "clock_jump", "clock_wander"})
KNOWN_S = 1e-3  # deviation of a clock difference, below which delays of other signals can be seen
BY_THEMSELVES = frozenset({"saturation", "quantization"})  # of the catalogue


def align_all(
    recordings: Sequence[Recording], sim: Recording | None, truth: str | None, settings: DiagnoseSettings
) -> tuple[list[Pair], list[str]]:
    """Recordings aligned with their references, and remarks on what is left out.

    Raises:
        DataError: as `_pairs` and `_telling`; of poses that are too poor only where none of several logs has better ones.
    """
    pairs: list[Pair] = []
    refused: list[ImutoolError] = []
    remarks = _held(sim, "the physics step is longer than the sample period") if sim is not None else []
    for recording, remark in _compared(recordings, settings.alignment):
        try:
            aligned = list(align(recording, sim, truth, settings))
        except (DataError, NumericsError) as error:
            if sim is not None or not recording.truths:
                raise
            refused.append(error.at(recording.name))
            continue
        pairs += map(without_unusable, aligned)
        remarks += [remark] if remark else []
        remarks += _held(recording, "the topic is faster than its sensor")
        remarks += batch_remark(recording)
        if repeated := sum(int(repeats(pair.real).sum()) for pair in aligned):
            remarks.append(f"{recording.name}: {repeated} samples repeat the one before on every axis, and do not count")
        if straight := sum(int(filled(pair.stamp_s, pair.real).sum()) for pair in aligned):
            where = "lie on a straight line between their neighbours on every axis, as where a gap was filled"
            remarks.append(f"{recording.name}: {straight} samples {where}, and do not count")
        covered = sum(float(pair.stamp_s[-1] - pair.stamp_s[0]) for pair in aligned)
        if covered < settings.reference.covered_share * recording.imu.duration_s:
            what = "its true poses cover" if sim is None else "the simulation covers"
            remarks.append(
                f"{recording.name}: {what} {covered:.0f} of {recording.imu.duration_s:.0f} s "
                f"in stretches of {settings.alignment.min_s:g} s or more without a hole; the rest was not looked at"
            )
    if refused and not pairs and len(recordings) > 1:
        raise refused[0]
    return pairs, remarks + [f"left out, {error}" if pairs else str(error) for error in refused]


def _held(recording: Recording, why: str) -> list[str]:
    """Remark on samples that repeat the one before, as a simulator or a driver holds them."""
    n = len(recording.imu) - len(new_samples(recording).imu)
    return [f"{recording.name}: {n} samples repeat gyro or accel of the one before, and do not count: {why}"] if n else []


def without_unseen_offset(candidates: Sequence[Effect], pairs: Sequence[Pair]) -> tuple[tuple[Effect, ...], Chosen]:
    """Candidates, and effects of every fit: a clock offset if the clocks share no epoch.

    What alignment by the motion leaves of it is no finding, but a filter or a delay cannot be fitted without it.
    """
    offset = tuple(e for e in candidates if e.name == "clock_offset" and any(pair.aligned_s for pair in pairs))
    return tuple(e for e in candidates if e not in offset), tuple((e, e.null_value.astype(float)) for e in offset)


def clock_difference(pairs: Sequence[Pair], found: Fit) -> ClockDifference | None:
    """Difference of two clocks without a common epoch, if the motion shows one that stays."""
    offsets = [float(theta[0]) for effect, theta in found.chosen if effect.name == "clock_offset"]
    if not offsets or not pairs[0].aligned_s or any(effect.name in DRIFTING for effect, _ in found.chosen):
        return None
    std_s = float(found.stds()["clock_offset"][0]) * float(np.sqrt(max(found.reduced_chi_square, 1.0)))
    return ClockDifference(pairs[0].aligned_s + offsets[0], std_s) if std_s < KNOWN_S else None


def with_unique_names(recordings: Sequence[Recording]) -> list[Recording]:
    """Recordings with unique names: logs of several folders may have the same."""
    out: list[Recording] = []
    for recording in recordings:
        name, number, taken = recording.name, 2, {other.name for other in out}
        while name in taken:
            name, number = f"{recording.name} ({number})", number + 1
        out.append(recording if name == recording.name else replace(recording, name=name))
    return out


def is_another_motion(reals: Sequence[Recording], sim: Recording, signals: Sequence[str], settings: AlignmentSettings) -> bool:
    """Whether the simulation is of another motion than every recording with true poses.

    Raises:
        DataError: it is of the motion of some only, or other signals are to be compared with it.
    """
    alike = [same_motion(real.imu, sim.imu, settings) for real in reals]
    if all(alike) or not sim.truths or not all(real.truths for real in reals):
        return False
    if any(alike):
        raise DataError(
            "the simulation is of the same motion as some recordings only",
            where=sim.name,
            expected="one motion, or as many as logs",
            fix=f"Diagnose separately: {', '.join(real.name for real, same in zip(reals, alike, strict=True) if same)}",
        )
    if signals:
        raise DataError(
            "`signals` compares one motion, and the simulation is of another", where=sim.name, fix="Leave `signals` out"
        )
    return True


def _compared(recordings: Sequence[Recording], settings: AlignmentSettings) -> Iterator[tuple[Recording, str]]:
    """First parts of recordings that together are too long, each with a remark; else the recordings."""
    share = settings.max_samples / max(1, sum(len(recording.imu) for recording in recordings))
    for recording in recordings:
        t_ns = recording.imu.t_ns
        if share >= 1.0:
            yield recording, ""
            continue
        part = recording.between(int(t_ns[0]), int(t_ns[int(share * (len(t_ns) - 1))]))
        first, whole = f"{part.imu.duration_s:.0f} s", f"{recording.imu.duration_s:.0f} s"
        more = "more need --set alignment.most_samples=N and about 6 kB of memory for each sample"
        yield part, f"{recording.name}: only the first {first} of {whole} were compared; {more}"


def align(real: Recording, sim: Recording | None, truth: str | None, settings: DiagnoseSettings) -> Iterator[Pair]:
    """Intervals of the recording that the simulation or its own poses cover without a hole."""
    real, batched_s = on_own_clock(new_samples(real))
    if sim is not None:
        real, sim = without_common_jitter(real, new_samples(sim), settings.timestamps)
    columns = () if sim is None else (*sim.imu.gyro.T, *sim.imu.accel.T)
    lsb = np.array([timestamps.grid(column, settings.timestamps) for column in columns] or [0.0] * 6)
    for pair in _aligned(real, sim, truth, settings):
        yield replace(pair, batched_s=batched_s, sim_lsb=lsb)


def _aligned(real: Recording, sim: Recording | None, truth: str | None, settings: DiagnoseSettings) -> Iterator[Pair]:
    if sim is not None:
        shared = _shared_stretches(real, sim)
        for pair in with_simulation(real, sim, settings, own_poses=bool(shared)):
            yield replace(pair, band_hz=_shared_band_hz(pair, shared)) if shared else pair
        return
    if not real.truths:
        raise real.no_truth("no simulation and no true poses", "`sim`, or poses in the log")
    yield from align_with_poses(real if truth is not None else real.with_truth(next(iter(real.truths))), settings)


def _shared_stretches(real: Recording, sim: Recording) -> list[tuple[int, int, Stretch]]:
    """Stretches of the poses that a simulation follows, from time to time (ns), if they are the recording's own and measured.

    Such a simulation shares the errors of the poses, and is no better a reference than they are.
    """
    if MOTION_TOPIC in real.truths:  # itself simulated, from exactly this motion
        return []
    for poses, other in product(real.truths.values(), sim.truths.values()):
        _, own_rows, other_rows = np.intersect1d(poses.t_ns, other.t_ns, return_indices=True)
        if len(own_rows) > COPIED * len(other.t_ns) and np.array_equal(poses.p_wb[own_rows], other.p_wb[other_rows]):
            motion = smooth_motion(poses)
            start_ns, measured = motion.start_ns, [part for part in motion.stretches if part.measured]
            return [(start_ns + round(1e9 * p.start_s), start_ns + round(1e9 * p.end_s), p) for p in measured]
    return []


def _shared_band_hz(pair: Pair, stretches: Sequence[tuple[int, int, Stretch]]) -> float:
    """Band of the stretches of poses that a simulation follows while it is compared; of all if none lasts."""
    end_ns = pair.start_ns + 1e9 * (pair.stamp_s[-1] - pair.stamp_s[0])
    min_ns = 1e9 * pair.settings.alignment.min_s
    last = [stretch for a, b, stretch in stretches if min(b, end_ns) - max(a, pair.start_ns) >= min_ns]
    return min(band_hz(stretch, pair.settings.reference) for stretch in last or [stretch for _, _, stretch in stretches])


def own_poses_sentence(pairs: Sequence[Pair]) -> str:
    """Remark on a simulation along the recording's own poses."""
    band_hz = min(pair.band_hz for pair in pairs if pair.band_hz is not None)
    return (
        f"The simulation follows the recording's own poses, and is compared as far as they are trusted, up to {band_hz:.2g} Hz."
    )


def without_unusable(pair: Pair) -> Pair:
    """Pair without clipped, repeated and filled samples, and axes stuck or mostly clipped.

    Raises:
        DataError: no axis is left.
    """
    min_s = pair.settings.reference.min_known_s
    whole_rows = (repeats(pair.real) | filled(pair.stamp_s, pair.real))[:, None]
    known = ~(timestamps.clipped(pair.real, pair.settings.timestamps) | timestamps.stuck(pair.real) | whole_rows)
    known &= True if pair.known is None else pair.known
    if known.all():
        return pair
    reduced = replace(pair, known=known)
    for part in (pair.fitted, pair.held_out):
        known &= (known[part].sum(axis=0) * pair.period_s >= min_s) | (known[part].all(axis=0))
    if not known.any():
        raise DataError(
            "; ".join(unusable_axes(reduced)),
            where=pair.name,
            expected=f"{min_s:g} s or more of an axis that moves within its range",
            fix="Record with a sensor that works, of a wider range or of finer digits",
        )
    return reduced


# ── without a reference ──


def check_without_reference(real: Recording, path: str, why: str, settings: DiagnoseSettings) -> Diagnosis:
    """Diagnosis of stamps and digits alone, for the reason `why`; the constant bias is NaN."""
    stamp_s = seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
    samples, no_rows = np.concatenate([real.imu.gyro, real.imu.accel], axis=1), np.zeros(len(stamp_s), bool)
    no_motion = IdealMotion(stamp_s, *np.zeros((3, len(stamp_s), 3)))
    pair = Pair(real.name, stamp_s, samples, no_rows, no_rows, ideal=no_motion, settings=settings)
    findings = [*timestamps.dropped([pair]), *timestamps.rounded([pair], white_noise(samples)), *_limits(pair)]
    remark = f"{why.rstrip('.')}. Only the checks of stamps and digits were possible"
    hidden = tuple(effect.name for effect in catalogue.diagnosed() if effect.name not in BY_THEMSELVES)
    return Diagnosis((path,), None, (), tuple(findings), np.full((1, 6), np.nan), hidden, {}, (remark,))


def _limits(pair: Pair) -> list[Finding]:
    """Saturation: samples that pile up at the largest value."""
    limits = timestamps.limits(pair.real, pair.settings.timestamps)
    if not limits:
        return []
    found = [(*saturation.of_limit(key)[:2], value) for key, value in limits.items()]
    parameters = {name: Estimate(value, 0.0, UNITS[signal]) for name, signal, value in found}
    signals = {signal for _, signal, _ in found}
    signal = signals.pop() if len(signals) == 1 else "both"
    return [timestamps.by_samples([pair], "saturation", signal, parameters, "readings pile up at +-limit")]


def locate_stuck(pair: Pair, floor: Float64[np.ndarray, "6"], *, several: bool) -> Iterator[Located]:
    """Axes with one value in every sample, although a motion was expected."""
    stuck, ideal = timestamps.stuck(pair.real), expected(pair, ())
    for a in np.flatnonzero(stuck & ~at_limit(pair) & (ideal.std(axis=0) > MOVES * floor)):
        signal = SENSORS[a // 3]
        reason = f"it reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample"
        span = ((float(pair.stamp_s[0]), float(pair.stamp_s[-1])),)
        name = pair.name if several else ""
        yield Located(signal, (AXES[a % 3],), span, f"always: {reason}", 1.0, 0.0, name, reason, extent="everywhere")


def unusable_axes(pair: Pair) -> list[str]:
    """Unusable axes of a log, with the reason."""
    clipped = timestamps.clipped(pair.real, pair.settings.timestamps).mean(axis=0)
    stuck, saturated, out = timestamps.stuck(pair.real), at_limit(pair), []
    for a in np.flatnonzero(stuck & ~saturated):
        signal = SENSORS[a // 3]
        out.append(f"{signal} {AXES[a % 3]} reads {pair.real[0, a]:.4g} {UNITS[signal]} in every sample")
    for key, maximum in timestamps.limits(pair.real, pair.settings.timestamps).items():
        _, signal, part = saturation.of_limit(key)
        share = ", ".join(f"{AXES[a % 3]} in {percent(float(clipped[a]))}" for a in range(6)[part] if saturated[a])
        if share:
            out.append(f"{signal} is at its limit of {maximum:.4g} {UNITS[signal]}: {share} of the samples")
    return out


def at_limit(pair: Pair) -> Bool[np.ndarray, "6"]:
    """Axes that are clipped in more than 5 % of the samples."""
    return np.asarray(timestamps.clipped(pair.real, pair.settings.timestamps).mean(axis=0) > SOME)
