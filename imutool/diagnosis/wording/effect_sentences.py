"""Sentence of each effect: what it does to the reading, with its numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from imutool.diagnosis.result import Diagnosis, Finding
from imutool.diagnosis.wording.quantity import SHOWN, Quantity, distinguished, grouped, stated_parameters
from imutool.recording import GRAVITY_M_S2


@dataclass(frozen=True)
class Words:
    """Words of a sentence: pronoun of the signal, name of the reference, quantities."""

    it: str  # pronoun of the signal
    other: str  # name of the reference
    by_poses: bool  # whether that is true poses
    main: Quantity
    rest: tuple[Quantity, ...]
    finding: Finding

    def left_out(self, text: str) -> str:
        """Quantities that the sentence does not mention; a curve's coefficients are never listed."""
        unmentioned = (
            () if self.finding.curve is not None else tuple(quantity for quantity in self.rest if str(quantity) not in text)
        )
        return "".join(f", {quantity.labelled}" for quantity in unmentioned)


def _actuator_delay(w: Words) -> str:
    """A command that acts late; or an effort that is measured, and logged late."""
    what, when = ("is logged", "acts") if w.main.sign < 0 else ("acts", "is commanded")
    return f"the effort {what} {w.main.size} after it {when}"


def _bias_drift(w: Words) -> str:
    """Size of a warm-up, or rate of a drift whose end the log does not show."""
    return f"its bias drifts by {w.main}{' in all' if w.rest else ', steadily'}"


def _unknown(w: Words) -> str:
    """An equation with its coefficients, or a curve that has none."""
    curve = w.finding.curve
    if curve is not None:
        return f"{w.it} follows a smooth curve of {curve.variable} that has no name among the known effects"
    return (
        f"{w.finding.equation}, with {w.main.labelled}; {_convention(w.finding) or 'this has no name among the known effects'}"
    )


CONVENTIONS = {  # gain of an axis that is off by nothing but a convention, by signal
    **{("gyro", -1.0): "its sign is reversed", ("accel", -1.0): "its sign is reversed"},
    ("gyro", 180.0 / math.pi): "so it is in deg/s instead of rad/s",
    ("gyro", math.pi / 180.0): "so the other is in deg/s instead of rad/s",
    ("accel", 1.0 / GRAVITY_M_S2): "so it is in g instead of m/s²",
    ("accel", GRAVITY_M_S2): "so the other is in g instead of m/s²",
}
OF_POSES = f"the {GRAVITY_M_S2:g} m/s² that poses are given"  # which know none of their own: the place on Earth has another
OF_CONVENTION = 0.03  # of such a gain: the scale of an uncalibrated sensor


def _wrong_unit(w: Words) -> str:
    """The unit that a factor stands for."""
    scale = w.finding.parameters["scale"].value
    text = next(text for (signal, gain), text in CONVENTIONS.items() if signal == w.finding.signal and _near(scale, gain))
    return f"{w.it} reads {w.main} of {w.other}, {text}"


def _convention(finding: Finding) -> str:
    """Convention that explains a term of an axis' own reading, empty without one."""
    own = {"gyro": "omega", "accel": "f"}.get(finding.signal)
    c = finding.parameters.get("c")
    if c is None or finding.equation != f"{finding.signal}.{finding.axis} += c {own}_{finding.axis}":
        return ""
    texts = (text for (signal, gain), text in CONVENTIONS.items() if signal == finding.signal and _near(1.0 + c.value, gain))
    return next(texts, "")


def _near(gain: float, other: float) -> bool:
    return abs(gain - other) < OF_CONVENTION * abs(other)


def _hysteresis(w: Words) -> str:
    """Of the whole reading, of a share of it, or of a material that is stiffer to small motions (a negative share)."""
    share = w.finding.parameters.get("share")
    if share is None:
        return f"{w.it} follows only once {w.other} has moved by {w.main}, and stays that far behind"
    if share.value < 0.0:
        return f"{w.it} reads motion of less than {w.main} larger than wider motion"
    return f"{w.rest[0] if w.rest else 'a part'} of it follows only once {w.other} has moved by {w.main}"


def _mount_resonance(w: Words) -> str:
    """A resonance that the motion excites, or one that shocks excite, which no sample predicts."""
    if has_gain(w.finding):
        return f"the mount swings at {w.main}"
    return f"the mount rings after shocks at {w.main}, which no sample predicts"


def _low_pass(w: Words) -> str:
    """Cut-off of a filter, and its order."""
    order = w.finding.parameters.get("order")
    first = "exponential smoothing" if "smoothing_rate" in w.finding.parameters else "first-order low-pass"
    form = first if order is None else f"low-pass of order {order.value:g}" if order.value else "moving average"
    return f"{w.it} is too slow for what happens above {w.main} ({form})"


