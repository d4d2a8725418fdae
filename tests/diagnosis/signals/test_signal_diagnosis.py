"""Any number of a log against its simulation: each effect planted is found by name and size, none where none is."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from support.seeds import seeds

from imutool.diagnosis.estimation.noise_estimate import noise_std
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.aligned_signal import aligned
from imutool.diagnosis.signals.ideal_signal import SignalPair
from imutool.diagnosis.signals.noise import rich_residual, whitened
from imutool.diagnosis.signals.signal_diagnosis import SignalDiagnosis, diagnose_signal
from imutool.errors import DataError
from imutool.mcap_io.fields import Fields

START_NS = 1_700_000_000_000_000_000
RATE_HZ, SIM_HZ, DURATION_S, NOISE = 80.0, 100.0, 60.0, 0.02
OFFSET = 0.3
NAME = "/odom.v"
SURE = 4.0  # standard deviations within which the planted value lies: 1 in 16 000 outside, in some thirty checks
CENTER = 5.0  # of the channel that drives


class Motion:
    """Forty cosines up to 2.5 Hz, of unit size: band-limited, with every derivative and filter known in closed form."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.f = rng.uniform(0.05, 2.5, 40)
        a = rng.normal(size=40) / np.sqrt(1.0 + (self.f / 0.7) ** 2)
        self.a = a / np.sqrt((a**2).sum() / 2.0)
        self.p = rng.uniform(0.0, 2.0 * np.pi, 40)

    def through(self, t: np.ndarray, response: np.ndarray) -> np.ndarray:
        """What a linear filter of this complex response at the frequencies makes of it."""
        phase = 2.0 * np.pi * np.outer(t, self.f) + self.p + np.angle(response)
        return (self.a * np.abs(response) * np.cos(phase)).sum(1)

    def __call__(self, t: np.ndarray) -> np.ndarray:
        return self.through(t, np.ones(40, complex))

    def rate(self, t: np.ndarray) -> np.ndarray:
        return self.through(t, 2j * np.pi * self.f)

    def low(self, t: np.ndarray, f_c: float) -> np.ndarray:
        return self.through(t, 1.0 / (1.0 + 1j * self.f / f_c))


Plant = Callable[[Motion, np.ndarray, np.ndarray], np.ndarray]  # motion, times, a channel of its own


def zone(y: np.ndarray, width: float) -> np.ndarray:
    return np.sign(y) * np.maximum(np.abs(y) - width, 0.0)


def fields(t: np.ndarray, values: np.ndarray, shift_s: float = 0.0) -> Fields:
    return Fields(START_NS + np.round((t + shift_s) * 1e9).astype(np.int64), values)


def pair(
    plant: Plant,
    seed: int = 0,
    *,
    after: Callable[[np.ndarray], np.ndarray] = lambda y: y,
    rate_hz: float = RATE_HZ,
    sim_hz: float = SIM_HZ,
    sim_noise: float = 0.0,
    clock_s: float = 0.0,
) -> tuple[Fields, Fields, dict[str, Fields]]:
    """Recording, simulation, and other channels, of which only `/motor.current` ever drives; `after` acts on the noise too."""
    x, rng = Motion(seed), np.random.default_rng(1000 + seed)
    t, t_sim = 3.0 + np.arange(int(DURATION_S * rate_hz)) / rate_hz, np.arange(int((DURATION_S + 6.0) * sim_hz)) / sim_hz
    current, decoy = Motion(seed + 500)(t), Motion(seed + 700)(t)
    real = after(plant(x, t, current) + OFFSET + NOISE * rng.normal(size=len(t)))
    sim = x(t_sim) + sim_noise * rng.normal(size=len(t_sim))
    others = {"/motor.current": fields(t, CENTER + 2.0 * current), "/decoy.x": fields(t, decoy), "/decoy.ramp": fields(t, t)}
    return fields(t, real), fields(t_sim, sim, clock_s), others


def diagnosed(plant: Plant, seed: int = 0, **options: object) -> SignalDiagnosis:
    return compared(*pair(plant, seed, **options))  # type: ignore[arg-type]  # the options are pair's own


def compared(real: Fields, sim: Fields, others: Mapping[str, Fields]) -> SignalDiagnosis:
    return diagnose_signal(SignalPair.of_fields(real, sim, NAME), others)


def nothing(x: Motion, t: np.ndarray, current: np.ndarray) -> np.ndarray:
    return x(t)


def jump(y: np.ndarray) -> np.ndarray:
    return np.where(np.abs(y) > 0.2, y, 0.0)


