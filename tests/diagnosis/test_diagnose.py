"""From logs on disk to the answer: what was planted is named, placed, sized and removed; nothing is said of nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import planted

from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.result import Diagnosis
from imutool.errors import DataError, LogError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.noise import datasheet
from imutool.recording import Recording, Scalars
from imutool.report import json_values
from imutool.sensor import catalogue
from imutool.sensor.made_up_flight import flight
from imutool.sensor.simulate import simulated

SURE = 4.0
ARM = [0.2, -0.05, 0.1]
FLOOR = 0.15  # how well a noise level is known from twenty seconds
SIM_HZ = 200.0
Made = Callable[..., tuple[Path, Path]]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Writes a recording with effects and a simulation of the same motion without, and says where they are."""

    def make(
        effects: Mapping[str, Sequence[float]] | None = None,
        *,
        seed: int = 1,
        name: str = "real",
        real_poses: bool = False,
        sim_noise: bool = True,
        keep: np.ndarray | None = None,
        added: Callable[[Any], np.ndarray] | None = None,
        lsb: np.ndarray | None = None,
        sim_seed: int | None = None,
    ) -> tuple[Path, Path]:
        folder, felt = tmp_path_factory.mktemp("pair"), planted.rich(seed)
        real = planted.ideal(felt, planted.acting(effects or {})) + planted.noise(len(felt.t_s), seed) + planted.BIAS
        if added is not None:
            real = real + added(felt)
        if lsb is not None:
            real = lsb * np.round(real / lsb)
        rows = np.ones(len(real), bool) if keep is None else keep
        path = planted.moving(seed)
        truth = planted.poses(path, planted.clock(rate_hz=SIM_HZ)) if real_poses else None
        recording = planted.recording(name, felt.t_s[rows], real[rows], poses=truth)
        t_sim = planted.clock(rate_hz=SIM_HZ)
        path = planted.moving(seed if sim_seed is None else sim_seed)
        imu = path.imu(path.start_ns + np.round(t_sim * 1e9).astype(np.int64))
        sim = np.concatenate([imu.gyro, imu.accel], axis=1) + (planted.noise(len(t_sim), seed + 99) if sim_noise else 0.0)
        write(recording, folder / f"{name}.mcap")
        write(planted.recording("sim", t_sim, sim, poses=planted.poses(path, t_sim)), folder / "sim.mcap")
        return folder / f"{name}.mcap", folder / "sim.mcap"

    return make


def effects(found: Diagnosis) -> list[str]:
    return [one.effect for one in found.findings]


def near(found: Diagnosis, effect: str, truth: Mapping[str, float]) -> bool:
    one = next(one for one in found.findings if one.effect == effect)
    return all(abs(one.parameters[name].value - value) < SURE * one.parameters[name].std for name, value in truth.items())


def begin(recording: Recording, seconds: float = 8.0) -> Recording:
    first = int(recording.imu.t_ns[0])
    return recording.between(first, first + int(seconds * 1e9))


@pytest.fixture(scope="module")
def nothing(made: Made) -> tuple[Path, Path, Diagnosis]:
    """A bias and noise, against a simulation."""
    real, sim = made()
    return real, sim, diagnose([real], sim)


@pytest.fixture(scope="module")
def arm(made: Made) -> tuple[Path, Path, Diagnosis]:
    """A lever arm, against a simulation."""
    real, sim = made({"lever_arm": ARM})
    return real, sim, diagnose([real], sim)


@pytest.fixture(scope="module")
def arm_by_poses(made: Made) -> tuple[Path, Diagnosis]:
    """A lever arm, against the recording's own poses."""
    real, _ = made({"lever_arm": ARM}, real_poses=True)
    return real, diagnose([real])


# ── nothing ──


def test_noise_and_a_constant_bias_are_no_mismatch(nothing: tuple[Path, Path, Diagnosis]) -> None:
    _, _, found = nothing
    assert not found.mismatch
    assert found.findings == ()
    assert found.located == ()
    assert found.not_identifiable == ()
    assert (np.abs(found.bias[0] - planted.BIAS) < 6 * planted.NOISE / np.sqrt(2000)).all()
    for signal, noise in (("gyro", planted.NOISE[0]), ("accel", planted.NOISE[3])):
        assert found.unexplained[signal].white
        assert found.unexplained[signal].noise_floor == pytest.approx(noise, rel=FLOOR)
        assert found.unexplained[signal].rms == pytest.approx(noise, rel=FLOOR)


