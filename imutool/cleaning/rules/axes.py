"""Axes that contradict poses or gravity; poses with another axis up or in another unit.

The poses decide where they can. Without them gravity, as the accelerometer reads it, decides how the gyro's axes lie to the
accelerometer's; which of the two is wrong it cannot say, and the proposal changes the gyro.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from imutool.array_types import Float64
from imutool.cleaning.conventions import Conventions
from imutool.cleaning.finding import Finding
from imutool.cleaning.likelihood import Reading, axis_names
from imutool.cleaning.pose_delay import Delay, lateness
from imutool.cleaning.rule import Rule, TopicSummary

DISTRUST = "the axes of {} contradict {}"
LATE_S, LATE_STDS = 0.03, 5.0  # a delay of the poses from which on it is a warning
FIXED = 0.8  # of that, the delay from which on `fix` corrects it, so that it leaves nothing of which a later command warns
TO_Z_UP = {  # rotations of the world after which z is up
    "-z": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),  # NED to ENU
    "+y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "+x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
}


class Axes(Rule):
    """Rule for axes and frames; it runs after `units`, and proposes what `fix` then does."""

    place = 130

    def findings(self, whole: TopicSummary) -> Iterator[Finding]:
        """Findings about the sensors' axes, the poses' world, and the poses' clock."""
        found = whole.conventions
        if found.quaternions:  # any other finding would be of poses that the log does not hold
            whole.quaternions = found.quaternions
            what = f"the quaternions of the poses {found.topic} {found.quaternions}"
            values = {"poses": found.topic, "fix": "quaternions w, x, y, z"}
            yield Finding("axes", "warning", what, 1, values=values, confidence=0.95)
            return
        fixed = whole.settings.fix
        for finding, gyro, accel in _sensors(found):
            if found.gyro is not None and "mount" in finding.values:
                whole.mount = found.gyro.axes
            proposed = gyro is not None or accel is not None
            if fixed and proposed:
                whole.axes[0] = whole.axes[0] if gyro is None else gyro
                whole.axes[1] = whole.axes[1] if accel is None else accel
                yield Finding(
                    "axes", "warning", finding.what, finding.count, values=finding.values, action="converted", confidence=0.95
                )
            else:
                yield finding
        if found.up is not None and found.up != "+z":
            whole.world = TO_Z_UP[found.up]
            name = " (as in NED)" if found.up == "-z" else ""
            if_right = "" if found.accel is not None else ", if the accelerometer counts as it should"
            what = f"the world of the poses {found.topic} has {found.up} up{name}, not +z{if_right}"
            values = {"poses": found.topic, "fix": f"turn the world: z up instead of {found.up}"}
            yield Finding("axes", "warning", what, 1, values=values, confidence=0.95)
        if found.unit != "m":
            whole.position_unit = found.unit
            what = f"the positions of the poses {found.topic} are in {found.unit} and not in m, by the accelerometer"
            values = {"poses": found.topic, "fix": f"{found.unit} to m"}
            yield Finding("axes", "warning", what, 1, values=values, confidence=0.95)
        if found.delay is not None:
            yield from _clock(found.delay, found.topic, whole)


def _clock(delay: Delay, topic: str, whole: TopicSummary) -> Iterator[Finding]:
    """Finding about poses that are late, or of which one part is; that no shift corrects."""
    if delay.step is not None:
        if whole.jumps:  # told by `clock_jumps`
            return
        before, after, at_ns = delay.step
        about_s, size = (at_ns - (whole.motion.start_ns or 0)) * 1e-9, f"{1e3 * abs(after - before):.0f} ms"
        what = (
            f"the clock of the IMU or that of the poses {topic} steps by {size} about {about_s:.0f} s after the start:"
            f" by the gyro the poses are {lateness(before)} before it, and {lateness(after)} after it"
        )
        yield Finding("axes", "warning", what, 1, values={"steps": topic}, confidence=0.9)
    elif abs(delay.seconds) > (FIXED if whole.settings.fix else 1.0) * max(LATE_S, LATE_STDS * delay.std_s):
        whole.pose_delay_ns = round(delay.seconds * 1e9)
        size = f"{lateness(delay.seconds)} (standard deviation {1e3 * delay.std_s:.1f} ms)"
        what = f"the stamps of the poses {topic} are {size} by the gyro"
        yield Finding("axes", "warning", what, 1, values={"fix": "move the stamps of the poses"}, confidence=0.9)


Proposal = tuple[Finding, Float64[np.ndarray, "3 3"] | None, Float64[np.ndarray, "3 3"] | None]


def _sensors(found: Conventions) -> Iterator[Proposal]:
    """Findings about the axes, each with the axes proposed for gyro and accel."""
    gyro, accel, relative = found.gyro, found.accel, found.relative
    if gyro is None:
        if relative is not None and relative.wrong:
            yield _wrong("gyro", relative, "gravity as accel reads it"), relative.axes, None
        return
    if not gyro.sole:
        if gyro.wrong:
            yield _wrong("gyro", gyro, "the true poses"), None, None
        return
    together = accel is not None and (accel.axes == gyro.axes).all()
    if accel is None and relative is not None:
        together = relative.as_is
    if together and np.linalg.det(gyro.axes) > 0:
        if gyro.wrong:
            names = axis_names(gyro.axes)
            what = f"the body of the true poses is not the IMU's: its x, y, z seem to be the IMU's {names}"
            yield Finding("axes", "note", what, 3, values={"mount": names, "fix": names}, confidence=0.8), None, None
        return
    if gyro.wrong:  # where nothing is known of the other sensor, it may still be the mount
        known = accel is not None or (relative is not None and (relative.axes == gyro.axes).all())
        yield _wrong("gyro", gyro, "the true poses", alone=not known), gyro.axes if known else None, None
    if accel is not None and accel.wrong:
        yield _wrong("accel", accel, "the true poses"), None, accel.axes


def _wrong(sensor: str, reading: Reading, against: str, *, alone: bool = False) -> Finding:
    """Finding about the axes of one sensor; `alone`: it may be the mount of both."""
    values = {"sensor": sensor, "reading": reading.names, "misfit": reading.misfit, "misfit_as_is": reading.misfit_as_is}
    fix = {} if alone or not reading.sole else {"fix": f"{sensor} {reading.names}"}
    return Finding(
        "axes",
        "warning" if alone else "error",
        f"{sensor} contradicts {against}: its true x, y, z seem to be its {reading.names}",
        int((np.abs(reading.axes - np.eye(3)).sum(axis=1) > 0).sum()),
        values=values | {"certain": reading.certain} | fix,
        confidence=0.5 if alone else 0.95,
        distrust="" if alone else DISTRUST.format(sensor, against),
    )
