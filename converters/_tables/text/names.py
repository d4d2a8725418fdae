"""Names of columns: words for time, gyro and accelerometer, axes, and units."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache

XSENS_TIME = r"sample_?time_?fine"  # counts 100 us
SI_WORDS = r"angular_?velocity|linear_?acceleration|gyro_rad_|accelerometer_m_s2_|gyro_?rotation"  # of ROS, PX4 and CoreMotion
TIME_WORDS = (
    rf"({XSENS_TIME}|times?|time_?interval|timestamps?|time_?stamps?|t|ts|cts|stamp|seconds|seconds_?elapsed|sec|epoch?|rosbagtimestamp|time_?(s|ms|us|ns|sec|boot)"
    r"|zeit|zeitstempel|uhrzeit|date_?time|utc|[a-z]*(nanos|micros|millis)|elapsed|(gps_?)?(tow|time_?of_?week))"
    r"(_since_?(boot|reboot|start|epoch|1970))?"
)
BEHIND = r"(t|ts|times?|timestamps?|time_stamps?)_"
OWN_TIME = {  # names of a sensor's own stamps begin so: gyro_time, acc_ts; or are t_gyro, timeAcc
    "gyro": rf"gyro?(scope)?_t|{BEHIND}gyro?(scope)?$",
    "accel": rf"acc(el(eration|erometer)?)?_t|{BEHIND}acc(el(eration|erometer)?)?$",
}
SECOND, PER, SQUARED = r"s(ec(ond)?)?", r"(\^?-|⁻)", r"([ _]?(\^|\*\*)?2|²|[ _]?squared|/s(ec)?)"
VECTOR = "unit_degreofarcpersecon", "unit_meterperseconsquar", "unit_forceofgravi"  # of cars' buses, in data bases of Vector
SAME_MARKS = str.maketrans("μº", "µ°")  # a Greek letter, an ordinal
UNITS = {
    "rad/s": rf"rps|radps|rad(ian)?s?[ _]?(per|/)[ _]?{SECOND}|rad[ .·*]?s{PER}(1|¹)|rad_?{SECOND}",
    "deg/s": rf"dps|degps|(deg(ree)?s?|°)[ _]?(per|/)[ _]?{SECOND}|(deg|°)[ .·*]?s{PER}(1|¹)|deg_?{SECOND}|{VECTOR[0]}",
    "mdeg/s": rf"mdps|mdegs|m(deg|°) ?/ ?{SECOND}",
    "m/s^2": rf"m/\({SECOND}\^?2\)|mps2|ms2|mss|m[ .·*]?s{PER}(2|²)"
    rf"|(m|met(er|re)s?)(_|[ _]?(per|/)[ _]?){SECOND}{SQUARED}|{VECTOR[1]}",
    "cm/s^2": r"cm/s(\^|\*\*)?2|cm/s²|gals?",
    "ft/s^2": r"(ft|feet|foot)/s(ec)?((\^|\*\*)?2|²|/s(ec)?)|(ft|feet|foot)[ .·]?s\^?-2|fps\^?2|ft_?(per_?)?s_?2",
    "mg": r"mg|milli[ _-]?gs?",
    "g": rf"g'?s?|g[ _-]?forces?|{VECTOR[2]}",
    "ns": r"ns|(n|nano)sec(ond)?s?|nanos",
    "us": r"us|µs|(u|micro)sec(ond)?s?|micros",
    "ms": r"ms|(m|milli)sec(ond)?s?|millis",
    "s": r"s|sec(ond)?s?",
    "min": r"min(ute)?s?",
    "h": r"h|hrs?|hours?",
    "day": r"days?",
    "m": r"m|met(er|re)s?",
    "cm": r"cm|centimet(er|re)s?",
    "mm": r"mm|millimet(er|re)s?",
}
MULTIPLES = {  # of a unit, by their names
    r"mrads?( ?/ ?s(ec)?)|milliradians?( ?/ ?| per )s(ec(ond)?)?": (1e-3, "rad/s"),
    r"(deg(ree)?s?|°)( ?/ ?| per )h(r|our)?": (1.0 / 3600.0, "deg/s"),
    r"(deg(ree)?s?|°)( ?/ ?| per )min(ute)?": (1.0 / 60.0, "deg/s"),
    r"rpm|(rev(olution)?s?|turns?)( ?/ ?| per )min(ute)?": (6.0, "deg/s"),
    r"(rev(olution)?s?|turns?)( ?/ ?| per )s(ec(ond)?)?": (360.0, "deg/s"),
    r"mm/s((\^|\*\*)?2|²)": (1e-3, "m/s^2"),
    r"[uµμ]g|micro-?gs?": (1e-6, "g"),
}
RATE_OR_FORCE_UNITS = (
    r"m?dps|(?:deg|rad)(?:_?s(?:ec(?:ond)?)?|ps)|(?:deg(?:ree)?|rad(?:ian)?)s?_?per_?s(?:ec(?:ond)?)?"
    r"|mps2|ms2|mss|mg|milli_?gs?|m(?:et(?:er|re)s?)?_(?:per_)?s(?:ec(?:ond)?)?_?(?:2|squared)|ft_(?:per_)?s_?2"  # in a name
)
LENGTH_UNITS = (  # at the end of the name of a position or of a height
    r"(?:[a-z]*[xyz]|[ned]|east|north|up|down|alt(?:itude)?|height|hgt|elevation)(?:_in)?_(mm|cm|m|met(?:er|re)s?)"
)
G_INSIDE = r"(?<=acc_)g|(?<=accel_)g|(?<=acceleration_)g"  # else `g` is a gyro
WITHOUT_GRAVITY = r"(user|free|lin|linear)_?acc"  # where an acceleration with gravity is next to it
ESTIMATED = r"(^|_)(est|estimated|filt|filtered|smoothed|fused|rotated|world|earth|ref|reference)(_|$)"  # no sensor
CORE_MOTION = r"accelerometer_acceleration"  # `CMAccelerometerData.acceleration` of Apple's CoreMotion
WHOLE_WORDS = "gyr|acc|time"  # that begin behind capitals
DIGITS = str.maketrans("012", "xyz")
UNBIASED = r"(?<!(?<![a-z0-9])b_)"  # b_g is a bias, and so is b_w_RS_S of EuRoC
BIAS = r"(^|_)bias(es)?_(?!corr|comp|free|remov)"  # in front of the name of a sensor
IN_FRAMES = r"(?<![pqrv]_[a-z]{2}_)"  # p_WS_W is a position, in a frame W
WORDS = {
    "gyro": rf"gyro(scope)?s?|gyro_?rotation|gyroskop|gyr|gy|omega|{IN_FRAMES}w|(?<![pqrvc]_)wb|{UNBIASED}g"
    rf"|angular_?velocity|ang_?vel|((rotation|angular)_?)?rate|rate_of_rotation|{UNBIASED}w_rs_s|dreh(rate|geschwindigkeit)|giro(scopio|scopo)?|vel(ocidad)?_?ang(ular)?|gyro_?adc|gyro_rad",
    "accel": rf"accel((eration|erometer)s?)?|acc[el]?|ac|{IN_FRAMES}{UNBIASED}a|fb|g_?force|gf|linear_?acceleration"
    rf"|specific_?force|sp_?force|(linear)?beschleunigung|{UNBIASED}a_rs_s|acel(eracion|erometro)?|accelerazione|acc_?smooth|accelerometer_m_s2",
}
STATES = (  # of the numbers in a column
    r"_(sensor|raw|deg(rees?)?|rad(ians?)?|adc|counts?|(un)?cal(ib)?(rated)?|data|values?|readings?|meas(ured)?|(non_?)?wake_?up"
    r"|(un_?)?comp(ensated)?)"
)
STATE = rf"(?P<state>({STATES})?)"
PLACES = (  # of several IMUs on a body
    r"((left|right|upper|lower|l|r)_?)*(left|right|head|neck|chest|back|torso|trunk|sternum|pelvis|waist|hip|arm|forearm|wrist"
    r"|hand|finger|leg|thigh|shank|knee|ankle|foot|shoe)"
)
FORMS = (  # names of an axis, by falling preference; one of roll, pitch and yaw may also be that of a command
    rf"(?P<sensor>(?:.*_)?(WORDS)(_(ln|wr))?)_?(?P<axis>[xyz]){STATE}",  # Shimmer has two: low noise and wide range
    rf"(?P<sensor>(?:.*_)?(WORDS))_?(?P<axis>[012]){STATE}",
    rf"(?P<of>(?:.*_)?)(?P<axis>[xyz])_?(?=[a-z]{{3}})(?P<sensor>(WORDS)){STATE}",  # xgyro, of MAVLink
    rf"(?P<sensor>(?:.*_)?(WORDS))_(?P<axis>roll|pitch|yaw){STATE}",
    rf"(?P<axis>roll|pitch|yaw)_?(?=[a-z]{{3}})(?P<sensor>(WORDS)){STATE}",
    rf"(?P<sensor>(?:.*_)?(WORDS))_?(?P<axis>[xyz])_?(?P<place>\d|{PLACES}|(imu|sensor)_?\d?){STATE}",  # ax1, acc_x_chest
    rf"(?P<sensor>(?:.*_)?(WORDS))_?(?P<place>\d|{PLACES})_?(?P<axis>[xyz]){STATE}",  # acc1_x, acc_chest_x
    rf"(?P<sensor>(?:.*_)?(WORDS))(?P<state>{STATES})_?(?P<axis>[xyz012])",  # acc_raw_x
    rf"(?P<sensor>(?:.*_)?(?=[a-z]{{2}})(WORDS)){STATE}_(?P<nth>[1-9])",  # acc_1, as MATLAB names the columns of a matrix
)
SYMBOLS = {  # of an aircraft and of Kalibr; specific force, or in the axes of the body, where gravity shows that it is no bias
    "gyro": r"(?P<sensor>)(?P<axis>[pqr])",
    "accel": r"(?P<sensor>f|alpha|(.*_)?acc(el(eration)?)?_b(ody)?)_?(?P<axis>[xyz])",
}
NUMBERED = r"([ _-]?(id|no|nr|num(ber)?|index|idx|name|code|label))?"
RECORDINGS = (  # columns whose values tell recordings apart
    r"trial|run|session|recording|take|subject|subj|participant|user|person|patient|athlete|volunteer|experiment|exp|attempt"
    r"|series|flight|source_?file|file"
)
SENSORS = r"sensor|device|imu|node|placement|body_?(part|segment|location)|limb|(sensor|device|imu)_?(position|location)"
UNCOMPENSATED = r"(^|_)un_?comp(ensated)?(_|$)"  # by the filter in a sensor, which removes the biases that it knows
COMPENSATED = r"(^|_)comp(ensated)?(_|$)|(^|_)angularrate_"  # the second of VectorNav's messages
VECTORNAV_RAW = rf"{UNCOMPENSATED}|(^|_)imu_(rate|accel)_[xyz]$"
CHINESE = {"加速度": "acc_", "角速度": "gyro_", "时间": "time"}  # of WitMotion's program
AXES = {"0": "x", "1": "y", "2": "z"}
TURNS = AXES | {"roll": "x", "pitch": "y", "yaw": "z", "p": "x", "q": "y", "r": "z"}


def triples(sensor: str, *names: dict[str, str]) -> dict[str, dict[str, str]]:
    """Columns of three axes by what they are of, in the first form of names that has all three.

    `names` are spellings of the columns' names; `left_gyr_x` is of `left`, `gx2` of `imu2`. Uncompensated ones come alone.
    """
    tries = (_triples(sensor, spelled, form) for form in FORMS for spelled in names)
    found = next(filter(None, tries), {}) or _symbols(sensor, names[0])
    of_vectornav = any(name.endswith("imu_rate_x") for name in names[0].values())
    raw = VECTORNAV_RAW if of_vectornav else UNCOMPENSATED
    return {owner: axes for owner, axes in found.items() if re.search(raw, spaced_name(axes["x"]))} or found


def is_compensated(column: str, time: str) -> bool:
    """Whether the filter in the sensor has corrected a column, by its name or VectorNav's time."""
    name, of_vectornav = spaced_name(column), spaced_name(time) == "time_startup"
    return re.search(COMPENSATED, name) is not None or (of_vectornav and re.search(VECTORNAV_RAW, name) is None)


