"""Latitude, longitude and height, or ECEF, of true poses, as metres along local axes.

In a plane about the first: north is (M + h) dlat and east (N + h) cos(lat) dlon, with the radii M and N of the ellipsoid there
(WGS 84; Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems, eq. 2.105, 2.106 and 2.111). A
kilometre to the north, lengths to the east are wrong by 1.6e-4 tan(lat).
"""

from __future__ import annotations

import re

import numpy as np

from imutool.array_types import Float64, Int64
from imutool.geometry import quaternion
from imutool.recording import Imu, interpolate

from ..text.delimited import Columns
from ..text.names import name_and_unit, split_name
from .map import Entries
from .rotations import UP, body_by_motion, rotations, seconds_of, up_share
from .units import ANGLE_SI, POSITION_SI

SEMI_MAJOR_M, ECCENTRICITY_SQUARED = 6_378_137.0, 6.69437999014e-3  # of WGS 84
ANGLE = r"(_?(deg|rad)[a-z]*)?"
GEODETIC = {
    "latitude": rf"(.*_)?lat(itude)?{ANGLE}",
    "longitude": rf"(.*_)?(lon|lng|long|longitude){ANGLE}",
    "height": r"(.*_)?(alt(itude)?|height|hgt|h|elevation)",
}
EASTING = "easting"
LOCAL = "local_"  # begins the names of the columns that are made
FROM_CENTRE_M = 6.3e6, 6.5e6  # of a place on the Earth, or above it


def add_local(columns: Columns) -> None:
    """Add local_north, local_east and local_down to a table of latitude, longitude, height."""
    names = {column: split_name(column)[0] for column in columns.values}
    found = [[c for c, each in names.items() if re.fullmatch(form, each)] for form in GEODETIC.values()]
    if any(len(each) != 1 for each in found):
        return
    latitude, longitude, height = (each[0] for each in found)
    values = columns.side_by_side([latitude, longitude, height])
    stated = name_and_unit(height, columns.units.get(height, ""))[1] or "m"
    unit = _unit(columns, [latitude, longitude], values)
    if unit and stated in POSITION_SI and np.isfinite(values).all(axis=1).any():
        values[:, :2] *= ANGLE_SI[unit]
        values[:, 2] *= POSITION_SI[stated]
        for axis, each in zip(("north", "east", "down"), plane(values).T, strict=True):
            columns.values[f"{LOCAL}{axis} [m]"] = each
        note = f"{LOCAL}north, {LOCAL}east and {LOCAL}down are {latitude}, {longitude} and {height} about their first"
        columns.remarks.notes.append(f"{note}, in m; the angles are taken for {unit}")
    elif not unit:
        columns.remarks.notes.append(f"{latitude} and {longitude} state neither deg nor rad: no positions are made of them")


def in_their_world(columns: Columns, entries: Entries, position: list[str], clock: tuple[str, str]) -> tuple[list[str], str]:
    """Positions in the world of the rotations, or the reason why there are none.

    Gravity shows that world. Those that were made here are north, east and down; a quaternion with z up is in a world of
    east, north and up. Easting, northing and height are positions where z is up.
    """
    name = split_name(position[0].rpartition("/")[2])[0] if position else ""
    if not name.startswith((LOCAL, EASTING)):
        return position, ""
    q_wxyz = rotations(columns, entries)
    body = body_by_motion(columns, entries, q_wxyz, clock)  # of angles from north: forward, right, down, whatever the IMU's
    share = up_share(columns, entries, q_wxyz, seconds_of(columns, clock), body)
    if share > UP and name == EASTING:
        return position, ""
    if share > UP and "quaternion_wxyz" in entries:
        note = "the world of the quaternions has +z up: it counts as east, north, up, and so do the positions"
        return [position[1], position[0], f"-{position[2]}"], note
    if share < -UP and name != EASTING:
        return position, ""
    what = "has +z up" if share > UP else "has +z down" if share < -UP else "does not show which way is up"
    return [], f"{', '.join(position)} are no positions of the poses: the world of their rotations {what}"


def _unit(columns: Columns, angles: list[str], values: Float64[np.ndarray, "n 3"]) -> str:
    """Unit of latitude and longitude: the stated one, or degrees beyond half a turn; else empty."""
    texts = [column.lower() + columns.units.get(column, "").lower() for column in angles]
    for unit, word in (("rad", r"(^|[^a-z])rad"), ("deg", r"(^|[^a-z])deg|°")):
        if all(re.search(word, text) for text in texts):
            return unit
    known = np.abs(values[np.isfinite(values).all(axis=1), :2])
    return "deg" if (known.max(axis=0, initial=0.0) > [np.pi / 2.0, np.pi]).any() else ""


def plane(values: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """North, east, down (m) of latitude, longitude (rad) and height (m), about the first known."""
    latitude, longitude, height = values[np.isfinite(values).all(axis=1)][0]
    bend = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    east_m = SEMI_MAJOR_M / np.sqrt(bend)
    north_m = east_m * (1.0 - ECCENTRICITY_SQUARED) / bend
    about = (values[:, 1] - longitude + np.pi) % (2.0 * np.pi) - np.pi  # past the date line
    north = (north_m + height) * (values[:, 0] - latitude)
    return np.stack([north, (east_m + height) * np.cos(latitude) * about, height - values[:, 2]], axis=1)


def to_east_north_up(
    t_ns: Int64[np.ndarray, " n"], p: Float64[np.ndarray, "n 3"], q_wxyz: Float64[np.ndarray, "n 4"], imu: Imu
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 4"], list[str]]:
    """Poses about the centre of the Earth in east, north, up, and a note; others as they are.

    The IMU's gravity is away from the centre in the world of their rotations. Northings of UTM may be as large.
    """
    if not len(p) or not FROM_CENTRE_M[0] < np.linalg.norm(middle := np.median(p, axis=0)) < FROM_CENTRE_M[1]:
        return p, q_wxyz, []
    longitude = np.arctan2(middle[1], middle[0])
    latitude = np.arctan2(middle[2], (1.0 - ECCENTRICITY_SQUARED) * np.hypot(*middle[:2]))  # exact on the ellipsoid
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    R_enu_ecef = np.stack([east, np.cross(up, east), up])
    force = interpolate((t_ns - imu.t_ns[0]) * 1e-9, (imu.t_ns - imu.t_ns[0]) * 1e-9, imu.accel)
    mean = np.nanmean(quaternion.rotate(q_wxyz, force), axis=0)
    if not float(mean @ up) > UP * float(np.linalg.norm(mean)):
        return p, q_wxyz, []
    note = "the poses count from the centre of the Earth (ECEF): they are east, north, up about the first in the log"
    return (p - p[0]) @ R_enu_ecef.T, quaternion.multiply(quaternion.of_matrix(R_enu_ecef), q_wxyz), [note]
