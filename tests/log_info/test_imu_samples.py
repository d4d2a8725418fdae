"""Samples in blocks are those that sorting the whole log gives, whatever is wrong with its stamps."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from support.imu_defects import batch_of, late, pick, repeated, with_values, write_log

from imutool.cleaning.samples import BLOCK, blocks
from imutool.log_info import clock, imu_samples
from imutool.log_info.imu_samples import ImuSamples, KeptBlocks
from imutool.log_info.inspection import inspect
from imutool.log_info.report import Interval
from imutool.mcap_io.codec import records, schemas
from imutool.mcap_io.codec.decode import ImuBatch
from imutool.mcap_io.codec.encode import encode_imu
from imutool.mcap_io.log import Log
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording

START_NS, RATE_HZ, COUNT = 1_700_000_000_000_000_000, 1000, 20_000
MAX_BYTES = 40  # a sample at 1000 Hz: means of tenths of a second; the samples alone have 56


def moving(count: int = COUNT) -> Imu:
    rng = np.random.default_rng(4)
    t_ns = START_NS + 10**9 // RATE_HZ * np.arange(count)
    return Imu(t_ns, rng.normal(size=(count, 3)), rng.normal([0.0, 0.0, 9.8], size=(count, 3)))


def defects() -> dict[str, ImuBatch]:
    whole = batch_of(moving())
    back = np.concatenate([np.arange(9000, COUNT), np.arange(9000)])
    return {
        "sound": whole,
        "not finite": with_values(whole, [5, 4096, 19_999], 2, np.nan),
        "late": late(whole, [7, 5000, 12_000], 40),
        "repeated": repeated(whole, [3, 8191], 2),
        "all": with_values(late(repeated(whole, [3, 8191], 2), [100, 9000], 3), [4, 9001], 4, np.inf),
        "set back": pick(whole, back),
    }


@pytest.mark.parametrize("name", defects())
def test_samples_come_in_order_of_time_each_stamp_once(tmp_path: Path, name: str) -> None:
    batch = defects()[name]
    write_log(batch, tmp_path / "log.mcap")
    finite = np.isfinite(batch.gyro).all(axis=1) & np.isfinite(batch.accel).all(axis=1)
    t_ns, first = np.unique(batch.stamp_ns[finite], return_index=True)
    values = np.concatenate([batch.gyro, batch.accel], axis=1)[finite][first]
    with Log(tmp_path / "log.mcap") as log:
        imu = ImuSamples(log, "/imu0")
        parts = [(samples.stamp_ns, samples.values) for samples in imu]
        stretches = [Interval(int(t_ns[a]), int(t_ns[b])) for a, b in ((0, 10), (4000, 4100), (15_000, len(t_ns) - 1))]
        within = [(stretch, part) for stretch, part in imu.within(stretches)]
    assert np.array_equal(np.concatenate([part for part, _ in parts]), t_ns)
    assert np.array_equal(np.concatenate([part for _, part in parts]), values)
    assert len(imu) == len(t_ns)
    for k, (a, b) in enumerate(((0, 11), (4000, 4101), (15_000, len(t_ns)))):
        assert np.array_equal(np.concatenate([part for stretch, part in within if stretch == k]), values[a:b])


def test_kept_samples_are_those_of_both_ends_and_too_many_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = batch_of(moving(2 * BLOCK))
    kept, few = KeptBlocks(), KeptBlocks()
    for samples in blocks([batch]):
        kept.add(samples)
    found = kept.read(int(batch.log_time[7]), int(batch.log_time[BLOCK + 3]))
    assert found is not None
    assert np.concatenate([samples.number for samples in found]).tolist() == list(range(7, BLOCK + 4))
    monkeypatch.setattr(imu_samples, "MAX_KEPT_ROWS", BLOCK)
    for samples in blocks([batch]):
        few.add(samples)
    assert few.read(None, None) is None


def test_missing_samples_are_counted_across_blocks(tmp_path: Path) -> None:
    whole = batch_of(moving())
    lost = np.array([1, 2, 3, 4095, 4096, 4097, 8192, 12_000, 19_997])
    write_log(pick(whole, np.delete(np.arange(COUNT), lost)), tmp_path / "log.mcap")
    (found,) = inspect(tmp_path / "log.mcap").imu
    assert (found.missing, found.out_of_order, found.duplicated) == (len(lost), 0, 0)


def peak_bytes(log: Path) -> int:
    tracemalloc.start()
    inspect(log)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock, "MAX_EXACT", 1 << 12)
    peaks = []
    for count in (COUNT, 5 * COUNT):
        write(Recording("log", moving(count)), tmp_path / f"{count}.mcap")
        peaks.append(peak_bytes(tmp_path / f"{count}.mcap"))
    assert peaks[1] - peaks[0] < MAX_BYTES * 4 * COUNT


def write_imus(path: Path, count: int = 10_000, imus: int = 3) -> None:
    """IMUs side by side in every chunk, each with its own noise."""
    payloads = [encode_imu(imu.t_ns, imu.gyro + k, imu.accel, f"imu{k}") for k, imu in enumerate([moving(count)] * imus)]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        kind = writer.register_schema(schemas.IMU, "ros2msg", schemas.definition(schemas.IMU).encode())
        ids = [writer.register_channel(f"/imu{k}", "cdr", kind) for k in range(imus)]
        for n, t_ns in enumerate(moving(count).t_ns.tolist()):
            for channel, payload in zip(ids, payloads, strict=True):
                writer.add_message(channel, t_ns, payload[n].tobytes(), t_ns, n)
        writer.finish()


def no_file(**_: object) -> None:
    raise OSError("No usable temporary directory found")


def test_a_chunk_is_unpacked_once_for_all_imus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_imus(tmp_path / "log.mcap")
    unpack, count = records.unpack, [0]
    monkeypatch.setattr(records, "unpack", lambda *a, **k: count.__setitem__(0, count[0] + 1) or unpack(*a, **k))
    found = inspect(tmp_path / "log.mcap")
    with Log(tmp_path / "log.mcap") as log:
        assert count[0] == 2 * len(log.index.blocks)  # to check it, and to read the IMUs; it was 7
    monkeypatch.setattr(imu_samples, "MAX_KEPT_ROWS", 1)
    assert inspect(tmp_path / "log.mcap") == found, "of many samples the log is read again"
    monkeypatch.setattr(imu_samples.tempfile, "TemporaryFile", no_file)
    assert inspect(tmp_path / "log.mcap") == found, "without a temporary file the log is read again"
    assert count[0] > 4 * len(log.index.blocks)
    assert [imu.samples for imu in found.imu] == [10_000] * 3
