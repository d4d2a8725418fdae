"""Significance of an effect: p-values, robust covariance, posterior of its onset.

A fit's information holds where its white residuals are white. Against poses they seldom are: the poses' errors come with the
motion and last. The sum of J^T r over a block of some seconds scatters by the real errors, and a covariance made of those
sums ("sandwich": Liang and Zeger, Biometrika 1986) is right whatever the residuals are within a block. Few blocks
underestimate it, for the fit went through each; the leverage is taken off (CR2: Bell and McCaffrey, Survey Methodology 2002).
A gain in squares is divided by the mean ratio of the two covariances (the design effect: Rao and Scott, JASA 1981) and becomes
an F.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaincc, gammainccinv, gammaln
from scipy.stats import f as fisher

from imutool.array_types import Bool, Float64
from imutool.diagnosis.estimation.gauss_newton import Fit, fit
from imutool.diagnosis.estimation.jacobians import Chosen, parameters_of, priors, sets_in, with_value
from imutool.diagnosis.estimation.noise_estimate import axis_squares, white_rows
from imutool.diagnosis.estimation.trial.walking_bias import squares_of_walk
from imutool.units import AXES

TAIL = 300.0  # half the gain, above which the tail itself underflows
FIXED_STD = 1e-6  # deviation of a parameter that is taken as it is
SCALES = {"gyro": "gyro_scale", "accel": "accel_scale"}  # by signal: its columns are x, y, z as the parameters are
Matrix = Float64[np.ndarray, "p p"]


def log_p_value(gain: float, parameters: int) -> float:
    """Log p-value of a gain in squares under H0, by chi-square; 0 without parameters."""
    if parameters == 0:  # all of them implausible: what is left of the effect does nothing
        return 0.0
    half, k = 0.5 * max(gain, 0.0), 0.5 * parameters
    return float(np.log(gammaincc(k, half))) if half < TAIL else float((k - 1.0) * np.log(half) - half - gammaln(k))


def gain_for(log_p: float, parameters: int) -> float:
    """Gain in squares with a given p-value: the inverse of `log_p_value`."""
    return float(2.0 * gammainccinv(0.5 * parameters, np.exp(max(log_p, -TAIL))))


def unnamed_count(found: Fit) -> int:
    """Number of effects that are not of the catalogue."""
    return sum(effect.kind != "catalogue" for effect, _ in found.chosen)


def bic(found: Fit) -> float:
    """Bayesian information criterion (BIC): squares left and the cost of the parameters."""
    return found.objective + parameter_cost(found, found.chosen)


def leaves_as_little(found: Fit, key: str, minimum: float) -> bool:
    """Whether a fit with an effect is as good as one whose Akaike criterion is `minimum`.

    A parameter costs two squares. Where the log shows few of many (one of the nine of a g-sensitivity), the others cost no more
    than they explain, and the effect may be worse by the cost of one.
    """
    (theta,) = (theta for effect, theta in found.chosen if effect.key == key)
    if found.objective + 2.0 * len(theta) < minimum + found.logs[0].pair.settings.search.clearly_better:
        return True
    if found.objective > minimum:
        return False
    cost = np.minimum(2.0, (theta / found.stds()[key]) ** 2).sum()
    return bool(found.objective + cost < minimum + 2.0)


def parameter_cost(like: Fit, chosen: Chosen) -> float:
    """Squares that parameters cost by the BIC on a fit's logs; more outside the catalogue."""
    search, unnamed = like.logs[0].pair.settings.search, sum(effect.kind != "catalogue" for effect, _ in chosen)
    return len(parameters_of(chosen)) * float(np.log(like.numbers)) + search.unnamed_penalty * unnamed


def gain_of(whole: Fit, k: int, iterations: int | None = None) -> tuple[float, float]:
    """Squares that leaving an effect out costs, at most, and those that no walk of a bias saves.

    What acts several times (two drifts, three steps) may be a walk as a whole, and each part be needed next to the rest. So
    all of it together, with as many parameters, has to be as unlikely by chance.
    """
    gain, saved = _gain_without(whole, [k], iterations)
    same = [j for j, (effect, _) in enumerate(whole.chosen) if effect.name == whole.chosen[k][0].name and effect.of_time]
    if len(same) > 1 and iterations is None:
        numbers = sum(len(whole.chosen[j][1]) for j in same)
        together = log_p_value(_gain_without(whole, same, iterations)[1], numbers)
        saved = saved if together < -TAIL else min(saved, gain_for(together, len(whole.chosen[k][1])))
    return gain, saved


