"""A log for programs that do not read MCAP as it is: a EuRoC (ASL) folder, or a rosbag2 folder around a copy of the log.

Both are folders that appear whole or not at all: written beside their place, renamed when complete. The log stays as it is.
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import json
import os
import re
import secrets
import shutil
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from imutool import noise
from imutool.errors import ConfigError, LogError
from imutool.mcap_io import schema
from imutool.mcap_io.log import DERIVED_KEY, Log
from imutool.mcap_io.read import VELOCITY_KEY, read
from imutool.noise import Noise
from imutool.recording import Frames, Poses, Recording, Scalars, unit_quaternions

SCHEMA = "imutool.export/1"
FORMATS = ("euroc", "rosbag2")
BLOCK_ROWS = 10_000
COPY_BYTES = 1 << 20
SIGNATURE = "# Exported by imutool"
Progress = Callable[[int, int, str], None]  # done, in all, what is being written

# ── EuRoC ──

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


@dataclass(frozen=True)
class ExportReport:
    """What was written: the IMU's topic (of a EuRoC folder), messages or rows by file, and the topics left behind."""

    output: Path
    format: str
    imu: str | None = None
    written: dict[str, int] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """The report as plain JSON values."""
        return {
            "schema": SCHEMA,
            "output": str(self.output),
            "format": self.format,
            "imu": self.imu,
            "written": self.written,
            "left_out": self.left_out,
        }


