"""Whoever uses the samples of a log in other units, axes or frames is warned in one sentence that names the correction."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.api.logs import convert, export
from imutool.api.models import debias as debias_recording
from imutool.debiasing import debias
from imutool.diagnosis.diagnose import diagnose
from imutool.errors import DataError, ImutoolError, ModelError
from imutool.evaluation import evaluate
from imutool.log_info.inspection import inspect
from imutool.mcap_io.write import write
from imutool.recording import Imu, Poses, Recording
from imutool.sensor.made_up_flight import flight
from imutool.sensor.simulate import simulate
from imutool.training.run import train

NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def with_samples(
    gyro: Callable[[np.ndarray], np.ndarray], accel: Callable[[np.ndarray], np.ndarray]
) -> Callable[..., Recording]:
    def changed(made: Recording) -> Recording:
        return replace(made, imu=Imu(made.imu.t_ns, gyro(made.imu.gyro), accel(made.imu.accel)))

    return changed


def in_ned(made: Recording) -> Recording:
    q_wb = (Rotation.from_matrix(NED) * Rotation.from_quat(made.truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    return replace(
        made, truths={"/ground_truth/pose": replace(made.truth, p_wb=made.truth.p_wb @ NED.T, q_wb_wxyz=q_wb, v_w=None)}
    )


def in_mm(made: Recording) -> Recording:
    return replace(made, truths={"/ground_truth/pose": replace(made.truth, p_wb=1e3 * made.truth.p_wb, v_w=None)})


CHANGES = {
    "accel looks like g": with_samples(lambda gyro: gyro, lambda accel: accel / 9.80665),
    "gyro looks like deg/s": with_samples(np.rad2deg, lambda accel: accel),
    "gyro contradicts": with_samples(lambda gyro: gyro[:, [1, 2, 0]], lambda accel: accel),
    "accel contradicts": with_samples(lambda gyro: gyro, lambda accel: -accel),
    "-z up (as in NED)": in_ned,
    "are in mm and not in m": in_mm,
}


class StopError(Exception):
    """The search after the warnings is not awaited."""


def stop(done: int, total: int, text: str) -> None:
    if done:
        raise StopError


USES: dict[str, Callable[[Path], object]] = {
    "debias": lambda log: debias(log, log.with_suffix(".out.mcap"), init="0,0,0,0,0,0", force=True, overwrite=True),
    "evaluate": evaluate,
    "diagnose": lambda log: diagnose([log], tell=stop),
}


@pytest.fixture(scope="module")
def made() -> Recording:
    return flight(3, duration_s=40.0)


def warned(told: str, name: str, made: Recording, log: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(CHANGES[told](made), log)
    with suppress(ImutoolError, StopError):
        USES[name](log)
    found = [line.getMessage() for line in caplog.records if told in line.getMessage()]
    assert len(found) == 1
    assert "imutool convert LOG OUT --fix" in found[0]


@pytest.mark.parametrize("told", CHANGES)
def test_wrong_units_axes_and_frames_are_warned_of(
    told: str, made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    warned(told, "evaluate", made, tmp_path / "log.mcap", caplog)


@pytest.mark.parametrize(
    ("told", "spoil"),
    [
        ("gyro.y unchanged", lambda gyro: np.where([False, True, False], 0.0123, gyro)),
        ("gyro.x at the end of its range", lambda gyro: np.clip(gyro, -0.3, 0.3)),
    ],
)
def test_a_dead_or_clipped_axis_is_warned_of_where_samples_are_used(
    told: str, spoil: Callable[[Any], Any], made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for use in ("debias", "evaluate"):
        caplog.clear()
        changed = replace(made, imu=Imu(made.imu.t_ns, spoil(made.imu.gyro), made.imu.accel))
        write(changed, tmp_path / f"{use}.mcap")
        with suppress(ImutoolError, StopError):
            USES[use](tmp_path / f"{use}.mcap")
        assert told in caplog.text
    caplog.clear()
    write(made, tmp_path / "sound.mcap")
    with suppress(ImutoolError, StopError):
        USES["evaluate"](tmp_path / "sound.mcap")
    assert "samples with" not in caplog.text


@pytest.mark.parametrize("name", ["debias", "diagnose"])
def test_every_use_of_wrong_samples_is_warned_of(
    name: str, made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    warned("accel looks like g", name, made, tmp_path / "log.mcap", caplog)


def test_a_diagnosis_says_in_its_remarks_what_is_wrong_with_the_samples(
    made: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its JSON and its page had no word of it."""
    told: list[str] = []

    def begun(*given: Any) -> None:
        told.extend(given[2])
        raise StopError

    monkeypatch.setattr("imutool.diagnosis.diagnose._beside_reference", begun)
    write(CHANGES["accel looks like g"](made), tmp_path / "log.mcap")
    with pytest.raises(StopError):
        diagnose([tmp_path / "log.mcap"])
    assert [text for text in told if "accel looks like g" in text]


