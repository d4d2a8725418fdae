"""Least squares in parameters that logs share, with each log's own unknowns eliminated.

Those of a log are eliminated log by log (Schur's complement), so that one solve of a matrix as small as the shared parameters
predicts a log from all others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from imutool.array_types import Float
from imutool.training.calibration.log_scatter import Integrated, integrated, shared_by_scatter

TINY = 1e-12  # of a loss, whose unit is a window's noise
RIDGE = 1e-9  # of a diagonal, so that a log without information on its own unknowns can be solved


@dataclass(frozen=True)
class Equations:
    """Loss of each log about a point, c + 2 g.d + d.H.d: unknowns theta, then the log's own."""

    H: Float[Tensor, "logs k k"]
    g: Float[Tensor, "logs k"]
    c: Float[Tensor, " logs"]

    def __add__(self, other: Equations) -> Equations:
        return Equations(self.H + other.H, self.g + other.g, self.c + other.c)

    def of(self, logs: Sequence[int]) -> Equations:
        """The losses of some logs."""
        return Equations(self.H[logs], self.g[logs], self.c[logs])

    def times(self, factor: float) -> Equations:
        """The same losses, each multiplied by a factor."""
        return Equations(factor * self.H, factor * self.g, factor * self.c)

    def moved(self, d_theta: Float[Tensor, " p"]) -> Equations:
        """The same losses about another point, moved in theta."""
        p = len(d_theta)
        Hd = self.H[:, :, :p] @ d_theta
        return Equations(self.H, self.g + Hd, self.c + 2 * self.g[:, :p] @ d_theta + Hd[:, :p] @ d_theta)


class Solution(NamedTuple):
    """Parameters, zero where they were not solved for, and the covariance of the others."""

    theta: Float[Tensor, " p"]
    covariance: Float[Tensor, "c c"]