SINGLE: Mapping[str, tuple[Plant, str, dict[str, float]]] = {
    "gain": (lambda x, t, c: 1.05 * x(t), "gain", {"gain": 1.05}),
    "reversed": (lambda x, t, c: -x(t), "gain", {"gain": -1.0}),
    "delay": (lambda x, t, c: x(t - 0.013), "delay", {"delay": 0.013}),
    "long delay": (lambda x, t, c: x(t - 0.8), "delay", {"delay": 0.8}),
    "low_pass": (lambda x, t, c: x.low(t, 8.0), "low_pass", {"f_c": 8.0}),
    "dead zone": (lambda x, t, c: zone(x(t), 0.1), "dead_band", {"width": 0.1, "center": 0.0}),
    "dead band": (lambda x, t, c: jump(x(t)), "dead_band", {"width": 0.2, "center": 0.0}),
    "drift": (lambda x, t, c: x(t) + 0.003 * t, "drift", {"rate": 0.003}),
    "friction": (lambda x, t, c: x(t) + 0.05 * np.sign(x(t)), "friction", {"level": 0.05}),
    "friction by rate": (lambda x, t, c: x(t) - 0.05 * np.sign(x.rate(t)), "friction", {"level": -0.05}),
}


def within(d: SignalDiagnosis, effect: str, expected: Mapping[str, float]) -> None:
    """An effect is there, with the planted values within its stated uncertainty, and that is worth something."""
    (one,) = [f for f in d.findings if f.effect == effect]
    assert one.signal == "/odom.v"
    assert one.false_discovery_rate <= 5e-3
    for name, value in expected.items():
        estimate = one.parameters[name]
        assert abs(estimate.value - value) < SURE * estimate.std, (name, estimate)
        assert estimate.std < 0.1 * max(abs(value), 0.1), (name, estimate)


def names(d: SignalDiagnosis) -> set[str]:
    return {one.effect for one in d.findings}


@pytest.mark.parametrize("which", SINGLE)
def test_a_single_effect_is_found_by_name_and_size(which: str) -> None:
    plant, effect, expected = SINGLE[which]
    d = diagnosed(plant)
    assert names(d) == {effect}
    within(d, effect, expected)
    assert d.findings[0].share > 0.9
    assert d.unexplained[NAME].white
    assert d.closer[NAME].rms_after < 1.1 * NOISE
    assert d.closer[NAME].rms_before > 1.2 * NOISE
    assert [place.signal for place in d.located] == ["/odom.v"]


@pytest.mark.parametrize(("rate_hz", "sim_hz"), [(50.0, 200.0), (100.0, 40.0)])
@pytest.mark.parametrize("which", ["delay", "dead zone"])
def test_rates_need_not_be_the_same(which: str, rate_hz: float, sim_hz: float) -> None:
    plant, effect, expected = SINGLE[which]
    d = diagnosed(plant, 3, rate_hz=rate_hz, sim_hz=sim_hz)
    assert names(d) == {effect}
    within(d, effect, expected)


def test_limits_are_found_where_they_are_reached() -> None:
    both = diagnosed(nothing, after=lambda y: np.clip(y, -1.2, 1.8))
    assert names(both) == {"saturation"}
    within(both, "saturation", {"upper": 1.8, "lower": -1.2})
    one = diagnosed(nothing, after=lambda y: np.minimum(y, 1.5))
    assert names(one) == {"saturation"}
    within(one, "saturation", {"upper": 1.5})
    assert "lower" not in one.findings[0].parameters


def test_steps_of_the_values_are_found_unless_the_simulation_has_them_too() -> None:
    d = diagnosed(nothing, after=lambda y: np.round(y / 0.05) * 0.05)
    assert names(d) == {"quantization"}
    within(d, "quantization", {"lsb": 0.05})
    real, sim, others = pair(nothing, after=lambda y: np.round(y / 0.05) * 0.05)
    same = compared(real, Fields(sim.t_ns, np.round(sim.values / 0.05) * 0.05), others)
    assert "quantization" not in names(same)


PAIRS: Mapping[str, tuple[Plant, dict[str, dict[str, float]]]] = {
    "gain and delay": (lambda x, t, c: 1.05 * x(t - 0.013), {"gain": {"gain": 1.05}, "delay": {"delay": 0.013}}),
    "delay and dead zone": (
        lambda x, t, c: zone(x(t - 0.013), 0.1),
        {"delay": {"delay": 0.013}, "dead_band": {"width": 0.1, "center": 0.0}},
    ),
    "low pass and drift": (
        lambda x, t, c: x.low(t, 8.0) + 0.003 * t,
        {"low_pass": {"f_c": 8.0}, "drift": {"rate": 0.003}},
    ),
}


