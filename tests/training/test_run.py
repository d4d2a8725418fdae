"""From logs on disk to a model file: its card repeats the training, an interrupt costs little, nothing half-made is left."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from imutool.bias import hybrid
from imutool.bias.model_file import load
from imutool.config import build
from imutool.config import load as load_settings
from imutool.errors import ConfigError, DataError, LogError, ModelError, NumericsError
from imutool.evaluation import evaluate
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording, seconds
from imutool.sensor.made_up_flight import flight
from imutool.training.bias_spread import TURN_ON_STD
from imutool.training.calibration.effect_selection import config_of
from imutool.training.checkpoint import checkpoint_path
from imutool.training.fit import Epoch, TrainSettings
from imutool.training.log_signals import TRIADS_RAD, read_parts
from imutool.training.objectives.objective import AdamW, WindowEndObjective
from imutool.training.run import helps, train
from imutool.training.settings import settings_from_physics, settings_of
from imutool.units import Sensor

pytestmark = pytest.mark.usefixtures("one_start")

TINY = TrainSettings(
    gyro_window_s=(0.25, 0.5),
    accel_window_s=(0.25,),
    samples=400,
    steps=6,
    validate_every=2,
    model={
        "curve_width": 8,
        "drift_step_s": 0.1,
        "drift": ["gyro", "accel"],
        "loads": [],
    },  # test_drift.py lets the logs choose
)
LINEAR = TrainSettings(gyro_window_s=(0.5, 1.0), accel_window_s=(0.5,))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("logs")
    made = []
    for seed in (1, 2):
        recording = flight(seed, duration_s=8.0, still_s=0.5, rate_hz=100.0)
        about = {"imutool": {"dataset": "euroc", "sensor": "adis16448"}}
        made.append(folder / f"{seed}.mcap")
        write(Recording(recording.name, recording.imu, recording.truths, metadata=about), made[-1])
    return made


@pytest.fixture(scope="module")
def expected(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file that a training without incident writes."""
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("out") / "m.safetensors"
    train(logs, out, method="neural_ode", settings=TINY)
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
    assert all(0 < held["error"] <= held["closed_form"] for held in card["held_out"].values())


@pytest.mark.parametrize("method", ["hybrid", "neural_ode", "linear"])
def test_orientations_alone_train_the_gyro_and_turn_the_accelerometer_with_it(
    logs: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture, method: str
) -> None:
    """The body of the poses is turned against the sensor, as markers are: gyro and accelerometer still agree."""
    turned, mount = [], Rotation.from_rotvec([0.05, 0.0, -0.02])
    for log in logs:
        recording = read(log)
        truths = {
            topic: Poses(
                p.t_ns,
                np.zeros_like(p.p_wb),
                (Rotation.from_quat(p.q_wb_wxyz, scalar_first=True) * mount).as_quat(scalar_first=True),
            )
            for topic, p in recording.truths.items()
        }
        turned.append(tmp_path / log.name)
        write(Recording(recording.name, recording.imu, truths, metadata=recording.metadata), turned[-1])
    tiny = SMALL_ODE if method == "neural_ode" else {}
    settings = msgspec.structs.replace(TINY, model=tiny, compare=False)  # logs of 8 s choose no matrix
    model = train(turned, tmp_path / "m.safetensors", method=method, settings=settings)
    assert "flight_1, flight_2 have no positions: the gyro alone is trained" in caplog.text
    assert set(model.card["held_out"]) == {"gyro"}
    assert model.prior_mean[:3].all()
    assert model.prior_mean[3:].tolist() == [0.0] * 3
    assert model.prior_std[3:].tolist() == pytest.approx([TURN_ON_STD["accel"]] * 3)
    imu = read(logs[0]).imu
    moved = model.stream(np.zeros(6))(seconds(imu.t_ns, int(imu.t_ns[0])), imu.gyro, imu.accel)
    assert moved[:, :3].any()
    f = imu.accel - moved[:, 3:]
    np.testing.assert_allclose(np.linalg.norm(f, axis=1), np.linalg.norm(imu.accel, axis=1), rtol=1e-6)  # float32
    found = Rotation.align_vectors(f, imu.accel)[0].as_rotvec()
    np.testing.assert_allclose(found, mount.inv().as_rotvec(), atol=0.02)
    if method == "neural_ode":  # it states no covariance of its matrices
        return
    root = model.calibration_covariance()
    assert root is not None
    assert np.linalg.norm(root(np.zeros(1), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]))["accel"]) > 9.81 * TRIADS_RAD


