"""Settings of a diagnosis: tuned numbers with unit, meaning and origin.

`imutool diagnose --set search.false_discovery_rate=1e-3` sets one; `--config FILE.toml` several. The chosen values come from
planted effects of the tests, from the blind cases, and from the 23 logs of EuRoC, TUM-VI and Fetch.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from imutool.config import Settings

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class SearchSettings(Settings, frozen=True):
    """Search for effects.

    Squares are of white residuals: their number is chi-square under H0.
    """

    false_discovery_rate: Share = 5e-3  # of all that was tried; none in 20 logs of noise alone
    held_out_p_value: Share = 0.05  # a finding has to improve held-out blocks at this level
    held_out_block_s: Positive = 2.0  # blocks of that test: longer than the noise of poses is correlated
    robust_block_s: Positive = 5.0  # blocks of the robust covariance: some of the slowest errors of poses
    fitted_each_round: Count = 3  # candidates of the best score that are fitted in full; the best is among them
    most_effects: Count = 8  # more never came out of a log
    rounds: Count = 20  # times that an effect may come in
    suspicious_effects: Count = 3  # from which on one unnamed effect may be the better answer
    clearly_better: Positive = 10.0  # squares by which an answer has to be better, as in BIC (Kass and Raftery 1995)
    unnamed_penalty: float = 15.0  # squares that an effect outside the catalogue costs
    explained_chi_square: Positive = 1.03  # reduced: below, everything is explained
    hopeless_chi_square: Positive = 2.0  # reduced: above, with many effects, more of the same is no answer
    most_unnamed: Annotated[int, msgspec.Meta(ge=0)] = 2  # effects outside the catalogue
    unnamed_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.03  # of the misfit that each of those has to remove
    beyond_band: Positive = 3.0  # over the poses' band: there their smoothing looks like a mount that rings
    beyond_band_low_pass: Positive = 6.0  # for a low pass: smoothing delays nothing
    slowest_hz: Positive = 0.5  # of a filter or a mount; a slower one is motion that the poses have lost
    white_chi_square: Positive = 1.15  # reduced: up to it the noise beside a simulation is taken as measured
    exchanged_effects: Count = 3  # up to which each is compared with replacements
    give_up_factor: Positive = 4.0  # over the needed squares: a fit as far off after a few steps gets no nearer
    rivals: Annotated[int, msgspec.Meta(ge=0)] = 3  # effects that are tried in another's place for `similar`
    rival_share: Share = 0.5  # of the gain that a score has to promise for a fit
    implausible_factor: Positive = 4.0  # over the plausible size: a larger linear parameter is a fit to noise
    model_error: Positive = 1e-5  # of the largest effect's squares (0.3 % of its size) may be its model's error
    model_error_denoised: Positive = 1e-3  # the same beside a simulation whose noise was filtered out (3 %)
    model_error_resonance: Positive = 1e-2  # the same beside a mount that rings, whose model is simplified
    observable_squares: Positive = 36.0  # six standard deviations, for some thousand hypotheses


class BandSettings(Settings, frozen=True):
    """Band up to which poses know the motion.

    Chosen on EuRoC and TUM-VI, where two references disagree above it.
    """

    segment_s: Positive = 4.0  # of the spectra
    diluted_share: Share = 0.04  # of the expectation that is its own error, from which on it is not known
    sigma: Positive = 3.0  # standard deviations of the gain beyond that
    least_hz: Positive = 1.25  # below, hardly any motion would be left
    noisy_axis: Positive = 3.0  # over the middle axis of a sensor: a noisier one holds what has no name


class ReferenceSettings(Settings, frozen=True):
    """Coverage and errors of the reference.

    Chosen on poses with planted gaps and on the real logs.
    """

    least_band_hz: Positive = 1.0  # of poses, at least: smoothing does not change a motion at rest
    band_share: Share = 0.45  # of the frequency at which smoothing halves a motion: there it takes one per cent
    covered_share: Share = 0.9  # of a recording: less coverage gives a remark
    least_known_s: Positive = 2.0  # of unclipped samples of an axis, both to fit and to test it
    block_s: Positive = 0.25  # of the search for intervals with a wrong reference
    p_value: Share = 1e-7  # below which a block is no noise
    most_of_time: Share = 0.15  # that such intervals may take; more is another misfit
    most_intervals: Count = 8
    longest_s: Positive = 4.0  # of one interval
    quiet_chi_square: Positive = 1.1  # reduced: up to it all the rest is noise
    join_s: Positive = 0.6  # intervals closer than this are joined


class LocalizationSettings(Settings, frozen=True):
    """Axes, intervals and regimes of a misfit: chosen on planted effects."""

    window_s: Positive = 1.0  # of which an interval is made
    clear_squares: Positive = 12.0  # of misfit over noise by which a window, or an axis, stands out
    axis_share: Share = 0.02  # of the strongest axis' squares, below which an axis is not named
    join_s: Positive = 1.5  # intervals closer than this are joined
    least_youden: Share = 0.35  # Youden's index from which a regime is named
    p_value: Share = 1e-3  # of a regime, and of a finding that no single window shows
    mean_samples: Count = 9  # of the running mean of an unexplained residual


class HeldOutSettings(Settings, frozen=True):
    """Whiteness of held-out residuals: chosen on logs of noise alone."""

    white_ratio: Positive = 1.15  # of residual and noise, up to which the residual is white
    white_p_value: Share = 0.01  # below which a residual beside poses is not white
    block_s: Positive = 3.0  # of held-out time for that test
    few_samples_p_value: Share = 1e-3  # of a larger ratio, where few values are left


class DiagnoseSettings(Settings, frozen=True):
    """All settings of `imutool diagnose`."""

    search: SearchSettings = SearchSettings()
    band: BandSettings = BandSettings()
    reference: ReferenceSettings = ReferenceSettings()
    localization: LocalizationSettings = LocalizationSettings()
    held_out: HeldOutSettings = HeldOutSettings()
