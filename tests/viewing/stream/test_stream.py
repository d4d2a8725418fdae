"""A live stream: every source gives the samples, the corrected ones are those of the log, what is no sample is counted."""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.report_schema import assert_valid

import imutool as api
from imutool.bias_start.bias_at_rest import auto
from imutool.cli.live import live
from imutool.errors import ConfigError, DataError, ModelError
from imutool.mcap_io.codec.encode import encode_imu
from imutool.recording import Imu
from imutool.viewing.stream import session, sources, stream_fit
from imutool.viewing.stream.samples import Malformed, Sample, decoded, sample
from imutool.viewing.stream.session import run
from imutool.viewing.stream.sources import open_source

Imutool = Callable[..., subprocess.CompletedProcess[str]]
PLAIN = '{"t_ns": 5, "gyro": [0.1, 0.2, 0.3], "accel": [1, 2, 9.8]}'
MESSAGE = (
    '{"header": {"stamp": {%s}, "frame_id": "imu"}, "angular_velocity": {"x": 0.1, "y": 0.2, "z": 0.3},'
    ' "linear_acceleration": {"x": 1, "y": 2, "z": 9.8}, "orientation": {"x": 0}}'
)


@pytest.fixture(scope="module")
def imu() -> Imu:
    """Eight seconds, the first three at rest."""
    return api.example_recording(duration_s=8.0).imu


def lines(imu: Imu) -> list[str]:
    rows = zip(imu.t_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True)
    return [json.dumps({"t_ns": t_ns, "gyro": gyro, "accel": accel}) for t_ns, gyro, accel in rows]


def stream(imu: Imu) -> Iterator[Sample]:
    for line in lines(imu):
        yield sample(line, time.perf_counter())


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        (PLAIN, 5),
        (PLAIN.replace('"t_ns": 5', '"t_s": 1.5'), 1_500_000_000),
        (MESSAGE % '"sec": 2, "nanosec": 7', 2_000_000_007),
        (MESSAGE % '"secs": 2, "nsecs": 7', 2_000_000_007),
        ('{"op": "publish", "topic": "/imu", "msg": %s}' % (MESSAGE % '"sec": 2, "nanosec": 7'), 2_000_000_007),
    ],
)
def test_a_sample_is_read_from_plain_json_and_from_ros_messages(text: str, stamp_ns: int) -> None:
    assert sample(text, 3.0) == Sample(stamp_ns, (0.1, 0.2, 0.3), (1.0, 2.0, 9.8), 3.0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"gyro": [1, 2, 3], "accel": [1, 2, 3]}',
        PLAIN.replace("0.3", '"a"'),
        PLAIN.replace(", 0.3", ""),
        "\ud800",
    ],
)
def test_what_is_no_sample_is_refused(text: str) -> None:
    with pytest.raises((ValueError, UnicodeError)):
        sample(text, 0.0)


def test_the_samples_are_corrected_as_by_the_log(imu: Imu) -> None:
    model, shown, corrected = api.load_model("static"), [], []
    done = run(
        stream(imu), model, Malformed(), show=shown.append, each=lambda found, rate, force: corrected.append((*rate, *force))
    )
    first = imu.rows(slice(0, int(np.searchsorted(imu.t_ns, imu.t_ns[0] + 2_000_000_000)) + 1))
    online = api.OnlineDebiaser(model, auto(model, first))
    expected = [np.concatenate(online(*row)[:2]) for row in zip(imu.t_ns.tolist(), imu.gyro, imu.accel, strict=True)]
    np.testing.assert_array_equal(corrected, expected)
    assert (done.samples, done.malformed, done.gaps, done.out_of_order, done.not_shown) == (len(imu), 0, 0, 0, 0)
    assert done.delay_ms is not None
    assert 0.0 < done.delay_ms.median <= done.delay_ms.p99 <= done.delay_ms.max
    np.testing.assert_array_equal(np.concatenate([block.batch.stamp_ns for block in shown]), imu.t_ns)
    np.testing.assert_allclose(
        np.concatenate([b.batch.gyro - b.bias[:, :3] for b in shown]), np.array(expected)[:, :3], rtol=1e-12
    )


