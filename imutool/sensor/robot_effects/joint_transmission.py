"""Transmission and encoder of a joint: ripple, offset, eccentricity, backlash, compliance.

A gear's torque ripples with its angle (Ghorbel, Gandhi, Alpeter, On the kinematic error in harmonic drive gears, 2001); an
eccentric encoder disc reads q + a sin(q) + b cos(q); play and a spring lie between motor and link (Nordin and Gutman,
Controlling mechanical systems with backlash, Automatica 38, 2002).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import next_fast_len, rfft

from imutool.sensor.effect import Effect, Parameter, Stage, Theta
from imutool.sensor.robot_effects.signal_samples import IdealSignal, Samples, SignalSamples
from imutool.sensor.robot_effects.signal_sizes import Scale

MAX_TEETH, MIN_TURNS = 120.0, 1.5  # ripples a turn that are tried, and how many of them the motion has to show
STARTS = 2
BINS_A_RADIAN = 4.0 * MAX_TEETH / np.pi  # eight to the shortest ripple
MAX_BINS, FINER = 2**19, 7  # some 500 turns; so much closer than they are told apart are ripples tried
PLAUSIBLE_RAD = 0.05
MAX_ECCENTRIC = 0.3  # of its radius, that a disc is off its centre: beyond, a reading has several angles before long
ROUNDS = 4  # to an angle from its reading: each leaves as much of the error as the disc is off its centre, of 0.1 rad 1e-5
GAPS = (0.3, 1.0, 1.5)  # of a joint's play to start from, over twice the deviation of the misfit


# ── in the effort ──


@dataclass(frozen=True)
class _Ripple:
    joint: int

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        angle = theta[2] * s.state[f"q{self.joint}"]
        return s.with_added(self.joint, theta[0] * np.sin(angle) + theta[1] * np.cos(angle))

    def starts(self, ideal: IdealSignal, real: Any) -> list[Theta]:
        """The strongest ripples of what smooth terms leave."""
        s = ideal.sample(real.stamp_s, real.stamp_s)
        q, dq, ddq = (s.state[f"{kind}{self.joint}"] for kind in ("q", "dq", "ddq"))
        smooth = np.stack(
            [np.ones(len(q)), q, dq, np.sign(dq), ddq, np.sin(q), np.cos(q), s.x[:, self.joint], s.dx[:, self.joint]], axis=1
        )
        residual = real.y[:, self.joint] - s.x[:, self.joint]
        residual = residual - smooth @ np.linalg.lstsq(smooth, residual, rcond=None)[0]
        bins = np.floor((q - q.min()) * BINS_A_RADIAN)
        near, shift = bins < MAX_BINS, float(q.min()) + 0.5 / BINS_A_RADIAN
        sums = np.bincount(bins[near].astype(int), residual[near])
        length = next_fast_len(FINER * len(sums), real=True)
        per_turn = 2.0 * np.pi * BINS_A_RADIAN / length * np.arange(length // 2 + 1)
        tried = (per_turn >= max(2.0, MIN_TURNS * 2.0 * np.pi * BINS_A_RADIAN / len(sums))) & (per_turn < MAX_TEETH)
        if not tried.any():
            return [np.array([0.0, 0.0, 2.0])]
        waves = (np.conj(rfft(sums, length)) * np.exp(1j * per_turn * shift))[tried] * 2.0 / near.sum()
        best, per_turn = np.argsort(-np.abs(waves))[:STARTS], per_turn[tried]
        return [np.array([waves[b].imag, waves[b].real, per_turn[b]]) for b in best]


# ── in the angle that the encoder reads: the motion itself is another ──


@dataclass(frozen=True)
class _Angle:
    joint: int
    eccentric: bool

    def __call__(self, ideal: IdealSignal, theta: Theta) -> IdealSignal:
        q, dq, ddq = (ideal.state[f"{kind}{self.joint}"] for kind in ("q", "dq", "ddq"))
        if not self.eccentric:
            return ideal.with_state(**{f"q{self.joint}": q - theta[0]})
        if np.hypot(*theta) > MAX_ECCENTRIC:
            return ideal
        angle = q  # that of the joint: where its disc reads q
        for _ in range(ROUNDS):
            angle = q - theta[0] * np.sin(angle) - theta[1] * np.cos(angle)
        rate = 1.0 + theta[0] * np.cos(angle) - theta[1] * np.sin(angle)
        bend = theta[0] * np.sin(angle) + theta[1] * np.cos(angle)
        changed = {"q": angle, "dq": dq / rate, "ddq": (ddq + bend * (dq / rate) ** 2) / rate}
        return ideal.with_state(**{f"{kind}{self.joint}": values for kind, values in changed.items()})


def effects(scale: Scale) -> Iterator[Effect]:
    """Ripple, encoder offset and eccentricity of each joint, in its effort."""
    for k in scale.columns:
        size, ripple = 0.5 * scale.size[k], _Ripple(k)
        waves = (Parameter("sine", scale.units[k], size), Parameter("cosine", scale.units[k], size))
        per_turn = Parameter("per_turn", "1/turn", MAX_TEETH, step=0.02, null_value=0.0)
        yield scale.effect(
            "gear_ripple",
            (k,),
            "effort += sine sin(per_turn q) + cosine cos(per_turn q)",
            (*waves, per_turn),
            ripple,
            "the joint turns through several ripples",
            starts=ripple.starts,
            alternatives=lambda _: round(MAX_TEETH),
        )
        if scale.dynamics is None:
            continue
        yield scale.effect(
            "encoder_offset",
            (k,),
            "the angle read = angle + offset",
            (Parameter("offset", "rad", PLAUSIBLE_RAD),),
            _Angle(k, eccentric=False),
            "gravity or the other joints depend on the angle",
            stage=Stage.MOUNT,
            starts=[np.zeros(1)],
        )
        yield scale.effect(
            "eccentricity",
            (k,),
            "the angle read = angle + sine sin(angle) + cosine cos(angle)",
            (Parameter("sine", "rad", PLAUSIBLE_RAD), Parameter("cosine", "rad", PLAUSIBLE_RAD)),
            _Angle(k, eccentric=True),
            "the joint turns through most of a circle",
            stage=Stage.MOUNT,
            starts=[np.zeros(2)],
        )


# ── in the position ──


def play(x: Samples, width: float) -> Samples:
    """Backlash operator: the output rests until the input has crossed the gap."""
    out, output, half = np.empty(len(x)), float(x[0]), 0.5 * width
    for i, value in enumerate(x.tolist()):
        output = min(max(output, value - half), value + half)
        out[i] = output
    return out


def _gaps(ideal: IdealSignal, real: Any) -> list[Theta]:
    """Gaps to start from: with play the misfit is half a gap, on either side."""
    gap = 2.0 * float((real.y[:, 0] - ideal.sample(real.stamp_s, real.stamp_s).x[:, 0]).std())
    return [np.array([share * gap]) for share in GAPS]


def position_effects(scale: Scale) -> Iterator[Effect]:
    """Backlash, compliance and eccentricity of a joint whose position alone is compared."""
    size = scale.size[0]
    yield scale.effect(
        "backlash",
        (0,),
        "the position rests until the drive has crossed the gap",
        (Parameter("gap", scale.units[0], size, positive=True, step=0.02),),
        lambda s, theta: s.with_column(0, play(s.y[:, 0], theta[0])),
        "the joint turns both ways",
        starts=_gaps,
    )
    yield scale.effect(
        "eccentricity",
        (0,),
        "position += sine sin(position) + cosine cos(position)",
        (Parameter("sine", scale.units[0], PLAUSIBLE_RAD), Parameter("cosine", scale.units[0], PLAUSIBLE_RAD)),
        lambda s, theta: s.with_added(0, theta[0] * np.sin(s.x[:, 0]) + theta[1] * np.cos(s.x[:, 0])),
        "the joint turns through most of a circle",
    )
    if "effort" in scale.state:
        yield scale.effect(
            "compliance",
            (0,),
            "position -= effort compliance",
            (Parameter("compliance", "rad/(N m)", 0.5 * size / scale.state["effort"]),),
            lambda s, theta: s.with_added(0, -theta[0] * s.state["effort"]),
            "the effort varies otherwise than the position",
        )
