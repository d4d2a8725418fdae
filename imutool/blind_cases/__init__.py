"""Blind cases: a simulation and a recording of one motion, the truth in an envelope.

The generator knows nothing of the effects that the estimator fits; the two share the file format alone. The logs themselves
reveal nothing: names, topics, metadata, message counts, sizes and the start time are the same for every case.
"""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.random import Generator, SeedSequence, default_rng

from imutool.blind_cases import catalogue, random_case
from imutool.blind_cases.catalogue import NO_LIMIT
from imutool.blind_cases.detectability import achievable_rms, cramer_rao_bounds, detectability, location
from imutool.blind_cases.effects import Model, Theta
from imutool.blind_cases.envelope import ConcealedEffect, ConcealedTruth, TrueParameter, digest, read_json, seal, unseal
from imutool.blind_cases.gain import WITHOUT_MISFIT
from imutool.blind_cases.motion import smoother
from imutool.blind_cases.scene import SIM_SHARE, Scene, place_scene, stamps_ns
from imutool.blind_cases.score import SCHEMA, Score, score
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.local import remove_abandoned, temporary_path
from imutool.mcap_io.storage.target import Target
from imutool.mcap_io.write import write
from imutool.noise.datasheet import Noise
from imutool.noise.datasheet import read as read_noise
from imutool.recording import Imu, Poses, Recording, Scalars

SIM, REAL, ENVELOPE, KEY, FINDINGS, OPENED = "sim.mcap", "real.mcap", "envelope.json", "key", "findings.json", "opened.json"
LONGEST_S = 75.0
POSE_NOISE = (2e-4, 2e-4)  # m, rad: of the real log's poses, as a motion capture has it


class OpenedCase(Score, frozen=True, kw_only=True, tag=SCHEMA):
    """Score of the findings with which a case was opened, and its truth."""

    findings_sha256: str
    truth: ConcealedTruth


class Plan(NamedTuple):
    """Scene of a case, its effects, its random generators, and the grade of the noise."""

    scene: Scene
    concealed: random_case.Concealed
    rngs: Sequence[Generator]
    grade: str


def conceal(
    trajectory: Path,
    folder: Path,
    *,
    seed: int | None = None,
    kind: str = "any",
    size: str = "any",
    noise: str | Path = "any",
    effects: Sequence[str] = (),
    longest_s: float = LONGEST_S,
    pose_noise: tuple[float, float] = POSE_NOISE,
    truth: str | None = None,
) -> None:
    """Writes a blind case to a folder: sim.mcap, real.mcap, envelope.json and its key.

    `effects` names what to conceal (of the catalogue, or a form of `unknown`); a benchmark needs that for its balance.
    One seed always gives the same case of one trajectory, but for the envelope's salt and key; without one it is random.

    Raises:
        ConfigError: unknown kind, size, noise or effect; the folder holds a case already.
        DataError, LogError: a trajectory that cannot be read, or does not show the effects.
    """
    _check("kind", kind, [*random_case.KINDS, "any"])
    _check("size", size, [*random_case.SIZES, "any"])
    for name in (SIM, REAL, ENVELOPE, KEY, FINDINGS, OPENED):
        if (folder / name).exists():
            raise ConfigError("the folder holds a case already", where=folder / name, fix="Choose another folder")
    recording = read(trajectory, truth=truth)
    chosen = secrets.randbits(64) if seed is None else seed
    _write(folder, plan(recording, chosen, kind, size, noise, effects, longest_s), pose_noise, chosen, recording.name)


def plan(
    recording: Recording, seed: int, kind: str, size: str, noise: str | Path, effects: Sequence[str], longest_s: float
) -> Plan:
    """Everything random of a case, by its seed."""
    rngs = [default_rng(child) for child in SeedSequence([seed, len(recording.truth), len(recording.imu)]).spawn(4)]
    grade, of_noise = _grade(noise, rngs[0])
    scene = place_scene(smoother(recording.truth), of_noise, rngs[0], longest_s)
    return Plan(scene, _draw(scene, rngs[0], kind, size, effects), rngs, grade)


def _draw(scene: Scene, rng: Generator, kind: str, size: str, effects: Sequence[str]) -> random_case.Concealed:
    """Effects that the motion shows; an open kind or size is drawn until it does."""
    seen = detectability(scene)
    kinds, chances = zip(*random_case.CHANCES.items(), strict=True)
    for _ in range(random_case.TRIES if "any" in (kind, size) else 1):
        drawn_kind = str(rng.choice(kinds, p=chances)) if kind == "any" else kind
        drawn_size = str(rng.choice(random_case.SIZES)) if size == "any" else size
        try:
            return random_case.draw_effects(seen, rng, drawn_kind, drawn_size, effects)  # type: ignore[arg-type]  # `conceal` checked
        except DataError as error:
            hidden = error
    raise hidden


def _write(folder: Path, planned: Plan, pose_noise: tuple[float, float], seed: int, trajectory: str) -> None:
    scene, concealed, rngs, grade = planned
    bias = np.concatenate(
        [random_case.GYRO_BIAS * rngs[1].standard_normal(3), random_case.ACCEL_BIAS * rngs[1].standard_normal(3)]
    )
    real, came_to = scene.real(concealed.acting, bias, rngs[1])
    sim = scene.simulated(concealed.acting, rngs[2])
    channels = {
        topic: Scalars(stamps_ns(scene.channel_t_s), np.ascontiguousarray(scene.channels[topic][:, None]), unit)
        for topic, unit in catalogue.TOPICS.items()
    }
    poses = [scene.poses(concealed.acting, noise, rngs[3]) for noise in ((0.0, 0.0), pose_noise)]
    truth = _truth(planned, bias, came_to, seed, trajectory, grade)
    write_case(folder, case_log(sim, poses[0], channels), case_log(real, poses[1], channels), truth)


