"""What is too faint beside a far larger effect to be told from what that one's model, or a filtered simulation, leaves out.

A filter and a clock say how a sensor follows its motion, and so does whatever a model of something else gets not quite right:
a mass on springs moves, and its lever arm with it; a simulator that holds its forces for a step reads accelerations half a step
early; noise that was filtered out of a simulation took a little of its motion along. Such errors are a share of the large
effect, certain as they may be against the noise, and no physics of their own.
"""

from __future__ import annotations

from collections.abc import Mapping

FOLLOWING = frozenset({"clock_offset", "clock_skew", "clock_jump", "low_pass", "mount_resonance"})
EXACT, FILTERED = 1e-5, 1e-3  # of the squares that the largest effect takes: 0.3 % and 3 % of its size
LEFT_OUT = {"mount_resonance": 1e-2}  # by models that are known to be simpler than what they stand for


def below_model_error(gains: Mapping[str, float], exact: bool) -> frozenset[str]:
    """Effects that follow the motion, and explain no more than another one's model may be wrong by.

    `gains` are the squares that leaving an effect out would cost; `exact`: what was expected holds no noise of a simulation.
    """
    allowed = EXACT if exact else FILTERED
    return frozenset(
        name
        for name, gain in gains.items()
        if name in FOLLOWING
        and any(gain < max(allowed, LEFT_OUT.get(one, 0.0)) * more for one, more in gains.items() if one != name)
    )