def _symbols(sensor: str, columns: Iterable[str]) -> dict[str, dict[str, str]]:
    """Columns of three axes with an aircraft's symbols in each group: `p`, `flight.p`, `imu/f_x`."""
    leaves: dict[str, dict[str, str]] = {}
    for column in columns:
        leaves.setdefault(group_of(column), {})[column] = split_name(leaf_of(column))[0]
    found = {group: _triples(sensor, names, SYMBOLS[sensor]) for group, names in leaves.items()}
    named = {split_name(group)[0] if group else name: each for group in found for name, each in found[group].items()}
    return named or _triples(sensor, {column: split_name(column)[0] for column in columns}, SYMBOLS[sensor])  # f.x


def _triples(sensor: str, names: dict[str, str], form: str) -> dict[str, dict[str, str]]:
    groups: dict[tuple[str, str], dict[str, str]] = {}
    axes = TURNS if sensor == "gyro" else AXES
    for column, name in names.items():
        if (match := re.fullmatch(form.replace("WORDS", WORDS[sensor]), name)) and not re.search(BIAS, name):
            found = match.groupdict()
            owner = f"{re.sub(r'^(?=[0-9])', 'imu', found['place'])}_" if "place" in found else found.get("of", "")
            group = groups.setdefault((owner + found["sensor"], found.get("state", "")), {})
            axis = found["axis"] if "axis" in found else "xyz456789"[int(found["nth"]) - 1]  # with a fourth it is no vector
            group[axes.get(axis, axis)] = column
    whole = {key: group for key, group in groups.items() if set(group) == set("xyz")}
    whole = {(name, state): group for (name, state), group in whole.items() if not state or (name, "") not in whole}
    owners = [re.sub(rf"(^|_)({WORDS[sensor]})$", "", name) for name, _ in whole]
    named = owners if len({*owners}) == len(whole) else [name + state for name, state in whole]
    return dict(zip(named, whole.values(), strict=True))


