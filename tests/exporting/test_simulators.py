"""A twin in a simulator's own words: each format is read by its own parser, and holds the physics with its sign and range."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imutool.api.logs import export
from imutool.errors import ConfigError, DataError
from imutool.exporting.twin import read
from imutool.noise import datasheet
from imutool.noise.datasheet import Colour, Noise
from imutool.sensor import physics_file
from imutool.sensor.physics_file import Bias, Curve, Entry, PhysicsFile, Term, Value

PHI, ARM, RATE_HZ = (0.1, -0.2, 0.3), (0.05, -0.02, 0.01), 250.0
NOISE = Noise(
    gyro_density=(1e-3, 2e-3, 3e-3),
    accel_density=(1e-2, 1e-2, 1e-2),
    gyro_walk=(1e-5, 1e-5, 1e-5),
    colour=Colour(
        rate_hz=RATE_HZ,
        window_s=1.0,
        edges_hz=(0.0, 125.0),
        shape=((0.0,) * 126,) * 6,
        mean=((0.0,),) * 6,
        follows_gyro=((0.0,),) * 6,
        follows_accel=((0.0,),) * 6,
        factors=(),
        own=((0.0,),) * 6,
        motion=(0.0, 0.0),
        minimum=(0.0, 0.0),
        maximum=(0.0, 0.0),
        gyro_range=(0.5, 1.5),
        accel_range=(1.0, 1.0),
    ),
)


def diagnosed(folder: Path, *, arm_x: float = ARM[0], bias_x: float = 0.01, noise: Noise = NOISE) -> Path:
    """The folder of a diagnosis: a mount, an arm, digits, a limit and a scale."""
    entries = {
        "lever_arm": {"x": (arm_x, "m"), "y": (ARM[1], "m"), "z": (ARM[2], "m")},
        "mount_rotation": {f"phi_{axis}": (v, "rad") for axis, v in zip("xyz", PHI, strict=True)},
        "quantization": {"gyro_lsb": (0.001, "rad/s")},
        "saturation": {"accel_limit": (40.0, "m/s²")},
        "gyro_scale": {"x": (0.02, "-")},
    }
    effects = tuple(
        Entry(name=name, parameters={k: Value(value=v, std=0.001, unit=unit) for k, (v, unit) in values.items()})
        for name, values in entries.items()
    )
    folder.mkdir(parents=True)
    physics_file.write(PhysicsFile(effect=effects, bias=Bias(gyro=(bias_x, 0.0, -0.02))), folder / "physics.toml")
    datasheet.write(noise, folder / "noise.toml")
    return folder


def test_mujoco_loads_the_site_the_sensors_and_the_ranges(tmp_path: Path) -> None:
    report = export(diagnosed(tmp_path / "d"), tmp_path / "out", format="mujoco")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "imu.xml"))
    np.testing.assert_allclose(model.site_pos[0], ARM, atol=1e-8)
    np.testing.assert_allclose(model.site_quat[0], Rotation.from_rotvec(PHI).as_quat(scalar_first=True), atol=1e-8)
    assert model.sensor_cutoff.tolist() == [0.0, 40.0]
    np.testing.assert_allclose(model.sensor_noise[1], 1e-2 * np.sqrt(RATE_HZ))
    scale = model.numeric("imu.gyro_scale.x").data
    np.testing.assert_allclose(scale, (0.02, 0.018, 0.022))
    np.testing.assert_allclose(model.numeric("imu.gyro_noise.y").data, 2e-3 * np.sqrt(RATE_HZ) * np.array([1.0, 0.5, 1.5]))
    assert report.left_out == ["quantization", "gyro_scale", "the colour of the noise"]
    assert (report.output, report.format, report.imu) == (tmp_path / "out", "mujoco", None)
    assert set(report.written) == {"imu.xml", "physics.toml", "noise.toml"}


def test_mujocos_own_sensor_reads_what_the_forward_model_says(tmp_path: Path) -> None:
    """A body that rests: the turned accelerometer reads R_bi^T g up."""
    export(diagnosed(tmp_path / "d"), tmp_path / "out", format="mujoco")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "imu.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.sensordata[3:], Rotation.from_rotvec(PHI).inv().apply([0.0, 0.0, 9.81]), atol=1e-6)


def test_gazebo_has_pose_noise_walk_and_digits_by_axis(tmp_path: Path) -> None:
    export(diagnosed(tmp_path / "d"), tmp_path / "out", format="gazebo")
    sensor = ElementTree.parse(tmp_path / "out" / "imu.sdf").getroot().find("model/link/sensor")
    assert sensor is not None
    pose = np.array([float(x) for x in (sensor.findtext("pose") or "").split()])
    np.testing.assert_allclose(pose[:3], ARM, atol=1e-8)
    np.testing.assert_allclose(Rotation.from_euler("xyz", pose[3:]).as_rotvec(), PHI, atol=1e-7)
    noise = sensor.find("imu/angular_velocity/z/noise")
    assert noise is not None
    assert noise.get("type") == "gaussian_quantized"
    read = {element.tag: float(element.text or "") for element in noise}
    assert read["mean"] == -0.02
    assert read["bias_mean"] == 0.0  # Gazebo draws its sign
    assert read["precision"] == 0.001
    assert read["dynamic_bias_stddev"] == 1e-5
    np.testing.assert_allclose(read["stddev"], 3e-3 * np.sqrt(RATE_HZ), rtol=1e-6)
    assert sensor.findtext("imu/linear_acceleration/x/noise/dynamic_bias_stddev") == "0", "an unknown walk is none"


def test_a_given_noise_has_the_rate_of_the_diagnosed_sensor(tmp_path: Path) -> None:
    """A density says nothing of a sample without the rate."""
    folder, other = diagnosed(tmp_path / "d"), tmp_path / "other.toml"
    assert NOISE.colour is not None
    datasheet.write(msgspec.structs.replace(NOISE, colour=msgspec.structs.replace(NOISE.colour, rate_hz=100.0)), other)
    for noise in ("bmi160", other):
        report = export(folder, tmp_path / "out", format="gazebo", noise=noise, overwrite=True)
        sensor = ElementTree.parse(tmp_path / "out" / "imu.sdf").getroot().find("model/link/sensor")
        assert sensor is not None
        assert float(sensor.findtext("update_rate") or "") == RATE_HZ
        density = datasheet.read(noise).values("gyro_density")[0]
        stddev = sensor.findtext("imu/angular_velocity/x/noise/stddev")
        np.testing.assert_allclose(float(stddev or ""), density * np.sqrt(RATE_HZ), rtol=1e-6)
        assert not any("rate" in text for text in report.left_out)
    (folder / "noise.toml").unlink()
    report = export(folder, tmp_path / "out", format="gazebo", noise="bmi160", overwrite=True)
    assert any("200 Hz are assumed" in text for text in report.left_out)


class Recorded:
    """Stands for a class of Isaac Lab, which does not install here: it keeps what it is made of."""

    def __init__(self, **values: Any) -> None:
        self.values = values

    class OffsetCfg:
        """Nested as in `ImuCfg`."""

        def __init__(self, pos: tuple[float, ...], rot: tuple[float, ...]) -> None:
            self.pos, self.rot = pos, rot


def test_isaac_is_python_with_the_classes_of_isaac_lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(diagnosed(tmp_path / "d"), tmp_path / "out", format="isaac")
    for name, classes in {
        "isaaclab": (),
        "isaaclab.sensors": ("ImuCfg",),
        "isaaclab.utils": (),
        "isaaclab.utils.noise": ("GaussianNoiseCfg", "NoiseModelWithAdditiveBiasCfg", "UniformNoiseCfg"),
    }.items():
        module = types.ModuleType(name)
        for one in classes:
            setattr(module, one, Recorded)
        monkeypatch.setitem(sys.modules, name, module)
    made: dict[str, Any] = {}
    exec(compile((tmp_path / "out" / "imu.py").read_text(), "imu.py", "exec"), made)
    assert made["IMU"].values["offset"].pos == ARM
    assert made["IMU"].values["update_period"] == 1.0 / RATE_HZ
    np.testing.assert_allclose(made["GYRO_NOISE"].values["noise_cfg"].values["mean"].numpy(), (0.01, 0.0, -0.02), rtol=1e-6)
    bias = made["GYRO_NOISE"].values["bias_noise_cfg"].values
    assert (bias["n_min"], bias["n_max"]) == (0.0, 0.0)  # a row of three does not fit the one column of a bias at a reset
    assert made["RANGES"]["gyro_scale.x"] == pytest.approx((0.018, 0.022))


def test_a_fleet_gives_means_and_ranges(tmp_path: Path) -> None:
    for k, x in enumerate((0.04, 0.05, 0.06)):
        diagnosed(tmp_path / "fleet" / f"robot_{k}", arm_x=x, bias_x=0.01 * k)
    assert export(tmp_path / "fleet", tmp_path / "out", format="toml").left_out == []
    file = physics_file.read(tmp_path / "out" / "physics.toml")
    arm = next(entry for entry in file.effect if entry.name == "lever_arm").parameters["x"]
    assert arm.value == pytest.approx(0.05)
    assert arm.std == pytest.approx(np.hypot(0.01, 0.001))
    assert file.bias is not None
    assert file.bias.gyro[0] == pytest.approx(0.01)
    assert datasheet.read(tmp_path / "out" / "noise.toml") == NOISE


def test_the_biases_of_a_fleet_scatter_and_its_noise_is_that_of_the_middle_unit(tmp_path: Path) -> None:
    biases, sizes = (0.0, 0.01, 0.05), (0.03, 0.01, 0.02)
    for k, (bias_x, size) in enumerate(zip(biases, sizes, strict=True)):
        noise = msgspec.structs.replace(NOISE, accel_density=(size,) * 3)
        diagnosed(tmp_path / "fleet" / f"robot_{k}", bias_x=bias_x, noise=noise)
    export(tmp_path / "fleet", tmp_path / "gazebo", format="gazebo")
    noise_of = ElementTree.parse(tmp_path / "gazebo" / "imu.sdf").getroot().find("model/link/sensor/imu")
    assert noise_of is not None
    spread = float(np.std(biases, ddof=1))
    assert float(noise_of.findtext("angular_velocity/x/noise/bias_stddev") or "") == pytest.approx(spread)
    assert float(noise_of.findtext("linear_acceleration/x/noise/stddev") or "") == pytest.approx(0.02 * np.sqrt(RATE_HZ))
    export(tmp_path / "fleet", tmp_path / "isaac", format="isaac")
    assert f"n_max={2.0 * spread!r}" in (tmp_path / "isaac" / "imu.py").read_text(encoding="utf-8")


def _lines(*f_hz: float) -> tuple[Entry, ...]:
    return tuple(Entry(name="vibration", signal="accel", parameters={"f": Value(value=hz, unit="Hz")}) for hz in f_hz)


def test_a_scale_that_sets_in_is_none_of_the_whole_simulation(tmp_path: Path) -> None:
    values = {"x": Value(value=0.02, unit="-"), "t_step": Value(value=20.0, unit="s")}
    later = Entry(name="gyro_scale", signal="gyro", parameters=values)
    term = Term(signal="accel", term="omega_x omega_y", value=(0.2, 0.0, -0.1))
    curve = Curve(signal="gyro", variable="f_x", unit="m/s²", x=(-3.0, 0.0, 3.0), y=((0.06, 0.0, 0.0),) * 3)
    physics_file.write(PhysicsFile(effect=(later,), term=(term,), unknown=(curve,)), tmp_path / "physics.toml")
    datasheet.write(NOISE, tmp_path / "noise.toml")
    twin = read(tmp_path)
    assert not twin.vector("gyro_scale").any()
    assert twin.ranges()["gyro_scale.x"][:3] == (0.02, 0.02, 0.02)
    assert twin.ranges()["gyro_bias.x"][:3] == (0.0, 0.0, 0.0), "nothing is known of it"
    left_out = export(tmp_path, tmp_path / "out", format="mujoco").left_out
    assert left_out == ["gyro_scale", "a curve of f_x", "omega_x omega_y", "the colour of the noise"]


def test_two_lines_of_a_vibration_stay_two(tmp_path: Path) -> None:
    """The mean of 30 and 90 Hz was one line at 60 Hz; of a unit alone the second took the range of the first."""
    step = Entry(name="gyro_bias_step", signal="gyro", parameters={"t_step": Value(value=20.0, unit="s")})
    scale = Entry(name="gyro_scale", signal="gyro", parameters={"x": Value(value=0.02, unit="-")})
    for name, effects in {"a": (*_lines(30.0, 90.0), step), "b": (*_lines(92.0, 32.0), step, scale)}.items():
        (tmp_path / "fleet" / name).mkdir(parents=True)
        physics_file.write(PhysicsFile(effect=effects), tmp_path / "fleet" / name / "physics.toml")
        datasheet.write(NOISE, tmp_path / "fleet" / name / "noise.toml")
    report = export(tmp_path / "fleet", tmp_path / "out", format="mujoco")
    found = physics_file.read(tmp_path / "out" / "physics.toml").effect
    assert [entry.parameters["f"].value for entry in found] == [31.0, 91.0]
    assert [entry.parameters["f"].std for entry in found] == [pytest.approx(np.sqrt(2.0))] * 2
    assert report.left_out[-2:] == ["gyro_bias_step of 2 of 2 units", "gyro_scale of 1 of 2 units"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "imu.xml"))
    assert [model.numeric(f"imu.vibration_accel{n}.f").data[0] for n in ("", "_2")] == [31.0, 91.0]


def test_lines_of_two_sensors_are_two_effects(tmp_path: Path) -> None:
    """Whichever is the faster in a unit."""
    for name, of_gyro, of_accel in (("a", 90.0, 30.0), ("b", 34.0, 94.0)):
        (line,) = _lines(of_accel)
        (tmp_path / "fleet" / name).mkdir(parents=True)
        other = msgspec.structs.replace(line, signal="gyro", parameters={"f": Value(value=of_gyro, unit="Hz")})
        physics_file.write(PhysicsFile(effect=(line, other)), tmp_path / "fleet" / name / "physics.toml")
        datasheet.write(NOISE, tmp_path / "fleet" / name / "noise.toml")
    found = read(tmp_path / "fleet").physics.effect
    assert {entry.signal: entry.parameters["f"].value for entry in found} == {"accel": 62.0, "gyro": 62.0}


def test_what_is_no_diagnosis_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds no diagnosis"):
        export(tmp_path, tmp_path / "out", format="gazebo")
    with pytest.raises(ConfigError, match="one IMU"):
        export(diagnosed(tmp_path / "d"), tmp_path / "out", format="gazebo", imu="/imu0")


def test_the_physics_of_samples_in_g_are_refused(tmp_path: Path) -> None:
    """Gravity that they lack became the mean of a simulator's noise: -8.9 m/s²."""
    source = diagnosed(tmp_path / "d")
    file = physics_file.read(source / "physics.toml")
    (source / "physics.toml").unlink()
    physics_file.write(msgspec.structs.replace(file, bias=Bias(accel=(-8.3, 0.1, 3.1))), source / "physics.toml")
    with pytest.raises(DataError, match=r"an accelerometer's bias of 8.86 m/s².*imutool convert LOG OUT --fix"):
        export(source, tmp_path / "out", format="gazebo")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    source = diagnosed(tmp_path / "d")
    with pytest.raises(ConfigError, match=r"out: cannot be written \(Not a directory\)"):
        export(source, source / "noise.toml" / "out", format="toml")
