"""Roles of the tables of a recording: of IMUs, of sensors, of poses."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from ..columns.map import IMU_GROUP, POSES_GROUP, TRUTH_GROUP
from ..columns.pose_names import TRUE_GROUPS
from ..files.sensors import SENSORS, SPACED, WORD, pairs_among, plain_among, sensors_among
from .look import MAX_LARGER, look

Names = Mapping[Path, str]  # of tables, without their endings
IMU = r"(.*[ _-])?(imu|inertial)\d*([ _-].*)?"  # in the name of a file, as of UZH-FPV's imu.txt; else its columns show it
IMUS = r"(imu|inertial)[ _-]?\w{1,20}"  # of several next to one file of poses: imu_1, imu_left
POSES = rf"(.*[ _-])?({TRUE_GROUPS}|ground[ _-]truth)([ _-].*)?"  # groundtruth.txt, stamped_groundtruth_imu.txt
REFERENCE = r"(.*[ _-])?ref(erence)?([ _-].*)?"  # of poses; of rates it is an ideal sensor
ROLES = "imu|inertial|ground|truth|poses?|raw|rots?|ref|reference"
ROLE = "|".join([ROLES, TRUE_GROUPS, *SENSORS.values()])  # a word in the name of a file


def without_role(stem: str) -> str:
    """Name of a file without the words that say what its table holds."""
    parts = re.split(rf"({WORD}|\d+)", stem)
    return "".join(part for part in parts if not re.fullmatch(ROLE, part.lower())).strip("_- .")


def role_folders(folder: Path) -> list[Path]:
    """Folders of IMUs, then those of poses next to them, by their names; none without both."""
    folders = {path: re.sub(SPACED, "_", path.name).lower() for path in sorted(folder.iterdir()) if path.is_dir()}
    imus = [path for path, name in folders.items() if re.fullmatch(IMU, name)]
    poses = [path for path, name in folders.items() if re.fullmatch(rf"{POSES}|poses?", name) and path not in imus]
    return [*imus, *poses] if imus and poses else []


def shared_names(stems: Names, roles: Names) -> dict[Path, str]:
    """What the names of a recording's tables have in common: `walk` of `walk_imu` and `walk_gt`.

    Tables in folders with roles (`imu/run-03`, `vicon/track_3`) may have numbers in common instead, which are in each folder
    the numbers of one table.
    """
    shared = {path: without_role(stem) for path, stem in stems.items()}
    count = Counter(shared.values())
    numbers = {p: tuple(map(int, re.findall(r"\d+", stem))) for p, stem in stems.items() if roles[p] and count[shared[p]] == 1}
    in_roles: dict[tuple[int, ...], list[str]] = {}
    for path, each in numbers.items():
        in_roles.setdefault(each, []).append(roles[path])
    pairs = {each for each, found in in_roles.items() if each and 1 < len(found) == len({*found})}
    return shared | {path: " ".join(map(str, each)) for path, each in numbers.items() if each in pairs}


def role_groups(tables: Names) -> dict[Path, str]:
    """Groups of the tables of a recording: of sensors, or of IMUs and poses; else none."""
    sensors, seen = sensors_among(tables.values()), {path: look(path) for path in tables}
    several = pairs_among(tables.values()) or plain_among(tables.values())
    groups = sensors if {*sensors.values()} == {*SENSORS} else several
    of_sensors = {path: groups[stem] for path, stem in tables.items() if stem in groups}
    captured = [path for path in tables if seen[path].is_mocap]
    words = {path: re.sub(SPACED, "_", stem).lower() for path, stem in tables.items()}  # viconRot1
    true = captured or [path for path in tables if re.fullmatch(POSES, words[path])]
    true = true or [p for p in tables if re.fullmatch(REFERENCE, words[p]) and seen[p].has_poses and not seen[p].is_imu]
    turned = [path for path in true if seen[path].has_turns]
    if len(true) == 2 and len(turned) == 1 and not seen[turned[0]].has_poses:  # its positions are in the other one
        true = turned
    if of_sensors:
        return of_sensors | {path: TRUTH_GROUP for path in true if len(true) == 1 and path not in of_sensors}
    shown = [path for path in tables if seen[path].is_imu and path not in true]
    shown = [path for path in shown if not re.fullmatch(REFERENCE, words[path])] or shown  # whose rates are no sensor's
    imus = [path for path in tables if re.fullmatch(IMU, words[path]) and path not in true] or shown
    poses = true or [path for path in tables if seen[path].has_poses and path not in shown]
    if len(poses) == len(shown) == 1 and shown[0] in imus and seen[poses[0]].has_poses:
        imus = shown  # imu0_resampled of TLIO has poses
    if not poses and len(imus) == len(shown) == 1 and any(seen[path].has_time for path in tables if path not in shown):
        return {shown[0]: IMU_GROUP}
    if len(poses) != 1 or poses[0] in imus:
        return {}
    beside = {poses[0]: TRUTH_GROUP if true else POSES_GROUP}
    together = [path for path in shown if re.fullmatch(IMUS, tables[path].lower())]
    paired = without_role(tables[poses[0]]) in {without_role(tables[path]) for path in together}
    if len(together) > 1 and not paired and _of_one_size(together):
        return {path: re.sub(r"[ -]", "_", tables[path].lower()) for path in together} | beside
    return {imus[0]: IMU_GROUP} | beside if len(imus) == 1 else {}


def _of_one_size(paths: list[Path]) -> bool:
    """Whether files have about as many bytes, as those of IMUs that were recorded together have."""
    sizes = [path.stat().st_size for path in paths]
    return max(sizes) < MAX_LARGER * min(sizes)
