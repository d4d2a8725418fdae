"""A log as recordings of some minutes each, one in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

from imutool.errors import LogError
from imutool.mcap_io.frames import read_frames
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read_recordings
from imutool.recording import Poses, Recording

PART_ROWS = 1 << 15  # samples of a part: 2 MB, and as much again of poses and numbers


class NotInPartsError(Exception):
    """Parts of a log would not hold what the whole does."""


def read_in_parts(log: Log, imu: str) -> Iterator[Recording]:
    """Parts of a log's recording by log time, of `PART_ROWS` samples; the first has all images.

    Raises:
        NotInPartsError: stamps do not increase, or there is something to warn of; `read_recordings` of the whole says what.
    """

    def refuse(*_: object) -> None:
        raise NotInPartsError

    edges, count = list[int](), 0
    for times in log.stamps(imu):
        edges += times[-count % PART_ROWS :: PART_ROWS].tolist()
        count += len(times)
    if any(a >= b for a, b in pairwise(edges)):
        raise NotInPartsError
    last, has_velocity = dict[str, int](), dict[str, bool]()
    for start_ns, next_ns in pairwise([None, *edges[1:], None]):
        end_ns = None if next_ns is None else next_ns - 1
        try:
            part, *others = read_recordings(log, imu=imu, start_ns=start_ns, end_ns=end_ns, images=False, warn=refuse)
        except LogError as error:
            raise NotInPartsError from error
        columns = {imu: part.imu, **part.truths, **part.scalars}
        if others or (last and last.keys() != columns.keys()):
            raise NotInPartsError
        for name, each in columns.items():
            if len(each) and last.get(name, -(2**63)) >= each.t_ns[0]:
                raise NotInPartsError
            moves = isinstance(each, Poses) and each.v_w is not None
            if len(each) and has_velocity.setdefault(name, moves) is not moves:
                raise NotInPartsError
            last[name] = int(each.t_ns[-1]) if len(each) else last.get(name, -(2**63))
        yield part if start_ns is not None else replace(part, frames=read_frames(log))
