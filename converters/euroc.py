"""EuRoC MAV: ADIS16448, 200 Hz, Leica or Vicon truth; ASL folder, .zip, .tar or .bag.

Source: Burri et al., IJRR 2016.

Frames: the IMU frame is the body frame, `state_groundtruth_estimate0` holds R_world_imu (its T_BS is the identity).
`vicon0` holds poses of the marker body, not of the IMU; they are kept as they are, their T_BS stands in the metadata.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from imutool.recording import Recording

from . import Sequence, _asl, _bag
from ._source import Tree, find, is_bag

DATASET, SENSOR = "euroc", "adis16448"
TRUTHS = {
    "state_groundtruth_estimate0": "/ground_truth/pose",
    "state_groundtruth_recomputed0": "/ground_truth_recomputed/pose",
    "gt0": "/ground_truth/pose",  # as Kimera writes the format
    "vicon0": "/ground_truth_vicon/pose",
}
SEQUENCES = re.compile(r"(MH_0[1-5]|V[12]_0[1-3])(_(easy|medium|difficult))?")
BAG_SIGNS = {"/vicon/firefly_sbx/firefly_sbx", "/leica/position"}
BAG_TRUTHS = ("/vicon/firefly_sbx/firefly_sbx",)
sequences = find  # ASL folders and bags, named like the folder or archive


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is EuRoC: whole-number stamps and no motion capture as in TUM-VI.

    A bag needs /imu0 and the topic of the laser tracker or of the Vicon system.
    """
    if is_bag(sequence.path):
        topics = _bag.topics(sequence.path)
        return _asl.IMU_TOPIC in topics and "/vrpn_client/raw_transform" not in topics and bool(BAG_SIGNS & topics.keys())
    tree = Tree(sequence)
    return "mocap0" not in tree.sensors() and not _asl.float_stamps(tree)


def _names_sensor(sequence: Sequence) -> bool:
    """Whether the IMU's own description names the sensor."""
    tree, name = Tree(sequence), f"{_asl.IMU}/sensor.yaml"
    return name in tree and SENSOR.upper().encode() in tree.load([name])[name].upper()


def read_sequence(sequence: Sequence, *, images: bool = True) -> Recording:
    """Recording of one sequence.

    Raises:
        DataError: the sequence contradicts its format, with file and line.
        ConfigError: it is a bag and rosbags is not installed.
    """
    known = bool(SEQUENCES.fullmatch(sequence.name)) or (is_bag(sequence.path) and recognises(sequence))  # it shows its origin
    sensor = SENSOR if known or (not is_bag(sequence.path) and _names_sensor(sequence)) else ""
    return _bag.recording_of(sequence, DATASET, sensor, known, TRUTHS, BAG_TRUTHS, images)


def read(source: Path) -> Iterator[Recording]:
    """Recordings of all sequences of the source, one after the other."""
    return map(read_sequence, sequences(source))
