"""The closed loop: what a second diagnosis misses, over all time that both know."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from imutool.diagnosis.closed_loop import CLOSED_LOG, closed_loop, figure, is_worth_a_round
from imutool.diagnosis.compare_findings import ANOTHER_MOTION
from imutool.diagnosis.diagnose import diagnose
from imutool.diagnosis.result import Diagnosis, Finding, HeldOut, Located, Traces, Unexplained
from imutool.diagnosis.to_sensor_files import to_physics_file
from imutool.errors import ConfigError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.noise import datasheet
from imutool.recording import Recording, seconds
from imutool.report import json_values
from imutool.sensor import catalogue, physics_file
from imutool.sensor.made_up_flight import flight
from imutool.sensor.simulate import simulate, simulated

RATE_HZ, DURATION_S = 100.0, 40.0
LATE_S = 3.0  # by which the simulation begins after the recording
PLACE = Located("gyro", ("x",), ((0.0, 1.0),), "", 1.0, 0.0)


def diagnosis(misfits: list[tuple[float, float, float]], *, findings: tuple[str, ...] = (), white: bool = True) -> Diagnosis:
    """Of stretches (start, end, misfit of the gyro about x)."""
    traces = []
    for start_s, end_s, misfit in misfits:
        t_s = np.arange(round(start_s * RATE_HZ), round(end_s * RATE_HZ)) / RATE_HZ
        real = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (len(t_s), 1))
        expected = real - [0.1 * misfit, 0.0, 0.0, 0.0, 0.0, 0.0]
        traces.append(Traces("log", t_s, real, expected, expected, np.zeros(len(t_s), bool)))
    kinds = {"unknown": "unknown"}
    found = tuple(
        Finding(name, "both", 0.0, 0.0, 0.0, {}, "", HeldOut(0.0, 0.0, "rad/s", 1.0), kind=kinds.get(name, "catalogue"))
        for name in findings
    )
    left = {"gyro": Unexplained(1.0, 1.0, white)}
    located = (PLACE,) if findings or not white else ()
    return Diagnosis(("log",), "sim", located, found, np.zeros((1, 6)), (), left, traces=tuple(traces))


def test_figures_are_of_all_time_that_both_know() -> None:
    first, again = (
        diagnosis([(0.0, 40.0, 3.0), (50.0, 80.0, 3.0)]),
        diagnosis([(0.0, 10.0, 1.0), (12.0, 40.0, 2.0), (60.0, 70.0, 0.0)]),
    )
    compared = closed_loop(first, again, Path(CLOSED_LOG)).compared
    figures = {one.figure: (one.before, one.after) for one in compared}
    after, quarter = (
        0.1 * np.sqrt(square / 3.0) for square in ((10.0 + 28.0 * 4.0) / 48.0, (10.0 + 2.0 * 4.0) / 12.0)
    )  # one of three axes
    assert figures["gyro rms"] == pytest.approx((0.1 * np.sqrt(3.0), after))
    assert figures["gyro rms, quarter 1"] == pytest.approx((0.1 * np.sqrt(3.0), quarter))
    turns = [
        0.5 * misfit for misfit in (1.0,) * 2 + (2.0,) * 5 + (0.0,) * 2
    ]  # windows of five seconds, each within one stretch
    assert figures["rotation over 5 s"][1] == pytest.approx(np.sqrt(np.mean(np.square(turns))))


def test_a_second_simulation_that_no_longer_moves_alike_is_no_closer() -> None:
    """It is compared by its own poses then, and the recording by its own: what that leaves says nothing of the simulation."""
    first, again = diagnosis([(0.0, 20.0, 3.0)]), diagnosis([(0.0, 20.0, 0.0)])
    loop = closed_loop(first, replace(again, remarks=(ANOTHER_MOTION,)), Path(CLOSED_LOG))
    assert loop.mismatch
    assert loop.compared == ()
    both = [replace(one, remarks=(ANOTHER_MOTION,)) for one in (first, again)]
    assert not closed_loop(both[0], both[1], Path(CLOSED_LOG)).mismatch


def test_a_metric_gives_a_number() -> None:
    first, log = diagnosis([(0.0, 20.0, 1.0)]), Path(CLOSED_LOG)
    loop = closed_loop(first, first, log, metric=(figure(lambda _: np.float32(0.5), log),) * 2)  # type: ignore[arg-type,return-value]
    assert loop.compared[-1].before == loop.compared[-1].after == 0.5
    assert json_values(loop)["compared"][-1]["after"] == 0.5
    with pytest.raises(ConfigError, match=r"'abc' for closed\.mcap; expected a number"):
        figure(lambda _: "abc", log)  # type: ignore[arg-type,return-value]
    with pytest.raises(ConfigError, match=r"`metric` fails for closed\.mcap: ZeroDivisionError: division by zero; .* leave"):
        figure(lambda _: 1 / 0, log)


def test_what_no_simulation_changes_is_not_missing() -> None:
    stays = ("quantization", "dropped_samples", "reference_smoothing", "gyro_dead_band")
    first = diagnosis([(0.0, 20.0, 1.0)], findings=("lever_arm", *stays))
    for findings, white, missing in (
        ((), True, None),
        (stays, True, None),
        (("quantization",), False, ()),  # a misfit without a name
        ((), False, ()),
        (("gravity", "quantization"), True, ("gravity",)),
        (("timestamp_jitter",), True, ("timestamp_jitter",)),  # the first did not have it
    ):
        loop = closed_loop(first, diagnosis([(0.0, 20.0, 0.5)], findings=findings, white=white), Path(CLOSED_LOG))
        assert (loop.mismatch, loop.findings) == (missing is not None, missing or ())


@pytest.mark.parametrize(
    ("again", "another"),
    [((), False), (("lever_arm",), False), (("gravity",), True), (("unknown",), False), (("timestamp_jitter",), False)],
)
def test_only_an_effect_that_the_first_search_did_not_have_is_worth_another(again: tuple[str, ...], another: bool) -> None:
    first, second = (diagnosis([(0.0, 20.0, 1.0)], findings=names, white=not again) for names in (("lever_arm",), again))
    assert is_worth_a_round(first, second) is another


def test_a_jump_of_the_clock_comes_at_its_time_in_a_simulation_that_begins_later(tmp_path: Path) -> None:
    path = flight(3, duration_s=DURATION_S, rate_hz=RATE_HZ)
    (jump,) = catalogue.effects(["clock_jump"])
    white = msgspec.structs.replace(datasheet.read("adis16448"), gyro_walk=(0.0,) * 3, accel_walk=(0.0,) * 3)
    real = simulated(path, [(jump, np.array([20.0, 0.05]))], white, RATE_HZ, 1).recording
    later = path.truth.rows(seconds(path.truth.t_ns, int(path.truth.t_ns[0])) > LATE_S)
    ideal = simulated(Recording("sim", path.imu, {"/gt": later}), [], white, RATE_HZ, 2).recording
    recorded, sim, closed, physics = (tmp_path / name for name in ("real.mcap", "sim.mcap", CLOSED_LOG, "physics.toml"))
    write(replace(real, truths={}), recorded)
    write(ideal, sim)
    first = diagnose([recorded], sim)
    assert [one.effect for one in first.findings] == ["clock_jump"]
    file = to_physics_file(first)
    assert file.start_ns == real.imu.t_ns[0]
    physics_file.write(file, physics)
    assert physics_file.read(physics) == file
    for start_ns, right in ((file.start_ns, True), (None, False)):  # else times count from its own first sample, and come late
        physics.write_text(physics_file.to_toml(msgspec.structs.replace(file, start_ns=start_ns)), "utf-8")
        simulate(sim, closed, physics=physics, overwrite=True)
        made, since_s = read(closed).imu, seconds(real.imu.t_ns, int(real.imu.t_ns[0]))
        rows = (since_s > 20.1) & (since_s < 20.0 + LATE_S)
        misfit = real.imu.gyro[rows] - make_interp_spline(made.t_ns, made.gyro, k=1)(real.imu.t_ns[rows])
        assert (misfit.std(axis=0).max() < 1.2 * white.gyro_density[0] * np.sqrt(RATE_HZ)) == right
