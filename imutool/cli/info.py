"""`imutool info`."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec.structs import replace

from imutool.cli.app import COMMON, PNG, TOML, Common, LogUrls, MaxChunk, app
from imutool.cli.terminal import kept_for_end, raise_kept, say, table, tell_losses
from imutool.errors import LOST, ConfigError, ImutoolError
from imutool.file_location import to_location
from imutool.report import UnsetType, json_values

if TYPE_CHECKING:
    from imutool.log_info.report import LogInfo
    from imutool.noise_identification import IdentifiedNoise


MANY = 3  # conventions that poses leave open: more than two are named together
EARLIEST_DATE_NS = 365 * 86400 * 10**9  # of 1971: an earlier first stamp counts from a start


@app.command(epilog="Example: [bold]imutool info MH_04.mcap[/] or [bold]imutool info still.mcap --noise --noise-toml i.toml[/]")
def info(
    logs: LogUrls,
    noise: Annotated[bool, typer.Option("--noise", help="Identify the IMU's noise, at rest and against the truth.")] = False,
    model: Annotated[str | None, typer.Option(help="For --noise: model that corrects the samples in motion.")] = None,
    imu: Annotated[str | None, typer.Option(help="For --noise: IMU topic, where a log has several.")] = None,
    truth: Annotated[str | None, typer.Option(help="For --noise: topic of the true poses, where a log has several.")] = None,
    noise_plot: Annotated[
        Path | None, typer.Option(metavar="F.png", help="Draw the Allan deviations (with --noise)."), PNG
    ] = None,
    noise_toml: Annotated[
        Path | None, typer.Option(metavar="F.toml", help="Write the noise as TOML (with --noise)."), TOML
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Read only the chunks with IMU messages; this may miss damage.")
    ] = False,
    max_chunk: MaxChunk = None,
    common: Common = COMMON,
) -> None:
    """Report the topics, quality and damage of a log; with --noise, also its IMU noise.

    Logs that cannot be read are named after the reports of the others.
    """
    from imutool.log_info.report import LogInfos

    asked = {"--model": model, "--imu": imu, "--truth": truth, "--noise-plot": noise_plot, "--noise-toml": noise_toml}
    if not noise and (idle := [name for name, value in asked.items() if value is not None]):
        raise ConfigError(f"{idle[0]} needs --noise", where="info", fix="Add --noise")
    if len(logs) > 1 and (noise_plot or noise_toml):
        raise ConfigError(f"{len(logs)} logs do not fit one file", where="--noise-plot, --noise-toml", expected="one log")
    settings = {"imu": imu, "truth": truth, "model": model}
    described: list[tuple[str, LogInfo, IdentifiedNoise | None]] = []
    errors: list[ImutoolError] = []
    for log in logs:
        with kept_for_end(errors):
            described.append((log, *_described(log, quick, max_chunk, noise, settings)))
    if not described:
        raise_kept(errors)
    reports = [report for _, report, _ in described]
    if (identified := described[0][2]) is not None:
        _write_noise(identified, noise_plot, noise_toml, common.overwrite)
    if not common.write(reports[0] if len(logs) == 1 else LogInfos(reports)):
        for log, report, identified in described:
            say(f"{log}: {_span(report)}")
            _print(report, identified)
    raise_kept(errors)
    if any(report.losses["stretches"] for report in reports):
        raise typer.Exit(LOST)


def _described(
    log: str, quick: bool, max_chunk: int | None, noise: bool, settings: Mapping[str, str | None]
) -> tuple[LogInfo, IdentifiedNoise | None]:
    """Report on a log, and its noise if requested; the log is opened once."""
    from imutool.log_info.inspection import describe
    from imutool.mcap_io.recovery.recovered_log import RecoveredLog

    place = to_location(log)
    with RecoveredLog(place, max_chunk=max_chunk) as opened:
        report, about = describe(opened, check=not quick), opened.metadata().get("imutool", {})
        if "dataset" in about:
            from imutool.bias.model_file import shipped_for

            report = replace(report, models=shipped_for(about))
        if not noise:
            return report, None
        from imutool import noise_identification

        identified = noise_identification.identify(opened, **settings)
        return replace(report, noise=noise_identification.plain(identified)), identified


def _print(report: LogInfo, identified: IdentifiedNoise | None) -> None:
    """Print tables, remarks, warnings and losses of one log."""
    table(topic_rows(report), keys=1)
    table(imu_rows(report), keys=2)
    if report.models:
        say(f"Models that ship for this unit of the sensor: {', '.join(report.models)}")
    if identified is not None:
        from imutool import noise_identification

        table(noise_identification.rows(identified), keys=1)
        for remark in identified.remarks:
            say(remark, "noise", "cyan")
    for warning in report.warnings:
        say(warning, "warning")
    tell_losses(report.losses)


def _write_noise(identified: IdentifiedNoise, plot: Path | None, toml: Path | None, overwrite: bool) -> None:
    """Write the requested noise files."""
    if plot is not None:
        from imutool.viewing.html.allan_plot import write_png

        write_png(identified, plot, overwrite=overwrite)
    if toml is not None:
        from imutool.noise.datasheet import write

        write(identified.noise, toml, overwrite=overwrite)


def _span(report: LogInfo) -> str:
    """Size of a log, its messages, and the time that they span."""
    size = f"{report.bytes / 1e6:.1f} MB, {report.messages} messages"
    if report.first_ns is None or report.duration_s is None:
        return size
    if report.first_ns < EARLIEST_DATE_NS:
        return f"{size}, {report.duration_s:.3f} s from {report.first_ns * 1e-9:.3f} s on its own clock"
    return (
        f"{size}, {report.duration_s:.3f} s from {datetime.fromtimestamp(report.first_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    )


def topic_rows(report: LogInfo) -> list[tuple[str, ...]]:
    """Rows of the topic table, the header first; times count from the log's first message."""
    start_ns = report.first_ns or 0
    header = ("topic", "type", "count", "rate Hz", "jitter ms", "gap s", "from s", "to s")
    rows = [
        (
            topic.name,
            topic.type,
            str(topic.count),
            _number(topic.rate_hz, ".2f"),
            _number(topic.jitter_s, ".3f", 1e3),
            _number(topic.largest_gap_s, ".3f"),
            *("–" if ns is None else f"{(ns - start_ns) * 1e-9:.3f}" for ns in (topic.first_ns, topic.last_ns)),
        )
        for topic in report.topics
    ]
    return [header, *rows]


