"""Known noise is found again within its own spread, what a log cannot show is left unknown, and files read back to the bit."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imutool.converters import euroc
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.write import write
from imutool.noise import allan, datasheet
from imutool.noise.datasheet import SHEETS, UNITS, Noise
from imutool.noise.residual import curves
from imutool.noise_identification import identify, plain, rows
from imutool.recording import GRAVITY_M_S2, Imu, Poses, Recording
from imutool.sensor.made_up_flight import GYRO, flight

Run = Callable[..., subprocess.CompletedProcess[str]]

RATE_HZ = 100.0
START_NS = 1_700_000_000_000_000_000
DENSITY, WALK = 2.0e-4, 2.0e-5
SEEDS = range(6)
# Relative, of one axis: 60 000 samples give 1 %, and the 10 % that the sum of powers may be off as much again
DENSITY_TOLERANCE = 0.05
# An hour at rest has about 40 independent differences where the walk rules: 16 % a standard deviation, and this is three
WALK_TOLERANCE = 0.5
SIGMAS = 4.0  # 36 axes, none of them so far off, by chance in 1 of 400
EUROC_FACTOR = 8.0  # seven seconds on the ground with motors idling: the bound holds their vibration, never less than the sheet
MOTION_WALK_TOLERANCE = 0.35  # eight flights gave 10 % too much (what turning does to a constant), 8 % apart
MOTION_TOLERANCE = 0.15  # what a flight of 60 s, its truth and the fit of twelve numbers to it leave of the density


def noisy(seed: int, seconds: float, density: float = DENSITY, walk: float = 0.0, rate_hz: float = RATE_HZ) -> np.ndarray:
    """White noise of a density and, under it, a random walk of a walk density (discretised as Kalibr does)."""
    rng = np.random.default_rng(seed)
    n, dt = round(seconds * rate_hz), 1.0 / rate_hz
    return density / np.sqrt(dt) * rng.normal(size=(n, 3)) + np.cumsum(walk * np.sqrt(dt) * rng.normal(size=(n, 3)), axis=0)


def still(seconds: float, seed: int = 1, density: float = DENSITY, accel_density: float = 2e-3) -> Imu:
    gyro, accel = noisy(seed, seconds, density), noisy(seed + 1000, seconds, accel_density)
    t_ns = START_NS + np.arange(len(gyro)) * round(1e9 / RATE_HZ)
    return Imu(t_ns, gyro + 0.01, accel + np.array([0.0, 0.0, GRAVITY_M_S2]))


def seen(parts: list[np.ndarray], name: str, rate_hz: float = RATE_HZ) -> list[float | None]:
    return [slopes.seen.get(name) for slopes in allan.slopes(allan.curve(parts, 1.0 / rate_hz))]


# ── Allan deviation ──


def test_the_curve_of_white_noise_is_its_density_over_the_root_of_time() -> None:
    curve = allan.curve([noisy(3, 600.0)], 1.0 / RATE_HZ)
    expected = DENSITY / np.sqrt(curve.tau_s)
    error = np.abs(curve.deviation / expected[:, None] - 1.0) * np.sqrt(2.0 * curve.freedom)[:, None]
    assert error.max() < SIGMAS
    assert curve.tau_s[0] == pytest.approx(0.01)
    assert curve.tau_s[-1] <= 600.0 / allan.LONGEST


def test_two_stretches_are_the_mean_of_their_squared_differences_and_none_goes_across() -> None:
    first, second = noisy(1, 40.0), noisy(2, 40.0) + 5.0  # a jump between them would be 5 rad/s at every averaging time
    apart = [allan.curve([part], 1.0 / RATE_HZ).deviation for part in (first, second)]
    both = allan.curve([first, second], 1.0 / RATE_HZ)
    np.testing.assert_allclose(both.deviation, np.sqrt((apart[0] ** 2 + apart[1] ** 2) / 2.0), rtol=1e-12)
    assert both.freedom[0] == pytest.approx(2.0 * allan.curve([first], 1.0 / RATE_HZ).freedom[0])


@pytest.mark.parametrize("seed", SEEDS)
def test_density_and_walk_of_an_hour_are_recovered(seed: int) -> None:
    found = allan.slopes(allan.curve([noisy(seed, 3600.0, walk=WALK)], 1.0 / RATE_HZ))
    for slopes in found:
        assert slopes.seen["density"] == pytest.approx(DENSITY, rel=DENSITY_TOLERANCE)
        assert slopes.seen["walk"] == pytest.approx(WALK, rel=WALK_TOLERANCE)
        assert abs(slopes.seen["density"] - DENSITY) < SIGMAS * slopes.std["density"]
        assert abs(slopes.seen["walk"] - WALK) < SIGMAS * slopes.std["walk"]
        assert "instability" not in slopes.seen


def test_the_mean_over_many_hours_is_the_walk_itself() -> None:
    """Eighteen axes with 10 % each: 2.4 % a standard deviation, and as much again for what powers share."""
    walks = [walk for seed in SEEDS for walk in seen([noisy(seed, 3600.0, walk=WALK)], "walk")]
    assert np.mean(np.array(walks, dtype=float)) == pytest.approx(WALK, rel=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_white_noise_alone_shows_no_walk_and_no_instability(seed: int) -> None:
    for slopes in allan.slopes(allan.curve([noisy(seed, 600.0)], 1.0 / RATE_HZ)):
        assert slopes.seen.keys() == {"density"}


def test_a_flicker_floor_is_found_as_instability() -> None:
    """Flicker noise as Kasdin and Walter make it: white noise through (1 - z^-1)^(-1/2); its deviation is flat at 0.664 B."""
    rng, n, level = np.random.default_rng(7), 60_000, 1.0e-3
    response = np.cumprod(np.concatenate([[1.0], (np.arange(1, n) - 0.5) / np.arange(1, n)]))
    flicker = np.stack(
        [np.fft.irfft(np.fft.rfft(rng.normal(size=2 * n)) * np.fft.rfft(response, 2 * n))[:n] for _ in "xyz"], axis=1
    )
    b = level * np.sqrt(2.0 * np.pi)  # this filter's spectrum is level²/(2 pi f tau) a sample; B²/(2 pi f) in IEEE 952
    values = seen([level * flicker + noisy(3, n / RATE_HZ, 5e-5)], "instability")
    assert values == pytest.approx([b / np.sqrt(2.0 * np.pi)] * 3, rel=0.2)


@pytest.mark.parametrize(("seconds", "known"), [(0.05, False), (5.0, True)])
def test_a_stretch_too_short_shows_no_walk_and_a_shorter_one_nothing(seconds: float, known: bool) -> None:
    part = noisy(1, seconds, walk=WALK)
    assert seen([part], "walk") == [None] * 3
    assert [value is not None for value in seen([part], "density")] == [known] * 3


def test_nothing_is_read_off_a_stuck_sensor() -> None:
    assert seen([np.ones((1000, 3))], "density") == [None] * 3


def test_vibration_is_left_out_and_the_noise_below_it_found() -> None:
    t = np.arange(round(120.0 * RATE_HZ)) / RATE_HZ
    shaken = noisy(4, 120.0) + 0.004 * np.sin(2.0 * np.pi * 13.7 * t)[:, None]
    for slopes in allan.slopes(allan.curve([shaken], 1.0 / RATE_HZ)):
        assert slopes.from_s > 1.0 / RATE_HZ or "quantisation" in slopes.seen
        assert slopes.seen["density"] == pytest.approx(DENSITY, rel=0.3)


@settings(max_examples=20)
@given(scale=st.floats(1e-6, 1e6), seed=st.integers(0, 3))
def test_what_is_read_scales_with_the_samples(scale: float, seed: int) -> None:
    part = noisy(seed, 150.0, walk=10.0 * WALK)
    plain_, scaled = (allan.slopes(allan.curve([factor * part], 1.0 / RATE_HZ)) for factor in (1.0, scale))
    for one, other in zip(plain_, scaled, strict=True):
        assert one.seen.keys() == other.seen.keys()
        for name, value in one.seen.items():
            assert other.seen[name] == pytest.approx(scale * value, rel=1e-6)


def test_what_is_read_does_not_depend_on_the_unit_of_time() -> None:
    part = noisy(2, 600.0, walk=5.0 * WALK)
    density, walk = seen([part], "density"), seen([part], "walk")
    assert seen([part], "density", RATE_HZ / 100.0) == pytest.approx([10.0 * value for value in density])
    assert seen([part], "walk", RATE_HZ / 100.0) == pytest.approx([value / 10.0 for value in walk])


# ── files and data sheets ──

VALUES = st.one_of(st.none(), st.floats(0.0, 1e3))
AXES = st.tuples(VALUES, VALUES, VALUES)


@given(axes=st.fixed_dictionaries(dict.fromkeys(UNITS, AXES)), sources=st.dictionaries(st.sampled_from(list(UNITS)), st.text()))
def test_toml_reads_back_to_the_same_noise(tmp_path_factory: pytest.TempPathFactory, axes: dict, sources: dict) -> None:
    given_ = Noise(**axes, sources={k: v.encode("utf-8", "replace").decode() for k, v in sources.items()})
    path = tmp_path_factory.mktemp("toml") / "noise.toml"
    datasheet.write(given_, path)
    assert datasheet.read(path) == given_


def test_one_number_stands_for_three_axes(tmp_path: Path) -> None:
    (tmp_path / "n.toml").write_text('gyro_density = 1.5e-4\ngyro_walk = [0, "unknown", 2e-5]\naccel_walk = "unknown"\n')
    found = datasheet.read(tmp_path / "n.toml")
    assert found.gyro_density == (1.5e-4,) * 3
    assert found.gyro_walk == (0.0, None, 2e-5)
    assert found.accel_walk == found.accel_density == (None,) * 3
    np.testing.assert_array_equal(found.values("gyro_walk"), [0.0, np.nan, 2e-5])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gyro_densty = 1e-4", "Did you mean gyro_density?"),
        ("gyro_density = -1e-4", "-1e-4|>= 0"),
        ("gyro_density = [1, 2]", "length 3"),
        ('gyro_density = "much"', "gyro_density"),
        ("gyro_density = true", "gyro_density"),
        ("gyro_density = nan", "nan"),
        ("gyro_density =", "TOML"),
    ],
)
def test_a_file_that_is_wrong_is_refused_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "n.toml").write_text(text)
    with pytest.raises(ConfigError, match=said) as refused:
        datasheet.read(tmp_path / "n.toml")
    assert "n.toml" in str(refused.value)


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(ConfigError, match="Did you mean adis16448"):
        datasheet.read("adis1648")


def test_data_sheets_are_in_our_units() -> None:
    """ADIS16448: 0.66 deg/sqrt(h), 0.11 m/s/sqrt(h), 14.5 deg/h, 0.25 mg; BMI160: 0.007 deg/s/sqrt(Hz), 180 ug/sqrt(Hz)."""
    adis, bmi = datasheet.read("adis16448"), datasheet.read("bmi160")
    assert adis.gyro_density[0] == pytest.approx(1.920e-4, rel=1e-3)
    assert adis.accel_density[0] == pytest.approx(1.833e-3, rel=1e-3)
    assert adis.gyro_instability[0] == pytest.approx(7.030e-5, rel=1e-3)
    assert adis.accel_instability[0] == pytest.approx(2.452e-3, rel=1e-3)
    assert bmi.gyro_density[0] == pytest.approx(1.222e-4, rel=1e-3)
    assert bmi.accel_density[0] == pytest.approx(1.765e-3, rel=1e-3)
    assert bmi.gyro_instability == (None,) * 3
    assert all(value == 0.0 for name in UNITS for value in getattr(SHEETS["none"], name))
    for sheet in SHEETS.values():  # whatever has a value says where it is from
        assert {name for name in UNITS if getattr(sheet, name)[0] is not None} == sheet.sources.keys()


# ── logs ──


def test_a_log_at_rest_gives_both_densities_and_says_for_how_long(tmp_path: Path) -> None:
    write(Recording("still", still(60.0)), tmp_path / "still.mcap")
    found = identify(tmp_path / "still.mcap")
    assert found.noise.gyro_density == pytest.approx((DENSITY,) * 3, rel=DENSITY_TOLERANCE)
    assert found.noise.accel_density == pytest.approx((2e-3,) * 3, rel=DENSITY_TOLERANCE)
    assert found.noise.gyro_walk == found.noise.accel_walk == (None,) * 3
    assert found.noise.sources["gyro_density"] == "60 s at rest"
    assert not any("vibrates" in remark for remark in found.remarks)
    assert any("no bias walk of the gyro" in remark for remark in found.remarks)
    for sensor, density in (("gyro", DENSITY), ("accel", 2e-3)):  # a bound lies above, and not far
        assert all(density < bound < 1.5 * density for bound in found.at_most[sensor] if bound is not None)
        assert found.samples[sensor] == pytest.approx((density,) * 3, rel=DENSITY_TOLERANCE)


def test_noise_has_the_units_that_are_stated_whatever_those_of_the_samples(tmp_path: Path) -> None:
    imu = still(60.0)
    write(Recording("right", imu), tmp_path / "right.mcap")
    write(Recording("in g", Imu(imu.t_ns, imu.gyro, imu.accel / 9.80665)), tmp_path / "g.mcap")
    right, in_g = (identify(tmp_path / name) for name in ("right.mcap", "g.mcap"))
    assert in_g.noise.accel_density == pytest.approx(right.noise.accel_density, rel=1e-9)
    assert any(remark.startswith("accel is in g") and remark.endswith("converted") for remark in in_g.remarks)
    assert not any("converted" in remark for remark in right.remarks)


@pytest.mark.parametrize("rate_hz", [600.0, 700.0])
def test_stamps_in_whole_milliseconds_do_not_change_the_density(rate_hz: float, tmp_path: Path) -> None:
    gyro, accel = (noisy(seed, 30.0, rate_hz=rate_hz) for seed in (1, 2))
    t_ns = START_NS + 1_000_000 * np.round(np.arange(len(gyro)) * 1e3 / rate_hz).astype(np.int64)
    write(Recording("ms", Imu(t_ns, gyro, accel + np.array([0.0, 0.0, GRAVITY_M_S2]))), tmp_path / "ms.mcap")
    found = identify(tmp_path / "ms.mcap")
    assert found.noise.gyro_density == pytest.approx((DENSITY,) * 3, rel=DENSITY_TOLERANCE)
    assert found.samples["gyro"] == pytest.approx((DENSITY,) * 3, rel=DENSITY_TOLERANCE)


def test_digits_coarser_than_the_noise_show_no_noise(tmp_path: Path) -> None:
    imu, lsb = still(60.0), 5.0 * DENSITY * np.sqrt(RATE_HZ)
    write(Recording("coarse", Imu(imu.t_ns, np.round(imu.gyro / lsb) * lsb, imu.accel)), tmp_path / "coarse.mcap")
    found = identify(tmp_path / "coarse.mcap")
    assert found.noise.gyro_density == (None,) * 3
    assert found.at_most["gyro"] == [None] * 3
    assert [remark for remark in found.remarks if "digits" in remark or "vibrates" in remark] == [
        "at rest: the gyro on x, y, z hardly leaves one reading: its digits are too coarse to show its noise"
    ]
    assert found.noise.accel_density == pytest.approx((2e-3,) * 3, rel=DENSITY_TOLERANCE)


def test_a_shaken_sensor_is_said_to_vibrate(tmp_path: Path) -> None:
    imu = still(60.0)
    hum = 0.02 * np.sin(2.0 * np.pi * 13.7 * np.arange(len(imu)) / RATE_HZ)[:, None]
    write(Recording("idle", Imu(imu.t_ns, imu.gyro + hum, imu.accel)), tmp_path / "idle.mcap")
    found = identify(tmp_path / "idle.mcap")
    said = [remark for remark in found.remarks if "vibrates" in remark]
    assert len(said) == 1
    assert "gyro's deviation on x, y, z" in said[0]


def test_a_sensor_that_rests_all_the_time_has_no_noise_in_motion(tmp_path: Path) -> None:
    imu = still(60.0)
    truth = Poses(imu.t_ns, np.zeros((len(imu), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(imu), 1)))
    write(Recording("still", imu, truths={"/pose": truth}), tmp_path / "still.mcap")
    found = identify(tmp_path / "still.mcap")
    assert found.noise.accel_density == pytest.approx((2e-3,) * 3, rel=DENSITY_TOLERANCE)
    assert found.in_motion is None  # a fitted matrix takes up noise: 36 % of the density were gone after 1000 s
    assert "in motion: the sensor rests nearly all the time" in found.remarks


def test_poses_that_cannot_be_used_cost_no_noise_at_rest(tmp_path: Path) -> None:
    imu = still(20.0)
    truth = Poses(imu.t_ns, np.zeros((len(imu), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(imu), 1)))
    truth.q_wb_wxyz.setflags(write=True)
    truth.q_wb_wxyz[:, 0] = 8.0
    write(Recording("still", imu, truths={"/pose": truth}), tmp_path / "still.mcap")
    found = identify(tmp_path / "still.mcap")
    assert found.noise.accel_density == pytest.approx((2e-3,) * 3, rel=2 * DENSITY_TOLERANCE)
    assert any(remark.startswith("/pose is left out: quaternion [8.0,") for remark in found.remarks)


def test_a_log_with_neither_rest_nor_truth_is_refused(tmp_path: Path) -> None:
    imu = still(20.0)
    turning = Imu(imu.t_ns, imu.gyro + np.sin(np.arange(len(imu)) / 50.0)[:, None], imu.accel)
    write(Recording("moving", turning), tmp_path / "moving.mcap")
    with pytest.raises(DataError, match=r"the log never rests; in motion: the log has no true poses") as refused:
        identify(tmp_path / "moving.mcap")
    assert refused.value.exit_code == 4


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight that never rests, with good truth and a gyro noisy enough to be told from it."""
    loud = {**{f: getattr(GYRO, f) for f in GYRO.__struct_fields__}, "noise_density": 2e-3, "warm_up": 0.0}
    path = tmp_path_factory.mktemp("moving") / "moving.mcap"
    write(flight(3, duration_s=60.0, still_s=0.0, gyro=loud), path)
    return path