def test_gaps_order_and_missing_values_are_counted_and_do_no_harm(imu: Imu) -> None:
    t_ns, gyro = imu.t_ns.copy(), imu.gyro.copy()
    t_ns[1000:] += 3_000_000_000  # a gap
    t_ns[1200] = t_ns[1198]
    gyro[1300], gyro[1400] = np.nan, 1e300  # no gyro reads this: it is no measurement, either
    rows = [Sample(t, tuple(g), tuple(a), 0.0) for t, g, a in zip(t_ns.tolist(), gyro, imu.accel, strict=True)]
    shown: list[Any] = []
    done = run(iter([None, *rows]), api.load_model("static"), Malformed(), show=shown.append)
    assert (done.gaps, done.out_of_order, done.not_measured) == (1, 1, 2)
    assert done.rate_hz == pytest.approx(1.0 / imu.period_s, rel=0.01)  # not less for the gap
    stamps = np.concatenate([block.batch.stamp_ns for block in shown])
    assert len(stamps) == len(imu) - 3
    assert (np.diff(stamps) > 0).all()
    assert np.isfinite(done.gyro_bias).all()


def altered(imu: Imu, gyro: float = 1.0, accel: float = 1.0, step: float = 1.0) -> Iterator[Sample]:
    t_ns = imu.t_ns[0] + np.round((imu.t_ns - imu.t_ns[0]) * step).astype(np.int64)
    return stream(Imu(t_ns, gyro * imu.gyro, accel * imu.accel))


@pytest.mark.parametrize(
    ("how", "error", "said"),
    [
        ({"accel": 1.0 / 9.80665}, ModelError, "median of 1.* m/s², expected about 9.81"),
        ({"accel": 0.0}, DataError, "none of the first samples is a measurement"),
        ({"step": 1e-3}, DataError, "not in nanoseconds"),
        ({"step": 2.0}, ModelError, "expected 200.0 Hz"),
    ],
)
def test_units_and_a_rate_that_no_model_may_correct_are_refused(
    how: dict[str, float], error: type[Exception], said: str, imu: Imu
) -> None:
    """Of an accelerometer in g the bias at rest was 8.8 m/s², without a word."""
    with pytest.raises(error, match=said):
        run(altered(imu, **how), api.load_model("euroc-adis16448-linear"), Malformed())
    if "accel" in how:
        with pytest.raises(error, match=said):
            run(altered(imu, **how), api.load_model("static"), Malformed())


def test_a_model_that_turns_out_to_be_unfit_is_named_while_the_stream_goes_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(stream_fit, "JUDGED_S", (9.5,))
    moving = api.example_recording(duration_s=14.0).imu
    moving = moving.rows(slice(800, None))
    model = api.load_model("euroc-adis16448-linear")
    rest = model.prior_mean
    own = Imu(moving.t_ns, moving.gyro + rest[:3], moving.accel + rest[3:])
    wrong = list(stream(Imu(own.t_ns, np.degrees(own.gyro), own.accel)))
    last_ns, waited = wrong[-1].stamp_ns, time.perf_counter()

    def until_said(found: Sample, *_: object) -> None:
        while found.stamp_ns == last_ns and "is unfit" not in caplog.text and time.perf_counter() - waited < 60.0:
            time.sleep(0.01)
        if found.stamp_ns == last_ns:
            assert "is unfit" in caplog.text

    done = run(iter(wrong), model, Malformed(), each=until_said, force=True)
    assert done.fit is not None
    assert done.fit.verdict == "unfit"
    caplog.clear()
    fits = run(stream(own), model, Malformed())
    assert fits.fit is not None
    assert fits.fit.verdict != "unfit"
    assert not caplog.records


