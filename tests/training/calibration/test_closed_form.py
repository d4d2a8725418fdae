"""A planted calibration comes back; what the motion does not show stays at zero; outliers of the truth do not pull."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from imutool.bias.networks import linear
from imutool.errors import DataError
from imutool.recording import Imu, Poses, Recording
from imutool.training.calibration import closed_form
from imutool.training.calibration.closed_form import Solution, solve
from imutool.training.calibration.log_scatter import CLOCK, NUISANCE_STD, ROTATION, shown_by_logs
from imutool.training.training_windows import Pool
from imutool.units import Sensor

Make = Callable[..., Recording]
W = {
    "gyro": np.array([[0.02, 0.01, -0.005], [0.003, -0.015, 0.004], [-0.008, 0.002, 0.01]]),
    "accel": np.array([[-0.01, 0.004, 0.006], [-0.002, 0.012, -0.007], [0.005, 0.001, 0.008]]),
}
RESTS = [
    {"gyro": np.array([0.04, -0.02, 0.01]), "accel": np.array([0.1, -0.2, 0.05])},
    {"gyro": np.array([0.03, -0.03, 0.02]), "accel": np.array([0.15, -0.1, 0.0])},
]
WINDOWS = {"gyro": (0.5, 2.0), "accel": (0.5, 1.0)}
DURATION_S = 25.0
# Exact samples and poses: what is left is the rule (`windows`), a second-order one: (rate'' dt² / 12) over a window, for a
# matrix as a share of the rate, 1e-4; for the accelerometer of its 3 m/s² of motion; and the prior's pull, smaller still.
EXACT = {"gyro": (2e-4, 5e-5), "accel": (1e-3, 5e-3)}  # of W, and of the rest bias in rad/s and m/s²
NOISE = {"gyro": 2.4e-3, "accel": 0.03}  # of a sample: the ADIS16448 at 200 Hz
# Five times what that noise leaves after 20 s: sigma sqrt(dt / T) of the rest, and that over 0.7 rad/s (3 m/s²) of W.
NOISY = {"gyro": (1e-3, 5e-4), "accel": (2e-3, 2e-2)}


@pytest.fixture(scope="module")
def flights(perfect: Make) -> list[Recording]:
    return [perfect(seed, duration_s=DURATION_S, still_s=1.0) for seed in (1, 2)]


def calibrate(recordings: Sequence[Recording], windows: dict[str, tuple[float, ...]] | None = None) -> dict[str, Solution]:
    """Both sensors, the gyro first, as the training does it."""
    pool = Pool.of(recordings)
    model = linear.Network(rate_hz=pool.rate_hz).double()
    rest = torch.zeros(len(recordings), 6, dtype=torch.float64)
    found = {}
    sensors: tuple[Sensor, Sensor] = ("gyro", "accel")
    for i, sensor in enumerate(sensors):
        found[sensor] = solve(model, sensor, pool, rest, (windows or WINDOWS)[sensor], matrix=True)
        model.begin_at(sensor, found[sensor].W)
        rest[:, 3 * i : 3 * i + 3] = found[sensor].rest
    return found


@pytest.mark.parametrize(("noise", "tolerance"), [(False, EXACT), (True, NOISY)])
def test_planted_matrices_and_biases_are_recovered(
    flights: list[Recording], planted: Make, noise: bool, tolerance: dict[str, tuple[float, float]]
) -> None:
    made = [planted(flight, W, rest) for flight, rest in zip(flights, RESTS, strict=True)]
    if noise:
        rng = np.random.default_rng(1)
        made = [
            replace(
                r,
                imu=Imu(
                    r.imu.t_ns,
                    r.imu.gyro + NOISE["gyro"] * rng.normal(size=r.imu.gyro.shape),
                    r.imu.accel + NOISE["accel"] * rng.normal(size=r.imu.accel.shape),
                ),
            )
            for r in made
        ]
    for sensor, solution in calibrate(made).items():
        of_W, of_rest = tolerance[sensor]
        np.testing.assert_allclose(solution.W, W[sensor], atol=of_W, err_msg=sensor)
        np.testing.assert_allclose(solution.rest, [rest[sensor] for rest in RESTS], atol=of_rest, err_msg=sensor)


def test_a_perfect_sensor_gets_nothing(flights: list[Recording]) -> None:
    for sensor, solution in calibrate(flights).items():
        of_W, of_rest = EXACT[sensor]
        assert solution.W.abs().max() < of_W
        assert solution.rest.abs().max() < of_rest


def test_without_matrix_only_the_rest_biases_move(flights: list[Recording], planted: Make) -> None:
    made = [planted(flight, {k: np.zeros((3, 3)) for k in W}, rest) for flight, rest in zip(flights, RESTS, strict=True)]
    pool = Pool.of(made)
    begin = torch.zeros(2, 6, dtype=torch.float64)
    solution = solve(linear.Network().double(), "gyro", pool, begin, WINDOWS["gyro"], matrix=False)
    assert torch.equal(solution.W, torch.zeros(3, 3, dtype=torch.float64))
    np.testing.assert_allclose(solution.rest, [rest["gyro"] for rest in RESTS], atol=EXACT["gyro"][1])
    assert not begin.any(), "what is passed in stays as it is"


def planar(seed: int, duration_s: float = DURATION_S) -> Recording:
    """A body that turns about the vertical alone, on a horizontal plane, with exact samples and truth at 200 Hz."""
    t = np.arange(int(duration_s * 200) + 1) / 200.0
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 0.8, 4), rng.uniform(0.0, 6.28, 4)
    heading = np.sin(frequency * t[:, None] * 6.28 + phase).sum(axis=1)
    rate = (np.cos(frequency * t[:, None] * 6.28 + phase) * 6.28 * frequency).sum(axis=1)
    p = np.column_stack([np.sin(1.3 * t + seed), np.cos(0.9 * t), np.zeros_like(t)])
    v = np.column_stack([1.3 * np.cos(1.3 * t + seed), -0.9 * np.sin(0.9 * t), np.zeros_like(t)])
    a = np.column_stack([-(1.3**2) * np.sin(1.3 * t + seed), -(0.9**2) * np.cos(0.9 * t), np.zeros_like(t)])
    turn = Rotation.from_euler("z", heading[:, None])
    t_ns = 10**18 + np.round(t * 1e9).astype(np.int64)
    gyro = np.column_stack([np.zeros_like(t), np.zeros_like(t), rate])
    accel = turn.inv().apply(a + np.array([0.0, 0.0, 9.81]))
    poses = Poses(t_ns, p, turn.as_quat(scalar_first=True), v)
    return Recording(f"planar_{seed}", Imu(t_ns, gyro, accel), {"/truth": poses})


def test_what_a_planar_motion_does_not_show_stays_at_zero(planted: Make) -> None:
    """Only the last column of the gyro's matrix meets a rate; the others meet nothing but the rest bias itself."""
    only_seen = np.zeros((3, 3))
    only_seen[:, 2] = W["gyro"][:, 2]
    rests = [{"gyro": np.zeros(3), "accel": np.zeros(3)}] * 2
    made = [planted(planar(seed), {"gyro": only_seen, "accel": np.zeros((3, 3))}, rests[0]) for seed in (1, 2)]
    solution = calibrate(made)["gyro"]
    np.testing.assert_allclose(solution.W[:, 2], W["gyro"][:, 2], atol=EXACT["gyro"][0])
    # measured x and y rates are 1e-2 of the z rate (the planted column), which tells of the other columns next to nothing
    assert solution.W[:, :2].abs().max() < 0.2 * np.abs(W["gyro"][:, 2]).max()


