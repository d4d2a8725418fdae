"""Chunks that were read before the copy are only copied, and the copy is the same; the digest follows the contents."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from imutool.debiasing import Debiaser
from imutool.errors import LogError
from imutool.file_location import identity
from imutool.mcap_io.log import Log
from imutool.mcap_io.passthrough import chunk_check, source_digest
from imutool.mcap_io.passthrough.source_digest import SourceDigest
from imutool.mcap_io.rewrite import RewriteReport, rewrite

Foreign = Callable[..., Path]
Messages = list[tuple[Any, ...]]
IMU = "/imu/data"


def copied(source: Path, target: Path, keep_until_ns: int | None) -> RewriteReport:
    from imutool.bias import static
    from imutool.bias_start.initial_bias import from_numbers

    with Log(source) as log:
        log.keep([IMU])
        times = [int(t) for _, rows in log.rows([IMU], end_ns=keep_until_ns) for t in rows.log_time]
        assert times == [int(t) for stamps in log.stamps(IMU) for t in stamps if keep_until_ns is None or t <= keep_until_ns]
        return rewrite(log, target, [Debiaser(IMU, static.Model(), from_numbers("0,0,0,0,0,0"))], metadata={})


def counted_chunks(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Offsets of the chunks that are unpacked from now on."""
    unpacked, unpack = list[int](), chunk_check.records.unpack

    def counted(record: memoryview, offset: int, *others: Any) -> bytes | memoryview:
        unpacked.append(offset)
        return unpack(record, offset, *others)

    monkeypatch.setattr(chunk_check.records, "unpack", counted)
    return unpacked


def test_kept_chunks_make_the_same_copy_and_are_unpacked_once(
    foreign: Foreign, flight: Messages, layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, unpacked = foreign(flight, layout, chunk_size=10_000), counted_chunks(monkeypatch)
    with Log(source) as log:
        middle = sorted(int(t) for stamps in log.stamps(IMU) for t in stamps)[400]
    reports, counts = [], []
    for until in (0, middle, None):
        unpacked.clear()
        reports.append(copied(source, tmp_path / f"{until}.mcap", until))
        counts.append(len(unpacked))
    assert reports[0] == reports[1] == reports[2]
    assert len({(tmp_path / f"{until}.mcap").read_bytes() for until in (0, middle, None)}) == 1
    if layout in ("zstd", "lz4", "plain", "data-crc"):
        assert reports[0].chunks > 20
        assert max(counts) <= counts[0] + 3  # those that define channels are read again


def test_a_chunk_is_unpacked_once_though_it_defines_channels(
    foreign: Foreign, flight: Messages, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Log(foreign(flight, "zstd", chunk_size=10_000)) as log:
        log.keep([IMU])
        unpacked = counted_chunks(monkeypatch)
        first = [rows.payload.tobytes() for _, rows in log.rows([IMU])]
        assert len(unpacked) == len(set(unpacked)) > 20
        assert [rows.payload.tobytes() for _, rows in log.rows([IMU])] == first
        assert len(unpacked) == len(set(unpacked))


def test_a_log_that_changes_after_its_chunks_were_kept_is_refused(foreign: Foreign, flight: Messages, tmp_path: Path) -> None:
    source = foreign(flight, "zstd")
    with Log(source) as log:
        log.keep([IMU])
        assert list(log.rows([IMU]))
        os.utime(source, ns=(0, 7))
        assert identity(source) != log.index.source.identity
        with pytest.raises(LogError, match="changed while it was copied"):
            rewrite(log, tmp_path / "out.mcap", [], metadata={})
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("named", ["zstd", "unchunked"])
def test_a_large_log_has_a_digest_of_what_states_its_contents(
    foreign: Foreign, flight: Messages, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    def digest(path: Path) -> dict[str, str]:
        with Log(path) as log, SourceDigest(log.index, path) as found:
            return found.result()

    one, other = foreign(flight, named), tmp_path / "other.mcap"
    *rest, payload = flight[5]
    other.write_bytes(one.read_bytes())
    assert digest(one) == digest(other)
    assert list(digest(one)) == ["source_sha256"]
    monkeypatch.setattr(source_digest, "LARGEST_HASHED", 1000)
    stated = digest(one)
    assert stated == digest(other)
    assert list(stated) == ["source_digest"]
    changed = [*flight[:5], (*rest, bytes([*payload[:-1], payload[-1] ^ 1])), *flight[6:]]
    assert digest(foreign(changed, named)) != stated
