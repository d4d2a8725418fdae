"""What may be the inexactness of a far larger effect: filters and clocks alone, by how much they explain."""

from __future__ import annotations

import pytest

from imutool.diagnosis.estimation.model_error_floor import EXACT, FILTERED, FOLLOWING, LEFT_OUT, below_model_error
from imutool.sensor import catalogue


def test_every_effect_that_is_asked_for_its_faintness_is_in_the_catalogue() -> None:
    assert {one.name for one in catalogue.diagnosed(sorted(FOLLOWING | set(LEFT_OUT)))} == FOLLOWING | set(LEFT_OUT)


@pytest.mark.parametrize(("exact", "allowed"), [(True, EXACT), (False, FILTERED)])
def test_a_filter_or_a_clock_must_explain_more_than_a_larger_models_error(exact: bool, allowed: float) -> None:
    for name in FOLLOWING:
        assert below_model_error({"lever_arm": 1e8, name: 0.9e8 * allowed}, exact) == {name}
        assert not below_model_error({"lever_arm": 1e8, name: 1.1e8 * allowed}, exact)


def test_a_mass_on_springs_does_more_than_its_model_says() -> None:
    between = 0.5 * LEFT_OUT["mount_resonance"]
    assert below_model_error({"mount_resonance": 1.0, "clock_offset": between}, exact=True) == {"clock_offset"}
    assert not below_model_error({"lever_arm": 1.0, "clock_offset": between}, exact=True)


def test_what_does_not_follow_the_motion_is_told_however_faint() -> None:
    assert not below_model_error({"timestamp_jitter": 1e9, "temperature": 300.0, "gyro_scale": 30.0}, exact=False)


def test_an_effect_alone_is_told() -> None:
    assert not below_model_error({"clock_offset": 25.0}, exact=False)
    assert not below_model_error({}, exact=True)