def test_motion_gives_the_density_where_nothing_rests(moving: Path) -> None:
    found = identify(moving)
    assert found.at_rest is None
    assert found.in_motion is not None
    assert found.noise.gyro_density == pytest.approx((2e-3,) * 3, rel=MOTION_TOLERANCE)
    assert "in motion against /ground_truth/pose" in found.noise.sources["gyro_density"]
    assert found.samples["gyro"] == pytest.approx([2e-3] * 3, rel=0.05)


def test_motion_gives_the_walk_of_the_rest_bias() -> None:
    quiet = {"noise_density": 2e-3, "walk_density": 6e-3, "warm_up": 0.0, "scale": 0.0, "misalignment_rad": 0.0}
    made = flight(1, duration_s=120.0, still_s=0.0, gyro={**{f: getattr(GYRO, f) for f in GYRO.__struct_fields__}, **quiet})
    gyro, _ = curves(made.imu, made.truth)
    for slopes in allan.slopes(gyro):
        assert slopes.seen["density"] == pytest.approx(2e-3, rel=MOTION_TOLERANCE)
        assert slopes.seen["walk"] == pytest.approx(6e-3, rel=MOTION_WALK_TOLERANCE)


def test_the_truths_own_noise_falls_faster_with_the_window_and_is_kept_apart() -> None:
    clean = {"noise_density": 2e-3, "scale": 0.0, "misalignment_rad": 0.0, "warm_up": 0.0}
    gyro = {**{f: getattr(GYRO, f) for f in GYRO.__struct_fields__}, **clean}
    made = flight(2, duration_s=60.0, still_s=0.0, gyro=gyro, truth_noise_rad=5e-4)
    curve, _ = curves(made.imu, made.truth)
    for slopes, first in zip(allan.slopes(curve), curve.deviation[0], strict=True):
        assert first > 3.0 * 2e-3 / np.sqrt(curve.tau_s[0])  # the truth rules at the shortest window
        assert slopes.seen["density"] == pytest.approx(2e-3, rel=2.0 * MOTION_TOLERANCE)  # shorter windows show nothing of it
        assert slopes.seen["quantisation"] == pytest.approx(5e-4, rel=0.5)  # interpolated between two poses it is less


