"""What another order of the effects of a sensor changes is no finding, and is part of the deviations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import planted

from imutool.diagnosis.estimation.gauss_newton import fit
from imutool.diagnosis.estimation.model_selection import select_effects
from imutool.diagnosis.estimation.trial.effect_order import INSTANT, order_squares, order_std
from imutool.sensor import catalogue
from imutool.sensor.effect import Effect

SURE, INVERSE = 4.0, 0.05  # deviations; of an arm that is computed with rates off by 3 %
MISALIGNMENT, QUADRATIC = [0.01, -0.02, 0.005, 0.015, -0.01, 0.02], [0.02, -0.016, 0.024]
ARM_AND_SCALE = {"gyro_scale", "lever_arm"}
LOOK_ALIKE = "gyro_g_sensitivity", "gyro_scale_asymmetry", "gyro_bias_step"


def among(*names: str) -> tuple[Effect, ...]:
    return tuple(effect for effect in planted.catalogue() if effect.key in names)


def test_effects_whose_order_is_reversed_are_in_the_catalogue() -> None:
    assert {effect.name for effect in catalogue.diagnosed(sorted(INSTANT))} == INSTANT


def test_errors_of_the_true_rate_are_found_without_others() -> None:
    """The model has k (M omega)^2, the sensor k omega^2: what differs was a step of the bias and a g-sensitivity."""
    felt = planted.rich()
    motion = replace(felt, gyro=3.0 * felt.gyro, alpha=3.0 * felt.alpha)
    planted_effects = {"gyro_misalignment": MISALIGNMENT, "gyro_quadratic": QUADRATIC}
    alone = [planted.ideal(motion, planted.acting({name: theta})) for name, theta in planted_effects.items()]
    pair = planted.pair(motion, {}, 3, added=sum(one - planted.ideal(motion) for one in alone))
    found = {e.effect.name: e for e in select_effects([planted.weighed(pair)], among(*planted_effects, *LOOK_ALIKE)).selected}
    assert found.keys() == planted_effects.keys()
    for name, theta in planted_effects.items():
        assert (np.abs(found[name].theta - theta) < SURE * found[name].std).all()


@pytest.mark.parametrize("arm", [[0.06, -0.05, 0.04], [0.1, -0.08, 0.05]])
def test_a_simulation_with_a_scale_and_an_arm_has_no_size_effect(arm: list[float]) -> None:
    """The inverse effects act on it in the reverse order: the arm of too fast a body was another one for each axis.

    An arm of 10 cm next to all nine numbers of a size effect was left out for them, and these were implausible then.
    """
    slow = planted.rich()
    felt = replace(slow, gyro=2.0 * slow.gyro, alpha=2.0 * slow.alpha)
    scaled = 1.0 + np.array([0.03, -0.03, 0.03])
    off = planted.ideal(felt, planted.acting({"lever_arm": arm}))
    wrong = replace(felt, gyro=felt.gyro * scaled, alpha=felt.alpha * scaled, accel=off[:, 3:])
    pair = planted.pair(wrong, {}, 3, added=planted.ideal(felt) - planted.ideal(wrong))
    found = {e.effect.name: e for e in select_effects([planted.weighed(pair)], among(*ARM_AND_SCALE, "size_effect")).selected}
    assert found.keys() == ARM_AND_SCALE
    assert found["lever_arm"].theta == pytest.approx(-np.array(arm), rel=INVERSE)


def test_sizes_are_as_unsure_as_the_order_of_a_scale_and_a_misalignment() -> None:
    """(1 + s_i) m_ij, m_ij (1 + s_j) or m_ij is what y adds to x; a 3 x 3 matrix leaves nothing else."""
    s, m = np.array([0.03, -0.02, 0.01]), np.array(MISALIGNMENT)
    log = planted.weighed(planted.pair(planted.rich(), effects := {"gyro_scale": s, "gyro_misalignment": m}))
    found = fit([log], planted.acting(effects))
    i, j = np.nonzero(~np.eye(3, dtype=bool))
    theta = dict(zip(found.keys, (theta for _, theta in found.chosen), strict=True))
    reverse, added = (
        theta["gyro_misalignment"] * change
        for change in (theta["gyro_scale"][j] - theta["gyro_scale"][i], -theta["gyro_scale"][i])
    )
    assert order_std(found)["gyro_misalignment"] == pytest.approx(np.hypot(reverse, added), rel=0.1)
    with_arm = fit([log], (*found.chosen, *planted.acting({"gyro_quadratic": [0.0] * 3})))
    assert order_squares(with_arm, with_arm.chosen[-1][0]) < 1.0
    assert order_std(fit([log], found.chosen[:1])) == {}
