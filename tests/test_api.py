"""The public API: light to import, documented, and every example of its documentation runs."""

from __future__ import annotations

import ast
import copy
import doctest
import inspect
import json
import pickle
import pydoc
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.in_process import run_script
from support.loaded import loaded

import imutool
from imutool.cleaning.survey import raw_batches
from imutool.cli.demo import write_asl
from imutool.viewing.rerun.live import is_complete_rrd

ROOT = Path(__file__).parents[1]
IMPORT_SHARE = 0.1  # of the time that `import torch` takes
ROUNDS = 3
REQUIRED = {
    *("read", "write", "Recording", "Imu", "Poses", "Log", "convert", "info", "clean", "repair", "debias", "OnlineDebiaser"),
    *("load_model", "train", "evaluate", "simulate", "diagnose", "export", "view", "ImutoolError"),
}
FUNCTIONS = [name for name in imutool.__all__ if inspect.isfunction(getattr(imutool, name))]
PARAGRAPHS = ("Args:", "Raises:", "Examples:")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, logs: Path) -> Path:
    """A folder with what the examples read: raw/, two logs, a model, a damaged log."""
    made = tmp_path_factory.mktemp("api")
    for name in ("flight_1.mcap", "flight_2.mcap", "linear.safetensors"):
        shutil.copy(logs / name, made / name)
    for seed in (1, 2):
        write_asl(imutool.example_recording(seed, duration_s=2.0), made / "raw" / f"flight_{seed}")
    whole = (made / "flight_1.mcap").read_bytes()
    (made / "cut_short.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    return made


# ── importing ──


def test_all_that_is_promised_is_public() -> None:
    assert set(imutool.__all__) >= REQUIRED
    assert list(imutool.__all__) == sorted(set(imutool.__all__))
    assert {name for name in dir(imutool) if not name.startswith("__")} == {*imutool.__all__} - {"__version__"}
    for name in imutool.__all__:
        getattr(imutool, name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'reed'"):
        imutool.reed  # noqa: B018


def test_the_types_that_tools_see_are_the_names_that_are_imported() -> None:
    """What stands under TYPE_CHECKING is what `__getattr__` gives."""
    tree = ast.parse(Path(imutool.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {name.name: node.module for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert seen == imutool._HOME
    assert {*seen, "__version__"} == set(imutool.__all__)


def test_importing_the_package_imports_no_numpy_and_no_torch() -> None:
    assert loaded("import imutool", {"numpy", "torch", "msgspec", "rerun"}) == []


def test_reading_and_writing_import_no_torch() -> None:
    assert loaded("import imutool; imutool.read, imutool.write, imutool.info, imutool.clean", {"torch"}) == []


def test_importing_takes_a_tenth_of_importing_torch(torch_import_s: float) -> None:
    clock = "import time; a = time.perf_counter(); import imutool; print(time.perf_counter() - a)"

    def seconds() -> float:
        return float(subprocess.run([sys.executable, "-c", clock], check=True, capture_output=True, text=True).stdout)

    limit_s = IMPORT_SHARE * torch_import_s
    assert any(seconds() < limit_s for _ in range(ROUNDS)), f"import imutool took over {limit_s:.3f} s each time"


# ── documentation ──


@pytest.mark.parametrize("name", sorted(set(imutool.__all__) - {"__version__"}))
def test_every_public_name_is_documented(name: str) -> None:
    doc = inspect.getdoc(getattr(imutool, name)) or ""
    assert doc, f"{name} has no docstring"
    assert doc != inspect.getdoc(object)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_says_arguments_errors_and_an_example(name: str) -> None:
    function = getattr(imutool, name)
    doc = inspect.getdoc(function) or ""
    missing = [paragraph for paragraph in PARAGRAPHS if f"\n{paragraph}\n" not in doc]
    assert not missing
    for parameter in inspect.signature(function).parameters:
        assert re.search(rf"^ +(\*\*)?{parameter}: ", doc, re.MULTILINE), f"{name} does not document {parameter}"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_example_of_a_docstring_runs(name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    doc = inspect.getdoc(getattr(imutool, name)) or ""
    test = doctest.DocTestParser().get_doctest(doc, {}, name, None, None)
    assert test.examples
    told: list[str] = []
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=told.append).failed == 0, "".join(told)


def lines_of_help() -> list[str]:
    """The code of the package's docstring: what `help(imutool)` shows."""
    doc = inspect.getdoc(imutool) or ""
    block = re.search(r"::\n\n((?: {4}.*\n|\n)+)", doc)
    assert block is not None
    return [line.removeprefix("    ") for line in block[1].splitlines() if line.strip()]


def test_help_shows_the_way_from_a_raw_folder_to_a_debiased_log_in_ten_lines() -> None:
    lines = lines_of_help()
    assert len(lines) - 1 <= 10  # without the import
    shown = pydoc.render_doc(imutool, renderer=pydoc.plaintext)
    assert all(line in shown for line in lines)


def test_the_lines_of_help_run(tmp_path: Path) -> None:
    for seed in (1, 2):
        write_asl(imutool.example_recording(seed, duration_s=20.0), tmp_path / "raw" / f"flight_{seed}")
    (tmp_path / "way.py").write_text("\n".join(lines_of_help()))
    done = run_script(["way.py"], tmp_path)
    assert done.returncode == 0, done.stderr
    errors = {name: float(value) for name, value in re.findall(r"^(\w+) ([\d.]+)$", done.stdout, re.MULTILINE)}
    assert errors["sensor"] < errors["raw"]
    assert "<svg" in (tmp_path / "debiased.html").read_text(encoding="utf-8")


def test_the_reference_names_what_is_there() -> None:
    text = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    for place, members in re.findall(r"^::: (\S+)\n    options:\n      members: \[(.*)\]", text, re.MULTILINE):
        module, _, name = place.rpartition(".")
        missing = [member for member in members.split(", ") if not hasattr(getattr(import_module(module), name), member)]
        assert not missing, f"{place} has no {', '.join(missing)}"


# ── arrays ──


def test_arrays_survive_a_log_bit_for_bit(tmp_path: Path) -> None:
    recording = imutool.example_recording(3, duration_s=2.0)
    imutool.write(str(tmp_path / "a.mcap"), recording)
    assert imutool.read(str(tmp_path / "a.mcap")) == recording
    assert imutool.read(tmp_path / "a.mcap") == recording


@pytest.mark.parametrize("other_poses", [{}, {"/slam/pose": "odometry"}])
def test_poses_keep_their_kind_whatever_their_topic_is_called(tmp_path: Path, other_poses: dict[str, str]) -> None:
    made = imutool.example_recording(3, duration_s=2.0)
    recording = replace(made, truths={"/slam/pose": made.truth}, other_poses=other_poses)
    imutool.write(tmp_path / "a.mcap", recording)
    assert imutool.read(tmp_path / "a.mcap", truth="/slam/pose" if other_poses else None) == recording
    assert dict(imutool.read(tmp_path / "a.mcap").other_poses) == other_poses


def test_the_first_truth_stays_the_first(tmp_path: Path) -> None:
    made = imutool.example_recording(3, duration_s=2.0)
    recording = replace(made, truths={"/pose": made.truth, "/vicon/pose": made.truth.rows(slice(9))})
    imutool.write(tmp_path / "a.mcap", recording)
    assert list(imutool.read(tmp_path / "a.mcap").truths) == ["/pose", "/vicon/pose"]


def test_a_recording_is_debiased_as_its_log_is(tmp_path: Path, logs: Path) -> None:
    source, model = logs / "flight_2.mcap", logs / "linear.safetensors"
    from_arrays = imutool.debias(imutool.read(source), imutool.load_model(model))
    by_name = imutool.debias(imutool.read(source), model=model)
    imutool.debias(str(source), tmp_path / "out.mcap", model=model)
    with imutool.Log(tmp_path / "out.mcap") as log:
        assert repr(log).startswith(f"<log {tmp_path / 'out.mcap'}: /imu0 (sensor_msgs/msg/Imu), ")
        batches = list(raw_batches(log, "/imu0/debiased"))
    gyro, accel = (np.concatenate([getattr(batch, name) for batch in batches]) for name in ("gyro", "accel"))
    for debiased in (from_arrays, by_name):
        assert np.array_equal(debiased.imu.gyro, gyro)
        assert np.array_equal(debiased.imu.accel, accel)
        assert debiased.model == "linear"
        assert debiased.std.min() > 0.0


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("model", ["static", None])
def test_a_recording_is_debiased_without_a_trained_model(logs: Path, model: str | None, smooth: bool) -> None:
    recording = imutool.read(logs / "flight_2.mcap")
    debiased = imutool.debias(recording, model, smooth=smooth)
    assert debiased.model == "static"
    true = recording.scalars["/ground_truth/bias/gyro"].values
    assert np.abs(debiased.bias[:, :3] - true).max() < 0.02


def test_samples_one_by_one_are_debiased_as_the_recording_is(logs: Path) -> None:
    recording, model = imutool.read(logs / "flight_2.mcap"), imutool.load_model(logs / "linear.safetensors")
    online, imu = imutool.OnlineDebiaser(model), recording.imu
    rows = [online(*sample)[2] for sample in zip(imu.t_ns.tolist(), imu.gyro, imu.accel, strict=True)]
    settled = slice(-1000, None)
    assert np.allclose(np.array(rows)[settled], imutool.debias(recording, model).bias[settled], atol=0.01)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (imutool.debias, "one of the two"),
        (lambda log: imutool.debias(log, "out.mcap", in_place=True), "one of the two"),
        (lambda log: imutool.debias(log, "out.mcap", model=imutool.load_model("static")), "a model file"),
        (lambda log: imutool.debias(log, "static"), "target: 'static' is a model; expected the new log"),
        (lambda log: imutool.debias(log, "fetch-hybrid"), "target: 'fetch-hybrid' is a model"),
        (lambda log: imutool.view(log, html="x.html", align="sideways"), "none, origin, yaw, se3"),
        (lambda log: imutool.export("s3://bucket/log.mcap", "out", format="euroc"), "a file on this machine"),
        (lambda log: imutool.train([log], "m.safetensors", settings={"step": 3}), "Did you mean steps"),
    ],
    ids=["no target", "both targets", "loaded model", "model as target", "shipped as target", "alignment", "url", "setting"],
)
def test_what_cannot_be_is_said(call: Callable[[str], object], said: str, logs: Path, tmp_path: Path) -> None:
    with pytest.raises(imutool.ConfigError, match=said):
        call(str(logs / "flight_1.mcap"))


def test_an_empty_name_is_no_model(logs: Path, tmp_path: Path) -> None:
    with pytest.raises(imutool.ModelError, match="is not a model file"):
        imutool.debias(logs / "flight_1.mcap", tmp_path / "out.mcap", model="")


STILL = imutool.example_recording(1, duration_s=5.0)
STATIC = imutool.load_model("static")
ZEROS = np.zeros((2, len(STILL.imu), 3))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: imutool.read(STILL), "of type Recording; expected a path or a URL. `imutool.write` makes a log"),
        (lambda: imutool.write("a.mcap", STILL.imu), "recording: is of type Imu; expected a Recording"),
        (lambda: imutool.debias(STILL.imu, "static"), "of type Imu; expected a path or a URL"),
        (
            lambda: imutool.debias(STILL, "out.mcap", model="static"),
            "target: a recording is debiased to arrays, with one model",
        ),
        (lambda: imutool.debias(STILL, "static", imus=["/imu0"], overwrite=True), "imus, overwrite: a recording is debiased"),
        (lambda: imutool.debias(replace(STILL, imu=STILL.imu.rows(slice(0, 1))), "static"), "1 samples; expected at least 2"),
        (
            lambda: imutool.debias(STILL, "static", init=STILL),
            "init: is of type Recording; expected the name of a method, or six",
        ),
        (lambda: imutool.load_model(STATIC), "name: is of type Model; expected text or a path"),
        (lambda: imutool.bias_at_rest("static", STILL.imu), "model, imu: are of type str, Imu"),
        (lambda: imutool.OnlineDebiaser("static"), "model: is of type str; expected a loaded model"),
        (
            lambda: imutool.OnlineDebiaser(STATIC, np.zeros(6)),
            "start: is of type ndarray; expected a bias of `imutool.bias_at_rest`",
        ),
        (lambda: imutool.notebook_page("a.mcap"), "runs: is of type str; expected runs of `imutool.load_run`"),
        (lambda: imutool.notebook_viewer(None), "runs: is of type NoneType; expected runs of `imutool.load_run`"),
        (lambda: imutool.Log(None), "of type NoneType; expected a path or a URL"),
        (lambda: imutool.debias(replace(STILL, imu=imutool.Imu(STILL.imu.t_ns, *ZEROS)), STATIC), "no sample is a measurement"),
        (lambda: imutool.train([], "m.safetensors"), "logs: no log is given"),
        (
            lambda: imutool.train("a.mcap", "m.safetensors", settings=["steps=3"]),
            "settings: is of type list; expected a dictionary",
        ),
        (lambda: imutool.train("a.mcap", "m.safetensors", method="lineer", settings={}), "method: .*Did you mean 'linear'"),
        (lambda: imutool.diagnose([]), "reals: no log is given"),
        (lambda: imutool.diagnose("a.mcap", metric=lambda log: 1.0), "`metric` compares two simulations"),
        (
            lambda: imutool.debias("a.mcap", "b.mcap", model="static", smooth="no"),
            "smooth: is of type str; expected True or False",
        ),
        (lambda: imutool.simulate("a.mcap", "b.mcap", seed=1.5), "seed: is of type float; expected an integer"),
        (lambda: imutool.simulate("a.mcap", "b.mcap", noise=None), "noise: is of type NoneType; expected text or a path"),
        (lambda: imutool.read("a.mcap", truth=True), "truth: is of type bool; expected text or None"),
        (lambda: imutool.clean("a.mcap", rules=[3]), "rules: is of type list; expected text or a list of texts"),
        (
            lambda: imutool.train("a.mcap", "m.safetensors", settings={"seed": "x"}),
            "settings: seed: is 'x', text; expected an integer",
        ),
        (
            lambda: imutool.train("a.mcap", "m.safetensors", settings={"steps": -1}),
            "settings: steps: is -1, out of range; expected an integer >=",
        ),
        (lambda: imutool.convert("a.mcap", "b.mcap", format="eurok"), "format: .*Did you mean 'euroc'"),
        (lambda: imutool.clean("a.mcap", rules="spike"), "rules: .*Did you mean 'spikes'"),
        (lambda: imutool.clean("a.mcap", skip_rules="spike"), "skip_rules: .*Did you mean 'spikes'"),
        (lambda: imutool.clean("a.mcap", rules="spikes", skip_rules="spikes"), "rules, skip_rules: spikes is in both lists"),
        (lambda: imutool.clean("a.mcap", fix=True), "`fix` needs `target`"),
        (lambda: imutool.clean("a.mcap", init=np.zeros(6)), "`init` needs `target`"),
        (lambda: imutool.info("a.mcap", max_chunk=0), "max_chunk: 0 bytes; expected 1 or more"),
        (lambda: imutool.convert("raw", "logs", progress=True), "progress: is of type bool; expected a function"),
        (lambda: imutool.convert("raw", "logs", mapping=["t"]), "mapping: is of type list; expected text or a path or a dict"),
        (lambda: imutool.InitialBias(np.full(6, np.nan), np.ones(6), "mine"), r"InitialBias.rest is \[nan, .*expected finite"),
        (lambda: imutool.InitialBias(np.zeros(6), -np.ones(6), "mine"), r"InitialBias.std is \[-1.0, .*that are not negative"),
    ],
    ids=range(38),
)
def test_a_value_of_another_kind_is_said(call: Callable[[], object], said: str) -> None:
    with pytest.raises(imutool.ImutoolError, match=said):
        call()