@pytest.mark.parametrize("seed", seeds(1))
@pytest.mark.parametrize("which", PAIRS)
def test_two_effects_are_told_apart(which: str, seed: int) -> None:
    plant, planted = PAIRS[which]
    d = diagnosed(plant, seed)
    assert names(d) == set(planted)
    for effect, expected in planted.items():
        within(d, effect, expected)


@pytest.mark.parametrize("seed", seeds(1))
def test_what_drives_is_named_and_decoys_are_not(seed: int) -> None:
    d = diagnosed(lambda x, t, c: x(t) + 0.08 * np.interp(t - 0.05, t, c), seed)
    assert names(d) == {"driven"}
    assert d.findings[0].driver == "/motor.current"
    within(d, "driven", {"gain": 0.04, "lag": 0.05})


@pytest.mark.parametrize("seed", seeds(1))
@pytest.mark.parametrize("variable", ["x", "dx/dt"])
def test_what_has_no_name_is_given_none_but_an_equation(variable: str, seed: int) -> None:
    cubic = variable == "x"
    d = diagnosed(lambda x, t, c: x(t) + (0.03 * x(t) ** 3 if cubic else 0.002 * x.rate(t) ** 2), seed)
    assert names(d) == {"unknown"}
    (finding,) = d.findings
    assert finding.variable == ("x^3" if cubic else "dx/dt^2")
    assert finding.python.endswith("x ** 3" if cubic else "dx_dt ** 2")
    (coefficient,) = finding.parameters.values()
    assert coefficient.value == pytest.approx(0.03 if cubic else 0.002, rel=0.05)
    assert finding.share > 0.9


@pytest.mark.parametrize("seed", seeds(1))
def test_where_no_form_fits_a_curve_is_given(seed: int) -> None:
    d = diagnosed(lambda x, t, c: x(t) + 0.2 * np.maximum(x(t) - 0.4, 0.0) * np.exp(-x(t)), seed)
    (finding,) = (f for f in d.findings if f.effect == "unknown")
    assert finding.curve is not None
    assert finding.curve.variable == "x"


@pytest.mark.parametrize("seed", seeds(9))
def test_nothing_is_found_where_only_noise_and_a_constant_differ(seed: int) -> None:
    d = diagnosed(nothing, seed, sim_noise=NOISE * (seed % 3) / 2.0, sim_hz=(60.0, 100.0, 150.0)[seed % 3])
    assert d.findings == ()
    assert d.located == ()
    assert d.unexplained[NAME].white
    assert abs(d.offset[NAME].value - OFFSET) < 0.005
    assert d.unexplained[NAME].rms == pytest.approx(NOISE, rel=0.25)


@pytest.mark.parametrize("seed", [4, 32, 36])
def test_what_is_left_of_a_slow_simulations_noise_is_no_lag_of_the_recording(seed: int) -> None:
    """A thermometer at 10 Hz, as noisy in both: a low-pass would smooth the noise that the Wiener filter leaves."""
    rng = np.random.default_rng(seed)
    t, t_sim, fine = 3.0 + np.arange(600) / 10.0, np.arange(650) / 10.0, np.arange(7000) / 100.0
    warm = 25.0 + np.cumsum(0.003 * rng.normal(size=len(fine)))
    real, sim = (fields(at, np.interp(at, fine, warm) + 0.02 * rng.normal(size=len(at))) for at in (t, t_sim))
    assert diagnose_signal(SignalPair.of_fields(real, sim, NAME), {}).findings == ()


def test_a_lag_and_a_delay_beside_a_simulation_without_noise_are_both_named() -> None:
    """Slow signals see one as the other, but for their amplitude: no noise is there to be smoothed."""
    t, fine = 3.0 + np.arange(5000) / 100.0, np.arange(70_000) / 1000.0
    rng, w = np.random.default_rng(0), 2.0 * np.pi * np.linspace(0.05, 0.5, 6)
    phase, tau = rng.uniform(0.0, 6.0, 6), 1.0 / (2.0 * np.pi * 1.5)
    lag = np.arctan(w * tau)
    slow = (np.cos(np.outer(t - 0.03, w) + phase - lag) * np.cos(lag)).sum(axis=1)
    real = fields(t, slow + 1e-3 * rng.normal(size=len(t)))
    found = compared(real, fields(fine[::10], np.cos(np.outer(fine, w) + phase).sum(axis=1)[::10]), {})
    assert names(found) == {"low_pass", "delay"}
    within(found, "low_pass", {"f_c": 1.5})
    within(found, "delay", {"delay": 0.03})


