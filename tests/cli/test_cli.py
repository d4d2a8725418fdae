"""The command line: codes, streams, help, tables. What commands compute is tested where it is computed."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from unittest.mock import Mock

import pytest

from imutool import cli, errors, registry
from imutool.cli import terminal
from imutool.cli.demo import write_asl
from imutool.cli.terminal import epoch_line, tell_error
from imutool.cli.train import left_out_table
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight
from imutool.training.fit import Epoch

Run = Callable[..., subprocess.CompletedProcess[str]]
Code = Callable[..., int]

COMMANDS = [
    command.name or command.callback.__name__.replace("_", "-")
    for command in cli.load().registered_commands
    if command.callback
]


# ── codes ──


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (errors.ConfigError("x"), 3),
        (errors.DataError("x"), 4),
        (errors.LogError("x"), 5),
        (errors.ModelError("x"), 6),
        (errors.NumericsError("x"), 7),
        (KeyboardInterrupt(), 130),
        (PermissionError(13, "Permission denied", "there"), 3),
    ],
    ids=lambda value: type(value).__name__,
)
def test_each_kind_of_error_has_its_code(
    code: Code, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException, expected: int
) -> None:
    def opened(_: Path, **options: object) -> None:
        raise error

    import_module("imutool.log_info.inspection")  # first, or it would keep what replaces the class here
    monkeypatch.setattr("imutool.mcap_io.recovery.recovered_log.RecoveredLog", opened)
    assert code("info", "log.mcap") == expected
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ")


def test_a_bug_is_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def opened(_: Path, **options: object) -> None:
        raise ZeroDivisionError

    import_module("imutool.log_info.inspection")  # first, or it would keep what replaces the class here
    monkeypatch.setattr("imutool.mcap_io.recovery.recovered_log.RecoveredLog", opened)
    monkeypatch.setattr(sys, "argv", ["imutool", "info", "log.mcap"])
    with pytest.raises(ZeroDivisionError):  # nobody catches it: Python prints the traceback and leaves with 1
        cli.main()


@pytest.mark.parametrize("words", [["frobnicate"], ["info"], ["info", "--colour", "x"], ["train", "a.mcap"]], ids=" ".join)
def test_wrong_usage_exits_with_2(code: Code, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert code(*words) == 2
    assert "Usage: " in capsys.readouterr().err


def test_a_message_of_a_hostile_file_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    tell_error(f"model.safetensors: is no model ({'x' * 100_000}). Choose another.")
    said = capsys.readouterr().err
    assert len(said) < 2100
    assert said.startswith("error: model.safetensors: is no model (xxx")
    assert said.endswith("xxx). Choose another.\n")


def test_a_message_of_many_lines_is_whole(capsys: pytest.CaptureFixture[str]) -> None:
    """A map to complete was cut in its middle, where its gyro and its units are."""
    lines = [f'column_{k} = "imu/values[{k}]"' for k in range(200)]
    tell_error("\n".join(["table.csv: its meaning is not certain", *lines]))
    assert capsys.readouterr().err.splitlines()[1:] == lines


def test_what_several_logs_in_a_row_have_alike_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.progress("Reading", verbose=False, quiet=False):
        for log, text in zip("aabbcda", ("one is lost",) * 5 + ("two are lost",) * 2, strict=True):  # some are read twice
            terminal.logger.warning("%s: %s", log, text)
    assert capsys.readouterr().err.splitlines() == [
        "warning: a: one is lost",
        "warning: b and 1 other: the same",
        "warning: d: two are lost",
        "warning: a: the same",
    ]


def test_the_warnings_of_a_log_that_is_read_twice_are_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.progress("Reading", verbose=False, quiet=False):
        for text in ("one is lost", "two are lost") * 2:
            terminal.logger.warning("a: %s", text)
    assert capsys.readouterr().err.splitlines() == ["warning: a: one is lost", "warning: a: two are lost"]


def test_a_question_needs_no_full_stop() -> None:
    assert str(errors.ConfigError("a", fix="Did you mean b?")) == "a. Did you mean b?"
    assert str(errors.ConfigError("a", fix="Do b")) == "a. Do b."


# ── help ──


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example(code: Code, capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert code(command, "--help") == 0
    printed = capsys.readouterr().out
    assert f"Example: imutool {command} " in printed
    assert max(map(len, printed.splitlines())) <= 80


@pytest.mark.parametrize("command", ["convert", "live", "view"])
def test_help_in_a_narrow_terminal_has_whole_names(
    code: Code, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """At 40 columns --compression was --compr…"""
    monkeypatch.setenv("COLUMNS", "40")
    assert code(command, "--help") == 0
    printed = capsys.readouterr().out
    assert f"Example: imutool {command} " in printed
    assert not re.search(r"--[a-z-]*…", printed)
    assert "[/]" not in printed


@pytest.mark.parametrize(("command", "group"), [("train", "imutool.bias"), ("convert", "imutool.converters")])
def test_help_lists_what_can_be_named_with_its_summary(
    code: Code, capsys: pytest.CaptureFixture[str], command: str, group: str
) -> None:
    assert code(command, "--help") == 0
    printed = " ".join(capsys.readouterr().out.split())
    for name in registry.names(group):
        assert f"{name} {' '.join(registry.summary(group, name).split())}" in printed


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (["train", "nowhere.mcap", "-o", "m.safetensors", "--method", "neural_odd"], "neural_ode"),
        (["convert", "nowhere", "out", "--format", "eurok"], "euroc"),
        (["train", "nowhere.mcap", "-o", "m.safetensors", "--set", "step=3"], "steps"),
    ],
    ids=["method", "format", "setting"],
)
def test_a_slip_of_the_pen_is_met_with_the_nearest_name(
    code: Code, capsys: pytest.CaptureFixture[str], words: list[str], near: str
) -> None:
    assert code(*words) == 3
    assert re.search(rf"Did you mean '?{near}'?\?", capsys.readouterr().err)


# ── streams ──


@pytest.mark.parametrize(
    "words",
    [
        ["convert", "seq", "seq.mcap"],
        ["info", "{}/flight_1.mcap"],
        ["train", "short.mcap", "--method", "linear", "-o", "m.safetensors"],
        ["debias", "{}/flight_2.mcap", "out.mcap"],
        ["evaluate", "{}/flight_2.mcap", "--model", "static"],
        ["models"],
    ],
    ids=lambda words: words[0],
)
def test_json_to_stdout_is_json_alone(tmp_path: Path, logs: Path, imutool: Run, words: Sequence[str]) -> None:
    write_asl(flight(1, duration_s=1.0), tmp_path / "seq")
    write(flight(1, duration_s=13.0, rate_hz=100.0), tmp_path / "short.mcap")
    done = imutool(*(word.format(logs) for word in words), "--json", "-", "-v", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["schema"].startswith("imutool.")


def test_json_to_a_file_leaves_the_table_on_stdout(tmp_path: Path, logs: Path, imutool: Run) -> None:
    done = imutool("info", logs / "flight_1.mcap", "--json", "report.json", cwd=tmp_path)
    assert "/imu0" in done.stdout
    assert json.loads((tmp_path / "report.json").read_text())["log"] == "flight_1"
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_results_go_to_stdout_and_the_rest_to_stderr_as_much_as_is_asked_for(tmp_path: Path, imutool: Run) -> None:
    write(flight(1, duration_s=13.0, rate_hz=100.0), tmp_path / "log.mcap")
    words = ["train", "log.mcap", "--method", "linear", "-o", "m.safetensors", "--overwrite"]
    loud, quiet = (imutool(*words, option, cwd=tmp_path) for option in ("-v", "-q"))
    assert loud.stdout == quiet.stdout == "m.safetensors\n"
    assert quiet.stderr == ""
    assert re.search(r"^info: Training gyro 0/0: held out [\d.]+° \(closed form [\d.]+\)", loud.stderr, re.MULTILINE)


def test_warnings_of_a_log_are_results(tmp_path: Path, imutool: Run) -> None:
    recording = flight(1, duration_s=10.0)
    in_g = replace(recording.imu, accel=recording.imu.accel / 9.81)
    write(replace(recording, imu=in_g), tmp_path / "g.mcap")
    assert re.search(r"^warning: .*\bg\b", imutool("info", "g.mcap", "-q", cwd=tmp_path).stdout, re.MULTILINE)


@pytest.mark.parametrize(
    "words", [["info", "LOG"], ["info", "LOG", "--json", "-"], ["--help"], ["info", "--help"]], ids=" ".join
)
def test_a_reader_that_has_left_is_no_error(logs: Path, command: str, words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        line = [command, *(word.replace("LOG", str(logs / "flight_1.mcap")) for word in words)]
        done = subprocess.run(line, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_help_page_that_cannot_be_written_is_no_bug(code: Code, monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cli, "show", full)
    assert code("--help") == errors.ConfigError.exit_code


def test_a_command_without_standard_output_does_its_work(logs: Path, tmp_path: Path) -> None:
    """As a service may start it; it ended in a traceback."""
    log, out = sorted(logs.glob("*.mcap"))[0], tmp_path / "out.mcap"
    words = shlex.join([sys.executable, "-m", "imutool", "debias", str(log), str(out), "--model", "static"])
    done = subprocess.run(["sh", "-c", f"{words} >&-"], capture_output=True, text=True, check=False)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    assert out.stat().st_size > 0


def test_names_of_files_are_shown_as_they_are(tmp_path: Path, logs: Path, imutool: Run) -> None:
    odd = "a [bold]b[] \x1b[31m.mcap"
    (tmp_path / odd).write_bytes((logs / "flight_1.mcap").read_bytes())
    done = imutool("info", odd, "./gone.mcap", cwd=tmp_path)
    assert done.stderr.startswith("error: gone.mcap: ")
    done = imutool("info", odd, cwd=tmp_path)
    assert done.stdout.startswith(r"a [bold]b[] \x1b[31m.mcap: ")


@pytest.mark.parametrize(
    ("word", "usage"), [("view", "{LOG}..."), ("live", "[LOG]"), ("schema", "[NAME]"), ("convert", "{SRC} {OUT}")]
)
def test_help_names_each_argument_once_and_has_no_lines_of_the_source(
    word: str, usage: str, imutool: Run, tmp_path: Path
) -> None:
    said = imutool(word, "--help", cwd=tmp_path, env={"COLUMNS": "200", "TERM": "dumb"}).stdout
    assert f" {word} [OPTIONS] {usage}\n" in re.sub(r" +\n", "\n", said)
    assert "an .rrd is saved." in said or word != "view"  # on one line


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_an_output_that_knows_few_letters_gets_a_report_and_json_stays_utf_8(
    encoding: str, logs: Path, imutool: Run, tmp_path: Path
) -> None:
    """As Windows has it where stdout goes to a file: the root of rad/s/√Hz was a traceback."""
    log = shutil.copy(logs / "flight_1.mcap", tmp_path / "Prüflauf.mcap")
    env = {"PYTHONIOENCODING": encoding}
    done = imutool("info", log, cwd=tmp_path, apart=True, env=env, encoding=encoding)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    assert "rad/s/?Hz" in done.stdout
    words = [sys.executable, "-m", "imutool", "info", str(log), "--json", "-"]
    said = subprocess.run(words, env=os.environ | env, capture_output=True, check=True).stdout
    assert json.loads(said.decode("utf-8"))["log"] == log.stem


@pytest.mark.parametrize("words", [("repair",), ("fleet", "repair")])
def test_an_unknown_word_for_damaged_bytes_is_a_usage_error(imutool: Run, tmp_path: Path, words: tuple[str, ...]) -> None:
    done = imutool(*words, "a.mcap", "out", "--damaged", "mend", cwd=tmp_path)
    assert done.returncode == errors.UsageError.exit_code
    assert "'mend' is not one of 'drop', 'keep'" in " ".join(done.stderr.replace("│", " ").split())


def test_a_usage_error_says_how_to_give_many_logs_and_a_name_that_begins_with_a_dash(imutool: Run, tmp_path: Path) -> None:
    done = imutool("debias", "a.mcap", "b.mcap", "c.mcap", cwd=tmp_path)
    assert done.returncode == errors.UsageError.exit_code
    assert "imutool fleet debias takes many logs" in " ".join(done.stderr.replace("│", " ").split())
    (tmp_path / "-x.mcap").write_bytes(b"")
    done = imutool("info", "-x.mcap", cwd=tmp_path)
    assert "No such option: -x; the file of that name is ./-x.mcap" in " ".join(done.stderr.replace("│", " ").split())


# ── tables and progress ──


@pytest.mark.parametrize("columns", [80, 200])
def test_tables_hold_every_figure_and_no_line_is_wider_than_the_terminal(
    tmp_path: Path, logs: Path, imutool: Run, columns: int
) -> None:
    words = ["evaluate", logs / "flight_2.mcap", "--model", "static", "--model", logs / "linear.safetensors", "--aligned"]
    env = {"COLUMNS": str(columns), "TTY_COMPATIBLE": "1", "NO_COLOR": "1", "TERM": "xterm"}
    done = imutool(*words, "--json", "out.json", "-q", cwd=tmp_path, env=env)
    shown = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)
    assert max(map(len, shown.splitlines())) <= columns
    cells = set(shown.split())
    results = json.loads((tmp_path / "out.json").read_text())["results"]
    for one in results:
        names = ("aoe_deg", "aoe_aligned_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s")
        figures = [one[name] for name in names] + [*one["roe_deg"].values(), *one["rpe_m"].values()]
        assert {f"{figure:.2f}" for figure in figures if figure is not None} <= cells
        assert {one["log"], one["model"]} <= cells


def test_python_runs_the_package_as_the_command() -> None:
    said = subprocess.run([sys.executable, "-m", "imutool", "--version"], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["imutool", version("imutool")]


def test_a_table_too_wide_goes_on_below_with_its_keys(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal, "out", type(terminal.out)(width=30))  # it asks for COLUMNS once, when it is made
    terminal.table([("log", "aaaaaaaa", "bbbbbbbb", "cccccccc", "dddddddd"), ("x" * 8, *"1234")], keys=1)
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip() and "─" not in line]
    assert lines == [["log", "aaaaaaaa", "bbbbbbbb"], ["x" * 8, "1", "2"], ["log", "cccccccc", "dddddddd"], ["x" * 8, "3", "4"]]


def test_a_row_whose_value_is_folded_begins_in_its_first_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The topic and the property stood next to the last line of the value."""
    monkeypatch.setattr(terminal, "out", type(terminal.out)(width=30, force_terminal=True, no_color=True, highlight=False))
    terminal.table([("topic", "value"), ("/imu0", "cannot be judged: the log has no poses")], keys=1)
    shown = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert shown[2].split() == ["/imu0", "cannot", "be", "judged:", "the"]
    assert shown[3].split() == ["log", "has", "no", "poses"]


