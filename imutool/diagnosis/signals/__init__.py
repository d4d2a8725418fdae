"""Diagnosis of all other signals of a recording and its simulation."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from itertools import product

import numpy as np

from imutool.diagnosis.compared_logs import ComparedLogs
from imutool.diagnosis.estimation.aligned_log import ClockDifference
from imutool.diagnosis.result import Closer, Diagnosis
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair, without_others
from imutool.diagnosis.signals.lag import on_recorded_clock
from imutool.diagnosis.signals.log_fields import on_one_clock
from imutool.diagnosis.signals.pairing import Pairing, paired
from imutool.diagnosis.signals.signal_diagnosis import SignalDiagnosis, diagnose_signal
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.fields import others, read_field
from imutool.report import NamedProgress

BY_OTHERS = frozenset({"pressure", "magnetic", "gnss"})  # kinds whose own physics may be most of the signal

ONE_CLOCK = "The motion of the IMU puts both logs on one clock, so a delay of another signal is relative to the IMU"


def check_signals(asked: ComparedLogs) -> None:
    """Refuse wrong signals before the search.

    Raises:
        ConfigError: they need one recording and its simulation.
        LogError: a log has no such field.
    """
    if asked.signals and (asked.sim is None or len(asked.reals) != 1):
        raise ConfigError("needs one recording and its simulation", where="signals", fix="Give one log and `sim`")
    for name, place in product(asked.signals, (asked.reals[0], asked.sim)):
        if place is not None:
            read_field(place, name)


def with_signals(
    diagnosis: Diagnosis, asked: ComparedLogs, report: NamedProgress, clock: ClockDifference | None = None
) -> Diagnosis:
    """Diagnosis with the signals that are asked for, or with all that both logs hold.

    Logs that share no epoch have the `clock` that the IMU's motion shows.

    Raises:
        ConfigError, LogError: a log cannot be read, or has no such topic.
        DataError: a named signal cannot be compared, or nothing can where there is no IMU.
    """
    real, sim, settings = asked.reals[0], asked.sim, asked.settings
    assert sim is not None
    if asked.signals:
        for name in asked.signals:
            pair = SignalPair.of_fields(on_one_clock(read_field(real, name)), on_one_clock(read_field(sim, name)), name)
            report(3, 4, name)
            diagnosis = _with_signal(diagnosis, diagnose_signal(on_recorded_clock(pair, clock), others(real, name), settings))
        return diagnosis
    pairing = paired(real, sim, clock)
    if not pairing.pairs and not diagnosis.unexplained:
        raise DataError(
            "recording and simulation share no IMU and no other varying number",
            where=real,
            expected="topics of one name and message in both logs",
            fix=". ".join(["Give both logs the topics of one robot", *pairing.remarks]),
        )
    if pairing.pairs:
        one_clock = [] if clock is None else [ONE_CLOCK]
        diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, *pairing.remarks, *one_clock))
    clocks, later = list[float](), list[SignalPair]()
    for pair in pairing.pairs:
        report(3, 4, pair.name)
        try:
            diagnosis = _compared(diagnosis, pair, pairing, settings, clocks)
        except DataError as error:
            if pair.kind in BY_OTHERS:
                later.append(pair)
            else:
                diagnosis = _left_out(diagnosis, pair.name, error)
    for pair in later:  # what differs in most of it is of one motion where other signals are
        try:
            known = replace(pair, clock_s=float(np.median(clocks)) if clocks else None)
            diagnosis = _compared(diagnosis, known, pairing, settings, [])
        except DataError as error:
            diagnosis = _left_out(diagnosis, pair.name, error)
    return diagnosis


def _left_out(diagnosis: Diagnosis, name: str, error: DataError) -> Diagnosis:
    return replace(diagnosis, remarks=(*diagnosis.remarks, f"{name} was not compared: {error.what}"))


def _compared(
    diagnosis: Diagnosis, pair: SignalPair, pairing: Pairing, settings: DiagnoseSettings, clocks: list[float]
) -> Diagnosis:
    """Diagnosis with one more signal, whose clock joins `clocks`; a remark where a part of it cannot be compared."""
    drivers = {name: values for name, values in pairing.drivers.items() if not name.startswith(f"{pair.name}.")}
    try:
        added = diagnose_signal(pair, drivers, settings)
    except DataError as error:
        if (rest := without_others(pair, settings)) is None:
            raise
        left_out = ", ".join(name for name in pair.names if name not in rest.names)
        return _compared(_left_out(diagnosis, left_out, error), rest, pairing, settings, clocks)
    clocks += [] if pair.sim_state else [added.clock_s]
    return _with_signal(diagnosis, added)


def _with_signal(diagnosis: Diagnosis, added: SignalDiagnosis) -> Diagnosis:
    """Adds the diagnosis of another signal."""
    closer = {name: Closer.computed(held_out, added.unexplained[name].noise_floor) for name, held_out in added.closer.items()}
    return replace(
        diagnosis,
        located=(*diagnosis.located, *added.located),
        findings=(*diagnosis.findings, *added.findings),
        not_identifiable=(*diagnosis.not_identifiable, *added.not_identifiable),
        unexplained={**diagnosis.unexplained, **added.unexplained},
        closer={**diagnosis.closer, **closer},
        remarks=reduce(_with_remark, added.remarks, diagnosis.remarks),
        signals={**diagnosis.signals, **added.traces},
    )


def _with_remark(remarks: tuple[str, ...], remark: str) -> tuple[str, ...]:
    """Adds a remark on a signal; signals with the same remark share it."""
    name, _, text = remark.partition(": ")
    for k, other in enumerate(remarks):
        if (names := other.removesuffix(f": {text}")) != other:
            return (*remarks[:k], f"{names}, {name}: {text}", *remarks[k + 1 :])
    return (*remarks, remark)
