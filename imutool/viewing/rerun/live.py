"""A debiasing as it happens: every batch of samples goes to a viewer, or into a file, with the paths it makes so far.

The same entities in the same style as afterwards (`scene`), except what needs truth or the end. Memory is constant: of each
path the last pose is kept, everything else is the viewer's. What goes wrong here never reaches the debiasing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from imutool.debiasing import Block
from imutool.errors import ConfigError, ImutoolError
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.mcap_io.storage.target import Target
from imutool.recording import Imu, Poses
from imutool.viewing.model.output import Output
from imutool.viewing.model.run_data import level_start
from imutool.viewing.rerun import connect, live_layout, viewer
from imutool.viewing.rerun.connect import Peer
from imutool.viewing.rerun.entities import clock, names, paths, styles
from imutool.viewing.rerun.entities.names import Role, Scope
from imutool.viewing.rerun.entities.palette import MODEL_COLORS, RAW_COLOR
from imutool.viewing.rerun.entities.signals import KINDS, SIGMAS
from imutool.viewing.rerun.live_layout import Box
from imutool.viewing.rerun.sdk import FLUSH_S, named, need_sdk

if TYPE_CHECKING:
    import rerun as rr

PATIENCE_S = 0.05  # for a batch to leave
STALLED_S = 5.0  # without one that did: the viewer does not keep up, and what waits for it fills our memory
SIZE_M = 5.0  # of a scene of which nobody knows yet how large it becomes
END, END_BYTES = b"RRF2FOOT", 16  # the last words of an .rrd
COLUMNS = (slice(0, 3), slice(3, 6))  # of the gyroscope and the accelerometer
TROUBLE = (ImutoolError, RuntimeError, ValueError, TypeError, OSError)

logger = logging.getLogger("imutool")


@contextmanager
def watching(
    name: str, *, connect_to: str | None = None, save: Path | None = None, instead: Path, overwrite: bool = False
) -> Iterator[Live]:
    """Somebody to watch a debiasing (`imutool.debiasing.debias(watch=)`): a viewer, a file, or both.

    A viewer of our own opens where neither is named; where it cannot, the file `instead` is written. A file appears when all
    is done, and not at all if it fails.

    Raises:
        ConfigError: Rerun is not installed, nobody listens at `connect_to`, or the file exists (without `overwrite`) or
            cannot be written.
    """
    need_sdk()
    live = Live(name)
    if connect_to is not None:
        peer = connect.probe(connect_to)
        live.send(peer, Output("connect", peer.url, f"Shown as it went: {peer.url}{connect.told(peer)}."))
    elif save is None:
        try:
            peer = viewer.open_empty()
            live.send(peer, Output("viewer", peer.url, "The viewer is open, and showed it as it went."))
        except ConfigError as error:
            save, live.trouble = instead, viewer.sentence(error)
    if save is None:
        yield live
        live.finish()
        return
    target = Target(save, overwrite=overwrite, summing=False)
    try:
        assert isinstance(target.temporary, Path), "not in a store"
        live.record(save, target.temporary)
        yield live
        live.finish()
        if live.kept(target.temporary):
            target.commit()
    finally:
        target.abandon()


def whole(path: Path) -> bool:
    """Whether an .rrd has its end: Rerun, which writes it, tells nobody that a disk is full."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - END_BYTES))
        return END in file.read()