UNCHECKED = """
import numpy as np
from dataclasses import replace
import imutool

made = imutool.example_recording(duration_s=1.0)
rows = np.zeros((len(made.imu), 6))
for call in (
    lambda: made.truth.at(made.truth.t_ns[:4].reshape(2, 2)),
    lambda: imutool.write("a.mcap", replace(made, scalars={"/t": imutool.Scalars([1], [20.0], 3)})),
    lambda: imutool.write("a.mcap", replace(made, frames={"/cam0": imutool.Frames("png", 1, [(1, b"")])})),
    lambda: imutool.LiveView("/imu0", print).add(made.imu.gyro, rows, rows),
):
    try:
        call()
    except imutool.DataError as error:
        print(error)
"""


def test_a_value_of_another_kind_is_said_where_no_type_is_checked() -> None:
    """Under the tests jaxtyping would refuse these values first."""
    done = subprocess.run([sys.executable, "-c", UNCHECKED], check=True, capture_output=True, text=True)
    assert done.stdout.splitlines() == [
        "t_ns is int64[2, 2]; expected int64[n].",
        "flight_1: the unit of /t is of type int; expected text.",
        "flight_1: the `each` of /cam0 is of type list; expected a function.",
        "LiveView.add: is of type ndarray; expected samples as an `Imu`.",
    ]