@pytest.mark.parametrize("told", CHANGES)
def test_no_model_learns_wrong_units_axes_or_frames(told: str, made: Recording, tmp_path: Path) -> None:
    """Trained on a world whose z is down, the accelerometer got a bias of twice gravity."""
    log, model = tmp_path / "log.mcap", tmp_path / "model.safetensors"
    write(CHANGES[told](made), log)
    with pytest.raises(DataError, match=f"{re.escape(told)}.*imutool convert LOG OUT --fix"):
        train([log], model, method="linear")
    assert not model.exists()


@pytest.mark.parametrize("told", CHANGES)
def test_no_folder_states_units_axes_or_frames_that_its_numbers_have_not(told: str, made: Recording, tmp_path: Path) -> None:
    """The header of a EuRoC table says rad/s and m/s²: readings in g passed for these."""
    log, out = tmp_path / "log.mcap", tmp_path / "euroc"
    write(CHANGES[told](made), log)
    with pytest.raises(DataError, match=f"{re.escape(told)}.*imutool convert LOG OUT --fix"):
        export(log, out, format="euroc")
    assert not out.exists()


@pytest.mark.parametrize("told", CHANGES)
def test_nothing_is_simulated_along_poses_of_another_world_or_unit(told: str, made: Recording, tmp_path: Path) -> None:
    """Of the log's own samples nothing is taken, so that their units and axes count for nothing."""
    log, out = tmp_path / "log.mcap", tmp_path / "sim.mcap"
    write(CHANGES[told](made), log)
    if not told.startswith(("-z up", "are in mm")):
        simulate(log, out)
        return
    with pytest.raises(DataError, match=f"{re.escape(told)}.*imutool convert LOG OUT --fix"):
        simulate(log, out)
    assert not out.exists()


def test_no_case_is_concealed_along_such_poses(
    imutool: Callable[..., subprocess.CompletedProcess[str]], made: Recording, tmp_path: Path
) -> None:
    write(in_mm(made), tmp_path / "log.mcap")
    done = imutool("conceal", "log.mcap", "case", cwd=tmp_path)
    assert done.returncode == 4
    assert "are in mm and not in m" in done.stderr
    assert not (tmp_path / "case").exists()


@pytest.mark.parametrize(("p_wb", "scored"), [(in_ned, False), (in_mm, False), (lambda made: made, True)])
def test_positions_of_another_world_or_unit_are_not_scored(
    p_wb: Callable[[Recording], Recording], scored: bool, made: Recording, tmp_path: Path
) -> None:
    log = tmp_path / "log.mcap"
    write(p_wb(made), log)
    (found,) = evaluate(log)
    assert found["aoe_deg"] > 0.0
    figures = [found[name] for name in ("ape_m", "velocity_rmse_m_s", "drift_velocity_m_s")]
    assert [figure is not None for figure in figures] == 3 * [scored]


