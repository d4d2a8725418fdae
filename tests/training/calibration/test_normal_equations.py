"""Leaving a log out of shared least squares gives what solving all the others from scratch gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imutool.sensor.made_up_flight import flight
from imutool.training.calibration import log_scatter
from imutool.training.calibration.effect_selection import calibrate
from imutool.training.calibration.log_scatter import USUAL_SQUARES, WANDER, LogPieces
from imutool.training.calibration.shared_parameters import Equations, Problem
from imutool.training.training_windows import Pool

LOGS, SHARED, OWN, DRAWS = 4, 5, 2, 200
ROUNDING = 1e-10
Data = list[tuple[torch.Tensor, torch.Tensor]]


@pytest.fixture(scope="module")
def data() -> Data:
    """Slopes and residuals of each log at zero: e = J [theta, own] + r."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return [(normal(30, SHARED + OWN), normal(30)) for _ in range(LOGS)]


PRIOR, OWN_PRIOR = torch.linspace(0.5, 2.0, SHARED).double(), torch.tensor([0.3, 0.7]).double()


def problem(data: Data, theta: torch.Tensor, own: torch.Tensor, free: int = OWN) -> Problem:
    """The losses about a point."""
    H, g, c = [], [], []
    for i, (J, r) in enumerate(data):
        e = J @ torch.cat([theta, own[i]]) + r
        H.append(J.T @ J)
        g.append(J.T @ e)
        c.append(e @ e)
    equations = Equations(torch.stack(H), torch.stack(g), torch.stack(c))
    return Problem(theta, own, PRIOR, OWN_PRIOR, 1.0, free, equations, equations)


def at_once(data: Data, columns: list[int], logs: list[int]) -> tuple[torch.Tensor, torch.Tensor]:
    """All unknowns in one system: theta (others at zero) and the own of each log."""
    c = len(columns)
    H = torch.zeros(c + OWN * len(logs), c + OWN * len(logs), dtype=torch.float64)
    g = torch.zeros(len(H), dtype=torch.float64)
    H[:c, :c] += torch.diag(PRIOR[columns])
    for k, i in enumerate(logs):
        where = [*range(c), *range(c + OWN * k, c + OWN * (k + 1))]
        J, r = data[i]
        J = J[:, [*columns, SHARED, SHARED + 1]]
        H[torch.tensor(where)[:, None], torch.tensor(where)] += J.T @ J
        g[where] += J.T @ r
        own = where[c:]
        H[own, own] += OWN_PRIOR
    x = -torch.linalg.solve(H, g)
    return x[:c], x[c:].reshape(-1, OWN)


@pytest.mark.parametrize("columns", [list(range(SHARED)), [0, 3], []])
@pytest.mark.parametrize("without", [None, 2])
@pytest.mark.parametrize("from_zero", [True, False])
def test_the_shared_parameters_are_those_of_the_whole_system(
    data: Data, columns: list[int], without: int | None, from_zero: bool
) -> None:
    """From any point: the losses are quadratic, so one step arrives."""
    size = 0.0 if from_zero else 1.0
    theta, own = size * torch.arange(float(SHARED)).double(), size * torch.ones(LOGS, OWN).double()
    made = problem(data, theta, own)
    found = made.solve(columns, without)
    logs = [i for i in range(LOGS) if i != without]
    expected, expected_own = at_once(data, columns, logs)
    others = [k for k in range(SHARED) if k not in columns]
    torch.testing.assert_close(found.theta[columns], expected, rtol=0, atol=ROUNDING)
    assert not found.theta[others].any()
    torch.testing.assert_close(made.own_at(found.theta)[logs], expected_own, rtol=0, atol=ROUNDING)
    assert found.covariance.shape == (len(columns), len(columns))


