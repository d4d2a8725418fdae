"""Live view of a debiasing: batches of samples and paths go to a viewer or a file.

Entities and styles are those of `scene`, except what needs truth or the end. Memory is constant: only the last pose of each
path is kept. An error here never stops the debiasing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from shlex import quote

import numpy as np

from imutool.debiasing import DebiasedBlock
from imutool.errors import ConfigError, ImutoolError
from imutool.inertial.strapdown import StartPose, dead_reckon
from imutool.mcap_io.storage.target import Target
from imutool.recording import Imu, Poses
from imutool.units import COLUMNS, SENSORS
from imutool.viewing import Output
from imutool.viewing.model.run_data import level_start
from imutool.viewing.rerun import connect, layout, rr, sdk, viewer
from imutool.viewing.rerun.connect import Listener
from imutool.viewing.rerun.entities import paths, styles
from imutool.viewing.rerun.entities.signals import SIGMAS
from imutool.viewing.rerun.entities.styles import MODEL_COLORS, RAW_COLOR
from imutool.viewing.rerun.plots import Box
from imutool.viewing.rerun.sdk import FLUSH_S, Role, Scope, new_stream

FLUSH_BATCH_S = 0.05  # for a batch to be sent
STALLED_S = 5.0  # without a sent batch: the viewer does not keep up, and waiting batches fill our memory
SCENE_SIZE_M = 5.0  # while the extent of the path is unknown
FOOTER, FOOTER_BYTES = b"RRF2FOOT", 16  # end of an .rrd file
ERRORS = (ImutoolError, RuntimeError, ValueError, TypeError, OSError)

logger = logging.getLogger("imutool")


@contextmanager
def live_view(
    name: str, *, connect_to: str | None = None, save: Path | None = None, instead: Path, overwrite: bool = False
) -> Iterator[Live]:
    """Live view for `imutool.debiasing.debias(watch=)`: a viewer, an .rrd file, or both.

    A viewer opens where neither `connect_to` nor `save` is given; where it cannot, the file `instead` is written. A file
    appears only after success.

    Raises:
        ConfigError: Rerun is not installed, nothing listens at `connect_to`, or the file exists (without `overwrite`) or
            cannot be written.
    """
    layout.live_blueprint({name: ()})  # the first layout takes 0.3 s, in which a stream of samples would have to wait
    live = Live(name)
    if connect_to is not None:
        peer = connect.probe(connect_to)
        live.send(peer, Output("connect", peer.url, f"Shown live: {peer.url}{connect.version_mismatch(peer)}."))
    elif save is None:
        try:
            peer = viewer.start().peer
            live.send(peer, Output("viewer", peer.url, "The viewer is open and showed the debiasing live."))
        except ConfigError as error:
            save, live.trouble = instead, viewer.as_sentence(error)
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
        if live.has_saved(target.temporary):
            target.commit()
    finally:
        target.abandon()


def is_complete_rrd(path: Path) -> bool:
    """Whether an .rrd file has its footer: Rerun writes it without reporting a full disk."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - FOOTER_BYTES))
        return FOOTER in file.read()


class Live:
    """Shows each block of a debiasing; `shown` lists the outputs."""

    def __init__(self, name: str) -> None:
        self._name, self.trouble = name, ""
        self._imus: dict[str, _Imu] = {}
        self._viewer: rr.RecordingStream | None = None
        self._file: rr.RecordingStream | None = None
        self._last_sent = time.monotonic()
        self.shown: list[Output] = []

    def send(self, peer: Listener, shown: Output) -> None:
        """Send everything to a viewer, which is `shown` unless it stops."""
        self._viewer = new_stream(self._name)
        self._viewer.connect_grpc(peer.url)
        self.shown.append(shown)

    def record(self, path: Path, temporary: Path) -> None:
        """Write everything to `temporary` too, which will become `path`."""
        self._file = new_stream(self._name)
        try:
            self._file.save(temporary)
        except UnicodeEncodeError as error:
            what = "has bytes in its path that are no UTF-8, which Rerun does not take"
            raise ConfigError(what, where=path, fix="Choose another place") from error
        self.shown.append(Output("rrd", str(path), f"{self.trouble}Saved {path}. Open with: rerun {quote(str(path))}"))

    def __call__(self, block: DebiasedBlock) -> None:
        """Show a block; after an error, warn once and stop the live view."""
        streams = [stream for stream in (self._viewer, self._file) if stream is not None]
        if not streams:
            return
        try:
            if block.topic not in self._imus:
                scope: Scope = () if not self._imus else ("run", block.topic)
                self._imus[block.topic] = _Imu(scope, block)
                for stream in streams:
                    self._imus[block.topic].begin(stream)
                self._lay_out(streams)
            self._imus[block.topic].log(block, streams)
        except ERRORS as error:
            self._file, self.shown = None, []
            self._drop_viewer(f"The live view failed ({error})")
            return
        self._check_viewer()

    def has_saved(self, path: Path) -> bool:
        """Whether the written file is complete; warns where it is not."""
        if self._file is None:
            return False
        if not is_complete_rrd(path):
            self.shown = [output for output in self.shown if output.how != "rrd"]
            logger.warning("The .rrd file could not be written completely, perhaps because the disk is full; it was removed")
            return False
        return True

    def finish(self) -> None:
        """Lay out the whole debiasing and flush everything to the viewer."""
        streams = [stream for stream in (self._viewer, self._file) if stream is not None]
        self._lay_out(streams, {topic: imu.box for topic, imu in self._imus.items()})
        if self._viewer is not None:
            try:
                self._viewer.flush(timeout_sec=FLUSH_S)
            except RuntimeError as error:
                self._drop_viewer(f"The viewer stopped listening ({error})")
        for stream in (self._viewer, self._file):
            if stream is not None:
                stream.disconnect()

    def _lay_out(self, streams: list[rr.RecordingStream], boxes: Mapping[str, Box] | None = None) -> None:
        scopes = {topic: imu.scope for topic, imu in self._imus.items()}
        for stream in streams if scopes else ():
            stream.send_blueprint(layout.live_blueprint(scopes, boxes))

    def _check_viewer(self) -> None:
        """Drops a viewer that is gone or stalled."""
        if self._viewer is None:
            return
        try:
            self._viewer.flush(timeout_sec=FLUSH_BATCH_S)
        except RuntimeError as error:
            if "timed out" not in str(error):
                self._drop_viewer("The viewer is gone")
            elif time.monotonic() - self._last_sent > STALLED_S:
                self._drop_viewer("The viewer does not keep up")
        else:
            self._last_sent = time.monotonic()

    def _drop_viewer(self, why: str) -> None:
        """Drops the viewer and warns once."""
        if self._viewer is not None:
            self.shown = [output for output in self.shown if output.how == "rrd"]
        self._viewer = None
        logger.warning("%s; debiasing goes on without it", why)


