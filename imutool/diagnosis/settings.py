"""Settings of a diagnosis: tuned numbers with unit, meaning and origin.

`imutool diagnose --set search.false_discovery_rate=1e-3` sets one; `--config FILE.toml` several. The chosen values come from
planted effects of the tests, from the blind cases, and from the 23 logs of EuRoC, TUM-VI and Fetch.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from imutool.config import Settings
from imutool.inertial.wiener import WienerSettings

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class FitSettings(Settings, frozen=True):
    """Gauss-Newton fit: by experience on planted effects and blind cases.

    Squares are of white residuals, steps those of the fit.
    """

    prior_std: Positive = 3.0  # of a parameter, over its plausible size: what no motion shows stays at its null value
    log_prior_std: Positive = 1.5  # of the logarithm of a positive parameter, about the start of the fit
    iterations: Count = 8  # Gauss-Newton steps at most
    backtracks: Count = 4  # lengths tried of one step, each half of the one before
    converged_squares: Positive = 1e-2  # a smaller gain ends the fit
    patience_steps: Count = 3  # after which a fit that is not below its limit is given up
    jacobian_error: Positive = 0.05  # of a step's length in white samples, up to which its Jacobian is kept
    polish_rounds: Count = 8  # halvings of the step of a parameter that jumps
    between_samples: Positive = 2.0  # inflation of the deviation at an edge, which lies between two samples (20 cases: 1.7)


class SplitSettings(Settings, frozen=True):
    """Fitted and held-out blocks of a log, and its constant bias: by experience on blind cases."""

    block_s: Positive = 6.0  # of one block
    block_samples: Count = 40  # of one block at least: the first ones only begin the whitening filter
    held_out_each: Annotated[int, msgspec.Meta(ge=2)] = 3  # of so many blocks the last is never fitted
    margin_s: Positive = 0.3  # around a border between blocks and around a gap: part of neither
    gap_periods: Positive = 3.0  # a longer step between samples is a gap
    gyro_bias_std: Positive = 0.5  # rad/s, prior of the constant bias
    accel_bias_std: Positive = 5.0  # m/s², likewise


class NoiseSettings(Settings, frozen=True):
    """Whitening filters: by experience on blind cases; the order also on real logs."""

    order: Count = 6  # of the autoregression: the noise of a sensor; of poses, on rows that just hold their band
    motion_hz: Positive = 15.0  # below, a body moves, so that against a simulation the noise is measured above
    reference_hz: Positive = 60.0  # up to which it is measured
    band_filter_s: Positive = 0.6  # length of the low-pass of a band
    band_oversampling: Positive = 2.5  # samples a period of the band's edge
    segment_samples: Count = 512  # of a spectrum
    min_segment_samples: Count = 64  # of a short log
    min_segments: Count = 8  # the median of one or two says too little
    line_bins: Count = 9  # of the running median that takes lines out of a spectrum
    rounds: Count = 2  # alternations of noise and model against poses
    walk_mean_s: Positive = 0.5  # of a mean of the residual in which the bias' walk is looked for
    walk_means: Count = 300  # of a log at most
    walk_cycles: Positive = 0.1  # of a log in the slowest walk that is looked for: at its corner both noises have one density
    walk_hz: Positive = 0.5  # corner of the fastest one: the accelerometer of EuRoC's sensor.yaml has 0.25 Hz
    walk_corners: Count = 14  # tried between these
    walk_fastest_hz: Positive = 8.0  # if not all depends on time alone; faster is whiter than half-second means show
    walk_fast_corners: Count = 4  # tried above the former

    def segment_of(self, samples: int) -> int:
        """Samples of a segment of a signal's spectrum."""
        return min(self.segment_samples, max(samples // self.min_segments, self.min_segment_samples), samples)


class SignificanceSettings(Settings, frozen=True):
    """Robust covariance and onsets: by experience on poses with coloured errors."""

    min_blocks: Count = 6  # of the robust covariance
    prior_blocks: Positive = 6.0  # weight, in blocks, of the variance ratio of all rows together
    max_leverage: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.95  # of one block on a parameter, above which it says nothing
    onset_near_s: Positive = 0.4  # searched on both sides of an onset: as far as the filter of a band smears it
    onset_times: Annotated[int, msgspec.Meta(ge=3)] = 41  # times tried there


class TimestampSettings(Settings, frozen=True):
    """Missing samples, jitter, digits, limits: by experience on blind cases and real logs."""

    median_samples: Count = 15  # of the running median that counts missing samples
    period_samples: Count = 500  # from which the period is found first
    period_span: Share = 0.02  # relative to the median step: periods tried on both sides
    periods: Count = 201  # tried there
    clear_share: Share = 0.25  # of a period: a stamp so near to its own place, or a step to whole periods, is taken at its word
    min_agreement: Share = 0.3  # of the stamps with one period, below which jitter is large
    lag_samples: Count = 10  # of a difference that is many periods long, under large jitter
    min_missing: Count = 3  # samples, from which a loss is reported
    min_at_limit: Count = 4  # samples at the largest reading, from which it may be a limit
    piled_factor: Positive = 2.0  # over the count of the next reading: digits come again everywhere
    clipped_share: Share = 0.995  # of the limit, from which a sample is clipped
    limit_error: Positive = 1e-3  # relative deviation that a limit is stated with
    min_jitter_s: Positive = 2e-5  # standard deviation of the stamps
    jitter_s: Positive = 0.25  # on both sides of a stamp: its jitter is its distance from their median
    min_digits: Positive = 0.3  # of the noise: finer steps leave no trace in it
    grid_share: Share = 0.98  # of the samples that have to lie on a grid
    line_samples: Count = 15  # of the local polynomial that the samples follow
    line_degree: Count = 3  # of that polynomial
    even_sigma: Positive = 5.0  # deviations by which samples must be nearer to even than to their stamps


class AlignmentSettings(WienerSettings, frozen=True):
    """Alignment of two IMUs in time: by experience on blind cases and logs without an epoch."""

    max_samples: Count = 400_000  # of all recordings that are compared, each from its start: one takes 6 kB of memory
    min_s: Positive = 8.0  # of shared time: below, nothing can be fitted and tested
    hole_s: Positive = 0.1  # without samples of a simulation, from which on it is not interpolated
    align_hz: Positive = 100.0  # of the clock on which angular rates are correlated
    farthest_s: Positive = 5.0  # by which clocks of one epoch may differ
    offset_s: Positive = 0.3  # up to which the search finds a clock offset from 0; from 0.5 s on it ended in other effects
    min_correlation: Share = 0.6  # of the angular rates, below which two motions differ
    alike_sigma: tuple[float, float] = (3.0, 6.0)  # over chance, with a shared epoch and at any lag; 210 unrelated pairs: 5.3
    poses_share: Share = 0.9  # of the simulation that its poses must cover to stand for it
    poses_hz: Positive = 40.0  # slower poses cannot be differentiated twice
    coarse_bands: Count = 5  # of all frequencies, in any of which a misfit between poses and samples may stand out
    coarse_factor: Positive = 1.3  # over the quietest of them, up to which poses stand for the samples
    line_chance: Share = 1e-6  # of white noise to show a line above the first, below which poses do not stand for the samples


class SignalSettings(Settings, frozen=True):
    """Any other signal of a log: by experience on planted effects."""

    min_s: Positive = 15.0  # two blocks to fit and one to test
    min_samples: Count = 100  # of a spectrum
    oversampling: Positive = 4.0  # so that a straight line between fine samples is the signal
    align_hz: Positive = 100.0  # of the clock on which recording and simulation are correlated
    min_correlation: Share = 0.3  # below which nothing says that the two are one motion
    alike_sigma: tuple[float, float] = (3.0, 4.0)  # over chance: with a shared epoch, and at any lag
    max_demanded: Share = 0.9  # of such a correlation, for slow signals
    noise_band: Share = 0.4  # of the rate: from here to `noise_band_end` a simulation's spectrum is its noise
    noise_band_end: Share = 0.45  # of the rate
    better_noise: Share = 0.95  # of the first noise level, below which effects are searched once more
    power_share: Share = 0.999  # of the signal's power that lies below its edge
    edge_factor: Positive = 1.3  # over the edge, from where noise is measured
    min_edge: Share = 0.05  # of the sample rate
    max_edge: Share = 0.3  # of the sample rate
    max_top: Share = 0.75  # of the highest frequency that is compared: above the edge some spectrum has to be left
    same_grid: Share = 0.01  # relative difference of two LSBs that are one
    motion_band_hz: Positive = 15.0  # of the motion of joints: above, accelerations are noise
    motion_band_share: Share = 0.15  # of the sample rate, for slower logs
    motion_beyond_band: Share = 0.3  # of the squared velocities above it, from which on a motion is faster than its band
    copy_correlation: Share = 0.98  # of another channel, above which it is a copy of the signal


class SearchSettings(Settings, frozen=True):
    """Search for effects.

    Squares are of white residuals: their number is chi-square under H0.
    """

    false_discovery_rate: Share = 5e-3  # of all that was tried; none in 20 logs of noise alone
    held_out_p_value: Share = 0.05  # a finding has to improve held-out blocks at this level
    held_out_block_s: Positive = 2.0  # blocks of that test: longer than the noise of poses is correlated
    robust_block_s: Positive = 5.0  # blocks of the robust covariance: some of the slowest errors of poses
    fitted_each_round: Count = 3  # candidates of the best score that are fitted in full; the best is among them
    max_effects: Count = 8  # more never came out of an IMU's log
    effects_each_column: Count = 2  # of the efforts of an arm of many joints, if that is more
    negligible_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0  # of the largest squares in a column: less ends a search
    rounds: Count = 20  # times that an effect may come in
    suspicious_effects: Count = 3  # from which on one unnamed effect may be the better answer
    clearly_better: Positive = 10.0  # squares by which an answer has to be better, as in BIC (Kass and Raftery 1995)
    unnamed_penalty: float = 15.0  # squares that an effect outside the catalogue costs
    explained_chi_square: Positive = 1.03  # reduced: below, everything is explained
    hopeless_chi_square: Positive = 2.0  # reduced: above, with many effects of which the last did little, more is no answer
    hopeless_share: Share = 0.05  # of the misfit that was left: less is little
    max_unnamed: Annotated[int, msgspec.Meta(ge=0)] = 2  # effects outside the catalogue
    unnamed_share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.03  # of the misfit: each removes more, a wander too
    beyond_band: Positive = 3.0  # over the poses' band: there their smoothing looks like a mount that rings
    beyond_band_low_pass: Positive = 6.0  # for a low pass: smoothing delays nothing
    slowest_hz: Positive = 0.5  # of a filter or a mount; a slower one is motion that the poses have lost
    ringing_segment_s: Positive = 8.0  # of the spectra in which a mount beyond the band has to ring
    ringing_power: Positive = 4.0  # of the readings that it may have there; right ones had at most 1.3
    beyond_sim_noise: Positive = 4.5  # of a simulation's sample, the largest of 25 000: less width takes what is left of it
    white_chi_square: Positive = 1.15  # reduced: up to it the noise against a simulation is taken as measured
    white_kurtosis: Positive = 6.0  # of an axis' white residuals, from which on few samples hold the squares (noise has 3)
    hysteresis_leaves: Share = 0.1  # of its squares, at most, in slow motion of its sensor: it fits a part of many a misfit
    larger_misfit: Positive = 10.0  # times the squares of an effect, in slow motion against a simulation: it is a part of that
    contradicted_share: Share = 0.1  # of what an effect removes of one sensor, at most, what it adds to another
    exchanged_effects: Count = 3  # up to which each is compared with replacements
    give_up_factor: Positive = 4.0  # over the needed squares: a fit as far off after a few steps gets no nearer
    rivals: Annotated[int, msgspec.Meta(ge=0)] = 3  # effects that are tried in another's place for `similar`
    rival_share: Share = 0.5  # of the gain that a score has to promise for a fit
    common_arm_share: Share = 0.7  # of a size effect's squares that a lever arm alone has to remove to replace it
    max_taken: Share = 0.7  # of an axis' motion by poses, that a term, a curve or a limit may take
    implausible_factor: Positive = 4.0  # over the plausible size: a larger linear parameter is a fit to noise
    model_error_reference: Positive = 1e-9  # of a sensor's motion against a simulation (0.003 % of its size): splines, rounding
    model_error: Positive = 1e-5  # of the largest effect's squares (0.3 % of its size) may be its model's error
    model_error_denoised: Positive = 1e-3  # the same against a simulation whose noise was filtered out (3 %)
    model_error_resonance: Positive = 1e-2  # the same together with a mount that rings, whose model is simplified
    model_error_low_pass: Positive = 1e-2  # of another filter together with a low-pass, whose order and form may be others
    model_error_clock: Positive = 0.1  # of a filter next to a clock of poses, whose drift is no straight line (a third of it)
    observable_squares: Positive = 36.0  # six standard deviations, for some thousand hypotheses


class BandSettings(Settings, frozen=True):
    """Band up to which poses know the motion.

    Chosen on EuRoC and TUM-VI, where two references disagree above it.
    """

    segment_s: Positive = 4.0  # of the spectra
    diluted_share: Share = 0.04  # of the expectation that is its own error, from which on it is not known
    sigma: Positive = 3.0  # standard deviations of the gain beyond that
    min_hz: Positive = 1.25  # below, hardly any motion would be left
    noisy_axis: Positive = 3.0  # over the middle axis of a sensor: a noisier one holds what has no name


class ReferenceSettings(Settings, frozen=True):
    """Coverage and errors of the reference.

    Chosen on poses with planted gaps and on the real logs.
    """

    min_band_hz: Positive = 1.0  # of poses, at least: smoothing does not change a motion at rest
    band_share: Share = 0.45  # of the frequency at which smoothing halves a motion: there it takes one per cent
    covered_share: Share = 0.9  # of a recording: less coverage gives a remark
    min_known_s: Positive = 2.0  # of unclipped samples of an axis, both to fit and to test it
    block_s: Positive = 0.25  # of the search for intervals with a wrong reference
    p_value: Share = 1e-7  # below which a block is no noise
    max_of_time: Share = 0.15  # that such intervals may take; more is another misfit
    max_intervals: Count = 8  # with a wrong reference that are named
    longest_s: Positive = 4.0  # of one interval
    both_share: Share = 0.9  # of the squares in such intervals, that both sensors have to show
    quiet_chi_square: Positive = 1.1  # reduced: up to it all the rest is noise
    join_s: Positive = 0.6  # intervals closer than this are joined
    turned_block_s: Positive = 5.0  # of a mean: slower than poses follow the gyro (EuRoC V1_01)
    min_turned_blocks: Count = 8  # of such means, to look for a rotation
    min_turned_rad: Positive = 5e-3  # of a rotation that is reported
    min_turned_share: Share = 0.6  # of the slow misfit that it has to remove
    turned_alike_p_value: Share = 1e-3  # below which gyro and gravity show two rotations


class LocalizationSettings(Settings, frozen=True):
    """Axes, intervals and regimes of a misfit: chosen on planted effects."""

    window_s: Positive = 1.0  # of which an interval is made
    clear_squares: Positive = 12.0  # of misfit over noise by which a window, or an axis, stands out
    axis_share: Share = 0.02  # of the strongest axis' squares, below which an axis is not named
    join_s: Positive = 1.5  # from the begin of one window to that of the next, up to which they are one interval
    min_youden: Share = 0.35  # Youden's index from which a regime is named
    p_value: Share = 1e-3  # of a regime, and of a finding that no single window shows
    mean_samples: Count = 9  # of the running mean of an unexplained residual
    window_p_value: Share = 1e-6  # below which a window of an axis of that residual is more than noise


class HeldOutSettings(Settings, frozen=True):
    """Whiteness of held-out residuals: chosen on logs of noise alone."""

    white_ratio: Positive = 1.15  # of residual and noise, up to which the residual is white
    white_p_value: Share = 0.01  # below which a residual against poses is not white
    max_white_ratio: Positive = 3.0  # of residual and noise, above which it is not, however few the blocks
    block_s: Positive = 3.0  # of held-out time for that test
    few_samples_p_value: Share = 1e-3  # of a larger ratio, where few values are left


class RingingSettings(Settings, frozen=True):
    """Ringing of a mount in the residual: by experience on made-up shocks and on null cases."""

    min_hz: Positive = 3.0  # of a mount
    segment_samples: Count = 512  # of the spectrum
    peak_factor: Positive = 8.0  # of the peak over the spectrum on both sides
    blocks: Annotated[int, msgspec.Meta(ge=4)] = 8  # of the jackknife
    min_damping: Positive = 0.005  # less is a line: a vibration
    max_damping: Share = 0.35  # more is no peak
    min_kurtosis: Positive = 6.0  # of the residual near the peak: between shocks hardly anything rings (noise has 3)


class DiagnoseSettings(Settings, frozen=True):
    """All settings of `imutool diagnose`."""

    search: SearchSettings = SearchSettings()
    fit: FitSettings = FitSettings()
    split: SplitSettings = SplitSettings()
    noise: NoiseSettings = NoiseSettings()
    significance: SignificanceSettings = SignificanceSettings()
    timestamps: TimestampSettings = TimestampSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    signal: SignalSettings = SignalSettings()
    band: BandSettings = BandSettings()
    reference: ReferenceSettings = ReferenceSettings()
    localization: LocalizationSettings = LocalizationSettings()
    held_out: HeldOutSettings = HeldOutSettings()
    ringing: RingingSettings = RingingSettings()
