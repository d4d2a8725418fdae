"""Show logs: in the Rerun viewer, in a browser, in a notebook, as a page, or live."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from imutool.api import Init, checked, init_text
from imutool.array_types import Float64
from imutool.debiasing import DebiasedBlock
from imutool.errors import ConfigError, DataError, did_you_mean
from imutool.file_location import LogPath, local, location, several
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.storage import output_conflicts
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs
from imutool.recording import Imu
from imutool.viewing import Output, notebook
from imutool.viewing.model.load_view import load
from imutool.viewing.model.run_data import RunData
from imutool.viewing.model.trajectory_error import alignment
from imutool.viewing.outputs import Outputs, RequestedOutputs
from imutool.viewing.rerun import live


@checked
def load_run(
    log: LogPath,
    *,
    models: Sequence[str | Path] | str | Path = (),
    init: Init = "auto",
    smooth: bool = False,
    imu: str | None = None,
    truth: str | None = None,
    align: str = "none",
    findings: str | Path | None = None,
    aid: str | None = None,
) -> RunData:
    """Traces, errors, figures and events of one log, as `view` shows them.

    Args:
        log: MCAP log: a file or a URL.
        models: Models to apply: files, names of models that ship, or `static`.
        init: Initial bias, as in `debias`.
        smooth: Smoothing, as in `debias`.
        imu: IMU topic; needed where the log has several.
        truth: Topic of the true poses; by default the first.
        align: Alignment of each path with the truth: `none`, `origin`, `yaw` or `se3`.
        findings: Folder of a diagnosis, whose findings become events.
        aid: Aids for a smoothed path of each model, as in `evaluate`.

    Returns:
        `traces` (of `raw`, each model and each aided path), each with `run`, `path`, `errors` and `windows`; `events`; and
        `table()`.

    Raises:
        ConfigError: A file cannot be read, or options contradict each other.
        LogError: No IMU, or no part of the log is sound.
        ModelError: A model that cannot be read, or for another rate.

    Examples:
        >>> import imutool
        >>> run = imutool.load_run("flight_2.mcap", models=["linear.safetensors"])
        >>> [trace.name for trace in run.traces]
        ['raw', 'linear']
        >>> run.traces[1].errors.orientation_total_deg.shape == run.traces[1].errors.t_ns.shape
        True
    """
    return load(
        location(log),
        models=several(models),
        init=init_text(init),
        smooth=smooth,
        imu=imu,
        truth=truth,
        align=alignment(align),
        findings=None if findings is None else local(findings, "findings"),
        aid=aid,
    )


@checked
def view(
    logs: LogPath | RunData | Iterable[LogPath | RunData],
    *,
    at: float | str | None = None,
    source: bool = True,
    save: str | Path | None = None,
    connect: str | None = None,
    web: bool = False,
    port: int | None = None,
    export_web: str | Path | None = None,
    png: str | Path | None = None,
    html: str | Path | None = None,
    overwrite: bool = False,
    **options: Any,
) -> list[Output]:
    """Show truth, raw and debiased: in a viewer, in a browser, or as files.

    Without `save`, `connect`, `web`, `export_web`, `png` and `html`, a viewer opens. Where no window can open, the function
    saves an .rrd file.

    Args:
        logs: Logs (files or URLs), or runs from `load_run`.
        at: Position of the cursor: seconds from the first sample, or `worst`, the largest orientation error of a model.
        source: Also show the other topics of the log, for example cameras.
        save: .rrd file for the Rerun viewer.
        connect: Address of a running viewer, `HOST:PORT`.
        web: Serve to a browser on this machine, until Ctrl-C.
        port: Port for `web`; by default a free one.
        export_web: Folder that any web server can serve.
        png: Folder for pictures.
        html: Page in one file.
        overwrite: Replace existing files.
        **options: Options of `load_run`: `models`, `init`, `smooth`, `imu`, `truth`, `align`, `findings`, `aid`.

    Returns:
        One entry per output: `how`, `place`, and a sentence, `said`.

    Raises:
        ConfigError: Contradictory options, a file that exists, no viewer at `connect`, or Rerun is not installed.
        DataError: `at` is outside the log.

    Examples:
        >>> import imutool
        >>> (page,) = imutool.view("flight_2.mcap", models=["linear.safetensors"], html="flight_2.html")
        >>> page.how, page.place, page.said
        ('html', 'flight_2.html', 'Wrote flight_2.html. Open it in a browser')
    """
    given: list[Any] = several(logs)
    _check_options(options, given)
    paths = [None if path is None else Path(path) for path in (save, export_web, png, html)]
    cursor = None if at is None else str(at)
    check_outputs(_outputs(*paths), [path for path in given if not isinstance(path, RunData)], overwrite=overwrite)
    asked = RequestedOutputs(paths[0], connect, web, port, paths[1], paths[2], paths[3], cursor, source, overwrite)
    with Outputs(asked) as views:
        shown = views.show([log if isinstance(log, RunData) else load_run(log, **options) for log in given])
        if views.refused is not None:
            raise views.refused
        views.serve()
    return shown


def _check_options(options: Mapping[str, Any], logs: Sequence[object]) -> None:
    """Refuse options that `load_run` does not take, and options for runs that are loaded already."""
    known = list(inspect.signature(load_run).parameters)[1:]
    for name in options:
        if name not in known:
            raise TypeError(f"view() got an unexpected keyword argument {name!r}. {did_you_mean(name, known, '{!r}')}".rstrip())
    if options and any(isinstance(log, RunData) for log in logs):
        raise ConfigError("a run is loaded already", where=", ".join(options), fix="Give these to `load_run`")


def _outputs(save: Path | None, export_web: Path | None, png: Path | None, html: Path | None) -> list[OutputFile]:
    return [
        OutputFile("save", save, output_conflicts.RRD, may_be_folder=True),
        OutputFile("export_web", export_web, files=("*",), keeps=True),
        OutputFile("png", png, files=("*.png",), keeps=True, of_each="{}-*.png"),
        OutputFile("html", html, output_conflicts.HTML),
    ]


def notebook_viewer(runs: RunData | Sequence[RunData]) -> Any:
    """Rerun viewer as a notebook widget; it needs no network.

    Args:
        runs: Runs from `load_run`.

    Raises:
        ConfigError: The extra `notebook` is not installed, or `runs` are no runs.

    Examples:
        >>> import imutool
        >>> imutool.notebook_viewer(imutool.load_run("flight_2.mcap"))  # doctest: +SKIP
    """
    return notebook.show(_loaded(runs))


def notebook_page(runs: RunData | Sequence[RunData]) -> notebook.Page:
    """Report as a notebook cell; a saved notebook shows it too.

    Args:
        runs: Runs from `load_run`.

    Raises:
        ConfigError: matplotlib is not installed, or `runs` are no runs.

    Examples:
        >>> import imutool
        >>> page = imutool.notebook_page(imutool.load_run("flight_2.mcap"))
        >>> "<svg" in page.content
        True
    """
    return notebook.page(_loaded(runs))


def _loaded(runs: object) -> list[RunData]:
    """Runs of a notebook cell; ConfigError of others, such as a path."""
    given = several(runs)
    if wrong := [type(run).__name__ for run in given if not isinstance(run, RunData)]:
        raise ConfigError(f"is of type {wrong[0]}", where="runs", expected="runs of `imutool.load_run`")
    return given


class LiveView:
    """Live view of one IMU; `watch` opens it.

    Attributes:
        outputs: Where the samples were shown, one entry per output with a sentence, `said`; complete at the end.
    """

    def __init__(self, topic: str, show: live.Live) -> None:
        self._topic, self._show, self._count = topic, show, 0

    def add(self, imu: Imu, bias: Float64[np.ndarray, "n 6"], std: Float64[np.ndarray, "n 6"]) -> None:
        """Show a batch of samples as they were debiased.

        Args:
            imu: Raw samples.
            bias: Subtracted bias at each sample: gyro (rad/s), then accel (m/s²).
            std: One standard deviation of `bias`.

        Raises:
            DataError: `imu` is no `Imu`, or `bias` or `std` has not one row of six for each sample.
        """
        given: object = imu
        if not isinstance(given, Imu):
            raise DataError(f"is of type {type(given).__name__}", where="LiveView.add", expected="samples as an `Imu`")
        if not np.shape(bias) == np.shape(std) == (len(imu), 6):
            what = f"bias and std of shape {list(np.shape(bias))}, {list(np.shape(std))}"
            raise DataError(what, where="LiveView.add", expected=f"[{len(imu)}, 6], a row for each sample")
        sequence = np.arange(self._count, self._count + len(imu), dtype=np.uint32)
        self._count += len(imu)
        batch = ImuBatch(imu.t_ns, imu.t_ns, sequence, imu.t_ns, imu.gyro, imu.accel, "imu")
        self._show(DebiasedBlock(self._topic, batch, bias, std))

    @property
    def outputs(self) -> list[Output]:
        """Viewers and files that showed the samples."""
        return self._show.shown


@checked
@contextmanager
def watch(
    name: str, *, topic: str = "/imu0", connect: str | None = None, save: str | Path | None = None, overwrite: bool = False
) -> Iterator[LiveView]:
    """Show a sensor while it measures: a context manager that gives a `LiveView`.

    Without `connect` and `save` a viewer opens. Where no window can open, the view goes to the file `NAME.rrd`. An error or
    Ctrl-C in the context ends the view as well; the file then holds what was shown until then.

    Args:
        name: Name of the recording in the viewer.
        topic: Name of the IMU.
        connect: Address of a running viewer, `HOST:PORT`.
        save: .rrd file to write.
        overwrite: Replace an existing file.

    Raises:
        ConfigError: Rerun is not installed, no viewer at `connect`, or the file exists.

    Examples:
        >>> import imutool
        >>> import numpy as np
        >>> imu = imutool.example_recording(duration_s=2.0).imu
        >>> with imutool.watch("live", save="live.rrd") as live:
        ...     live.add(imu, np.zeros((len(imu), 6)), np.ones((len(imu), 6)))
        >>> len(live.outputs)
        1
    """
    file, instead = None if save is None else Path(save), Path(f"{name}.rrd")
    check_outputs([OutputFile("save", file, output_conflicts.RRD)], overwrite=overwrite)
    context = ExitStack()
    show = context.enter_context(live.live_view(name, connect_to=connect, save=file, instead=instead, overwrite=overwrite))
    try:
        yield LiveView(topic, show)
    finally:
        context.close()  # as at its usual end: what was shown is saved
