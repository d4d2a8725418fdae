"""Shows logs in Rerun: paths in 3D, raw against debiased signals, biases and errors on one timeline, or saves them."""

from __future__ import annotations

import importlib.util
import os
import re
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64

from imutool.errors import ConfigError
from imutool.mcap_io.target import Target
from imutool.recording import Poses, Times
from imutool.view.rundata import TRUTH, RunData, Trace, sparse, stretches

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

Color = tuple[int, int, int]

AXES = ("x", "y", "z")
XYZ: tuple[Color, ...] = ((230, 60, 60), (40, 170, 70), (60, 120, 240))  # the same three everywhere, on dark and light
GREY: Color = (128, 128, 128)
TRUTH_COLOR: Color = (150, 150, 150)
RAW_COLOR: Color = (230, 110, 20)
# Okabe and Ito's palette, told apart by colour-blind eyes too; orange belongs to raw.
MODEL_COLORS: tuple[Color, ...] = ((30, 140, 230), (0, 158, 115), (204, 121, 167), (190, 160, 0))
RAW_WIDTH, BOLD_WIDTH = 1.0, 2.0
PATH_RADIUS = 1.0
RAW_FADE, TRUE_FADE, NEXT_MODEL_FADE = 0.6, 0.45, 0.3  # how far a colour goes towards grey

READABLE = 10.0  # an error this many times smaller than the plot is high can still be read
MOST_IN_3D = 20_000  # poses of one path; plots are never thinned
MEMORY_LIMIT = "50%"  # of the machine, for a viewer of our own: by default it takes three quarters
VIEWER_STARTS_S = 10.0
FLUSH_S = 30.0
Q_XYZW = [1, 2, 3, 0]  # columns of wxyz

VIEWERS: list[subprocess.Popen[bytes]] = []  # they outlive us; held so that Python does not warn of a lost child


def show(logs: Sequence[RunData], *, save: Path | None = None, spawn: bool | None = None, overwrite: bool = False) -> str:
    """Opens the viewer or saves .rrd files, and returns a sentence that says which and how to go on.

    Without `save` and `spawn`, the viewer opens if there is a display, else the logs are saved as NAME.rrd here.
    Several logs are several recordings in one viewer, or several files in the folder `save`. A display is looked for
    before anything is sent, and a viewer that does not start is given up after ten seconds, at once if it dies; if
    nobody insisted on it with `spawn`, the logs are then saved instead.

    Raises:
        ConfigError: no log, Rerun is not installed, no display though `spawn` is true, or the target cannot be written.
    """
    if not logs:
        raise ConfigError("there is no log to show", where="view")
    _sdk()
    wants_viewer = spawn if spawn is not None else save is None and has_display()
    if wants_viewer and not has_display():
        raise ConfigError("there is no display (DISPLAY and WAYLAND_DISPLAY are not set)", where="view", fix="Use --save")
    said = []
    if wants_viewer:
        trouble = _open(logs)
        if trouble and spawn:
            raise ConfigError(trouble, where="view", fix="Use --save")
        said.append(trouble or "The viewer is open.")
    elif save is None:
        said.append("There is no display here.")
    if save is not None or not wants_viewer or trouble:
        said.append(_save(logs, save, overwrite))
    return " ".join(said)


