"""Importer that Rerun finds on PATH: `rerun log.imu` shows what `imutool view` shows.

Rerun runs every program on PATH whose name begins with `rerun-importer-`, and reads an .rrd from its standard output. It does
so only for suffixes that it does not read itself, up to 0.41 not for .mcap: there the log needs a link of another name.
https://rerun.io/docs/concepts/logging-and-ingestion/importers/overview
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from imutool.file_location import Location, first_bytes
from imutool.viewing.rerun import rr

if TYPE_CHECKING:
    from imutool.mcap_io.log import Log
    from imutool.viewing.model.run_data import RunData

INCOMPATIBLE = 66  # exit code by which Rerun knows that a file is not this importer's
MAGIC = b"\x89MCAP0\r\n"  # a log begins with it, whatever its name
METADATA = "imutool"  # record with the sensor of a converted log


def main() -> NoReturn:
    """Write the .rrd of an MCAP log with an IMU to standard output.

    Any other file gives exit code 66 and no output.
    """
    parser = argparse.ArgumentParser(prog="rerun-importer-imutool", description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--application-id")
    parser.add_argument("--recording-id")
    parser.add_argument("--entity-path-prefix", default="")
    given, _ = parser.parse_known_args()
    if first_bytes(given.file, len(MAGIC)) != MAGIC:  # before anything heavy is imported
        sys.exit(INCOMPATIBLE)
    from imutool.errors import ImutoolError

    try:
        content = rrd(given.file, given.application_id, given.recording_id, given.entity_path_prefix)
    except ImutoolError as error:
        print(f"imutool: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    if content is None:
        sys.exit(INCOMPATIBLE)
    sys.stdout.buffer.write(content)
    sys.exit(0)


def rrd(path: Path, application: str | None = None, recording: str | None = None, prefix: str = "") -> bytes | None:
    """Content of the .rrd for a log; None without an IMU.

    Rerun proposes the ids of the application and of the recording, and the entity below which to log.

    The log's own debiased channels are shown; without any, the model that ships for its sensor is applied, else raw is alone.

    Raises:
        ConfigError: Rerun is not installed, or the file cannot be opened.
        LogError, DataError: nothing in the log is sound, or its IMU has fewer than two samples.
    """
    data = load_first_imu(path)
    if data is None:
        return None
    from imutool.viewing.rerun import layout, scene, sdk

    root = tuple(part for part in prefix.split("/") if part)

    def send(stream: rr.RecordingStream) -> None:
        stream.send_blueprint(layout.blueprint([data], root=root))
        scene.log([data], stream, root=root)

    return sdk.rrd_bytes(sdk.new_stream(data.name, application=application, recording=recording), send)


def load_first_imu(path: Location, findings: Path | None = None) -> RunData | None:
    """Data of the first IMU of a log, with the events of `findings`; None without an IMU.

    Raises:
        ConfigError, LogError, DataError: as `imutool.viewing.model.load_view.load`.
    """
    from imutool.errors import LogError
    from imutool.mcap_io.log import Log
    from imutool.mcap_io.recovery.recovered_log import RecoveredLog

    try:
        with Log(path) as log:
            imu, model = _imu_and_model(log)
    except LogError:
        with RecoveredLog(path) as log:
            imu, model = _imu_and_model(log)
    if imu is None:
        return None
    from imutool.viewing.model.load_view import load

    return load(path, models=() if model is None else [model], imu=imu, findings=findings)


def _imu_and_model(log: Log) -> tuple[str | None, str | None]:
    """First IMU topic, and the model that ships for its sensor where the log holds no debiased channel of it."""
    from imutool.bias.model_file import shipped_for
    from imutool.mcap_io.codec import schemas
    from imutool.mcap_io.topics import DERIVED_KEY

    if not log.imu_topics:
        return None, None
    imu = log.imu_topics[0]
    if any(topic.metadata.get(DERIVED_KEY) == imu for topic in log.with_schema((schemas.IMU,))):
        return imu, None
    return imu, next(iter(shipped_for(dict(log.metadata_records()).get(METADATA, {}))), None)


if __name__ == "__main__":
    main()
