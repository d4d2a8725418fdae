"""Terms without a name: the sparsest equation over the channels of a log.

The library has powers, products, sines, and forms with a scale s of their own (Brunton, Proctor, Kutz, Discovering governing
equations from data by sparse identification, PNAS 113, 2016; the scales are fitted by Gauss-Newton, not by a grid). The search
is that of all effects: one term at a time, against curves, on unseen time.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.signals.aligned_signal import AlignedSignal
from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.signal_samples import Samples, SignalSamples

WORDS = {"ddq": "acceleration", "dq": "velocity", "q": "position"}
MULTIPLES = (1, 2, 3, 4, 5)  # of an angle
SCALES = (0.4, 1.5)  # to start from, over the standard deviation
Form = Callable[..., Any]  # of one channel, of one and a scale, or of two

FORMS: Mapping[str, tuple[Form, str]] = {
    "{v}": (lambda v: v, "{0}"),
    "|{v}|": (np.abs, "np.abs({0})"),
    "{v} |{v}|": (lambda v: v * np.abs(v), "{0} * np.abs({0})"),
    "{v}^2": (lambda v: v**2, "{0} ** 2"),
    "{v}^3": (lambda v: v**3, "{0} ** 3"),
    "sqrt(|{v}|) sign({v})": (lambda v: np.sqrt(np.abs(v)) * np.sign(v), "np.sqrt(np.abs({0})) * np.sign({0})"),
}
SCALED: Mapping[str, tuple[Form, str]] = {
    "exp(-|{v}|/s)": (lambda v, s: np.exp(-np.abs(v) / s), "np.exp(-np.abs({0}) / s)"),
    "1/(1 + |{v}|/s)": (lambda v, s: 1.0 / (1.0 + np.abs(v) / s), "1.0 / (1.0 + np.abs({0}) / s)"),
    "1/(1 + ({v}/s)^2)": (lambda v, s: 1.0 / (1.0 + (v / s) ** 2), "1.0 / (1.0 + ({0} / s) ** 2)"),
    "tanh({v}/s)": (lambda v, s: np.tanh(v / s), "np.tanh({0} / s)"),
}


def channels(samples: SignalSamples, k: int) -> dict[str, Samples]:
    """Channels of a term by name: the joints' motion, or the ideal value, its rate and others."""
    if "q0" in samples.state:
        return {name: values for name, values in samples.state.items() if name.rstrip("0123456789") in WORDS}
    states = {name: values for name, values in samples.state.items() if not name.startswith(("R", "v"))}
    others = {name: samples.channel(name) for name in samples.channels}
    return {"x": samples.x[:, k], "dx/dt": samples.dx[:, k], **states, **others}


@dataclass(frozen=True)
class Term:
    """Forward model of c times a form of one or two channels, in one column.

    `code` is the form in Python, with the `words` of its channels.
    """

    column: int
    names: tuple[str, ...]
    form: Form
    code: str
    words: tuple[str, ...]

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        """The signal with the term on it."""
        return s.with_added(self.column, theta[0] * self.values(channels(s, self.column), theta))

    def values(self, by_name: Mapping[str, Samples], theta: Theta) -> Float64[np.ndarray, " n"]:
        """The form itself."""
        return np.asarray(self.form(*(by_name[name] for name in self.names), *theta[1:].tolist()))


def terms(signal: AlignedSignal, k: int) -> Iterator[Effect]:
    """Terms of the library in one column."""
    by_name, joints = channels(signal.sampled, k), "q0" in signal.sampled.state
    varying = [name for name, values in by_name.items() if np.ptp(values) > 0.0 and not _is_copy(signal, name, values)]
    if joints:  # what a joint feels depends on its own motion, and on another's by a product
        varying = [name for name in varying if not name.startswith("ddq")]
    simple = [name for name in varying if not joints or name.lstrip("dq") == str(k)]
    for name in simple:
        yield from _of_one(signal, k, name, by_name, is_angle=joints and name.startswith("q"))
    for at, name in enumerate(varying):
        for other in varying[at + 1 :]:
            if name in simple or other in simple:
                yield _effect(signal, k, (name, other), "{} {}", (lambda v, w: v * w, "{0} * {1}"), by_name)


def _is_copy(signal: AlignedSignal, name: str, values: Samples) -> bool:
    """Whether a channel is one of the recorded columns, or another copy: it would explain every misfit."""
    if name not in signal.ideal.channels:
        return False
    alike = (abs(float(np.corrcoef(values, column)[0, 1])) for column in signal.real.T)
    return name in signal.names or max(alike) > signal.settings.signal.copy_correlation


def _of_one(signal: AlignedSignal, k: int, name: str, by_name: Mapping[str, Samples], *, is_angle: bool) -> Iterator[Effect]:
    values = by_name[name]
    for text, form in FORMS.items():
        same = ("{v}", "|{v}|") if (values >= 0.0).all() or (values <= 0.0).all() else ("{v}",)
        if text in same and (name in ("x", "dx/dt") or name in signal.ideal.channels):
            continue  # a gain, a delay, and what another channel drives
        yield _effect(signal, k, (name,), text, form, by_name)
    for text, form in SCALED.items():
        yield _effect(signal, k, (name,), text, form, by_name, scale=float(values.std()))
    for n, (word, wave) in product(MULTIPLES if is_angle else (), (("sin", np.sin), ("cos", np.cos))):
        multiple = partial(_of_multiple, wave, n), f"np.{word}({n} * {{0}})"
        yield _effect(signal, k, (name,), f"{word}({{v}})" if n == 1 else f"{word}({n} {{v}})", multiple, by_name)


def _of_multiple(wave: Form, n: int, v: Samples) -> Any:
    return wave(n * v)


def _effect(
    signal: AlignedSignal,
    k: int,
    names: tuple[str, ...],
    text: str,
    form: tuple[Form, str],
    by_name: Mapping[str, Samples],
    scale: float | None = None,
) -> Effect:
    labels = [_label(signal, name) for name in names]
    term, text = Term(k, names, *form, tuple(map(_word, labels))), text.format(*labels, v=labels[0])
    size, unit = float(signal.sampled.x[:, k].std()), signal.units[k]
    theta = np.array([1.0] if scale is None else [1.0, scale])
    spread = max(float(np.std(term.values(by_name, theta))), 1e-12)
    c = Parameter("c", f"{unit or '1'} per unit of {text}", size / spread)
    numbers = (c,) if scale is None else (c, Parameter("s", "", scale, positive=True, step=0.02))
    starts = None if scale is None else [np.array([0.1 * size / spread, share * scale]) for share in SCALES]
    equation = f"{signal.names[k].rpartition('.')[2]} += c {text}"
    return signal.scale.effect(
        "unknown", (k,), equation, numbers, term, starts=starts, kind="unknown", variable=text, variant=text
    )


def _label(signal: AlignedSignal, name: str) -> str:
    """Name of a channel in a term: of a joint with its index in the message."""
    word = WORDS.get(name.rstrip("0123456789"))
    return name if word is None else f"{word}[{signal.joint(name)}]"


def python(effect: Effect, column: str) -> str:
    """A term as Python: a function of its channels and parameters; empty for a curve."""
    term = effect.forward
    if not isinstance(term, Term):
        return ""
    arguments = ", ".join([*term.words, *(number.name for number in effect.parameters)])
    return f"def {_word(column)}_added({arguments}):\n    return c * {term.code.format(*term.words)}"


def _word(text: str) -> str:
    """A name in Python."""
    word = re.sub(r"[^0-9A-Za-z]", "_", text).strip("_")
    return word if word[:1].isalpha() else f"_{word}"