def test_the_same_command_writes_the_same_bytes(logs: list[Path], expected: bytes, tmp_path: Path) -> None:
    said: list[Epoch] = []
    model = train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY, progress=said.append)
    assert (tmp_path / "m.safetensors").read_bytes() == expected
    assert names(tmp_path) == ["m.safetensors"]  # the checkpoint has gone
    assert model.card["name"] == "m"
    assert [epoch.step for epoch in said] == [0, 2, 4, 6] * 2  # of both sensors, as both have a drift here


def test_a_script_s_settings_of_pytorch_change_no_training_and_stay(logs: list[Path], expected: bytes, tmp_path: Path) -> None:
    """A seed gives one model, and what a script draws after a training does not depend on it."""
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(7)
        drawn = torch.rand(4, dtype=torch.float64)
        torch.manual_seed(7)
        torch.set_default_dtype(torch.float64)
        try:
            train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY)
            assert torch.get_default_dtype() == torch.float64
        finally:
            torch.set_default_dtype(torch.float32)
        assert torch.equal(torch.rand(4, dtype=torch.float64), drawn)
        assert not torch.is_grad_enabled()
    assert (tmp_path / "m.safetensors").read_bytes() == expected


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
        train(logs, out, method="neural_ode", settings=TINY, progress=stop)
    assert names(tmp_path) == [checkpoint_path(out).name]
    train(logs, out, method="neural_ode", settings=TINY, resume=True)
    assert out.read_bytes() == expected
    assert names(tmp_path) == [out.name]


@pytest.mark.parametrize("place", ["loss", "update"])
def test_ctrl_c_in_the_middle_of_a_step_leaves_no_torn_checkpoint(
    logs: list[Path], expected: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    """The draw of a step is done, or its weights half moved; what goes on from there must still be the same training."""
    calls, whole_update, whole_loss = 0, AdamW.step, WindowEndObjective.terms

    def update(*words: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        whole_update(*words, **named)
        if calls == 4:
            raise KeyboardInterrupt

    def terms(self: WindowEndObjective, generator: torch.Generator) -> Iterator[torch.Tensor]:
        nonlocal calls
        calls += 1
        for term in whole_loss(self, generator):
            yield term
            if calls == 4:
                raise KeyboardInterrupt

    out = tmp_path / "m.safetensors"
    with monkeypatch.context() as patched:
        patched.setattr(*((AdamW, "step", update) if place == "update" else (WindowEndObjective, "terms", terms)))
        with pytest.raises(KeyboardInterrupt):
            train(logs, out, method="neural_ode", settings=TINY)
    assert calls == 4
    assert names(tmp_path) == [checkpoint_path(out).name]
    train(logs, out, method="neural_ode", settings=TINY, resume=True)
    assert out.read_bytes() == expected


def test_ctrl_c_before_anything_is_done_leaves_nothing(logs: list[Path], tmp_path: Path) -> None:
    def stop(epoch: Epoch) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY, progress=stop)
    assert names(tmp_path) == []


@pytest.mark.parametrize("method", ["linear", "hybrid"])
def test_a_device_that_is_not_there_is_refused_before_any_log_is_read(method: str, tmp_path: Path) -> None:
    devices = ["tpu"] if torch.cuda.is_available() else ["tpu", "cuda"]
    for device in devices:
        with pytest.raises(ConfigError, match="device"):
            train([tmp_path / "absent.mcap"], tmp_path / "m.safetensors", method=method, device=device)


def test_to_resume_what_was_never_begun_is_refused(logs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"m.safetensors.checkpoint: there is no checkpoint.*without `resume`"):
        train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY, resume=True)