def case_log(imu: Imu, truth: Poses, channels: Mapping[str, Scalars]) -> Recording:
    """Recording of a case, whose metadata reveals nothing."""
    return Recording(name="case", imu=imu, truths={"/ground_truth/pose": truth}, scalars=dict(sorted(channels.items())))


def write_case(folder: Path, sim: Recording, real: Recording, truth: ConcealedTruth) -> None:
    """Seals a case: writes all files next to the folder, then moves each into its place.

    The envelope is moved last. Logs are not compressed: how well numbers compress would tell which of them are rounded.

    Raises:
        ConfigError: the system refuses to write; nothing is left behind.
    """
    remove_abandoned(folder)
    partial = temporary_path(folder)
    try:
        partial.mkdir(parents=True)
        for name, recording in ((SIM, sim), (REAL, real)):
            write(recording, partial / name, compression="none")
        envelope, key = seal(truth, {name: partial / name for name in (SIM, REAL)})
        (partial / ENVELOPE).write_text(json.dumps(msgspec.to_builtins(envelope), indent=1) + "\n", encoding="utf-8")
        (partial / KEY).write_text(key + "\n", encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for name in (SIM, REAL, KEY, ENVELOPE):
            (partial / name).replace(folder / name)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=folder, fix="Choose another folder") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _truth(
    planned: Plan, bias: np.ndarray, came_to: dict[str, float], seed: int, trajectory: str, grade: str
) -> ConcealedTruth:
    scene, concealed = planned.scene, planned.concealed
    limits = cramer_rao_bounds(scene, concealed.acting)
    misfit = scene.misfit(concealed.acting, scene.t_s)
    removable = [effect for effect in concealed.acting if effect[0].name not in WITHOUT_MISFIT]  # rounding cannot be undone
    return ConcealedTruth(
        seed=seed,
        trajectory=trajectory,
        noise=grade,
        kind=concealed.kind,
        size=concealed.size,
        effects=tuple(
            _concealed_effect(model, theta, std, factor, came_to)
            for (model, theta), std, factor in zip(concealed.acting, limits, concealed.factors, strict=True)
        ),
        came_to=came_to,
        bias={"gyro": tuple(bias[:3].tolist()), "accel": tuple(bias[3:].tolist())},
        noise_std={"real": tuple(scene.noise.tolist()), "sim": tuple((SIM_SHARE * scene.noise).tolist())},
        duration_s=scene.duration_s,
        place=location(misfit, scene.sigma),
        achievable=achievable_rms(scene.misfit(removable, scene.t_s), scene.sigma),
    )


def _concealed_effect(
    model: Model, theta: Theta, std: Theta | None, factor: float, came_to: Mapping[str, float]
) -> ConcealedEffect:
    """Effect with its true parameters; one is identifiable if its bound is below a third of its scale."""
    parameters = {}
    for k, parameter in enumerate(model.parameters):
        value = came_to.get(parameter.name, float(theta[k]))
        minimum = None if std is None or not np.isfinite(std[k]) else float(std[k])
        scale = max(abs(value), parameter.plausible * (factor if parameter.amount else 1.0))
        known = value != 0.0 if std is None else (minimum is not None and minimum < scale / 3.0)
        identifiable = bool(known and abs(value) < NO_LIMIT and not parameter.name.startswith("phase"))
        parameters[parameter.name] = TrueParameter(value, parameter.unit, scale, minimum, identifiable)
    return ConcealedEffect(model.name, model.signal, model.driver, model.equation, factor, parameters)


def open_case(folder: Path, findings: Path | None = None) -> OpenedCase:
    """Opens the envelope and scores the findings of `diagnose` against the truth.

    The first opening writes opened.json, which holds the digest of the findings that were scored: findings that were written
    or changed after the truth was known are refused.

    Raises:
        DataError: no case, the envelope, a log or the findings were changed, or findings of another schema.
    """
    path = folder / FINDINGS if findings is None else findings
    found, mark = read_json(path), digest(path)
    truth = unseal(folder / ENVELOPE, folder / KEY)
    opened, before = folder / OPENED, None
    if opened.exists():
        before = read_json(opened).get("findings_sha256")
        if before != mark:
            raise DataError(
                "these are not the findings with which the envelope was opened",
                where=path,
                expected=f"SHA-256 {before}",
                fix="Only findings that were there before the truth count; conceal another case",
            )
    sim = None if truth.generator else read(folder / SIM)  # another generator's motions are not ours to simulate along
    scored = score(truth, found, path, sim)
    if before is None:
        with Target(opened) as target:
            target.write(json.dumps({"schema": "imutool.opened/1", "findings_sha256": mark}).encode() + b"\n")
    return OpenedCase(findings_sha256=mark, truth=truth, **msgspec.structs.asdict(scored))


def _grade(noise: str | Path, rng: Generator) -> tuple[str, Noise]:
    names, chances = zip(*random_case.GRADE_CHANCES.items(), strict=True)
    drawn = str(rng.choice(names, p=chances))  # always, so that one seed means one case
    if noise == "any":
        return drawn, random_case.GRADES[drawn]
    if isinstance(noise, str) and noise in random_case.GRADES:
        return noise, random_case.GRADES[noise]
    return str(noise), read_noise(noise)


def _check(name: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise ConfigError(f"unknown {name} {value!r}", where=name, expected=f"one of {', '.join(known)}")
