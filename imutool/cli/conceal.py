"""`imutool conceal`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from imutool.cli.app import Json, Quiet, Verbose, app
from imutool.cli.terminal import log_to_stderr, say, write_json
from imutool.errors import ConfigError


@app.command(epilog="Example: [bold]imutool conceal MH_03.mcap case/ --seed 7[/], then [bold]imutool conceal --open case/[/]")
def conceal(
    places: Annotated[list[Path], typer.Argument(metavar="[TRAJECTORY] DIR", help="A log with true poses; the case's folder.")],
    seed: Annotated[int | None, typer.Option(min=0, help="The same case again; else a random one.")] = None,
    kind: Annotated[str, typer.Option(help="single, pair, null, driven, unknown or any.")] = "any",
    size: Annotated[str, typer.Option(help="large (plausible), middle (a quarter), small (just visible) or any.")] = "any",
    noise: Annotated[str, typer.Option(help="any, adis16448, bmi160, navigation or a TOML file.")] = "any",
    longest: Annotated[float, typer.Option(min=20.0, metavar="SECONDS", help="At most so much of the trajectory.")] = 75.0,
    truth: Annotated[str | None, typer.Option(help="Topic of the true poses, where a log has several.")] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the envelope in DIR and score DIR/findings.json.")] = False,
    findings: Annotated[Path | None, typer.Option(help="Findings to score instead (with --open).")] = None,
    json_to: Json = None,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Make a sealed blind case: a simulation, a recording, and in an envelope what separates them. Or open one."""
    log_to_stderr(verbose, quiet)
    if len(places) != (1 if open_it else 2):
        expected = "DIR alone" if open_it else "TRAJECTORY and DIR"
        raise ConfigError(f"{len(places)} places are named", where="conceal", expected=expected)
    if open_it:
        _open(places[0], findings, json_to)
        return
    if findings is not None or json_to is not None:
        raise ConfigError("--findings and --json say nothing without --open", where="conceal", fix="Add --open")
    from imutool.blind_cases.cases import conceal as run

    run(places[0], places[1], seed=seed, kind=kind, size=size, noise=noise, longest_s=longest, truth=truth)
    say(f"{places[1]}: sim.mcap, real.mcap, envelope.json and its key")
    say(f"next: imutool diagnose {places[1]}/real.mcap --sim {places[1]}/sim.mcap -o {places[1]}")
    say(f"then: imutool conceal --open {places[1]}")


def _open(folder: Path, findings: Path | None, json_to: str | None) -> None:
    import msgspec

    from imutool.blind_cases.cases import open_case

    result: dict[str, Any] = msgspec.to_builtins(open_case(folder, findings))
    if write_json(result, json_to):
        return
    hidden = "; ".join(_told(effect) for effect in result["truth"]["effects"]) or "nothing but a bias and noise"
    say(f"concealed ({result['kind']}, {result['size']}): {hidden}")
    say(f"found: {', '.join(result['found']) or 'nothing'}; the names are {'right' if result['right'] else 'not right'}")
    if result["place"]["f1"] is not None:
        say(f"place: F1 {result['place']['f1']:.2f}")
    for row in result["parameters"]:
        sigmas = "" if row["sigmas"] is None else f", {row['sigmas']:+.1f} sigmas off"
        name = f"{row['effect']}.{row['parameter']}"
        say(f"{name}: {row['value']:.5g} ± {row['std']:.2g}, truly {row['true']:.5g} ({row['percent']:.2g} %{sigmas})")
    if result["gain"] is not None:
        say(f"gain: {100.0 * result['gain']:.0f} % of what perfect knowledge would remove")


def _told(effect: dict[str, Any]) -> str:
    """An effect with its parameters, but for what does nothing."""
    numbers = (
        f"{name} {one['value']:.4g} {one['unit']}"
        for name, one in effect["parameters"].items()
        if one["value"] != 0.0 and abs(one["value"]) < 1e8 and not name.startswith("phase")
    )
    driver = f" by {effect['driver']}" if effect["driver"] else ""
    return f"{effect['effect']}{driver} ({', '.join(numbers)})"
