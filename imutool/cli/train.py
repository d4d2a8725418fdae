"""`imutool train`."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Any

import typer

from imutool import registry
from imutool.cli.app import COMMON, MODEL, Common, Imu, Logs, Set, Truth, app, listing
from imutool.cli.terminal import epoch_line, say, table
from imutool.errors import ConfigError
from imutool.report import UNSET, Report, Section, UnsetType

DRIFT_ROWS = "after 5 s"


@app.command(
    cls=listing("imutool.bias", "--method"),
    epilog="Example: [bold]imutool train MH_01.mcap MH_03.mcap -o adis.safetensors[/]",
)
def train(
    logs: Logs,
    model: Annotated[str, typer.Option("-o", "--output", metavar="MODEL.safetensors", help="File of the new model."), MODEL],
    method: Annotated[str, typer.Option(help="Bias model from the list below.")] = "hybrid",
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="File of settings; the documentation lists them.")
    ] = None,
    set_: Set = None,
    physics: Annotated[
        Path | None,
        typer.Option(metavar="physics.toml", help="For hybrid: effects to fit; the neural ODE learns the rest."),
    ] = None,
    device: Annotated[str, typer.Option(help="Device: cpu or cuda. Only conv is faster on cuda.")] = "cpu",
    seed: Annotated[int | None, typer.Option(help="Seed of the random numbers.")] = None,
    imu: Imu = None,
    truth: Truth = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted training from its checkpoint.")] = False,
    common: Common = COMMON,
) -> None:
    """Train a bias model on logs of one sensor with true poses."""
    registry.load("imutool.bias", method, "method")  # refuse a wrong name before reading any log
    from imutool.config import load
    from imutool.file_location import local, refuse_twins
    from imutool.processes.forked import forking
    from imutool.training.run import train as run
    from imutool.training.settings import full_name, settings_of

    place, words = local(model, "model"), list[str]()
    if physics is not None:
        words, unread = _named_by(physics, method)
        if unread:
            logging.getLogger("imutool").warning("left to the neural ODE: %s", ", ".join(unread))
    words += [*(set_ or ()), *([f"seed={seed}"] if seed is not None else ())]
    refuse_twins(logs, "logs")
    settings = load(settings_of(method), config, [full_name(method, word) for word in words])
    with forking(), common.progress("Training") as tell:
        trained = run(
            logs,
            place,
            method=method,
            settings=settings,
            device=device,
            imu=imu,
            truth=truth,
            resume=resume,
            overwrite=common.overwrite,
            progress=lambda epoch: tell(*epoch_line(epoch)),
        )
    if not common.write(training_report(place, trained.card), replace=resume):
        if not common.quiet:
            with redirect_stdout(sys.stderr):  # how the model was chosen is no result
                if "left_out" in trained.card:
                    left_out_table(trained.card["left_out"])
                for line in lines_of_choice(trained.card):
                    say(line)
                if channel := getattr(trained.config, "temperature", UNSET):
                    say(f"the bias follows {channel}")
        say(str(model))


def left_out_table(left_out: Mapping[str, Any]) -> None:
    """Print the scores of left-out logs by log and start, and the models that were kept."""
    scores = left_out["scores"]
    models = list(dict.fromkeys(score["model"] for score in scores))
    logs = list(dict.fromkeys(score["log"] for score in scores))
    starts = sorted({score["start"] for score in scores if score["start"]})
    errors = {(score["log"], score["start"], score["model"]): score["aoe_deg"] for score in scores}
    errors |= {
        (score["log"], start, "raw"): score["aoe_deg"] for score in scores if score["model"] == "raw" for start in starts
    }
    drifts = [score for score in scores if score["start"] in ("", "truth") and score["drift_deg"] is not None]
    errors |= {(score["log"], DRIFT_ROWS, score["model"]): score["drift_deg"] for score in drifts}
    rows = [
        (log, error, [errors.get((log, error, model)) for model in models])
        for error in (*starts, *([DRIFT_ROWS] if drifts else []))
        for log in logs
    ]
    for error in dict.fromkeys(error for _, error, _ in rows):
        known = (values for _, of, values in rows if of == error and {*values} != {None})  # too short a log has no drift
        columns = zip(*known, strict=True)
        rows.append(("mean", error, [None if None in column else sum(column) / len(column) for column in columns]))
    cells = [
        (
            log,
            error if error == DRIFT_ROWS else f"AOE, {error}",
            *("–" if value is None else f"{value:.2f}" for value in values),
        )
        for log, error, values in rows
    ]
    parts = left_out["parts"]
    table([("left-out part" if parts else "left-out log", "error °", *models), *cells], keys=2)
    why = "by how they predict each part from the others" if parts else "the simplest models that are not beaten"
    say(f"kept {', '.join(f'{kept} for the {sensor}' for sensor, kept in left_out['kept'].items())}: {why}")


def lines_of_choice(card: Mapping[str, Any]) -> list[str]:
    """Effects of each sensor, and what the descent of a network changes on held-out time."""
    lines = [f"{sensor}: {', '.join(found['effects']) or 'no effect'}" for sensor, found in card.get("physics", {}).items()]
    compared = card.get("compared", {})
    if ode := compared.get("effects and neural_ode"):
        effects = compared["effects"]
        kept = "kept" if card["held_out"] == ode != effects else "dropped"
        before = {sensor: found["error"] for sensor, found in effects.items()}
        errors = (f"{sensor} {before[sensor]:.3g} to {found['error']:.3g} {found['unit']}" for sensor, found in ode.items())
        lines.append(f"neural ODE {kept}: held-out error of {', of '.join(errors)}")
    elif compared and len(card["logs"]) == 1:
        lines.append("no neural ODE: one log shows only what fits its own motion")
    held_out = {sensor: found for sensor, found in card.get("held_out", {}).items() if "closed_form" in found and not compared}
    kept = card.get("left_out", {}).get("kept", {})
    if refuted := [sensor for sensor in held_out if kept.get(sensor, card.get("method")) != card.get("method")]:
        lines.append(f"no network for {' and '.join(refuted)}: left-out logs do not confirm it; --set compare=false keeps it")
    gains = [
        f"{sensor} {found['closed_form']:.3g} to {found['error']:.3g} {found['unit']}"
        for sensor, found in held_out.items()
        if sensor not in refuted
    ]
    if gains:
        lines.append(f"held-out error, from the closed form to the network: {', '.join(gains)}")
    return lines


class TrainingLog(Section, frozen=True):
    """Log that a model was trained on."""

    name: str
    file: str
    sha256: str
    poses: str | UnsetType = UNSET  # what they are worth; older models have none


class TrainingReport(Report, frozen=True, kw_only=True, tag="imutool.training/1"):
    """Report of `imutool train`: the model's card; a hybrid adds `compared` and `physics`."""

    model: str
    imutool: str
    torch: str
    method: str
    training: dict[str, Any]
    logs: list[TrainingLog]
    held_out: dict[str, Any]
    sessions: list[dict[str, Any]]
    turn_on_least_std: list[float] | UnsetType = UNSET  # of the next session's bias; older models have none
    speed: dict[str, float] | UnsetType = UNSET  # of the logs, where the filter's own bound is too small
    turn_error: float | UnsetType = UNSET  # share of a turn that the filter takes for wrong
    compared: dict[str, Any] | UnsetType = UNSET
    physics: dict[str, Any] | UnsetType = UNSET
    left_out: dict[str, Any] | UnsetType = UNSET
    sensor: str | None
    dataset: str | None
    name: str | UnsetType = UNSET
    sha256: str | UnsetType = UNSET


def training_report(model: Path, card: Mapping[str, Any]) -> TrainingReport:
    """Report of a training from the card of its model."""
    logs = [TrainingLog(**log) for log in card["logs"]]
    return TrainingReport(**{"model": str(model), **card, "logs": logs})


def _named_by(physics: Path, method: str) -> tuple[list[str], tuple[str, ...]]:
    """Settings for the effects of a physics.toml, and the names of the effects left out.

    Raises:
        ConfigError: another method than `hybrid`, or a file that says nothing to it.
    """
    if method != "hybrid":
        raise ConfigError(f"{method} has no effects", where="--physics", fix="Leave it out, or train --method hybrid")
    from imutool.training.settings import settings_from_physics

    return settings_from_physics(physics)
