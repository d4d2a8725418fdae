"""Samples that are no measurement, and clocks that jump: no NaN comes out, and time costs by samples."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from support.imu_defects import batch_of, with_values, write_log

from imutool.bias import static
from imutool.bias.model import BiasModel
from imutool.bias.model_file import load
from imutool.bias_start.correction import OnlineDebiaser, apply_with_std
from imutool.bias_start.initial_bias import tracked_from_prior
from imutool.bias_start.stretches import Sieve, StretchClock, measured, measured_recording, read_stretches
from imutool.debiasing import DebiasedBlock, DebiasReport, debias
from imutool.errors import ConfigError, DataError, ImutoolError, LogError
from imutool.evaluation import evaluate
from imutool.mcap_io.codec import schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu, encode_pose
from imutool.mcap_io.read import read
from imutool.recording import Imu, Recording
from imutool.recording.columns import MAX_GAP_S
from imutool.sensor.made_up_flight import flight
from imutool.training.run import train

MODELS = Path(__file__).parents[2] / "models"
METHODS = ("linear", "neural_ode", "hybrid", "conv")
BAD = slice(700, 760)  # samples that a defect hits in motion
ALL = slice(None)
DEFECTS: dict[str, Callable[[ImuBatch], ImuBatch]] = {
    "zero force": lambda b: with_values(b, BAD, slice(3, 6), 0.0),
    "zero everything": lambda b: with_values(b, BAD, ALL, 0.0),
    "zero force always": lambda b: with_values(b, ALL, slice(3, 6), 0.0),
    "zero always": lambda b: with_values(b, ALL, ALL, 0.0),
    "constant": lambda b: with_values(b, ALL, ALL, 1.0),
    "1e30": lambda b: with_values(b, BAD, ALL, 1e30),
    "1e30 always": lambda b: with_values(b, ALL, 1, 1e30),
    "largest float": lambda b: with_values(b, 3, 4, np.finfo(float).max),
    "denormal force": lambda b: with_values(b, BAD, slice(3, 6), 5e-324),
    "denormal rate": lambda b: with_values(b, ALL, slice(0, 3), 5e-324),
    "NaN": lambda b: with_values(b, BAD, 2, np.nan),
    "NaN first": lambda b: with_values(b, 0, 2, np.nan),
    "infinite": lambda b: with_values(b, BAD, 5, -np.inf),
    "NaN always": lambda b: with_values(b, ALL, 5, np.nan),
    "dead gyro axis": lambda b: with_values(b, ALL, 1, 0.0),
    "dead accel axis": lambda b: with_values(b, ALL, 3, 0.0),
    "one axis alive": lambda b: with_values(b, ALL, slice(3, 5), 0.0),
    "sound": lambda b: b,
}
LEAVES_OUT = {"zero force", "zero everything", "1e30", "largest float", "denormal force", "NaN", "NaN first", "infinite"}
LEAVES_NOTHING = {"zero force always", "zero always", "1e30 always", "NaN always"}
STARTS = ("auto", "stationary", "prior", "truth", "0.01,0,0,0,0,0.1", "smooth")


@pytest.fixture(scope="module")
def batch() -> ImuBatch:
    """Seven seconds, the first three at rest."""
    return batch_of(flight(4, duration_s=7.0, still_s=3.0).imu)


@pytest.fixture(scope="module")
def models() -> dict[str, BiasModel]:
    return {method: load(MODELS / f"euroc-adis16448-{method}.safetensors") for method in METHODS} | {"static": static.Model()}


def debiased(log: Path, model: str, start: str = "auto") -> tuple[DebiasReport, np.ndarray, np.ndarray]:
    """The report, the bias and its standard deviation of every debiased sample."""
    blocks: list[DebiasedBlock] = []
    name = model if model == "static" else MODELS / f"euroc-adis16448-{model}.safetensors"
    how = {"smooth": True, "force": True} if start == "smooth" else {"init": start, "force": True}
    report = debias(log, log.with_name("out.mcap"), model=name, overwrite=True, check="none", watch=blocks.append, **how)  # type: ignore[arg-type]
    return report, np.concatenate([b.bias for b in blocks]), np.concatenate([b.std for b in blocks])


@pytest.mark.parametrize("defect", DEFECTS)
@pytest.mark.parametrize("model", ["static", "hybrid"])
def test_no_nan_comes_out_of_a_log(defect: str, model: str, batch: ImuBatch, tmp_path: Path) -> None:
    write_log(DEFECTS[defect](batch), tmp_path / "in.mcap")
    refusals: dict[str, ImutoolError] = {}
    for start in STARTS if model == "hybrid" else ("auto", "prior", "smooth"):
        try:
            report, bias, std = debiased(tmp_path / "in.mcap", model, start)
        except ImutoolError as error:
            refusals[start] = error
            continue
        assert defect not in LEAVES_NOTHING
        assert np.isfinite(bias).all()
        assert np.isfinite(std).all()
        assert report.lossy == (defect in LEAVES_OUT)
        assert len(bias) == len(batch.stamp_ns) - sum(report.sieves["/imu0"].left_out.values())
    if defect in LEAVES_NOTHING:
        assert all(isinstance(error, ConfigError) for error in refusals.values())
    else:  # without truth, or without rest where there is no prior
        assert refusals.keys() <= ({"auto", "prior", "smooth"} if model == "static" else {"truth", "stationary"})


@pytest.mark.parametrize("defect", sorted(set(DEFECTS) - LEAVES_NOTHING - {"NaN", "NaN first", "infinite"}))
def test_no_nan_comes_out_of_arrays(defect: str, batch: ImuBatch, models: dict[str, BiasModel]) -> None:
    """As `evaluate`, `view` and `imutool.debias(recording)` do; the number of samples stays."""
    spoiled = DEFECTS[defect](batch)
    imu = Imu(spoiled.stamp_ns, spoiled.gyro, spoiled.accel)
    for model in models.values():
        made, std = apply_with_std(model, tracked_from_prior(model), imu)
        assert np.isfinite(made.bias).all()
        assert np.isfinite(std).all()
        assert len(made.bias) == len(imu)


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_live_node_survives(defect: str, batch: ImuBatch, models: dict[str, BiasModel]) -> None:
    spoiled = DEFECTS[defect](batch)
    for name in ("static", "hybrid", "neural_ode"):
        online = OnlineDebiaser(models[name])
        for k in (*range(0, 300), *range(690, 800)):
            *_, bias = online(int(spoiled.stamp_ns[k]), spoiled.gyro[k], spoiled.accel[k])
            assert np.isfinite(bias).all()


def test_what_is_left_out_is_counted_and_the_rest_stays(batch: ImuBatch, tmp_path: Path) -> None:
    write_log(DEFECTS["zero force"](with_values(batch, 5, 0, np.nan)), tmp_path / "in.mcap")
    report, bias, _ = debiased(tmp_path / "in.mcap", "linear", "0.01,0,0,0,0,0.1")
    assert report.sieves["/imu0"].left_out == {"not_finite": 1, "zero_force": 60}
    write_log(batch, tmp_path / "sound.mcap")
    _, sound, _ = debiased(tmp_path / "sound.mcap", "linear", "0.01,0,0,0,0,0.1")
    kept = np.ones(len(batch.stamp_ns), bool)
    kept[BAD] = kept[5] = False
    np.testing.assert_array_equal(bias, sound[kept])


# ── clocks ───────────────────────────────────────────────────────────────────────────────────────────────────────────

YEARS = 50 * 365.25 * 86400.0


def jumping(batch: ImuBatch, step_s: float) -> ImuBatch:
    """A clock that is set while it runs: the samples before lie elsewhere, for instance in 1974."""
    stamp_ns = batch.stamp_ns.copy()
    stamp_ns[slice(None, 900) if step_s > 0 else slice(900, None)] -= int(abs(step_s) * 1e9)
    return batch._replace(stamp_ns=stamp_ns)


CLOCKS = [(30.0, "hybrid"), (1900.0, "neural_ode"), (86400.0, "static"), (YEARS, "neural_ode"), (YEARS, "conv")]


@pytest.mark.parametrize(("step_s", "model"), [*CLOCKS, (-YEARS, "hybrid"), (-5.0, "static")])
def test_time_costs_by_samples(step_s: float, model: str, batch: ImuBatch, tmp_path: Path) -> None:
    """Before the jump nothing changes; after it the bias is as good as before, and its deviation has grown, within bounds."""
    write_log(batch, tmp_path / "even.mcap")
    write_log(jumping(batch, step_s), tmp_path / "jump.mcap")
    for start in ("auto", "prior", "0.01,0,0,0,0,0.1", "smooth"):
        if model == "static" and start == "prior":
            continue
        _, even, even_std = debiased(tmp_path / "even.mcap", model, start)
        began = time.process_time()
        report, bias, std = debiased(tmp_path / "jump.mcap", model, start)
        assert time.process_time() - began < 5.0
        ((_, told),) = report.sieves["/imu0"].clock.stretches
        assert told == pytest.approx(step_s, abs=0.01)
        assert not report.lossy
        assert np.isfinite(bias).all()
        if start != "smooth":
            np.testing.assert_allclose(bias[:900], even[:900], rtol=0, atol=1e-12)
            np.testing.assert_allclose(std[:900], even_std[:900], rtol=0, atol=1e-12)
        assert np.abs(bias - even)[:, :3].max() < 0.05
        assert (std[900:] >= 0.5 * even_std[900:]).all()
        assert std.max() < 1.0


def test_a_jump_is_in_report_and_metadata(batch: ImuBatch, tmp_path: Path, imutool: Callable[..., object]) -> None:
    write_log(jumping(DEFECTS["zero force"](batch), YEARS), tmp_path / "in.mcap")
    words = ("--model", "euroc-adis16448-hybrid", "--force", "--json", "r.json")
    done = imutool("debias", "in.mcap", "out.mcap", *words, cwd=tmp_path)
    assert done.returncode == 3  # type: ignore[attr-defined]
    assert "the clock jumps by +1.5778" in done.stderr  # type: ignore[attr-defined]
    assert "60 samples are no measurement and left out (60 without any specific force)" in done.stderr  # type: ignore[attr-defined]
    (imu,) = json.loads((tmp_path / "r.json").read_text())["imus"].values()
    assert imu["left_out"] == {"zero_force": 60}
    assert imu["stretches"][0]["step_s"] == pytest.approx(YEARS, abs=1.0)


@pytest.fixture
def clock_was_set(tmp_path: Path) -> Callable[[float], tuple[Recording, Path]]:
    """A flight of 24 s with true poses, and its log whose clock was set by so many seconds in the middle."""

    def made(step_s: float) -> tuple[Recording, Path]:
        whole, path = flight(4, duration_s=24.0, still_s=3.0), tmp_path / "set.mcap"
        middle = int(whole.imu.t_ns[len(whole.imu) // 2])
        imu, truth = whole.imu, whole.truth
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=4000)
            writer.start("ros2")
            rows = [(int(t), "/imu0", k) for k, t in enumerate(imu.t_ns)] + [
                (int(t), "/pose", k) for k, t in enumerate(truth.t_ns)
            ]
            kinds = {"/imu0": schemas.IMU, "/pose": schemas.POSE}
            ids = {
                topic: writer.register_channel(
                    topic, "cdr", writer.register_schema(kind, "ros2msg", schemas.definition(kind).encode())
                )
                for topic, kind in kinds.items()
            }
            for t, topic, k in sorted(rows):
                t_ns = np.array([t + (round(step_s * 1e9) if t >= middle else 0)])
                part = slice(k, k + 1)
                payload = (
                    encode_imu(t_ns, imu.gyro[part], imu.accel[part], "imu")
                    if topic == "/imu0"
                    else encode_pose(t_ns, truth.p_wb[part], truth.q_wb_wxyz[part], "world")
                )
                writer.add_message(ids[topic], int(t_ns[0]), payload.tobytes(), int(t_ns[0]), k)
            writer.finish()
        return whole, path

    return made


@pytest.mark.parametrize("step_s", [1e7, -6.0, -1e7])
def test_each_stretch_of_a_clock_that_was_set_is_evaluated(
    clock_was_set: Callable[[float], tuple[Recording, Path]], caplog: pytest.LogCaptureFixture, step_s: float
) -> None:
    """A clock set back ended `evaluate`; over one set forward it integrated the years of the jump."""
    whole, path = clock_was_set(step_s)
    first, second = read_stretches(path)
    count, middle = len(whole.imu), len(whole.imu) // 2
    assert (first.name, second.name) == ("set_1", "set_2")
    assert (len(first.imu), len(second.imu)) == (middle, count - middle)
    np.testing.assert_array_equal(second.imu.gyro, whole.imu.gyro[middle:])
    np.testing.assert_array_equal(second.imu.t_ns, whole.imu.t_ns[middle:] + round(step_s * 1e9))
    for part, cut in ((first, slice(0, middle)), (second, slice(middle, count))):
        times = whole.imu.t_ns[cut]
        own = whole.truth.between(int(times[0]), int(times[-1]))
        assert len(own) <= len(part.truth) <= len(own) + 1  # a pose behind the last sample
        np.testing.assert_array_equal(part.truth.p_wb[: len(own)], own.p_wb)
    results = evaluate(path)
    assert [result["log"] for result in results] == ["set_1", "set_2"]
    assert all(result["duration_s"] < 13.0 and result["ape_m"] < 1000.0 for result in results)
    assert "the clock jumps by" in caplog.text


def test_a_log_whose_clock_was_set_back_is_read_as_its_longest_stretch(
    clock_was_set: Callable[[float], tuple[Recording, Path]], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    _, path = clock_was_set(-6.0)
    first, second = read_stretches(path)
    found = read(path)
    assert found.imu == max(first, second, key=lambda part: len(part.imu)).imu
    assert "only the longest stretch of its clock is read" in caplog.text
    debias(path, tmp_path / "out.mcap", model="euroc-adis16448-hybrid", force=True)
    with pytest.raises(DataError, match="explain 0% of the gyro's motion"):  # poses on the clock that was set
        debias(path, tmp_path / "out.mcap", model="euroc-adis16448-hybrid", init="truth", force=True, overwrite=True)
    train([path], tmp_path / "m.safetensors", method="linear")


def test_the_clock_equals_the_stamps_until_it_jumps() -> None:
    clock, stamps = StretchClock(), np.array([5, 6, 7]) * 10**9 // 10
    np.testing.assert_array_equal(clock(stamps), stamps)
    later = clock(stamps + int(YEARS * 1e9))
    assert later[0] - stamps[-1] == MAX_GAP_S * 1e9
    back = clock(stamps)
    assert back[0] - later[-1] == MAX_GAP_S * 1e9
    assert (np.diff(np.concatenate([stamps, later, back])) > 0).all()
    with pytest.raises(LogError, match="goes back"):
        clock(np.array([6]) * 10**8)
    with pytest.raises(LogError, match="repeats"):
        clock(np.array([7, 7]) * 10**8)


def test_a_log_of_nothing_but_zeros_is_refused(batch: ImuBatch) -> None:
    sieve, zeros = Sieve("here"), np.zeros((len(batch.stamp_ns), 3))
    left, _ = sieve(batch._replace(accel=zeros))
    assert not len(left.stamp_ns)
    with pytest.raises(ConfigError, match="no sample is a measurement"):
        sieve.refuse_nothing()
    assert not measured(zeros, zeros).any()


def test_samples_of_a_stuck_sensor_are_left_out_and_those_of_one_without_noise_stay(caplog: pytest.LogCaptureFixture) -> None:
    recording = flight(1, duration_s=5.0)
    gyro, accel = recording.imu.gyro.copy(), recording.imu.accel.copy()
    gyro[400:460], accel[400:460] = gyro[400], accel[400]
    held = replace(recording, imu=replace(recording.imu, gyro=gyro, accel=accel))
    left = measured_recording(held)
    np.testing.assert_array_equal(left.imu.t_ns, np.delete(recording.imu.t_ns, np.s_[401:460]))
    assert "59 samples that repeat the one before are left out, from 2.005 s on" in caplog.text
    still = replace(recording, imu=replace(recording.imu, gyro=0.0 * gyro, accel=0.0 * accel + 1.0))
    assert measured_recording(recording).imu is recording.imu
    assert measured_recording(still).imu is still.imu


def test_samples_of_a_gyro_that_fails_are_left_out(caplog: pytest.LogCaptureFixture) -> None:
    recording = flight(1, duration_s=10.0)
    gyro = np.round(recording.imu.gyro / 0.002) * 0.002
    gyro[800:1200] = 0.002 * (np.array([382, 383, 384]) + np.arange(400)[:, None] // [3, 5, 1000] % 2)
    left = measured_recording(replace(recording, imu=replace(recording.imu, gyro=gyro)))
    np.testing.assert_array_equal(left.imu.t_ns, np.delete(recording.imu.t_ns, np.s_[800:1200]))
    assert "400 samples whose gyro stands still within one count while the accelerometer moves are left out" in caplog.text


def test_a_sensor_at_rest_whose_digits_are_coarser_than_its_noise_is_not_stuck() -> None:
    """It repeats itself, and then one axis alone changes."""
    recording = flight(1, duration_s=5.0)
    gyro, accel = recording.imu.gyro.copy(), recording.imu.accel.copy()
    gyro[400:], accel[400:] = gyro[400], accel[400]
    gyro[460:, 1] += 1e-3
    gyro[520:, 0] -= 1e-3
    resting = replace(recording, imu=replace(recording.imu, gyro=gyro, accel=accel))
    assert measured_recording(resting).imu is resting.imu