def test_a_truth_made_from_the_gyro_shows_nothing_of_it(tmp_path: Path) -> None:
    import torch
    from scipy.spatial.transform import Rotation

    from imutool.inertial.windows import attitudes

    made = flight(4, duration_s=30.0, still_s=0.0)
    gyro, dt = torch.from_numpy(made.imu.gyro.copy())[None], torch.from_numpy(np.diff(made.imu.t_ns) * 1e-9)[None]
    R_wb = attitudes(torch.eye(3, dtype=torch.float64)[None], gyro, dt)[0].numpy()
    q_wb_wxyz = np.ascontiguousarray(Rotation.from_matrix(R_wb).as_quat(scalar_first=True))
    own = Poses(made.imu.t_ns, made.truth.at(made.imu.t_ns)[0].p_wb, q_wb_wxyz)
    write(Recording("own", made.imu, truths={"/ground_truth/pose": own}), tmp_path / "own.mcap")
    found = identify(tmp_path / "own.mcap")
    assert found.noise.gyro_density == (None,) * 3
    assert any("it was computed from the same samples" in remark and "gyro" in remark for remark in found.remarks)


def test_a_model_takes_the_place_of_the_fit(logs: Path) -> None:
    found = identify(logs / "flight_2.mcap", model=logs / "linear.safetensors")
    assert found.in_motion is not None
    assert found.in_motion.how.endswith("corrected by linear")


