"""No output of any command destroys anything: the cases are made from the commands themselves, so no option escapes them.

Inputs that are refused as junk or not at all there show that an output is refused before any work.
"""

from __future__ import annotations

import inspect
import os
import re
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

from imutool import cli
from imutool.cli.app import Written, caught, written
from imutool.errors import ConfigError
from imutool.mcap_io.storage.output_conflicts import OutputFile, check_outputs

Refused = Callable[..., str]
MAGIC = b"\x89MCAP0\r\n"

USAGE, CONFIG, LOG = 2, 3, 5

# words without which a command does not get as far as its outputs; in.mcap is junk where it exists
NEEDS = {
    "convert": ["in.mcap", "out.mcap"],
    "info": ["in.mcap"],
    "repair": ["in.mcap", "out.mcap"],
    "train": ["in.mcap", "-o", "out.safetensors"],
    "debias": ["in.mcap", "out.mcap"],
    "clean": ["in.mcap", "out.mcap"],
    "evaluate": ["in.mcap"],
    "vio": ["in.mcap"],
    "view": ["in.mcap", "--html", "out.html"],
    "live": ["--from", "in.mcap"],
    "simulate": ["in.mcap", "out.mcap"],
    "diagnose": ["in.mcap"],
    "audit": ["in.mcap"],
    "conceal": ["--open", "in.mcap"],
    "export": ["in.mcap", "out", "--format", "euroc"],
    "models": [],
    "demo": ["-o", "out"],
    "fleet debias": ["in.mcap", "out"],
    "fleet repair": ["in.mcap", "out"],
    "fleet info": ["in.mcap", "out"],
    "fleet diagnose": ["in.mcap", "out"],
    "fleet view": ["in.mcap"],
}
ALSO = {"noise_plot": ["--noise"], "noise_toml": ["--noise"]}  # words that an option needs
SILENT = {"schema", "new-converter"}  # one prints on stdout, the other makes a new folder or refuses

# parameters that name inputs or are words; whoever adds a parameter that names an output marks it with `Written`
READ = {
    "source",
    "log",
    "logs",
    "places",
    "trajectory",
    "reals",
    "sim",
    "physics",
    "config",
    "findings",
    "model",
    "noise",
    "map_",
    "real",
    "metric",
    "folders",
}
WORDS = {
    *("format", "sequence", "compression", "imu", "truth", "rule", "no_rule", "init", "verify", "connect", "method", "set_"),
    *("sensor", "device", "align", "at", "signal", "kind", "size", "damaged", "name", "address", "memory", "robot_from"),
    *("encoding", "by", "aid"),
}


def commands() -> Iterator[tuple[str, Any]]:
    """Every command by its words, also those of groups."""
    for name, command in typer.main.get_command(cli.load()).commands.items():  # type: ignore[attr-defined]
        inner = getattr(command, "commands", None)
        yield from [(name, command)] if inner is None else ((f"{name} {word}", below) for word, below in inner.items())


COMMANDS = dict(commands())
MARKS = {name: written(command.function) for name, command in COMMANDS.items()}
OUTPUTS = [(name, parameter) for name, marks in MARKS.items() for parameter in marks]
FILES = [(name, parameter) for name, parameter in OUTPUTS if MARKS[name][parameter].files is None]
FOLDERS = [(name, parameter) for name, parameter in OUTPUTS if MARKS[name][parameter].files is not None]


def line(command: str, parameter: str, value: str | Path) -> list[str]:
    """A command line in which an output has this value, and every other one what it needs."""
    found = next(p for p in COMMANDS[command].params if p.name == parameter)
    words = list(NEEDS[command])
    if found.param_type_name == "argument":
        words[1] = str(value)
    else:
        flag = max(found.opts, key=len)
        for short in found.opts:
            if short in words:
                del words[words.index(short) : words.index(short) + 2]
        words += [*ALSO.get(parameter, []), flag, str(value)]
    return words


