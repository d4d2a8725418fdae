"""A simulation of another motion: what both have is no finding, what differs is told with both numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from support import planted
from support.diagnoses import replace

from imutool.diagnosis.compare_findings import ANOTHER_MOTION, is_of_digits, remarks, shared
from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.result import Curve, Diagnosis, Estimate, Finding, HeldOut
from imutool.errors import DataError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write

ARM, SCALE = [0.2, -0.05, 0.1], [0.02, 0.0, -0.015]
SURE = 6.0  # of stated deviations: differentiated poses lack a little of the motion


def finding(effect: str = "gyro_scale", x: float = 0.02, std: float = 1e-4, **more: object) -> Finding:
    held_out = HeldOut(0.02, 0.01, "rad/s", 9.0)
    found = Finding(effect, "gyro", 0.9, 1e-9, 0.0, {"x": Estimate(x, std, "-")}, "gyro += S gyro", held_out)
    return replace(found, **more)


def log(
    folder: Path,
    name: str,
    seed: int,
    effects: Mapping[str, Sequence[float]],
    *,
    poses: bool = True,
    long_s: float = planted.DURATION_S,
) -> Path:
    felt = planted.rich(seed, long_s)
    samples = planted.ideal(felt, planted.acting(effects)) + planted.noise(len(felt.t_s), seed) + planted.BIAS
    truth = planted.poses(planted.moving(seed, long_s), planted.clock(long_s, 200.0)) if poses else None
    path = folder / f"{name}.mcap"
    write(planted.recording(name, felt.t_s, samples, poses=truth), path)
    return path


@pytest.mark.parametrize(
    ("x", "std", "alike"),
    [(0.02, 1e-4, True), (0.0205, 1e-6, True), (0.0203, 1e-4, True), (0.022, 1e-4, False), (0.03, 0.01, True)],
)
def test_numbers_are_alike_within_what_the_two_are_sure_of_and_what_poses_can_tell(x: float, std: float, alike: bool) -> None:
    assert shared(finding(), [finding("lever_arm"), finding(x=x, std=std)]) is alike


def test_a_scale_below_minus_one_is_named_as_an_axis_that_is_reversed() -> None:
    """So the gyro of FETCH reads about y, by whose rates a diagnosis once said a scale of -180 % and no more."""
    (remark,) = remarks([finding("lever_arm", x=-2.0), finding(x=-0.9, std=0.01), finding(x=-1.8, std=0.3)], [])
    assert remark == "gyro x: it reads the opposite of the motion, as an axis that is reversed does"


def test_another_effect_signal_or_driver_is_another_finding() -> None:
    driven = finding("driven", driver="/motor.x")
    assert not shared(finding(), [finding("gyro_misalignment"), finding(signal="accel")])
    assert not shared(driven, [finding("driven", driver="/motor.y")])
    assert shared(driven, [driven])


def test_digits_are_alike_on_the_sensor_whose_noise_shows_them_and_vibrations_at_any_phase() -> None:
    def vibration(sin: float, cos: float) -> Finding:
        numbers = {"f": (30.0, "Hz"), "accel_sin_x": (sin, "m/s^2"), "accel_cos_x": (cos, "m/s^2")}
        return finding("vibration", signal="both", parameters={k: Estimate(v, 1e-3, unit) for k, (v, unit) in numbers.items()})

    gyro, accel = ({f"{sensor}_lsb": Estimate(1e-3, 1e-6, "-")} for sensor in ("gyro", "accel"))
    both = finding("quantization", signal="both", parameters=gyro | accel)
    assert shared(finding("quantization", parameters=gyro), [both])
    assert not shared(finding("quantization", parameters={"gyro_lsb": Estimate(2e-3, 1e-6, "-")}), [both])
    assert shared(vibration(0.3, 0.4), [vibration(-0.5, 0.0)])
    assert not shared(vibration(0.3, 0.4), [vibration(0.3, 0.0)])


@pytest.mark.parametrize(
    ("equation", "lsb", "sensor", "rounding"),
    [
        ("gyro.x += curve(omega_x)", 0.1, "gyro", True),
        ("gyro.x += c omega_x |omega_x|", 0.1, "gyro", True),
        ("gyro.x += curve(omega_x)", 0.05, "gyro", False),  # rounding adds less than it removes
        ("gyro.x += curve(omega_y)", 0.1, "gyro", False),
        ("gyro.x += curve(omega_x)", 0.1, "accel", False),
    ],
)
def test_a_curve_of_an_axis_that_does_no_more_than_its_digits_is_theirs(
    equation: str, lsb: float, sensor: str, rounding: bool
) -> None:
    curve = finding("unknown", kind="unknown", axis="x", equation=equation)
    digits = finding("quantization", parameters={f"{sensor}_lsb": Estimate(lsb, 1e-3 * lsb, "rad/s")})
    assert is_of_digits(curve, digits) is rounding
    assert not is_of_digits(finding(equation=equation, axis="x"), digits)


@pytest.mark.parametrize(("lsb", "rounding"), [(0.3, True), (0.2, False)])
@pytest.mark.parametrize("name", ["gyro_scale_asymmetry", "gyro_bias_drift"])
def test_what_removes_a_fraction_of_what_the_digits_add_is_theirs(name: str, lsb: float, rounding: bool) -> None:
    digits = finding("quantization", parameters={"gyro_lsb": Estimate(lsb, 1e-3 * lsb, "rad/s")})
    assert is_of_digits(finding(name), digits) is rounding
    assert not is_of_digits(finding("gyro_misalignment"), digits)


def test_curves_are_alike_where_both_reach() -> None:
    def curve(slope: float, first: float) -> Finding:
        x = np.linspace(first, 2.0, 21)
        y = np.outer(slope * x, [1.0, 0.0, 0.0])
        one = Curve.of_arrays("rate about x", "rad/s", x, y - y.mean(axis=0), np.full((21, 3), 1e-3))
        return finding("unknown", parameters={}, curve=one)

    assert shared(curve(0.1, -2.0), [curve(0.1, -1.0)])
    assert not shared(curve(0.1, -2.0), [curve(0.2, -1.0)])


def test_what_the_simulation_has_is_said() -> None:
    here = [finding(), finding("lever_arm"), finding("mount_rotation")]
    known = [finding(), finding("lever_arm", x=0.5), finding("clock_offset")]
    said = "\n".join(remarks(here, known))
    assert "gyro scale: the simulation has it alike" in said
    assert "lever arm: the simulation has it too, as" in said
    assert "clock offset: the simulation has it" in said
    assert "mount rotation" not in said


def test_what_only_the_recording_has_is_found_beside_a_simulation_of_another_motion(tmp_path: Path) -> None:
    real = log(tmp_path, "real", 3, {"lever_arm": ARM, "gyro_scale": SCALE})
    sim = log(tmp_path, "sim", 7, {"gyro_scale": SCALE})
    found = diagnose([real], sim)
    assert found.sim == str(sim)
    assert [one.effect for one in found.findings] == ["lever_arm"]
    arm = found.findings[0].parameters
    assert all(abs(arm[axis].value - true) < SURE * arm[axis].std for axis, true in zip("xyz", ARM, strict=True))
    assert found.remarks[0] == ANOTHER_MOTION
    assert any("gyro scale: the simulation has it alike" in remark for remark in found.remarks)
    assert found.closer["gyro"].rms_before == pytest.approx(
        found.closer["gyro"].rms_after, rel=0.02
    )  # nothing is left out there
    assert found.closer["accel"].rms_after < 0.1 * found.closer["accel"].rms_before


def test_a_simulations_poses_of_another_motion_are_true_on_an_odometry_topic_too(tmp_path: Path) -> None:
    real, sim = log(tmp_path, "real", 3, {"lever_arm": ARM}), log(tmp_path, "sim", 7, {})
    known = read(sim)
    poses = {"/odom": known.truth}
    write(replace(known, truths=poses, other_poses={"/odom": "odometry"}), tmp_path / "odometry.mcap")
    with pytest.raises(DataError, match="odometry"):
        diagnose([tmp_path / "odometry.mcap"])
    assert [one.effect for one in diagnose([real], tmp_path / "odometry.mcap").findings] == ["lever_arm"]


def test_another_motion_without_poses_on_both_sides_is_refused(tmp_path: Path) -> None:
    real = log(tmp_path, "real", 3, {}, poses=False)
    sim = log(tmp_path, "sim", 7, {})
    with pytest.raises(DataError, match="turn differently"):
        diagnose([real], sim)


def test_a_simulation_of_the_motion_of_some_recordings_only_is_refused(tmp_path: Path) -> None:
    reals = [log(tmp_path, "one", 3, {}), log(tmp_path, "two", 7, {})]
    with pytest.raises(DataError, match="some recordings only"):
        diagnose(reals, log(tmp_path, "sim", 7, {}))


@pytest.mark.parametrize(
    ("differs", "stranger", "long_s"),
    [
        ("gyro_scale", {"gyro_scale": [-0.02, 0.01, 0.03]}, 150.0),
        ("gyro_scale", {"gyro_scale": [0.02, 0.006, -0.015]}, planted.DURATION_S),
        ("mount_rotation", {"gyro_scale": SCALE, "mount_rotation": [0.05, 0.0, 0.0]}, planted.DURATION_S),
        ("clock_offset", {"gyro_scale": SCALE, "clock_offset": [0.02]}, planted.DURATION_S),  # a matrix did a part of it
        ("clock_skew", {"gyro_scale": SCALE, "clock_skew": [8e-4]}, planted.DURATION_S),  # nothing was named
    ],
)
def test_a_recording_that_contradicts_the_others_is_named(
    differs: str, stranger: Mapping[str, Sequence[float]], long_s: float, tmp_path: Path
) -> None:
    """Also one that outweighs the others, or differs on one axis alone, by its clock, or in what two matrices do."""
    of_one_unit = logs_of_one_unit(tmp_path)
    of_another = log(tmp_path, "stranger", 11, stranger, long_s=long_s)
    found = diagnose([*of_one_unit, of_another])
    (remark,) = contradicting(found)
    assert remark.startswith(f"stranger contradicts the other logs: its {differs.replace('_', ' ')} is ")
    assert remark == found.remarks[0]


def test_a_recording_of_another_clock_is_named_by_its_clock(tmp_path: Path) -> None:
    """Against one simulation of all three; two matrices do a part of it."""
    felt, paths = planted.rich(3, 60.0), []
    for name, late_s in (("first", 0.0), ("second", 0.0), ("third", 0.02), ("sim", None)):
        effects = {} if late_s is None else {"gyro_scale": SCALE, "clock_offset": [late_s]}
        samples = planted.ideal(felt, planted.acting(effects)) + planted.noise(len(felt.t_s), len(paths))
        k = len(paths)
        part = slice(None) if late_s is None else (felt.t_s > 20.0 * k) & (felt.t_s < 20.0 * k + 19.0)
        write(planted.recording(name, felt.t_s[part], samples[part]), tmp_path / f"{name}.mcap")
        paths.append(tmp_path / f"{name}.mcap")
    (remark,) = contradicting(diagnose(paths[:3], paths[3]))
    assert remark.startswith("third contradicts the other logs: its clock offset is tau ")


def test_recordings_of_one_unit_do_not_contradict_each_other(tmp_path: Path) -> None:
    assert contradicting(diagnose(logs_of_one_unit(tmp_path))) == []


def test_logs_that_state_different_sensors_are_refused(tmp_path: Path) -> None:
    felt = planted.rich(3)
    paths = [tmp_path / f"{sensor}.mcap" for sensor in ("bmi160", "adis16448")]
    for path in paths:
        one = planted.recording(path.stem, felt.t_s, planted.ideal(felt, ()), poses=planted.poses(planted.moving(3), felt.t_s))
        write(replace(one, metadata={"imutool": {"sensor": path.stem}}), path)
    with pytest.raises(DataError, match=r"different sensors \(bmi160: bmi160, adis16448: adis16448\)"):
        diagnose(paths)


def logs_of_one_unit(folder: Path) -> list[Path]:
    return [log(folder, f"log{seed}", seed, {"gyro_scale": SCALE}) for seed in (3, 7)]


def contradicting(found: Diagnosis) -> list[str]:
    return [remark for remark in found.remarks if "contradicts the other logs" in remark]