class Live:
    """Takes each block of a debiasing and shows it; `shown` says where, and what became of it."""

    def __init__(self, name: str) -> None:
        self._name, self.trouble = name, ""
        self._watched: dict[str, _Imu] = {}
        self._viewer: rr.RecordingStream | None = None
        self._file: rr.RecordingStream | None = None
        self._left_at = time.monotonic()
        self.shown: list[Output] = []

    def send(self, peer: Peer, shown: Output) -> None:
        """Sends everything to a viewer, which is `shown` unless it goes away."""
        self._viewer = named(self._name)
        self._viewer.connect_grpc(peer.url)
        self.shown.append(shown)

    def record(self, path: Path, temporary: Path) -> None:
        """Also writes everything to a file, which is to become `path`."""
        self._file = named(self._name)
        self._file.save(temporary)
        self.shown.append(Output("rrd", str(path), f"{self.trouble}Saved {path}. Open with: rerun {path}"))

    def __call__(self, block: Block) -> None:
        """Shows a block; what cannot be shown is said once, and the rest goes on without it."""
        streams = [stream for stream in (self._viewer, self._file) if stream is not None]
        if not streams:
            return
        try:
            if block.topic not in self._watched:
                scope: Scope = () if not self._watched else ("run", block.topic)
                self._watched[block.topic] = _Imu(scope, block)
                for stream in streams:
                    self._watched[block.topic].begin(stream)
                self._lay_out(streams)
            self._watched[block.topic].log(block, streams)
        except TROUBLE as error:
            self._file, self.shown = None, []
            self._give_up(f"It cannot be shown as it goes ({error})")
            return
        self._see_off()

    def kept(self, path: Path) -> bool:
        """Whether what was written there is all of it; said where it is not and nothing else was said."""
        if self._file is None:
            return False
        if not whole(path):
            self.shown = [one for one in self.shown if one.how != "rrd"]
            logger.warning("What was to be shown could not be written whole, perhaps for lack of room; there is no such file")
            return False
        return True

    def finish(self) -> None:
        """Everything was debiased: the whole of it is laid out, and whoever listens has all of it."""
        streams = [stream for stream in (self._viewer, self._file) if stream is not None]
        self._lay_out(streams, {topic: imu.box for topic, imu in self._watched.items()})
        if self._viewer is not None:
            try:
                self._viewer.flush(timeout_sec=FLUSH_S)
            except RuntimeError as error:
                self._give_up(f"The viewer stopped listening ({error})")
        for stream in (self._viewer, self._file):
            if stream is not None:
                stream.disconnect()

    def _lay_out(self, streams: list[rr.RecordingStream], boxes: Mapping[str, Box] | None = None) -> None:
        scopes = {topic: imu.scope for topic, imu in self._watched.items()}
        for stream in streams if scopes else ():
            stream.send_blueprint(live_layout.blueprint(scopes, boxes))

    def _see_off(self) -> None:
        """Looks whether the viewer still takes what it is sent; waiting for it is kept short."""
        if self._viewer is None:
            return
        try:
            self._viewer.flush(timeout_sec=PATIENCE_S)
        except RuntimeError as error:
            if "timed out" not in str(error):
                self._give_up("The viewer is gone")
            elif time.monotonic() - self._left_at > STALLED_S:
                self._give_up("The viewer does not keep up")
        else:
            self._left_at = time.monotonic()

    def _give_up(self, why: str) -> None:
        """Leaves the viewer to itself, and says so once."""
        if self._viewer is not None:
            self.shown = [one for one in self.shown if one.how == "rrd"]
        self._viewer = None
        logger.warning("%s; debiasing goes on without it", why)


