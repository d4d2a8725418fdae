"""A second simulation keeps what the first has beyond its poses, and adds the physics that was found."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.api.sensors import simulate as simulate_log
from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.second_simulation import simulate_again
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.file_writer import LogWriter
from imutool.mcap_io.read import read
from imutool.mcap_io.write import Series, chunks, write
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import Imu, Poses, Recording, Scalars
from imutool.sensor import catalogue, physics_file
from imutool.sensor.effect import Acting
from imutool.sensor.made_up_flight import flight
from imutool.sensor.physics_file import Bias, Entry, PhysicsFile, Value
from imutool.sensor.simulate import simulate, simulated
from imutool.units import SENSORS
from imutool.viewing.html.diagnosis_paths import held_out_stretches, rms_drift

RATE_HZ, DURATION_S = 100.0, 30.0
SCALE = PhysicsFile(effect=(Entry(name="gyro_scale", parameters={"x": Value(value=0.03, unit="-")}),))
WARMTH = PhysicsFile(
    effect=(Entry(name="temperature", parameters={"gyro_x": Value(value=1e-3, unit="rad/s per K")}),),
    bias=Bias(gyro=(0.01, 0.0, 0.0), accel=(0.0, 0.0, 0.0)),
)
READ = 0.01  # of the change that the physics makes: a spline at 100 Hz reads so far next to it


def sensor(acting: Acting = (), scalars: dict[str, Scalars] | None = None) -> Recording:
    path = replace(flight(3, duration_s=DURATION_S, rate_hz=RATE_HZ), scalars=scalars or {})
    return simulated(path, acting, Noise(), RATE_HZ, 1).recording


def again(tmp_path: Path, real: Recording, sim: Recording | Path, physics: PhysicsFile) -> Imu:
    """Samples of the second simulation."""
    places = [tmp_path / name for name in ("real.mcap", "sim.mcap", "closed.mcap", "physics.toml")]
    recorded, given, closed, file = places
    write(real, recorded)
    if isinstance(sim, Path):
        sim.rename(given)
    else:
        write(sim, given)
    physics_file.write(physics, file)
    simulate_again(recorded, given, closed, physics=file, imu=None, settings=DiagnoseSettings(), overwrite=False)
    assert read(closed).name == "closed"
    return read(closed).imu


@pytest.mark.parametrize("poses", [True, False])
def test_a_simulated_imu_that_sits_beside_its_poses_stays_there(tmp_path: Path, poses: bool) -> None:
    """As in Gazebo or Isaac Lab, which log the poses of the base; an ideal sensor along them would lose the arm."""
    arm = [(effect, np.array([0.2, -0.1, 0.3])) for effect in catalogue.effects(["lever_arm"])]
    sim, wanted = sensor(arm), sensor([*arm, *SCALE.acting()])
    found = again(tmp_path, wanted, sim if poses else replace(sim, truths={}), SCALE)
    assert len(found) == len(sim.imu)
    change = (wanted.imu.gyro - sim.imu.gyro).std(axis=0).max()
    assert np.abs(found.gyro - wanted.imu.gyro).max() < READ * change
    assert np.abs(found.accel - sim.imu.accel).max() < READ * (sim.imu.accel - sensor().imu.accel).std()


@pytest.mark.parametrize("poses", [True, False])
def test_a_simulator_that_runs_again_gets_the_physics_on_its_samples(tmp_path: Path, poses: bool) -> None:
    """Of another motion, years later, with a sensor next to its poses and no recording."""
    arm = [(effect, np.array([0.2, -0.1, 0.3])) for effect in catalogue.effects(["lever_arm"])]
    sim, wanted = sensor(arm), sensor([*arm, *SCALE.acting()])
    run, out, file = tmp_path / "run.mcap", tmp_path / "better.mcap", tmp_path / "physics.toml"
    write(replace(sim if poses else replace(sim, truths={}), imu_topic="/sim/imu"), run)
    physics_file.write(msgspec.structs.replace(SCALE, start_ns=int(sim.imu.t_ns[0]) - 10**18), file)
    made = simulate_log(run, out, physics=file, imu="/sim/imu")
    found = read(out)
    assert (made.motion is None, bool(found.truths)) == (True, poses)
    np.testing.assert_array_equal(found.imu.t_ns, sim.imu.t_ns)
    change = (wanted.imu.gyro - sim.imu.gyro).std(axis=0).max()
    assert np.abs(found.imu.gyro - wanted.imu.gyro).max() < READ * change
    assert np.abs(found.imu.accel - sim.imu.accel).max() < READ * (sim.imu.accel - sensor().imu.accel).std()


def test_samples_may_be_taken_at_another_rate_and_get_noise(tmp_path: Path) -> None:
    sim = sensor()
    write(sim, tmp_path / "run.mcap")
    made = simulate_log(tmp_path / "run.mcap", tmp_path / "half.mcap", imu=sim.imu_topic, rate_hz=RATE_HZ / 2, noise="bmi160")
    imu = read(tmp_path / "half.mcap").imu
    assert made.plain()["rate_hz"] == RATE_HZ / 2
    np.testing.assert_allclose(np.diff(imu.t_ns), 2e9 / RATE_HZ, atol=1.0)
    noise = imu.gyro - sim.imu.gyro[::2][: len(imu)]
    assert noise[:, 0].std() == pytest.approx(datasheet.read("bmi160").gyro_density[0] * np.sqrt(RATE_HZ / 2), rel=0.1)


def test_poses_in_a_world_whose_z_is_down_are_no_obstacle(tmp_path: Path) -> None:
    """`diagnose` turns them by the name of their world; `simulate` takes them as they are."""
    sim, wanted = sensor(), sensor(SCALE.acting())
    down = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    q_wb = (down * Rotation.from_quat(sim.truth.q_wb_wxyz, scalar_first=True)).as_quat(scalar_first=True)
    poses = Poses(sim.truth.t_ns, down.apply(sim.truth.p_wb.copy()), q_wb)
    with LogWriter(tmp_path / "robot.mcap") as log:
        imu, body = (sim.imu.t_ns, sim.imu.gyro, sim.imu.accel), (poses.t_ns, poses.p_wb, poses.q_wb_wxyz)
        encode = partial(encode_imu, frame_id="base"), partial(encode_pose, frame_id="odom_ned")
        kinds = ("/imu", schemas.IMU), ("/ground_truth/pose", schemas.POSE)
        series = [
            Series(log.channel(*kind), part[0], part, encoded)
            for kind, part, encoded in zip(kinds, (imu, body), encode, strict=True)
        ]
        for chunk in chunks(series):
            log.chunk(chunk)
    found = again(tmp_path, wanted, tmp_path / "robot.mcap", SCALE)
    assert np.abs(found.gyro - wanted.imu.gyro).max() < READ * (wanted.imu.gyro - sim.imu.gyro).std(axis=0).max()
    assert np.abs(found.accel - sim.imu.accel).max() < READ


def test_an_effect_of_the_temperature_follows_that_of_the_recording(tmp_path: Path) -> None:
    """A simulator logs none."""
    sim = sensor()
    t_ns = sim.imu.t_ns[::100]
    celsius = 20.0 + 10.0 * np.arange(len(t_ns)) / len(t_ns)
    real = sensor(WARMTH.acting(), {"/imu/temperature": Scalars(t_ns, celsius[:, None])})
    found = again(tmp_path, real, sim, WARMTH)
    change = np.ptp(real.imu.gyro[:, 0] - sim.imu.gyro[:, 0])
    assert change > 0.009  # ten degrees
    np.testing.assert_allclose(found.gyro, real.imu.gyro, atol=READ * change)


def test_a_simulation_that_is_ideal_is_simulated_along_its_poses(tmp_path: Path) -> None:
    sim = sensor()
    found = again(tmp_path, sim, sim, SCALE)
    simulate(tmp_path / "sim.mcap", tmp_path / "same.mcap", physics=tmp_path / "physics.toml")
    assert found == read(tmp_path / "same.mcap").imu


def test_a_lag_is_not_counted_twice_where_the_clocks_share_no_epoch(tmp_path: Path) -> None:
    """Alignment by the motion takes the lag of a low-pass; the clock's offset in the fit gives it back."""
    (low_pass,) = catalogue.effects(["low_pass"])
    white = msgspec.structs.replace(datasheet.read("bmi160"), gyro_walk=(0.0,) * 3, accel_walk=(0.0,) * 3)
    path = flight(3, duration_s=60.0, rate_hz=RATE_HZ)
    real = simulated(path, [(low_pass, np.array([4.0]))], white, RATE_HZ, 1).recording
    sim = simulated(path, (), Noise(), RATE_HZ, 1).recording
    away_ns = 10**18  # of the simulation's clock
    imu = replace(sim.imu, t_ns=sim.imu.t_ns - away_ns)
    truths = {topic: replace(poses, t_ns=poses.t_ns - away_ns) for topic, poses in sim.truths.items()}
    write(replace(real, imu_topic="/robot/imu"), tmp_path / "real.mcap")
    write(replace(sim, imu=imu, truths=truths), tmp_path / "sim.mcap")
    found = diagnose([tmp_path / "real.mcap"], tmp_path / "sim.mcap", imu="/robot/imu")  # a simulator calls its own otherwise
    assert [one.effect for one in found.findings] == ["low_pass"]
    for sensor in SENSORS:
        closer = found.closer[sensor]
        assert closer.by == "second simulation"
        assert closer.share is not None
        assert closer.share > 0.95
    (trace,) = found.traces
    assert trace.ideal is not None
    turned = {side: rms_drift(list(held_out_stretches(trace)), side)[1][-1, 0] for side in (1, 2)}
    assert turned[2] < 0.3 * turned[1]  # the drift of the report, with the findings and without