def export(
    log: Path,
    out: Path,
    *,
    format: str,
    imu: str | None = None,
    sensor_noise: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> ExportReport:
    """Writes the folder `out` in one of `FORMATS`.

    `imu` is the topic that goes into a EuRoC folder: by default the debiased one, else the only raw one. `sensor_noise` is
    a data sheet or a TOML file (`imutool.noise.read`) for its `sensor.yaml`. With `overwrite` an earlier export of the same
    format is replaced; any other folder is refused all the same.

    Raises:
        ConfigError: unknown format, an option that says nothing for it, a target that exists or cannot be written.
        LogError: the log is damaged, or holds what the format cannot.
    """
    if format not in FORMATS:
        near = difflib.get_close_matches(format, FORMATS, n=1)
        raise ConfigError(
            f"unknown format {format!r}",
            where="--format",
            expected=" or ".join(FORMATS),
            fix=f"Did you mean {near[0]}?" if near else "",
        )
    tell: Progress = progress or (lambda done, total, word: None)
    if format == "euroc":
        return _euroc(log, out, imu, sensor_noise, overwrite, tell)
    if imu is not None or sensor_noise is not None:
        raise ConfigError("a rosbag2 folder holds the whole log", where="--imu, --noise", fix="Leave them out")
    return _rosbag2(log, out, overwrite, tell)


class _Folder:
    """Context manager over a folder being written; leaving it without an error puts it in its place.

    Any error, Ctrl-C included, removes what was written. An older folder is replaced only if its file `signed` says that it
    was made here and its top holds nothing but what `holds` matches: a data set that merely looks alike is never removed.

    Raises:
        ConfigError: the target exists (without `overwrite`), is no export, holds the log, or cannot be written.
    """

    def __init__(self, path: Path, log: Path, *, signed: str, holds: str, overwrite: bool) -> None:
        self.path, self.log, self.overwrite = path.absolute(), log, overwrite
        self.signed, self.holds = signed, holds
        self._refuse_existing()
        self.temporary = self._beside("partial")
        self._remove = weakref.finalize(self, shutil.rmtree, self.temporary, True)
        with _told(path):
            self.temporary.mkdir()

    def _beside(self, ending: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{os.getpid()}.{secrets.token_hex(4)}.{ending}")

    def _refuse_existing(self) -> None:
        if not self.path.exists() and not self.path.is_symlink():
            return
        if not self.overwrite:
            raise ConfigError("the target exists", where=self.path, fix="Choose another name, or add --overwrite")
        if self.path.is_symlink() or not self.path.is_dir():
            raise ConfigError("the target is no folder", where=self.path, expected="the name of a new folder")
        if self.log.resolve().is_relative_to(self.path.resolve()):
            raise ConfigError("the target holds the log itself", where=self.path, expected="another folder")
        foreign = sorted(entry.name for entry in self.path.iterdir() if not re.fullmatch(self.holds, entry.name))
        if foreign or not self._was_made_here():
            what = f"the target holds {foreign[0]}, which no export makes" if foreign else "the target was not made by imutool"
            raise ConfigError(what, where=self.path, fix="Choose another folder, or remove this one yourself")

    def _was_made_here(self) -> bool:
        try:
            with (self.path / self.signed).open("rb") as file:
                return SIGNATURE.encode() in file.read(len(SIGNATURE) + 80)
        except OSError:
            return False

    def __enter__(self) -> Path:
        return self.temporary

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            if kind is None:
                self._commit()
        finally:
            self._remove()

    def _commit(self) -> None:
        """Puts the folder in its place, and an older one out of it only when nothing can go wrong any more."""
        self._refuse_existing()
        with _told(self.path):
            if not self.path.exists():
                self.temporary.rename(self.path)
                return
            before = self._beside("replaced")
            self.path.rename(before)
            try:
                self.temporary.rename(self.path)
            except BaseException:
                before.rename(self.path)
                raise
            shutil.rmtree(before)


@contextlib.contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        fix = "Choose a place that can be written and has room"
        raise ConfigError(f"cannot be written ({reason})", where=path, fix=fix) from error


def _euroc(
    log: Path, out: Path, imu: str | None, sensor_noise: str | Path | None, overwrite: bool, tell: Progress
) -> ExportReport:
    given = noise.read(sensor_noise) if sensor_noise is not None else None
    with Log(log) as opened:
        topic = imu or _best_imu(opened)
        topics = list(opened.topics)
        velocities = {name: t.metadata[VELOCITY_KEY] for name, t in opened.topics.items() if VELOCITY_KEY in t.metadata}
    with _Folder(out, log, signed="mav0/imu0/sensor.yaml", holds="mav0", overwrite=overwrite) as folder:
        recording = read(log, imu=topic)
        with _told(out):
            writer = _Asl(folder / "mav0", recording, tell)
            writer.imu(given)
            writer.truths()
            writer.cameras()
            writer.texts()
    left_out = [name for name in topics if velocities.get(name, name) not in writer.used]
    return ExportReport(out, "euroc", topic, writer.written, left_out)


def _best_imu(log: Log) -> str:
    """The debiased IMU, else the raw one.

    Raises:
        LogError: there is none, or several to choose from.
    """
    every = log.with_schema((schema.IMU,))
    derived = [t.name for t in every if DERIVED_KEY in t.metadata]
    found = derived or [t.name for t in every]
    if len(found) != 1:
        listed = ", ".join(found) or "none"
        raise LogError(f"IMU topics: {listed}", where=log.path, expected="one", fix="Choose with --imu" if found else "")
    return found[0]


class _Asl:
    """Writes the parts of a `mav0` folder, and keeps count."""

    def __init__(self, root: Path, recording: Recording, tell: Progress) -> None:
        self.root, self.recording, self.tell = root, recording, tell
        self.written: dict[str, int] = {}
        self.used: set[str] = {recording.imu_topic}
        self.root.mkdir()

    def imu(self, given: Noise | None) -> None:
        """`imu0`: samples to the last bit, and a sensor.yaml."""
        imu = self.recording.imu
        self._table("imu0", IMU_COLUMNS, imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1))
        self._text("imu0/sensor.yaml", self._imu_yaml(given))

    def truths(self) -> None:
        """The true poses under the names EuRoC has for them; the first under that of the truth, whatever its topic."""
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
        """A true bias on the stamps of the poses, NaN where it is not known; all NaN if some of it lies between them."""
        rows = np.full((len(poses), 3), np.nan)
        name = f"{topic.removesuffix('/pose')}/bias/{end}"
        known: Scalars | None = self.recording.scalars.get(name)
        if known is not None and known.values.shape[1] == 3 and np.isin(known.t_ns, poses.t_ns).all():
            rows[np.searchsorted(poses.t_ns, known.t_ns)] = known.values
            self.used.add(name)
        return rows

    def cameras(self) -> None:
        """One folder a camera with the images byte for byte, one in memory at a time."""
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
                    raise LogError(f"the image at {t_ns} ns is neither PNG nor JPEG", where=topic, fix="Use --format rosbag2")
                name = f"{t_ns}{ending}"
                try:
                    with (images / name).open("xb") as file:
                        file.write(image)
                except FileExistsError as error:
                    raise LogError(f"two images at {t_ns} ns", where=topic, expected="increasing stamps") from error
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
        """The source's own text where it has one and nothing else was asked for; else one with a sheet's figures."""
        note = f"{SIGNATURE} from {_line(self.recording.name)}, topic {_line(self.recording.imu_topic)}\n"
        if (kept := self._kept("imu0/sensor.yaml")) and given is None:
            directive, rest = (kept + "\n").split("\n", 1) if kept.startswith("%") else ("", kept)  # %YAML must come first
            return f"{directive}\n{note}{rest}" if directive else note + kept
        named = self.recording.metadata.get("imutool", {}).get("sensor", "").lower()
        sheet = given or noise.SHEETS[named if named in noise.SHEETS else DEFAULT_SHEET]
        lines = [note + "sensor_type: imu", f"comment: {json.dumps(named or 'unknown')}", "T_BS:", IDENTITY.rstrip("\n")]
        lines.append(f"rate_hz: {1.0 / self.recording.imu.period_s:.6g}")
        if given is None:
            said = (
                f"the sensor's, {named}" if named in noise.SHEETS else f"{DEFAULT_SHEET}'s, as the log does not name its sensor"
            )
            lines.append(f"# Noise: defaults of a data sheet ({said}), not measured on this sensor")
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
                rows = slice(block, block + BLOCK_ROWS)
                file.writelines(_rows(t_ns[rows].tolist(), values[rows].tolist()))
                self.tell(min(block + BLOCK_ROWS, len(t_ns)), len(t_ns), folder)
        self.written[f"{folder}/data.csv"] = len(t_ns)

    def _text(self, name: str, text: str) -> None:
        (self.root / name).write_text(text, encoding="utf-8", newline="\n")


def _rows(stamps: Iterable[int], values: Iterable[Iterable[float]]) -> Iterator[str]:
    """Lines of a table; `repr` is the shortest text that reads back to the same number."""
    for stamp, row in zip(stamps, values, strict=True):
        yield f"{stamp},{','.join(map(repr, row))}\n"


def _line(text: str) -> str:
    """Text that stays in its line, also of a file others parse."""
    return "".join(c if c.isprintable() else " " for c in text)


# ── rosbag2 ──

VERSION = 5  # of metadata.yaml: the oldest with a list of files, so that Humble plays it, and every later one too
QOS_NUMBERS = {  # as rmw numbers them; names came with version 9
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available"),
}


def _rosbag2(log: Path, out: Path, overwrite: bool, tell: Progress) -> ExportReport:
    with Log(log) as opened:
        _refuse_what_rosbag2_cannot(opened)
        name = f"{out.absolute().name}_0.mcap"
        text = _metadata_yaml(opened, name)
        counts = {topic.name: topic.count for topic in opened.topics.values()}
    holds = r"metadata\.yaml|.*_\d+\.mcap"
    with _Folder(out, log, signed="metadata.yaml", holds=holds, overwrite=overwrite) as folder, _told(out):
        _copy(log, folder / name, tell)
        (folder / "metadata.yaml").write_text(text, encoding="utf-8", newline="\n")
    return ExportReport(out, "rosbag2", None, counts)


def _refuse_what_rosbag2_cannot(log: Log) -> None:
    """The log is copied as it is, so it must be one already.

    Raises:
        LogError: the profile is another, or a topic is not in CDR or has no schema.
    """
    if log.profile != "ros2":
        raise LogError(f"the log's profile is {log.profile!r}", where=log.path, expected="'ros2', the only one rosbag2 holds")
    for topic in log.topics.values():
        if topic.message_encoding != "cdr" or not topic.schema_name:
            what = (
                f"{topic.name} is encoded as {topic.message_encoding!r}" if topic.schema_name else f"{topic.name} has no schema"
            )
            raise LogError(what, where=log.path, expected="CDR messages of ROS 2", fix="Use --format euroc")


def _copy(log: Path, copy: Path, tell: Progress) -> None:
    """The log's bytes in a file of its own (no link: what happens to one must not happen to the other), read back and compared.

    Raises:
        LogError: the log changed while it was copied.
        ConfigError: what was written does not read back the same.
    """
    size, done, told = log.stat().st_size, 0, hashlib.sha256()
    with log.open("rb") as source, copy.open("xb") as target:
        while block := source.read(COPY_BYTES):
            told.update(block)
            target.write(block)
            done += len(block)
            tell(done, 2 * size, copy.name)
        target.flush()
        os.fsync(target.fileno())
    if done != size:
        raise LogError("changed while it was copied", where=log, fix="Wait until it is complete")
    again = hashlib.sha256()
    with copy.open("rb") as written:
        while block := written.read(COPY_BYTES):
            again.update(block)
            done += len(block)
            tell(done, 2 * size, copy.name)
    if again.digest() != told.digest():
        raise ConfigError("does not read back as it was written", where=copy.parent, fix="Look at the disk")


def _metadata_yaml(log: Log, name: str) -> str:
    """What rosbag2 wants to know of the folder; JSON strings are YAML strings."""
    ends = [(int(t.min()), int(t.max())) for topic in log.topics for t in log.stamps(topic) if len(t)]
    start = min((first for first, _ in ends), default=0)
    duration = max((last for _, last in ends), default=0) - start
    total = sum(topic.count for topic in log.topics.values())
    times = (
        f"{{}}starting_time:\n{{}}  nanoseconds_since_epoch: {start}\n{{}}duration:\n{{}}  nanoseconds: {duration}\n"
        f"{{}}message_count: {total}\n"
    )
    text = f"{SIGNATURE}\nrosbag2_bagfile_information:\n  version: {VERSION}\n  storage_identifier: mcap\n" + _indented(
        times, 2
    )
    text += "  topics_with_message_count:" + ("\n" if log.topics else " []\n")
    for topic in log.topics.values():
        text += (
            "    - topic_metadata:\n"
            f"        name: {_quoted(topic.name)}\n"
            f"        type: {_quoted(topic.schema_name)}\n"
            "        serialization_format: cdr\n"
            f"        offered_qos_profiles: {_quoted(_qos(topic.metadata.get('offered_qos_profiles', '')))}\n"
            f"      message_count: {topic.count}\n"
        )
    text += f'  compression_format: ""\n  compression_mode: ""\n  relative_file_paths:\n    - {_quoted(name)}\n'
    return text + f"  files:\n    - path: {_quoted(name)}\n" + _indented(times, 6)


def _indented(text: str, by: int) -> str:
    return text.replace("{}", " " * by)


def _qos(text: str) -> str:
    """Offered qualities of service with numbers in place of names."""

    def number(found: re.Match[str]) -> str:
        names = QOS_NUMBERS[found[2]]
        return f"{found[1]}{names.index(found[3])}" if found[3] in names else found[0]

    return re.sub(r"^([-\s]*(history|reliability|durability|liveliness): *)(\w+)", number, text, flags=re.MULTILINE)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=True)