@pytest.mark.parametrize("noise", [0.0, 2.4e-3])
def test_a_sensor_that_only_rests_shows_no_matrix(planted: Make, perfect: Make, noise: float) -> None:
    """Without noise, too: what is unknown must not be made of rounding errors."""
    made = planted(perfect(3, duration_s=10.0, still_s=60.0), {k: np.zeros((3, 3)) for k in W}, RESTS[0], noise)
    solution = calibrate([made])["gyro"]
    np.testing.assert_allclose(solution.rest[0], RESTS[0]["gyro"], atol=1e-3)
    assert solution.W.abs().max() < 1e-2  # rest and W tell the same story; the prior gives W its share of it and no more


def test_outliers_of_the_truth_do_not_pull(flights: list[Recording], planted: Make) -> None:
    """A motion capture that loses its markers: one pose in a hundred is turned by tens of degrees."""
    made = [planted(flight, W, rest) for flight, rest in zip(flights, RESTS, strict=True)]
    rng = np.random.default_rng(5)
    spoiled = []
    for recording in made:
        truth = recording.truth
        wrong = rng.random(len(truth)) < 0.01
        turn = Rotation.from_rotvec(np.where(wrong[:, None], rng.normal(size=(len(truth), 3)), 0.0))
        q = (Rotation.from_quat(truth.q_wb_wxyz, scalar_first=True) * turn).as_quat(scalar_first=True)
        spoiled.append(replace(recording, truths={"/t": replace(truth, q_wb_wxyz=q)}))
    pool = Pool.of(spoiled)
    rest = torch.zeros(2, 6, dtype=torch.float64)
    solution = solve(linear.Network().double(), "gyro", pool, rest, WINDOWS["gyro"], matrix=True)
    of_W, of_rest = NOISY["gyro"]
    np.testing.assert_allclose(solution.W, W["gyro"], atol=of_W)
    np.testing.assert_allclose(solution.rest, [rest["gyro"] for rest in RESTS], atol=of_rest)