@lru_cache(maxsize=1 << 14)  # of the columns of one file, group by group
def group_of(column: str) -> str:
    """Group of a column: `mocap` of `mocap/v [m/s]`, and of a structure's `mocap.position[0]`."""
    return re.sub(r"(^|[/.])[^/.]*$", "", re.sub(r"\s*[\[(][^\])]*[\])]\s*$", "", column))


def leaf_of(column: str) -> str:
    """Name of a column without its group."""
    return column.removeprefix(group_of(column)).lstrip("/.")


def is_of_recordings(column: str) -> bool:
    """Whether a column is named as one that tells recordings apart: `trial`, `Subject ID`."""
    return re.fullmatch(rf"(({RECORDINGS}){NUMBERED}|id)", spaced_name(column)) is not None


def is_of_sensors(column: str) -> bool:
    """Whether a column is named as one that tells sensors apart: `device_id`, `placement`."""
    return (
        re.fullmatch(rf"(({SENSORS})|(sensor|device|imu)_({SENSORS})){NUMBERED}|mac|address", spaced_name(column)) is not None
    )


def is_named_time(name: str) -> bool:
    """Whether a name is that of a time, or ends as one: `gps_time`."""
    return re.fullmatch(rf"(.*_)?{TIME_WORDS}", split_name(name)[0]) is not None