def test_a_log_without_samples_is_not_diagnosed(tmp_path: Path) -> None:
    imutool.write(tmp_path / "log.mcap", replace(STILL, imu=STILL.imu.rows(slice(0, 0))))
    with pytest.raises(imutool.ImutoolError, match="expected"):
        imutool.diagnose(tmp_path / "log.mcap")


def test_six_numbers_are_a_start_as_their_text_is() -> None:
    numbers = [0.01, -0.02, 1.0 / 3.0, 0.1, 0.0, -0.3]
    text = ",".join(map(repr, numbers))
    for given in (numbers, np.array(numbers), text):
        debiased = imutool.debias(STILL, STATIC, init=given, force=True)  # the log shows others
        assert np.array_equal(debiased.start.rest, numbers)


def test_a_start_of_ones_own_has_six_numbers_each() -> None:
    """As users make it: without the check of annotations."""
    start = object.__new__(imutool.InitialBias)
    start.__dict__.update(rest=[0] * 6, std=np.ones(6, np.float32), noise=(0.0,) * 6)
    start.__post_init__()
    assert {value.dtype for value in (start.rest, start.std, start.noise)} == {np.dtype(np.float64)}
    start.__dict__.update(std=[1.0] * 3)
    with pytest.raises(imutool.DataError, match=r"InitialBias.std is float64\[3\]; expected float64\[6\]"):
        start.__post_init__()


