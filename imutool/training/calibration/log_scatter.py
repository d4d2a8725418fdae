"""Unknowns of each training log, and the scatter of the logs beyond them.

A log has a rest bias of its own, and nuisances: rotation, clock and lever arm between its poses and the sensor, and the tilt of
its world. They are integrated out, which leaves a loss of each log in the parameters that all logs share.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from imutool.array_types import Float, Int
from imutool.bias.networks.threads import of_each
from imutool.units import Sensor

PIECE_S = 300.0  # of a log, in which its rest bias counts as constant
WANDER = {"gyro": 5e-4, "accel": 0.02}  # rad/s, m/s²: of the rest bias from piece to piece, a choice
REST_PRIOR = {"gyro": 0.1, "accel": 1.0}  # rad/s, m/s²: plausible turn-on biases
NUISANCE_STD = {  # how far they differ from log to log, at most
    "gyro": (0.01,) * 3 + (5e-3,),  # rotation (rad), clock (s)
    "accel": (0.1,) * 2 + (0.01,) * 3 + (5e-3,) + (0.02,) * 3,  # tilt (m/s² of gravity), rotation, clock, lever arm (m)
}
ROTATION = {"gyro": slice(3, 6), "accel": slice(5, 8)}  # of a log's unknowns, of which the rest bias comes first
CLOCK, LEVER = {"gyro": slice(6, 7), "accel": slice(8, 9)}, {"gyro": slice(7, 7), "accel": slice(9, 12)}
NARROWER = np.geomspace(1.0, 20.0, 13)  # shares of these widths that logs may show, as divisors
MIN_GAIN, SURELY = 0.03, 2.0  # share of the error, and standard errors over logs, by which more parameters have to be better
USUAL_SQUARES, MIN_VARIANCE = 4.0, 1e-10  # of differences between logs; of a combination of parameters, in units of the prior


def widest(sensor: Sensor, like: Tensor) -> Float[Tensor, " o"]:
    """One over the plausible variance of each of a log's own unknowns."""
    return torch.tensor([REST_PRIOR[sensor]] * 3 + list(NUISANCE_STD[sensor])).to(like) ** -2


def shown_by_logs(
    sensor: Sensor,
    H: Float[Tensor, "logs k k"],
    g: Float[Tensor, "logs k"],
    theta: Float[Tensor, " p"],
    own: Float[Tensor, "logs o"],
    prior: Float[Tensor, " p"],
) -> Float[Tensor, " o"]:
    """Prior of a log's own unknowns: as wide as the logs scatter beyond their deviations.

    The restricted likelihood of all logs decides between widths up to `NUISANCE_STD`: what logs share is the effects', and
    logs that agree keep one clock, one rotation and one lever arm. `H` and `g` are the losses of the logs about a point.
    """
    own_prior, p = widest(sensor, theta), len(prior)
    for _ in range(2):
        for part in (ROTATION[sensor], CLOCK[sensor], LEVER[sensor]):
            if part.start < part.stop:
                tried = own_prior.repeat(len(NARROWER), 1)
                tried[:, part] = torch.from_numpy(NARROWER[:, None] ** 2).to(tried) * widest(sensor, theta)[part]
                own_prior = tried[minus_log_likelihood(integrated(H, g, own, tried[:, None], p), theta, prior).argmin()]
    return own_prior


class Integrated(NamedTuple):
    """Losses of logs with each log's own unknowns integrated out."""

    S: Float[Tensor, "*batch logs p p"]
    v: Float[Tensor, "*batch logs p"]
    c: Float[Tensor, "*batch logs"]


def integrated(
    H: Float[Tensor, "*#batch k k"], g: Float[Tensor, "*#batch k"], own: Tensor, own_prior: Tensor, p: int
) -> Integrated:
    """Integrate out a log's own unknowns, which follow p parameters that the logs share."""
    A, b = H[..., p:, p:] + torch.diag_embed(own_prior), g[..., p:] + own_prior * own
    X, y = torch.linalg.solve(A, torch.cat([H[..., p:, :p].expand(*A.shape[:-1], p), b[..., None]], -1)).split((p, 1), -1)
    S, v = H[..., :p, :p] - H[..., :p, p:] @ X, g[..., :p] - (H[..., :p, p:] @ y)[..., 0]
    c = torch.logdet(A) - own_prior.log().sum(-1) + (own_prior * own.square()).sum(-1) - (b * y[..., 0]).sum(-1)
    return Integrated(S, v, c)


def minus_log_likelihood(logs: Integrated, theta: Float[Tensor, " p"], prior: Float[Tensor, " p"]) -> Float[Tensor, "*batch"]:
    """Twice the negative logarithm, but for a constant, with all unknowns integrated out."""
    S, v = torch.diag(prior) + logs.S.sum(-3), prior * theta + logs.v.sum(-2)
    L, failed = torch.linalg.cholesky_ex(S)  # one factor for both terms: a third of the time of logdet and solve
    whitened = torch.linalg.solve_triangular(L, v[..., None], upper=False)
    logdet = 2.0 * torch.diagonal(L, dim1=-2, dim2=-1).log().sum(-1)
    found = logs.c.sum(-1) + logdet - whitened.square().sum((-2, -1))
    return torch.where(failed == 0, found, math.inf)  # rounding alone makes S indefinite