def has_display() -> bool:
    """Whether a window can open here: always asked before a viewer is, since Rerun finds out only after 18 s."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def rrd(data: RunData) -> bytes:
    """The log and its layout as the content of an .rrd file.

    Raises:
        ConfigError: Rerun is not installed.
    """
    _sdk()
    import rerun as rr

    recording = _stream(data)
    stream = rr.binary_stream(recording)
    recording.send_blueprint(blueprint(data))
    log(data, recording)
    content = stream.read(flush_timeout_sec=FLUSH_S)
    assert content, "a stream that was written to holds bytes"
    return bytes(content)


def log(data: RunData, to: rr.RecordingStream) -> None:
    """Everything there is to see, into a Rerun recording: whole columns on timelines `elapsed` and `ros2_timestamp`.

    Entities: `/world/{truth,RUN}/{path,body}`, `/imu/{gyro,accel}/RUN`, `/bias/{gyro,accel}/{true,MODEL}`,
    `/error/{orientation,position}/RUN/{total,axes}` (degrees and metres) and `/report`.

    Raises:
        ConfigError: Rerun is not installed.
    """
    _sdk()
    import rerun as rr

    to.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, strict=True)
    to.log("report", rr.TextDocument(_report(data), media_type="text/markdown"), static=True, strict=True)
    size = _size(data)
    if data.truth is not None:
        _log_path(to, data, TRUTH, data.truth, TRUTH_COLOR, size)
    for trace in data.traces:
        _log_path(to, data, trace.name, trace.path, color_of(data, trace), size)
        _log_signals(to, data, trace)
        if trace.errors is not None:
            _log_errors(to, data, trace)
    for kind, bias in data.true_bias.items():
        style = rr.SeriesLines(
            names=[f"{axis} true" for axis in AXES],
            colors=[_fade(c, TRUE_FADE) for c in XYZ],
            widths=[2 * BOLD_WIDTH] * 3,
        )
        _log_scalars(to, f"bias/{kind}/true", data, bias.t_ns, bias.values, style)


def blueprint(data: RunData) -> rrb.Blueprint:
    """The layout: paths over errors on the left, tabs for signals, biases and the report on the right; no empty panel.

    Raises:
        ConfigError: Rerun is not installed.
    """
    _sdk()
    import rerun.blueprint as rrb

    left: list[Any] = [rrb.Spatial3DView(origin="/world", name="Paths", eye_controls=_eye(data), background=(24, 26, 30))]
    if data.truth is not None:
        left += [
            _plot(
                data, "/error/orientation", "Orientation error (deg)", _totals(data, "orientation"), _limit(data, "orientation")
            ),
            _plot(data, "/error/position", "Position error (m)", _totals(data, "position"), _limit(data, "position")),
        ]
    tabs: list[Any] = [
        rrb.Vertical(
            _plot(data, "/imu/gyro", "Angular rate (rad/s)"),
            _plot(data, "/imu/accel", "Specific force (m/s²)"),
            name="Signals",
        )
    ]
    if data.models() or data.true_bias:
        units = {"gyro": "Gyro bias (rad/s)", "accel": "Accel bias (m/s²)"}
        shown = units if data.models() else {kind: units[kind] for kind in data.true_bias}
        tabs.append(rrb.Vertical(*(_plot(data, f"/bias/{k}", title) for k, title in shown.items()), name="Bias"))
    tabs.append(rrb.TextDocumentView(origin="/report", name="Report"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2, 1, 1][: len(left)]), rrb.Tabs(*tabs, active_tab=0), column_shares=[1, 1]
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="elapsed"),
        auto_layout=False,
        auto_views=False,
    )


def color_of(data: RunData, trace: Trace) -> Color:
    """The colour of a run's path and total error; raw always has the same one."""
    if trace.is_raw:
        return RAW_COLOR
    return MODEL_COLORS[data.models().index(trace) % len(MODEL_COLORS)]


def _log_path(to: rr.RecordingStream, data: RunData, name: str, path: Poses, color: Color, size: float) -> None:
    """The whole path as lines, and the body that moves along it with the cursor."""
    import rerun as rr

    strips = [piece.p_wb[sparse(len(piece), MOST_IN_3D)] for piece in stretches(path)]
    lines = rr.LineStrips3D(strips, colors=[color] * len(strips), radii=rr.Radius.ui_points(PATH_RADIUS))
    to.log(_entity("world", name, "path"), lines, static=True, strict=True)
    poses = path.rows(_mask(len(path), sparse(len(path), MOST_IN_3D)))
    columns = rr.Transform3D.columns(translation=poses.p_wb, quaternion=poses.q_wb_wxyz[:, Q_XYZW])
    body = _entity("world", name, "body")
    to.send_columns(body, _time(data, poses.t_ns), columns, strict=True)
    to.log(body, rr.TransformAxes3D(axis_length=0.12 * size), static=True, strict=True)
    to.log(body, rr.Points3D([[0, 0, 0]], colors=[color], radii=rr.Radius.ui_points(4), labels=[name]), static=True)


def _log_signals(to: rr.RecordingStream, data: RunData, trace: Trace) -> None:
    """What the run reads, raw thin and faint, a model's bold; and what a model subtracted."""
    import rerun as rr

    run = trace.run
    bold = rr.SeriesLines(names=[f"{axis} {trace.name}" for axis in AXES], colors=_xyz(data, trace), widths=[BOLD_WIDTH] * 3)
    thin = rr.SeriesLines(
        names=[f"{axis} raw" for axis in AXES], colors=[_fade(c, RAW_FADE) for c in XYZ], widths=[RAW_WIDTH] * 3
    )
    style = thin if trace.is_raw and data.models() else bold
    for kind, values in (("gyro", run.imu.gyro), ("accel", run.imu.accel)):
        _log_scalars(to, _entity("imu", kind, trace.name), data, run.imu.t_ns, values, style)
    if not trace.is_raw:
        for kind, values in (("gyro", run.gyro_bias), ("accel", run.accel_bias)):
            _log_scalars(to, _entity("bias", kind, trace.name), data, run.imu.t_ns, values, bold)