@pytest.mark.parametrize("seed", seeds(1))
def test_the_start_of_a_lag_is_unknown_and_makes_no_drift(seed: int) -> None:
    """Both logs begin together: the lag came in from a motion that nobody logged."""
    x, rng, t = Motion(seed), np.random.default_rng(seed), np.arange(3000) / 50.0
    found = compared(fields(t, x.low(t, 0.8) + 0.002 * rng.normal(size=len(t))), fields(t, x(t)), {})
    assert names(found) == {"low_pass"}
    within(found, "low_pass", {"f_c": 0.8})


def test_what_drives_a_field_has_a_direction() -> None:
    """The current of a motor next to a magnetometer: one lag, a gain for each axis."""
    t, rng, gains = 3.0 + np.arange(3000) / 50.0, np.random.default_rng(1), np.array([2e-7, -1e-7, 3e-7])
    field = 4e-5 * np.stack([Motion(k)(t) for k in range(3)], axis=1)
    current = 5.0 + Motion(9)(t)
    real_field = field + np.outer(current - current.mean(), gains) + 1e-7 * rng.normal(size=field.shape)
    ns, units = fields(t, t).t_ns, ("T",) * 3
    sides = (dict(zip("xyz", (Fields(ns, column) for column in side.T), strict=True)) for side in (real_field, field))
    pair_of_fields = SignalPair.of_columns("/mag", ("x", "y", "z"), "magnetic", units, *sides, {})
    (finding,) = diagnose_signal(pair_of_fields, {"/esc.current": Fields(ns, current)}).findings
    assert (finding.effect, finding.variable, finding.signal) == ("driven", "/esc.current", "/mag")
    for axis, gain in zip("xyz", gains.tolist(), strict=True):
        estimate = finding.parameters[axis]
        assert abs(estimate.value - gain) < SURE * estimate.std


def test_what_interpolation_leaves_between_two_logs_without_noise_is_nothing() -> None:
    """Two simulators interpolate one motion on straight lines."""
    fine = np.arange(0.0, 70.0, 2e-3)
    x = Motion(5)(fine)
    t, t_sim = 3.0 + np.arange(2000) / 40.0, np.arange(3000) / 50.0
    real, sim = fields(t, np.interp(t, fine, x)), fields(t_sim, np.interp(t_sim, fine, x))
    found = diagnose_signal(SignalPair.of_fields(real, sim, NAME), {})
    assert found.findings == found.located == ()


def test_an_offset_alone_is_no_news_but_told() -> None:
    d = diagnosed(lambda x, t, c: x(t) + 4.0)
    assert d.findings == ()
    assert abs(d.offset[NAME].value - 4.0 - OFFSET) < SURE * d.offset[NAME].std


@pytest.mark.parametrize("clock_s", [1234.567, -98_765.4])
def test_clocks_without_a_common_epoch_are_aligned_and_say_that_a_delay_cannot_be_seen(clock_s: float) -> None:
    d = diagnosed(lambda x, t, c: 1.05 * x(t - 0.013), clock_s=clock_s)
    assert names(d) == {"gain"}
    within(d, "gain", {"gain": 1.05})
    assert d.not_identifiable == ("/odom.v.delay",)
    assert "share no epoch" in d.remarks[0]


def test_the_noise_of_a_slow_sensor_is_known_from_few_samples() -> None:
    """Six hundred samples are two long segments of a spectrum, and a fit of forty numbers takes some of the noise."""
    levels = []
    for seed in seeds(16):
        real, sim, _ = pair(nothing, seed, rate_hz=10.0)
        signal = aligned(SignalPair.of_fields(real, sim, NAME), {}, DiagnoseSettings())
        levels.append(noise_std(whitened(signal, rich_residual(signal, 0)[:, None], [0.0]).whiten)[0])
    assert np.mean(levels) == pytest.approx(NOISE, rel=0.05)


@pytest.mark.parametrize("late_s", [0.0, 0.12])
def test_a_sensor_slower_than_its_motion_shows_a_delay_and_nothing_else(late_s: float) -> None:
    """Two samples a second of a motion of 2.5 Hz, 120 in all: blocks and a fit's numbers are fewer than for a fast sensor."""
    for seed in seeds(3):
        d = diagnosed(lambda x, t, c: x(t - late_s), seed, rate_hz=2.0)
        assert names(d) == ({"delay"} if late_s else set())
        if late_s:
            within(d, "delay", {"delay": late_s})