def tells_apart(column: str) -> bool:
    """Whether a column is named as one that tells recordings or sensors apart."""
    return is_of_recordings(column) or is_of_sensors(column)


def is_recording(group: str) -> bool:
    """Whether a group is named as one of several recordings: `trial3`, `Subject_A`."""
    return re.fullmatch(rf"({RECORDINGS})s?(_?\d.*|_.+)?", _plain(group)) is not None


def is_sensor(group: str) -> bool:
    """Whether a group is named as one of several sensors: `imu_left`, `sensor2`, `wrist`."""
    return re.fullmatch(rf"(.*_)?({SENSORS}|inertial)s?(_?\d.*|_.+)?|{PLACES}(_?\d+)?", _plain(group)) is not None


def _plain(group: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", group).lower()).strip("_")


def name_and_unit(column: str, beside: str) -> tuple[str, str]:
    """Name and unit of a column; the unit `beside` the column counts where its name has none."""
    name, unit = split_name(column)
    return name, unit or unit_named(beside) or split_name(_spaced(column))[1]


def unit_named(text: str) -> str:
    """Unit that a text is; empty for other texts."""
    plain = text.strip("[]").lower().translate(SAME_MARKS)
    return next((unit for unit, pattern in UNITS.items() if re.fullmatch(pattern, plain)), "")


def unit_with_factor(column: str, beside: str) -> tuple[float, str]:
    """Factor and unit that a column states, `(0.1 deg/s)` or `[mrad/s]`; else 1 and no unit."""
    inside = re.search(r"[\[(]([^\])]*)[\])]\s*$", column)
    text = (inside[1] if inside else beside).strip().lower()
    if found := next((multiple for named, multiple in MULTIPLES.items() if re.fullmatch(named, text)), None):
        return found
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?(?:[eE]-?\d+)?)\s*[*·x]?\s*(\D.*)", inside[1] if inside else beside)
    unit, factor = (unit_named(match[2].strip()), float(match[1])) if match else ("", 1.0)
    return (factor, unit) if unit and 0.0 < factor < 1.0 else (1.0, "")  # a larger one may be a range: `acc_x (16 g)`


