"""Terms without a name: the sparsest equation over the channels of a log.

The library has powers, products, sines, and forms with a scale s of their own (Brunton, Proctor, Kutz, Discovering governing
equations from data by sparse identification, PNAS 113, 2016; the scales are fitted by Gauss-Newton, not by a grid). The search
is that of all effects: one term at a time, against curves, on unseen time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imutool.array_types import Float64
from imutool.diagnosis.signals.aligned_signal import AlignedSignal
from imutool.sensor.effect import Effect, Parameter, Theta
from imutool.sensor.robot_effects.signal_samples import Samples, SignalSamples

WORDS = {"ddq": "acceleration", "dq": "velocity", "q": "position", "w": "wheel"}
MULTIPLES = (1, 2, 3, 4, 5)  # of an angle
SCALES = (0.4, 1.5)  # to start from, over the standard deviation
Form = Callable[[Any, float], Any]

FORMS: Mapping[str, tuple[Form, str]] = {
    "{v}": (lambda v, s: v, "{p}"),
    "|{v}|": (lambda v, s: np.abs(v), "np.abs({p})"),
    "{v} |{v}|": (lambda v, s: v * np.abs(v), "{p} * np.abs({p})"),
    "{v}^2": (lambda v, s: v**2, "{p} ** 2"),
    "{v}^3": (lambda v, s: v**3, "{p} ** 3"),
    "sqrt(|{v}|) sign({v})": (lambda v, s: np.sqrt(np.abs(v)) * np.sign(v), "np.sqrt(np.abs({p})) * np.sign({p})"),
}
SCALED: Mapping[str, tuple[Form, str]] = {
    "exp(-|{v}|/s)": (lambda v, s: np.exp(-np.abs(v) / s), "np.exp(-np.abs({p}) / s)"),
    "1/(1 + |{v}|/s)": (lambda v, s: 1.0 / (1.0 + np.abs(v) / s), "1.0 / (1.0 + np.abs({p}) / s)"),
    "1/(1 + ({v}/s)^2)": (lambda v, s: 1.0 / (1.0 + (v / s) ** 2), "1.0 / (1.0 + ({p} / s) ** 2)"),
    "tanh({v}/s)": (lambda v, s: np.tanh(v / s), "np.tanh({p} / s)"),
}


def channels(samples: SignalSamples, k: int) -> dict[str, Samples]:
    """Channels of a term by name: the state, or the ideal value, its rate and others."""
    if "q0" in samples.state:
        named = {
            (kind, name.removeprefix(kind)): name for name in samples.state for kind in ("ddq", "dq", "q") if _is(name, kind)
        }
        return {f"{WORDS[kind]}[{joint}]": samples.state[name] for (kind, joint), name in named.items()}
    states = {name: values for name, values in samples.state.items() if not name.startswith(("R", "v"))}
    others = {name: samples.channel(name) for name in samples.channels}
    return {"x": samples.x[:, k], "dx/dt": samples.dx[:, k], **states, **others}


def _is(name: str, kind: str) -> bool:
    return name.removeprefix(kind).isdigit() and name.startswith(kind)


@dataclass(frozen=True)
class Term:
    """Forward model of c times a form of one or two channels, in one column."""

    column: int
    names: tuple[str, ...]
    form: Form

    def __call__(self, s: SignalSamples, theta: Theta) -> SignalSamples:
        """The signal with the term on it."""
        return s.with_added(self.column, theta[0] * self.values(channels(s, self.column), theta))

    def values(self, by_name: Mapping[str, Samples], theta: Theta) -> Float64[np.ndarray, " n"]:
        """The form itself."""
        if len(self.names) == 2:
            return np.asarray(by_name[self.names[0]] * by_name[self.names[1]])
        return np.asarray(self.form(by_name[self.names[0]], float(theta[1]) if len(theta) > 1 else 1.0))


def terms(signal: AlignedSignal, k: int) -> Iterator[Effect]:
    """Terms of the library in one column."""
    by_name, own = channels(signal.sampled, k), signal.names[k].rpartition("[")[2].rstrip("]")
    varying = [name for name, values in by_name.items() if np.ptp(values) > 0.0 and not _is_copy(signal, name, values)]
    if own.isdigit():  # what a joint feels depends on its own motion, and on another's by a product
        varying = [name for name in varying if not name.startswith("acceleration")]
    simple = [name for name in varying if not own.isdigit() or name.endswith(f"[{own}]")]
    for name in simple:
        yield from _of_one(signal, k, name, by_name[name])
    for at, name in enumerate(varying):
        for other in varying[at + 1 :]:
            if name in simple or other in simple:
                yield _effect(signal, k, Term(k, (name, other), _product), f"{name} {other}", by_name)


def _is_copy(signal: AlignedSignal, name: str, values: Samples) -> bool:
    """Whether a channel is one of the recorded columns, or another copy: it would explain every misfit."""
    if name not in signal.ideal.channels:
        return False
    alike = (abs(float(np.corrcoef(values, column)[0, 1])) for column in signal.real.T)
    return name in signal.names or max(alike) > signal.settings.signal.copy_correlation


def _of_one(signal: AlignedSignal, k: int, name: str, values: Samples) -> Iterator[Effect]:
    by_name = {name: values}
    for text, (form, _) in FORMS.items():
        same = ("{v}", "|{v}|") if (values >= 0.0).all() or (values <= 0.0).all() else ("{v}",)
        if text in same and (name in ("x", "dx/dt") or name in signal.ideal.channels):
            continue  # a gain, a delay, and what another channel drives
        yield _effect(signal, k, Term(k, (name,), form), text.format(v=name), by_name)
    for text, (form, _) in SCALED.items():
        yield _effect(signal, k, Term(k, (name,), form), text.format(v=name), by_name, scale=float(values.std()))
    if name.startswith("position"):
        for n in MULTIPLES:
            for word, wave in (("sin", np.sin), ("cos", np.cos)):
                turned = name if n == 1 else f"{n} {name}"
                yield _effect(signal, k, Term(k, (name,), _Wave(wave, n)), f"{word}({turned})", by_name)


@dataclass(frozen=True)
class _Wave:
    wave: Callable[[Any], Any]
    n: int

    def __call__(self, v: Any, s: float) -> Any:
        return self.wave(self.n * v)


def _product(v: Any, s: float) -> Any:
    raise NotImplementedError("a product has two channels")


def _effect(
    signal: AlignedSignal, k: int, term: Term, text: str, by_name: Mapping[str, Samples], scale: float | None = None
) -> Effect:
    size, unit = float(signal.sampled.x[:, k].std()), signal.units[k]
    theta = np.array([1.0, scale or 1.0])[: 1 if scale is None else 2]
    spread = max(float(np.std(term.values(by_name, theta))), 1e-12)
    c = Parameter("c", f"{unit or '1'} per unit of {text}", size / spread)
    numbers = (c,) if scale is None else (c, Parameter("s", "", scale, positive=True, step=0.02))
    starts = None if scale is None else [np.array([0.1 * size / spread, share * scale]) for share in SCALES]
    equation = f"{signal.names[k].rpartition('.')[2]} += c {text}"
    return signal.scale.effect(
        "unknown", (k,), equation, numbers, term, starts=starts, kind="unknown", variable=text, variant=text
    )


def python(variable: str, column: str) -> str:
    """A term as Python: a function of its channels, empty for a curve or a channel."""
    names = re_names(variable)
    if not names:
        return ""
    words = {name: "".join(letter if letter.isalnum() else "_" for letter in name).strip("_") for name in names}
    arguments = ", ".join([*words.values(), "c", *(["s"] if "/s" in variable else [])])
    return f"def {_word(column)}_added({arguments}):\n    return c * {_body(variable, words)}"


def _word(column: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in column).strip("_")


def re_names(variable: str) -> list[str]:
    """Channels of joints in a term, in order."""
    import re

    return list(dict.fromkeys(re.findall(r"(?:position|velocity|acceleration)\[\d+\]|\bdx/dt\b|\bx\b", variable)))


def _body(variable: str, words: Mapping[str, str]) -> str:
    for forms in (FORMS, SCALED):
        for text, (_, code) in forms.items():
            for name, word in words.items():
                if text.format(v=name) == variable:
                    return code.format(p=word)
    text = variable
    for name, word in words.items():
        text = text.replace(name, word)
    if text.startswith(("sin(", "cos(")):
        return f"np.{text.replace(' ', ' * ')}"
    return text.replace(" ", " * ")