@pytest.mark.parametrize(("axes", "told"), [(np.eye(3), False), (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), True)])
def test_gravity_shows_an_imu_that_lies_otherwise_than_a_robot_on_a_floor(
    axes: np.ndarray, told: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Turns about one axis do not, and odometry is no evidence of axes: as on a Husky whose IMU has its y up."""
    t_s, rng = np.arange(3000) / 100.0, np.random.default_rng(4)
    yaw, rate = np.sin(0.7 * t_s), 0.7 * np.cos(0.7 * t_s)
    v_w = np.stack([np.cos(yaw), np.sin(yaw), 0.0 * t_s], axis=1)
    p_wb, q_wb = np.cumsum(v_w, axis=0) / 100.0, Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0])
    rates = np.stack([0.0 * t_s, 0.0 * t_s, rate], axis=1)
    force = np.stack([0.0 * t_s, rate, 9.81 + 0.0 * t_s], axis=1)  # centripetal at 1 m/s
    gyro, accel = ((each + rng.normal(0.0, 1e-2, (3000, 3))) @ axes.T for each in (rates, force))
    t_ns = np.rint(t_s * 1e9).astype(np.int64)
    poses = Poses(t_ns[::5], p_wb[::5], q_wb.as_quat(scalar_first=True)[::5])
    topic = "/ground_truth/pose"
    write(Recording("log", Imu(t_ns, gyro, accel), {topic: poses}), tmp_path / "true.mcap")
    convert(tmp_path / "true.mcap", tmp_path / "log.mcap", kinds=[f"{topic}=odometry"])
    evaluate(tmp_path / "log.mcap", truth=topic)
    said = [line.getMessage() for line in caplog.records if "along the z of the poses" in line.getMessage()]
    assert len(said) == told


def test_the_command_that_corrects_estimated_poses_calls_them_true(
    made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """`convert --fix` alone judges no poses of another kind."""
    topic, log, fixed = "/ground_truth/pose", tmp_path / "log.mcap", tmp_path / "fixed.mcap"
    write(in_ned(made), tmp_path / "true.mcap")
    convert(tmp_path / "true.mcap", log, kinds=[f"{topic}=estimate"])
    evaluate(log, truth=topic)
    (told,) = [line.getMessage() for line in caplog.records if "has -z up" in line.getMessage()]
    assert told.endswith(f"imutool convert LOG OUT --fix --kind {topic}=truth corrects it")
    convert(log, fixed, kinds=[f"{topic}=truth"], fix=True)
    caplog.clear()
    (found,) = evaluate(fixed, truth=topic)
    assert found["ape_m"] is not None
    assert not caplog.records


def test_a_log_as_it_should_be_brings_no_warning(made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = tmp_path / "log.mcap"
    write(made, log)
    evaluate(log)
    debias(log, tmp_path / "out.mcap", init="0,0,0,0,0,0")
    assert "--fix" not in caplog.text


def test_a_log_in_g_is_not_debiased_as_metres_a_second_squared(made: Recording, tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write(CHANGES["accel looks like g"](made), log)
    with pytest.raises(ModelError, match=r"specific force has a median of .*--fix"):
        debias(log, out, init="0,0,0,0,0,0")
    assert not out.exists()


def test_no_model_fits_samples_whose_axes_the_poses_contradict(
    made: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A reversed accelerometer turned as gravity does, and the verdict in `--json` was that the model fits."""
    wrong = CHANGES["accel contradicts"](made)
    write(wrong, tmp_path / "log.mcap")
    report = debias(tmp_path / "log.mcap", tmp_path / "out.mcap", model="static")
    (scored,) = [row["fit"] for row in evaluate(tmp_path / "log.mcap", models=["static"]) if row["model"] == "static"]
    caplog.clear()
    fitness = debias_recording(wrong, "static").fitness
    assert "accel contradicts the true poses" in caplog.text
    for verdict, reasons in (
        (report.fits["/imu0"].verdict, report.fits["/imu0"].reasons),
        (scored["verdict"], scored["reasons"]),
        (fitness.verdict, fitness.reasons),
    ):
        assert verdict == "doubtful"
        assert reasons[0].startswith("accel contradicts the true poses")


@pytest.mark.parametrize("angle_deg", [3.0, 5.0, 46.0])
def test_info_measures_how_the_body_of_the_poses_is_turned(tmp_path: Path, angle_deg: float) -> None:
    made, turn = flight(2, duration_s=20.0), Rotation.from_rotvec([0.0, -angle_deg, 0.0], degrees=True)
    q_wb = (Rotation.from_quat(made.truth.q_wb_wxyz, scalar_first=True) * turn).as_quat(scalar_first=True)
    write(replace(made, truths={"/ground_truth/pose": replace(made.truth, q_wb_wxyz=q_wb)}), tmp_path / "log.mcap")
    report = inspect(tmp_path / "log.mcap")
    (truth,) = report.truth
    assert np.allclose(truth.body_turned_deg, turn.as_rotvec(degrees=True), atol=1.0)
    warned = [warning for warning in report.warnings if "the body of the poses" in warning]
    assert len(warned) == (angle_deg > 4.0)


@pytest.mark.parametrize(("rate", "verdict"), [(0.0, "fits"), (0.015, "doubtful")])
def test_a_steady_turn_of_the_true_poses_contradicts_a_bias_from_stops(rate: float, verdict: str) -> None:
    """On a turntable a constant bias was said to fit, with the whole turn in it."""
    t_ns, rng = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(3000), np.random.default_rng(1)
    gyro = np.array([0.004, -0.003, 0.002 + rate]) + 0.003 * rng.normal(size=(3000, 3))
    imu = Imu(t_ns, gyro, np.array([0.0, 0.0, 9.81]) + 0.03 * rng.normal(size=(3000, 3)))
    angle = rate * np.arange(300) / 10.0 + 1e-3 * rng.normal(size=300)
    q_wb = Rotation.from_euler("z", angle[:, None]).as_quat(scalar_first=True)
    table = Recording("table", imu, {"/ground_truth/pose": Poses(t_ns[::10], np.zeros((300, 3)), q_wb)})
    fitness = debias_recording(table, model="static").fitness
    assert (fitness.verdict, "turns steadily by 0.015 rad/s" in fitness.reasons[0]) == (verdict, rate > 0.0)