def name_for(command: str, parameter: str, stem: str = "existing") -> str:
    """A name that fits what is written."""
    suffixes = MARKS[command][parameter].suffixes
    return f"{stem}{suffixes[0]}" if suffixes else stem


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): (path.stat().st_ino, path.read_bytes()) for path in files}


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Runs a command in `tmp_path` that must refuse with this code; its message, when nothing has changed."""
    monkeypatch.chdir(tmp_path)

    def run(code: int, command: str, *words: str) -> str:
        before = snapshot(tmp_path)
        with pytest.raises(SystemExit) as leaving, caught():
            COMMANDS[command].main([*words, "-q"], prog_name="imutool", standalone_mode=False)
        said = " ".join(capsys.readouterr().err.split())
        assert leaving.value.code == code, said
        assert snapshot(tmp_path) == before
        return said

    return run


def test_every_command_is_tried() -> None:
    assert set(NEEDS) == set(COMMANDS) - SILENT
    assert {(command, parameter) for command, parameter in OUTPUTS} >= {
        *((name, "json_to") for name in NEEDS),
        *(("view", option) for option in ("save", "export_web", "png", "html")),
        *(("debias", option) for option in ("target", "save_view", "report_to")),
        *(("info", option) for option in ("noise_plot", "noise_toml")),
    }


@pytest.mark.parametrize("command", COMMANDS)
def test_every_parameter_with_a_name_of_a_file_is_an_output_an_input_or_a_word(command: str) -> None:
    parameters = inspect.signature(COMMANDS[command].function, eval_str=True).parameters
    texts = {
        name
        for name, parameter in parameters.items()
        if not {bool, int, float} & {get_args(parameter.annotation)[0], *get_args(get_args(parameter.annotation)[0])}
    }
    new = {"folder"} if command == "new-converter" else set()
    assert texts - set(MARKS[command]) - READ - WORDS - new == set(), "mark an output with `Written`, or list it here"


@pytest.mark.parametrize("command", sorted({name for name, _ in OUTPUTS}))
def test_every_command_with_an_output_has_overwrite(command: str) -> None:
    assert "overwrite" in {parameter.name for parameter in COMMANDS[command].params}


@pytest.mark.parametrize(("command", "parameter"), FILES)
def test_an_existing_file_is_refused_before_any_work(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    name = name_for(command, parameter)
    (tmp_path / name).write_text("precious")
    said = refused(CONFIG, command, *line(command, parameter, name))
    assert f"{name}: the target exists" in said
    assert "--overwrite" in said


@pytest.mark.parametrize(("command", "parameter"), FILES)
def test_a_link_to_nothing_is_refused_too(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    name = name_for(command, parameter)
    (tmp_path / name).symlink_to("nowhere")
    if (command, parameter) not in KEEPING:
        assert "the target exists" in refused(CONFIG, command, *line(command, parameter, name))
        assert (tmp_path / name).is_symlink()


KEEPING = [(name, parameter) for name, parameter in FILES if MARKS[name][parameter].keeps]


@pytest.mark.parametrize("how", ["itself", "hard link", "link", "spelling", "link of a folder"])
@pytest.mark.parametrize(("command", "parameter"), [case for case in FILES if "in.mcap" in NEEDS[case[0]]])
def test_an_input_is_refused_with_overwrite_too(
    refused: Refused, tmp_path: Path, command: str, parameter: str, how: str
) -> None:
    source, name = tmp_path / "in.mcap", name_for(command, parameter, "other")
    source.write_bytes(b"junk")
    if how == "itself":  # an input whose suffix is that of the output
        words = [name if word == "in.mcap" else word for word in line(command, parameter, name)]
        source.rename(tmp_path / name)
    elif how == "hard link":
        os.link(source, tmp_path / name)
        words = line(command, parameter, name)
    elif how == "link":
        (tmp_path / name).symlink_to("in.mcap")
        words = line(command, parameter, name)
    elif how == "spelling":
        (tmp_path / "sub").mkdir()
        source.rename(tmp_path / name)
        words = [f"sub/../{name}" if word == "in.mcap" else word for word in line(command, parameter, f"./{name}")]
    else:
        (tmp_path / "again").symlink_to(tmp_path)
        source.rename(tmp_path / name)
        words = [name if word == "in.mcap" else word for word in line(command, parameter, f"again/{name}")]
    said = refused(CONFIG, command, *words, "--overwrite")
    assert "would replace the source" in said


@pytest.mark.parametrize(("command", "parameter"), [case for case in FILES if MARKS[case[0]][case[1]].suffixes])
def test_a_suffix_that_does_not_fit_is_refused(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    suffixes = MARKS[command][parameter].suffixes
    said = refused(USAGE, command, *line(command, parameter, "wrong.txt"))
    assert "wrong.txt: " in said
    assert re.search(rf"expected .*{re.escape(suffixes[0])}", said)


@pytest.mark.parametrize(("command", "parameter"), FILES)
def test_a_file_that_is_named_as_a_folder_is_refused(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    """`debias LOG new/` and `view LOG --html new/` wrote a file `new`."""
    said = refused(USAGE, command, *line(command, parameter, "new/"))
    assert "new/: ends in a slash, as the name of a folder; expected the name of a file. Write the file's own name" in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("command", "parameter"), [case for case in OUTPUTS if case[1] != "json_to" and case[0] != "convert"])
def test_a_stream_is_refused_where_a_file_is_written(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    """`view LOG --html -` wrote a file `-`; of --json, - is stdout; `convert` looks at its source first."""
    assert "-: is a stream" in refused(CONFIG, command, *line(command, parameter, "-"))
    assert not (tmp_path / "-").exists()


PAIRS = [
    (name, first, second)
    for name, first in FILES
    for other, second in FILES
    if name == other and first < second and set(MARKS[name][first].suffixes) & set(MARKS[name][second].suffixes)
]


def test_two_outputs_of_a_command_that_are_one_file_are_refused(refused: Refused, tmp_path: Path) -> None:
    assert PAIRS == [], "no two outputs of a command take one suffix; where they do, try them here"
    said = refused(CONFIG, "view", "in.mcap", "--html", "w/index.html", "--export-web", "w")
    assert "--export-web and --html are the same file" in said
    (tmp_path / "link").symlink_to(tmp_path)
    (tmp_path / "a.mcap").touch()
    os.link(tmp_path / "a.mcap", tmp_path / "b.mcap")
    for first, second in (("a.mcap", "b.mcap"), ("new.mcap", "link/new.mcap"), ("new.mcap", "./link/./new.mcap")):
        with pytest.raises(ConfigError, match="are the same file"):
            check_outputs([OutputFile("one", first), OutputFile("two", second)], overwrite=True)
    check_outputs([OutputFile("one", "new.mcap"), OutputFile("two", "New.mcap")])  # this folder tells them apart


@pytest.mark.parametrize(("command", "parameter"), FOLDERS)
def test_a_folder_that_is_a_file_is_refused(refused: Refused, tmp_path: Path, command: str, parameter: str) -> None:
    if command in ("convert",):  # OUT of one sequence is a file
        return
    (tmp_path / "existing").write_text("precious")
    refused(CONFIG, command, *line(command, parameter, "existing"), "--overwrite")


@pytest.mark.parametrize(
    ("command", "option", "name"), [("view", "--png", "a_b-errors.png"), ("evaluate", "--trajectories", "a_b_raw.tum")]
)
def test_a_file_about_a_log_in_a_folder_of_others_is_refused_before_any_work(
    refused: Refused, tmp_path: Path, command: str, option: str, name: str
) -> None:
    """The log is junk, which is not even looked at; files about other logs stay next to the new ones."""
    (tmp_path / "in.mcap").write_bytes(b"junk")
    (tmp_path / "a b.mcap").write_bytes(b"junk")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / f"other{name}").touch()
    assert "MCAP log" in refused(LOG, command, "a b.mcap", option, "out")
    (tmp_path / "out" / name).write_text("precious")
    assert f"out/{name}: the target exists" in refused(CONFIG, command, "in.mcap", "a b.mcap", option, "out")


@pytest.mark.parametrize(("command", "parameter"), [("models", "json_to"), ("info", "json_to")])
@pytest.mark.parametrize("where", ["/dev/null", "fifo", "/dev/stdout"])
def test_a_device_or_a_pipe_is_written_to_and_never_replaced(
    command: str, parameter: str, where: str, tmp_path: Path, logs: Path
) -> None:
    words = [*command.split(), *line(command, parameter, where), "-q"]
    words = [str(logs / "flight_1.mcap") if word == "in.mcap" else word for word in words]
    got: list[str] = []
    if where == "fifo":
        os.mkfifo(tmp_path / "fifo")
        reader = threading.Thread(target=lambda: got.append((tmp_path / "fifo").read_text()))
        reader.start()
    executable = Path(typer.__file__).parents[4] / "bin" / "imutool"
    done = subprocess.run([executable, *words], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    if where == "fifo":
        reader.join(10.0)
        assert stat.S_ISFIFO((tmp_path / "fifo").stat().st_mode)
    elif where == "/dev/stdout":
        got.append(done.stdout)
    if got:
        assert "imutool." in got[0]
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    assert sorted(path.name for path in tmp_path.iterdir()) == (["fifo"] if where == "fifo" else [])


def test_an_output_has_stdout_for_itself(logs: Path) -> None:
    """The summary stood behind the log, which then ended in bytes that are no record."""
    executable = Path(typer.__file__).parents[4] / "bin" / "imutool"
    repair = [executable, "repair", logs / "flight_1.mcap", "/dev/stdout"]
    done = subprocess.run(repair, capture_output=True, timeout=120, check=False)
    assert (done.returncode, done.stdout[:8], done.stdout[-8:]) == (0, MAGIC, MAGIC)
    assert b"/dev/stdout: " in done.stderr
    done = subprocess.run([*repair, "--json", "-"], capture_output=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (CONFIG, b"")
    assert b"both go to stdout" in done.stderr


def test_samples_and_a_report_are_not_mixed(refused: Refused) -> None:
    said = refused(CONFIG, "live", "--from", "in.mcap", "--no-view", "--print", "--json", "-")
    assert "--print and --json - both go to stdout" in said


def test_a_mark_is_found_in_an_annotation() -> None:
    assert MARKS["train"]["model"] == Written((".safetensors",))
    assert MARKS["view"]["save"].may_be_folder