def _reference_error(w: Words) -> str:
    """Short wrong intervals, or an attitude that is turned throughout."""
    if any(name.startswith("turned_") for name in w.finding.parameters):
        return f"the attitude of the true poses is wrong, not the sensor: it is turned by {w.main} against gyro and gravity"
    return f"the reference is wrong, not the sensor, {w.main.labelled}"


SENTENCES: Mapping[str, str | Callable[[Words], str]] = {
    "gyro_bias": "{w.it} reads a constant {w.main} too much",
    "accel_bias": "{w.it} reads a constant {w.main} too much",
    "gyro_scale": (scale := lambda w: f"its scale is off by {w.main}{f' from {w.rest[0]} on' if w.rest else ''}"),
    "accel_scale": scale,
    "gyro_scale_asymmetry": "its scale for positive readings exceeds that for negative ones by {w.main}",
    "accel_scale_asymmetry": "its scale for positive readings exceeds that for negative ones by {w.main}",
    "gyro_misalignment": "its axes are not square: one shows on another by {w.main}",
    "accel_misalignment": "its axes are not square: one shows on another by {w.main}",
    "gyro_g_sensitivity": "{w.it} feels the specific force, with {w.main}",
    "gyro_quadratic": "its error grows with the square of the rate, by {w.main}",
    "accel_quadratic": "its error grows with the square of the specific force, by {w.main}",
    "gyro_bias_drift": _bias_drift,
    "accel_bias_drift": _bias_drift,
    "gyro_bias_step": (step := lambda w: f"its bias steps by {w.main}{f' at {w.rest[0]}' if w.rest else ''}"),
    "accel_bias_step": step,
    "rate_curve": "{w.it} errs by a curve of the rate, with {w.main}",
    "vibration_rectification": "{w.it} turns vibration into a constant, with {w.main}",
    "lever_arm": "{w.it} sits {w.main} from the tracked point",
    "size_effect": "its three axes sit apart, by {w.main}",
    "mount_rotation": lambda w: f"{w.it} is mounted turned by {w.main}{f' from {w.rest[0]} on' if w.rest else ''}",
    # tau > 0: a sample shows what happens later, so the reading is ahead
    "clock_offset": lambda w: f"{w.it} {'lags' if w.main.sign < 0 else 'is ahead of'} {w.other} by {w.main.size}",
    # t (1 + eps): eps > 0 puts more motion between two stamps than they say
    "clock_skew": lambda w: f"the clock of the recording runs {'slow' if w.main.sign > 0 else 'fast'} by {w.main.size}",
    "clock_jump": lambda w: f"the clock of the recording jumps{f' by {w.rest[0]}' if w.rest else ''} at {w.main}",
    "clock_wander": "the clock of the recording wanders, by {w.main}",
    "gyro_delay": lambda w: f"{w.it} {'is ahead of' if w.main.sign < 0 else 'lags'} the motion by {w.main.size}",
    "gyro_hysteresis": _hysteresis,
    "accel_hysteresis": _hysteresis,
    "gyro_dead_band": "{w.it} reads zero below {w.main}",
    "low_pass": _low_pass,
    "second_order_low_pass": "{w.it} is too slow for fast motion, {w.main.labelled} (second-order low-pass)",
    "saturation": "{w.it} stops at its limit of {w.main}",
    "quantization": "{w.it} comes in steps of {w.main}",
    "gravity": lambda w: f"gravity differs from {OF_POSES if w.by_poses else f'that of {w.other}'}, {w.main.labelled}",
    "earth_rotation": "{w.it} feels the Earth turn, {w.main.labelled}",
    "vibration": "{w.it} vibrates at {w.main}",
    "mount_resonance": _mount_resonance,
    "gyro_scale_drift": "its scale grows by {w.main}",
    "gyro_scale_temperature": "its scale follows the temperature, by {w.main}",
    "temperature": "{w.it} follows the temperature, with {w.main}",
    "dropped_samples": "samples are missing, {w.main.labelled}",
    "timestamp_jitter": "its time stamps jitter, {w.main.labelled}",
    "reference_error": _reference_error,
    "reference_smoothing": "the true poses are smoothed, and slower than the body, by {w.main.labelled}",
    "wrong_unit": _wrong_unit,
    "left_handed": "its axes are left-handed: {w.finding.equation}",
    "permuted_axes": "its axes are in another order: {w.finding.equation}",
    "gain": "its gain is {w.main} of that of {w.other}",
    "offset": "{w.it} reads a constant {w.main} too much",
    "delay": lambda w: f"{w.it} {'comes before' if w.main.sign < 0 else 'lags'} {w.other} by {w.main.size}",
    "dead_band": "{w.it} stays still within {w.main} of rest",
    "drift": lambda w: f"{w.it} drifts {'along a smooth curve of the time' if w.finding.curve else f'by {w.main}'}",
    "friction": "{w.it} is held back by friction of {w.main}, which turns with the sign of the motion",
    "coulomb_friction": "{w.it} lacks dry friction of {w.main}",
    "viscous_friction": "{w.it} lacks friction that grows with the velocity, by {w.main}",
    "stribeck_friction": "{w.it} lacks friction near rest, {w.main.labelled}",
    "payload": "the arm carries {w.main} that the simulation does not know",
    "rotor_inertia": "the rotor has an inertia of {w.main} that the simulation lacks",
    "actuator_delay": _actuator_delay,
    "actuator_gain": "the actuator gives {w.main} of what is commanded",
    "actuator_dead_band": "the actuator loses the first {w.main} of a command",
    "torque_saturation": "the actuator gives no more than {w.main}",
    "gear_ripple": "the gear ripples with the angle, {w.main.labelled}",
    "encoder_offset": "the encoder reads {w.main} too much",
    "eccentricity": "the encoder sits off its axis, {w.main.labelled}",
    "backlash": "the transmission has a play of {w.main}",
    "compliance": "the transmission gives way by {w.main}",
    "wheel_radius": "the wheels have other radii than in the simulation, {w.main.labelled}",
    "track_width": "the track differs from that of the simulation by {w.main} of it",
    "wheel_slip": "the wheels slip, {w.main.labelled}",
    "hard_iron": "the field has a constant from iron on board of {w.main}",
    "soft_iron": "iron on board bends the field, {w.main.labelled}",
    "magnetometer_misalignment": "the magnetometer is mounted turned by {w.main}",
    "declination": "the field of the simulation is turned about the vertical by {w.main}",
    "dynamic_pressure": "the barometer feels the wind of its own motion, {w.main.labelled}",
    "pressure_temperature": "the barometer follows the temperature, with {w.main}",
    "gnss_lever_arm": "the antenna sits {w.main} from the tracked point",
    "latency": "{w.it} lags {w.other} by {w.main}",
    "driven": lambda w: f"{w.it} follows {w.finding.driver or 'another channel of the log'} with {w.main.labelled}",
    "unknown": _unknown,
}
"""By effect, what it does to a reading. What a sentence leaves out of its quantities is added behind it."""


