"""Export a diagnosed sensor as a simulator's configuration, with ranges.

The physics of one diagnosis, or of a fleet's: means, and ranges for domain randomisation of two deviations, of the fits and
among the units.
What a simulator has no word for is listed, and stays in the physics.toml and noise.toml that are written as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from imutool.array_types import Float64
from imutool.errors import ConfigError, DataError
from imutool.exporting import ExportReport
from imutool.mcap_io.storage.target import Target, writing
from imutool.noise import datasheet
from imutool.noise.datasheet import Noise
from imutool.recording import GRAVITY_M_S2
from imutool.sensor import physics_file
from imutool.sensor.physics_file import Bias, Entry, PhysicsFile, Value
from imutool.units import AXES, SENSORS, Sensor, three

PHYSICS, NOISE = "physics.toml", "noise.toml"
MOST_BIAS_M_S2 = 0.6 * GRAVITY_M_S2  # of an accelerometer; with a larger one it measures no gravity
RATE_HZ = 200.0  # of a sensor whose rate neither the given noise nor the diagnosed one says
DEVIATIONS = 2.0  # of a range
CORRELATION_S = 3600.0  # of a bias that walks, where a simulator lets it come back
Vector = Float64[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Twin:
    """Sensor of a fleet: physics, spread of the bias, noise; `used`: the effects expressed."""

    physics: PhysicsFile
    bias_std: Mapping[Sensor, Vector]
    noise: Noise
    units: int
    rate_hz: float = RATE_HZ
    used: set[str] = field(default_factory=set)

    def vector(self, effect: str) -> Vector:
        """Three parameters of an effect, zero where it is not known."""
        entry = next((entry for entry in self.physics.effect if entry.name == effect), None)
        if entry is None:
            return np.zeros(3)
        self.used.add(effect)
        return np.array([next((v.value for k, v in entry.parameters.items() if k[-1] == axis), 0.0) for axis in AXES])

    def value(self, effect: str, parameter: str) -> float | None:
        """One parameter of an effect."""
        for entry in self.physics.effect:
            if entry.name == effect and parameter in entry.parameters:
                self.used.add(effect)
                return entry.parameters[parameter].value
        return None

    def rotation(self) -> Rotation:
        """Attitude of the sensor on its body."""
        return Rotation.from_rotvec(self.vector("mount_rotation"))

    def bias(self, sensor: Sensor) -> Vector:
        """Mean bias of a sensor."""
        return np.zeros(3) if self.physics.bias is None else np.array(getattr(self.physics.bias, sensor))

    def std(self, sensor: Sensor) -> Vector:
        """Standard deviation of a sample's noise."""
        return np.asarray(np.nan_to_num(self.noise.values(f"{sensor}_density")) * np.sqrt(self.rate_hz))

    def ranges(self) -> dict[str, tuple[float, float, float, str]]:
        """Value, low, high and unit of every parameter with a name."""
        out = {}
        for entry in self.physics.effect:
            for name, value in entry.parameters.items():
                half = DEVIATIONS * (value.std or 0.0)
                out[f"{entry.name}.{name}"] = (value.value, value.value - half, value.value + half, value.unit)
        for sensor in SENSORS:
            low, high = (1.0, 1.0) if self.noise.colour is None else getattr(self.noise.colour, f"{sensor}_range")
            for axis, std in zip(AXES, self.std(sensor), strict=True):
                out[f"{sensor}_noise.{axis}"] = (float(std), float(std * low), float(std * high), "")
            for axis, mean, std in zip(AXES, self.bias(sensor), self.bias_std[sensor], strict=True):
                out[f"{sensor}_bias.{axis}"] = (float(mean), float(mean - DEVIATIONS * std), float(mean + DEVIATIONS * std), "")
        return out


def write(source: Path, out: Path, form: str, noise: str | Path | None, overwrite: bool) -> ExportReport:
    """Write the folder `out` from a diagnosis' folder, or a folder of such folders.

    Raises:
        ConfigError: no diagnosis in `source`, no noise, or a file of `out` exists (without `overwrite`).
    """
    twin = read(source, noise)
    name, text_of = FORMATS[form]
    texts = {PHYSICS: physics_file.to_toml(twin.physics), NOISE: datasheet.to_toml(twin.noise)}
    if text_of is not None:
        texts[name] = text_of(twin)
    else:
        twin.used.update(entry.name for entry in twin.physics.effect)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    for file, text in texts.items():
        with Target(out / file, overwrite=overwrite) as target:
            target.write(text.encode())
    left_out = [entry.name for entry in twin.physics.effect if entry.name not in twin.used or entry.column]
    if text_of is not None:
        left_out += [f"a curve of {curve.variable}" for curve in twin.physics.unknown] + [t.term for t in twin.physics.term]
        left_out += ["the colour of the noise"] * (twin.noise.colour is not None)
    return ExportReport(out, form, None, dict.fromkeys(texts, 1), left_out)


