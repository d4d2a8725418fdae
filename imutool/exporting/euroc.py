"""Export a log as a EuRoC (ASL) folder: IMU, truth and cameras."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.errors import LogError
from imutool.exporting import ExportReport, Progress
from imutool.log_info.convention_report import check_conventions
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.storage.target import SIGNATURE, FolderTarget, writing
from imutool.mcap_io.topics import DERIVED_KEY, VELOCITY_KEY
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import Frames, Poses, Recording, Scalars, seconds, unit_quaternions

BLOCK_ROWS = 10_000
FEWEST = 2  # samples
IMU_COLUMNS = (
    "timestamp [ns]",
    *(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
    *(f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"),
)
TRUTH_COLUMNS = (
    "timestamp",
    *(f" p_RS_R_{axis} [m]" for axis in "xyz"),
    *(f" q_RS_{axis} []" for axis in "wxyz"),
    *(f" v_RS_R_{axis} [m s^-1]" for axis in "xyz"),
    *(f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
    *(f" b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"),
)
CAMERA_COLUMNS = ("timestamp [ns]", "filename")
TRUTH_FOLDER = "state_groundtruth_estimate0"
TRUTH_FOLDERS = {
    "/ground_truth/pose": TRUTH_FOLDER,
    "/ground_truth_recomputed/pose": "state_groundtruth_recomputed0",
    "/ground_truth_vicon/pose": "vicon0",
}
IMAGES = {b"\x89PNG\r\n\x1a\n": ".png", b"\xff\xd8\xff": ".jpg"}  # by how the bytes begin
DEFAULT_SHEET = "adis16448"  # EuRoC's own
DENSITIES = {
    "gyroscope_noise_density": ("gyro_density", "rad/s/sqrt(Hz)"),
    "gyroscope_random_walk": ("gyro_walk", "rad/s^2/sqrt(Hz)"),
    "accelerometer_noise_density": ("accel_density", "m/s^2/sqrt(Hz)"),
    "accelerometer_random_walk": ("accel_walk", "m/s^3/sqrt(Hz)"),
}
IDENTITY = "  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, 0.0,\n" + (
    "         0.0, 1.0, 0.0, 0.0,\n         0.0, 0.0, 1.0, 0.0,\n         0.0, 0.0, 0.0, 1.0]\n"
)


def write(
    log: Path, out: Path, imu: str | None, sensor_noise: str | Path | None, overwrite: bool, tell: Progress
) -> ExportReport:
    """Writes the folder `out`; the arguments are those of `imutool.export`.

    Raises:
        DataError: units, axes or frames are not those that the folder states.
    """
    given = datasheet.read(sensor_noise) if sensor_noise is not None else None
    with Log(log) as opened:
        topic = imu or _best_imu(opened)
        topics = list(opened.topics)
        source = opened.topics[topic].metadata.get(DERIVED_KEY) if topic in opened.topics else None
        velocities = {name: t.metadata[VELOCITY_KEY] for name, t in opened.topics.items() if VELOCITY_KEY in t.metadata}
    with FolderTarget(out, log, signed="mav0/imu0/sensor.yaml", holds="mav0", overwrite=overwrite) as folder:
        recording = read(log, imu=topic)
        if len(recording.imu) < FEWEST:
            raise LogError(f"{topic} has {len(recording.imu)} samples", where=log, expected=f"{FEWEST} or more, for a rate")
        check_conventions([recording])  # the header of each table states units, and T_BS the body
        with writing(out):
            writer = _Asl(folder / "mav0", recording, source, tell)
            writer.imu(given)
            writer.truths()
            writer.cameras()
            writer.texts()
    left_out = [name for name in topics if velocities.get(name, name) not in writer.used]
    return ExportReport(out, "euroc", topic, writer.written, left_out)


def _best_imu(log: Log) -> str:
    """The debiased IMU, else the raw one.

    Raises:
        LogError: none, or several.
    """
    every = log.with_schema((schemas.IMU,))
    derived = [t.name for t in every if t.is_derived]
    found = derived or [t.name for t in every]
    if len(found) != 1:
        what = f"the log has {len(found)} IMU topics: {', '.join(found)}" if found else "the log has no IMU"
        raise LogError(what, where=log.path, expected="one", fix="Choose one with `imu`" if found else "")
    return found[0]


class _Asl:
    """Writes the parts of a `mav0` folder and counts their rows."""

    def __init__(self, root: Path, recording: Recording, source: str | None, tell: Progress) -> None:
        """`source` is the topic from which the samples were computed, None for raw ones."""
        self.root, self.recording, self.tell, self._source = root, recording, tell, source
        self.written: dict[str, int] = {}
        self.used: set[str] = {recording.imu_topic}
        self.root.mkdir()

    def imu(self, given: Noise | None) -> None:
        """Writes `imu0`: samples to the last bit, and a sensor.yaml."""
        imu = self.recording.imu
        self._table("imu0", IMU_COLUMNS, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1))
        self._text("imu0/sensor.yaml", self._imu_yaml(given))

    def truths(self) -> None:
        """Writes the true poses under EuRoC's names, the first as the ground truth."""
        for number, (topic, poses) in enumerate(self.recording.truths.items()):
            folder = TRUTH_FOLDER if number == 0 else TRUTH_FOLDERS.get(topic)
            if folder is None or f"{folder}/data.csv" in self.written or not len(poses):
                continue
            self.used.add(topic)
            v_w = np.full((len(poses), 3), np.nan) if poses.v_w is None else poses.v_w
            biases = [self._bias(topic, poses, end) for end in ("gyro", "accel")]
            values = np.concatenate([poses.p_wb, unit_quaternions(poses.q_wb_wxyz), v_w, *biases], axis=1)
            self._table(folder, TRUTH_COLUMNS, poses.t_ns, values)

    def _bias(self, topic: str, poses: Poses, end: str) -> Float64[np.ndarray, "n 3"]:
        """True bias of the samples on the stamps of the poses, NaN where unknown or between the stamps.

        The true bias of a debiased IMU is that of the sensor minus what was subtracted.
        """
        rows, name = np.full((len(poses), 3), np.nan), f"{topic.removesuffix('/pose')}/bias/{end}"
        known: Scalars | None = self.recording.scalars.get(name)
        if known is not None and known.values.shape[1] == 3 and np.isin(known.t_ns, poses.t_ns).all():
            rows[np.searchsorted(poses.t_ns, known.t_ns)] = known.values - self._subtracted(known.t_ns, end)
            self.used.add(name)
        return rows

    def _subtracted(self, t_ns: Int64[np.ndarray, " n"], end: str) -> Float64[np.ndarray, "n 3"]:
        """Bias that `debias` subtracted from the samples: zero of a raw IMU, NaN where it is not known."""
        if self._source is None:
            return np.zeros((len(t_ns), 3))
        bias = self.recording.scalars.get(f"{self._source}/bias/{end}")
        if bias is None or bias.values.shape[1] != 3 or not len(bias.t_ns):
            return np.full((len(t_ns), 3), np.nan)
        at, knots = (seconds(stamps, int(bias.t_ns[0])) for stamps in (t_ns, bias.t_ns))
        return np.stack([np.interp(at, knots, column, left=np.nan, right=np.nan) for column in bias.values.T], axis=1)

    def cameras(self) -> None:
        """Writes one folder per camera, images byte for byte, one in memory at a time."""
        for number, (topic, frames) in enumerate(self.recording.frames.items()):
            named = re.match(r"/(cam\d+)/", topic)
            folder = named[1] if named else f"cam{number}"
            if frames.count and f"{folder}/data.csv" not in self.written:
                self._camera(folder, topic, frames)
                self.used.add(topic)

    def _camera(self, folder: str, topic: str, frames: Frames) -> None:
        images = self.root / folder / "data"
        images.mkdir(parents=True)
        done = 0
        with (self.root / folder / "data.csv").open("w", encoding="ascii", newline="\n") as table:
            table.write(f"#{','.join(CAMERA_COLUMNS)}\n")
            for t_ns, image in frames.each():
                ending = next((kind for start, kind in IMAGES.items() if image.startswith(start)), None)
                if ending is None:
                    raise LogError(f"the image at {t_ns} ns is neither PNG nor JPEG", where=topic, fix="Use `format=rosbag2`")
                name = f"{t_ns}{ending}"
                try:
                    with (images / name).open("xb") as file:
                        file.write(image)
                except FileExistsError as error:
                    raise LogError(f"two images have the stamp {t_ns} ns", where=topic, expected="increasing stamps") from error
                table.write(f"{t_ns},{name}\n")
                done += 1
                self.tell(done, frames.count, folder)
        self.written[f"{folder}/data.csv"] = done

    def texts(self) -> None:
        """The sensor.yaml of the folders written, and body.yaml, where the log kept them."""
        folders = {name.split("/")[0] for name in self.written}
        for folder in sorted(folders - {"imu0"}):
            if text := self._kept(f"{folder}/sensor.yaml"):
                self._text(f"{folder}/sensor.yaml", text)
        if text := self._kept("body.yaml"):
            self._text("body.yaml", text)

    def _kept(self, name: str) -> str:
        return str(self.recording.metadata.get(name, {}).get("text", ""))

    def _imu_yaml(self, given: Noise | None) -> str:
        """The source's own sensor.yaml unless another noise is given, else a data sheet's figures."""
        note = f"{SIGNATURE} from {_line(self.recording.name)}, topic {_line(self.recording.imu_topic)}\n"
        if (kept := self._kept("imu0/sensor.yaml")) and given is None:
            directive, rest = (kept + "\n").split("\n", 1) if kept.startswith("%") else ("", kept)  # %YAML must come first
            return f"{directive}\n{note}{rest}" if directive else note + kept
        named = self.recording.metadata.get("imutool", {}).get("sensor", "").lower()
        sheet = given or datasheet.SHEETS[named if named in datasheet.SHEETS else DEFAULT_SHEET]
        lines = [note + "sensor_type: imu", f"comment: {json.dumps(named or 'unknown')}", "T_BS:", IDENTITY.rstrip("\n")]
        lines.append(f"rate_hz: {1.0 / self.recording.imu.period_s:.6g}")
        if given is None:
            why = f"there is none of {_line(named)}" if named else "the log does not name its sensor"
            origin = f"the sensor's, {named}" if named in datasheet.SHEETS else f"{DEFAULT_SHEET}'s, as {why}"
            lines.append(f"# Noise: defaults of a data sheet ({origin}), not measured on this sensor")
        for key, (quantity, unit) in DENSITIES.items():
            axes = sheet.values(quantity)
            known = axes[np.isfinite(axes)]
            if len(known):
                source = sheet.sources.get(quantity, "")
                value = float(np.sqrt(np.mean(known**2)))
                lines.append(f"{key}: {value!r}  # [{unit}] {_line(source)}".rstrip())
            else:
                lines.append(f"# {key} is not known")
        return "\n".join([*lines, ""])

    def _table(
        self, folder: str, columns: Sequence[str], t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n k"]
    ) -> None:
        """A data.csv whose numbers read back to the same float64."""
        (self.root / folder).mkdir()
        with (self.root / folder / "data.csv").open("w", encoding="ascii", newline="\n") as file:
            file.write(f"#{','.join(columns)}\n")
            for block in range(0, len(t_ns), BLOCK_ROWS):
                part = slice(block, block + BLOCK_ROWS)
                file.writelines(rows(t_ns[part].tolist(), values[part].tolist()))
                self.tell(min(block + BLOCK_ROWS, len(t_ns)), len(t_ns), folder)
        self.written[f"{folder}/data.csv"] = len(t_ns)

    def _text(self, name: str, text: str) -> None:
        (self.root / name).write_text(text, encoding="utf-8", newline="\n")


def rows(stamps: Iterable[int], values: Iterable[Iterable[float]]) -> Iterator[str]:
    """Lines of a table; `repr` is the shortest text that reads back to the same number."""
    for stamp, row in zip(stamps, values, strict=True):
        yield f"{stamp},{','.join(map(repr, row))}\n"


def _line(text: str) -> str:
    """Text that stays in its line, also of a file others parse."""
    return "".join(c if c.isprintable() else " " for c in text)
