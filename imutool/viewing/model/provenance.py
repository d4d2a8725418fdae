"""What a picture was made from, in words: file, size, models and their digests, versions, and what imutool noted in the log."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence

import numpy as np

from imutool import __version__
from imutool.location import Location
from imutool.recording import Recording

OURS = "imutool"  # with it begin the names of the metadata records that imutool writes
MOST_ENTRIES = 60  # of the log's own; anybody may have written them
LONGEST = 200  # letters of a value


def provenance(
    log: Location,
    recording: Recording,
    metadata: Sequence[tuple[str, Mapping[str, str]]],
    models: Mapping[str, str],
    asked: Mapping[str, str],
) -> dict[str, str]:
    """Pairs of words for a reader: the file, topics, settings, models, versions, and then imutool's own records in the log.

    No digest of the log itself, which may be terabytes. Long values are cut, many entries counted.
    """
    told = {"file": log.name, "size": f"{log.stat().st_size} bytes", "IMU": recording.imu_topic}
    if recording.truths:
        told["truth"] = next(iter(recording.truths))
    told |= {**asked, **{f"model {name}": how for name, how in models.items()}}
    told |= {"imutool": __version__, "numpy": np.__version__, "python": platform.python_version()}
    noted = [(name, key, value) for name, values in metadata if name.startswith(OURS) for key, value in values.items()]
    told |= {_cut(f"{name}: {key}"): value for name, key, value in noted[:MOST_ENTRIES]}
    if len(noted) > MOST_ENTRIES:
        told["more in the log's records"] = f"{len(noted) - MOST_ENTRIES} entries"
    return {key: _cut(value) for key, value in told.items()}


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"
