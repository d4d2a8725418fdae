"""Bad input through the installed command: a sentence or two, the exit code, nothing half-written, no input changed."""

from __future__ import annotations

import errno
import gzip
import json
import lzma
import os
import re
import resource
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard
from mcap_ros2.writer import Writer
from support.digests import digests

from fuzz import bounded
from fuzz.numbers import put_log
from imutool.bias import model_file
from imutool.cli.demo import write_asl
from imutool.errors import ConfigError, ModelError
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.log import Log
from imutool.mcap_io.storage.target import Target
from imutool.mcap_io.write import write
from imutool.sensor.made_up_flight import flight

Run = Callable[..., subprocess.CompletedProcess[str]]
Refuse = Callable[..., str]

CONFIG, DATA, LOG, MODEL, INTERRUPTED = 3, 4, 5, 6, 130
LOST = 3  # something of a log is
DISK_BYTES = 200_000  # less than any log here, more than any message
WAIT_S = 120.0  # for the middle of a run, on a machine busy with other things
TRIES = 20  # the middle may pass between two looks
QUICK_S = 13.0  # of the flight that is trained on
QUICK_SETTINGS = ("steps=40", "model.loads=[]", "samples=400", "gyro_window_s=[0.5]", "accel_window_s=[0.5]")
QUICK = ["--method", "neural_ode", *(word for setting in QUICK_SETTINGS for word in ("--set", setting))]


def told(done: subprocess.CompletedProcess[str] | subprocess.Popen[str], stderr: str, code: int) -> str:
    """The message, once it is seen to be one or two sentences and the exit code the right one."""
    assert done.returncode == code, stderr
    assert "Traceback" not in stderr
    lines = stderr.strip().splitlines()
    assert len(lines) == 1, stderr
    message = lines[0].removeprefix("error: ")
    assert message != lines[0]
    assert 1 <= len(re.findall(r"[.?](?=\s|$)", message)) <= 2, message
    return message


@pytest.fixture
def refuse(imutool: Run, tmp_path: Path) -> Refuse:
    """Runs a command that must refuse: returns its message, having seen that no file came, went or changed."""

    def run(code: int, *words: str | Path, **options: Any) -> str:
        before = digests(tmp_path)
        done = imutool(*words, "-q", cwd=tmp_path, **options)
        assert done.stdout == ""
        assert digests(tmp_path) == before
        return told(done, done.stderr, code)

    return run


@pytest.fixture
def here(tmp_path: Path, logs: Path) -> Path:
    """The folder the command runs in, with copies of the logs and the model."""
    for file in logs.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


# ── logs ──


@pytest.mark.parametrize(
    "words",
    [["info", "bad.mcap"], ["debias", "bad.mcap", "out.mcap"], ["train", "bad.mcap", "-o", "m.safetensors"]],
    ids=lambda words: words[0],
)
def test_an_empty_file_is_no_log(tmp_path: Path, refuse: Refuse, words: Sequence[str]) -> None:
    (tmp_path / "bad.mcap").touch()
    message = refuse(LOG, *words)
    assert message.startswith("bad.mcap: ")
    assert "empty" in message


def test_a_text_file_named_mcap_is_no_log(tmp_path: Path, refuse: Refuse) -> None:
    (tmp_path / "notes.mcap").write_text("these are notes, not a log\n" * 9)
    assert "notes.mcap" in refuse(LOG, "info", "notes.mcap")


@pytest.mark.parametrize("share", [0.4, 0.8])
@pytest.mark.parametrize(
    "words", [["train", "cut.mcap", "-o", "m.safetensors"], ["evaluate", "cut.mcap"]], ids=lambda words: words[0]
)
def test_what_needs_a_whole_log_says_where_it_is_cut_short(
    here: Path, refuse: Refuse, share: float, words: Sequence[str]
) -> None:
    whole = (here / "flight_2.mcap").read_bytes()
    (here / "cut.mcap").write_bytes(whole[: int(share * len(whole))])
    message = refuse(LOG, *words)
    assert message.startswith("cut.mcap: ")
    assert re.search(r"cut short at byte \d+.*imutool repair", message)


def test_a_log_cut_before_its_first_record_holds_nothing(here: Path, refuse: Refuse) -> None:
    (here / "cut.mcap").write_bytes((here / "flight_2.mcap").read_bytes()[:8])
    for words in (["info", "cut.mcap"], ["repair", "cut.mcap", "out.mcap"], ["debias", "cut.mcap", "out.mcap"]):
        assert "no record" in refuse(LOG, *words)