def _log_errors(to: rr.RecordingStream, data: RunData, trace: Trace) -> None:
    """Orientation and position error of a run, per axis and in total."""
    import rerun as rr

    errors = trace.errors
    assert errors is not None, "asked only where there is truth"
    width = RAW_WIDTH if trace.is_raw else BOLD_WIDTH
    total = rr.SeriesLines(names=[trace.name], colors=[color_of(data, trace)], widths=[width])
    axes = rr.SeriesLines(names=[f"{a} {trace.name}" for a in AXES], colors=_xyz(data, trace), widths=[width] * 3)
    for kind, whole, parts in (
        ("orientation", errors.orientation_total_deg, errors.orientation_deg),
        ("position", errors.position_total_m, errors.position_m),
    ):
        _log_scalars(to, _entity("error", kind, trace.name, "total"), data, errors.t_ns, whole[:, None], total)
        _log_scalars(to, _entity("error", kind, trace.name, "axes"), data, errors.t_ns, parts, axes)


def _log_scalars(
    to: rr.RecordingStream,
    entity: str,
    data: RunData,
    t_ns: Times,
    values: Float64[np.ndarray, "n k"],
    style: rr.SeriesLines,
) -> None:
    """One curve per column; the style goes first, so that no curve is ever drawn in a colour of the viewer's choice."""
    import rerun as rr

    to.log(entity, style, static=True, strict=True)
    # strict: Rerun only warns of a length that does not match, and then the rows are missing.
    to.send_columns(entity, _time(data, t_ns), rr.Scalars.columns(scalars=values), strict=True)


def _time(data: RunData, t_ns: Times) -> list[rr.TimeColumn]:
    """Both clocks, exact to the nanosecond; `ros2_timestamp` is what Rerun's own MCAP reader calls header stamps."""
    import rerun as rr

    return [
        rr.TimeColumn("elapsed", duration=(t_ns - data.start_ns).astype("timedelta64[ns]")),
        rr.TimeColumn("ros2_timestamp", timestamp=t_ns.astype("datetime64[ns]")),
    ]


def _plot(
    data: RunData, origin: str, name: str, contents: str | list[str] = "$origin/**", limit: float | None = None
) -> rrb.TimeSeriesView:
    """A plot over the whole log: by default Rerun shows a minute around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    ends = [rr.TimeRangeBoundary.absolute(seconds=t) for t in (0.0, data.duration_s)]
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(link="Independent", view_range=rr.TimeRange(start=ends[0], end=ends[1])),
        axis_y=None if limit is None else rrb.ScalarAxis(range=(0.0, limit)),
        plot_legend=rrb.Corner2D.LeftTop,
    )


def _totals(data: RunData, kind: str) -> list[str]:
    """The entities of the total errors."""
    return [_entity("error", kind, trace.name, "total") for trace in data.traces if trace.errors is not None]


def _limit(data: RunData, kind: str) -> float | None:
    """How high an error plot reaches: a raw error that would make the models' flat lines leaves the plot."""
    tops = {}
    for trace in data.traces:
        if trace.errors is not None:
            total = trace.errors.orientation_total_deg if kind == "orientation" else trace.errors.position_total_m
            tops[trace.name] = float(np.nanmax(total))
    models = [tops[trace.name] for trace in data.models() if trace.name in tops]
    highest = max(tops.values(), default=0.0)
    cut = bool(models) and highest > READABLE * max(models) > 0.0
    limit = READABLE / 2.0 * max(models) if cut else highest
    return 1.05 * limit if limit > 0.0 else None


def _eye(data: RunData) -> rrb.EyeControls3D:
    """A look at the truth (without it, at everything) from above one corner: raw paths often leave for kilometres."""
    import rerun.blueprint as rrb

    low, high = _box(data)
    centre, size = (low + high) / 2.0, _size(data)
    return rrb.EyeControls3D(position=centre + size * np.array([-0.6, -0.6, 0.4]), look_target=centre, eye_up=[0.0, 0.0, 1.0])


def _box(data: RunData) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """The corners of what matters in 3D."""
    shown = [data.truth] if data.truth is not None else [trace.path for trace in data.traces]
    points = np.concatenate([poses.p_wb for poses in shown])
    return points.min(axis=0), points.max(axis=0)


def _size(data: RunData) -> float:
    """The diagonal of what matters in 3D, at least a metre."""
    low, high = _box(data)
    return max(float(np.linalg.norm(high - low)), 1.0)


def _xyz(data: RunData, trace: Trace) -> list[Color]:
    """Red, green and blue; each further model a little greyer, so that several can be told apart in one plot."""
    rank = 0 if trace.is_raw else data.models().index(trace)
    return [_fade(color, min(NEXT_MODEL_FADE * rank, 0.75)) for color in XYZ]