@dataclass(frozen=True)
class Problem:
    """Linearisation point, the losses about it, and priors about zero."""

    theta: Float[Tensor, " p"]
    own: Float[Tensor, "logs o"]
    prior: Float[Tensor, " p"]  # one over the plausible variance of each parameter
    own_prior: Float[Tensor, " o"]
    design_effect: float  # by which the losses are divided
    free: int  # of a log's own unknowns: those without a prior when the log is predicted
    fit: Equations
    judged: Equations  # what a solution is judged by

    def solve(self, columns: Sequence[int], without: int | None = None) -> Solution:
        """Gauss-Newton step for some parameters, the others at zero, and all logs but one."""
        return self._solved(list(columns), *self._eliminated(list(columns)), without)

    def _eliminated(self, columns: list[int]) -> tuple[Float[Tensor, " p"], Float[Tensor, "logs c c"], Float[Tensor, "logs c"]]:
        """Point with the other parameters at zero, and each log's equations there without its own unknowns."""
        p, at = len(self.prior), torch.zeros_like(self.theta)
        at[columns] = self.theta[columns]
        fit = self.fit.moved(at - self.theta)
        own_H, own_g = self._own_equations(fit)
        shared = fit.H[:, columns]
        X = torch.linalg.solve(own_H, shared[:, :, p:].mT)
        return at, shared[:, :, columns] - shared[:, :, p:] @ X, fit.g[:, columns] - (X.mT @ own_g[..., None])[..., 0]

    def _solved(
        self,
        columns: list[int],
        start: Float[Tensor, " p"],
        S: Float[Tensor, "logs c c"],
        v: Float[Tensor, "logs c"],
        without: int | None,
    ) -> Solution:
        kept, at = [i for i in range(len(self.own)) if i != without], start.clone()
        S, v = torch.diag(self.prior[columns]) + S[kept].sum(0), self.prior[columns] * at[columns] + v[kept].sum(0)
        covariance = torch.linalg.inv(S) if columns else S
        at[columns] -= covariance @ v
        return Solution(at, covariance)

    def solve_by_scatter(self, columns: Sequence[int], without: int | None = None) -> Solution:
        """The same with errors as large as the logs scatter, in place of the design effect."""
        return self._solved_by_scatter(list(columns), *self._integrated(list(columns)), without)

    def _integrated(self, columns: list[int]) -> tuple[Float[Tensor, " p"], Integrated]:
        """Point with the other parameters at zero, and each log's losses there as if it were alone."""
        at = torch.zeros_like(self.theta)
        at[columns] = self.theta[columns]
        fit = self.fit.times(self.design_effect).moved(at - self.theta)
        kept = [*columns, *range(len(self.prior), fit.g.shape[1])]
        return at, integrated(fit.H[:, kept][:, :, kept], fit.g[:, kept], self.own, self.own_prior, len(columns))

    def _solved_by_scatter(
        self, columns: list[int], start: Float[Tensor, " p"], of_logs: Integrated, without: int | None
    ) -> Solution:
        logs, at = [i for i in range(len(self.own)) if i != without], start.clone()
        some = Integrated(*(part[logs] for part in of_logs))
        at[columns], covariance = shared_by_scatter(some, at[columns], self.prior[columns])
        return Solution(at, covariance)

    def without(self, index: int) -> Problem:
        """The problem of all logs but one."""
        return self._of([i for i in range(len(self.own)) if i != index])

    def alone(self, index: int) -> Problem:
        """The problem of one log, which counts in full."""
        return replace(self._of([index], self.design_effect), design_effect=1.0)

    def own_at(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "logs o"]:
        """Unknowns of each log, for given parameters."""
        H, g = self._own_equations(self.fit.moved(theta - self.theta))
        own: Tensor = self.own - torch.linalg.solve(H, g)
        return own

    def predicted(self, columns: Sequence[int], *, by_itself: bool = False, by_scatter: bool = False) -> Float[Tensor, " logs"]:
        """Loss of each log with parameters of the other logs, or `by_itself`; its own are solved for."""
        columns, p, losses = list(columns), len(self.prior), []
        of_others: Callable[[int], Solution] = partial(self._solved, columns, *self._eliminated(columns))
        if by_scatter:
            of_others = partial(self._solved_by_scatter, columns, *self._integrated(columns))
        penalty = torch.where(torch.arange(len(self.own_prior)).to(self.prior) < self.free, 0.0, self.own_prior)
        for i, at in enumerate(self.own):
            theta = (self.alone(i).solve(columns) if by_itself else of_others(i)).theta
            judged = self.judged.of([i]).moved(theta - self.theta)
            H, g = judged.H[0, p:, p:] + torch.diag(penalty), judged.g[0, p:] + penalty * at
            minimum = RIDGE * H.diagonal().mean().clamp_min(RIDGE)
            own = -torch.linalg.solve(H + minimum * torch.eye(len(g)).to(H), g)
            losses.append(judged.c[0] + penalty @ at.square() + 2 * g @ own + own @ H @ own)
        return torch.stack(losses)

    def _of(self, logs: Sequence[int], factor: float = 1.0) -> Problem:
        fit, judged = (e.of(logs).times(factor) for e in (self.fit, self.judged))
        return replace(self, own=self.own[logs], fit=fit, judged=judged)

    def _own_equations(self, fit: Equations) -> tuple[Float[Tensor, "logs o o"], Float[Tensor, "logs o"]]:
        p = len(self.prior)
        return fit.H[:, p:, p:] + torch.diag(self.own_prior), fit.g[:, p:] + self.own_prior * self.own


def gain_of(new: Float[Tensor, " logs"], loss: Float[Tensor, " logs"]) -> float:
    """Share of the losses of logs that new ones take off, by a geometric mean.

    A log that nothing explains does not outvote the others.
    """
    return 1 - float((new.clamp_min(TINY) / loss.clamp_min(TINY)).log().mean().exp())