def test_without_a_terminal_stderr_has_no_empty_line_of_the_progress(logs: Path, imutool: Run, tmp_path: Path) -> None:
    done = imutool("debias", logs / "flight_2.mcap", "out.mcap", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_without_a_terminal_a_line_of_progress_comes_each_minute(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cluster's log had nothing for hours, as of a run that hangs."""
    clock = iter([0.0, 59.0, 60.0, 61.0, 119.0, 121.0])
    monkeypatch.setattr(terminal, "time", Mock(monotonic=lambda: next(clock, 121.0)))
    with terminal.progress("Fleet info", verbose=False, quiet=False) as tell:
        for done in range(1, 5):
            tell(done, 8, f"{done} of 8 done")
    assert capsys.readouterr().err == "Fleet info: 25 %, 2 of 8 done\nFleet info: 50 %, 4 of 8 done\n"
    monkeypatch.setattr(terminal, "time", Mock(monotonic=lambda: 1e6))
    with terminal.progress("Fleet info", verbose=False, quiet=True) as tell:
        tell(1, 8, "1 of 8 done")
    assert capsys.readouterr().err == ""


def test_a_verbose_line_of_progress_is_not_repeated_while_nothing_changes(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.progress("Fleet", verbose=True, quiet=False) as tell:
        for done, word in ((1, "1 of 2 done"), (1, "1 of 2 done"), (1, ""), (2, "2 of 2 done")):
            tell(done, 2, word)
    assert [line.split("Fleet ")[1] for line in capsys.readouterr().err.splitlines()] == ["1 of 2 done", "2 of 2 done"]


def test_nothing_is_folded_where_nobody_looks_at_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    terminal.table([("log", "figure"), ("x" * 70, "y" * 70)], keys=1)
    assert f"{'x' * 70}  {'y' * 70}" in capsys.readouterr().out


def test_a_table_without_a_figure_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("aoe_deg", "aoe_aligned_deg", "ape_m", "ape_aligned_m", "velocity_rmse_m_s")
    turned = dict.fromkeys(names) | {"log": "flight", "model": "raw", "aoe_deg": 2.5, "drift_window_s": 5.0}
    terminal.figures([turned | {"roe_deg": {"5": None}, "rpe_m": {"5": None}}])
    assert "2.50" in (shown := capsys.readouterr().out)
    assert "ROE" not in shown
    assert "expected" not in shown
    terminal.figures([turned | {"roe_deg": {"5": 0.25}, "rpe_m": {"5": None}}])
    assert "ROE" in (shown := capsys.readouterr().out)
    assert "RPE" not in shown


def test_the_mean_of_left_out_logs_is_that_of_the_logs_that_have_a_figure(capsys: pytest.CaptureFixture[str]) -> None:
    score = {"log": "short", "model": "raw", "start": "", "aoe_deg": 1.0, "drift_m_s": None, "drift_deg": None}
    scores = [score, score | {"log": "a", "drift_deg": 2.0}, score | {"log": "b", "drift_deg": 3.0}]
    scores += [each | {"model": "linear", "start": "truth"} for each in scores[:2]]
    left_out_table({"scores": scores, "parts": False, "kept": {"gyro": "linear"}})
    assert re.search(r"mean +after 5 s +2\.50 +–", capsys.readouterr().out)


def test_progress_tells_loss_held_out_error_and_time_left() -> None:
    epoch = Epoch("gyro", step=40, steps=120, loss=0.25, held_out=0.0174533, before=0.00872665, left_s=83.2)
    assert epoch_line(epoch) == (40, 120, "gyro 40/120: loss 0.250, held out 1.000° (closed form 0.500), 1:23 left")
    done, total, text = epoch_line(Epoch("accel", 0, 0, float("nan"), 0.5, 0.5, 0.0))
    assert (done, total, text) == (0, 1, "accel 0/0: held out 0.500 m/s (closed form 0.500)")


def test_threads_that_wait_do_not_spin(code: Code, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert code("--version") == 0
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"


def test_the_commands_of_the_contract_are_there() -> None:
    assert {"convert", "info", "train", "debias", "evaluate", "view", "models", "demo"} <= set(COMMANDS)
