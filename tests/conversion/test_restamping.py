"""A log in which messages share a stamp keeps them all, and the note names what spreads them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from imutool.api.logs import convert
from imutool.cleaning import raw_batches
from imutool.log_info.inspection import inspect
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording

MS, START_NS = 1_000_000, 1_700_000_000_000_000_000
T_NS = START_NS + 10 * MS * np.arange(2000)
VALUES = np.random.default_rng(4).normal([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], 1.0, (2000, 6))


def logged(path: Path, stamps: np.ndarray, rows: np.ndarray | None = None) -> Path:
    """Log whose messages have these stamps and the values of `rows`, logged a sample apart."""
    whole = path.with_name(f"whole_{path.name}")
    write(Recording("made", imu=Imu(T_NS, VALUES[:, :3], VALUES[:, 3:])), whole)
    with whole.open("rb") as file, path.open("wb") as out:
        found = [*make_reader(file).iter_messages(topics=["/imu0"])]
        writer = Writer(out)
        writer.start("ros2")
        schema, channel, _ = found[0]
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        own = writer.register_channel(channel.topic, channel.message_encoding, number)
        for n, stamp_ns in enumerate(stamps.tolist()):
            data = bytearray(found[n if rows is None else rows[n]][2].data)
            struct.pack_into("<iI", data, 4, *divmod(stamp_ns, 10**9))
            writer.add_message(own, int(T_NS[n]), bytes(data), int(T_NS[n]))
        writer.finish()
    whole.unlink()
    return path


@pytest.mark.parametrize(
    ("stamps", "max_ms"), [(np.repeat(T_NS[4::5], 5), 0.01), (T_NS // 10**9 * 10**9, 0.01)], ids=["batches", "whole seconds"]
)
def test_messages_that_share_a_stamp_are_told_of_and_restamped(stamps: np.ndarray, max_ms: float, tmp_path: Path) -> None:
    shared = int((np.diff(stamps) == 0).sum())
    report = convert(logged(tmp_path / "in.mcap", stamps), tmp_path / "kept.mcap")
    assert [note for note in report.notes if "stamp" in note] == [
        f"kept.mcap: /imu0: {shared} of 2000 messages have the stamp of the one before, and other values; "
        "imutool convert LOG OUT --restamp spreads them at the sensor's rate"
    ]
    with Log(tmp_path / "kept.mcap") as log:
        assert np.array_equal(np.concatenate([batch.stamp_ns for batch in raw_batches(log, "/imu0")]), stamps)
        assert any("--restamp" in line for line in log.metadata()["imutool/remarks"].values())
    convert(tmp_path / "in.mcap", tmp_path / "even.mcap", restamp=True)
    even = read(tmp_path / "even.mcap").imu
    assert np.abs(even.t_ns - T_NS).max() <= max_ms * MS
    assert np.array_equal(even.gyro, VALUES[:, :3])


def test_first_stamps_that_were_not_set_are_where_the_log_times_put_them(tmp_path: Path) -> None:
    """A driver publishes before it has the time; its clock may be another than the log's."""
    own = T_NS - START_NS + 3_600 * 10**9
    stamps = np.where(np.arange(2000) < 7, 0, own)
    report = convert(logged(tmp_path / "in.mcap", stamps), tmp_path / "out.mcap", restamp=True)
    assert np.abs(read(tmp_path / "out.mcap").imu.t_ns - own).max() <= 0.01 * MS
    assert any("/imu0: stamps that were not set: 7; stamps are now on a line" in note for note in report.notes)


def test_stamps_of_their_own_repeated_messages_and_stamps_never_set_are_no_shared_ones(tmp_path: Path) -> None:
    assert not convert(logged(tmp_path / "own.mcap", T_NS), tmp_path / "a.mcap").notes
    twice = np.repeat(np.arange(1000), 2)
    report = convert(logged(tmp_path / "twice.mcap", T_NS[twice], twice), tmp_path / "b.mcap")
    assert not any("stamp" in note for note in report.notes)
    unset = convert(logged(tmp_path / "unset.mcap", np.full(2000, START_NS)), tmp_path / "c.mcap")
    assert unset.notes == ["c.mcap: /imu0: the stamps were never set; imutool convert LOG OUT --restamp takes the log times"]


def test_a_table_keeps_the_samples_of_a_stamp_and_says_so_in_the_log(tmp_path: Path) -> None:
    names = [*(f"gyro_{axis} [rad/s]" for axis in "xyz"), *(f"acc_{axis} [m/s^2]" for axis in "xyz")]
    stamps_ms = np.repeat(T_NS[::5], 5) // MS
    rows = (",".join(map(repr, [int(stamp), *row])) for stamp, row in zip(stamps_ms, VALUES.tolist(), strict=True))
    (tmp_path / "phone.csv").write_text("\n".join([",".join(["time_ms", *names]), *rows]) + "\n")
    report = convert(tmp_path / "phone.csv", tmp_path / "phone.mcap")
    said = "/imu0: 1600 of 2000 samples share the stamp of another one: they are spread evenly, by up to 40 ms later"
    assert any(said in note for note in report.notes)
    with Log(tmp_path / "phone.mcap") as log:
        assert any(said in line for line in log.metadata()["imutool/remarks"].values())
    found = read(tmp_path / "phone.mcap").imu
    assert np.array_equal(found.t_ns, T_NS)
    assert np.array_equal(found.gyro, VALUES[:, :3])
    assert inspect(tmp_path / "phone.mcap").imu[0].duplicated == 0