def named_sentence(d: Diagnosis, finding: Finding) -> str:
    """Sentence of a finding with its name: `it lags the simulation by 12 ms (clock_offset)`."""
    could = f"; could as well be {' or '.join(finding.similar)}" if finding.similar else ""
    return f"{effect_sentence(d, finding)} ({finding.effect}{could})"


def effect_sentence(d: Diagnosis, finding: Finding) -> str:
    """What a finding does to the reading, with its numbers."""
    parameters, small = distinguished(stated_parameters(finding))
    quantities = grouped(parameters)
    main = quantities[0] if quantities else Quantity("", (), ())
    words = Words(_pronoun(finding.signal), reference(d), d.sim is None, main, tuple(quantities[1:]), finding)
    template = SENTENCES.get(finding.effect)
    needs_quantity = finding.curve is None if callable(template) else "{w.main" in (template or "")
    if template is None or (needs_quantity and not quantities):
        text = f"{words.it} shows {finding.effect}, {finding.equation}"
        text += f", {main.labelled}" if quantities else ""
    else:
        text = template(words) if callable(template) else template.format(w=words)
    return f"{text}{words.left_out(text)}{indistinct(small)}"


def indistinct(names: Sequence[str]) -> str:
    """Clause on parameters that are smaller than their deviation, empty without any."""
    if not names:
        return ""
    shown = ", ".join(names) if len(names) <= SHOWN else f"{len(names)} parameters"
    return f"; {shown} not distinguished from zero"


def label(finding: Finding) -> str:
    """Name of the effect, with its driver if it has one."""
    return f"{finding.effect} by {finding.driver}" if finding.driver else finding.effect


def has_gain(finding: Finding) -> bool:
    """Whether it removes misfit: missing samples and digits do not, nor does a wrong reference."""
    return finding.held_out.rms_before > 0.0 and finding.effect != "reference_error"


def parameters_text(finding: Finding) -> str:
    """Quantities of a finding: `r (0.213, -0.051, 0.120) ± 0.004 m`; of a curve its variable."""
    if finding.curve is not None:
        return f"a curve of {finding.curve.variable}"
    parameters, small = distinguished(stated_parameters(finding))
    return (", ".join(q.labelled for q in grouped(parameters)) or finding.equation) + indistinct(small)


def signals(signal: str) -> tuple[str, ...]:
    """Single signals of a finding: gyro and accel for `both`; any other signal alone."""
    if signal in {"both", "imu"}:
        return ("gyro", "accel")
    return tuple(part for part in re.split(r"\s*(?:\+|,|\band\b)\s*", signal) if part) or (signal,)


def _pronoun(signal: str) -> str:
    return "it" if len(signals(signal)) == 1 else "the sensor"


def reference(d: Diagnosis) -> str:
    """The simulation, or the true poses."""
    return "the simulation" if d.sim is not None else "the true poses"
