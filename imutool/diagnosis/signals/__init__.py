"""Diagnosis of all other signals of a recording and its simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from imutool.diagnosis.result import Closer, Diagnosis
from imutool.diagnosis.settings import DiagnoseSettings
from imutool.diagnosis.signals.ideal_signal import SignalPair, without_others
from imutool.diagnosis.signals.log_fields import on_one_clock
from imutool.diagnosis.signals.pairing import Pairing, paired
from imutool.diagnosis.signals.signal_diagnosis import SignalDiagnosis, diagnose_signal
from imutool.errors import DataError
from imutool.location import Location
from imutool.mcap_io.fields import others, read_field


def with_signals(
    diagnosis: Diagnosis,
    real: Location,
    sim: Location,
    named: Sequence[str],
    report: Callable[[int, int, str], None],
    settings: DiagnoseSettings,
) -> Diagnosis:
    """Diagnosis with the signals `named` (TOPIC.field), or with all that both logs hold.

    Raises:
        ConfigError, LogError: a log cannot be read, or has no such topic.
        DataError: a named signal cannot be compared, or nothing can where there is no IMU.
    """
    if named:
        for name in named:
            pair = SignalPair.of_fields(on_one_clock(read_field(real, name)), on_one_clock(read_field(sim, name)), name)
            report(3, 4, name)
            diagnosis = _with_signal(diagnosis, diagnose_signal(pair, others(real, name), settings))
        return diagnosis
    pairing = paired(real, sim)
    if not pairing.pairs and not diagnosis.unexplained:
        raise DataError(
            "recording and simulation share no IMU and no other varying number",
            where=real,
            expected="topics of one name and message in both logs",
            fix=". ".join(["Give both logs the topics of one robot", *pairing.remarks]),
        )
    if pairing.pairs:
        diagnosis = replace(diagnosis, remarks=(*diagnosis.remarks, *pairing.remarks))
    for pair in pairing.pairs:
        report(3, 4, pair.name)
        diagnosis = _compared(diagnosis, pair, pairing, settings)
    return diagnosis


def _compared(diagnosis: Diagnosis, pair: SignalPair, pairing: Pairing, settings: DiagnoseSettings) -> Diagnosis:
    """Diagnosis with one more signal; a remark where it cannot be compared."""
    drivers = {name: values for name, values in pairing.drivers.items() if not name.startswith(f"{pair.name}.")}
    try:
        return _with_signal(diagnosis, diagnose_signal(pair, drivers, settings))
    except DataError as error:
        rest = without_others(pair, settings)
        left_out = ", ".join(name for name in pair.names if rest is not None and name not in rest.names) or pair.name
        told = replace(diagnosis, remarks=(*diagnosis.remarks, f"{left_out} was not compared: {error.what}"))
        return told if rest is None else _compared(told, rest, pairing, settings)


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
        remarks=(*diagnosis.remarks, *added.remarks),
        signals={**diagnosis.signals, **added.traces},
    )