class _Imu:
    """One IMU that is watched: where its entities lie, and how far its two paths have come."""

    def __init__(self, scope: Scope, first: Block) -> None:
        self.scope = scope
        self._start_ns = self._last_ns = int(first.batch.stamp_ns[0])
        self._last_ns -= 1
        self.box: Box = (np.full(3, np.inf), np.full(3, -np.inf))  # of the debiased path
        self._ways: dict[Role, _Way] = {"raw": _Way(), "debiased": _Way()}

    def begin(self, to: rr.RecordingStream) -> None:
        """Styles, before anything that has one."""
        import rerun as rr

        colors = {"raw": RAW_COLOR, "debiased": MODEL_COLORS[0]}
        to.log(self._path("world"), rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
        for role, color in colors.items():
            to.log(self._path("world", role, "path"), styles.path(role, color), static=True, strict=True)
            to.log(self._path("world", role, "body"), *styles.body(role, role, color, SIZE_M), static=True, strict=True)
        for kind in KINDS:
            for role in self._ways:
                to.log(self._path("imu", kind, role), styles.axes(role, role), static=True, strict=True)
            to.log(self._path("bias", kind, "estimated"), styles.axes("debiased", "estimated"), static=True, strict=True)
            to.log(self._path("bias", kind, "sigma"), styles.sigma("estimated"), static=True, strict=True)

    def log(self, block: Block, streams: list[rr.RecordingStream]) -> None:
        """The new samples of a block: those after a damaged log's repair that were seen before it are none."""
        new = block.batch.stamp_ns > self._last_ns
        if not new.any():
            return
        self._last_ns = int(block.batch.stamp_ns[-1])
        import rerun as rr

        t_ns, log_ns = block.batch.stamp_ns[new], block.batch.log_time[new]
        raw = np.hstack([block.batch.gyro, block.batch.accel])[new]
        bias, spread = block.bias[new], SIGMAS * block.std[new]
        curves: dict[str, np.ndarray] = {}
        for kind, columns in zip(KINDS, COLUMNS, strict=True):
            curves[self._path("imu", kind, "raw")] = raw[:, columns]
            curves[self._path("imu", kind, "debiased")] = (raw - bias)[:, columns]
            curves[self._path("bias", kind, "estimated")] = bias[:, columns]
            curves[self._path("bias", kind, "sigma")] = np.hstack([(bias + spread)[:, columns], (bias - spread)[:, columns]])
        times = clock.columns(t_ns, log_ns, self._start_ns)
        for stream in streams:
            for entity, values in curves.items():
                stream.send_columns(entity, times, rr.Scalars.columns(scalars=values), strict=True)
        delay_ns = int(log_ns[-1] - t_ns[-1])
        for (role, way), samples in zip(self._ways.items(), (raw, raw - bias), strict=True):
            poses = way(Imu(t_ns, samples[:, :3].copy(), samples[:, 3:].copy()))
            self._log_path(self._path("world", role), poses, delay_ns, streams)
        low, high = self.box
        self.box = np.minimum(low, poses.p_wb.min(axis=0)), np.maximum(high, poses.p_wb.max(axis=0))  # the debiased come last

    def _log_path(self, home: str, poses: Poses, delay_ns: int, streams: list[rr.RecordingStream]) -> None:
        import rerun as rr

        cut = paths.pieces(poses)
        if not len(cut.first):
            return
        strips = np.stack([poses.p_wb[cut.first], poses.p_wb[cut.last]], axis=1)
        lines = rr.LineStrips3D.columns(strips=strips).partition(cut.counts)
        at_ns, body_ns = cut.stamp_ns, poses.t_ns[cut.last]
        q_xyzw = poses.q_wb_wxyz[cut.last][:, paths.Q_XYZW]
        body = rr.Transform3D.columns(translation=poses.p_wb[cut.last], quaternion=q_xyzw)
        for stream in streams:
            stream.send_columns(f"{home}/path", clock.columns(at_ns, at_ns + delay_ns, self._start_ns), lines, strict=True)
            stream.send_columns(f"{home}/body", clock.columns(body_ns, body_ns + delay_ns, self._start_ns), body, strict=True)

    def _path(self, *parts: str) -> str:
        return names.path(self.scope, *parts)


class _Way:
    """A dead-reckoned path that grows by batches: what `rundata.build` integrates at once, to the last digits."""

    def __init__(self) -> None:
        self._end: tuple[Imu, StartPose] | None = None

    def __call__(self, imu: Imu) -> Poses:
        """The poses at the samples, after the last one before them, so that lines join.

        Raises:
            NumericsError: the numbers overflow.
        """
        if self._end is None:
            poses = dead_reckon(imu, level_start(imu))
        else:
            last, start = self._end
            joined = (np.concatenate([getattr(last, name), getattr(imu, name)]) for name in ("t_ns", "gyro", "accel"))
            poses = dead_reckon(Imu(*joined), start)
        self._end = imu.rows(slice(len(imu) - 1, None)), StartPose(*(np.array(part) for part in StartPose.of(poses, -1)))
        return poses
