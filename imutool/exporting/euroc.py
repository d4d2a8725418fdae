"""Export a log as a EuRoC (ASL) folder: IMU, truth and cameras."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import TextIO

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.cleaning.truth import read_truth, truth_of
from imutool.errors import LogError
from imutool.exporting import ExportReport
from imutool.exporting.log_parts import NotInPartsError, read_in_parts
from imutool.exporting.sensor_yaml import imu_yaml
from imutool.inertial.strapdown import velocity_follows
from imutool.log_info.clock import IncreasingStamps
from imutool.log_info.convention_report import check_motion
from imutool.log_info.imu_motion import ImuMotion, blocks_of
from imutool.log_info.pose_imu_rotation import warn_of_velocities
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import longest_recording, read_recordings
from imutool.mcap_io.storage.target import FolderTarget, writing
from imutool.mcap_io.topics import DERIVED_KEY, VELOCITY_KEY
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import Frames, Poses, Recording, Scalars, seconds, unit_quaternions
from imutool.report import NamedProgress
from imutool.units import SENSORS

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
HOLDS = (  # paths in a folder that is written
    r"mav0(/(body\.yaml|(imu0|vicon0|state_groundtruth\w*|cam\d+)(/(data\.csv|sensor\.yaml))?|cam\d+/data(/\d+\.(png|jpg))?))?"
)


def write(
    log: Path, out: Path, imu: str | None, sensor_noise: str | Path | None, overwrite: bool, tell: NamedProgress
) -> ExportReport:
    """Writes the folder `out`; the arguments are those of `imutool.export`.

    Raises:
        DataError: units, axes or frames are not those that the folder states.
    """
    given = datasheet.read(sensor_noise) if sensor_noise is not None else None
    with Log(log) as opened:
        topic, topics = imu or _best_imu(opened), list(opened.topics)
        with FolderTarget(out, log, signed="mav0/imu0/sensor.yaml", holds=HOLDS, overwrite=overwrite) as folder, writing(out):
            root, name = folder / "mav0", opened.topic(topic, (schemas.IMU,)).name
            try:
                writer = _written(opened, name, root, None, given, tell)
            except NotInPartsError:
                shutil.rmtree(root, ignore_errors=True)
                whole = longest_recording(read_recordings(opened, imu=name))
                writer = _written(opened, name, root, whole, given, tell)
        velocities = {name: t.metadata[VELOCITY_KEY] for name, t in opened.topics.items() if VELOCITY_KEY in t.metadata}
        left_out = [name for name in topics if velocities.get(name, name) not in writer.used]
    return ExportReport(out, "euroc", topic, writer.written, left_out)


def _written(log: Log, topic: str, root: Path, whole: Recording | None, given: Noise | None, tell: NamedProgress) -> _Asl:
    """Writes a folder from a recording, or from the parts of one.

    Raises:
        NotInPartsError: it takes the whole recording.
    """
    with ExitStack() as files:
        writer = _Asl(log, topic, root, files, tell)
        for part in read_in_parts(log, topic) if whole is None else [whole]:
            writer.add(part, is_whole=whole is not None)
    writer.check()  # the header of each table states units, and T_BS the body
    writer.cameras()
    writer.texts(given)
    return writer


def _best_imu(log: Log) -> str:
    """The debiased IMU, else the raw one.

    Raises:
        LogError: none, or several.
    """
    every = log.with_schema((schemas.IMU,))
    found = [t.name for t in every if t.is_derived] or [t.name for t in every]
    if not found:
        raise log.no_imu()
    if len(found) > 1:
        what = f"the log has {len(found)} IMU topics: {', '.join(found)}"
        raise LogError(what, where=log.path, expected="one", fix="Choose one with `imu`")
    return found[0]


class _Asl:
    """Writes the parts of a `mav0` folder and counts their rows."""

    def __init__(self, log: Log, topic: str, root: Path, files: ExitStack, tell: NamedProgress) -> None:
        self.root, self.tell, self._log, self._files = root, tell, log, files
        self._source = log.topics[topic].metadata.get(DERIVED_KEY)  # the topic from which the samples were computed
        self.written: dict[str, int] = {}
        self.used: set[str] = {topic}
        self._tables: dict[str, tuple[int, str, TextIO]] = {}  # number of the poses, folder and file by topic
        self._has_bias: dict[str, bool] = {}
        self._stamps = IncreasingStamps()
        self._follow: list[bool] = []  # whether the velocities of each part follow the positions
        self.root.mkdir()

    def add(self, part: Recording, *, is_whole: bool) -> None:
        """Writes the samples and the true poses of the next part of the recording."""
        imu, topic = part.imu, part.imu_topic
        if topic not in self._tables:
            self.recording, self._is_whole, first = part, is_whole, next(iter(part.truths), None)
            self._truth = truth_of(part) if is_whole else None if first is None else read_truth(self._log, topics=[first])
            known = {} if self._truth is None else {self._truth.topic: self._truth}
            self._motion = ImuMotion(imu.period_s * 1e9 if len(imu) > 1 else 0.0, known)
            self._tables[topic] = 0, "imu0", self._table("imu0", IMU_COLUMNS)
        for samples in blocks_of(imu):
            self._motion.see(samples)
        self._stamps.see(imu.t_ns)
        self._rows(topic, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1))
        self._follow += [velocity_follows(poses) for poses in [*part.truths.values()][:1]]
        for number, (topic, poses) in enumerate(part.truths.items()):
            self._poses(number, topic, poses, part.scalars)

    def _poses(self, number: int, topic: str, poses: Poses, scalars: Mapping[str, Scalars]) -> None:
        """Writes true poses under EuRoC's names, the first as the ground truth."""
        folder = TRUTH_FOLDER if number == 0 else TRUTH_FOLDERS.get(topic)
        if folder is None:
            return
        taken = next((other for other, (_, name, _) in self._tables.items() if name == folder), topic)
        if taken != topic:
            if len(poses) and self._tables[taken][0] > number:
                raise NotInPartsError
            return
        biases = [self._bias(topic, poses, end, scalars) for end in SENSORS]
        if not len(poses):
            return
        if topic not in self._tables:
            self.used.add(topic)
            self._tables[topic] = number, folder, self._table(folder, TRUTH_COLUMNS)
        v_w = np.full((len(poses), 3), np.nan) if poses.v_w is None else poses.v_w
        self._rows(topic, poses.t_ns, np.concatenate([poses.p_wb, unit_quaternions(poses.q_wb_wxyz), v_w, *biases], axis=1))

    def _bias(self, topic: str, poses: Poses, end: str, scalars: Mapping[str, Scalars]) -> Float64[np.ndarray, "n 3"]:
        """True bias of the samples on the stamps of the poses, NaN where unknown or between the stamps.

        The true bias of a debiased IMU is that of the sensor minus what was subtracted.
        """
        rows, name = np.full((len(poses), 3), np.nan), f"{topic.removesuffix('/pose')}/bias/{end}"
        known = scalars.get(name)
        if known is None or known.values.shape[1] != 3:
            return rows
        fits = bool(np.isin(known.t_ns, poses.t_ns).all())
        if len(known) and self._has_bias.setdefault(name, fits) is not fits:
            raise NotInPartsError
        if fits and len(known):
            if self._source is not None and not self._is_whole:  # what was subtracted at the ends lies in another part
                raise NotInPartsError
            rows[np.searchsorted(poses.t_ns, known.t_ns)] = known.values - self._subtracted(known.t_ns, end, scalars)
        return rows

    def _rows(self, topic: str, t_ns: Int64[np.ndarray, " n"], values: Float64[np.ndarray, "n k"]) -> None:
        """Rows of a table whose numbers read back to the same float64."""
        _, folder, file = self._tables[topic]
        name, count = f"{folder}/data.csv", self._log.topics[topic].count if topic in self._log.topics else 0
        for first in range(0, len(t_ns), BLOCK_ROWS):
            part = slice(first, first + BLOCK_ROWS)
            file.writelines(rows(t_ns[part].tolist(), values[part].tolist()))
            self.written[name] += len(t_ns[part])
            self.tell(self.written[name], max(count, self.written[name]), folder)

    def _table(self, folder: str, columns: Sequence[str]) -> TextIO:
        """Begins a data.csv."""
        (self.root / folder).mkdir()
        self.written[f"{folder}/data.csv"] = 0
        file = self._files.enter_context((self.root / folder / "data.csv").open("w", encoding="ascii", newline="\n"))
        file.write(f"#{','.join(columns)}\n")
        return file

    def check(self) -> None:
        """Refuses recordings that the folder cannot hold; warns of others.

        Raises:
            LogError: too few samples.
            DataError: units, axes or frames are not those that the folder states.
        """
        name, topic = self.recording.name, self.recording.imu_topic
        if (count := self.written["imu0/data.csv"]) < FEWEST:
            raise LogError(f"{topic} has {count} samples", where=self._log.path, expected=f"{FEWEST} or more, for a rate")
        if 2 * self._follow.count(False) > len(self._follow):
            warn_of_velocities(name, next(iter(self.recording.truths)))
        check_motion(self._motion, self._truth, f"{name} {topic}")
        self.used |= {name for name, fits in self._has_bias.items() if fits}

    def _subtracted(
        self, t_ns: Int64[np.ndarray, " n"], end: str, scalars: Mapping[str, Scalars]
    ) -> Float64[np.ndarray, "n 3"]:
        """Bias that `debias` subtracted from the samples: zero of a raw IMU, NaN where it is not known."""
        if self._source is None:
            return np.zeros((len(t_ns), 3))
        bias = scalars.get(f"{self._source}/bias/{end}")
        if bias is None or bias.values.shape[1] != 3 or not len(bias.t_ns):
            return np.full((len(t_ns), 3), np.nan)
        at, knots = (seconds(stamps, int(bias.t_ns[0])) for stamps in (t_ns, bias.t_ns))
        return np.stack([np.interp(at, knots, column, left=np.nan, right=np.nan) for column in bias.values.T], axis=1)

    def cameras(self) -> None:
        """Writes one folder per camera, images byte for byte, one in memory at a time."""
        named = {topic: found[1] for topic in self.recording.frames if (found := re.match(r"/(cam\d+)/", topic))}
        free = (folder for number in count() if (folder := f"cam{number}") not in named.values())
        for topic, frames in self.recording.frames.items():
            folder = named.get(topic) or next(free)
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

    def texts(self, given: Noise | None) -> None:
        """The sensor.yaml of the folders written, and body.yaml, where the log kept them."""
        rate_hz, kept = self._stamps.clock().rate_hz, self._kept("imu0/sensor.yaml")
        assert rate_hz is not None  # two samples or more, whose stamps increase
        self._text("imu0/sensor.yaml", imu_yaml(self.recording, kept, rate_hz, given))
        for folder in sorted({name.split("/")[0] for name in self.written} - {"imu0"}):
            if text := self._kept(f"{folder}/sensor.yaml"):
                self._text(f"{folder}/sensor.yaml", text)
        if text := self._kept("body.yaml"):
            self._text("body.yaml", text)

    def _kept(self, name: str) -> str:
        return str(self.recording.metadata.get(name, {}).get("text", ""))

    def _text(self, name: str, text: str) -> None:
        (self.root / name).write_text(text, encoding="utf-8", newline="\n")


def rows(stamps: Iterable[int], values: Iterable[Iterable[float]]) -> Iterator[str]:
    """Lines of a table; `repr` is the shortest text that reads back to the same number."""
    for stamp, row in zip(stamps, values, strict=True):
        yield f"{stamp},{','.join(map(repr, row))}\n"