def test_a_logs_loss_is_judged_at_what_the_others_say(data: Data) -> None:
    made = problem(data, torch.zeros(SHARED).double(), torch.zeros(LOGS, OWN).double())
    losses = made.predicted([1, 2])
    for i, (J, r) in enumerate(data):
        theta, _ = at_once(data, [1, 2], [j for j in range(LOGS) if j != i])
        left = J[:, [1, 2]] @ theta + r
        own = torch.linalg.lstsq(J[:, SHARED:], -left[:, None]).solution[:, 0]
        assert float(losses[i]) == pytest.approx(float((left + J[:, SHARED:] @ own).square().sum()), rel=1e-8)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_nuisance_keeps_its_prior_in_a_log_that_is_judged(data: Data, size: float) -> None:
    """From any point: the loss is that of the residuals and of the nuisance's prior together."""
    made = problem(data, size * torch.ones(SHARED).double(), size * torch.ones(LOGS, OWN).double(), free=1)
    losses = made.predicted([1, 2])
    for i, (J, r) in enumerate(data):
        theta, _ = at_once(data, [1, 2], [j for j in range(LOGS) if j != i])
        left = torch.cat([J[:, [1, 2]] @ theta + r, torch.zeros(1).double()])
        by_own = torch.cat([J[:, SHARED:], torch.tensor([[0.0, float(OWN_PRIOR[1]) ** 0.5]]).double()])
        own = torch.linalg.lstsq(by_own, -left[:, None]).solution[:, 0]
        assert float(losses[i]) == pytest.approx(float((left + by_own @ own).square().sum()), rel=1e-6)
    assert len(made.without(0).own) == len(made.without(0).fit.H) == LOGS - 1