@pytest.mark.parametrize("damage", ["cut short", "in a chunk"])
def test_of_a_damaged_log_the_sound_part_is_described_debiased_and_saved(here: Path, imutool: Run, damage: str) -> None:
    content = bytearray((here / "flight_2.mcap").read_bytes())
    with Log(here / "flight_2.mcap") as log:
        blocks = [b for b in log.index.blocks if b.may_hold(log.channel_ids("/imu0"))]
    if damage == "cut short":
        del content[blocks[-1].offset + 100 :]
    else:
        content[blocks[-1].offset + blocks[-1].length // 2] ^= 0xFF
    (here / "bad.mcap").write_bytes(content)
    before = digests(here)
    info = imutool("info", "bad.mcap", "--json", "-", cwd=here)
    debias = imutool("debias", "bad.mcap", "out.mcap", "--model", "linear.safetensors", "--json", "-", cwd=here)
    repair = imutool("repair", "bad.mcap", "saved.mcap", "--json", "-", cwd=here)
    reports = []
    for done in (info, debias, repair):
        assert done.returncode == LOST, done.stderr
        reports.append(json.loads(done.stdout))
    stretches = [[s["offset"] for s in report["losses"]["stretches"]] for report in reports]
    assert stretches[0] == stretches[1] == stretches[2]
    assert blocks[-1].offset in stretches[0]
    counts = {topic["name"]: topic["count"] for topic in reports[0]["topics"]}
    assert counts == {**dict.fromkeys(counts, 0), **reports[2]["messages"]}
    assert reports[1]["added"]["/imu0/debiased"] == counts["/imu0"] < 4001
    assert {name: digest for name, digest in digests(here).items() if name not in ("out.mcap", "saved.mcap")} == before
    other = imutool("debias", "bad.mcap", "other.mcap", "--imu", "/imu9", cwd=here)
    assert told(other, other.stderr, LOG).startswith("bad.mcap: there is no topic /imu9")
    in_place = imutool("debias", "bad.mcap", "--in-place", "--model", "linear.safetensors", cwd=here)
    assert "damaged" in told(in_place, in_place.stderr, LOG)


def test_a_log_that_is_not_there_is_a_matter_of_the_command_line(tmp_path: Path, refuse: Refuse) -> None:
    assert refuse(CONFIG, "info", "data/nowhere.mcap").startswith("data/nowhere.mcap: ")


@pytest.fixture
def talk(tmp_path: Path) -> str:
    """A log of words."""
    with (tmp_path / "talk.mcap").open("wb") as file, Writer(file) as writer:
        text = writer.register_msgdef("std_msgs/msg/String", "string data\n")
        writer.write_message("/chatter", text, {"data": "hello"}, log_time=1, publish_time=1)
    return "talk.mcap"


def test_a_log_without_imu_is_refused_with_its_topics(refuse: Refuse, talk: str) -> None:
    message = refuse(LOG, "debias", talk, "out.mcap")
    assert message.startswith(talk)
    assert "IMU" in message
    for words in (["evaluate"], ["export", "out", "--format", "euroc"], ["live", "--no-view"]):
        assert "/chatter" in refuse(LOG, words[0], talk, *words[1:])


def test_a_log_without_imu_is_described_with_a_warning(tmp_path: Path, imutool: Run, talk: str) -> None:
    done = imutool("info", talk, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "/chatter" in done.stdout
    assert re.search(r"warning: .*IMU", done.stdout)


def imu_log(path: Path, stamps_ns: Sequence[int], odd: Mapping[int, float] | None = None) -> None:
    """A log by a foreign writer, at rest; `odd` puts a value in place of the x rate of some messages."""
    with path.open("wb") as file, Writer(file) as writer:
        definition = writer.register_msgdef("sensor_msgs/msg/Imu", schemas.definition(schemas.IMU))
        for row, stamp in enumerate(stamps_ns):
            rate = {"x": (odd or {}).get(row, 0.01), "y": 0.02, "z": 0.03}
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "imu"}
            covariance = [0.0] * 9
            message = {
                "header": header,
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                "orientation_covariance": covariance,
                "angular_velocity": rate,
                "angular_velocity_covariance": covariance,
                "linear_acceleration": {"x": 0.0, "y": 0.0, "z": 9.81},
                "linear_acceleration_covariance": covariance,
            }
            time_ns = stamps_ns[0] + row
            writer.write_message("/imu", definition, message, log_time=time_ns, publish_time=time_ns)


STAMPS = [1_700_000_000_000_000_000 + 5_000_000 * k for k in range(800)]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_no_number_is_left_out(tmp_path: Path, imutool: Run, value: float) -> None:
    imu_log(tmp_path / "nan.mcap", STAMPS, odd={500: value})
    done = imutool("debias", "nan.mcap", "out.mcap", cwd=tmp_path)
    assert done.returncode == 3
    assert "1 samples are no measurement and left out (1 not finite)" in done.stderr
    assert "799 on /imu/debiased" in done.stdout


ODD = {"zero": 0.0, "huge": 1e30, "denormal": 5e-324, "not a number": np.nan, "infinite": np.inf}
TAKING_SAMPLES: tuple[tuple[str, ...], ...] = (
    ("audit", "odd.mcap", "--json", "-"),
    ("evaluate", "odd.mcap", "--json", "-"),
    ("live", "--from", "odd.mcap", "--speed", "1e9", "--no-view", "--json", "-"),
    ("view", "odd.mcap", "--html", "out.html"),
)  # train: tests/fuzz/numbers.py


@pytest.mark.parametrize("words", TAKING_SAMPLES, ids=lambda words: words[0])
@pytest.mark.parametrize("what", ODD)
def test_samples_of_no_sensor_are_left_out_or_refused(tmp_path: Path, imutool: Run, words: Sequence[str], what: str) -> None:
    """All of the accelerometer's samples are so: a finite answer in strict JSON, or a message and its exit code."""
    recording = flight(1, duration_s=4.0)
    accel = np.full_like(recording.imu.accel, ODD[what])
    put_log(tmp_path / "odd.mcap", recording.imu.t_ns, recording.imu.gyro, accel, next(iter(recording.truths.values())))
    done = imutool(*words, cwd=tmp_path)
    assert "Traceback" not in done.stderr
    assert "RuntimeWarning" not in done.stderr
    assert done.returncode in {0, 3, 4, 5, 7}, done.stderr
    if done.returncode == 0 and "--json" in words:
        msgspec.json.decode(done.stdout)  # strict: it refuses NaN
    elif done.returncode:
        assert "error: " in done.stderr or done.returncode == 3


@pytest.mark.parametrize("name", ["debias", "repair", "clean", "convert"])
def test_a_log_without_crcs_is_said_to_be_unchecked(tmp_path: Path, imutool: Run, name: str) -> None:
    """Fleets: tests/fleet/test_one_log.py."""
    recording = flight(1, duration_s=4.0)
    put_log(tmp_path / "in.mcap", recording.imu.t_ns, recording.imu.gyro, recording.imu.accel, None, crcs=False)
    done = imutool(name, "in.mcap", "out.mcap", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.search("no CRC.*not checked|no CRC covers", " ".join((done.stdout + done.stderr).split()))


CLOCK_S = 8.0
JUMPING: tuple[tuple[str, ...], ...] = (
    ("info", "in.mcap"),
    ("evaluate", "in.mcap"),
    ("audit", "in.mcap"),
    ("convert", "in.mcap", "out.mcap"),
    ("export", "in.mcap", "out", "--format", "euroc"),
    ("live", "--from", "in.mcap", "--speed", "1e12", "--no-view"),
    ("clean", "in.mcap", "--json", "-"),
    ("view", "in.mcap", "--html", "out.html"),
)  # debias: tests/bias_start/test_stretches.py; train: tests/training/test_training_windows.py


@pytest.mark.parametrize("words", JUMPING, ids=lambda words: words[0])
def test_a_clock_that_jumps_from_1970_costs_nothing_and_is_told(tmp_path: Path, imutool: Run, words: Sequence[str]) -> None:
    """A robot without a battery for its clock, until it hears of the time."""
    recording = flight(1, duration_s=CLOCK_S)
    poses = next(iter(recording.truths.values()))
    since_1970, set_ns = int(recording.imu.t_ns[0]) - 10**9, int(recording.imu.t_ns[len(recording.imu) // 3])
    imu_ns, pose_ns = (np.where(t < set_ns, t - since_1970, t) for t in (recording.imu.t_ns, poses.t_ns))
    put_log(tmp_path / "in.mcap", imu_ns, recording.imu.gyro, recording.imu.accel, replace(poses, t_ns=pose_ns))
    with bounded():
        done = imutool(*words, cwd=tmp_path)
    assert done.returncode in {0, LOG}, done.stderr
    page = tmp_path / "out.html"
    assert re.search(
        "clock jumps by|the clock was set", done.stdout + done.stderr + (page.read_text() if page.exists() else "")
    )


@pytest.mark.parametrize(("pack", "program"), [(gzip.compress, "gzip"), (zstandard.compress, "zstd"), (lzma.compress, "xz")])
def test_a_compressed_log_is_named(tmp_path: Path, refuse: Refuse, pack: Callable[[bytes], bytes], program: str) -> None:
    imu_log(tmp_path / "a.mcap", STAMPS)
    (tmp_path / "a.mcap.packed").write_bytes(pack((tmp_path / "a.mcap").read_bytes()))
    for words in (("info", "a.mcap.packed"), ("debias", "a.mcap.packed", "b.mcap"), ("repair", "a.mcap.packed", "b.mcap")):
        assert f"is compressed with {program}" in refuse(LOG, *words)
        assert "imutool convert" in refuse(LOG, *words)


def test_time_going_back_in_a_log_stops_debias(tmp_path: Path, refuse: Refuse) -> None:
    back = [*STAMPS[:500], STAMPS[450], *STAMPS[501:]]
    imu_log(tmp_path / "back.mcap", back)
    message = refuse(LOG, "debias", "back.mcap", "out.mcap")
    assert message.startswith("back.mcap /imu: ")
    assert str(STAMPS[450]) in message


# ── data sets ──


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """A sequence folder of two seconds."""
    write_asl(flight(3, duration_s=2.0), tmp_path / "seq")
    return tmp_path / "seq" / "mav0" / "imu0" / "data.csv"


def edit(path: Path, line: int, change: Callable[[list[str]], list[str]]) -> None:
    """Changes the cells of one line (counted from 1) of a table."""
    lines = path.read_text().splitlines()
    lines[line - 1] = ",".join(change(lines[line - 1].split(",")))
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("value", ["NaN", "inf", "", "1.2.3"])
def test_a_row_that_holds_no_number_is_named_by_file_and_line(sequence: Path, refuse: Refuse, value: str) -> None:
    edit(sequence, 17, lambda cells: [*cells[:2], value, *cells[3:]])
    message = refuse(DATA, "convert", "seq", "out.mcap")
    assert "data.csv:17: " in message
    assert value.lower() in message.lower()


def test_time_going_back_in_a_table_is_named_by_file_and_line(sequence: Path, refuse: Refuse) -> None:
    first = sequence.read_text().splitlines()[1].split(",")[0]
    edit(sequence, 30, lambda cells: [first, *cells[1:]])
    message = refuse(DATA, "convert", "seq", "out.mcap")
    assert "data.csv:30: " in message


def test_of_many_sequences_the_good_ones_are_written_and_the_bad_one_is_told(tmp_path: Path, imutool: Run) -> None:
    for seed in (1, 2):
        write_asl(flight(seed, duration_s=2.0), tmp_path / "src" / f"s{seed}")
    edit(tmp_path / "src" / "s1" / "mav0" / "imu0" / "data.csv", 5, lambda cells: [*cells[:1], "NaN", *cells[2:]])
    before = digests(tmp_path / "src")
    done = imutool("convert", "src", "out", "-q", cwd=tmp_path)
    assert "data.csv:5: " in told(done, done.stderr, DATA)
    assert done.stdout.split() == ["out/s2.mcap"]
    assert sorted(digests(tmp_path / "out")) == ["s2.mcap"]
    assert digests(tmp_path / "src") == before


# ── training and models ──


@pytest.mark.parametrize("truth_s", [0.0, 0.3])
def test_truth_shorter_than_a_segment_cannot_train(tmp_path: Path, refuse: Refuse, truth_s: float) -> None:
    whole = flight(1, duration_s=5.0)
    start = int(whole.imu.t_ns[400])
    truth = whole.truth.between(start, start + round(truth_s * 1e9))
    truths = {"/ground_truth/pose": truth} if truth_s else {}
    write(type(whole)(whole.name, whole.imu, truths=truths), tmp_path / "short.mcap")
    message = refuse(DATA, "train", "short.mcap", "-o", "m.safetensors", "--method", "linear")
    assert "truth" in message or "true poses" in message


def test_a_model_for_another_rate_is_refused(here: Path, refuse: Refuse) -> None:
    write(flight(4, duration_s=6.0, rate_hz=100.0), here / "slow.mcap")
    message = refuse(MODEL, "debias", "slow.mcap", "out.mcap", "--model", "linear.safetensors")
    assert "100.0 Hz" in message
    assert "200.0 Hz" in message


def test_a_model_of_another_version_is_refused(here: Path, refuse: Refuse) -> None:
    tensors, header = model_file.read_tensors(here / "linear.safetensors", model_file.FORMAT)
    model_file.write_tensors(tensors, header | {"format": "imutool.model/99"}, here / "future.safetensors", overwrite=False)
    message = refuse(MODEL, "debias", "flight_2.mcap", "out.mcap", "--model", "future.safetensors")
    assert "imutool.model/99" in message


@pytest.mark.parametrize("name", ["torn.safetensors", "nowhere.safetensors", "euroc-none"])
def test_a_model_that_is_none_is_refused(here: Path, refuse: Refuse, name: str) -> None:
    (here / "torn.safetensors").write_bytes((here / "linear.safetensors").read_bytes()[:-40])
    assert name in refuse(MODEL, "evaluate", "flight_2.mcap", "--model", name)


def test_without_model_and_without_rest_debias_says_what_to_do(tmp_path: Path, refuse: Refuse) -> None:
    write(flight(1, duration_s=6.0, still_s=0.0), tmp_path / "moving.mcap")
    assert "--model" in refuse(MODEL, "debias", "moving.mcap", "out.mcap")


# ── targets ──

TARGETS = {
    "convert": ["convert", "seq", "{}/out.mcap"],
    "debias": ["debias", "flight_2.mcap", "{}/out.mcap"],
    "train": ["train", "flight_1.mcap", "--method", "linear", "-o", "{}/m.safetensors"],
    "view": ["view", "flight_2.mcap", "--save", "{}/out.rrd"],
    "json": ["info", "flight_2.mcap", "--json", "{}/out.json"],
    "demo": ["demo", "-o", "{}/demo"],
}


@pytest.mark.parametrize("words", TARGETS.values(), ids=TARGETS.keys())
def test_a_target_that_cannot_be_written_is_told(here: Path, imutool: Run, words: Sequence[str]) -> None:
    """Root may write anywhere, so the place is one where not even root can: below a file."""
    write_asl(flight(3, duration_s=2.0), here / "seq")
    (here / "file").write_text("not a folder")
    before = digests(here)
    done = imutool(*(word.format("file") for word in words), "-q", cwd=here)
    assert "file" in told(done, done.stderr, CONFIG)
    assert digests(here) == before


def test_a_locked_model_is_no_missing_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    (tmp_path / "m.safetensors").touch()
    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(ModelError, match=r"m\.safetensors: cannot be read \(Permission denied\)"):
        model_file.load(tmp_path / "m.safetensors")


def test_a_target_the_system_refuses_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(ConfigError, match=r"out\.mcap: cannot be written \(Permission denied\)"):
        Target(tmp_path / "out.mcap")
    assert not list(tmp_path.iterdir())


def test_an_existing_target_stays_without_overwrite(here: Path, refuse: Refuse) -> None:
    (here / "out.mcap").write_text("mine")
    assert "--overwrite" in refuse(CONFIG, "debias", "flight_2.mcap", "out.mcap")
    assert "source" in refuse(CONFIG, "debias", "flight_2.mcap", "flight_2.mcap", "--overwrite")
    assert "--overwrite" in refuse(CONFIG, "train", "flight_1.mcap", "-o", "linear.safetensors", "--method", "linear")


NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}  # Python leaves it half written there


def full_disk() -> None:
    """In the child: no file may grow beyond some size; writing on then fails as on a full disk (Python ignores SIGXFSZ)."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))


@pytest.mark.parametrize("name", ["convert", "debias", "view"])
def test_a_full_disk_leaves_nothing(here: Path, refuse: Refuse, name: str) -> None:
    write_asl(flight(3, duration_s=10.0), here / "seq")
    words = [word.format(".") for word in TARGETS[name]]
    message = refuse(CONFIG, *words, preexec_fn=full_disk, env=NO_BYTECODE)
    assert "out." in message


def test_a_full_disk_leaves_no_half_model(here: Path, refuse: Refuse) -> None:
    write(flight(3, duration_s=QUICK_S, rate_hz=100.0), here / "flight_3.mcap")
    words = ["train", "flight_3.mcap", "-o", "m.safetensors", *QUICK, "--set", "validate_every=5"]
    assert "m.safetensors" in refuse(CONFIG, *words, preexec_fn=full_disk, env=NO_BYTECODE)


def test_results_into_a_full_disk_are_told(here: Path, command: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [command, "info", "flight_2.mcap"], cwd=here, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert "No space left" in told(done, done.stderr, CONFIG)


# ── Ctrl-C ──


def interrupted(line: Sequence[str | Path], cwd: Path, in_the_middle: Callable[[], bool]) -> tuple[int, str]:
    """Exit code and stderr of a command interrupted, as by Ctrl-C, at a moment seen to be in the middle.

    The whole process group is stopped as soon as the moment seems to have come, looked at again while it stands still,
    interrupted, and let go; if the moment has passed meanwhile, the next one counts. Code 0: there was none, and it ended.
    """
    process = subprocess.Popen(
        list(map(str, line)), cwd=cwd, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    deadline = time.monotonic() + WAIT_S
    while process.poll() is None and time.monotonic() < deadline:
        if in_the_middle():
            os.killpg(process.pid, signal.SIGSTOP)
            time.sleep(0.05)  # every process has stood still by then
            if hit := in_the_middle():
                os.killpg(process.pid, signal.SIGINT)
            os.killpg(process.pid, signal.SIGCONT)
            if hit:
                break
        time.sleep(0.0005)
    _, stderr = process.communicate(timeout=WAIT_S)
    return process.returncode, stderr


def assert_interrupted(code: int, stderr: str, *words: str) -> None:
    assert code == INTERRUPTED, stderr
    assert "Traceback" not in stderr
    message = stderr.strip().splitlines()[-1]
    assert message.startswith("error: interrupted.")
    assert all(word in message for word in words)


def partial(folder: Path) -> bool:
    return folder.is_dir() and any(".partial" in name.name for name in folder.iterdir())


@pytest.mark.parametrize("count", [1, 3], ids=["one", "in processes"])
def test_ctrl_c_in_the_middle_of_convert_leaves_whole_logs_only(on_disk: Path, command: str, count: int) -> None:
    for seed in range(count):
        write_asl(flight(seed, duration_s=30.0), on_disk / "src" / f"s{seed}")
    before = digests(on_disk / "src")
    for _ in range(TRIES):
        line = [command, "convert", "src", "out", "--overwrite", "--workers", "2", "-q"]
        (on_disk / "out").mkdir(exist_ok=True)
        code, stderr = interrupted(line, on_disk, lambda: partial(on_disk / "out"))
        if code:
            break
    assert_interrupted(code, stderr, "Nothing half-written")
    for path in (on_disk / "out").iterdir():
        assert path.suffix == ".mcap"
        with Log(path) as log:
            assert log.topics["/imu0"].count == 6001
    assert digests(on_disk / "src") == before


def test_ctrl_c_in_the_middle_of_debias_leaves_nothing(on_disk: Path, logs: Path, command: str) -> None:
    shutil.copy(logs / "flight_2.mcap", on_disk)
    before = digests(on_disk)
    for _ in range(TRIES):
        code, stderr = interrupted([command, "debias", "flight_2.mcap", "out.mcap", "-q"], on_disk, lambda: partial(on_disk))
        if code:
            break
        (on_disk / "out.mcap").unlink()
    assert_interrupted(code, stderr, "Nothing half-written")
    assert digests(on_disk) == before


def test_ctrl_c_in_the_middle_of_training_leaves_a_checkpoint_that_resume_takes_up(
    here: Path, command: str, imutool: Run
) -> None:
    write(flight(3, duration_s=QUICK_S, rate_hz=100.0), here / "flight_3.mcap")
    before, kept = digests(here), here / "m.safetensors.checkpoint"
    words = ["train", "flight_3.mcap", "-o", "m.safetensors", *QUICK, "--set", "validate_every=10"]
    code, stderr = interrupted([command, *words, "-q"], here, kept.exists)
    assert_interrupted(code, stderr, "m.safetensors.checkpoint", "--resume")
    left = digests(here)
    assert left.pop(kept.name)
    assert left == before

    other = imutool(*words, "--seed", "7", "--resume", "-q", cwd=here)  # another training may not take it up
    assert kept.name in told(other, other.stderr, CONFIG)
    done = imutool(*words, "--resume", "-v", "--json", "-", cwd=here)
    assert done.returncode == 0, done.stderr
    steps = [int(step) for step in re.findall(r"gyro (\d+)/40", done.stderr)]
    assert steps[0] >= 10  # it did not begin anew
    assert json.loads(done.stdout)["method"] == "neural_ode"
    assert set(digests(here)) == {*before, "m.safetensors"}
