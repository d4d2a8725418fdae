"""Write a diagnosed sensor as a simulator's configuration, with ranges.

What a simulator has no word for is listed, and stays in the physics.toml and noise.toml that are written as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from imutool.array_types import Float64
from imutool.exporting import ExportReport
from imutool.exporting.twin import DEVIATIONS, NOISE, PHYSICS, Twin, read, sets_in
from imutool.mcap_io.storage.target import Target, writing
from imutool.noise import datasheet
from imutool.sensor import physics_file
from imutool.units import AXES, SENSORS, three

CORRELATION_S = 3600.0  # of a bias that walks, where a simulator lets it come back


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
        left_out += [entry.name for entry in twin.physics.effect if entry.name in twin.used and sets_in(entry)]
        left_out += [f"a curve of {curve.variable}" for curve in twin.physics.unknown] + [t.term for t in twin.physics.term]
        left_out += ["the colour of the noise"] * (twin.noise.colour is not None)
        left_out += [f"the sample rate, which no noise file tells: {twin.rate_hz:g} Hz are assumed"] * (not twin.rate_known)
    left_out += twin.of_some
    return ExportReport(out, form, None, dict.fromkeys(texts, 1), left_out)


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
    """Python of Isaac Lab's configuration classes (isaaclab.sensors, isaaclab.utils.noise).

    A bias has one column until a noise model is first called, and is drawn before: its range is a number, and its mean is the
    noise's.
    """
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
        mean, std = (f"torch.tensor({list(map(float, values))})" for values in (twin.bias(sensor), twin.std(sensor)))
        half = DEVIATIONS * float(twin.bias_std[sensor].max())
        lines += [
            f"{sensor.upper()}_NOISE = NoiseModelWithAdditiveBiasCfg(",
            f"    noise_cfg=GaussianNoiseCfg(mean={mean}, std={std}),",
            f'    bias_noise_cfg=UniformNoiseCfg(n_min={0.0 - half!r}, n_max={half!r}, operation="abs"),',
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