def spaced_name(column: str) -> str:
    """Name of a column with underscores between its words: UncompGyro_0, SENSgyro, gyroXDps."""
    return split_name(_spaced(column))[0]


def _spaced(column: str) -> str:
    begins = r"((?<=[a-z]{2})|(?<=^[xyz])|(?<=[a-z][XYZ]))(?=[A-Z][a-z])"
    return re.sub(rf"{begins}|(?<=[A-Z]{{2}})(?={WHOLE_WORDS})", "_", column.strip())


def split_name(column: str) -> tuple[str, str]:
    """Name in lower case with underscores, and the unit in brackets or at the end."""
    text = column.strip().lower().translate(SAME_MARKS)
    for words, translated in CHINESE.items():
        text = text.replace(words, translated)
    text = re.sub(r"(?<=uncomp)(?=gyro|acc)|(?<=imu)(?=rate|accel)", "_", text)
    bracket = re.search(r"[\[(]([^\])]*[a-zµ°][^\])]*)[\])]\s*$", text)
    unit = next((u for u, p in UNITS.items() if bracket and re.fullmatch(rf"(in )?({p})", bracket[1].strip())), "")
    if bracket:
        text = text[: bracket.start()]
    name = re.sub(r"[^a-z0-9]+", "_", text).strip("_")
    if not unit and (
        end := re.search(
            rf"(?:_in)?_({RATE_OR_FORCE_UNITS}|gs?|ns|us|ms|s|(nano|micro|milli|u)?sec(ond)?s?)$",
            name,
        )
    ):
        unit = next(u for u, p in UNITS.items() if re.fullmatch(p, end[1]))
        name = name[: end.start()]
    elif not unit and (end := re.search(rf"(?:^|_){LENGTH_UNITS}$", name)):  # pos_x_m, alt_mm
        unit = unit_named(end[1])
        name = re.sub(r"(_in)?_[a-z]+$", "", name)
    elif not unit and (inside := re.search(rf"_({RATE_OR_FORCE_UNITS}|{G_INSIDE})(?=_[xyz012]$)", name)):  # acc_mg_x
        unit = next(u for u, p in UNITS.items() if re.fullmatch(p, inside[1]))
        name = name[: inside.start()] + name[inside.end() :]
    return name, unit


def distinct_names(names: list[str]) -> list[str]:
    """Names of columns, of which one that repeats stands below the last that does not.

    So are messages of a bag that are written as a table:
    `angular_velocity,x,y,z,linear_acceleration,x,y,z` has `angular_velocity.x`, `linear_acceleration.x`, ....
    """
    above, distinct = "", list[str]()
    for text in names:
        if names.count(text) > 1:
            name = f"{above}.{text}" if above else text
            repeated = sum(re.fullmatch(rf"{re.escape(name)}( \(\d+\))?", other) is not None for other in distinct)
            distinct.append(f"{name} ({repeated + 1})" if repeated else name)
        else:
            above = text
            distinct.append(text)
    return distinct


def topic_of(column: str, taken: Collection[str], notes: list[str]) -> str:
    """Topic of a column in Latin letters; a note where it does not show the column."""
    leaf = leaf_of(column)
    distinct = leaf if f"{leaf}_".startswith(f"{group_of(column)}_") else column  # of speed/speed_left: speed_left
    name = re.sub(r"[^A-Za-z0-9_]+", "_", distinct).strip("_") or "column"
    topic = f"/{name}" if name[0].isalpha() else f"/column_{name}"
    if topic in taken or topic == "/column":  # of a name that differs by marks, or is in other letters
        while topic in taken:
            topic = f"{topic}_{len(taken)}"
        notes.append(f"{column!r} is on {topic}")
    return topic


def listed(names: Sequence[str], limit: int) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")
