"""Joints of two logs by their names: efforts with motion, wheels with their vehicle."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import butter, sosfiltfilt

from imutool.array_types import Float64
from imutool.diagnosis.signals.ideal_signal import SignalPair, stacked
from imutool.diagnosis.signals.quantities import continuous, unwrapped
from imutool.errors import LogError
from imutool.inertial.stationary import white_noise
from imutool.mcap_io.fields import Fields, decoder_of
from imutool.mcap_io.log import Log
from imutool.recording import seconds

JOINTS = "sensor_msgs/msg/JointState"
JOINT_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
SPEEDS = ("twist.twist.linear.x", "twist.twist.angular.z")
MIN_MOVED = 1e-3  # rad or m: a joint that moves less shows nothing of its dynamics
MIN_EFFORTS = 0.5  # of the joints, that have efforts where efforts are compared
MIN_RATES, SLOWER_HZ, RATE_ERROR = 100, 0.1, 0.003  # samples; of a drift that integration makes; share of a motion
DRIVES = 0.05  # of a vehicle's speed or turning, that a wheel makes


def joint_names(log: Log, topic: str) -> list[list[str]]:
    """Names of a topic's joints: one list, or two of several publishers; none if unreadable."""
    found = dict[tuple[str, ...], None]()
    try:
        decoder = decoder_of(log, log.topics[topic])
        for _, rows in log.rows([topic]):
            for names in decoder.texts(rows.payload, "name"):
                found[names] = None
            if len(found) > 1:
                break
    except LogError:  # its numbers are not read either
        return []
    return [list(names) for names in found]


def by_joint(fields: Mapping[str, Fields], wanted: Sequence[str], given: Sequence[str]) -> dict[str, Fields]:
    """Fields under the indices of the same joints in another log: by name, or else by order."""
    index = {f"[{given.index(name)}]": f"[{k}]" for k, name in enumerate(wanted) if name in given}
    if not index:
        return dict(fields)
    split = {path: path.partition("[") for path in fields}
    return {f"{word}{index[f'[{rest}']}": fields[path] for path, (word, _, rest) in split.items() if f"[{rest}" in index}


def joint_remarks(topic: str, real: Sequence[str], sim: Sequence[str]) -> list[str]:
    """Names of the indices that findings have, and joints of one log alone."""
    if not real:
        return []
    out = [f"Joints of {topic}: {', '.join(f'[{k}] {name}' for k, name in enumerate(real))}"]
    alone = [name for name in real if name not in sim], [name for name in sim if name not in real]
    if sim and len(alone[0]) == len(real):
        return [*out, f"No joint of {topic} has a name of the simulation's: joints were compared by their order"]
    for names, log in zip(alone, ("recording", "simulation"), strict=True):
        out += [f"Only the {log} has the joints {', '.join(names)}: they were not compared"] if names and sim else []
    return out


def joint_pairs(
    topic: str, real: Mapping[str, Fields], sim: Mapping[str, Fields], wheels: Collection[str]
) -> Iterator[SignalPair]:
    """Efforts with the motion of joints but wheels where both logs have both, else each number."""
    both = [path for path in sim if path in real and not path.endswith(tuple(wheels))]  # in the order of the model
    joints = [path.removeprefix("position") for path in both if path.startswith("position")]
    driven = [k for k in joints if f"effort{k}" in both]
    moving = [k for k in driven if min(np.ptp(side[f"position{k}"].values) for side in (real, sim)) > MIN_MOVED]
    if moving and len(driven) >= MIN_EFFORTS * len(joints):
        yield _efforts(topic, moving, real, sim)
        return
    known = rates(real, sim)
    for path in (path for path in both if path not in known):
        kind = "positions" if path.startswith("position") else "number"
        effort = real.get(path.replace("position", "effort"))
        state = {"effort": effort} if kind == "positions" and effort is not None else {}
        pair = SignalPair.of_fields(real[path], sim[path], f"{topic}.{path}")
        yield unwrapped(replace(pair, kind=kind, state=state, units=(JOINT_UNITS[path.partition("[")[0]],)))


def rates(real: Mapping[str, Fields], sim: Mapping[str, Fields]) -> list[str]:
    """Recorded velocities that are the rates of positions which both logs hold."""
    found = [(path, path.replace("velocity", "position")) for path in real if path.startswith("velocity") and path in sim]
    return [path for path, of in found if of in real and of in sim and _is_rate(real[path], real[of])]