def test_a_checkpoint_is_not_trained_over_without_being_told(logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "m.safetensors"
    checkpoint_path(out).write_bytes(b"hours of work")
    with pytest.raises(ConfigError, match=r"interrupted training left its checkpoint.*`resume` to go on"):
        train(logs, out, method="neural_ode", settings=TINY)
    assert checkpoint_path(out).read_bytes() == b"hours of work"
    train(logs, out, method="neural_ode", settings=TINY, overwrite=True)
    assert names(tmp_path) == [out.name]


def test_to_resume_with_other_settings_is_refused_and_the_checkpoint_kept(logs: list[Path], tmp_path: Path) -> None:
    def stop(epoch: Epoch) -> None:
        if epoch.step == 4:
            raise KeyboardInterrupt

    out = tmp_path / "m.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train(logs, out, method="neural_ode", settings=TINY, progress=stop)
    kept = checkpoint_path(out).read_bytes()
    with pytest.raises(ConfigError, match="other settings"):
        train(logs, out, method="neural_ode", settings=msgspec.structs.replace(TINY, seed=1), resume=True)
    assert checkpoint_path(out).read_bytes() == kept
    with pytest.raises(ConfigError, match="linear has no steps to go on with"):
        train(logs, out, method="linear", settings=LINEAR, resume=True)
    assert checkpoint_path(out).read_bytes() == kept
    checkpoint_path(out).write_bytes(kept[:-100])
    with pytest.raises(ModelError):
        train(logs, out, method="neural_ode", settings=TINY, resume=True)
    assert names(tmp_path) == [checkpoint_path(out).name]


def test_a_closed_form_needs_no_checkpoint(logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imutool.training.checkpoint.save", lambda *_: pytest.fail("nothing to put down"))
    model = train(logs, tmp_path / "m.safetensors", method="linear", settings=LINEAR)
    assert model.method == "linear"


def test_refusals_come_before_the_work_and_leave_nothing(
    logs: list[Path], tmp_path: Path, perfect: Callable[..., Recording]
) -> None:
    there = tmp_path / "there.safetensors"
    there.write_bytes(b"mine")
    with pytest.raises(ConfigError, match=r"exists already.*overwrite"):
        train(logs, there, method="neural_ode", settings=TINY)
    with pytest.raises(ConfigError, match="the folder does not exist"):
        train(logs, tmp_path / "no" / "m.safetensors", method="neural_ode", settings=TINY)
    with pytest.raises(ConfigError, match="is a pipe or a device"):
        train(logs, Path("/dev/stdout"), method="linear", overwrite=True)
    blind = tmp_path / "blind.mcap"
    write(Recording("blind", flight(3, duration_s=2.0).imu), blind)
    with pytest.raises(DataError, match="blind: no true poses"):
        train([logs[0], blind], tmp_path / "m.safetensors", method="neural_ode", settings=TINY)
    other = tmp_path / "other.mcap"
    write(perfect(3, duration_s=4.0, rate_hz=50.0), other)
    with pytest.raises(DataError, match="different rates"):
        train([logs[0], other], tmp_path / "m.safetensors", method="neural_ode", settings=TINY)
    with pytest.raises(ConfigError, match="cannot be"):
        train([tmp_path / "none.mcap"], tmp_path / "m.safetensors", method="neural_ode", settings=TINY)
    with pytest.raises(LogError):
        train([there], tmp_path / "m.safetensors", method="neural_ode", settings=TINY)
    with pytest.raises(LogError, match="/imu9"):
        train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY, imu="/imu9")
    with pytest.raises(LogError, match="/nowhere"):
        train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TINY, truth="/nowhere")
    assert names(tmp_path) == ["blind.mcap", "other.mcap", "there.safetensors"]
    assert there.read_bytes() == b"mine"