def imu_rows(report: LogInfo) -> list[tuple[str, ...]]:
    """Rows of the property table of IMUs and truth, the header first."""
    from imutool.mcap_io.codec.reflection import BY_LOG_TIMES, WITHOUT_STAMP

    rows: list[tuple[str, ...]] = [("topic", "property", "value")]
    for imu in map(json_values, report.imu):
        if "samples" not in imu:
            continue
        counts = ("out_of_order", "duplicated", "missing", "not_finite", "saturated")
        rows.append((imu["topic"], "samples", str(imu["samples"])))
        rows += [(imu["topic"], name.replace("_", " "), str(imu[name])) for name in counts]
        if "time" in imu:
            why = f"in {imu['time_unit']}, {BY_LOG_TIMES}" if "time_unit" in imu else WITHOUT_STAMP
            why = f"not {', '.join(imu['other_times'])}" if imu["other_times"] else why
            rows.append((imu["topic"], "time of the samples", f"{imu['time']}, {why}"))
        stated = [imu["stated_units"]] if "stated_units" in imu else []
        rows += [(imu["topic"], "units", f"{units}, by the comments of its definition") for units in stated]
        if imu["rate_hz"] is not None:
            clock = f"{imu['rate_hz']:.2f} Hz, jitter {1e3 * imu['jitter_s']:.3f} ms, longest gap {imu['largest_gap_s']:.3f} s"
            rows.append((imu["topic"], "clock of stamps", clock))
        rows.append((imu["topic"], "at rest", f"{imu['stationary_s']:.1f} s in {_counted(len(imu['stationary']), 'stretch')}"))
        rows.append((imu["topic"], "accel at rest", _number(imu["accel_at_rest_m_s2"], ".3f") + " m/s²"))
        alike: dict[str, list[str]] = {}
        for entry in imu.get("conventions", []):
            alike.setdefault(entry["evidence"], []).append(entry["subject"])
        for evidence, subjects in alike.items():  # only what the poses leave open has a reason in common
            rows.append((imu["topic"], ", ".join(subjects) if len(subjects) < MANY else "against poses", evidence))
        for name, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
            noise = imu["noise"]
            if noise is not None:
                density = noise[f"{name}_density"]
                rows.append((imu["topic"], f"{name} noise", ", ".join(f"{d:.2e}" for d in density) + f" {unit}/√Hz"))
    for truth in report.truth:
        value = f"{100 * truth.coverage:.1f} % of the IMU, {_counted(truth.gaps, 'gap')}, longest {truth.longest_gap_s:.2f} s"
        rows.append((truth.topic, "kind of poses", truth.kind))
        if report.imu:  # without one there is nothing to cover
            rows.append((truth.topic, "covers", value))
        if not isinstance(truth.gyro_rms_rad_s, UnsetType) and not isinstance(truth.gyro_explained, UnsetType):
            value = f"{100 * truth.gyro_explained:.1f} % of the motion, {truth.gyro_rms_rad_s:.4f} rad/s rms remain"
            rows.append((truth.topic, "explains gyro", value))
        if not isinstance(truth.body_turned_deg, UnsetType) and not isinstance(truth.body_turned_std_deg, UnsetType):
            both = truth.body_turned_deg, truth.body_turned_std_deg
            turned, std = (", ".join(f"{value:.2f}" for value in values) for values in both)
            rows.append((truth.topic, "body of poses", f"turned by ({turned}) ± ({std})° against the gyro"))
    return rows


def _counted(count: int, noun: str) -> str:
    """Number with its noun: 1 gap, 2 gaps, 2 stretches."""
    return f"{count} {noun}{'' if count == 1 else 'es' if noun.endswith('ch') else 's'}"


def _number(value: float | int | None, form: str, scale: float = 1.0) -> str:
    return "–" if value is None else format(value * scale, form)
