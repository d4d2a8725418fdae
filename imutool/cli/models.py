"""`imutool models`."""

from __future__ import annotations

from msgspec.structs import astuple

from imutool.cli.app import Json, Quiet, Verbose, app
from imutool.cli.terminal import log_to_stderr, say, table, write_json
from imutool.report import Report, Section


class ModelEntry(Section, frozen=True):
    """A model that ships."""

    name: str
    method: str
    sensor: str | None
    dataset: str | None
    rate_hz: float


class Models(Report, frozen=True, tag="imutool.models/1"):
    """The models that ship."""

    models: list[ModelEntry]


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias.io import header_of, library

    log_to_stderr(verbose, quiet)
    found = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        rate_hz = round(float(about["rate_hz"]), 1)
        found.append(ModelEntry(path.stem, about["method"], about.get("sensor"), about.get("dataset"), rate_hz))
    if write_json(Models(found), json_to):
        return
    if found:
        table([ModelEntry.__struct_fields__, *(tuple(map(str, astuple(model))) for model in found)], keys=1)
    else:
        say("No model ships with this version; train one with: imutool train")
