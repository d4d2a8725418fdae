"""Sealed blind cases: a simulation and a recording of one real motion, what separates them in an envelope, and its opening.

The generator (`sealing`) knows nothing of the effects that the estimator fits; the two share the file format alone. What the
logs show of themselves is the same for every case: names, topics, metadata, message counts, sizes, the time they begin.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence, default_rng

from imutool.blind_cases import draw, unnamed
from imutool.blind_cases.effects import NO_LIMIT, TEMPERATURE
from imutool.blind_cases.envelope import digest, read_json, sealed, unsealed
from imutool.blind_cases.information import bounds, sight
from imutool.blind_cases.motion import smoother
from imutool.blind_cases.place import achievable, place
from imutool.blind_cases.recheck import WITHOUT
from imutool.blind_cases.scene import SIM_SHARE, Scene, set_up, stamps_ns
from imutool.blind_cases.score import score
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.target import Target
from imutool.mcap_io.write import write
from imutool.noise.datasheet import Noise
from imutool.noise.datasheet import read as read_noise
from imutool.recording import Imu, Poses, Recording, Scalars

SIM, REAL, ENVELOPE, KEY, FINDINGS, OPENED = "sim.mcap", "real.mcap", "envelope.json", "key", "findings.json", "opened.json"
TRUTH_SCHEMA = "imutool.sealed_truth/1"
LONGEST_S = 75.0
POSE_NOISE = (2e-4, 2e-4)  # m, rad: of the real log's poses, as a motion capture has it


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
    """Writes a sealed case to a folder: sim.mcap, real.mcap, envelope.json and its key. Nothing is said about what it holds.

    `effects` names what to conceal (of the catalogue, or a form of `unknown`); a benchmark needs that for its balance.
    One seed gives the same case of one trajectory again, but for the envelope's salt and key; without one it is random.

    Raises:
        ConfigError: unknown kind, size, noise or effect; the folder holds a case already.
        DataError, LogError: a trajectory that cannot be read or shows nothing of what was asked.
    """
    _check(kind, [*draw.KINDS, "any"], "--kind")
    _check(size, [*draw.SIZES, "any"], "--size")
    for name in (SIM, REAL, ENVELOPE, KEY, FINDINGS, OPENED):
        if (folder / name).exists():
            raise ConfigError("a case lies there already", where=folder / name, fix="Choose another folder")
    recording = read(trajectory, truth=truth)
    chosen = secrets.randbits(64) if seed is None else seed
    scene, what, rngs, grade = _planned(recording, chosen, kind, size, noise, effects, longest_s)
    _write(folder, scene, what, rngs, pose_noise, {"seed": chosen, "trajectory": recording.name, "noise": grade})


def shown_by_poses(trajectory: Path, truth: Mapping[str, Any], effects: Sequence[str] = ()) -> bool:
    """Whether a case that was opened, made of this trajectory with these `effects` asked for, can be seen from its poses alone.

    The case is planned again by its seed, and looked at beside poses with their noise instead of a simulation: is all of it as
    clear as `draw` asks of a case beside a simulation?

    Raises:
        DataError: another trajectory, or other effects, than the case was made with.
    """
    recording = read(trajectory)
    scene, what, _, _ = _planned(recording, truth["seed"], truth["kind"], truth["size"], truth["noise"], effects, LONGEST_S)
    if [model.name for model, _ in what.acting] != [one["effect"] for one in truth["effects"]]:
        raise DataError("the case was not made of this", where=trajectory, expected=truth["trajectory"])
    return draw.shown(sight(scene, POSE_NOISE), what)


def _planned(
    recording: Recording, seed: int, kind: str, size: str, noise: str | Path, effects: Sequence[str], longest_s: float
) -> tuple[Scene, draw.Concealed, list[Generator], str]:
    """Scene, what acts in it, the generators of the rest, and the grade of the noise."""
    rngs = [default_rng(one) for one in SeedSequence([seed, len(recording.truth), len(recording.imu)]).spawn(4)]
    grade, of_noise = _grade(noise, rngs[0])
    scene = set_up(smoother(recording.truth), of_noise, rngs[0], longest_s)
    return scene, _draw(scene, rngs[0], kind, size, effects), rngs, grade


def _draw(scene: Scene, rng: Generator, kind: str, size: str, effects: Sequence[str]) -> draw.Concealed:
    """What is concealed; of a kind and size that was left open, one that the motion shows."""
    seen = sight(scene)
    kinds, chances = zip(*draw.CHANCES.items(), strict=True)
    for _ in range(draw.TRIES if "any" in (kind, size) else 1):
        one_kind = str(rng.choice(kinds, p=chances)) if kind == "any" else kind
        one_size = str(rng.choice(draw.SIZES)) if size == "any" else size
        try:
            return draw.concealed(seen, rng, one_kind, one_size, effects)  # type: ignore[arg-type]  # checked by `conceal`
        except DataError as error:
            hidden = error
    raise hidden


def _write(
    folder: Path,
    scene: Scene,
    what: draw.Concealed,
    rngs: Sequence[Generator],
    pose_noise: tuple[float, float],
    told: dict[str, Any],
) -> None:
    bias = np.concatenate([draw.GYRO_BIAS * rngs[1].standard_normal(3), draw.ACCEL_BIAS * rngs[1].standard_normal(3)])
    real, came_to = scene.real(what.acting, bias, rngs[1])
    sim = scene.simulated(what.acting, rngs[2])
    channels = {
        topic: Scalars(stamps_ns(scene.channel_t_s), np.ascontiguousarray(scene.channels[topic][:, None]), unit)
        for topic, unit in unnamed.TOPICS.items()
    }
    poses = [scene.poses(what.acting, noise, rngs[3]) for noise in ((0.0, 0.0), pose_noise)]
    write_case(folder, log(sim, poses[0], channels), log(real, poses[1], channels), _truth(scene, what, bias, came_to, told))


def log(imu: Imu, truth: Poses, channels: Mapping[str, Scalars]) -> Recording:
    """A recording of a case that says nothing but its numbers."""
    return Recording(name="case", imu=imu, truths={"/ground_truth/pose": truth}, scalars=dict(sorted(channels.items())))


def write_case(folder: Path, sim: Recording, real: Recording, truth: Mapping[str, Any]) -> None:
    """Seals a case: everything into a folder beside, then file by file into its place, the envelope last.

    Logs are not compressed: how well numbers compress would tell which of them are rounded.

    Raises:
        ConfigError: the system refuses to write; nothing is left behind.
    """
    beside = folder.parent / f".{folder.name}.{os.getpid()}.{secrets.token_hex(4)}.partial"
    try:
        beside.mkdir(parents=True)
        for name, recording in ((SIM, sim), (REAL, real)):
            write(recording, beside / name, compression="none")
        envelope, key = sealed(truth, {name: beside / name for name in (SIM, REAL)})
        (beside / ENVELOPE).write_text(json.dumps(envelope, indent=1) + "\n", encoding="utf-8")
        (beside / KEY).write_text(key + "\n", encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for name in (SIM, REAL, KEY, ENVELOPE):
            (beside / name).replace(folder / name)
    except OSError as error:
        raise ConfigError(f"cannot be written ({error.strerror})", where=folder, fix="Choose another folder") from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _truth(
    scene: Scene, what: draw.Concealed, bias: np.ndarray, came_to: dict[str, float], told: dict[str, Any]
) -> dict[str, Any]:
    limits = bounds(scene, what.acting)
    effects = []
    for (model, theta), std, factor in zip(what.acting, limits, what.factors, strict=True):
        parameters = {}
        for k, parameter in enumerate(model.parameters):
            value = came_to.get(parameter.name, float(theta[k]))
            least = None if std is None or not np.isfinite(std[k]) else float(std[k])
            scale = max(abs(value), parameter.plausible * (factor if parameter.amount else 1.0))
            known = value != 0.0 if std is None else (least is not None and least < scale / 3.0)
            parameters[parameter.name] = {
                "value": value,
                "unit": parameter.unit,
                "scale": scale,
                "smallest_std": least,
                "identifiable": bool(known and abs(value) < NO_LIMIT and not parameter.name.startswith("phase")),
            }
        effects.append(
            {
                "effect": model.name,
                "signal": model.signal,
                "driver": model.driver,
                "equation": model.equation,
                "factor": factor,
                "parameters": parameters,
            }
        )
    misfit = scene.misfit(what.acting, scene.t_s)
    removable = [one for one in what.acting if one[0].name not in WITHOUT]  # what was rounded away, nobody brings back
    return {
        "schema": TRUTH_SCHEMA,
        **told,
        "kind": what.kind,
        "size": what.size,
        "effects": effects,
        "came_to": came_to,
        "bias": {"gyro": bias[:3].tolist(), "accel": bias[3:].tolist()},
        "noise_std": {"real": scene.noise.tolist(), "sim": (SIM_SHARE * scene.noise).tolist()},
        "duration_s": scene.duration_s,
        "place": place(misfit, scene.sigma),
        "achievable": achievable(scene.misfit(removable, scene.t_s), scene.sigma),
    }


def opened(folder: Path, findings: Path | None = None) -> dict[str, Any]:
    """The score of what `diagnose` found against what the envelope held, which `truth` in it tells.

    The first opening leaves opened.json, which holds what was scored to what it is: findings written or changed once the truth
    was out are refused.

    Raises:
        DataError: no case, the envelope, a log or the findings were changed, or findings of another schema.
    """
    path = folder / FINDINGS if findings is None else findings
    found, mark = read_json(path), digest(path)
    truth = unsealed(folder / ENVELOPE, folder / KEY)
    seal, before = folder / OPENED, None
    if seal.exists():
        before = read_json(seal).get("findings_sha256")
        if before != mark:
            raise DataError(
                "these are not the findings with which the envelope was opened",
                where=path,
                expected=f"SHA-256 {before}",
                fix="Findings count only if they were there before the truth was; conceal another case",
            )
    result = {"findings_sha256": mark, **score(truth, found, path, _simulation(folder, truth)), "truth": truth}
    if before is None:
        with Target(seal) as target:
            target.write(json.dumps({"schema": "imutool.opened/1", "findings_sha256": mark}).encode() + b"\n")
    return result


def _simulation(folder: Path, truth: Mapping[str, Any]) -> Recording | None:
    """The simulation of a case that was made here; another generator's motions are not ours to go along."""
    return None if "generator" in truth else read(folder / SIM)


def _grade(noise: str | Path, rng: Generator) -> tuple[str, Noise]:
    names, chances = zip(*draw.GRADE_CHANCES.items(), strict=True)
    drawn = str(rng.choice(names, p=chances))  # always, so that one seed means one case
    if noise == "any":
        return drawn, draw.GRADES[drawn]
    if isinstance(noise, str) and noise in draw.GRADES:
        return noise, draw.GRADES[noise]
    return str(noise), read_noise(noise)


def _check(value: str, known: Sequence[str], option: str) -> None:
    if value not in known:
        raise ConfigError(f"{option} {value!r}", where="conceal", expected=f"one of {', '.join(known)}")


assert {TEMPERATURE, *unnamed.DRIVERS} == set(unnamed.TOPICS)
