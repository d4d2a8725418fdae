"""`imutool diagnose` from logs to a folder: what it holds, what it says, and that its physics brings a simulation closer."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from support import diagnoses
from support.diagnoses import replace
from support.report_schema import assert_valid
from typer.testing import CliRunner, Result

import imutool
from imutool import diagnosis_output
from imutool.cli import load
from imutool.diagnosis.closed_loop import CLOSED_LOG
from imutool.diagnosis.estimation import unnamed_effects as unnamed
from imutool.diagnosis.estimation.jacobians import SplineBasis
from imutool.diagnosis.result import Curve, Diagnosis, Estimate, Finding, HeldOut
from imutool.diagnosis.to_sensor_files import to_physics_file
from imutool.diagnosis.wording.conclusion import conclusion
from imutool.diagnosis_output import FILES
from imutool.errors import ConfigError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.processes import forked
from imutool.report import json_values
from imutool.sensor import physics_file
from imutool.sensor.made_up_flight import flight
from imutool.sensor.physics_file import Bias, Entry, PhysicsFile, Value
from imutool.sensor.samples import IdealMotion
from imutool.sensor.simulate import simulate
from imutool.units import AXES

ARM_M = np.array([0.2, -0.1, 0.05])
GYRO_BIAS, ACCEL_BIAS = (0.01, -0.02, 0.005), (0.1, 0.05, -0.08)
WHITE = "gyro_density = [2e-4, 2e-4, 2e-4]\naccel_density = [2e-3, 2e-3, 2e-3]\n"
RATE_HZ, SECONDS, NULL_SECONDS = 100.0, 30.0, 15.0
SIGMAS = 5.0  # of the planted arm, from what is stated
BIAS_TOLERANCE = np.array([1e-3] * 3 + [1e-2] * 3)  # rad/s, m/s²: thirty seconds of the noise above, and what an arm hides
EXACT = 1e-9  # of two ways to the same curve, between whose points both are straight
Done = subprocess.CompletedProcess[str]
Command = Callable[..., Done]
HELD = HeldOut(0.02, 0.01, "rad/s", 9.0)


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(load(), [*map(str, words)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """trajectory.mcap, along it arm.mcap (a lever arm, a bias); null.mcap (a bias) along a short one, other.mcap another."""
    place = tmp_path_factory.mktemp("diagnose")
    (place / "white.toml").write_text(WHITE)
    bias = Bias(gyro=GYRO_BIAS, accel=ACCEL_BIAS)
    arm = {axis: Value(value=r, unit="m") for axis, r in zip("xyz", ARM_M.tolist(), strict=True)}
    physics_file.write(PhysicsFile(effect=(Entry(name="lever_arm", parameters=arm),), bias=bias), place / "arm.toml")
    physics_file.write(PhysicsFile(bias=bias), place / "null.toml")
    for name, seed, duration_s in (("trajectory", 5, SECONDS), ("short", 5, NULL_SECONDS), ("another", 6, SECONDS)):
        write(flight(seed, duration_s=duration_s), place / f"{name}.mcap")
    for name, trajectory, seed in (("arm", "trajectory", 2), ("null", "short", 3), ("other", "another", 4)):
        physics = place / ("arm.toml" if name == "arm" else "null.toml")
        path = place / f"{trajectory}.mcap"
        simulate(path, place / f"{name}.mcap", physics=physics, noise=place / "white.toml", rate_hz=RATE_HZ, seed=seed)
    simulate(place / "trajectory.mcap", place / "ideal.mcap", rate_hz=RATE_HZ)
    return place


@pytest.fixture(scope="module")
def diagnosed(folder: Path, imutool: Command) -> tuple[Path, Done]:
    """The folder that the command wrote about the lever arm, with a process next to it, and what it said."""
    (folder / "bytes.py").write_text("import pathlib, sys\nprint(len(pathlib.Path(sys.argv[2]).read_bytes()))\n")
    closed = ("--close", "--metric", folder / "bytes.py", "--sim", folder / "ideal.mcap")
    words = ("-o", folder / "diagnosis", "--json", folder / "said.json", *closed)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(forked, "processors", lambda: 2)
        said = imutool("diagnose", folder / "arm.mcap", *words, cwd=folder)
    assert said.returncode == 0, said.stderr
    return folder / "diagnosis", said


def test_the_planted_lever_arm_is_found_and_written(diagnosed: tuple[Path, Done]) -> None:
    place, _ = diagnosed
    assert sorted(path.name for path in place.iterdir()) == sorted(
        [*diagnosis_output.FILES, diagnosis_output.CLOSED, CLOSED_LOG]
    )
    assert f'href="{diagnosis_output.LOG}"' in (place / diagnosis_output.REPORT).read_text()
    closed = (place / diagnosis_output.CLOSED).read_text()
    assert "Before and after" in closed
    assert closed.count("<figure") >= 3  # error over time, spectrum, integrated path
    page = (place / diagnosis_output.LOG).read_text()
    assert "lever_arm" in page  # its finding, where it acts
    assert ".partial" not in page
    told = json.loads((place / "findings.json").read_text())
    assert_valid(told)
    assert told["schema"] == "imutool.diagnosis/1"
    assert told["mismatch"]
    assert [one["effect"] for one in told["findings"]] == ["lever_arm"]
    assert json.loads((place.parent / "said.json").read_text()) == told
    (entry,) = physics_file.read(place / "physics.toml").effect
    for axis, r in zip("xyz", ARM_M, strict=True):
        value = entry.parameters[axis]
        assert value.std is not None
        assert abs(value.value - r) < SIGMAS * value.std
        assert value.value == told["findings"][0]["parameters"][axis]["value"]
    bias = physics_file.read(place / "physics.toml").bias
    assert bias is not None
    assert np.all(np.abs(np.array([*bias.gyro, *bias.accel]) - [*GYRO_BIAS, *ACCEL_BIAS]) < BIAS_TOLERANCE)
    assert "lever_arm" in (place / "report.html").read_text()
    assert (place / "view.rrd").read_bytes()[:4] == b"RRF2"


def test_the_closed_loop_misses_nothing_and_compares_before_and_after(diagnosed: tuple[Path, Done]) -> None:
    place, _ = diagnosed
    closed = json.loads((place / "findings.json").read_text())["closed"]
    assert not closed["mismatch"]
    figures = {one["figure"]: (one["before"], one["after"]) for one in closed["compared"]}
    for name in ("accel rms", "accel rms, 1 to 5 Hz", "accel rms, quarter 4", "path over 5 s"):
        assert figures[name][1] < 0.3 * figures[name][0]
    assert figures["metric"][1] == (place / CLOSED_LOG).stat().st_size
    assert "Nothing but a constant bias" in (place / diagnosis_output.CLOSED).read_text()


def test_what_the_loop_still_misses_begins_another_search(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first search overlooks the arm here; the second begins with it, and the folder holds its answer."""
    begins: list[list[str]] = []
    searched = diagnosis_output.diagnose_logs

    def overlooked(*words: Any, begin: Sequence[Finding] = (), **more: Any) -> Diagnosis:
        begins.append([finding.effect for finding in begin])
        found = searched(*words, begin=begin, **more)
        return replace(found, findings=(), located=()) if len(begins) == 1 else found

    monkeypatch.setattr(diagnosis_output, "diagnose_logs", overlooked)
    said = run("diagnose", folder / "arm.mcap", "--sim", folder / "ideal.mcap", "--close", "-o", tmp_path / "out")
    assert said.exit_code == 0, said.output
    told = json.loads((tmp_path / "out" / "findings.json").read_text())
    assert [one["effect"] for one in told["findings"]] == ["lever_arm"]
    assert (told["closed"]["mismatch"], told["closed"]["rounds"]) == (False, 2)
    assert begins == [[], [], ["lever_arm"], []]
    assert [entry.name for entry in physics_file.read(tmp_path / "out" / "physics.toml").effect] == ["lever_arm"]
    assert "nothing is missing, after 2 rounds" in said.output