class _Imu:
    """Entities and growing paths of one IMU."""

    def __init__(self, scope: Scope, first: DebiasedBlock) -> None:
        self.scope = scope
        self._start_ns = self._last_ns = int(first.batch.stamp_ns[0])
        self._last_ns -= 1
        self.box: Box = (np.full(3, np.inf), np.full(3, -np.inf))  # of the debiased path
        self._paths: dict[Role, _GrowingPath] = {"raw": _GrowingPath(), "debiased": _GrowingPath()}

    def begin(self, to: rr.RecordingStream) -> None:
        """Log styles before any data."""
        colors = {"raw": RAW_COLOR, "debiased": MODEL_COLORS[0]}
        sdk.log_static(to, self._path("world"), rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for role, color in colors.items():
            sdk.log_static(to, self._path("world", role, "path"), styles.path_style(role, color))
            sdk.log_static(to, self._path("world", role, "body"), *styles.body_style(role, role, color, SCENE_SIZE_M))
        for kind in SENSORS:
            for role in self._paths:
                sdk.log_static(to, self._path("imu", kind, role), styles.axis_curves(role, styles.axis_names(role)))
            estimated = styles.axis_curves("debiased", styles.axis_names("estimated"))
            sdk.log_static(to, self._path("bias", kind, "estimated"), estimated)
            sdk.log_static(to, self._path("bias", kind, "sigma"), styles.sigma_curves())

    def log(self, block: DebiasedBlock, streams: list[rr.RecordingStream]) -> None:
        """Log the new samples of a block: after the recovery of a damaged log some come again."""
        new = block.batch.stamp_ns > self._last_ns
        if not new.any():
            return
        self._last_ns = int(block.batch.stamp_ns[-1])
        t_ns, log_ns = block.batch.stamp_ns[new], block.batch.log_time[new]
        raw = np.hstack([block.batch.gyro, block.batch.accel])[new]
        bias, margin = block.bias[new], SIGMAS * block.std[new]
        curves: dict[str, np.ndarray] = {}
        for kind, columns in COLUMNS.items():
            curves[self._path("imu", kind, "raw")] = raw[:, columns]
            curves[self._path("imu", kind, "debiased")] = (raw - bias)[:, columns]
            curves[self._path("bias", kind, "estimated")] = bias[:, columns]
            curves[self._path("bias", kind, "sigma")] = np.hstack([(bias + margin)[:, columns], (bias - margin)[:, columns]])
        times = sdk.time_columns(t_ns, log_ns, self._start_ns)
        for stream in streams:
            for entity, values in curves.items():
                stream.send_columns(entity, times, rr.Scalars.columns(scalars=values), strict=True)
        delay_ns = int(log_ns[-1] - t_ns[-1])
        for (role, path), samples in zip(self._paths.items(), (raw, raw - bias), strict=True):
            poses = path(Imu(t_ns, samples[:, :3].copy(), samples[:, 3:].copy()))
            self._log_path(self._path("world", role), poses, delay_ns, streams)
        low, high = self.box
        self.box = (
            np.minimum(low, poses.p_wb.min(axis=0)),
            np.maximum(high, poses.p_wb.max(axis=0)),
        )  # of the debiased path, which comes last

    def _log_path(self, entity: str, poses: Poses, delay_ns: int, streams: list[rr.RecordingStream]) -> None:
        cut = paths.path_pieces(poses)
        if not len(cut.first):
            return
        strips = np.stack([poses.p_wb[cut.first], poses.p_wb[cut.last]], axis=1)
        lines = rr.LineStrips3D.columns(strips=strips).partition(cut.counts)
        at_ns, body_ns = cut.stamp_ns, poses.t_ns[cut.last]
        q_xyzw = poses.q_wb_wxyz[cut.last][:, paths.Q_XYZW]
        body = rr.Transform3D.columns(translation=poses.p_wb[cut.last], quaternion=q_xyzw)
        for stream in streams:
            stream.send_columns(f"{entity}/path", sdk.time_columns(at_ns, at_ns + delay_ns, self._start_ns), lines, strict=True)
            stream.send_columns(
                f"{entity}/body", sdk.time_columns(body_ns, body_ns + delay_ns, self._start_ns), body, strict=True
            )

    def _path(self, *parts: str) -> str:
        return sdk.entity_path(self.scope, *parts)


class _GrowingPath:
    """Dead-reckoned path, batch by batch; equals that of `load_view.build` to the last digits."""

    def __init__(self) -> None:
        self._end: tuple[Imu, StartPose] | None = None

    def __call__(self, imu: Imu) -> Poses:
        """Poses at the samples, after the last pose before them, so that lines join.

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