def test_what_serves_as_well_is_listed() -> None:
    d = diagnosed(lambda x, t, c: x.low(t, 400.0))  # 0.4 ms behind, and nothing else that could be seen
    (one,) = d.findings
    assert {one.effect, *one.similar} >= {"delay", "low_pass"}


LIMIT = 1.8  # reached in one sample of twenty


def test_a_misfit_is_placed_where_it_is() -> None:
    d = diagnosed(nothing, after=lambda y: np.minimum(y, LIMIT))
    (place,) = d.located
    assert "its value above" in place.regime
    inside = np.zeros(len(d.traces[NAME].t_s), bool)
    for begin, end in place.intervals_s:
        inside |= (d.traces[NAME].t_s >= begin) & (d.traces[NAME].t_s < end)
    clipped = d.traces[NAME].real >= LIMIT
    assert clipped[inside].mean() > 2.0 * clipped.mean()
    assert (clipped & inside).sum() > 0.9 * clipped.sum()


def test_a_copy_of_the_signal_drives_nothing() -> None:
    real, sim, _ = pair(lambda x, t, c: x(t) + 0.02 * c)
    copies = {"/odom/filtered.v": Fields(real.t_ns, 0.5 * real.values)}
    assert "driven" not in names(compared(real, sim, copies))


@pytest.mark.parametrize("which", ["short", "few", "constant recording", "constant simulation", "nan", "apart", "unlike"])
def test_what_cannot_be_compared_is_refused_with_what_to_do(which: str) -> None:
    real, sim, others = pair(nothing)
    if which == "short":
        real = Fields(real.t_ns[:800], real.values[:800])
    elif which == "few":
        real = Fields(real.t_ns[::60], real.values[::60])
    elif which == "constant recording":
        real = Fields(real.t_ns, np.full(len(real), 2.5))
    elif which == "constant simulation":
        sim = Fields(sim.t_ns, np.zeros(len(sim)))
    elif which == "nan":
        real = Fields(real.t_ns, np.where(np.arange(len(real)) == 7, np.nan, real.values))
    elif which == "apart":  # the last seconds of the one are the first of the other
        keep = sim.t_ns < real.t_ns[600]
        sim = Fields(sim.t_ns[keep], sim.values[keep])
    else:
        sim = Fields(sim.t_ns, np.random.default_rng(1).normal(size=len(sim)))
    with pytest.raises(DataError) as raised:
        compared(real, sim, others)
    assert raised.value.where == "/odom.v"
    assert raised.value.fix
    assert raised.value.expected


def test_gaps_of_either_are_left_out() -> None:
    real, sim, others = pair(SINGLE["gain"][0])
    t, t_sim = (one.t_ns - real.t_ns[0] for one in (real, sim))
    keep, there = (t < 20e9) | (t > 23e9), (t_sim < 40e9) | (t_sim > 42e9)
    d = compared(Fields(real.t_ns[keep], real.values[keep]), Fields(sim.t_ns[there], sim.values[there]), others)
    assert names(d) == {"gain"}
    within(d, "gain", {"gain": 1.05})


def test_a_hard_iron_is_what_is_added_behind_the_soft_iron() -> None:
    """m = S m_0 + h, as magnetometers are calibrated, and not S (m_0 + h)."""
    rng, field, hard = np.random.default_rng(5), 5e-5, np.array([6e-6, -4e-6, 3e-6])
    t, t_sim = 3.0 + np.arange(4000) / 80.0, np.arange(6000) / 100.0
    soft = np.array([[1.1, 0.03, -0.02], [0.03, 0.92, 0.04], [-0.02, 0.04, 1.05]])
    real, sim = (field * np.stack([Motion(seed)(at) for seed in (1, 2, 3)], axis=1) for at in (t, t_sim))
    real = real @ soft + hard + 1e-7 * rng.normal(size=real.shape)
    stamps = [fields(at, at).t_ns for at in (t, t_sim)]
    names = tuple(f"/mag.magnetic_field.{axis}" for axis in "xyz")
    d = diagnose_signal(SignalPair("/mag", names, ("T",) * 3, stamps[0], real, stamps[1], sim, "magnetic"), {})
    assert {finding.effect for finding in d.findings} == {"soft_iron", "hard_iron"}
    (found,) = (finding for finding in d.findings if finding.effect == "hard_iron")
    for planted, estimate in zip(hard, found.parameters.values(), strict=True):
        assert abs(estimate.value - planted) < SURE * estimate.std < 0.01 * abs(planted)