def test_a_loop_closes_in_python_with_a_figure_of_ones_own(folder: Path, tmp_path: Path) -> None:
    """Its own log is refused as an input before the work."""
    place, metric = tmp_path / "out", lambda log: float(log.stat().st_size)
    told = imutool.diagnose(folder / "null.mcap", folder / "ideal.mcap", output=place, close=True, metric=metric)
    assert told.closed is not None
    assert not told.closed.mismatch
    figures = {one.figure: (one.before, one.after) for one in told.closed.compared}
    assert figures["metric"] == (metric(folder / "ideal.mcap"), metric(place / CLOSED_LOG))
    assert json.loads((place / "findings.json").read_text())["closed"]["mismatch"] is False
    before = (place / CLOSED_LOG).read_bytes()
    for output in (place, None):
        with pytest.raises(ConfigError, match="close"):
            imutool.diagnose(folder / "null.mcap", place / CLOSED_LOG, output=output, close=True, overwrite=True)
    assert (place / CLOSED_LOG).read_bytes() == before


@pytest.mark.parametrize("fails_for", ["ideal", "closed"])
def test_a_metric_that_fails_costs_no_diagnosis(folder: Path, tmp_path: Path, fails_for: str) -> None:
    """With the given simulation it fails before the search; with the one that closes the loop, the answer stays."""
    script, place = tmp_path / "figure.py", tmp_path / "out"
    script.write_text(f"import sys\nprint('no figure' if '{fails_for}' in sys.argv[2] else 0.5)\n")
    closed = ("--close", "--metric", script, "-o", place)
    said = run("diagnose", folder / "null.mcap", "--sim", folder / "ideal.mcap", *closed)
    if fails_for == "ideal":
        assert said.exit_code == ConfigError.exit_code
        assert "printed no number for ideal.mcap: no figure" in said.stderr
        assert not place.exists()
        return
    assert said.exit_code == 0, said.output
    assert "Nothing but a constant bias" in said.stdout
    assert "The metric is not compared: " in said.stdout
    assert "printed no number for closed.mcap: no figure" in said.stdout
    told = json.loads((place / "findings.json").read_text())
    assert not told["closed"]["mismatch"]
    assert "metric" not in [one["figure"] for one in told["closed"]["compared"]]