def _is_rate(velocity: Fields, position: Fields) -> bool:
    """Whether a velocity is the rate of a position at the same stamps, up to a sample late.

    What its integral leaves of the position, but for white noise, is compared with the position's motion.
    """
    if len(position) < MIN_RATES or not np.array_equal(velocity.t_ns, position.t_ns):
        return False
    t_s = seconds(position.t_ns, int(position.t_ns[0]))
    period_s = float(np.median(np.diff(t_s)))
    slow = butter(2, min(2.0 * SLOWER_HZ * period_s, 0.5), "highpass", output="sos")
    gone = cumulative_trapezoid(velocity.values, t_s, initial=0)
    q, residual, v = sosfiltfilt(slow, np.stack([position.values, position.values - gone, velocity.values], axis=1), axis=0).T
    residual = residual - float(np.clip(residual @ v / max(v @ v, 1e-300), -period_s, period_s)) * v
    noise = float(white_noise(residual[:, None])[0])
    return bool(residual.var() - noise**2 < RATE_ERROR**2 * q.var())


def _efforts(topic: str, moving: Sequence[str], real: Mapping[str, Fields], sim: Mapping[str, Fields]) -> SignalPair:
    """Efforts of the joints that move, with the motion of all of them, at the stamps that all fields have."""
    states, sides = list[dict[str, Fields]](), list[dict[str, Fields]]()
    for side in (real, sim):
        paths = [f"{word}{k}" for k in moving for word in JOINT_UNITS if f"{word}{k}" in side]
        t_ns, values = stacked([side[path] for path in paths])
        columns = (
            continuous(column) if path.startswith("position") else column for path, column in zip(paths, values.T, strict=True)
        )
        known = {path: Fields(t_ns, column) for path, column in zip(paths, columns, strict=True)}
        sides.append(known)
        words = (("q", "position"), ("dq", "velocity"))
        named = {f"{short}{n}": f"{word}{k}" for n, k in enumerate(moving) for short, word in words}
        states.append({name: known[path] for name, path in named.items() if path in known})
    efforts = tuple(f"effort{k}" for k in moving)
    return SignalPair.of_columns(topic, efforts, "efforts", (JOINT_UNITS["effort"],) * len(efforts), *sides, *states)


def wheel_pair(
    topic: str,
    real: Mapping[str, Fields],
    sim: Mapping[str, Fields],
    joints: tuple[Mapping[str, Fields], Mapping[str, Fields]],
) -> tuple[SignalPair, list[str]] | None:
    """A vehicle's speeds with those of two or more joints that drive it, and their indices."""
    if not all(path in side for path in SPEEDS for side in (real, sim)):
        return None
    speeds = [_speeds(side) for side in joints]
    shared = [k for k in speeds[0] if k in speeds[1]]
    t_ns, moved = stacked([sim[path] for path in SPEEDS])
    shared = [k for k, drives in zip(shared, _driving([speeds[1][k] for k in shared], t_ns, moved), strict=True) if drives]
    if len(shared) < 2:
        return None
    states = [{f"w{n}": values for n, values in enumerate(_together([side[k] for k in shared]))} for side in speeds]
    return SignalPair.of_columns(topic, SPEEDS, "wheels", ("m/s", "rad/s"), real, sim, *states), shared


def _together(columns: Sequence[Fields]) -> list[Fields]:
    t_ns, values = stacked(columns)
    return [Fields(t_ns, column) for column in values.T]


def _speeds(side: Mapping[str, Fields]) -> dict[str, Fields]:
    """Speeds of joints by index: as logged, else the slope of their angles."""
    out = dict[str, Fields]()
    for path, values in side.items():
        word, _, rest = path.partition("[")
        if word == "velocity":
            out[f"[{rest}"] = values
        elif word == "position" and f"velocity[{rest}" not in side and len(values) > 2:
            t_s = seconds(values.t_ns, int(values.t_ns[0]))
            out[f"[{rest}"] = Fields(values.t_ns, np.gradient(np.unwrap(values.values), t_s))
    return out


def _driving(speeds: Sequence[Fields], t_ns: np.ndarray, moved: Float64[np.ndarray, "n k"]) -> list[bool]:
    """Whether each joint makes a good part of a vehicle's motion, in the simulation."""
    if not speeds:
        return []
    start_ns = int(t_ns[0])
    at = np.stack([np.interp(seconds(t_ns, start_ns), seconds(own.t_ns, start_ns), own.values) for own in speeds], axis=1)
    weights = np.linalg.lstsq(at, moved, rcond=None)[0]
    return [
        bool(np.any(np.abs(w) * column.std() > DRIVES * moved.std(axis=0))) for w, column in zip(weights, at.T, strict=True)
    ]