def test_the_covariance_is_the_inverse_of_the_information(data: Data) -> None:
    """Schur's complement inverted is the block of the whole inverse."""
    made = problem(data, torch.zeros(SHARED).double(), torch.zeros(LOGS, OWN).double())
    H = torch.zeros(SHARED + OWN * LOGS, SHARED + OWN * LOGS).double()
    H[:SHARED, :SHARED] += torch.diag(PRIOR)
    for i, (J, _) in enumerate(data):
        where = torch.tensor([*range(SHARED), *range(SHARED + OWN * i, SHARED + OWN * (i + 1))])
        H[where[:, None], where] += J.T @ J
        H[where[SHARED:], where[SHARED:]] += OWN_PRIOR
    expected = torch.linalg.inv(H)[:SHARED, :SHARED]
    torch.testing.assert_close(made.solve(range(SHARED)).covariance, expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("noise", [0.4, 1.0, 2.5])
def test_the_covariance_follows_the_scatter_of_the_logs(noise: float) -> None:
    """It allows for errors of another size than the solution takes them for; squares of the usual size count as well."""
    generator = torch.Generator().manual_seed(3)
    squares, sizes = [], []
    for _ in range(DRAWS):
        theta = torch.randn(SHARED, generator=generator, dtype=torch.float64) / PRIOR.sqrt()
        data = []
        for _ in range(LOGS):
            J = torch.randn(40, SHARED + OWN, generator=generator, dtype=torch.float64)
            own = torch.randn(OWN, generator=generator, dtype=torch.float64) / OWN_PRIOR.sqrt()
            r = noise * torch.randn(40, generator=generator, dtype=torch.float64) - J @ torch.cat([theta, own])
            data.append((J / 2.0**0.5, r / 2.0**0.5))
        zero = problem(data, torch.zeros(SHARED).double(), torch.zeros(LOGS, OWN).double())
        made = replace(zero, design_effect=2.0)
        found = made.solve(range(SHARED))
        error = found.theta - theta
        squares.append(float(error @ torch.linalg.solve(found.covariance, error)))
        sizes.append(float(torch.linalg.solve(found.covariance, made.solve_by_scatter(range(SHARED)).covariance).trace()))
    freedom = SHARED * (LOGS - 1)
    size = (freedom * noise**2 + USUAL_SQUARES) / (freedom + USUAL_SQUARES - 2.0)
    assert sum(squares) / sum(sizes) == pytest.approx(noise**2 / size, rel=0.25)
    assert sum(squares) / (DRAWS * SHARED) == pytest.approx(noise**2 / made.design_effect, rel=0.25)  # without the scatter


def test_a_parameter_that_only_missing_effects_show_stays_near_its_prior() -> None:
    """The losses take errors for ten times smaller than the logs scatter, and the motion hardly shows the first parameter."""
    generator = torch.Generator().manual_seed(4)
    weak, ratios = torch.tensor([0.1, *[1.0] * (SHARED + OWN - 1)], dtype=torch.float64), []
    for _ in range(DRAWS):
        normal = [torch.randn(40, SHARED + OWN + 1, generator=generator, dtype=torch.float64) for _ in range(LOGS)]
        zero = problem(
            [(x[:, :-1] * weak, 10.0 * x[:, -1]) for x in normal], torch.zeros(SHARED).double(), torch.zeros(LOGS, OWN).double()
        )
        solved = [zero.solve(range(SHARED)), zero.solve_by_scatter(range(SHARED))]
        ratios.append([float(found.theta[0].square() / found.covariance[0, 0]) for found in solved])
        assert solved[1].theta[0].abs() < PRIOR[0].rsqrt()
    stated, scattered = torch.tensor(ratios).mean(0).tolist()
    assert stated > 10.0
    assert scattered < 1.0


def test_a_log_on_its_own_counts_in_full(data: Data) -> None:
    made = problem(data, torch.zeros(SHARED).double(), torch.zeros(LOGS, OWN).double())
    alone = replace(made.alone(1), design_effect=2.0)
    expected = replace(alone._of([0], 2.0), design_effect=1.0).solve(range(SHARED))
    torch.testing.assert_close(alone.solve_by_scatter(range(SHARED)).covariance, expected.covariance, rtol=0, atol=ROUNDING)
    assert made.solve_by_scatter([]).covariance.shape == (0, 0)


def test_pieces_of_a_log_differ_in_their_rest_bias(data: Data) -> None:
    """The loss of a log is that of its pieces with the best differences, and a log in one piece keeps its own."""
    log = torch.tensor([0] * 4 + [1] * 3)
    split = LogPieces.of(log, torch.tensor([0.0, 100.0, 310.0, 350.0, 0.0, 100.0, 299.0]).double(), 2)
    assert split.of_sample.tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert split.log.tolist() == [0, 0, 1]
    wide, p, rest = 4, 1, slice(1, 4)
    losses = [(J[:, :wide], r) for J, r in data[: len(split.log)]]
    H, g, c = (torch.stack(parts) for parts in zip(*((J.T @ J, J.T @ r, r @ r) for J, r in losses), strict=True))
    merged = split.merged(H, g, c, "gyro", p)
    assert torch.equal(merged[0][1], H[2])
    assert merged[2][1] == c[2]
    at, minimum = torch.tensor([0.3, -0.2, 0.1, 0.4]).double(), 0.0
    for J, r in losses[:2]:
        e, by_rest = J @ at + r, J[:, rest]
        ridge = torch.eye(3).double() / WANDER["gyro"] ** 2
        off = -torch.linalg.solve(by_rest.T @ by_rest + ridge, by_rest.T @ e)
        minimum += float((e + by_rest @ off).square().sum() + off @ ridge @ off)
    found = merged[2][0] + 2.0 * merged[1][0] @ at + at @ merged[0][0] @ at
    assert float(found) == pytest.approx(minimum, rel=ROUNDING)


def test_a_bias_that_wanders_over_a_long_log_is_no_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made-up sensors warm up with a time constant of 20 s, and their bias wanders."""
    logs = [flight(seed, duration_s=500.0, rate_hz=50.0) for seed in (3, 4)]
    still = [log.scalars["/ground_truth/bias/gyro"].values for log in logs]
    warm_up = np.mean([bias[0] - bias[100 * 50] for bias in still], axis=0)  # but for a share of 7e-3, and the wander
    pool, errors = Pool.of(logs), []
    for piece_s in (1e9, log_scatter.PIECE_S):
        monkeypatch.setattr(log_scatter, "PIECE_S", piece_s)
        fit = calibrate(pool, "gyro", pool.gyro, ("gyro_scale", "gyro_misalignment", "gyro_warm_up"), "all")
        found = fit.theta[-9:].reshape(3, 3).numpy()  # for each axis those of 5, 20 and 80 s
        errors.append(np.abs(found + np.outer(warm_up, [0.0, 1.0, 0.0])).mean())
    assert errors[1] < 0.7 * errors[0], errors