@pytest.mark.parametrize("stray_ns", [0, 1 << 62])
def test_one_stray_stamp_does_not_end_the_wait_for_the_start(imu: Imu, stray_ns: int, caplog: pytest.LogCaptureFixture) -> None:
    """As of a driver whose first message has no time yet."""
    samples = list(stream(imu))
    done = run(iter([samples[0]._replace(stamp_ns=stray_ns), *samples]), api.load_model("static"), Malformed())
    alone = run(iter(samples), api.load_model("static"), Malformed())
    assert (done.start, done.samples, done.gaps) == (alone.start, alone.samples + 1, 1)
    np.testing.assert_allclose(done.gyro_bias, alone.gyro_bias, atol=1e-5)
    assert "the clock jumps" in caplog.text


def test_a_sample_may_come_again_without_its_temperature(imu: Imu) -> None:
    twice = [again for each in stream(imu.rows(slice(0, 600))) for again in (each._replace(temperature=20.0), each)]
    assert run(iter(twice), api.load_model("static"), Malformed()).out_of_order == 600


def test_a_clock_that_begins_below_zero_does_not_jump(imu: Imu, caplog: pytest.LogCaptureFixture) -> None:
    """As one that counts to an event; its seconds were counted from zero, and nothing of it was shown."""
    early = [found._replace(stamp_ns=found.stamp_ns - int(imu.t_ns[0]) - 10**15) for found in stream(imu)]
    shown: list[int] = []
    done = run(
        iter(early), api.load_model("static"), Malformed(), show=lambda block: shown.extend(block.batch.stamp_ns.tolist())
    )
    assert (done.seconds, done.gaps) == (pytest.approx(8.0), 0)
    assert shown == [found.stamp_ns for found in early]
    assert "the clock jumps" not in caplog.text


def test_a_clock_that_jumps_at_each_sample_does_not_delay_the_start_for_ever(imu: Imu, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "MAX_FIRST", 100)
    corrected: list[int] = []
    odd = (found._replace(stamp_ns=found.stamp_ns + k % 2 * 10**15) for k, found in enumerate(stream(imu)))
    first = (found for found, _ in zip(odd, range(101), strict=False))
    linear = api.load_model("fetch-linear")
    run(first, linear, Malformed(), each=lambda found, rate, force: corrected.append(found.stamp_ns))
    assert len(corrected) == 101


@pytest.mark.parametrize("time", ['"t_s": 1e300', '"t_ns": 9223372036854775807', '"t_ns": 99999999999999999999999'])
def test_a_time_out_of_range_is_no_sample(time: str) -> None:
    malformed = Malformed()
    assert list(decoded(PLAIN.replace('"t_ns": 5', time), 0.0, malformed)) == [None]
    assert malformed.count == 1