def test_a_training_that_diverges_leaves_no_model(logs: list[Path], tmp_path: Path) -> None:
    values = {name: getattr(TINY, name) for name in TINY.__struct_fields__}
    with pytest.raises(NumericsError, match="the loss is"):
        train(logs, tmp_path / "m.safetensors", method="neural_ode", settings=TrainSettings(**values | {"gyro_rate": 1e300}))
    assert not (tmp_path / "m.safetensors").exists()


# ── hybrid: effects in closed form, then the neural ODE where it helps ───────────────────────────────────────────────

SMALL_ODE = {"curve_width": 8, "drift_step_s": 0.1}
DRIFTING_ODE = {**SMALL_ODE, "drift": ["gyro", "accel"]}  # so that both sensors take steps
HYBRID = TrainSettings(
    gyro_window_s=(0.25, 0.5),
    accel_window_s=(0.25,),
    samples=400,
    steps=6,
    validate_every=2,
    compare=False,  # left-out logs are scored in the training on orientations
    model={"gyro_effects": ["gyro_scale", "gyro_misalignment"], "accel_effects": ["accel_scale"], "ode": DRIFTING_ODE},
)


@pytest.fixture
def any_ode_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    """What six steps do to made-up flights is not the question here."""
    monkeypatch.setattr("imutool.training.run.helps", lambda before, after: True)