def test_a_live_sample_of_another_kind_is_refused() -> None:
    call = inspect.unwrap(imutool.OnlineDebiaser.__call__)  # as users call it: without the check of annotations
    still, none, texts = np.ones(3), None, ["0", "0", "1"]
    wrong: list[tuple[Any, Any, Any]] = [(0.5, still, still), (5, np.zeros((2, 3)), np.ones((2, 3))), (5, np.zeros(6), [0.0])]
    wrong += [(5, np.zeros(4), np.ones(2)), (5, np.ones(6), [])]
    for stamp, gyro, accel in [*wrong, (5, none, none), (5, still, none), (5, still, texts), (5, still + 1j, still)]:
        with pytest.raises(imutool.DataError, match="expected one sample of 3 numbers each, at integer nanoseconds"):
            call(imutool.OnlineDebiaser(STATIC), stamp, gyro, accel)
    assert call(imutool.OnlineDebiaser(STATIC), np.int64(5), [0.0, 0.0, 0.1], (0.0, 0.0, 9.8))[0][2] == 0.1


@pytest.mark.parametrize(
    ("told", "stamps_ns", "step"),
    [("the stamps are not in nanoseconds", 1e-3, 1), ("IMU at 100.0 Hz; expected 200.0 Hz", 1.0, 2), ("", 1.0, 1)],
)
def test_a_live_sensor_of_another_rate_is_refused_by_its_first_samples(
    told: str, stamps_ns: float, step: int, logs: Path
) -> None:
    """With stamps in microseconds no time went by, so that the bias stayed where it began."""
    imu, model = imutool.read(logs / "flight_2.mcap").imu, imutool.load_model(logs / "linear.safetensors")
    online, samples = imutool.OnlineDebiaser(model), imu.rows(slice(0, 1000 * step, step))

    with pytest.raises(imutool.ImutoolError, match=told) if told else nullcontext():
        for t_ns, gyro, accel in zip(samples.t_ns.tolist(), samples.gyro, samples.accel, strict=True):
            online(round(t_ns * stamps_ns), gyro, accel)