def _gain_without(whole: Fit, left_out: Sequence[int], iterations: int | None) -> tuple[float, float]:
    """Squares that leaving some effects out costs, at most, and those that no walk of a bias saves.

    Walks of any speed count for what depends on time alone, and for all where what is left walks.
    """
    search = whole.logs[0].pair.settings.search
    chosen = tuple(entry for j, entry in enumerate(whole.chosen) if j not in left_out)
    without = fit(whole.logs, chosen, part=whole.part, iterations=iterations, near=whole)
    jumps = any(effect.jumps for effect, _ in without.chosen)  # what moves a signal a little wins single samples at an edge
    gain = (without.objective - whole.objective) / (whole.settings.between_samples**2 if jumps else 1.0)
    if iterations is not None:
        return gain, gain
    walks = squares_of_walk(whole, whole, of_any_speed=True) > search.clearly_better
    of_any_speed = whole.chosen[left_out[0]][0].of_time or walks
    explained, remaining = (squares_of_walk(fitted, whole, of_any_speed=of_any_speed) for fitted in (without, whole))
    return gain, gain - max(0.0, explained - remaining)


# ── robust covariance ──


@dataclass(frozen=True, eq=False)
class Scatter:
    """Robust standard deviations by effect, no less than by information."""

    std: dict[str, Float64[np.ndarray, " _"]]
    inflation: dict[str, float]  # ratio of the blocks' variance to the information's, at least 1
    blocks: dict[str, float]  # independent ones less one, on which that rests

    def log_p_value(self, key: str, gain: float, parameters: int) -> float:
        """Logarithm of the p-value of a gain in squares, by F."""
        f = max(gain, 0.0) / (parameters * self.inflation[key])
        return float(fisher.logsf(f, parameters, parameters * self.blocks[key]))


def scatter(found: Fit) -> Scatter:
    """Robust covariance of a fit's free parameters, from blocks of the rows that were fitted."""
    settings = found.logs[0].pair.settings.significance
    blocks = [block for k in range(len(found.logs)) for block in _blocks(found, k)]
    _, prior_std = priors(found.chosen, found.settings)
    prior = np.diag(1.0 / np.where(_begins(found), FIXED_STD, prior_std) ** 2)
    lower = np.linalg.cholesky(sum((H for H, _ in blocks), start=prior))
    middle = _seen_from(lower, prior)
    shares = []
    for H, score in blocks:
        share = _seen_from(lower, H)
        leverage, axes = np.linalg.eigh(share)
        turned = axes.T @ solve_triangular(lower, score, lower=True)
        even = axes @ (turned / np.sqrt(1.0 - np.clip(leverage, 0.0, settings.max_leverage)))
        middle += np.outer(even, even)
        shares.append(share)
    outer = solve_triangular(lower, np.eye(len(lower)), lower=True)  # covariance by information: outer.T @ outer
    by_blocks, by_information = outer.T @ middle @ outer, outer.T @ outer
    out = _by_effect(found, by_blocks, by_information, [outer.T @ share @ outer for share in shares], settings.prior_blocks)
    for key, diluted in _dilution(found, by_information).items():
        out.std[key] = np.hypot(out.std[key], diluted)
    return out


def _dilution(found: Fit, by_information: Matrix) -> dict[str, Float64[np.ndarray, " _"]]:
    """Regression dilution of scale factors against poses, by effect: at most the squares left over the information.

    The error e of the expectation f + e is in the residual as well: E[(f + e) (-e)] = -E[e²], alike in every block of time
    (Fuller, Measurement Error Models, 1987, eq. 1.1.7).
    """
    if all(log.pair.exact for log in found.logs):
        return {}
    out, squares = {}, axis_squares(found)
    for effect, _ in found.chosen:
        for signal, columns in found.logs[0].pair.signals.items():
            if effect.name == SCALES.get(signal):
                column = [columns.start + AXES.index(parameter.name) for parameter in effect.parameters if not parameter.begins]
                out[effect.key] = np.where(sets_in(effect), 0.0, np.diag(by_information)[found.place(effect.key)])
                out[effect.key][~sets_in(effect)] *= squares[column]
    return out


def _begins(found: Fit) -> Bool[np.ndarray, " p"]:
    """Parameters that are onsets: nothing is smooth in them, so they are taken as they are."""
    return np.concatenate([np.zeros(0, bool), *(sets_in(effect) for effect, _ in found.chosen)])


def _by_effect(found: Fit, by_blocks: Matrix, by_information: Matrix, shares: Sequence[Matrix], prior_blocks: float) -> Scatter:
    std, inflation, count = {}, {}, {}
    usual, stated = max(1.0, found.reduced_chi_square), found.stds()
    for key in found.keys:
        part = found.place(key)
        own, robust = by_information[part, part], by_blocks[part, part]
        each = np.array([np.diag(share)[part] for share in shares]) / np.diag(own)
        ratio, blocks = _moderated(np.diag(robust) / np.diag(own), _effective(each), usual, prior_blocks)
        std[key] = stated[key] * np.sqrt(np.maximum(1.0, np.where(_begins(found)[part], 1.0, ratio)))
        mean = np.asarray(np.trace(np.linalg.solve(own, robust)) / len(own))
        taken = np.array([np.trace(np.linalg.solve(own, share[part, part])) for share in shares])
        ratio, blocks = _moderated(mean, _effective(taken), usual, prior_blocks)
        inflation[key], count[key] = max(1.0, float(ratio)), float(blocks)
    return Scatter(std, inflation, count)