def read(source: Path, noise: str | Path | None = None) -> Twin:
    """Twin of one diagnosis or of several.

    Raises:
        ConfigError: no physics.toml, or no noise.
        DataError: the physics of samples in another unit.
    """
    folders = [source] if (source / PHYSICS).is_file() else sorted(path.parent for path in source.glob(f"*/{PHYSICS}"))
    if not folders:
        raise ConfigError("holds no diagnosis", where=source, expected=f"the folder of imutool diagnose, with {PHYSICS}")
    files = [physics_file.read(folder / PHYSICS) for folder in folders]
    noises = [datasheet.read(folder / NOISE) for folder in folders if (folder / NOISE).is_file()]
    if noise is None and not noises:
        raise ConfigError(f"holds no {NOISE}", where=source, fix="Diagnose again, or give `noise`")
    sheet = datasheet.read(noise) if noise is not None else _middle(noises)
    biases = {s: np.array([getattr(file.bias, s) for file in files if file.bias is not None]).reshape(-1, 3) for s in SENSORS}
    known = {s: rows for s, rows in biases.items() if len(rows)}
    for folder, file in zip(folders, files, strict=True):
        if file.bias is not None and (size := float(np.linalg.norm(file.bias.accel))) > MOST_BIAS_M_S2:
            what = f"{PHYSICS} has an accelerometer's bias of {size:.3g} m/s²: its log does not measure gravity, or not in m/s²"
            raise DataError(what, where=folder, fix="Correct the log with imutool convert LOG OUT --fix, and diagnose it again")
    mean = Bias(**{s: three(rows.mean(axis=0)) for s, rows in known.items()}) if known else None
    std: dict[Sensor, Vector] = {s: rows.std(axis=0, ddof=1) if len(rows) > 1 else np.zeros(3) for s, rows in biases.items()}
    physics = files[0] if len(files) == 1 else _of_fleet(files)
    rates = [each.colour.rate_hz for each in (sheet, *noises) if each.colour is not None]
    return Twin(msgspec.structs.replace(physics, bias=mean), std, sheet, len(files), next(iter(rates), RATE_HZ))


def _of_fleet(files: list[PhysicsFile]) -> PhysicsFile:
    """Effects that most units have, with the mean and spread of each parameter; curves and terms belong to one unit."""
    found: dict[tuple[str, str, str], list[Entry]] = {}
    for file in files:
        for entry in file.effect:
            found.setdefault((entry.name, entry.signal or entry.column, entry.driver), []).append(entry)
    common = [entries for entries in found.values() if 2 * len(entries) > len(files)]
    return PhysicsFile(effect=tuple(_pooled(entries) for entries in common))


def _pooled(entries: list[Entry]) -> Entry:
    values = {}
    for name, first in entries[0].parameters.items():
        own = [entry.parameters[name] for entry in entries if name in entry.parameters]
        x, std = np.array([v.value for v in own]), np.array([v.std or 0.0 for v in own])
        spread = float(x.std(ddof=1)) if len(x) > 1 else 0.0
        values[name] = Value(value=float(x.mean()), std=float(np.hypot(spread, np.sqrt((std**2).mean()))), unit=first.unit)
    return msgspec.structs.replace(entries[0], parameters=values)