def test_samples_in_g_are_warned_of_one_by_one_and_give_no_bias_at_rest(logs: Path, caplog: pytest.LogCaptureFixture) -> None:
    imu, model = imutool.read(logs / "flight_2.mcap").imu.rows(slice(0, 500)), imutool.load_model(logs / "linear.safetensors")
    online, in_g = imutool.OnlineDebiaser(model), imutool.Imu(imu.t_ns, imu.gyro, imu.accel / 9.80665)
    for sample in zip(imu.t_ns.tolist(), in_g.gyro, in_g.accel, strict=True):
        online(*sample)
    assert caplog.text.count("the specific force has a median of 1.0") == 1
    with pytest.raises(imutool.DataError, match="the specific force has a median of 1"):
        imutool.bias_at_rest(model, in_g)
    with pytest.raises(imutool.DataError, match="imu: the samples do not begin at rest") as refused:
        imutool.bias_at_rest(model, imu.rows(slice(0, 50)))
    assert "init" not in str(refused.value)


@pytest.mark.parametrize("set_back_ns", [0, 20_000_000_000])
def test_a_live_sensor_may_count_its_time_from_anywhere(logs: Path, set_back_ns: int) -> None:
    """Stamps below zero, and a clock since power-on that is set back beyond its start, begin nothing anew."""
    imu, model = imutool.read(logs / "flight_2.mcap").imu.rows(slice(0, 1200)), imutool.load_model(logs / "linear.safetensors")
    t_ns = imu.t_ns - imu.t_ns[0] - set_back_ns * (np.arange(len(imu)) >= 600)
    rows = []
    for start_ns in (10**15, 5_000_000_000, -60_000_000_000):
        online = imutool.OnlineDebiaser(model)
        rows.append([online(*sample)[2] for sample in zip((start_ns + t_ns).tolist(), imu.gyro, imu.accel, strict=True)])
    np.testing.assert_array_equal(rows[1], rows[0])
    np.testing.assert_array_equal(rows[2], rows[0])


def test_a_debiased_recording_is_not_debiased_again(logs: Path, tmp_path: Path) -> None:
    """In a log of its own it looked like a raw one."""
    raw = imutool.read(logs / "flight_2.mcap")
    once = imutool.debias(raw, logs / "linear.safetensors").recording
    imutool.write(tmp_path / "once.mcap", once)
    for again in (once, imutool.read(tmp_path / "once.mcap")):
        with pytest.raises(imutool.DataError, match="debiased already, by linear"):
            imutool.debias(again, "static")
        assert imutool.debias(again, "static", force=True).model == "static"
    with pytest.raises(imutool.LogError, match=r"once.mcap: its IMU is debiased already, by linear"):
        imutool.debias(tmp_path / "once.mcap", tmp_path / "twice.mcap", model="static")
    assert not (tmp_path / "twice.mcap").exists()
    assert imutool.debias(raw, "static").model == "static"