def test_what_is_left_of_the_windows_is_next_to_nothing(flights: list[Recording], planted: Make) -> None:
    made = [planted(flight, W, rest) for flight, rest in zip(flights, RESTS, strict=True)]
    found, pool = calibrate(made), Pool.of(made)
    model = linear.Network().double().requires_grad_(False)
    rest = torch.cat([found["gyro"].rest, found["accel"].rest], dim=1)
    for sensor, maximum in (("gyro", 1e-4), ("accel", 5e-3)):  # rad and m/s; the biases alone had moved it by 0.05 and 0.5
        model.begin_at(sensor, found[sensor].W)  # type: ignore[arg-type]
        first = pool.starts(pool.samples(1.0), "train", hop=50)
        windows = pool.windows(first, pool.samples(1.0), rest[pool.log[first]])
        e, _ = closed_form.sensor_residual(model, sensor, windows)  # type: ignore[arg-type]
        assert e.norm(dim=1).median() < maximum, sensor


def test_the_derivative_of_a_window_is_that_of_finite_differences(flights: list[Recording], planted: Make) -> None:
    made = [planted(flight, W, rest) for flight, rest in zip(flights, RESTS, strict=True)]
    pool = Pool.of(made)
    first = pool.starts(60, "train", hop=601)
    rest = torch.tensor([[*r["gyro"], *r["accel"]] for r in RESTS], dtype=torch.float64)
    model = linear.Network().double()
    model.begin_at("gyro", torch.from_numpy(W["gyro"]))
    model.requires_grad_(False)
    for sensor, tolerance in (("gyro", 5e-3), ("accel", 1e-9)):  # the gyro's is exact in the limit of small steps
        begin = torch.from_numpy(W[sensor]) if sensor == "accel" else torch.zeros(3, 3, dtype=torch.float64)
        windows = pool.windows(first, 60, rest[pool.log[first]])
        _, A = closed_form.sensor_residual(model, sensor, windows, begin)  # type: ignore[arg-type]
        u, _ = windows.segment.of(sensor)  # type: ignore[arg-type]
        u = 0.5 * (u[:, 1:] + u[:, :-1]) if sensor == "gyro" else u
        J = closed_form._by_matrix(A, u)
        for index in range(9):
            change = torch.zeros(9, dtype=torch.float64)
            change[index] = 1e-6
            ahead, behind = (
                closed_form.sensor_residual(model, sensor, windows, begin + s * change.reshape(3, 3))[0]  # type: ignore[arg-type]
                for s in (1, -1)
            )
            slope = (ahead - behind) / 2e-6
            scale = float(J.abs().max())
            torch.testing.assert_close(slope, J[..., index], rtol=0, atol=tolerance * scale)