def shared_by_scatter(
    logs: Integrated, theta: Float[Tensor, " p"], prior: Float[Tensor, " p"]
) -> tuple[Float[Tensor, " p"], Float[Tensor, "p p"]]:
    """Parameters that logs share, with their covariance, as the logs scatter (Birge's ratio).

    `logs` are losses about theta. Each log alone is compared with the others: posterior means of one prior differ by
    C + D - CD - DC, in units of the prior. The ratio of their squares to this is the size of a log's errors, next to
    `USUAL_SQUARES` squares of the stated size. A log on its own has the stated size. Errors of parameters that are missing
    count, too: what only a part of them shows stays near its prior.
    """
    P, S, v, size = torch.diag(prior), logs.S.sum(0), logs.v.sum(0), 1.0
    if len(logs.S) > 1 and len(theta):
        C, D = torch.linalg.inv(P + logs.S), torch.linalg.inv(P + S - logs.S)
        step = C @ (prior * theta + logs.v)[..., None] - D @ (prior * theta + v - logs.v)[..., None]
        root = prior.sqrt()
        C, D = (root[:, None] * each * root for each in (C, D))
        variance, V = torch.linalg.eigh(C + D - C @ D - D @ C)
        square = (V.mT @ (root[:, None] * step))[..., 0].square() / variance
        shown, share = variance > MIN_VARIANCE, 1.0 - 1.0 / len(logs.S)
        size = (USUAL_SQUARES + share * float(square[shown].sum())) / (USUAL_SQUARES - 2.0 + share * int(shown.sum()))
    covariance = torch.linalg.inv(P + S / size) if len(theta) else S
    return theta - covariance @ (prior * theta + v / size), covariance


class LogPieces(NamedTuple):
    """Piece of each sample, with a rest bias of its own, and the log of each piece."""

    of_sample: Int[Tensor, " n"]
    log: Int[Tensor, " pieces"]

    @classmethod
    def of(cls, log: Int[Tensor, " n"], t: Float[Tensor, " n"], logs: int) -> LogPieces:
        """Pieces of logs, from the log and the time of each sample."""
        began, ended = (torch.stack([edge(t[log == i]) for i in range(logs)]) for edge in (torch.amin, torch.amax))
        count = ((ended - began) / PIECE_S).ceil().clamp_min(1.0).long()
        share = (t - began[log]) / (ended - began).clamp_min(MIN_VARIANCE)[log]
        before = torch.cumsum(count, 0) - count
        piece = before[log] + (share * count[log]).long().clamp_max(count[log] - 1)
        return cls(piece, torch.repeat_interleave(torch.arange(logs).to(log), count))

    def merged(
        self, H: Float[Tensor, "pieces k k"], g: Float[Tensor, "pieces k"], c: Float[Tensor, " pieces"], sensor: Sensor, p: int
    ) -> tuple[Float[Tensor, "logs k k"], Float[Tensor, "logs k"], Float[Tensor, " logs"]]:
        """Losses of the logs, with what the rest bias of a piece differs from that of its log integrated out.

        The rest bias follows p parameters. That of a log in one piece is the log's.
        """
        wandering = (torch.bincount(self.log)[self.log] > 1).to(H)
        rest, X = slice(p, p + 3), torch.cat([H, g[..., None]], dim=2)[:, p : p + 3]
        y = torch.linalg.solve(H[:, rest, rest] + torch.eye(3).to(H) / WANDER[sensor] ** 2, X) * wandering[:, None, None]
        H, g, c = H - X[..., :-1].mT @ y[..., :-1], g - (X[..., :-1].mT @ y[..., -1:])[..., 0], c - (X * y)[..., -1].sum(1)
        H, g, c = (x.new_zeros(int(self.log[-1]) + 1, *x.shape[1:]).index_add(0, self.log, x) for x in (H, g, c))
        return H, g, c


def sums_by_log(
    J: Float[Tensor, "m 3 k"], e: Float[Tensor, "m 3"], weight: Float[Tensor, " m"], log: Int[Tensor, " m"], logs: int
) -> tuple[Float[Tensor, "logs k k"], Float[Tensor, "logs k"], Float[Tensor, " logs"]]:
    """Sums over each log's windows of the weighted J'J, J'e and e'e."""

    def of_log(i: int) -> tuple[Float[Tensor, "k k"], Float[Tensor, " k"], Float[Tensor, ""]]:
        w, J_i, e_i = (x[log == i] for x in (weight, J, e))
        H, g = torch.einsum("m,mij,mik->jk", w, J_i, J_i), torch.einsum("m,mij,mi->j", w, J_i, e_i)
        return H, g, (w * e_i.square().sum(1)).sum()

    H, g, c = (torch.stack(parts) for parts in zip(*of_each(of_log, range(logs)), strict=True))
    return H, g, c
