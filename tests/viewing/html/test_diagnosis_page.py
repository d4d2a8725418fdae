"""The page about a diagnosis: what it says, that it asks nobody for anything, and that its figures show what is there."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import diagnoses, markup
from support.diagnoses import replace

from imutool.diagnosis.result import Closer, SignalTraces
from imutool.diagnosis.wording.conclusion import headline
from imutool.errors import ConfigError
from imutool.recording import Poses
from imutool.viewing.html import diagnosis_figures as figures
from imutool.viewing.html import diagnosis_paths, drawing
from imutool.viewing.html.diagnosis_page import html, write
from imutool.viewing.html.page import text
from imutool.viewing.model import decimation

Page, svgs = markup.Page, markup.svgs
MAX_BYTES = 3_000_000
# Welch's estimate over 30 s has about 14 independent windows and three axes, and a bin at the top averages many frequencies.
DENSITY = 0.05


@pytest.fixture(scope="module")
def three() -> str:
    return html(diagnoses.THREE)


@pytest.fixture(scope="module")
def nothing() -> str:
    return html(diagnoses.NOTHING)


# ── what it says ──


@pytest.mark.parametrize("name", ["NOTHING", "ARM", "LATE", "BOTH", "BY_CURRENT", "NAMELESS", "UNEXPLAINED"])
def test_the_conclusion_comes_first_and_what_remains_and_the_provenance_after(name: str) -> None:
    d = replace(getattr(diagnoses, name), traces=())  # its words alone: figures are looked at below
    said = Page(html(d)).text
    places = [said.index(words) for words in (headline(d), "Remaining misfit", "Provenance", "imutool.diagnosis/1")]
    assert places == sorted(places)
    assert ("Unmodelled effects" in said) == bool(d.findings)
    assert ("Location of the misfit" in said) == bool(d.located)


def test_the_table_holds_effect_signal_equation_value_share_unseen_time_and_chances(three: str) -> None:
    said = Page(three).text
    row = said[said.index("lever_arm accel it sits") :]
    for words in (
        "(0.213, -0.051, 0.120) ± 0.004 m", "accel += alpha x r + omega x (omega x r)", "71 %",
        "rms 0.52 to 0.19 m/s² on 30 s", "1 in 100", "clock_offset",
    ):  # fmt: skip
        at = row.index(words)
        row = row[at + len(words) :]


def test_a_matrix_is_listed_entry_by_entry() -> None:
    estimate = type(diagnoses.LAG.parameters["tau"])
    matrix = {a + b: estimate(0.01 * (1 + k), 0.001, "-") for k, (a, b) in enumerate((a, b) for a in "xyz" for b in "xyz")}
    one = replace(diagnoses.LEVER_ARM, effect="gyro_misalignment", parameters=matrix)
    said = Page(html(replace(diagnoses.ARM, findings=(one,), traces=()))).text
    assert "; ".join(f"{key} {1 + k}.00 ± 0.10" for k, key in enumerate(matrix)).replace("; ", " ; ") + " %" in said


def test_every_log_has_its_bias_its_samples_and_its_unseen_time(three: str) -> None:
    said = Page(three).text
    assert "constant bias gyro (-0.01, +0.02, -0.003) rad/s, accel (-0.1, +0.2, -0.05) m/s²" in said
    assert "one: 18000 at 200 Hz, 0.0 to 90.0 s, 30 s of it unseen by any fit" in said
    assert "two: 14000 at 200 Hz, 100.0 to 170.0 s, 23 s of it unseen by any fit" in said
    assert "gyro rms 0.02 to 0.0074 rad/s, 90 % of the misfit removed" in said
    assert diagnoses.THREE.remarks[0] in said


def test_what_was_counted_and_not_fitted_claims_no_gain() -> None:
    steps = replace(
        diagnoses.LAG, effect="quantization", share=0.0, held_out=replace(diagnoses.LAG.held_out, rms_before=0.0, rms_after=0.0)
    )
    said = Page(html(replace(diagnoses.LATE, findings=(steps,), traces=()))).text
    assert "removes 0 %" not in said
    assert "rms 0 to 0" not in said
    assert "it comes in steps of" in said


def test_a_curve_is_drawn_for_the_axes_that_have_one() -> None:
    curve = diagnoses.UNKNOWN.curve  # x bends, y does nothing but has a band, z bends
    assert curve is not None
    only = replace(curve, y=tuple((0.0, 0.0, z) for *_, z in curve.y), band=tuple((0.0, 0.0, z) for *_, z in curve.band))
    titles = {word for word in Page(figures.curve(only, "gyro")).words if word.startswith("gyro")}
    assert titles == {"gyro z"}
    titles = {word for word in Page(figures.curve(curve, "gyro")).words if word.startswith("gyro")}
    assert titles == {"gyro x", "gyro y", "gyro z"}


# ── a page that can be sent to anybody ──


def test_three_logs_stay_small_whole_and_without_a_request(three: str) -> None:
    assert len(three.encode()) < MAX_BYTES
    page = Page(three)
    assert page.addresses  # markers of lines are used by their identifiers
    assert all(address.startswith("#") for address in page.addresses)
    assert "default-src 'none'" in three
    assert not page.tags & {"script", "link", "iframe", "img", "object"}
    assert "@import" not in three


def test_identifiers_are_unique_and_every_use_finds_its_own_figure(three: str) -> None:
    page = Page(three)
    assert len(page.ids) == len(set(page.ids))
    assert {address.removeprefix("#") for address in page.addresses} <= set(page.ids)


def test_what_a_log_is_called_never_becomes_markup(three: str) -> None:
    page = Page(three)
    assert "img" not in page.tags
    assert page.handlers == []
    assert diagnoses.HOSTILE in page.text
    driver = replace(diagnoses.DRIVEN, driver=diagnoses.HOSTILE, equation=diagnoses.HOSTILE, similar=(diagnoses.HOSTILE,))
    place = replace(diagnoses.FAST, signal=diagnoses.HOSTILE, regime=diagnoses.HOSTILE)
    curve = replace(diagnoses.UNKNOWN.curve, variable=diagnoses.HOSTILE, unit=diagnoses.HOSTILE)
    nameless = replace(diagnoses.UNKNOWN, signal=diagnoses.HOSTILE, curve=curve)
    hostile = replace(
        diagnoses.THREE, sim=diagnoses.HOSTILE, findings=(driver, nameless), located=(place,), remarks=(diagnoses.HOSTILE,),
        not_identifiable=(diagnoses.HOSTILE,), unexplained={diagnoses.HOSTILE: diagnoses.unexplained()["gyro"]}, traces=(),
        closer={diagnoses.HOSTILE: Closer.computed(diagnoses.LAG.held_out, 0.001)},
    )  # fmt: skip
    page = Page(html(hostile))
    assert not page.tags & {"img", "script"}
    assert page.handlers == []


def test_letters_that_hide_or_turn_others_are_spelt_out() -> None:
    assert text("a\u202eb\x00\x1b[31m<b>") == "a\\u202eb\\x00\\x1b[31m&lt;b&gt;"
    assert text("Größe µ ± ω") == "Größe µ ± ω"


def test_it_is_drawn_in_the_pages_own_colours_for_light_dark_and_paper(three: str) -> None:
    for svg in svgs(three):
        assert set(re.findall(r"#[0-9a-fA-F]{6}\b", svg)) == set()
        used = set(re.findall(r"var\(--(\w+)\)", svg))
        assert used >= {"ink", "grid"} or "where" in svg or used >= {"ink"}
        assert used <= set(drawing.VARIABLES.values())
    style = three[three.index("<style>") : three.index("</style>")]
    for variable in drawing.VARIABLES.values():
        assert style.count(f"--{variable}:") >= 1
    for variable in ("ink", "before", "after", "paper", "grid"):
        assert style.count(f"--{variable}:") == 3, "light, dark and print"


def test_the_same_diagnosis_gives_the_same_page(nothing: str) -> None:
    assert html(diagnoses.NOTHING) == nothing


@pytest.mark.usefixtures("words_alone")
def test_ten_logs_draw_the_first_four_and_say_so() -> None:
    many = tuple(diagnoses.traces(f"log {k}", late=True, seed=k, duration_s=20.0) for k in range(10))
    d = replace(diagnoses.LATE, real=("x.mcap",) * 10, bias=np.zeros((10, 6)), traces=many)
    content = html(d)
    assert len(content.encode()) < MAX_BYTES
    assert "The first 4 of 10 stretches are drawn" in Page(content).text
    assert Page(content).text.count(": over time.") == 4


# ── figures ──


def test_without_findings_there_is_no_after(nothing: str) -> None:
    assert "var(--before)" in "".join(svgs(nothing))
    assert "var(--after)" not in "".join(svgs(nothing))
    assert "with the findings" not in Page(nothing).text
    assert "Difference" in Page(nothing).text


def axes_labels(svg: str) -> str:
    return " ".join(Page(svg).words)


def test_every_figure_has_labels_with_units() -> None:
    d = diagnoses.BOTH
    wanted = {
        figures.misfit_strip(d, d.traces[0]): ["time (s)", "gyro x", "accel z", "unseen"],
        figures.residual(d.traces[0], found=True): ["time (s)", "x (rad/s)", "z (m/s²)"],
        figures.spectrum(d): ["frequency (Hz)", "density (rad/s/√Hz)", "density (m/s²/√Hz)"],
        figures.residual_against_rate(d): ["rate about y (rad/s)", "turning rate (rad/s)", "mean misfit (m/s²)"],
        figures.residual_against_attitude(d): ["z above the horizon (°)", "mean misfit (rad/s)"],
        figures.curve(diagnoses.UNKNOWN.curve, "gyro"): ["angular rate z (rad/s)", "misfit (rad/s)", "gyro z"],
    }
    for svg, words in wanted.items():
        assert svg is not None
        for word in words:
            assert word in axes_labels(svg), word
        assert "mathdefault" not in svg


def test_without_positions_the_accelerometer_is_not_drawn() -> None:
    (trace,) = diagnoses.LATE.traces
    poses = trace.truth
    still = Poses(poses.t_ns, np.zeros_like(poses.p_wb), poses.q_wb_wxyz)
    d = replace(diagnoses.LATE, traces=(replace(trace, truth=still),))
    for drawn in (
        figures.misfit_strip(d, d.traces[0]),
        figures.residual(d.traces[0], found=True),
        figures.spectrum(d),
        figures.residual_against_rate(d),
        figures.residual_against_attitude(d),
    ):
        assert drawn is not None
        assert "rad/s" in axes_labels(drawn) or "gyro x" in axes_labels(drawn)
        assert not {"m/s²", "accel"} & set(re.findall(r"m/s²|accel", axes_labels(drawn)))


def changed(d: SimpleNamespace, unseen: bool) -> SimpleNamespace:
    """The same with other readings in unseen, or in seen, time."""
    (trace,) = d.traces
    real = trace.real.copy()
    real[trace.held_out if unseen else ~trace.held_out] *= 1.5
    return replace(d, traces=(replace(trace, real=real),))


@pytest.mark.parametrize("figure", [figures.spectrum, figures.residual_against_rate, figures.residual_against_attitude])
def test_spectra_and_means_are_over_unseen_time_alone(figure: object) -> None:
    assert callable(figure)
    drawn = figure(diagnoses.LATE)
    assert figure(changed(diagnoses.LATE, unseen=False)) == drawn
    assert figure(changed(diagnoses.LATE, unseen=True)) != drawn


def test_another_signal_is_drawn_as_recorded_and_expected_and_what_is_left() -> None:
    t_s = np.arange(500) / 50.0
    there, held_out = np.sin(t_s), t_s > 5.0
    beside = SignalTraces(t_s, 1.2 * there, there, 1.2 * there, held_out, "m/s")
    with_it = replace(diagnoses.BOTH, signals={"/odom.<x>": beside})
    with pytest.MonkeyPatch.context() as patch:  # counted, not drawn
        for module in (figures, diagnosis_paths):
            patch.setattr(module, "svg", lambda *_, **__: "<svg></svg>")
        content = html(with_it)
        assert len(svgs(content)) == len(svgs(html(diagnoses.BOTH))) + 1
    assert "/odom.&lt;x&gt;: over time" in content
    svg = figures.scalar_signal(beside, found=True)
    assert "(m/s)" in axes_labels(svg)
    assert "var(--after)" in svg
    assert "var(--after)" not in figures.scalar_signal(beside, found=False)


@pytest.mark.parametrize(("of", "drawn"), [("/odom", True), ("/odom.x", True), ("/odom.y", False), ("/od", False)])
def test_what_a_finding_of_a_topic_removes_is_drawn_and_first(of: str, drawn: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    monkeypatch.setattr(figures, "scalar_signal", lambda _, found: asked.append(found) or "<svg></svg>")
    t_s = np.arange(500) / 50.0
    beside = SignalTraces(t_s, t_s, t_s, t_s, t_s > 5.0, "m/s")
    finding = replace(diagnoses.BOTH.findings[0], signal=of)
    html(replace(diagnoses.BOTH, traces=(), findings=(finding,), signals={"/mag.x": beside, "/odom.x": beside}))
    assert asked == [drawn, False]


@pytest.mark.usefixtures("words_alone")
def test_without_attitude_or_a_long_enough_stretch_it_says_so() -> None:
    (trace,) = diagnoses.LATE.traces
    held_out = np.arange(len(trace.t_s)) % 100 < 20  # a tenth of a second at a time
    d = replace(diagnoses.LATE, traces=(replace(trace, truth=None, held_out=held_out),))
    said = Page(html(d)).text
    assert "The attitude is unknown" in said
    assert "Every unseen stretch is too short for a spectrum" in said
    assert "Against turning rate" in said


@pytest.mark.usefixtures("words_alone")
def test_where_nothing_was_held_out_all_time_is_drawn_and_said() -> None:
    (trace,) = diagnoses.LATE.traces
    d = replace(diagnoses.LATE, traces=(replace(trace, held_out=np.zeros_like(trace.held_out)),))
    assert "all time: none was held out" in Page(html(d)).text


def test_a_stretch_without_expectation_leaves_a_hole_and_no_error() -> None:
    (trace,) = diagnoses.LATE.traces
    before, after = trace.before.copy(), trace.after.copy()
    before[7000:9000] = after[7000:9000] = np.nan
    svg = figures.residual(replace(trace, before=before, after=after), found=True)
    whole = figures.residual(trace, found=True)
    lifted = [len(re.findall(r"\bM ", drawn)) for drawn in (svg, whole)]
    assert lifted[0] == lifted[1] + 12  # the pen, once in each of two lines in six panels
    d = replace(diagnoses.LATE, traces=(replace(trace, before=before, after=after),))
    for drawn in (
        figures.spectrum(d),
        figures.residual_against_rate(d),
        figures.residual_against_attitude(d),
        figures.misfit_strip(d, d.traces[0]),
    ):
        assert drawn is not None
        assert "nan" not in drawn


def test_located_stretches_shade_the_axes_they_name_alone() -> None:
    def shaded(axes: tuple[str, ...]) -> int:
        d = replace(diagnoses.ARM, located=(replace(diagnoses.FAST, axes=axes),))
        return figures.misfit_strip(d, d.traces[0]).count("var(--mark)")

    assert shaded(()) == 0
    assert shaded(("x", "y")) == 2 * shaded(("x",)) > 0


def test_a_place_is_shaded_in_its_own_log_and_in_every_stretch_of_it() -> None:
    place = replace(diagnoses.FAST, intervals_s=((80.0, 120.0),))
    first, second = diagnoses.traces("a", duration_s=90.0), diagnoses.traces("a", start_s=100.0, duration_s=90.0)
    assert list(figures.intervals_in_log(first, place)) == [(80.0, first.t_s[-1])]
    assert list(figures.intervals_in_log(second, place)) == [(100.0, 120.0)]
    of_b = replace(place, log="b.mcap")
    assert list(figures.intervals_in_log(replace(first, path="a.mcap"), of_b)) == []
    assert list(figures.intervals_in_log(replace(first, path="b.mcap"), of_b)) == [(80.0, first.t_s[-1])]


def test_beside_poses_a_misfit_is_drawn_as_far_as_they_know_the_motion() -> None:
    trace = diagnoses.traces("a")
    assert (figures.residual_in_band(trace, trace.after) == trace.real - trace.after).all()
    slow = figures.residual_in_band(replace(trace, band_hz=4.0), trace.after)
    away = slice(100, -100)  # a filter's length from the ends
    assert slow[away].std() < 0.3 * (trace.real - trace.after)[away].std()  # white noise, of which 4 % of the band is left


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=400), st.integers(1, 50))
def test_thinning_a_line_keeps_its_ends_of_scale_its_order_and_its_length_in_bounds(values: list[float], buckets: int) -> None:
    t, y = np.arange(len(values), dtype=float), np.array(values)
    thin_t, thin_y = decimation.decimate_extremes(t, y, buckets)
    assert len(thin_t) <= 2 * buckets
    assert (np.diff(thin_t) > 0).all()
    assert thin_y.min() == y.min()
    assert thin_y.max() == y.max()
    np.testing.assert_array_equal(y[thin_t.astype(int)], thin_y)


@pytest.mark.parametrize("rate_hz", [1, 8000])
@pytest.mark.parametrize("samples", [500, 20_000])
def test_no_line_crosses_a_gap(samples: int, rate_hz: int) -> None:
    rows = np.arange(samples)
    rows = rows[(rows < 0.4 * samples) | (rows >= 0.5 * samples)]
    t, y = rows / rate_hz, np.sin(0.01 * rows)
    drawn_t, drawn_y = decimation.decimate_extremes(t, y)
    (hole,) = np.flatnonzero(np.isnan(drawn_y))
    assert drawn_t[[hole - 1, hole + 1]].tolist() == [(0.4 * samples - 1) / rate_hz, 0.5 * samples / rate_hz]
    assert drawn_t[hole - 1] < drawn_t[hole] < drawn_t[hole + 1]


def test_a_mask_becomes_stretches_of_time() -> None:
    t = np.arange(6) / 2.0
    mask = np.array([True, True, False, True, False, True])
    assert decimation.true_intervals(t, mask) == [(0.0, 0.5), (1.5, 1.5), (2.5, 2.5)]
    assert decimation.true_intervals(t, np.zeros(6, dtype=bool)) == []


def test_white_noise_has_the_density_of_the_dashed_line() -> None:
    found = figures._density(diagnoses.NOTHING.traces, slice(0, 3), after=False)
    assert found is not None
    frequency, density = found
    assert frequency[-1] == pytest.approx(100.0, rel=0.05)
    wanted = diagnoses.GYRO_NOISE * np.sqrt(2.0 / diagnoses.RATE_HZ)
    assert np.median(density[frequency > 5.0]) == pytest.approx(wanted, rel=DENSITY)


def test_means_follow_a_line_and_their_bands_count_blocks_not_samples() -> None:
    rng = np.random.default_rng(1)
    x = rng.uniform(-1.0, 1.0, 50_000)
    blocks = np.repeat(np.arange(500.0), 100)
    shared = np.repeat(rng.normal(0.0, 0.3, 500), 100)  # an error that a block has in common
    centre, mean, band = figures.means(x, 2.0 * x + shared, blocks)
    assert len(centre) == figures.BINS
    np.testing.assert_allclose(mean, 2.0 * centre, atol=0.06)  # 0.3 / sqrt(500), four times
    np.testing.assert_allclose(band, 2.0 * 0.3 / np.sqrt(500), rtol=0.25)  # a few samples of each block are in each bin
    assert len(figures.means(x[:10], x[:10], np.zeros(10))[0]) == 0  # one block says nothing of its own spread


# ── files ──


def test_it_is_written_and_an_existing_page_is_kept(tmp_path: Path) -> None:
    target, bare = tmp_path / "report.html", replace(diagnoses.NOTHING, traces=())
    write(bare, target)
    assert target.read_text(encoding="utf-8") == html(bare)
    with pytest.raises(ConfigError, match="exists"):
        write(diagnoses.LATE, target)
    assert target.read_text(encoding="utf-8") == html(bare)
    write(replace(diagnoses.LATE, traces=()), target, overwrite=True)
    assert target.read_text(encoding="utf-8") != html(bare)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def fail(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", fail)
    return iter(())


def test_an_interrupt_leaves_nothing(tmp_path: Path, interrupted: None) -> None:
    with pytest.raises(KeyboardInterrupt):
        write(replace(diagnoses.LATE, traces=()), tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_matplotlib_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ConfigError, match=r"pip install 'imutool\[report\]'"):
        write(diagnoses.NOTHING, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("words_alone")
def test_paths_of_a_closed_loop_are_those_of_the_first_ideal_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples of the second simulation have a bias: integrated, it would drift away."""
    drawn: list[np.ndarray | None] = []
    monkeypatch.setattr(diagnosis_paths, "paths", lambda d: drawn.extend(trace.ideal for trace in d.traces))
    (trace,) = diagnoses.ARM.traces
    ideal = trace.before - 0.01
    again = replace(diagnoses.NOTHING, traces=(replace(trace, ideal=ideal + 0.02),))
    for expected in (ideal, None):
        drawn.clear()
        html(again, first=replace(diagnoses.ARM, traces=(replace(trace, ideal=expected),)))
        (found,) = drawn
        assert (found is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(found, expected)
