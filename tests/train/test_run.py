"""From logs on disk to a model file: its card repeats the training, an interrupt costs little, nothing half-made is left."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from imutool.bias._file import load
from imutool.config import build
from imutool.errors import ConfigError, DataError, LogError, ModelError, NumericsError
from imutool.mcap_io.write import write
from imutool.physics.flight import flight
from imutool.recording import Recording
from imutool.train.fit import Epoch, Training, TrainSettings
from imutool.train.run import checkpoint_path, train

TINY = TrainSettings(
    gyro_window_s=(0.25, 0.5),
    accel_window_s=(0.25,),
    samples=400,
    steps=6,
    validate_every=2,
    model={"curve_width": 8, "drift_step_s": 0.1},
)
LINEAR = TrainSettings(gyro_window_s=(0.5, 1.0), accel_window_s=(0.5,))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    made = []
    for seed in (1, 2):
        recording = flight(seed, duration_s=6.0, still_s=0.5)
        about = {"imutool": {"dataset": "euroc", "sensor": "adis16448"}}
        made.append(folder / f"{seed}.mcap")
        write(Recording(recording.name, recording.imu, recording.truths, metadata=about), made[-1])
    return made


@pytest.fixture(scope="module")
def expected(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file that a training without incident writes."""
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("out") / "m.safetensors"
    train(logs, out, settings=TINY)
    return out.read_bytes()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_card_holds_everything_needed_to_repeat_the_training(logs: list[Path], expected: bytes, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    path.write_bytes(expected)
    card = load(path).card
    assert (card["method"], card["sensor"], card["dataset"]) == ("neural_ode", "adis16448", "euroc")
    assert build(TrainSettings, card["training"]) == TINY
    digests = [hashlib.sha256(log.read_bytes()).hexdigest() for log in logs]
    assert [(log["name"], log["file"], log["sha256"]) for log in card["logs"]] == [
        ("flight_1", "1.mcap", digests[0]),
        ("flight_2", "2.mcap", digests[1]),
    ]
    assert card["torch"] == torch.__version__
    assert {(sensor, held["unit"]) for sensor, held in card["held_out"].items()} == {("gyro", "rad"), ("accel", "m/s")}
    assert all(held["error"] > 0 for held in card["held_out"].values())


def test_the_same_command_writes_the_same_bytes(logs: list[Path], expected: bytes, tmp_path: Path) -> None:
    said: list[Epoch] = []
    model = train(logs, tmp_path / "m.safetensors", settings=TINY, progress=said.append)
    assert (tmp_path / "m.safetensors").read_bytes() == expected
    assert names(tmp_path) == ["m.safetensors"]  # the checkpoint has gone
    assert model.card["name"] == "m"
    assert [epoch.step for epoch in said] == [0, 2, 4, 6] * 2


@pytest.mark.parametrize("line", [4, 8])
def test_ctrl_c_between_two_steps_leaves_a_checkpoint_that_resume_takes_up(
    logs: list[Path], expected: bytes, tmp_path: Path, line: int
) -> None:
    def stop(epoch: Epoch, seen: list[Epoch] = []) -> None:  # noqa: B006  counts across calls
        seen.append(epoch)
        if len(seen) == line:  # the checkpoint of the line before is what there is
            raise KeyboardInterrupt

    out = tmp_path / "m.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train(logs, out, settings=TINY, progress=stop)
    assert names(tmp_path) == [checkpoint_path(out).name]
    train(logs, out, settings=TINY, resume=True)
    assert out.read_bytes() == expected
    assert names(tmp_path) == [out.name]


@pytest.mark.parametrize("place", ["loss", "update"])
def test_ctrl_c_in_the_middle_of_a_step_leaves_no_torn_checkpoint(
    logs: list[Path], expected: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """The draw of a step is done, or its weights half moved; what goes on from there must still be the same training."""
    calls = 0
    whole = torch.optim.AdamW.step if place == "update" else Training._errors

    def interrupted(*words: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        stage = next((w.stage for w in words if isinstance(w, Training)), None)
        if place == "update" and calls == 4:
            whole(*words, **named)
            raise KeyboardInterrupt
        if place == "loss" and stage is not None and stage.step == 3 and stage.sensor == "gyro":
            raise KeyboardInterrupt
        return whole(*words, **named)

    out = tmp_path / "m.safetensors"
    with monkeypatch.context() as patched:
        patched.setattr(*((torch.optim.AdamW, "step") if place == "update" else (Training, "_errors")), interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(logs, out, settings=TINY)
    assert names(tmp_path) == [checkpoint_path(out).name]
    train(logs, out, settings=TINY, resume=True)
    assert out.read_bytes() == expected


def test_ctrl_c_before_anything_is_done_leaves_nothing(logs: list[Path], tmp_path: Path) -> None:
    def stop(epoch: Epoch) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(logs, tmp_path / "m.safetensors", settings=TINY, progress=stop)
    assert names(tmp_path) == []


def test_to_resume_what_was_never_begun_is_refused(logs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"m.safetensors.checkpoint: there is no checkpoint.*without --resume"):
        train(logs, tmp_path / "m.safetensors", settings=TINY, resume=True)


def test_a_checkpoint_is_not_trained_over_without_being_told(logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "m.safetensors"
    checkpoint_path(out).write_bytes(b"hours of work")
    with pytest.raises(ConfigError, match=r"interrupted training left its checkpoint.*--resume to go on"):
        train(logs, out, settings=TINY)
    assert checkpoint_path(out).read_bytes() == b"hours of work"
    train(logs, out, settings=TINY, overwrite=True)
    assert names(tmp_path) == [out.name]


def test_to_resume_with_other_settings_is_refused_and_the_checkpoint_kept(logs: list[Path], tmp_path: Path) -> None:
    def stop(epoch: Epoch) -> None:
        if epoch.step == 4:
            raise KeyboardInterrupt

    out = tmp_path / "m.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train(logs, out, settings=TINY, progress=stop)
    kept = checkpoint_path(out).read_bytes()
    with pytest.raises(ConfigError, match="other settings"):
        train(logs, out, settings=LINEAR, method="linear", resume=True)
    assert checkpoint_path(out).read_bytes() == kept
    checkpoint_path(out).write_bytes(kept[:-100])
    with pytest.raises(ModelError):
        train(logs, out, settings=TINY, resume=True)
    assert names(tmp_path) == [checkpoint_path(out).name]


def test_a_closed_form_needs_no_checkpoint(logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imutool.train.checkpoint.save", lambda *_: pytest.fail("nothing to put down"))
    model = train(logs, tmp_path / "m.safetensors", method="linear", settings=LINEAR)
    assert model.method == "linear"


def test_refusals_come_before_the_work_and_leave_nothing(
    logs: list[Path], tmp_path: Path, perfect: Callable[..., Recording]
) -> None:
    there = tmp_path / "there.safetensors"
    there.write_bytes(b"mine")
    with pytest.raises(ConfigError, match=r"exists already.*--overwrite"):
        train(logs, there, settings=TINY)
    with pytest.raises(ConfigError, match="the folder does not exist"):
        train(logs, tmp_path / "no" / "m.safetensors", settings=TINY)
    blind = tmp_path / "blind.mcap"
    write(Recording("blind", flight(3, duration_s=2.0).imu), blind)
    with pytest.raises(DataError, match="blind: no true poses"):
        train([logs[0], blind], tmp_path / "m.safetensors", settings=TINY)
    other = tmp_path / "other.mcap"
    write(perfect(3, duration_s=4.0, rate_hz=100.0), other)
    with pytest.raises(DataError, match="different rates"):
        train([logs[0], other], tmp_path / "m.safetensors", settings=TINY)
    with pytest.raises(ConfigError, match="cannot be"):
        train([tmp_path / "none.mcap"], tmp_path / "m.safetensors", settings=TINY)
    with pytest.raises(LogError):
        train([there], tmp_path / "m.safetensors", settings=TINY)
    with pytest.raises(LogError, match="/imu9"):
        train(logs, tmp_path / "m.safetensors", settings=TINY, imu="/imu9")
    with pytest.raises(LogError, match="/nowhere"):
        train(logs, tmp_path / "m.safetensors", settings=TINY, truth="/nowhere")
    assert names(tmp_path) == ["blind.mcap", "other.mcap", "there.safetensors"]
    assert there.read_bytes() == b"mine"


def test_a_training_that_diverges_leaves_no_model(logs: list[Path], tmp_path: Path) -> None:
    values = {name: getattr(TINY, name) for name in TINY.__struct_fields__}
    with pytest.raises(NumericsError, match="the loss is"):
        train(logs, tmp_path / "m.safetensors", settings=TrainSettings(**values | {"gyro_rate": 1e300}))
    assert not (tmp_path / "m.safetensors").exists()
