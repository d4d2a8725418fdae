"""Parameters as flags: the library says `init`, the command line --init."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from support.loaded import loaded_by_command

from imutool import cli
from imutool.cli import overview
from imutool.cli.parameters import error_with_flags, flags, instead_of, with_flags
from imutool.errors import ConfigError
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

Run = Callable[..., subprocess.CompletedProcess[str]]
COMMANDS = typer.main.get_command(cli.load()).commands  # type: ignore[attr-defined]


def test_the_page_of_help_lists_every_command_with_its_own_words(capsys: pytest.CaptureFixture[str]) -> None:
    own = {name: (command.help or "").splitlines()[0] for name, command in COMMANDS.items()}
    assert {name: text for name, (_, text) in overview.COMMANDS.items()} == own
    homes = {c.callback.__module__: c.name for c in cli.load().registered_commands if c.callback is not None}
    assert {f"imutool.cli.{module}" for module in overview.MODULES} == homes.keys() | {"imutool.cli.fleet_view"}
    overview.show()
    shown = capsys.readouterr().out
    assert all(name in shown for name in own)


def test_every_command_prints_more_or_less_as_it_is_asked_to() -> None:
    own = {name: {p.name for p in command.params} for name, command in COMMANDS.items() if name != "fleet"}
    assert [name for name, names in own.items() if not {"verbose", "quiet"} <= names] == []


@pytest.mark.parametrize(
    ("command", "typed", "answer"),
    [
        ("diagnose", "--html", ["--output"]),
        ("evaluate", "--html", ["--report"]),
        ("view", "--report", ["--html", "--png"]),
        ("debias", "-o", ["OUT as a word without a flag"]),
        ("convert", "--force", ["--overwrite"]),
        ("debias", "--overwite", ["--overwrite"]),
        ("info", "--html", []),
    ],
)
def test_an_option_of_another_command_is_answered_with_this_ones(command: str, typed: str, answer: list[str]) -> None:
    assert instead_of(typed, COMMANDS[command]) == answer


def test_a_wrong_option_is_told_with_what_serves_its_purpose(tmp_path: Path, imutool: Run) -> None:
    done = imutool("repair", "in.mcap", "-o", "out.mcap", cwd=tmp_path)
    assert (
        done.returncode,
        "OUT as a word without a flag" in done.stderr.replace("│", " ").replace("\n", " ").replace("  ", " "),
    ) == (2, True)


@pytest.mark.parametrize("words", ["convert  out/", "fleet info  out", "debias in out.mcap --model ", "view in.mcap --png "])
def test_an_empty_word_is_no_path_and_no_model(words: str, tmp_path: Path, imutool: Run) -> None:
    """ "$LOGS", which was not set, was the folder one stood in; with "$MODEL" a log was debiased by another model."""
    done = imutool(*words.split(" "), cwd=tmp_path)
    assert (done.returncode, "an empty word" in done.stderr, list(tmp_path.iterdir())) == (2, True, [])


def test_help_and_a_command_import_what_they_need() -> None:
    seen = {"numpy", "typer", "scipy", "pydantic", "imutool.cli.train", "rich.progress"}
    assert loaded_by_command(["--help"], seen) == []
    assert loaded_by_command(["debias", "missing.mcap", "out.mcap", "-q"], seen) == ["numpy", "typer"]


def test_debias_of_a_log_with_poses_does_without_what_takes_long_to_import(tmp_path: Path) -> None:
    write(flight(2, duration_s=40.0), tmp_path / "flight.mcap")  # so long that steps of the poses' clock are looked for
    words = ["debias", tmp_path / "flight.mcap", tmp_path / "out.mcap", "-q", "--force", "--model", "euroc-adis16448-linear"]
    assert loaded_by_command(words, {"scipy", "torch", "jaxtyping", "asyncio", "importlib.metadata", "numpy.ma"}) == []
    assert (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("words", "module"),
    [
        ("repair LOG OUT", "scipy"),
        ("clean LOG OUT", "scipy"),
        ("view LOG --html OUT", "rerun"),
        ("fleet info LOG OUT", "scipy"),
        ("simulate LOG OUT", "scipy.signal"),
    ],
)
def test_a_command_needs_no_pydantic_and_no_more_than_it_computes(tmp_path: Path, words: str, module: str) -> None:
    write(flight(2, duration_s=20.0), tmp_path / "LOG")
    assert loaded_by_command(words.split(), {module, "pydantic"}, tmp_path) == []
    assert (tmp_path / "OUT").exists()


def test_a_log_without_poses_does_without_masked_arrays(tmp_path: Path) -> None:
    write(replace(flight(2, duration_s=10.0), truths={}), tmp_path / "imu.mcap")
    assert loaded_by_command(["info", tmp_path / "imu.mcap"], {"numpy.ma"}) == []
    assert loaded_by_command(["clean", tmp_path / "imu.mcap"], {"numpy.ma"}) == []


def test_an_argument_goes_by_its_word_and_an_option_by_its_long_flag() -> None:
    known = flags(COMMANDS["debias"])
    assert (known["init"], known["models"], known["out"], known["source"]) == ("--init", "--model", "OUT", "IN")
    assert flags(COMMANDS["train"])["set"] == "--set"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Give `model`", "Give --model"),
        ("Give `init=prior`", "Give --init prior"),
        ('Give `init="prior"`', "Give --init prior"),
        ("Add `smooth=True`", "Add --smooth"),
        ("Run `imutool clean LOG` or `rerun`", "Run `imutool clean LOG` or `rerun`"),
    ],
)
def test_a_parameter_in_backquotes_is_shown_as_its_flag(text: str, shown: str) -> None:
    assert with_flags(text, flags(COMMANDS["debias"])) == shown


def test_leaving_out_is_a_flag_of_its_own() -> None:
    assert with_flags("Leave images out with `images=False`", flags(COMMANDS["convert"])) == "Leave images out with --no-images"


@pytest.mark.parametrize(
    ("where", "shown"), [("init", "--init"), ("model, imu", "--model, --imu"), ("data.csv:17", "data.csv:17"), ("logs", "logs")]
)
def test_a_place_is_a_parameter_only_if_the_command_has_it(where: str, shown: str) -> None:
    assert error_with_flags(ConfigError("x", where=where), flags(COMMANDS["debias"])).where == shown


def test_a_method_and_a_setting_go_by_the_option_that_gave_them() -> None:
    flag_of = flags(COMMANDS["train"])
    assert error_with_flags(ConfigError("'liner' is not known", where="bias"), flag_of).where == "--method"
    assert error_with_flags(ConfigError("stps is not a setting", where="settings"), flag_of).where == "--set"
    assert error_with_flags(ConfigError("is 'x'", where="settings: model.loads"), flag_of).where == "--set: model.loads"


@pytest.mark.parametrize(("verb", "name"), [("debias", "init"), ("evaluate", "html"), ("info", "json")])
def test_a_file_that_is_called_like_a_parameter_stays_a_file(verb: str, name: str, imutool: Run, tmp_path: Path) -> None:
    line = [verb, name, *(["out.mcap"] if verb == "debias" else [])]
    assert imutool(*line, cwd=tmp_path).stderr.lstrip().startswith(f"error: {name}: cannot be opened")


def test_an_error_names_the_parameter_in_python_and_the_flag_on_the_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    error = ConfigError("'x'", where="init", expected="auto or six numbers", fix="Give `init=prior` with a trained `model`")

    def debias(*_: object, **__: object) -> None:
        raise error

    assert str(error) == "init: 'x'; expected auto or six numbers. Give `init=prior` with a trained `model`."
    monkeypatch.setattr("imutool.debiasing.debias", debias)
    monkeypatch.setattr(sys, "argv", ["imutool", "debias", "a.mcap", str(tmp_path / "b.mcap"), "--init", "x"])
    with pytest.raises(SystemExit):
        cli.main()
    printed = capsys.readouterr().err
    assert printed.lstrip() == "error: --init: 'x'; expected auto or six numbers. Give --init prior with a trained --model.\n"


def test_a_help_names_values_and_no_types_of_python(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        COMMANDS["clean"].main(["--help"], "imutool clean")
    shown = dict(re.findall(r"(--(?:imu|init|smooth|report))  +(\S+)", capsys.readouterr().out))
    assert shown == {"--imu": "TOPIC", "--init": "INIT", "--smooth": "Use", "--report": "F.html"}
