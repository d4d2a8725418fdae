"""Log of a simulation with the poses of its sensor.

The simulator's poses are moved by the mount that its /tf_static states. They are true, whatever their topic is called. In a
world whose frame is named NED, z is turned up.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.bias_start.stretches import longest_stretch, measured_recording
from imutool.file_location import Location
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import longest_recording, read_recordings
from imutool.recording import Poses, Recording

Z_UP = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # of north, east, down: east, north, up


class Mount(NamedTuple):
    """Pose of a sensor's frame in its body's."""

    p: Float64[np.ndarray, "3"]
    R: Rotation

    @property
    def arm(self) -> Float64[np.ndarray, "3"]:
        """Lever arm (m) in the sensor's axes."""
        return np.asarray(self.R.inv().apply(self.p))


AT_BODY = Mount(np.zeros(3), Rotation.identity())


def read_simulation(
    sim: Location, *, imu: str | None, truth: str | None = None, simulated: bool = True
) -> tuple[Recording, Mount]:
    """A simulation with the poses of its sensor, and the mount that moved them.

    A recording is read likewise, if not `simulated`: its only poses need not be true then, and it does not fall freely.

    Raises:
        ConfigError, LogError: the log cannot be read, or has several poses and no `truth`.
    """
    with Log(sim) as log:
        others = log.pose_topics
        if simulated and truth is None and not log.truth_topics and len(others) == 1:
            truth = others[0]
        recording = measured_recording(longest_recording(read_recordings(log, imu=imu, truth=truth)), free_fall=simulated)
        recording = longest_stretch(recording)
        if not recording.truths:
            return recording, AT_BODY
        topic = next(iter(recording.truths))
        world, body = _pose_frames(log, topic)
        mount = _stated_mount(_static_transforms(log), _imu_frame(log, recording.imu_topic), world, body)
    moved = _of_sensor(recording.truths[topic], mount, down="ned" in re.split(r"[^a-z0-9]+", world.lower()))
    return replace(recording, truths={**recording.truths, topic: moved}), mount


def imu_in(sim: Location, imu: str | None) -> str | None:
    """IMU topic of a simulation: that of the recording, or its only one, whatever its name."""
    with Log(sim) as log:
        return log.imu_topics[0] if imu is not None and imu not in log.topics and len(log.imu_topics) == 1 else imu


def _of_sensor(poses: Poses, mount: Mount, *, down: bool) -> Poses:
    """Poses of the sensor in a world whose z is up; the same object where nothing changes."""
    R_wb, turned = Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True), Z_UP if down else Rotation.identity()
    if not down and mount is AT_BODY:
        return poses
    p = turned.apply(poses.p_wb + R_wb.apply(mount.p))
    return Poses(poses.t_ns, p, (turned * R_wb * mount.R).as_quat(scalar_first=True))


def _pose_frames(log: Log, topic: str) -> tuple[str, str]:
    """World and body of the poses on a topic, or of a transform TOPIC/CHILD_FRAME; the body is empty where it is not said."""
    tree = next((name for name in log.topics if topic.startswith(f"{name}/")), "") if topic not in log.topics else ""
    for name, rows in log.rows([tree or topic]):
        for part in log.topics[name].decode_poses(rows):
            if not tree or topic == f"{tree}/{_plain(part.child_frame_id)}":
                return _plain(part.frame_id), _plain(part.child_frame_id)
    return "", ""


def _imu_frame(log: Log, topic: str) -> str:
    """Frame of an IMU; empty for one that is joined of two topics."""
    found = log.topics[topic]
    batches = (batch for _, rows in log.rows([topic]) for batch in found.decode_imu(rows))
    return "" if found.recorded_on else next((_plain(batch.frame_id) for batch in batches), "")


def _static_transforms(log: Log) -> dict[str, tuple[str, Mount]]:
    """Parent and pose of each frame on /tf_static."""
    out = {}
    topics = [topic.name for topic in log.with_schema((schemas.TF,)) if topic.name.endswith("tf_static") and topic.is_read]
    for name, rows in log.rows(topics) if topics else ():
        for part in (part for part in log.topics[name].decode_poses(rows) if len(part.stamp_ns)):
            R = Rotation.from_quat(part.q_wb_wxyz[0], scalar_first=True)
            out[_plain(part.child_frame_id)] = (_plain(part.frame_id), Mount(part.p_wb[0], R))
    return out


def _stated_mount(static: dict[str, tuple[str, Mount]], sensor: str, world: str, body: str) -> Mount:
    """The sensor in its body, or where the poses do not name their body, in the frame from which all others hang."""
    frame, mount = sensor, AT_BODY
    while frame in static and frame != body and static[frame][0] != world:
        (frame, up), static = static[frame], {child: of for child, of in static.items() if child != frame}
        mount = Mount(up.p + up.R.apply(mount.p), up.R * mount.R)
    return mount if not body or frame == body else AT_BODY


def _plain(frame: str) -> str:
    return frame.lstrip("/")