def test_the_conclusion_comes_first(diagnosed: tuple[Path, Done]) -> None:
    place, said = diagnosed
    lines = said.stdout.splitlines()
    assert lines[0].startswith("The accel differs")
    assert "(lever_arm)" in lines[0]
    assert (
        lines[-1]
        == f"{place}: findings.json, physics.toml, noise.toml, report.html, log.html, view.rrd, closed.html, closed.mcap"
    )
    (closer,) = [line for line in lines if "imulated again with everything that was found" in line]
    assert "accel rms" in closer
    assert "% of the misfit removed" in closer


def test_nothing_is_found_where_nothing_was_left_out(folder: Path, imutool: Command) -> None:
    said = imutool("diagnose", folder / "null.mcap", "--json", "-", cwd=folder)
    assert said.returncode == 0, said.stderr
    told = json.loads(said.stdout)  # the JSON, and nothing next to it
    assert not told["mismatch"]
    assert told["findings"] == []
    assert told["located"] == []


def test_a_diagnosis_stays_where_one_is(diagnosed: tuple[Path, Done]) -> None:
    place, _ = diagnosed
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    said = run("diagnose", place.parent / "arm.mcap", "-o", place)
    assert said.exit_code == ConfigError.exit_code
    assert "the target exists" in said.stderr
    assert {path.name: path.read_bytes() for path in place.iterdir()} == before


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["untrue.mcap", "--sim", "another.mcap"], 4, "turn differently"),
        (["arm.mcap", "--imu", "/imu7"], 5, "/imu7"),
        (["arm.mcap", "--truth", "/nowhere"], 5, "/nowhere"),
        (["untrue.mcap"], 4, "no simulation and no true poses"),
        (["nosuch.mcap"], 3, "nosuch.mcap"),
        (["arm.mcap", "-o", "white.toml"], 3, "is a file"),
        (["arm.mcap", "--metric", "white.toml"], 3, "--metric compares two simulations"),
        (["arm.mcap", "--sim", "ideal.mcap", "--close", "-o", "out", "--metric", "nosuch.py"], 3, "nosuch.py: no such script"),
    ],
)
def test_what_cannot_be_diagnosed_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, says: str
) -> None:
    monkeypatch.chdir(folder)
    if words[0] == "untrue.mcap":
        write(replace(read(folder / "arm.mcap"), truths={}), folder / "untrue.mcap", overwrite=True)
    before = sorted(folder.iterdir())
    said = run("diagnose", *words)
    assert said.exit_code == code, said.output
    assert says in said.stderr
    assert said.stdout == ""
    assert sorted(folder.iterdir()) == before