def test_a_source_of_other_messages_is_named_and_ends_in_time(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    clock = itertools.count()  # a second at each look: on a busy machine a real one may leap over the warning
    monkeypatch.setattr(sources, "time", SimpleNamespace(perf_counter=lambda: float(next(clock))))
    monkeypatch.setattr(sources, "SILENT_S", 10.0)
    malformed = Malformed()
    others = (found for _ in range(10**6) for found in decoded('{"ax": 1}', 0.0, malformed))
    assert list(sources.timely(iter(others), 30.0, malformed)) == []
    assert malformed.count < 40
    assert "no sample for 11 s; the first of" in caplog.text


def test_a_stream_without_samples_and_one_without_rest_say_what_to_do(imu: Imu) -> None:
    malformed = Malformed()
    malformed.add("nonsense", ValueError("no JSON"))
    with pytest.raises(DataError, match=r"no samples; the first of 1 messages: no JSON: 'nonsense'"):
        run(iter([None]), api.load_model("static"), malformed)
    moving = imu.rows(slice(800, None))
    with pytest.raises(DataError, match=r"the stream: it does not start at rest\. Leave the sensor still for 2 s"):
        run(stream(moving), api.load_model("static"), Malformed())
    with pytest.raises(DataError, match=r"the stream: it ended after 1 sample, 0 s\. Leave the sensor still"):
        run(stream(moving.rows(slice(0, 1))), api.load_model("static"), Malformed())


@pytest.mark.parametrize(
    "name",
    ["udp://127.0.0.1", "udp://h:99999", "zenoh://x:1/", "ftp://x/y", "rosbridge://127.0.0.1:9", "rosbridge://127.0.0.1:9/imu"],
)
def test_a_wrong_source_is_refused_at_once(name: str) -> None:
    with pytest.raises(ConfigError):
        open_source(name, Malformed())


def test_a_zenoh_address_without_a_key_says_so() -> None:
    """Zenoh itself names a place in its own source code."""
    with pytest.raises(ConfigError, match=r"'zenoh://127\.0\.0\.1:1/' names no key; expected zenoh://\[HOST:PORT\]/KEY"):
        open_source("zenoh://127.0.0.1:1/", Malformed())


def test_closed_standard_input_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # as Python does for `<&-`
    with pytest.raises(ConfigError, match="standard input is closed"):
        open_source("stdin", Malformed())


def test_a_log_of_a_web_server_is_replayed(logs: Path) -> None:
    handler = partial(SimpleHTTPRequestHandler, directory=str(logs))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            source = open_source(f"http://127.0.0.1:{server.server_port}/flight_1.mcap", Malformed(), speed=100.0)
            found = next(source)
            source.close()  # type: ignore[attr-defined]
        finally:
            server.shutdown()
            thread.join()
    assert found is not None
    assert found.stamp_ns == api.read(logs / "flight_1.mcap").imu.t_ns[0]


def test_a_source_that_nobody_reads_is_closed(logs: Path) -> None:
    """As when the output of the command is refused."""
    source = open_source(str(logs / "flight_1.mcap"), Malformed())
    opened = [entry.readlink() for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()]
    assert opened.count(logs / "flight_1.mcap") == 1
    del source
    assert not any(entry.readlink() == logs / "flight_1.mcap" for entry in Path("/proc/self/fd").iterdir() if entry.exists())


def test_a_refused_stream_is_closed_while_its_error_is_looked_at(tmp_path: Path) -> None:
    """From Python 3.13 on the log stayed open until the next collection of garbage."""
    recording = api.example_recording(duration_s=4.0)
    huge = replace(recording.imu, accel=np.full_like(recording.imu.accel, 1e30))
    api.write(tmp_path / "huge.mcap", replace(recording, imu=huge))
    with pytest.raises(DataError, match="none of the first samples is a measurement") as refused:
        live(log=str(tmp_path / "huge.mcap"), speed=1e9, no_view=True)
    assert refused.tb is not None
    opened = [entry.readlink() for entry in Path("/proc/self/fd").iterdir() if entry.is_symlink()]
    assert tmp_path / "huge.mcap" not in opened


def test_datagrams_are_samples(imu: Imu, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "WAIT_S", 0.01)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    malformed = Malformed()
    source = open_source(f"udp://127.0.0.1:{port}", malformed)
    with pytest.raises(ConfigError, match="cannot be bound"):
        open_source(f"udp://127.0.0.1:{port}", malformed)
    assert next(source) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto("\n".join([lines(imu)[0], "nonsense", lines(imu)[1]]).encode(), ("127.0.0.1", port))
    found = [next(source) for _ in range(3)]
    assert [one and one.stamp_ns for one in found] == [imu.t_ns[0], None, imu.t_ns[1]]
    assert malformed.count == 1
    source.close()  # type: ignore[attr-defined]


def test_drawing_that_begins_late_loses_nothing_of_a_minute() -> None:
    """A log that was replayed 30 times as fast was saved without half of its samples on a busy machine."""
    ended, drawn = threading.Event(), list[int]()

    def samples() -> Iterator[Sample]:
        yield from (Sample(n * 100_000_000, (0.0, 0.0, 0.001 * (n % 2)), (0.0, 0.0, 9.81), 0.0) for n in range(600))
        ended.set()

    def show(block: Any) -> None:
        ended.wait()
        drawn.append(len(block.batch.stamp_ns))

    assert run(samples(), api.load_model("static"), Malformed(), show=show).not_shown == 0
    assert sum(drawn) == 600


@pytest.mark.parametrize("lost", [False, True])
def test_a_rosbridge_is_subscribed_to(imu: Imu, caplog: pytest.LogCaptureFixture, lost: bool) -> None:
    from websockets.sync.server import serve

    asked: list[Any] = []

    def publish(line: Any) -> None:
        asked.append(json.loads(line.recv()))
        for t_ns in imu.t_ns[:3].tolist():
            stamp = f'"sec": {t_ns // 10**9}, "nanosec": {t_ns % 10**9}'
            line.send('{"op": "publish", "topic": "/imu", "msg": %s}' % (MESSAGE % stamp))
        if lost:
            line.close_socket()
        line.close()

    with serve(publish, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        port = server.socket.getsockname()[1]
        found = list(open_source(f"rosbridge://127.0.0.1:{port}/imu/data", Malformed()))
        server.shutdown()
        thread.join()
    assert ("the connection is lost" in caplog.text) == lost
    assert asked == [{"op": "subscribe", "topic": "/imu/data"}]
    assert [one.stamp_ns for one in found if one is not None] == imu.t_ns[:3].tolist()


def test_zenoh_carries_json_and_cdr(imu: Imu) -> None:
    import zenoh

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    malformed = Malformed()
    with zenoh.open(config) as session:
        source = open_source(f"zenoh://127.0.0.1:{port}/0/robot/imu/**", malformed)
        publisher = session.declare_publisher("0/robot/imu/sensor_msgs::msg::dds_::Imu_/RIHS01_0")  # as rmw_zenoh's keys are
        while not publisher.matching_status.matching:
            time.sleep(0.01)
        publisher.put(lines(imu)[0])
        publisher.put(b"nonsense")
        for row in encode_imu(imu.t_ns[1:3], imu.gyro[1:3], imu.accel[1:3], "imu"):  # as rmw_zenoh publishes
            publisher.put(row.tobytes())
        found = [next(source) for _ in range(4)]
        source.close()  # type: ignore[attr-defined]
    assert [one.stamp_ns for one in found if one is not None] == imu.t_ns[:3].tolist()
    np.testing.assert_array_equal([one.gyro for one in found if one is not None], imu.gyro[:3])
    assert malformed.count == 1


def test_the_command_replays_a_log_and_reports_the_delay(logs: Path, tmp_path: Path, imutool: Imutool) -> None:
    words = ("live", logs / "flight_1.mcap", "--speed", "6", "--save", "live.rrd", "--json", "r.json")
    done = imutool(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "99 % within" in done.stdout
    report = json.loads((tmp_path / "r.json").read_text())
    assert_valid(report)
    assert report["stream"]["samples"] > 4000
    assert (tmp_path / "live.rrd").stat().st_size > 100_000
    assert imutool(*words, cwd=tmp_path).returncode == 3  # the file exists


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_standard_input_is_printed_debiased_until_ctrl_c(
    imu: Imu, tmp_path: Path, command: str, number: signal.Signals
) -> None:
    line = [command, "live", "--from", "stdin", "--no-view", "--print", "--json", str(tmp_path / "r.json")]
    with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        given = "\n".join([*lines(imu), "nonsense", ""])
        writer = threading.Thread(target=lambda: (process.stdin.write(given), process.stdin.flush()))  # else both pipes fill up
        writer.start()
        printed = [json.loads(process.stdout.readline()) for _ in range(len(imu))]
        writer.join()
        time.sleep(0.2)
        process.send_signal(number)
        told = process.stderr.read()
        assert process.wait(30) == 0, told
    assert [row["t_ns"] for row in printed] == imu.t_ns.tolist()
    assert "messages without a sample: 1" in told
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["stream"]["samples"], report["stream"]["malformed"]) == (len(imu), 1)


def test_a_line_without_an_end_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    with os.fdopen(reading) as given:
        monkeypatch.setattr(sys, "stdin", given)
        monkeypatch.setattr(sources, "MAX_BYTES", 100)
        malformed = Malformed()
        source = open_source("stdin", malformed)
        os.write(writing, b"x" * 1000 + b"\n" + PLAIN.encode() + b"\n")
        os.close(writing)
        assert [one.stamp_ns for one in source if one is not None] == [5]
        assert malformed.count >= 1
