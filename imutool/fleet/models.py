"""Which model a fleet runs, as a hash: the same name may stand for another file tomorrow."""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec

from imutool.bias.io import digest, find_model, library
from imutool.fleet.task import Settings


def settled(settings: Settings) -> Settings:
    """Settings with the model's path made absolute and its SHA-256 beside; where each log chooses, that of all that ship.

    Raises:
        ModelError: no such model.
    """
    name = settings.model
    if name is not None and Path(name).suffix in {".safetensors", ".toml"}:
        path = Path(name).absolute()
        if path.suffix == ".safetensors":
            find_model(path)  # before a thousand logs say the same
        return msgspec.structs.replace(settings, model=str(path), model_sha256=digest(path))
    if name is not None and name != "static":
        return msgspec.structs.replace(settings, model_sha256=str(find_model(name).card["sha256"]))
    every = "".join(digest(path) for path in sorted(library().glob("*.safetensors")))
    return msgspec.structs.replace(settings, model_sha256=hashlib.sha256(every.encode()).hexdigest())
