"""Normal equations of many logs that share parameters, kept by log so that one can be left out.

Unknowns are theta, shared by all logs, and a few of each log, which are eliminated log by log (Schur's complement). A
prediction of one log from all others is then one solve of a matrix as small as theta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

RIDGE = 1e-9  # of a diagonal, so that a log without information on its own unknowns can be solved


@dataclass(frozen=True)
class Equations:
    """Loss of each log to second order about a point: c + 2 g.d + d.H.d, unknowns theta then the log's own."""

    H: Float[Tensor, "logs k k"]
    g: Float[Tensor, "logs k"]
    c: Float[Tensor, " logs"]

    @classmethod
    def none(cls, like: Tensor, logs: int, unknowns: int) -> Equations:
        """Equations without any sample."""
        return cls(*(like.new_zeros(logs, *shape) for shape in ((unknowns, unknowns), (unknowns,), ())))

    def __add__(self, other: Equations) -> Equations:
        return Equations(self.H + other.H, self.g + other.g, self.c + other.c)

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
    fit: Equations
    judged: Equations  # what a solution is judged by

    def solve(self, columns: Sequence[int], without: int | None = None) -> Solution:
        """Gauss-Newton step for some parameters, the others at zero, and all logs but one."""
        columns, p = list(columns), len(self.prior)
        at = torch.zeros_like(self.theta)
        at[columns] = self.theta[columns]
        fit = self.fit.moved(at - self.theta)
        S, v = torch.diag(self.prior[columns]), self.prior[columns] * at[columns]
        own_H, own_g = self._own_equations(fit)
        for i in range(len(self.own)):
            if i != without:
                X = torch.linalg.solve(own_H[i], fit.H[i, p:][:, columns])
                S = S + fit.H[i][columns][:, columns] - fit.H[i][columns][:, p:] @ X
                v = v + fit.g[i, columns] - X.mT @ own_g[i]
        covariance = torch.linalg.inv(S) if columns else S
        at[columns] -= covariance @ v
        return Solution(at, covariance)

    def own_at(self, theta: Float[Tensor, " p"]) -> Float[Tensor, "logs o"]:
        """Unknowns of each log, for given parameters."""
        H, g = self._own_equations(self.fit.moved(theta - self.theta))
        own: Tensor = self.own - torch.linalg.solve(H, g)
        return own

    def predicted(self, columns: Sequence[int]) -> Float[Tensor, " logs"]:
        """Loss of each log with parameters from the other logs, its own unknowns solved for."""
        p, losses = len(self.prior), []
        for i in range(len(self.own)):
            judged = self.judged.moved(self.solve(columns, without=i).theta - self.theta)
            H, g = judged.H[i, p:, p:], judged.g[i, p:]
            least = RIDGE * H.diagonal().mean().clamp_min(RIDGE)
            own = -torch.linalg.solve(H + least * torch.eye(len(g)).to(H), g)
            losses.append(judged.c[i] + 2 * g @ own + own @ H @ own)
        return torch.stack(losses)

    def _own_equations(self, fit: Equations) -> tuple[Float[Tensor, "logs o o"], Float[Tensor, "logs o"]]:
        p = len(self.prior)
        return fit.H[:, p:, p:] + torch.diag(self.own_prior), fit.g[:, p:] + self.own_prior * self.own
