"""Settings in TOML: depth, long integers, wrong types, names twice, letters of no language."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

from fuzz import command, outside_contract
from fuzz._inputs import only_below
from fuzz.models import log

VALUES = (
    *("1", "-1", "0", "1.5", "1e308", "1e400", "nan", "-inf", "true", '""', '"x"', "[]", "{}", "[1, 2, 3]", "[nan, inf, 0.0]"),
    *(
        "9" * 5000,
        "[" * 3000 + "]" * 3000,
        "[[1,2],[3]]",
        "1979-05-27T07:32:00Z",
        '"\\u202e"',
        '"\\u001b[31m"',
        "0x" + "f" * 300,
        "{a={b={c=1}}}",
    ),
    *("[1e300, 1e300, 1e300]", "-0.0", "1e-320", '"lever_arm"', '"accel"', '"m"', "[[0.1, 0.0, 0.0]]"),
)
PHYSICS = """[[effect]]
name = "lever_arm"
signal = "accel"
[effect.parameters.x]
value = 0.213
std = 0.004
unit = "m"

[bias]
gyro = [0.0, 0.0, 0.0]
accel = [0.0, 0.0, 0.0]

[[unknown]]
signal = "accel"
variable = "omega_x"
unit = "rad/s"
x = [-1.0, 0.0, 1.0]
y = [[0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]
band = [[0.01, 0.01, 0.01], [0.01, 0.01, 0.01], [0.01, 0.01, 0.01]]
"""
NOISE = """gyro_noise_density = 0.0001
accel_noise_density = 0.002
gyro_random_walk = 1e-5
accel_random_walk = 1e-4
"""
TRAINING = """seed = 3
window_s = 5.0
method = "linear"
"""


def problems(rng: random.Random, folder: Path) -> Iterator[str]:
    """Gives a hostile file to the commands that read settings: an error with a message, or finite numbers."""
    (folder / "in.mcap").write_bytes(log())
    kind = rng.choice(("physics", "physics", "simulate", "noise", "training"))
    text = hostile(rng, {"noise": NOISE, "training": TRAINING}.get(kind, PHYSICS))
    (folder / "s.toml").write_bytes(text)
    words = {
        "physics": ("debias", "in.mcap", "out.mcap", "--model", "s.toml", "-q"),
        "simulate": ("simulate", "in.mcap", "out.mcap", "--physics", "s.toml", "-q"),
        "noise": ("simulate", "in.mcap", "out.mcap", "--noise", "s.toml", "-q"),
        "training": ("train", "in.mcap", "-o", "out.safetensors", "--config", "s.toml", "--method", "linear", "-q"),
    }[kind]
    with only_below(folder, "out.") as wrong:
        done = command(folder, *words)
    yield from wrong
    yield from outside_contract(done)
    if len(done.stderr) > 4000:
        yield f"a message of {len(done.stderr)} letters: {done.stderr[:200]}"
    if any(not letter.isprintable() and letter != "\n" for letter in done.stderr + done.stdout):
        yield f"control characters in a message: {done.stderr!r}"
    if done.returncode == 0 and (folder / "out.mcap").exists():
        from fuzz._inputs import finite_log

        yield from finite_log(folder / "out.mcap")


def hostile(rng: random.Random, text: str) -> bytes:
    """A settings file with something wrong in it."""
    lines = text.splitlines()
    for _ in range(rng.choice((1, 1, 2, 3))):
        row = rng.randrange(len(lines))
        what = rng.randrange(7)
        name = lines[row].partition(" = ")[0]
        if what <= 2 and " = " in lines[row]:
            lines[row] = f"{name} = {rng.choice(VALUES)}"
        elif what == 3:
            lines.insert(
                row,
                rng.choice(
                    (lines[row], "[a]", "[bias]", "[[bias]]", "x = 1", '"" = 1', "é = 2", "[" + ".".join("abc" * 1000) + "]")
                ),
            )
        elif what == 4:
            del lines[row]
            lines = lines or [""]
        elif what == 5:
            lines[row] = lines[row].replace(rng.choice("aelxyz"), rng.choice(("", "é", "\u202e", "zz")))
        else:
            lines[row] += rng.choice((" # \0", "\0", " = ", '"""', "\ufeff", "\r"))
    raw = "\n".join(lines).encode()
    return rng.choice((raw, raw, raw, raw[: rng.randrange(len(raw) + 1)], b"\xff\xfe" + raw, raw.replace(b"\n", b"\r\n"), b""))