def _fade(color: Color, share: float) -> Color:
    """A colour moved towards grey: faint on a dark and on a light ground alike, which transparency is not."""
    red, green, blue = (round(c + share * (g - c)) for c, g in zip(color, GREY, strict=True))
    return red, green, blue


def _report(data: RunData) -> str:
    """The notes and the table of figures as Markdown."""
    lines = [f"# {data.name}", "", f"{data.duration_s:.1f} s.", "", *data.notes, ""]
    table = data.table()
    if table:
        names = [trace.name for trace in data.traces]
        lines += ["| figure | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
        for label, values in table:
            lines.append(f"| {label} | " + " | ".join("" if v is None else _number(v) for v in values) + " |")
    return "\n".join(lines)


def _number(value: float) -> str:
    """Four digits are enough to compare; no exponent for what has more."""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _entity(*parts: str) -> str:
    """An entity path of which every part may hold any character."""
    import rerun as rr

    return str(rr.new_entity_path(list(parts)))


def _mask(count: int, rows: Int64[np.ndarray, " m"]) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[rows] = True
    return mask


def _stream(data: RunData) -> rr.RecordingStream:
    """A recording of its own, in an application of its own: Rerun keeps one layout per application."""
    _sdk()
    import rerun as rr

    plain = re.sub(r"[^A-Za-z0-9_-]", "_", data.name)[:100]
    return rr.RecordingStream(f"imutool {plain}", recording_id=f"{plain}-{uuid.uuid4().hex[:8]}")


def _sdk() -> None:
    """Nothing, if Rerun is there.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"the viewer is not installed ({error})", where="view", fix="Install it with: pip install 'imutool[view]'"
        ) from error


def _save(logs: Sequence[RunData], save: Path | None, overwrite: bool) -> str:
    """Saves one file, or a file per log in a folder, and says how to open them."""
    names = [re.sub(r"[^\w.-]", "_", data.name) + ".rrd" for data in logs]
    if len(logs) > 1:
        folder = save or Path()
        if folder.suffix == ".rrd" or folder.is_file():
            raise ConfigError(f"{len(logs)} logs do not fit one .rrd", where=folder, expected="a folder")
        targets = [folder / name for name in names]
    elif save is not None and save.is_dir():
        targets = [save / names[0]]
    else:
        targets = [save or Path(names[0])]
    if len(set(targets)) < len(targets):
        raise ConfigError("two logs have the same name", where=save or Path(), expected="names of their own")
    if len(logs) > 1:
        _make(targets[0].parent)
    with ExitStack() as stack:  # every target is refused before the first is written, and none is left alone
        opened = [stack.enter_context(Target(target, overwrite=overwrite)) for target in targets]
        for data, target in zip(logs, opened, strict=True):
            target.write(rrd(data))
    listed = " ".join(str(target) for target in targets)
    return f"Saved {listed}. Open with: rerun {listed}"


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"the folder cannot be made ({error.strerror})", where=folder) from error


def _open(logs: Sequence[RunData]) -> str:
    """Opens a viewer of our own and sends the logs; an empty string, or what went wrong."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    arguments = ["--bind", "127.0.0.1", "--port", str(port), "--memory-limit", MEMORY_LIMIT, "--hide-welcome-screen"]
    quiet: Mapping[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    try:
        viewer = subprocess.Popen([str(_binary()), *arguments], **quiet, start_new_session=True)
    except OSError as error:
        return f"The viewer cannot be started ({error.strerror})."
    VIEWERS.append(viewer)
    if not _answers(viewer, port):
        if viewer.poll() is None:
            viewer.terminate()
            return f"The viewer did not answer within {VIEWER_STARTS_S:g} s."
        return f"The viewer stopped at once (exit code {viewer.returncode})."
    for data in logs:
        recording = _stream(data)
        recording.connect_grpc(f"rerun+http://127.0.0.1:{port}/proxy", default_blueprint=blueprint(data))
        log(data, recording)
        try:
            recording.flush(timeout_sec=FLUSH_S)
        except (RuntimeError, ValueError) as error:
            return f"The viewer stopped listening ({error})."
        recording.disconnect()
    return ""


def _answers(viewer: subprocess.Popen[bytes], port: int) -> bool:
    """Whether the viewer listens before it dies or the time is up."""
    end = time.monotonic() + VIEWER_STARTS_S
    while time.monotonic() < end and viewer.poll() is None:
        with socket.socket() as probe:
            probe.settimeout(0.2)
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.05)
    return False


def _binary() -> Path:
    """The viewer itself: its Python wrapper needs a PATH, and outlives nothing it starts."""
    spec = importlib.util.find_spec("rerun_cli")  # comes with rerun-sdk
    folders = list(spec.submodule_search_locations or ()) if spec else [""]
    return Path(folders[0]) / ("rerun.exe" if sys.platform == "win32" else "rerun")