def _effective(shares: Float64[np.ndarray, "b ..."]) -> Float64[np.ndarray, "..."]:
    """Effective number of blocks, where a few may hold most of the information."""
    return np.asarray(shares.sum(axis=0) ** 2 / np.maximum((shares**2).sum(axis=0), 1e-300))


def _moderated(
    ratio: Float64[np.ndarray, "..."], blocks: Float64[np.ndarray, "..."], usual: float, prior_blocks: float
) -> tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]:
    """A variance ratio shrunk to that of all rows, and its degrees of freedom (Smyth 2004)."""
    own = np.maximum(blocks - 1.0, 0.0)
    return np.asarray((own * ratio + prior_blocks * usual) / (own + prior_blocks)), np.asarray(own + prior_blocks)


def _seen_from(lower: Matrix, H: Matrix) -> Matrix:
    """H in coordinates in which the whole information is the identity."""
    half = solve_triangular(lower, H, lower=True)
    out = np.asarray(solve_triangular(lower, half.T, lower=True))
    return np.asarray(0.5 * (out + out.T))


def _blocks(found: Fit, k: int) -> list[tuple[Matrix, Float64[np.ndarray, " p"]]]:
    """Information and score J^T r of each block of a log, a constant taken out of the whole log."""
    log, begins, residual = found.logs[k], _begins(found), white_rows(found)[k]
    rows, settings = log.rows(found.part), log.pair.settings
    J = np.zeros((log.pair.columns, len(begins), int(rows.sum())))
    for axis in range(log.pair.columns):
        where, J_axis = found.jacobians.on_axis(k, axis, rows)
        constant = log.constants[rows, axis]
        J[axis, where] = J_axis - np.outer(J_axis @ constant, constant) / max(float(constant @ constant), 1e-300)
    J[:, begins] = 0.0
    t_s = log.pair.stamp_s[:: log.whiten.every][rows]
    block_s = min(settings.search.robust_block_s, np.ptp(t_s) / settings.significance.min_blocks)
    block = np.floor((t_s - t_s[0]) / block_s).astype(int)
    out = []
    for number in np.unique(block):
        inside = block == number
        flat = J[:, :, inside].transpose(1, 0, 2).reshape(len(begins), -1)
        out.append((flat @ flat.T, flat @ residual[inside].T.reshape(-1)))
    return out


# ── onsets ──


def estimate_onsets(found: Fit) -> tuple[Fit, dict[tuple[str, int], float]]:
    """Fit with each onset at its posterior mean, and standard deviations (s).

    Nothing is smooth in an onset, so the times near it are searched. A time is as likely as exp(-squares / 2), the squares
    divided by the reduced chi-square where they are more than noise.
    """
    logs, part, inflation = found.logs, found.part, max(1.0, found.reduced_chi_square)
    settings, period_s = logs[0].pair.settings.significance, max(log.pair.period_s for log in logs)
    spread: dict[tuple[str, int], float] = {}
    for k, (effect, theta) in enumerate(found.chosen):
        for j, parameter in enumerate(effect.parameters):
            if not parameter.begins or not np.isfinite(theta[j]):
                continue
            step_s = max(period_s, 2.0 * settings.onset_near_s / (settings.onset_times - 1))
            t_s = theta[j] + step_s * np.arange(-(settings.onset_times // 2), settings.onset_times // 2 + 1)
            moved = (with_value(found.chosen, k, j, float(t)) for t in t_s)  # all else as it is but for the constants
            squares = np.array([fit(logs, chosen, part=part, iterations=0, near=found).objective for chosen in moved])
            likely = np.exp(-(squares - squares.min()) / (2.0 * inflation))
            likely /= likely.sum()
            mean = float(likely @ t_s)
            spread[effect.key, j] = float(np.sqrt(likely @ (t_s - mean) ** 2 + step_s**2 / 12.0))
            found = fit(logs, with_value(found.chosen, k, j, mean), part=part, iterations=0, near=found)
    return found, spread


def with_onsets_of_all_rows(fitted: Fit) -> Fit:
    """Fit with onsets where all rows show them: fitted rows do not show one between them."""
    if not any(sets_in(effect).any() for effect, _ in fitted.chosen):
        return fitted
    whole = fit(fitted.logs, fitted.chosen, part="all", near=fitted)
    return fit(fitted.logs, with_onsets_of(fitted.chosen, whole.chosen), fitted.part, near=fitted, hold_onsets=True)


def with_onsets_of(fitted: Chosen, whole: Chosen) -> Chosen:
    """Fitted effects with the onsets of all rows."""
    out = []
    for (effect, theta), (_, onsets) in zip(fitted, whole, strict=True):
        out.append((effect, np.where(sets_in(effect), onsets, theta)))
    return tuple(out)