def test_a_loop_without_an_imu_is_refused_before_the_search(folder: Path, tmp_path: Path) -> None:
    with (tmp_path / "wheel.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "another tool")
        writer.finish()
    said = run("diagnose", folder / "arm.mcap", "--sim", tmp_path / "wheel.mcap", "--close", "-o", tmp_path / "out")
    assert said.exit_code == ConfigError.exit_code
    assert "--close simulates an IMU, and the log has none" in said.stderr
    assert not (tmp_path / "out").exists()


# ── the folder, of made-up diagnoses ──


def test_a_setting_reaches_the_search(folder: Path, tmp_path: Path) -> None:
    """At a false discovery rate that no gain reaches, a planted lever arm is not found."""
    config = tmp_path / "settings.toml"
    config.write_text("[search]\nrounds = 1\n")
    words = ("diagnose", folder / "arm.mcap", "--config", config, "--json", "-")
    done = run(*words, "--set", "search.false_discovery_rate=1e-300", "--quiet")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["findings"] == []


def test_a_setting_reaches_the_alignment(folder: Path) -> None:
    done = run("diagnose", folder / "arm.mcap", "--set", "alignment.min_s=1000", "--quiet")
    assert done.exit_code == 0, done.output
    assert "no stretch of 1000 s" in done.stdout


@pytest.mark.parametrize("word", ["search.false_discovery=1e-3", "search.false_discovery_rate=2", "band.sigma=none"])
def test_a_wrong_setting_is_refused(folder: Path, word: str) -> None:
    done = run("diagnose", folder / "arm.mcap", "--set", word)
    assert done.exit_code == ConfigError.exit_code
    assert word.partition("=")[0].rpartition(".")[2] in done.stderr


def test_other_files_in_the_folder_stay(tmp_path: Path) -> None:
    (tmp_path / "real.mcap").write_bytes(b"mine")
    assert diagnosis_output.write(diagnoses.NOTHING, tmp_path) == []
    (tmp_path / diagnosis_output.CLOSED).touch()  # of the diagnosis that is replaced: it goes as well
    assert diagnosis_output.write(diagnoses.ARM, tmp_path, overwrite=True) == []
    assert (tmp_path / "real.mcap").read_bytes() == b"mine"
    without_logs = {*diagnosis_output.FILES, "real.mcap"} - {diagnosis_output.LOG}
    assert {path.name for path in tmp_path.iterdir()} == without_logs
    assert json.loads((tmp_path / "findings.json").read_text()) == json_values(diagnoses.ARM.report)


def test_a_page_of_somebody_else_stays(tmp_path: Path) -> None:
    """It was removed, as if it were of a diagnosis that is replaced."""
    (tmp_path / diagnosis_output.CLOSED).write_text("mine")
    with pytest.raises(ConfigError, match=r"holds a diagnosis already \(closed\.html\)"):
        diagnosis_output.write(diagnoses.NOTHING, tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(diagnosis_output.CLOSED, "mine")]


def test_an_absent_extra_costs_its_file_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    diagnosis_output.write(diagnoses.ARM, tmp_path / "out")
    monkeypatch.setitem(sys.modules, "rerun", None)
    (remark,) = diagnosis_output.write(diagnoses.NOTHING, tmp_path / "out", overwrite=True)
    assert remark == "view.rrd is left out: rerun is not installed (pip install 'imutool[view]')"
    files = ["findings.json", "noise.toml", "physics.toml", "report.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == files


@pytest.mark.parametrize("exists", [False, True])
def test_of_two_diagnoses_that_end_together_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, exists: bool
) -> None:
    """Both have looked whether the folder holds a diagnosis before either puts its own there."""
    folder, both, looks = tmp_path / "out", threading.Barrier(2), threading.local()
    refuse, refused = diagnosis_output.refuse, list[ConfigError]()

    def look(place: Path, *, overwrite: bool = False) -> None:
        looks.made = getattr(looks, "made", 0) + 1
        refuse(place, overwrite=overwrite)
        if looks.made == 2:  # the last look before it writes
            both.wait(timeout=60.0)

    def run() -> None:
        try:
            diagnosis_output.write(diagnoses.NOTHING, folder)
        except ConfigError as error:
            refused.append(error)

    if exists:
        folder.mkdir()
    monkeypatch.setattr(diagnosis_output, "refuse", look)
    monkeypatch.setattr(diagnosis_output, "_make", lambda d, place, *_: [(place / name).touch() for name in FILES][:0])
    threads = [threading.Thread(target=run) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (error,) = refused
    assert "holds a diagnosis already" in error.what
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)


def test_nothing_is_left_of_what_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> Iterator[str]:
        raise KeyboardInterrupt

    monkeypatch.setattr("imutool.viewing.rerun.diagnosis.save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        diagnosis_output.write(diagnoses.ARM, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_number_is_null_in_the_json() -> None:
    endless = {"gyro_limit": Estimate(np.inf, np.nan, "rad/s"), "accel_limit": Estimate(80.0, 0.1, "m/s²")}
    told = json_values(replace(diagnoses.ARM, findings=(finding("saturation", "accel", endless),)).report)
    assert told["findings"][0]["parameters"]["gyro_limit"] == {"value": None, "std": None, "unit": "rad/s"}
    (entry,) = to_physics_file(replace(diagnoses.ARM, findings=(finding("saturation", "accel", endless),))).effect
    assert list(entry.parameters) == ["accel_limit"]


# ── the physics found, as a file ──


def finding(effect: str, signal: str, parameters: dict[str, Estimate], equation: str = "", **more: object) -> Finding:
    return Finding(effect, signal, 0.5, 1e-9, 1e-3, parameters, equation, HELD, **more)  # type: ignore[arg-type]


def only(*findings: Finding) -> Diagnosis:
    return replace(diagnoses.ARM, findings=findings, bias=np.zeros((1, 6)))


def test_a_null_diagnosis_is_a_bias_alone() -> None:
    file = to_physics_file(diagnoses.NOTHING)
    assert file.effect == ()
    assert file.term == ()
    assert file.unknown == ()
    assert file.bias is not None
    assert [*file.bias.gyro, *file.bias.accel] == diagnoses.NOTHING.bias[0].tolist()
    assert conclusion(diagnoses.NOTHING).startswith("Nothing")


@pytest.mark.parametrize("effect", ["dropped_samples", "timestamp_jitter", "reference_error"])
def test_what_is_no_effect_on_a_reading_stays_out(effect: str) -> None:
    file = to_physics_file(only(finding(effect, "both", {"share": Estimate(0.01, 0.001, "-")})))
    assert file.effect == ()
    assert [effect.name for effect, _ in file.acting()] == ["~bias"]


def test_what_is_driven_keeps_its_driver_and_lag() -> None:
    unit = "m/s² per unit of /motor/current"
    gain = {axis: Estimate(0.1 * k, 0.01, unit) for k, axis in enumerate("xyz")} | {"lag": Estimate(0.05, 0.01, "s")}
    file = to_physics_file(only(finding("driven", "accel", gain, driver="/motor/current")))
    (physics, theta), _ = file.acting()
    assert theta.tolist() == [0.0, 0.1, 0.2, 0.05]
    t = np.arange(50) * 0.01
    there = IdealMotion(t, *(np.zeros((50, 3)) for _ in range(3)), channels={"/motor/current": t}).sample(t, t)
    assert np.ptp(physics.forward(there, theta).accel[:, 2]) > 0.0


def test_a_term_without_a_name_acts_as_it_was_found() -> None:
    c = {"c": Estimate(0.3, 0.01, "")}
    said = finding("unknown", "gyro", c, kind="unknown", axis="z", variable="omega_x omega_y")
    (physics, theta), _ = to_physics_file(only(said)).acting()
    gyro = np.random.default_rng(1).normal(size=(20, 3))
    t_s = np.arange(20) * 0.01
    there = IdealMotion(t_s, gyro, gyro, gyro).sample(t_s, t_s)
    added = physics.forward(there, theta).gyro - gyro
    assert np.allclose(added, np.outer(gyro[:, 0] * gyro[:, 1], [0.0, 0.0, 0.3]), rtol=0, atol=EXACT)


def test_a_curve_and_the_bias_add_up_to_what_was_fitted() -> None:
    """The curve is told about its mean, which goes to the bias: the coefficients' own curve is what both make together."""
    shape = SplineBasis(np.array([-1.0, -0.3, 0.0, 0.2, 1.0]))
    c, x = np.array([0.5, 0.1, 0.0, 0.2, 0.4, 0.9, 1.0]), np.linspace(-1.0, 1.0, 41)
    y = np.zeros((41, 3))
    mean = float((shape.basis(x) @ c).mean())
    y[:, 2] = shape.basis(x) @ c - mean
    curve = Curve.of_arrays("omega_x", "rad/s", x, y, np.full((41, 3), 0.01), mean)
    said = finding("unknown", "accel", {}, kind="unknown", axis="z", variable="omega_x", curve=curve)
    acting = to_physics_file(only(said)).acting()
    gyro = np.stack([x, np.zeros(41), np.zeros(41)], axis=1)
    t_s = np.arange(41) * 0.01
    there = IdealMotion(t_s, gyro, np.zeros((41, 3)), gyro).sample(t_s, t_s)
    for physics, theta in acting:
        there = physics.forward(there, theta)
    assert np.allclose(there.accel[:, 2], shape.basis(x) @ c, rtol=0, atol=EXACT)
    assert not there.accel[:, :2].any()


def test_every_term_there_can_be_is_written_as_it_acts() -> None:
    """Whatever `unnamed` can propose, the file can say: same signal, same axis, same numbers."""
    gyro, accel, alpha = (np.random.default_rng(k).normal(size=(30, 3)) for k in (1, 2, 3))
    t_s = np.arange(30) * 0.01
    there = IdealMotion(t_s, gyro, accel, alpha).sample(t_s, t_s)
    for physics in unnamed.terms(there):
        c = {"c": Estimate(0.7, 0.01, physics.parameters[0].unit)}
        assert physics.axis is not None
        what = {"kind": "unknown", "axis": AXES[physics.axis], "variable": physics.variable}
        (written, theta), _ = to_physics_file(only(finding("unknown", physics.sensors[0], c, **what))).acting()
        one, other = written.forward(there, theta), physics.forward(there, np.array([0.7]))
        assert np.allclose(one.gyro, other.gyro, rtol=0, atol=EXACT), physics.equation
        assert np.allclose(one.accel, other.accel, rtol=0, atol=EXACT), physics.equation