def test_a_channel_that_is_debiased_already_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    imutool.write(tmp_path / "raw.mcap", imutool.example_recording(duration_s=5.0))
    imutool.debias(tmp_path / "raw.mcap", tmp_path / "out.mcap", model="static")
    channel = imutool.read(tmp_path / "out.mcap", imu="/imu0/debiased")
    with pytest.raises(imutool.DataError, match="debiased already, by static"):
        imutool.debias(channel, "static")
    with pytest.raises(imutool.LogError, match="debiased already, as /imu0/debiased"):
        imutool.debias(tmp_path / "out.mcap", tmp_path / "twice.mcap", model="static", imus=["/imu0/debiased"])
    imutool.evaluate(tmp_path / "out.mcap")
    assert caplog.messages == []
    imutool.evaluate(channel, models=["static"])
    assert caplog.messages == ["flight_1: `raw` is debiased already, by static: a model corrects it once more"]


def test_results_print_briefly(logs: Path) -> None:
    log, model = logs / "flight_2.mcap", imutool.load_model(logs / "linear.safetensors")
    still = imutool.read(log).imu.rows(slice(0, 400))
    run = imutool.load_run(log, models=["static"])
    results = imutool.clean(log), run, imutool.bias_at_rest(model, still), imutool.notebook_page(run)
    for result in (*results, imutool.OnlineDebiaser(model)):
        assert len(repr(result)) < 500
        assert "array(" not in repr(result)
    assert copy.deepcopy(results[2]) != results[2]  # the comparison of its arrays has no one truth value


