"""Several recordings of one sensor: how far they agree, what they say together, and what one's physics leaves of another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import shift
from support import planted
from support.benchmarks import benchmark

from imutool.mcap_io.write import write

EXACT = 1e-12
DRAWS = 2000
OF_ONE = 0.05  # z of so many honest draws lies as near to 1: its own deviation is 1 / sqrt(2 * 2000)
ARM_M = (0.3, -0.2, 0.25)
DRAWN = 0.06  # of a slope from so many draws
LAG_S = 5e-4  # of a lag: a matrix of all windows takes a little of what a mean lag does
LONG_S, MAX_LAG_STD_S = 90.0, 2e-3  # time that shows a lag at 0.3 Hz; a deviation that tells twelve milliseconds from none
POSE_NOISE = 0.05  # of what the lever arm adds: how inexact splines through exact poses may be


@pytest.fixture(scope="module")
def tables() -> Any:
    return benchmark("sensor_tables")


@pytest.fixture(scope="module")
def bench() -> Any:
    return benchmark("real_diagnoses")


@pytest.fixture(scope="module")
def check() -> Any:
    return benchmark("reference_check")


def test_equal_deviations_make_the_mean_plain_and_z_the_spread_in_sigmas(tables: Any) -> None:
    told = tables.consistency([(1.0, 0.5), (2.0, 0.5), (3.0, 0.5)])
    assert told.mean == pytest.approx(2.0, abs=EXACT)
    assert told.spread == pytest.approx(1.0, abs=EXACT)
    assert told.z == pytest.approx(2.0, abs=EXACT)
    assert told.std == pytest.approx(2.0 * 0.5 / np.sqrt(3.0), abs=EXACT)


def test_honest_deviations_have_a_z_of_one_and_agreement_never_narrows_the_mean(tables: Any) -> None:
    rng = np.random.default_rng(3)
    std = rng.uniform(0.1, 2.0, DRAWS)
    told = tables.consistency(zip(5.0 + std * rng.normal(size=DRAWS), std, strict=True))
    assert abs(told.z - 1.0) < OF_ONE
    assert abs(told.mean - 5.0) < 4.0 * told.std
    alike = tables.consistency([(1.0, 0.3), (1.0, 0.4)])
    assert alike.z == 0.0
    assert alike.std == pytest.approx(1.0 / np.sqrt(1 / 0.09 + 1 / 0.16), abs=EXACT)


def test_one_sequence_has_no_spread_and_none_has_nothing(tables: Any) -> None:
    one, none = tables.consistency([(4.0, 0.1)]), tables.consistency([])
    assert (one.mean, one.std, one.count) == (4.0, pytest.approx(0.1), 1)
    assert np.isnan([one.z, one.spread, none.mean, none.std]).all()


def test_fits_apart_make_the_fit_together(tables: Any) -> None:
    rng = np.random.default_rng(5)
    parts = [(A := rng.normal(size=(30, 4)), A @ [1.0, -2.0, 0.5, 3.0] + rng.normal(size=30)) for _ in range(3)]
    apart = [np.linalg.lstsq(A, y)[0] for A, y in parts]
    theta, covariance = tables.together(apart, [A.T @ A for A, _ in parts])
    whole = np.concatenate([A for A, _ in parts])
    np.testing.assert_allclose(theta, np.linalg.lstsq(whole, np.concatenate([y for _, y in parts]))[0], atol=1e-10)
    np.testing.assert_allclose(covariance, np.linalg.inv(whole.T @ whole), atol=1e-10)


def test_effects_are_carried_over_that_last_and_come_up_in_half_the_sequences(tables: Any) -> None:
    found = {
        "a": ["lever_arm", "vibration"],
        "b": ["lever_arm", "vibration"],
        "c": ["clock_offset"],
        "d": ["clock_offset", "gravity"],
    }
    assert tables.agreed(found, ["lever_arm", "clock_offset", "gravity"]) == ("clock_offset", "lever_arm")
    assert [tables.how_often(count, 4) for count in (4, 3, 2, 1)] == ["all", "most", "some", "one"]


def test_numbers_are_told_to_two_digits_of_their_deviation_in_the_tables_unit(tables: Any) -> None:
    assert tables.shown(0.057416, 0.000498, "-") == "5.742 ± 0.050"
    assert tables.shown(-0.08529, 0.0131, "-") == "-8.5 ± 1.3"
    assert tables.shown(0.0948, 0.0017, "m") == "94.8 ± 1.7"
    assert tables.shown(0.00122, 0.0, "rad/s") == "0.00122"
    assert tables.shown(float("nan"), 1.0, "m") == "–"


def test_a_parameter_that_no_motion_showed_is_in_no_row(tables: Any) -> None:
    seen, wild = tables.Value(0.02, 0.001, "-", 0.1), tables.Value(-1.68, 0.02, "-", 0.1)
    vague = tables.Value(0.05, 0.3, "-", 0.1)
    measured = {"one": {"gyro_scale.z": seen, "gyro_scale.y": wild}, "two": {"gyro_scale.z": seen, "gyro_scale.x": vague}}
    assert list(tables.parameter_rows(measured)) == ["gyro_scale.z"]
    row = tables.consistency_table(measured, {"gyro_scale.z": 0.0211}).splitlines()[-1]
    assert row == "| gyro_scale.z (%) | 2 of 2 | 2.000 ± 0.071 | 0 | 0.1 | 0.0 | 2.11 |"


def test_findings_are_counted_by_sequence(tables: Any) -> None:
    def told(*effects: str) -> dict[str, Any]:
        return {"findings": [{"effect": effect, "signal": "accel", "share": 0.5} for effect in effects]}

    text = tables.findings_table({"a": told("lever_arm", "unknown"), "b": told("lever_arm"), "c": told("lever_arm", "gravity")})
    assert "| lever_arm | all (3 of 3) | 50 % |  |" in text
    assert "| unknown (accel) | one (1 of 3) | 50 % | a |" in text


def test_what_tum_vi_publishes_is_the_inverse_of_its_matrices(bench: Any) -> None:
    stated = bench.published()["tumvi"]
    for sensor, matrix in bench.TUM_VI.items():
        scale = np.diag([stated[f"{sensor}_scale.{axis}"] for axis in "xyz"])
        M = np.array([[0.0 if i == j else stated[f"{sensor}_misalignment.{i}{j}"] for j in "xyz"] for i in "xyz"])
        np.testing.assert_allclose((np.eye(3) + scale) @ (np.eye(3) + M) @ matrix, np.eye(3), atol=EXACT)
    assert stated["gyro_scale.y"] == pytest.approx(-0.0860, abs=1e-4)


def test_only_what_the_sequences_agree_on_is_carried_over(bench: Any) -> None:
    def fitted(z: float, x: float) -> dict[str, Any]:
        rows = {
            "gyro_scale.z": [z, 1e-3, "-", 0.1],
            "lever_arm.x": [x, 1e-3, "m", 0.3],
            "lever_arm.y": [0.0005, 1e-3, "m", 0.3],
        }
        return {"values": rows, "information": np.diag([1e6] * 3).tolist()}

    file, left = bench.learned([fitted(0.02, 0.10), fitted(0.021, -0.02), fitted(0.019, 0.03)])
    assert [(entry.name, list(entry.parameters)) for entry in file.effect] == [("gyro_scale", ["z"])]
    assert file.effect[0].parameters["z"].value == pytest.approx(0.02)
    assert left == ["lever_arm.x", "lever_arm.y"]  # the sequences contradict each other; it is nothing


def test_the_true_scale_lies_between_both_slopes_whichever_signal_is_noisy(check: Any) -> None:
    rng = np.random.default_rng(2)
    f = rng.normal(size=(DRAWS, 3))
    noisy = f + 0.5 * rng.normal(size=(DRAWS, 3))
    diluted, swollen = check.slopes(noisy, 1.05 * f), check.slopes(f, 1.05 * noisy)
    np.testing.assert_allclose(diluted.forward, 1.05 / 1.25, atol=DRAWN)  # reliability var f / var E of 0.8
    np.testing.assert_allclose(diluted.reverse, 1.05, atol=DRAWN)
    np.testing.assert_allclose(swollen.forward, 1.05, atol=DRAWN)
    np.testing.assert_allclose(swollen.reverse, 1.05 * 1.25, atol=DRAWN)


def test_a_lag_that_changes_is_told_window_by_window_whatever_the_scale(check: Any) -> None:
    t, rate_hz = np.arange(3200) / 100.0, 100.0
    late_s = np.where(t < 16.0, 0.003, -0.002)
    turning = [
        np.stack([np.sin(2.0 * at + k) + np.cos(3.3 * at * (k + 1)) for k in range(3)], axis=1) for at in (t, t + late_s)
    ]
    lags = check.lags_s(turning[0], turning[1] @ np.diag([1.06, 0.91, 0.98]), rate_hz)
    np.testing.assert_allclose(lags, [0.003, 0.003, -0.002, -0.002], atol=LAG_S)


def test_positions_that_come_late_are_found_in_every_band_and_none_where_they_do_not(check: Any) -> None:
    felt, late_s = planted.rich(4, LONG_S), 0.012
    f_w = np.einsum("nij,nj->ni", felt.R_wb, felt.accel)
    late = np.einsum("nji,nj->ni", felt.R_wb, shift(f_w, (late_s * felt.rate_hz, 0.0), order=3, mode="nearest"))
    for ideal, expected_s in ((felt, 0.0), (replace(felt, accel=late), late_s)):
        pair = replace(planted.pair(felt, {}, 1), ideal=ideal)
        for lag_s, std_s in check.position_lags_s(pair):
            assert abs(lag_s - expected_s) < 4.0 * std_s + LAG_S
            assert std_s < MAX_LAG_STD_S


def test_physics_of_one_recording_removes_its_misfit_of_another(bench: Any, tmp_path: Path) -> None:
    path, felt = planted.moving(4), planted.rich(4)
    arm = planted.acting({"lever_arm": ARM_M})
    samples = planted.ideal(felt, arm) + planted.BIAS
    log = tmp_path / "flight.mcap"
    write(planted.recording("flight", felt.t_s, samples, poses=planted.poses(path, felt.t_s)), log)
    without, with_ = bench.residual_to_truth(log), bench.residual_to_truth(log, arm)
    assert without["gyro"].rms_after == without["gyro"].rms_before
    assert with_["accel"].rms_before == without["accel"].rms_before
    assert with_["accel"].rms_after < POSE_NOISE * with_["accel"].rms_before
    assert with_["accel"].seconds > 0.8 * planted.DURATION_S  # all of it, not a held-out part
