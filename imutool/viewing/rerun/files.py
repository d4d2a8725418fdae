"""A recording as an .rrd file, for a viewer on this machine or another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from imutool.mcap_io.storage.target import Target
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import RunData
from imutool.viewing.rerun import layout, scene
from imutool.viewing.rerun.sdk import FLUSH_S, need_sdk, stream, title


def save(logs: Sequence[RunData], path: Path | None = None, *, source: bool = True, overwrite: bool = False) -> Output:
    """Writes all logs into one .rrd: `path`, or NAME.rrd in the folder `path`, or NAME.rrd here.

    Raises:
        ConfigError: no log, Rerun is not installed, the file exists (without `overwrite`) or cannot be written.
    """
    place = path or Path()
    target = place / f"{title(logs)}.rrd" if place.is_dir() else place
    need_sdk()
    with Target(target, overwrite=overwrite) as file:  # refuses before the work is done, leaves nothing after a failure
        file.write(rrd(logs, source=source))
    return Output("rrd", str(target), f"Saved {target}. Open with: rerun {target}")


def rrd(logs: Sequence[RunData], *, source: bool = True) -> bytes:
    """All logs and their layout as the content of an .rrd file.

    Raises:
        ConfigError: no log, or Rerun is not installed.
    """
    recording = stream(logs)
    import rerun as rr

    written = rr.binary_stream(recording)
    recording.send_blueprint(layout.blueprint(logs, source=source))
    scene.log(logs, recording, source=source)
    content = written.read(flush_timeout_sec=FLUSH_S)
    assert content, "a stream that was written to holds bytes"
    return bytes(content)