@pytest.fixture(scope="module")
def expected_hybrid(logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("hybrid") / "m.safetensors"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("imutool.training.run.helps", lambda before, after: True)
        train(logs, out, method="hybrid", settings=HYBRID)
    return out.read_bytes()


def test_hybrid_is_what_is_trained_unless_told_otherwise(logs: list[Path], expected_hybrid: bytes, tmp_path: Path) -> None:
    model = train(logs, tmp_path / "m.safetensors", settings=msgspec.structs.replace(HYBRID, steps=1))
    assert model.method == "hybrid"


def test_a_hybrids_card_says_what_was_found_and_compared(expected_hybrid: bytes, tmp_path: Path) -> None:
    (tmp_path / "m.safetensors").write_bytes(expected_hybrid)
    model = load(tmp_path / "m.safetensors")
    assert isinstance(model, hybrid.Model)
    card = model.card
    assert card["method"] == "hybrid"
    assert build(TrainSettings, card["training"]) == HYBRID
    assert card["physics"]["gyro"]["effects"] == ["gyro_scale", "gyro_misalignment"]
    assert card["physics"]["accel"]["effects"] == ["accel_scale"]
    assert set(card["compared"]) == {"effects", "effects and neural_ode"}
    assert card["held_out"] == card["compared"]["effects and neural_ode"]
    assert model.config.effects("gyro") == ("gyro_scale", "gyro_misalignment")
    assert model.ode is not None
    for name in ("prior_std", "truth_std", "noise_std"):
        assert (getattr(model, name) > 0).all(), name


def test_an_interrupted_hybrid_goes_on_as_if_nothing_had_been(
    logs: list[Path], expected_hybrid: bytes, tmp_path: Path, any_ode_helps: None
) -> None:
    def stop(epoch: Epoch, seen: list[Epoch] = []) -> None:  # noqa: B006  counts across calls
        seen += [epoch] * (epoch.steps > 0)
        if len(seen) == 8:  # in the second stage, the accelerometer's
            raise KeyboardInterrupt

    out = tmp_path / "m.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train(logs, out, method="hybrid", settings=HYBRID, progress=stop)
    assert names(tmp_path) == [checkpoint_path(out).name]
    train(logs, out, method="hybrid", settings=HYBRID, resume=True)
    assert out.read_bytes() == expected_hybrid
    assert names(tmp_path) == [out.name]


def test_ctrl_c_while_effects_are_looked_for_leaves_nothing(logs: list[Path], tmp_path: Path) -> None:
    def stop(epoch: Epoch) -> None:
        assert epoch.note
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(logs, tmp_path / "m.safetensors", method="hybrid", settings=HYBRID, progress=stop)
    assert names(tmp_path) == []


def test_an_ode_that_does_not_help_is_left_out(tmp_path: Path, perfect: Callable[..., Recording]) -> None:
    """A sensor with noise and nothing else: the model is its effects, with the held-out error of those."""
    noisy = []
    for seed in (1, 2):
        exact, rng = perfect(seed, duration_s=20.0, rate_hz=100.0), np.random.default_rng(seed)
        gyro, accel = (u + size * rng.normal(size=u.shape) for u, size in ((exact.imu.gyro, 0.02), (exact.imu.accel, 0.2)))
        noisy.append(tmp_path / f"{seed}.mcap")
        write(replace(exact, imu=Imu(exact.imu.t_ns, gyro, accel)), noisy[-1])
    chosen = msgspec.structs.replace(HYBRID, steps=20, gyro_window_s=(1.0, 4.0))
    model = train(noisy, tmp_path / "m.safetensors", settings=chosen)
    assert isinstance(model, hybrid.Model)
    assert model.ode is None
    assert not model.config.remainder
    assert model.card["held_out"] == model.card["compared"]["effects"]
    assert set(model.card["compared"]) == {"effects", "effects and neural_ode"}
    alone = train(noisy[:1], tmp_path / "alone.safetensors", settings=chosen)
    assert set(alone.card["compared"]) == {"effects"}, "one log shows only what fits its own motion"


def test_without_a_remainder_no_ode_is_trained(logs: list[Path], tmp_path: Path) -> None:
    said: list[Epoch] = []
    chosen = msgspec.structs.replace(HYBRID, model={**HYBRID.model, "remainder": False})
    model = train(logs, tmp_path / "m.safetensors", method="hybrid", settings=chosen, progress=said.append)
    assert set(model.card["compared"]) == {"effects"}
    assert not any(epoch.steps for epoch in said)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"gyro_effects": ["gyro_scal"]}, r"'gyro_scal' is not known.*Did you mean 'gyro_scale'"),
        ({"gyro_effects": ["lever_arm"]}, "lever_arm does not act on the gyro"),
        ({"accel_effects": ["accel_scale", "accel_scale"]}, "a name occurs twice"),
        ({"remainer": False}, r"remainer is not a setting.*Did you mean remainder"),
    ],
)
def test_a_slip_of_the_pen_is_told_before_any_log_is_read(tmp_path: Path, model: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        train([tmp_path / "none.mcap"], tmp_path / "m.safetensors", settings=TrainSettings(model=model))


def test_helps_asks_for_a_gain_beyond_the_scatter_of_logs_and_no_harm_to_the_other_sensor() -> None:
    before: dict[Sensor, np.ndarray] = {"gyro": np.zeros(4), "accel": np.ones(4)}
    alike, few = np.array([-0.2, -0.25, -0.22, -0.18]), np.array([-0.9, 0.0, 0.05, 0.02])
    assert helps(before, {"gyro": before["gyro"] + alike, "accel": before["accel"]})
    assert helps(before, {"gyro": before["gyro"], "accel": before["accel"] + alike})
    assert not helps(before, {"gyro": before["gyro"] + few, "accel": before["accel"]}), "one log of four"
    assert not helps(before, {"gyro": before["gyro"] + 0.1 * alike, "accel": before["accel"]}), "too little"
    assert not helps(before, {"gyro": before["gyro"] + alike, "accel": before["accel"] + 0.1}), "harm"
    assert not helps(before, before)


def test_static_is_not_trained(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="static is not trained"):
        train([], tmp_path / "model.safetensors", method="static")


def entry(name: str, parameter: str, unit: str) -> str:
    return f'[[effect]]\nname = "{name}"\n[effect.parameters.{parameter}]\nvalue = 0.01\nunit = "{unit}"\n'


def test_a_physics_file_says_which_effects_hybrid_takes_off_and_what_is_left(tmp_path: Path) -> None:
    file = tmp_path / "physics.toml"
    some = (("gyro_scale", "x", "-"), ("saturation", "gyro", "rad/s"), ("lever_arm", "x", "m"), ("clock_offset", "tau", "s"))
    file.write_text("".join(entry(*one) for one in some))
    words, left = settings_from_physics(file)
    config = load_settings(settings_of("hybrid"), None, words)
    assert config_of(config).gyro_effects == ("clock_offset", "gyro_scale")
    assert "lever_arm" in (config_of(config).accel_effects or ())
    assert left == ("saturation",)


def test_a_physics_file_of_which_hybrid_knows_nothing_is_refused(tmp_path: Path, imutool: Any) -> None:
    file = tmp_path / "physics.toml"
    file.write_text(entry("saturation", "gyro", "rad/s"))
    with pytest.raises(ConfigError, match="no effect that a bias model can correct"):
        settings_from_physics(file)
    words = ["train", "a.mcap", "-o", tmp_path / "m.safetensors", "--method", "linear", "--physics", file]
    said = imutool(*words, cwd=tmp_path)
    assert said.returncode == 3
    assert "linear has no effects" in said.stderr


def test_samples_at_the_end_of_the_gyros_range_teach_no_scale(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """They made a model of 85 degrees on a sequence on which a constant bias has 1.6."""
    errors = {}
    for share in (1.0, 0.7):
        made = flight(2, duration_s=30.0, still_s=0.5, rate_hz=100.0)
        limit = share * np.abs(made.imu.gyro).max()
        write(replace(made, imu=replace(made.imu, gyro=np.clip(made.imu.gyro, -limit, limit))), tmp_path / f"{share}.mcap")
        train([tmp_path / f"{share}.mcap"], tmp_path / f"{share}.safetensors", method="linear", settings=LINEAR)
        errors[share] = evaluate(tmp_path / "1.0.mcap", models=[tmp_path / f"{share}.safetensors"], init="truth")[1]["aoe_deg"]
    assert errors[0.7] < 1.5 * errors[1.0] + 0.2
    assert "at the end of its range, and are left out" in caplog.text


def test_long_logs_are_cut_to_what_memory_holds(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    logs = [tmp_path / f"{seed}.mcap" for seed in range(5)]
    for seed, (log, duration_s) in enumerate(zip(logs, (8.0, 70.0, 90.0, 90.0, 70.0), strict=True)):
        write(flight(seed, duration_s=duration_s, rate_hz=100.0), log)
    parts = [part for _, part in read_parts(logs[:3], 13_000)]
    assert [len(part.imu) for part in parts] == [801, 6_099, 6_099]
    assert all(part.imu.gyro.base is None for part in parts[1:]), "the rest of a log is not kept in memory"
    assert all(part.truth.t_ns[-1] <= part.imu.t_ns[-1] for part in parts[1:])
    found = read_parts(logs[1:], 14_100)
    assert [(path, len(part.imu)) for path, part in found] == [(logs[1], 7_001), (logs[3], 7_099)], "a minute of each, at least"
    assert [len(part.imu) for _, part in read_parts(logs[2:3], 500)] == [500]
    assert len(read_parts(logs[:3], 16_804)) == 3
    first = ("only the first 61 s of long logs", "only 2 of 4 logs are used, and only the first 71 s of long logs")
    said = ": a sample takes 3 kB of memory; --set most_samples=N takes more"
    assert caplog.messages == [text + said for text in (*first, "only the first 5 s of long logs")]