def test_a_log_whose_training_part_has_no_truth_is_named(flights: list[Recording], without_truth: Make) -> None:
    """Its truth begins with the held-out part, so to say: the first four fifths have holes everywhere."""
    holed = flights[1]
    for start in np.arange(0.05, 0.8 * DURATION_S, 0.45):
        holed = without_truth(holed, start, start + 0.3)
    with pytest.raises(DataError, match=r"exact_2: no stretch of truth without a gap in the train part; expected 0.5 s"):
        calibrate([flights[0], holed])


def shown(clock_s: float, turn_rad: float) -> tuple[float, float]:
    """Widths of clock and rotation from twelve logs with a common clock of 6 ms and their own on top."""
    rng, deviation = np.random.default_rng(3), np.array([1e-3] * 3 + [5e-4] * 3 + [2e-4])
    H, g = [], []
    for sign in (1, -1) * 6:
        J = np.linalg.qr(rng.normal(size=(40, 7)))[0] / deviation
        J = np.column_stack([J[:, 6], J])  # theta is the common clock
        own = np.concatenate([0.01 * rng.normal(size=3), sign * turn_rad * np.ones(3), [sign * clock_s]])
        e = rng.normal(size=40) - J @ np.concatenate([[6e-3], own])
        H.append(torch.from_numpy(J.T @ J))
        g.append(torch.from_numpy(J.T @ e))
    theta, own = torch.zeros(1).double(), torch.zeros(12, 7).double()
    found = shown_by_logs("gyro", torch.stack(H), torch.stack(g), theta, own, torch.tensor([1e4]).double()) ** -0.5
    return float(found[CLOCK["gyro"]]), float(found[ROTATION["gyro"]][0])


def test_nuisances_are_as_wide_as_logs_scatter() -> None:
    """A common clock is no scatter, and no width is beyond the plausible."""
    *_, turn, clock = NUISANCE_STD["gyro"]
    assert shown(0.0, 0.0) == (pytest.approx(clock / 20), pytest.approx(turn / 20))
    assert shown(2e-3, 0.0) == (pytest.approx(2e-3, rel=0.3), pytest.approx(turn / 20))
    assert shown(0.0, 4e-3) == (pytest.approx(clock / 20), pytest.approx(4e-3, rel=0.3))
    assert shown(0.05, 0.1) == (pytest.approx(clock), pytest.approx(turn))


def test_an_estimate_that_hides_the_errors_of_the_imu_counts_less_than_a_truth(flights: list[Recording], planted: Make) -> None:
    """Poses made with the IMU follow it: next to them it seems to have no matrix, and their small residual is no merit."""
    small, none = ({sensor: size * W[sensor] for sensor in W} for size in (0.1, 0.0))
    no_rest = {sensor: np.zeros(3) for sensor in W}
    true, hidden = planted(flights[0], small, no_rest, noise=NOISE["gyro"]), planted(flights[1], none, no_rest)
    misses = {}
    for kind in ("truth", "estimate", "odometry"):
        doubtful = replace(hidden, other_poses={} if kind == "truth" else {"/ground_truth/pose": kind})
        misses[kind] = float(np.abs(calibrate([true, doubtful])["gyro"].W.numpy() - small["gyro"]).max())
    assert misses["truth"] > 0.9 * np.abs(small["gyro"]).max()
    assert misses["estimate"] < 0.3 * misses["truth"], misses
    assert misses["odometry"] < misses["estimate"], misses
