"""`imutool models`."""

from __future__ import annotations

from imutool.cli.app import Json, Quiet, Verbose, app
from imutool.cli.terminal import log_to_stderr, say, table, write_json


@app.command(epilog="Example: [bold]imutool models --json -[/]")
def models(json_to: Json = None, verbose: Verbose = False, quiet: Quiet = False) -> None:
    """List the models that ship, their sensor and their card."""
    from imutool.bias.io import header_of, library

    log_to_stderr(verbose, quiet)
    found = []
    for path in sorted(library().glob("*.safetensors")):
        about = header_of(path)
        keys = ("method", "sensor", "dataset", "rate_hz")
        one = {"name": path.stem, **{key: about.get(key) for key in keys}}
        found.append({**one, "rate_hz": round(float(about["rate_hz"]), 1)})
    if write_json({"schema": "imutool.models/1", "models": found}, json_to):
        return
    if found:
        table([tuple(found[0]), *(tuple(str(value) for value in one.values()) for one in found)], keys=1)
    else:
        say("No model ships with this version; train one with: imutool train")
