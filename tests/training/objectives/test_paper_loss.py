"""The paper's loss: segments from true poses, and from the biases that consecutive poses give."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from imutool.bias.networks.neural_ode import Network
from imutool.bias.neural_ode import Config
from imutool.errors import ConfigError, DataError
from imutool.recording import Imu, Recording
from imutool.training.objectives.objective import RestBiases
from imutool.training.objectives.paper_scheme import PaperLoss, biases_from_poses
from imutool.training.settings import PaperSettings, TrainSettings
from imutool.training.training_windows import Pool

Make = Callable[..., Recording]
BIAS = np.array([0.01, -0.02, 0.02, 0.1, -0.2, 0.2])
LATE = {"gyro": 0.03, "accel": 0.4}  # rad/s and m/s²: half a step, 2.5 ms, of a motion's changes of rate and force

FIRST_STEP = {"gyro": 1e-20, "accel": 2e-7}  # rad² and m²: a position by Euler's rule lacks 30 m/s² dt² / 2


def biased(perfect: Make, noise: float = 0.0) -> Recording:
    exact = perfect(1, duration_s=8.0, still_s=0.5)
    drawn = noise * np.random.default_rng(0).normal(size=(len(exact.imu), 6))
    gyro, accel = exact.imu.gyro + BIAS[:3] + drawn[:, :3], exact.imu.accel + BIAS[3:] + drawn[:, 3:]
    return Recording(exact.name, Imu(exact.imu.t_ns, gyro, accel), exact.truths)


def still(pool: Pool, sensor: str, **changes: int) -> PaperLoss:
    """Loss of a model whose fields are zero: a segment's bias stays what it was."""
    model = Network(Config(scheme="paper"), pool.rate_hz).double()
    for name, value in model.named_parameters():
        if ".out." in name:
            torch.nn.init.zeros_(value)
    settings = TrainSettings(paper=PaperSettings(**changes))
    return PaperLoss(model, "gyro" if sensor == "gyro" else "accel", pool, RestBiases(pool, 20.0), settings)


def test_consecutive_poses_give_the_bias(perfect: Make) -> None:
    pool = Pool.of([biased(perfect)])
    found, known = biases_from_poses(pool, 1)
    assert int(known.sum()) == len(known) - 1  # all but the last
    off = (found - torch.from_numpy(BIAS))[known].abs()
    assert off[:, :3].max() < LATE["gyro"]
    assert off[:, 3:].max() < LATE["accel"]
    torch.testing.assert_close(found[known].mean(0), torch.from_numpy(BIAS), rtol=0.02, atol=1e-2)


def test_smoothing_takes_noise_off_and_no_gap_into_it(perfect: Make) -> None:
    pool = Pool.of([biased(perfect, noise=0.1)])
    trusted = pool.trusted.clone()
    trusted[700:720] = False
    pool = replace(pool, trusted=trusted, R_wb=torch.where(trusted[:, None, None], pool.R_wb, torch.full_like(pool.R_wb, 0.5)))
    single, known = biases_from_poses(pool, 1)
    smoothed, _ = biases_from_poses(pool, 51)
    assert not known[700:720].any()
    spread = [float((x - torch.from_numpy(BIAS))[known][:, :3].std()) for x in (single, smoothed)]
    assert spread[0] == pytest.approx(0.1, rel=0.1)
    assert spread[1] < 0.03
    assert float((smoothed - torch.from_numpy(BIAS))[690:730].abs().max()) < LATE["accel"]


def test_a_segment_from_its_true_bias_misses_what_the_bias_changes(perfect: Make) -> None:
    """The first bias makes the first step exact, whatever the sensor; later steps miss what the motion changes."""
    pool = Pool.of([biased(perfect)])
    for sensor in ("gyro", "accel"):
        loss = still(pool, sensor)
        squares = loss.squares(loss.first_by_log[0]).detach()
        assert float(squares[0].max()) < FIRST_STEP[sensor]
        assert float(squares[-1].max()) < (LATE[sensor] * 16 * 0.005) ** 2 * 2


def test_a_wrong_bias_turns_by_itself_times_the_time(perfect: Make) -> None:
    pool = Pool.of([biased(perfect)])
    loss = still(pool, "gyro")
    loss.start = loss.start + torch.tensor([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    missed = loss.squares(loss.first_by_log[0]).detach().sqrt().median(1).values
    expected = 0.3 * 0.005 * torch.arange(1, 17, dtype=torch.float64)
    torch.testing.assert_close(missed, expected, rtol=0.1, atol=1e-4)


def test_a_steps_terms_are_the_mean_over_all_its_segments(perfect: Make) -> None:
    loss, again = still(Pool.of([biased(perfect)]), "accel", segments=600), torch.Generator().manual_seed(3)
    terms = loss.terms(torch.Generator().manual_seed(3))
    torch.randint(1, (1,), generator=again)  # the log of the step
    chosen = torch.randint(len(loss.first_by_log[0]), (600,), generator=again)
    whole = loss.squares(loss.first_by_log[0][chosen]).mean()
    assert len(terms) > 1
    torch.testing.assert_close(torch.stack([term() for term in terms]).sum(), 1e6 * whole, rtol=1e-12, atol=0)


def test_smoothing_that_would_do_nothing_is_refused(perfect: Make) -> None:
    pool = Pool.of([biased(perfect)])
    with pytest.raises(ConfigError, match=r"paper\.smoothed_samples.*4 and more"):
        still(pool, "gyro", smoothed_samples=3)


def test_truth_too_short_for_a_segment_is_refused(perfect: Make) -> None:
    pool = Pool.of([biased(perfect)])
    with pytest.raises(DataError, match="no segment of 5000 samples"):
        still(pool, "gyro", samples=5000)


def test_a_step_draws_its_segments_from_one_log(perfect: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Over many steps from all."""
    pool = Pool.of([biased(perfect), biased(perfect, noise=0.01)])
    seen: list[set[int]] = []

    def drawn(first: torch.Tensor) -> torch.Tensor:
        seen.append(set(pool.log[first].tolist()))
        return torch.zeros(1)

    loss, generator = still(pool, "gyro", segments=600), torch.Generator().manual_seed(0)
    monkeypatch.setattr(loss, "squares", drawn)
    logs: list[set[int]] = []
    for _ in range(20):
        seen.clear()
        for term in loss.terms(generator):
            term()
        assert len(seen) == 3
        logs.append(set.union(*seen))
    assert {len(of_step) for of_step in logs} == {1}
    assert set.union(*logs) == {0, 1}
