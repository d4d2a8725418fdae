"""`imutool demo` on a made-up recording: logs, a model, a debiased log and its figures."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from imutool.cli.app import COMMON, Common, Written, app
from imutool.cli.evaluate import Score
from imutool.cli.terminal import epoch_line, err, figures, say
from imutool.errors import ConfigError, not_installed
from imutool.report import Report

if TYPE_CHECKING:
    from imutool.recording import Recording
    from imutool.training.fit import Epoch

FOLDER = Written(files=("*",), keeps=True)

TRAINING_SEEDS = (1, 2, 3, 4)  # four flights of one sensor, each with a turn-on bias of its own
TEST_SEED = 5
STEPS = 10  # of each stage: as good as 30 on flights of one minute


class DemoReport(Report, frozen=True, tag="imutool.demo/1"):
    """Report of `imutool demo`: scores of `imutool evaluate`, and the files written."""

    results: list[Score]
    log: str
    debiased: str
    model: str
    rrd: str
    png: str
    report: str


@app.command(epilog="Example: [bold]imutool demo -o demo-out[/]")
def demo(
    folder: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder."), FOLDER] = Path("demo-out"),
    common: Common = COMMON,
) -> None:
    """Run a demo without download: convert, train, debias, evaluate, view.

    The recording is made up.
    """

    def announce(line: str) -> None:
        if not common.quiet:
            say(line, to=err)

    with common.progress("Training") as tell:
        done = run(folder, announce, overwrite=common.overwrite, progress=lambda epoch: tell(*epoch_line(epoch)))
    if not common.write(done):
        say("Pure integration of a flight the model has not seen, from its true start:")
        figures(msgspec.to_builtins(done.results))
        say(f"Report: {done.report}. Error curves: {done.png}. In the viewer: rerun {done.rrd}")


def run(
    out: Path,
    say: Callable[[str], None],
    *,
    overwrite: bool = False,
    progress: Callable[[Epoch], None] | None = None,
) -> DemoReport:
    """Run every step in the folder `out`, and report each.

    Raises:
        ConfigError: the folder holds an earlier demo, or the extras train, view and report are not installed.
    """
    _check(out, overwrite)  # before the packages of the work are loaded
    from imutool.api.logs import convert
    from imutool.debiasing import debias
    from imutool.evaluation import evaluate
    from imutool.training.run import train
    from imutool.training.settings import TrainSettings
    from imutool.viewing.html import report
    from imutool.viewing.model.load_view import load
    from imutool.viewing.rerun import scene

    raw, logs = out / "raw", out / "logs"
    names = [f"flight_{number}" for number in (*TRAINING_SEEDS, TEST_SEED)]
    log, model, debiased = logs / f"{names[-1]}.mcap", out / "model.safetensors", out / "debiased.mcap"
    rrd, page = out / "demo.rrd", out / "report.html"
    say(f"1. Making up {len(names)} flights, as raw files of the EuRoC layout: {raw}")
    for number, name in zip((*TRAINING_SEEDS, TEST_SEED), names, strict=True):
        write_asl(made_up(number), raw / name)
    say(f"2. Converting them to MCAP: {logs}")
    convert(raw, logs, format="euroc", sequences=names, overwrite=overwrite)
    say(f"3. Training the neural ODE on {len(TRAINING_SEEDS)} of them: {model}")
    training = [logs / f"{name}.mcap" for name in names[:-1]]
    settings = TrainSettings(steps=STEPS)
    try:
        train(training, model, method="neural_ode", settings=settings, overwrite=overwrite, progress=progress)
    except (KeyboardInterrupt, SystemExit) as end:
        end.__notes__ = []  # they advise `resume`, which the demo has not
        raise
    say(f"4. Debiasing the one it has not seen, without its truth: {debiased}")
    debias(log, debiased, model=model, overwrite=overwrite)
    say("5. Measuring against the truth, drawing")
    results = msgspec.convert(evaluate(log, models=["static", model]), list[Score])
    data = load(log, models=["static", model])
    scene.save([data], rrd, overwrite=overwrite)
    pictures = report.write_pngs(data, out / "pictures", overwrite=overwrite)
    report.write_page([data], page, overwrite=overwrite)
    png = next(path for path in pictures if path.stem.endswith("-errors"))
    return DemoReport(results, *map(str, (log, debiased, model, rrd, png, page)))


def made_up(seed: int) -> Recording:
    """Made-up flight of one minute; `seed` sets motion, turn-on bias and drift."""
    from imutool.sensor.made_up_flight import ACCEL, GYRO, FlightSettings, flight

    # A consumer's sensor: a factor of two per cent and a degree of misalignment outweigh what its bias drifts in a minute.
    sensor = FlightSettings(
        gyro=msgspec.structs.replace(GYRO, scale=0.02, misalignment_rad=0.015, warm_up=0.001),
        accel=msgspec.structs.replace(ACCEL, scale=0.02, misalignment_rad=0.015, warm_up=0.005),
    )
    return flight(seed, sensor)


def _check(out: Path, overwrite: bool) -> None:
    """Check everything that would stop the demo half-way."""
    for module in ("torch", "rerun", "matplotlib"):
        if importlib.util.find_spec(module) is None:
            raise not_installed(module, "train,view,report", where="demo")
    if out.exists() and not out.is_dir():
        raise ConfigError("is a file", where=out, expected="a folder")
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise ConfigError("is not empty", where=out, fix="Choose another `out`, or add `overwrite`")


def write_asl(recording: Recording, folder: Path) -> None:
    """Write a recording as an ASL sequence folder, with numbers exact to the last bit.

    The folder has mav0/imu0 and mav0/state_groundtruth_estimate0.
    """
    import numpy as np

    from imutool.exporting.euroc import IMU_COLUMNS, TRUTH_COLUMNS, TRUTH_FOLDER, rows
    from imutool.mcap_io.storage.target import Target

    imu, truth = recording.imu, recording.truth
    assert truth.v_w is not None
    tables = (
        ("imu0", IMU_COLUMNS, imu.t_ns, [imu.gyro, imu.accel]),
        (TRUTH_FOLDER, TRUTH_COLUMNS[:11], truth.t_ns, [truth.p_wb, truth.q_wb_wxyz, truth.v_w]),  # without biases
    )
    for name, columns, t_ns, values in tables:
        path = folder / "mav0" / name / "data.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = rows(t_ns.tolist(), np.concatenate(values, axis=1).tolist())
        with Target(path, overwrite=True) as table:
            table.write(f"#{','.join(columns)}\n{''.join(lines)}".encode("ascii"))