def test_euroc_bounds_its_gyro_near_the_data_sheet(data: Path, tmp_path: Path) -> None:
    (recording,) = euroc.read(data / "euroc" / "V1_01_easy.zip")
    write(recording, tmp_path / "V1_01.mcap")
    found = identify(tmp_path / "V1_01.mcap", truth="/ground_truth/pose")
    sheet = SHEETS["adis16448"].values("gyro_density")
    bound = np.array(found.at_most["gyro"], dtype=float)
    assert (bound > sheet).all()
    assert (bound < EUROC_FACTOR * sheet).all()
    known = found.noise.values("gyro_density")
    assert not (known > bound).any()  # NaN where the vibration hides it
    assert any("vibrates" in remark for remark in found.remarks)


# ── the command ──


def test_info_prints_writes_and_draws_the_noise(imutool: Run, tmp_path: Path) -> None:
    write(Recording("still", still(60.0)), tmp_path / "still.mcap")
    words = ("--noise", "--noise-toml", "n.toml", "--noise-plot", "n.png")
    done = imutool("info", "still.mcap", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "gyro_density" in done.stdout
    assert "60 s at rest" in done.stdout
    found = identify(tmp_path / "still.mcap")
    assert datasheet.read(tmp_path / "n.toml") == found.noise
    assert (tmp_path / "n.png").read_bytes().startswith(b"\x89PNG")
    again = imutool("info", "still.mcap", *words, cwd=tmp_path)
    assert again.returncode == 3
    assert "--overwrite" in again.stderr
    told = json.loads(imutool("info", "still.mcap", "--noise", "--json", "-", cwd=tmp_path).stdout)
    assert told["noise"] == json.loads(json.dumps(plain(found)))
    assert told["noise"]["gyro_walk"] == [None] * 3


def test_noise_options_without_noise_are_refused(imutool: Run, tmp_path: Path) -> None:
    write(Recording("still", still(5.0)), tmp_path / "still.mcap")
    done = imutool("info", "still.mcap", "--noise-toml", "n.toml", cwd=tmp_path)
    assert done.returncode == 3
    assert "--noise-toml needs --noise" in done.stderr
    assert not (tmp_path / "n.toml").exists()


def test_a_missing_library_is_said_with_the_way_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "allantools", None)
    with pytest.raises(ConfigError, match=r"imutool\[noise\]"):
        allan.library()


