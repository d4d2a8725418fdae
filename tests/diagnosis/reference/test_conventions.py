"""A wrong unit and swapped axes against a simulation of the same motion have their own names."""

from __future__ import annotations

import numpy as np
import pytest
from support import diagnoses, planted
from support.diagnoses import replace

from imutool.diagnosis.audit.motion import OTHER_UNIT
from imutool.diagnosis.reference.conventions import with_common_conventions
from imutool.diagnosis.result import CONVENTIONS, Closer
from imutool.diagnosis.wording.conclusion import conclusion
from imutool.diagnosis.wording.effect_sentences import SENTENCES

SWAPPED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
CYCLIC = np.roll(np.eye(3), 1, axis=0)
SECONDS = 12.0
NORMAL = {"gyro_scale": [0.03, -0.02, 0.01], "mount_rotation": [0.05, -0.08, 0.06], "lever_arm": [0.1, 0.1, -0.2]}


@pytest.fixture(scope="module")
def pair():
    return planted.pair(planted.rich(2, SECONDS), NORMAL)


@pytest.mark.parametrize(
    ("gyro", "accel", "named"),
    [
        (np.eye(3), np.eye(3), []),
        (np.eye(3), np.eye(3) / OTHER_UNIT["accel"], [("wrong_unit", "accel")]),
        (np.eye(3) / OTHER_UNIT["gyro"], np.eye(3), [("wrong_unit", "gyro")]),
        (np.eye(3), OTHER_UNIT["accel"] * np.eye(3), [("wrong_unit", "accel")]),
        (SWAPPED, SWAPPED, [("left_handed", "both")]),
        (np.eye(3), CYCLIC, [("permuted_axes", "accel")]),
        (SWAPPED, SWAPPED / OTHER_UNIT["accel"], [("wrong_unit", "accel"), ("left_handed", "both")]),
        (0.9 * np.eye(3), 1.1 * np.eye(3), []),
    ],
)
def test_a_convention_is_named_and_undone(pair, gyro: np.ndarray, accel: np.ndarray, named: list[tuple[str, str]]) -> None:
    read = np.concatenate([pair.real[:, :3] @ gyro.T, pair.real[:, 3:] @ accel.T], axis=1)
    (after,), found = with_common_conventions([replace(pair, real=read)])
    assert [(one.effect, one.signal) for one in found] == named
    assert after.real == pytest.approx(pair.real if named else read)
    for one in found:
        assert one.effect in SENTENCES
        assert one.effect in CONVENTIONS
        assert one.share > 0.9


@pytest.mark.parametrize(
    ("axes", "factor", "named"),
    [(np.diag([1.0, -1.0, -1.0]), 1.0, ["permuted_axes"]), (np.eye(3), 1.0 / OTHER_UNIT["accel"], ["wrong_unit"])],
)
def test_a_large_lever_arm_hides_no_convention_whose_axes_the_gyro_shows(
    axes: np.ndarray, factor: float, named: list[str]
) -> None:
    far = planted.pair(planted.rich(2, SECONDS), {"lever_arm": [1.0, 0.0, 1.0]})
    read = np.concatenate([far.real[:, :3] @ axes, factor * far.real[:, 3:] @ axes], axis=1)
    (after,), found = with_common_conventions([replace(far, real=read)])
    assert [one.effect for one in found] == named
    assert after.real == pytest.approx(far.real)


@pytest.mark.parametrize("constant", [60.0, 90.0])
def test_a_large_constant_of_one_axis_is_no_unit(constant: float) -> None:
    """As a battery's voltage leaves it: in g it would be a motionless sensor, with the other constant even one turned aside."""
    calm = planted.pair(planted.planar(SECONDS))
    read = calm.real.copy()
    read[:, 3] += constant + np.sin(np.linspace(0.0, 6.0, len(read)))
    (after,), found = with_common_conventions([replace(calm, real=read)])
    assert found == []
    assert after.real == pytest.approx(read)


def test_axes_that_the_motion_does_not_tell_apart_stay() -> None:
    flat = planted.pair(planted.planar(SECONDS))
    swapped = np.concatenate([flat.real[:, :3] @ SWAPPED.T, flat.real[:, 3:]], axis=1)
    assert with_common_conventions([replace(flat, real=swapped)])[1] == []


@pytest.mark.parametrize(("tilt", "y", "named"), [(-0.04, 1.0, []), (0.0, -1.0, [("left_handed", "both")])])
def test_an_axis_that_hardly_turns_is_mirrored_only_if_the_accel_shows_it(tilt: float, y: float, named: list) -> None:
    """Fetch 04_eight turns about z: what a tilt of its mount adds to y was more than y turns, and the other way."""
    flat, turn = planted.planar(SECONDS), np.diag([1.0, y, 1.0])
    leaning = replace(flat, gyro=flat.gyro + 0.02 * flat.gyro[:, 2:] * [0.0, 1.0, 0.0])
    pair = planted.pair(leaning, {"mount_rotation": [tilt, 0.0, 0.0]})
    read = np.concatenate([pair.real[:, :3] @ turn, pair.real[:, 3:] @ turn], axis=1)
    (after,), found = with_common_conventions([replace(pair, real=read)])
    assert [(one.effect, one.signal) for one in found] == named
    assert after.real == pytest.approx(pair.real)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_gravity_is_up_in_the_world_of_both_logs(z: float) -> None:
    """In a world whose z is down, as a simulator in NED has it, more gravity was less of it."""
    felt, turn = planted.rich(2, SECONDS), np.diag([1.0, z, z])
    columns = {name: np.ascontiguousarray(getattr(felt, name) @ turn) for name in ("gyro", "accel", "alpha")}
    (pair,), _ = with_common_conventions([planted.pair(replace(felt, R_wb=turn @ felt.R_wb @ turn, **columns))])
    assert pair.ideal.R_wb is not None
    assert np.einsum("nij,nj->ni", pair.ideal.R_wb, pair.ideal.accel)[:, 2].mean() > 9.0


def test_the_conclusion_does_not_count_a_convention_among_what_the_others_remove(pair) -> None:
    read = np.concatenate([pair.real[:, :3] @ SWAPPED.T, pair.real[:, 3:] @ SWAPPED.T], axis=1)
    _, (axes,) = with_common_conventions([replace(pair, real=read)])
    (arm,) = diagnoses.ARM.findings
    closer = {"accel": Closer.computed(arm.held_out, 0.001)}
    said = conclusion(replace(diagnoses.ARM, findings=(axes, arm), closer=closer))
    assert "in the units and axes of the simulation the others remove" in said
    alone = conclusion(replace(diagnoses.ARM, findings=(axes,)))
    assert "its axes are left-handed: recorded x, y, z = y, x, z of the simulation (left_handed)" in alone