@pytest.mark.parametrize(("unit_ns", "told"), [(1_000_000_000, "have 2 stamps, 1 ns apart"), (10**18, "have one stamp")])
def test_stamps_of_whole_seconds_or_never_set_are_refused(logs: Path, unit_ns: int, told: str) -> None:
    """No time went by, so that the bias was another one, without a word."""
    imu, model = imutool.read(logs / "flight_2.mcap").imu.rows(slice(0, 400)), imutool.load_model(logs / "linear.safetensors")
    online = imutool.OnlineDebiaser(model)
    for t_ns, gyro, accel in zip(imu.t_ns[:-1].tolist(), imu.gyro, imu.accel, strict=False):
        online(t_ns // unit_ns, gyro, accel)
    with pytest.raises(imutool.DataError, match=told):
        online(int(imu.t_ns[-1]) // unit_ns, imu.gyro[-1], imu.accel[-1])


def test_stamps_of_batches_are_warned_of(logs: Path, caplog: pytest.LogCaptureFixture) -> None:
    imu, model = imutool.read(logs / "flight_2.mcap").imu.rows(slice(0, 600)), imutool.load_model(logs / "linear.safetensors")
    online = imutool.OnlineDebiaser(model)
    for k, (gyro, accel) in enumerate(zip(imu.gyro, imu.accel, strict=True)):
        online(int(imu.t_ns[k // 32 * 32]), gyro, accel)
    assert caplog.text.count("387 of the first 400 samples have the stamp of another") == 1


def test_a_sample_that_comes_twice_counts_once(logs: Path) -> None:
    imu, model = imutool.read(logs / "flight_2.mcap").imu.rows(slice(0, 1000)), imutool.load_model(logs / "linear.safetensors")
    once, twice = imutool.OnlineDebiaser(model), imutool.OnlineDebiaser(model)
    for sample in zip(imu.t_ns.tolist(), imu.gyro, imu.accel, strict=True):
        twice(*sample)
        np.testing.assert_array_equal(twice(*sample)[2], once(*sample)[2])


def test_rates_in_degrees_and_a_dead_accelerometer_are_warned_of(logs: Path, caplog: pytest.LogCaptureFixture) -> None:
    imu, model = imutool.read(logs / "flight_2.mcap").imu, imutool.load_model(logs / "linear.safetensors")
    degrees, dead = imutool.OnlineDebiaser(model), imutool.OnlineDebiaser(model)
    for t_ns, gyro, accel in zip(imu.t_ns.tolist(), imu.gyro, imu.accel, strict=True):
        degrees(t_ns, np.rad2deg(gyro), accel)
        dead(t_ns, gyro, np.zeros(3))
    assert caplog.text.count("gyro looks like deg/s") == 1
    assert caplog.text.count("no sample of the first 400 is a measurement") == 1


def test_the_covariance_of_live_samples_is_that_of_the_recording(logs: Path) -> None:
    recording, model = imutool.read(logs / "flight_2.mcap"), imutool.load_model(logs / "linear.safetensors")
    batch, imu = imutool.debias(recording, model, init="prior"), recording.imu
    online, plain = imutool.OnlineDebiaser(model, batch.start, with_covariance=True), imutool.OnlineDebiaser(model, batch.start)
    assert np.isnan(online.covariance).all()
    for k in range(1500):
        sample = int(imu.t_ns[k]), imu.gyro[k], imu.accel[k]
        np.testing.assert_allclose(online(*sample)[2], plain(*sample)[2], rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.sqrt(online.covariance.diagonal()), batch.std[k], rtol=1e-9)
    assert np.array_equal(online.covariance, online.covariance.T)
    with pytest.raises(imutool.ConfigError, match="with_covariance=True"):
        _ = plain.covariance


@pytest.mark.parametrize("copied_by", [copy.copy, copy.deepcopy])
def test_a_copy_of_a_live_debiaser_goes_its_own_way(copied_by: Callable[[Any], Any], logs: Path) -> None:
    imu, model = imutool.read(logs / "flight_2.mcap").imu, imutool.load_model(logs / "linear.safetensors")
    samples = list(zip(imu.t_ns.tolist(), imu.gyro, imu.accel, strict=True))[:800]
    alone, copied = imutool.OnlineDebiaser(model), imutool.OnlineDebiaser(model)
    for online in (alone, copied):
        for sample in samples[:400]:
            online(*sample)
    branch = copied_by(copied)
    for stamp_ns, gyro, accel in samples[400:]:
        branch(stamp_ns, gyro + 0.3, accel)
    for sample in samples[400:]:
        np.testing.assert_array_equal(copied(*sample)[2], alone(*sample)[2])


def test_times_outside_a_log_are_refused_with_those_it_has(tmp_path: Path) -> None:
    imutool.write(tmp_path / "log.mcap", STILL)
    assert imutool.read(tmp_path / "log.mcap", end_ns=int(STILL.imu.t_ns[0])).imu == STILL.imu.rows(slice(0, 1))
    with pytest.raises(imutool.LogError, match=r"to `end_ns` 10; expected times within 17\d+ to 17\d+"):
        imutool.read(tmp_path / "log.mcap", start_ns=5, end_ns=10)


def test_one_name_is_a_list_of_one(tmp_path: Path) -> None:
    imutool.write(tmp_path / "log.mcap", STILL)
    (survey,) = imutool.clean(tmp_path / "log.mcap", imus="/imu0", rules="gaps").surveys
    assert survey.topic == "/imu0"
    assert [trace.name for trace in imutool.load_run(tmp_path / "log.mcap", models="static").traces] == ["raw", "static"]


def test_a_loaded_run_crosses_to_another_process(logs: Path) -> None:
    run = imutool.load_run(logs / "flight_1.mcap", models="static", aid="stops")
    for again in (pickle.loads(pickle.dumps(run)), copy.deepcopy(run)):
        assert again.table() == run.table()
        assert [trace.run.is_aided for trace in again.traces] == [trace.run.is_aided for trace in run.traces]


def test_a_view_leaves_the_environment_as_it_was(tmp_path: Path) -> None:
    shown = "with imutool.watch('x', save='x.rrd'): pass"
    code = f"import os, imutool\nbefore = dict(os.environ)\n{shown}\nprint(before == dict(os.environ))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("True\n", "")


def test_what_a_live_view_showed_until_ctrl_c_is_saved(tmp_path: Path) -> None:
    def show(zeros: np.ndarray) -> None:
        with imutool.watch("x", save=tmp_path / "x.rrd") as live:
            live.add(STILL.imu, zeros, zeros + 1.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        show(np.zeros((len(STILL.imu), 6)))
    assert is_complete_rrd(tmp_path / "x.rrd")


def test_a_misspelt_option_of_view_is_named_before_any_work() -> None:
    with pytest.raises(TypeError, match=r"view\(\) got an unexpected keyword argument 'model'. Did you mean 'models'"):
        imutool.view("absent.mcap", model="static")


def test_convert_corrects_a_log_on_demand_as_the_command_does(tmp_path: Path) -> None:
    made = imutool.example_recording(3, duration_s=20.0)
    late = np.random.default_rng(0).integers(0, 3_000_000, len(made.imu))
    in_g = imutool.Imu(made.imu.t_ns + late, made.imu.gyro, made.imu.accel / 9.80665)
    imutool.write(tmp_path / "wrong.mcap", replace(made, imu=in_g))
    imutool.convert(tmp_path / "wrong.mcap", tmp_path / "right.mcap", fix=True, restamp=True)
    right = imutool.read(tmp_path / "right.mcap").imu
    np.testing.assert_allclose(right.accel, made.imu.accel, atol=1e-9)
    assert np.ptp(np.diff(right.t_ns)) < 1e5


def test_a_report_prints_as_the_json_of_its_command(tmp_path: Path) -> None:
    imutool.write(tmp_path / "log.mcap", STILL)
    report = imutool.info(tmp_path / "log.mcap")
    assert json.loads(str(report)) == report.to_dict()
    assert report.to_dict()["imu"][0]["samples"] == len(STILL.imu)


@pytest.mark.parametrize("unit_ns", [1_000, 1_000_000])
def test_times_of_another_unit_are_refused(unit_ns: int, logs: Path, tmp_path: Path) -> None:
    imu = imutool.read(logs / "flight_1.mcap").imu
    other = imutool.Recording("other", imutool.Imu(imu.t_ns // unit_ns, imu.gyro, imu.accel))
    for call in (
        lambda: imutool.write(tmp_path / "log.mcap", other),
        lambda: imutool.debias(other, imutool.load_model("static")),
    ):
        with pytest.raises(imutool.DataError, match="not in nanoseconds"):
            call()
    assert not any(tmp_path.iterdir())


def test_a_url_is_a_path(store: Any, logs: Path) -> None:
    recording = imutool.read(logs / "flight_1.mcap")
    imutool.write("s3://fleet/flight_1.mcap", recording)
    assert imutool.read("s3://fleet/flight_1.mcap") == recording


# ── what we show to others uses the public API alone ──


def shown_code() -> Iterator[tuple[str, str]]:
    """Python code of the examples, of the notebook, and of every page: where, and the text."""
    for path in sorted((ROOT / "examples").glob("*.py")):
        yield path.name, path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        yield path.name, "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        if path.exists():
            for block in re.findall(r"```py(?:thon)?[^\n]*\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
                yield path.name, block


def test_examples_and_pages_import_the_package_alone() -> None:
    for where, code in shown_code():
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Import):
                inside = [name.name for name in node.names if name.name.startswith("imutool.")]
                assert not inside, f"{where} imports {inside}"
            elif isinstance(node, ast.ImportFrom):
                assert (node.module or "").partition(".")[0] != "imutool" or node.module == "imutool", f"{where}: {node.module}"
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "imutool":
                assert node.attr in imutool.__all__, f"{where} uses imutool.{node.attr}"


def test_arrays_are_trained_on_scored_and_diagnosed_as_their_logs_are(logs: Path, tmp_path: Path) -> None:
    first, second = sorted(logs.glob("*.mcap"))[:2]
    arrays = [imutool.read(path) for path in (first, second)]
    models = [
        imutool.train(given, tmp_path / f"{name}.safetensors", method="linear", settings={"compare": False})
        for name, given in (("logs", [first, second]), ("arrays", arrays))
    ]
    for name, values in models[0].tensors.items():
        np.testing.assert_array_equal(values, models[1].tensors[name])
    model = tmp_path / "logs.safetensors"
    assert imutool.evaluate(arrays[0], models=model) == imutool.evaluate(first, models=model)
    scaled = replace(arrays[0], imu=imutool.Imu(arrays[0].imu.t_ns, 1.02 * arrays[0].imu.gyro, arrays[0].imu.accel))
    found = imutool.diagnose(scaled, arrays[0])
    assert [finding.effect for finding in found.findings] == ["gyro_scale"]
    with pytest.raises(imutool.errors.ConfigError, match="no log is given"):
        imutool.train([], tmp_path / "none.safetensors")


def test_a_diagnosis_of_arrays_names_them_and_no_file_that_is_gone(tmp_path: Path) -> None:
    """Arrays are a temporary log while they are diagnosed; its path stood in findings.json and on the page."""
    real = replace(imutool.example_recording(7, duration_s=10.0), name="Halle 3/links")
    other = replace(real, imu=real.imu.rows(slice(1, None)))
    found = imutool.diagnose([real, other], imutool.example_recording(7, duration_s=10.0), output=tmp_path / "found")
    assert (found.report.real, found.report.sim) == (("Halle 3_links", "Halle 3_links (2)"), "flight_7")
    written = [path.read_bytes().decode(errors="ignore") for path in sorted((tmp_path / "found").iterdir())]
    assert len(written) >= 5
    assert not [text for text in written if "/imutool-" in text]
    page = (tmp_path / "found" / "log.html").read_text(encoding="utf-8")
    assert "are not marked in Halle 3_links.mcap" not in page
    with pytest.raises(imutool.errors.DataError, match="no simulation and no true poses") as refused:
        imutool.diagnose(replace(real, truths={}))
    assert "/imutool-" not in str(refused.value)
