"""TUM-VI: BMI160, 200 Hz, motion capture; ASL folder, .tar, .tar.gz, .zip or .bag.

Source: Schubert et al., IROS 2018.

Frames: `mocap0` holds R_world_imu and the IMU's position; a bag's `/vrpn_client/raw_transform` holds the marker body.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from imutool.recording import Recording

from . import Sequence, _asl, _bag
from ._source import Tree, find, is_bag

DATASET, SENSOR = "tum_vi", "bmi160"
TRUTHS = {"mocap0": "/ground_truth/pose"}
SEQUENCES = re.compile(r"(room|corridor|magistrale|outdoors|slides|calib-cam|calib-imu)[1-9]?")
BAG_TRUTHS = ("/vrpn_client/raw_transform",)


def sequences(source: Path) -> list[Sequence]:
    """Sequences in the source; `dataset-room2_512_16` is named `room2`."""
    return [replace(found, name=_short(found.name)) for found in find(source)]


def _short(name: str) -> str:
    official = re.fullmatch(r"dataset-(.+?)(_\d+_\d+)?", name)
    return official[1] if official else name


def recognises(sequence: Sequence) -> bool:
    """Whether a sequence is TUM-VI: motion capture and whole-number stamps.

    A bag needs the vrpn topic.
    """
    if is_bag(sequence.path):
        return "/vrpn_client/raw_transform" in _bag.topics(sequence.path)
    tree = Tree(sequence)
    return "mocap0" in tree.sensors() and not _asl.float_stamps(tree)


def read_sequence(sequence: Sequence, *, images: bool = True) -> Recording:
    """Recording of one sequence.

    Raises:
        DataError: the sequence contradicts its format, with file and line.
        ConfigError: it is a bag and rosbags is not installed.
    """
    known = bool(SEQUENCES.fullmatch(sequence.name)) or (is_bag(sequence.path) and recognises(sequence))  # it shows its origin
    return _bag.recording_of(sequence, DATASET, SENSOR if known else "", known, TRUTHS, BAG_TRUTHS, images)


def read(source: Path) -> Iterator[Recording]:
    """Recordings of all sequences of the source, one after the other."""
    return map(read_sequence, sequences(source))