def test_noise_and_a_constant_bias_are_no_mismatch_beside_true_poses_either(made: Made) -> None:
    real, _ = made(seed=2, real_poses=True)
    assert not diagnose([real]).mismatch


def test_a_simulation_without_gravity_is_told(
    nothing: tuple[Path, Path, Diagnosis], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Without an attitude no effect says so, and an arm stood for a part of it."""
    real, sim, _ = nothing
    ideal, recorded = read(sim), read(real)
    R_bw = Rotation.from_quat(ideal.truth.at(ideal.imu.t_ns)[0].q_wb_wxyz, scalar_first=True).inv()
    accel = ideal.imu.accel - R_bw.apply([0.0, 0.0, 9.81])
    write(begin(replace(ideal, imu=replace(ideal.imu, accel=accel), truths={})), tmp_path / "weightless.mcap")
    write(begin(replace(recorded, truths={})), tmp_path / "real.mcap")

    def until_the_search(done: int, total: int, text: str) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        diagnose([tmp_path / "real.mcap"], tmp_path / "weightless.mcap", tell=until_the_search)
    assert [
        line
        for line in caplog.messages
        if line.startswith(f"{ideal.name} {ideal.imu_topic}: accel reads") and "gravity" in line
    ]


def test_times_count_from_the_start_of_the_log_also_where_its_poses_begin_later(made: Made, tmp_path: Path) -> None:
    real, _ = made({"lever_arm": ARM}, real_poses=True)
    recording = read(real)
    late_s = 3.0
    truth = recording.truth.between(int(recording.imu.t_ns[0]) + int(late_s * 1e9), int(recording.imu.t_ns[-1]))
    write(replace(recording, truths={"/ground_truth/pose": truth}), tmp_path / "late.mcap")
    found = diagnose([tmp_path / "late.mcap"])
    assert effects(found) == ["lever_arm"]
    assert late_s <= found.traces[0].t_s[0] < late_s + 1.0
    assert min(first for place in found.located for first, _ in place.intervals_s) >= late_s


# ── the JSON ──

KEYS = {"schema", "real", "sim", "mismatch", "located", "findings", "bias", "not_identifiable", "unexplained"}


def test_the_json_has_the_fields_that_programs_read(arm: tuple[Path, Path, Diagnosis]) -> None:
    real, sim, found = arm
    plain = json_values(found.report)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert set(plain) >= KEYS
    assert plain["schema"] == "imutool.diagnosis/1"
    assert plain["real"] == [str(real)]
    assert plain["sim"] == str(sim)
    assert plain["mismatch"] is True
    (place,) = plain["located"]
    assert set(place) >= {"signal", "axes", "intervals_s", "regime", "share", "p_value"}
    assert place["signal"] == "accel"
    assert set(place["axes"]) <= {"x", "y", "z"}
    assert all(0.0 <= begin < end for begin, end in place["intervals_s"])
    (one,) = plain["findings"]
    assert set(one) >= {"effect", "signal", "share", "p_value", "false_discovery_rate", "parameters", "equation", "held_out"}
    assert one["effect"] == "lever_arm"
    assert one["signal"] == "accel"
    assert set(one["parameters"]) == {"x", "y", "z"}
    assert one["parameters"]["x"]["unit"] == "m"
    assert set(one["parameters"]["x"]) == {"value", "std", "unit"}
    assert set(one["held_out"]) == {"rms_before", "rms_after", "unit", "seconds"}
    assert one["held_out"]["unit"] == "m/s^2"
    assert set(plain["bias"]) == {"gyro", "accel"}
    assert len(plain["bias"]["gyro"]) == 3
    assert set(plain["unexplained"]) >= {"gyro_rms", "accel_rms", "noise_floor", "white"}
    assert set(plain["unexplained"]["noise_floor"]) == {"gyro", "accel"}


def test_the_json_of_nothing_says_so_and_has_every_field(nothing: tuple[Path, Path, Diagnosis]) -> None:
    plain = json_values(nothing[2].report)
    json.dumps(plain, allow_nan=False)
    assert set(plain) >= KEYS
    assert plain["mismatch"] is False
    assert plain["findings"] == []
    assert plain["located"] == []


# ── what was planted ──


def test_a_lever_arm_is_named_sized_placed_and_removed(arm: tuple[Path, Path, Diagnosis]) -> None:
    found = arm[2]
    assert effects(found) == ["lever_arm"]
    assert near(found, "lever_arm", dict(zip("xyz", ARM, strict=True)))
    (one,) = found.findings
    assert one.share > 0.9
    assert one.p_value < 1e-12
    assert one.false_discovery_rate < 0.01
    assert one.held_out.rms_before > 5 * planted.NOISE[3]
    assert one.held_out.rms_after == pytest.approx(planted.NOISE[3], rel=FLOOR)
    assert 4.0 < one.held_out.seconds < 12.0  # about a third of 24 s
    closer = found.closer["accel"]
    assert closer.by == "second simulation"
    assert closer.rms_before == pytest.approx(one.held_out.rms_before, rel=1e-9)
    assert closer.rms_after == pytest.approx(one.held_out.rms_after, rel=0.01)  # another way to the same: smoothed poses
    assert closer.share == pytest.approx(1.0, abs=0.01)
    assert [place.signal for place in found.located] == ["accel"]
    (trace,) = found.traces
    assert trace.real.shape == trace.before.shape == trace.after.shape
    assert (trace.real - trace.after)[:, 3:].std() < 1.1 * planted.NOISE[3] < (trace.real - trace.before)[:, 3:].std()


def test_an_offset_of_clocks_that_share_no_epoch_is_no_finding(made: Made, tmp_path: Path) -> None:
    real, sim = made({"lever_arm": ARM})
    simulated, away_ns = read(sim), 86_400_003_700_000
    imu, poses = simulated.imu, replace(simulated.truth, t_ns=simulated.truth.t_ns + away_ns)
    moved = replace(simulated, imu=replace(imu, t_ns=imu.t_ns + away_ns), truths=dict.fromkeys(simulated.truths, poses))
    write(moved, tmp_path / "sim.mcap")
    found = diagnose([real], tmp_path / "sim.mcap")
    assert effects(found) == ["lever_arm"]
    assert near(found, "lever_arm", dict(zip("xyz", ARM, strict=True)))


def test_a_lag_of_another_signal_shows_by_the_clock_of_the_imu_where_the_logs_share_no_epoch(tmp_path: Path) -> None:
    """A gauge that is late and slow, next to one that both logs copy from the motion."""
    rng, t_s = np.random.default_rng(4), planted.clock(40.0)
    path = planted.moving(4, 40.0)
    imu = path.imu(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
    samples, every = np.concatenate([imu.gyro, imu.accel], axis=1), slice(5, -5, 5)
    logs, delay_s = [tmp_path / "real.mcap", tmp_path / "sim.mcap"], 0.12
    for log, start_ns, late_s in zip(logs, (planted.START_NS, 0), (delay_s, 0.0), strict=True):
        recorded = planted.recording(log.stem, t_s, samples + planted.noise(len(t_s), len(log.stem)), start_ns)
        gauge = np.interp(t_s - late_s, t_s, imu.gyro[:, 0])[every] + 0.01 * rng.normal(size=len(t_s[every]))
        t_ns, copied = recorded.imu.t_ns[every], imu.gyro[every, 1]
        scalars = {name: Scalars(t_ns, values[:, None]) for name, values in (("/gauge", gauge), ("/copied", copied))}
        write(replace(recorded, scalars=scalars), log)
    found = diagnose(logs[:1], logs[1])
    assert [(one.effect, one.signal) for one in found.findings] == [("delay", "/gauge.data")]
    assert near(found, "delay", {"delay": delay_s})
    assert any("/copied" in remark and "same in both" in remark for remark in found.remarks)


def test_impacts_and_noise_of_both_are_no_mismatch(tmp_path: Path) -> None:
    """A body that is thrown: its forces last for a sample, and its rates jump."""
    rng, t_s = np.random.default_rng(3), planted.clock(12.0, 240.0)
    path = planted.moving(3, 12.0)
    imu = path.imu(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
    felt, hits = np.concatenate([0.1 * imu.gyro, 0.01 * imu.accel], axis=1), np.arange(60, len(t_s), 120)
    felt[hits, 3:] += rng.normal(scale=200.0, size=(len(hits), 3))
    for hit in hits:
        felt[hit:, :3] += rng.normal(size=3) - 0.5 * felt[hit, :3]
    logs = [tmp_path / "real.mcap", tmp_path / "sim.mcap"]
    for log, start_ns, bias in zip(logs, (planted.START_NS, 0), (planted.BIAS, 0.0), strict=True):
        noisy = felt + np.repeat([2e-3, 2e-2], 3) * rng.normal(size=felt.shape) + bias
        write(planted.recording(log.stem, t_s, noisy, start_ns), log)
    assert effects(diagnose(logs[:1], logs[1])) == []


@pytest.mark.parametrize(("seed", "cutoff_hz"), [(0, None), (1, 15.0)])
def test_a_low_pass_is_more_than_what_smooths_a_simulations_noise(seed: int, cutoff_hz: float | None, tmp_path: Path) -> None:
    """Clocks without a common epoch hide its lag; the noise of a simulation of 240 Hz looked like one."""
    rng, t_s = np.random.default_rng(seed), planted.clock(20.0, 240.0)
    path, own_s, noise = planted.moving(seed, 20.0), t_s[10:-10], np.repeat([2e-3, 2e-2], 3)
    imu = path.imu(path.start_ns + np.round(t_s * 1e9).astype(np.int64))
    slow = planted.acting({} if cutoff_hz is None else {"low_pass": [cutoff_hz]})
    real, sim = planted.ideal(planted.rich(seed, 20.0), slow, own_s), np.concatenate([imu.gyro, imu.accel], axis=1)
    real, sim = (samples + noise * rng.normal(size=samples.shape) for samples in (real, sim))
    write(planted.recording("real", own_s, real), tmp_path / "real.mcap")
    write(planted.recording("sim", t_s, sim, 0), tmp_path / "sim.mcap")
    found = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap")
    assert effects(found) == ([] if cutoff_hz is None else ["low_pass"])


def test_a_pair_is_named_whole_strongest_first(made: Made) -> None:
    real, sim = made({"clock_offset": [0.004], "lever_arm": ARM})
    found = diagnose([real], sim)
    assert sorted(effects(found)) == ["clock_offset", "lever_arm"]
    assert near(found, "clock_offset", {"tau": 0.004})
    assert near(found, "lever_arm", dict(zip("xyz", ARM, strict=True)))
    p_values = [one.p_value for one in found.findings]
    assert p_values == sorted(p_values)


def test_without_a_simulation_the_recordings_own_poses_serve(arm_by_poses: tuple[Path, Diagnosis]) -> None:
    found = arm_by_poses[1]
    assert effects(found) == ["lever_arm"]
    assert found.sim is None
    assert json_values(found.report)["sim"] is None
    assert near(found, "lever_arm", dict(zip("xyz", ARM, strict=True)))


def test_what_separates_the_two_is_never_denied(made: Made) -> None:
    """A misfit four times the noise, whatever it is called: the answer is not that nothing but noise is there."""

    def bent(felt: Any) -> np.ndarray:
        out = np.zeros((len(felt.t_s), 6))
        out[:, 4] = 0.5 * np.tanh(felt.gyro[:, 2] / 0.4)
        return out

    real, sim = made(added=bent, seed=9)
    found = diagnose([real], sim)
    assert found.mismatch
    assert not {one.effect for one in found.findings} - {"unknown"}


UNCALIBRATED = {
    "gyro_scale": [0.06, -0.08, -0.02],
    "gyro_misalignment": [0.02, -0.03, 0.01, 0.015, -0.02, 0.02],
    "accel_scale": [-0.02, -0.03, 0.05],
    "accel_misalignment": [0.03, 0.02, -0.02, 0.03, -0.02, 0.015],
    "lever_arm": [0.1, -0.05, 0.08],
    "gravity": [0.0, 0.02, -0.015],
}


def test_a_sensor_that_was_never_calibrated_has_many_errors_and_each_is_named(tmp_path: Path) -> None:
    """After four of them the misfit is still more than the noise; each takes a good part of what is left."""
    path = flight(3, duration_s=60.0, rate_hz=100.0)
    acting = [(catalogue.effects([name])[0], np.array(values)) for name, values in UNCALIBRATED.items()]
    made, rng, poses = (
        simulated(path, acting, datasheet.read("bmi160"), 100.0, 3).recording,
        np.random.default_rng(3),
        path.truth,
    )
    p_wb, turn = (
        poses.p_wb + 1e-4 * rng.normal(size=poses.p_wb.shape),
        Rotation.from_rotvec(1e-4 * rng.normal(size=poses.p_wb.shape)),
    )
    q_wb = (Rotation.from_quat(poses.q_wb_wxyz, scalar_first=True) * turn).as_quat(scalar_first=True)
    write(
        replace(made, truths={"/pose": replace(poses, p_wb=p_wb, q_wb_wxyz=np.ascontiguousarray(q_wb))}), tmp_path / "log.mcap"
    )
    found = diagnose([tmp_path / "log.mcap"])
    assert sorted(effects(found)) == sorted(UNCALIBRATED)
    assert near(found, "gyro_scale", dict(zip("xyz", UNCALIBRATED["gyro_scale"], strict=True)))


# ── what stamps and digits show ──


def test_missing_samples_are_counted_and_a_coarse_grid_is_told_with_its_step(made: Made) -> None:
    keep = np.ones(2400, bool)
    keep[np.random.default_rng(4).choice(np.arange(50, 2350), 12, replace=False)] = False
    real, sim = made(keep=keep, lsb=np.repeat([0.01, 0.1], 3))
    found = diagnose([real], sim)
    assert sorted(effects(found)) == ["dropped_samples", "quantization"]
    told = {one.effect: one.parameters for one in found.findings}
    assert told["dropped_samples"]["missing"].value == 12
    assert told["quantization"]["gyro_lsb"].value == pytest.approx(0.01, rel=1e-3)
    assert told["quantization"]["accel_lsb"].value == pytest.approx(0.1, rel=1e-3)
    json.dumps(json_values(found.report), allow_nan=False)


# ── several logs, and what is refused ──


def test_several_recordings_share_the_physics_and_have_a_bias_each(made: Made, arm_by_poses: tuple[Path, Diagnosis]) -> None:
    first, alone = arm_by_poses
    second, _ = made({"lever_arm": ARM}, seed=2, name="second", real_poses=True)
    both = diagnose([first, second])
    assert effects(both) == ["lever_arm"]
    assert both.bias.shape == (2, 6)
    assert len(json_values(both.report)["biases"]) == 2
    assert len(both.traces) == 2
    assert {place.log for place in both.located} == {str(first), str(second)}
    assert {place["log"] for place in json_values(both.report)["located"]} == set(json_values(both.report)["real"])
    assert "log" not in json_values(alone.report)["located"][0]
    assert both.findings[0].parameters["x"].std < alone.findings[0].parameters["x"].std
    assert near(both, "lever_arm", dict(zip("xyz", ARM, strict=True)))


def test_neither_truth_nor_simulation_is_refused_with_what_would_help(made: Made) -> None:
    real, _ = made()
    with pytest.raises(DataError, match=r"no simulation and no true poses.*`sim`"):
        diagnose([real])


def test_a_simulation_of_another_motion_is_refused(made: Made) -> None:
    real, sim = made(sim_seed=7)
    with pytest.raises(DataError, match="motion"):
        diagnose([real], sim)


def test_what_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "real.mcap").write_bytes(b"no log at all")
    with pytest.raises(LogError):
        diagnose([tmp_path / "real.mcap"])


def test_logs_are_left_as_they_are_and_progress_is_told_and_the_answer_is_the_same_again(
    arm: tuple[Path, Path, Diagnosis],
) -> None:
    real, sim, found = arm
    before = real.read_bytes(), sim.read_bytes()
    told: list[tuple[int, int]] = []
    again = diagnose([real], sim, tell=lambda done, total, _: told.append((done, total)))
    assert json_values(again.report) == json_values(found.report)
    assert (real.read_bytes(), sim.read_bytes()) == before
    assert told == sorted(told)
    assert told[0][0] == 0
    assert told[-1][0] == told[-1][1]
    assert sorted(path.name for path in real.parent.iterdir()) == ["real.mcap", "sim.mcap"]


def test_a_second_simulation_has_the_filter_of_each_sensor(made: Made) -> None:
    """Both have one equation, and the filter of one sensor was simulated on the other as well."""

    def filtered(felt: Any) -> np.ndarray:
        of_each = (planted.ideal(felt, planted.acting({"second_order_low_pass": [hz, 0.7]})) for hz in (3.0, 6.0))
        gyro, accel = (x - planted.ideal(felt, ()) for x in of_each)
        return np.concatenate([gyro[:, :3], accel[:, 3:]], axis=1)

    real, sim = made(added=filtered, sim_noise=False)
    found = diagnose([real], sim)
    assert effects(found) == ["second_order_low_pass"] * 2
    by_signal = {one.signal: one.parameters["f_c"] for one in found.findings}
    assert by_signal["gyro"].value == pytest.approx(3.0, abs=SURE * by_signal["gyro"].std)
    assert by_signal["accel"].value == pytest.approx(6.0, abs=SURE * by_signal["accel"].std)
    for closer in found.closer.values():
        assert closer.share == pytest.approx(1.0, abs=0.02)