def test_the_table_holds_what_was_found(tmp_path: Path) -> None:
    write(Recording("still", still(60.0)), tmp_path / "still.mcap")
    found = identify(tmp_path / "still.mcap")
    cells = {row[0]: row[1:] for row in rows(found)}
    assert cells["gyro_density"][0] == f"{found.noise.gyro_density[0]:.2e}"
    assert cells["gyro_walk"][:3] == ("–", "–", "–")
    assert {row[4] for row in rows(found)[1:]} == set(UNITS.values())


def test_white_noise_is_known_on_every_axis(tmp_path: Path) -> None:
    """The fit scatters about the bound of its shortest times by less than its own error, and is no vibration."""
    for seed in range(4):
        drawn = np.random.default_rng(seed).standard_normal((20_000, 6))
        t_ns = np.arange(len(drawn)) * 10_000_000
        still = Imu(t_ns, 2e-3 * drawn[:, :3], [0.0, 0.0, GRAVITY_M_S2] + 2e-2 * drawn[:, 3:])
        write(Recording(name="still", imu=still), tmp_path / f"{seed}.mcap")
        found = identify(tmp_path / f"{seed}.mcap").noise
        assert found.gyro_density == pytest.approx([2e-4] * 3, rel=0.05)
        assert found.accel_density == pytest.approx([2e-3] * 3, rel=0.05)