def _middle(noises: list[Noise]) -> Noise:
    """The unit with the middle noise; a colour cannot be averaged."""
    sizes = [float(np.nansum(noise.values("accel_density"))) for noise in noises]
    return noises[int(np.argsort(sizes)[len(sizes) // 2])]


def _numbers(values: Float64[np.ndarray, " n"] | tuple[float, ...]) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


# ── the formats ──


def _mujoco(twin: Twin) -> str:
    """MJCF with a site and its sensors: `noise` is a note to the reader, `cutoff` clips (MuJoCo's XML reference, sensor)."""
    site = f'pos="{_numbers(twin.vector("lever_arm"))}" quat="{_numbers(twin.rotation().as_quat(scalar_first=True))}"'
    lines = []
    for sensor in SENSORS:
        element = "gyro" if sensor == "gyro" else "accelerometer"
        limit = twin.value("saturation", f"{sensor}_limit")
        cutoff = "" if limit is None else f' cutoff="{limit:.9g}"'
        noise = float(np.sqrt((twin.std(sensor) ** 2).mean()))
        lines.append(f'    <{element} name="imu_{sensor}" site="imu" noise="{noise:.9g}"{cutoff}/>')
    lines += ["  </sensor>", "  <custom>"]
    for name, (value, low, high, _) in twin.ranges().items():
        lines.append(f'    <numeric name={quoteattr(f"imu.{name}")} data="{_numbers((value, low, high))}"/>')
    return "\n".join(
        [
            f"<!-- IMU of {twin.units} unit(s). MuJoCo adds no noise: draw it, and each numeric (value, low, high). -->",
            '<mujoco model="imu">',
            "  <worldbody>",
            '    <body name="imu">',
            '      <inertial pos="0 0 0" mass="0.01" diaginertia="1e-6 1e-6 1e-6"/>',
            f'      <site name="imu" {site}/>',
            "    </body>",
            "  </worldbody>",
            "  <sensor>",
            *lines,
            "  </custom>",
            "</mujoco>",
            "",
        ]
    )


def _gazebo(twin: Twin) -> str:
    """SDF of a sensor.

    A mean bias is the `mean` of the noise: Gazebo draws the sign of `bias_mean` (gz-sensors, GaussianNoiseModel, Load).
    `dynamic_bias_stddev` is the density of the walk (ibid., ApplyImpl).
    """
    pose = _numbers(np.concatenate([twin.vector("lever_arm"), twin.rotation().as_euler("xyz")]))
    lines = []
    for sensor in SENSORS:
        element = "angular_velocity" if sensor == "gyro" else "linear_acceleration"
        lsb, walk = twin.value("quantization", f"{sensor}_lsb"), np.nan_to_num(twin.noise.values(f"{sensor}_walk"))
        lines.append(f"        <{element}>")
        for k, axis in enumerate(AXES):
            values = {
                "mean": twin.bias(sensor)[k],
                "stddev": twin.std(sensor)[k],
                "bias_mean": 0.0,
                "bias_stddev": twin.bias_std[sensor][k],
                "dynamic_bias_stddev": walk[k],
                "dynamic_bias_correlation_time": CORRELATION_S,
            } | ({} if lsb is None else {"precision": lsb})
            inner = "".join(f"<{key}>{value:.9g}</{key}>" for key, value in values.items())
            kind = "gaussian" if lsb is None else "gaussian_quantized"
            lines.append(f'          <{axis}><noise type="{kind}">{inner}</noise></{axis}>')
        lines.append(f"        </{element}>")
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<sdf version="1.9">',
            '  <model name="imu">',
            '    <link name="imu_link">',
            '      <sensor name="imu" type="imu">',
            f"      <pose>{pose}</pose>",
            f"      <update_rate>{twin.rate_hz:.9g}</update_rate>",
            "      <imu>",
            *lines,
            "      </imu>",
            "      </sensor>",
            "    </link>",
            "  </model>",
            "</sdf>",
            "",
        ]
    )


def _isaac(twin: Twin) -> str:
    """Python of Isaac Lab's configuration classes (isaaclab.sensors, isaaclab.utils.noise)."""
    wxyz = tuple(map(float, twin.rotation().as_quat(scalar_first=True)))
    lines = [
        f'"""IMU of {twin.units} diagnosed unit(s): sensor, noise, and ranges (low, high) for domain randomisation."""',
        "",
        "import torch",
        "from isaaclab.sensors import ImuCfg",
        "from isaaclab.utils.noise import GaussianNoiseCfg, NoiseModelWithAdditiveBiasCfg, UniformNoiseCfg",
        "",
        "IMU = ImuCfg(",
        '    prim_path="{ENV_REGEX_NS}/Robot/base",',
        f"    update_period={1.0 / twin.rate_hz:.9g},",
        f"    offset=ImuCfg.OffsetCfg(pos={three(twin.vector('lever_arm'))}, rot={wxyz}),  # w, x, y, z; since 3.0 x, y, z, w",
        ")",
    ]
    for sensor in SENSORS:
        mean, half = twin.bias(sensor), DEVIATIONS * twin.bias_std[sensor]
        low, high, std = (
            (f"torch.tensor({list(map(float, values))})") for values in (mean - half, mean + half, twin.std(sensor))
        )
        lines += [
            f"{sensor.upper()}_NOISE = NoiseModelWithAdditiveBiasCfg(",
            f"    noise_cfg=GaussianNoiseCfg(mean=0.0, std={std}),",
            f'    bias_noise_cfg=UniformNoiseCfg(n_min={low}, n_max={high}, operation="abs"),',
            ")",
        ]
    ranges = twin.ranges().items()
    lines += ["RANGES = {", *(f"    {name!r}: ({low!r}, {high!r}),{_unit(unit)}" for name, (_, low, high, unit) in ranges), "}"]
    return "\n".join([*lines, ""])


def _unit(unit: str) -> str:
    return f"  # {unit}" if unit else ""


# By format: the name of its file, and the function that makes its text (None: only the files that `imutool simulate` takes).
FORMATS: Mapping[str, tuple[str, Callable[[Twin], str] | None]] = {
    "mujoco": ("imu.xml", _mujoco),
    "gazebo": ("imu.sdf", _gazebo),
    "isaac": ("imu.py", _isaac),
    "toml": (PHYSICS, None),
}
