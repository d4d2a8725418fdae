"""FETCH mobile base: 100 Hz, motion capture; ASL folder, archive or .bag.

Source: released with the neural-ODE bias paper.

The stamps are nanoseconds printed in scientific notation with 19 digits; they are read exactly, with no float between.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from imutool.recording import Recording

from . import Sequence, _asl, _bag
from ._source import Tree, find, is_bag

DATASET, SENSOR = "fetch", "fetch"
BAG_IMU = "/base/imu"
TRUTHS = {"mocap0": "/ground_truth/pose"}
sequences = find  # ASL folders and bags, named like the folder or archive


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is FETCH: stamps in scientific notation.

    A bag needs the base's IMU and a motion-capture pose.
    """
    if is_bag(sequence.path):
        topics = _bag.topics(sequence.path)
        mocap = any("mocap" in topic and kind == "geometry_msgs/msg/PoseStamped" for topic, kind in topics.items())
        return topics.get(BAG_IMU) == _bag.IMU and mocap
    return _asl.float_stamps(Tree(sequence))


def read_sequence(sequence: Sequence, *, images: bool = True) -> Recording:
    """Recording of one sequence.

    Raises:
        DataError: the sequence contradicts its format, with file and line.
        ConfigError: it is a bag and rosbags is not installed.
    """
    known = recognises(sequence)  # by its stamps, or by its bag's topics
    return _bag.recording_of(sequence, DATASET, SENSOR if known else "", known, TRUTHS, (), images)


def read(source: Path) -> Iterator[Recording]:
    """Recordings of all sequences of the source, one after the other."""
    return map(read_sequence, sequences(source))
