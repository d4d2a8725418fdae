"""Packed recordings: the log is that of the unpacked file, the folder goes, and hostile archives are refused."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import signal
import stat
import tarfile
import tracemalloc
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
import zstandard

from imutool.api.logs import convert
from imutool.conversion.workers import ConvertReport
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.read import read
from imutool.mcap_io.write import write
from imutool.recording import Imu, Recording

PACKERS: Mapping[str, Callable[[bytes], bytes]] = {
    "gz": gzip.compress,
    "xz": lzma.compress,
    "bz2": bz2.compress,
    "zst": lambda raw: zstandard.compress(raw[: len(raw) // 2]) + zstandard.compress(raw[len(raw) // 2 :]),
}
MIB = 1 << 20


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log of noise, which hardly packs."""
    rng = np.random.default_rng(0)
    imu = Imu(np.arange(500, dtype=np.int64) * 5_000_000 + 10**18, rng.normal(size=(500, 3)), rng.normal(size=(500, 3)))
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    write(Recording("walk", imu), tmp_path / "in/walk.mcap")
    return tmp_path / "in/walk.mcap"


def zipped(path: Path, files: Mapping[str, bytes], packing: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def tarred(path: Path, members: Mapping[str, bytes | tarfile.TarInfo]) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in members.items():
            info = content if isinstance(content, tarfile.TarInfo) else tarfile.TarInfo(name)
            info.name = name
            if isinstance(content, bytes):
                info.size = len(content)
            archive.addfile(info, io.BytesIO(content) if isinstance(content, bytes) else None)
    return path


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def converted(source: Path, out: Path) -> ConvertReport:
    """What `convert` reports, when it is seen that the source is as it was and that nothing but the logs came."""
    before = source.read_bytes()
    report = convert(source, out, workers=1)
    assert source.read_bytes() == before
    assert sorted(path.name for path in out.parent.rglob("*") if path.is_file()) == sorted(p.name for p in report.written)
    assert [note for note in report.notes if note.startswith(f"{source.name}: it is packed")] == report.notes[:1]
    return report


def refused(source: Path, match: str) -> None:
    """The source is refused, and nothing is left of it, neither next to the target nor anywhere above."""
    out = source.parents[1] / "out"
    before = sorted(source.parents[1].rglob("*"))
    with pytest.raises(DataError, match=match) as error:
        convert(source, out / "b.mcap")
    assert ".imutool-" not in str(error.value)
    assert sorted(source.parents[1].rglob("*")) == before


@pytest.mark.parametrize("ending", [*PACKERS, "zip", "tar.gz", "tar.xz", "tar.zst"])
def test_a_packed_log_becomes_the_log_of_the_unpacked_one(log: Path, ending: str) -> None:
    raw, source, out = log.read_bytes(), log.with_name(f"walk.mcap.{ending}"), log.parents[1] / "out/b.mcap"
    if ending == "zip":
        zipped(source, {"some/walk.mcap": raw, "__MACOSX/some/._walk.mcap": b"x"})
    elif ending == "tar.gz":
        tarred(source, {"./some/walk.mcap": raw})
    elif ending.startswith("tar"):
        tar = gzip.decompress(tarred(log.with_name("a.tgz"), {"some/walk.mcap": raw}).read_bytes())
        source.write_bytes(PACKERS[ending.removeprefix("tar.")](tar))
    else:
        source.write_bytes(PACKERS[ending](raw))
    converted(source, out)
    convert(log, log.parents[1] / "plain.mcap")
    assert out.read_bytes() == (log.parents[1] / "plain.mcap").read_bytes()
    assert read(out).name == "walk"


def test_an_archive_of_several_recordings_becomes_a_log_for_each(log: Path) -> None:
    rows = "\n".join(f"{n / 100},0.1,{n % 7 / 10},0.3,0.1,0.2,9.8" for n in range(200))
    header = "time [s],gyr_x [rad/s],gyr_y [rad/s],gyr_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n"
    tables = {f"day/{name}/imu.csv": (header + rows).encode() for name in ("a", "b")}
    source = zipped(log.with_name("day.zip"), tables)
    with pytest.raises(ConfigError, match=r"several sequences do not fit into one file \(a, b\)"):
        convert(source, log.parents[1] / "out/b.mcap")
    report = converted(source, log.parents[1] / "out/logs")
    assert sorted(path.name for path in report.written) == ["a.mcap", "b.mcap"]


def test_packed_files_in_a_folder_and_in_each_other_become_logs_beside_the_others(log: Path) -> None:
    """The table is read where it is; the archive of an archive, the packed log and the damaged one are unpacked."""
    raw, folder, out = log.read_bytes(), log.parent, log.parents[1] / "out"
    log.unlink()
    rows = "\n".join(f"{n / 100},0.1,{n % 7 / 10},0.3,0.1,0.2,9.8" for n in range(200))
    table = f"time [s],gyr_x [rad/s],gyr_y [rad/s],gyr_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n{rows}".encode()
    (folder / "a").mkdir()
    (folder / "a/run.csv.gz").write_bytes(gzip.compress(table))
    inner = zipped(folder / "inner.zip", {"ride/imu.csv": table}).read_bytes()
    (folder / "inner.zip").unlink()
    tarred(folder / "day.tar.gz", {"more/inner.zip": inner})
    zipped(folder / "notes.zip", {"readme.md": b"no recording"})
    (folder / "flight.mcap.zst").write_bytes(zstandard.compress(raw))
    (folder / "cut.mcap.zst").write_bytes(zstandard.compress(raw)[:-100])
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    report = convert(folder, out, workers=1)
    assert sorted(path.name for path in report.written) == ["a.mcap", "ride.mcap"]  # `flight` is a log of imutool itself
    assert [(failure.name, "cut off" in failure.message) for failure in report.failures] == [("cut.mcap.zst", True)]
    assert "day.tar.gz: it is packed, and was unpacked into a temporary folder" in report.notes
    assert "notes.zip: it is packed, and nothing in it shows that it is a recording" in report.notes
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert left(out) == ["a.mcap", "ride.mcap"]


def test_a_folder_of_packed_logs_alone_becomes_a_log_for_each(log: Path) -> None:
    raw, folder = log.read_bytes(), log.parent
    log.unlink()
    for number in (1, 2):
        (folder / f"day{number}").mkdir()
        (folder / f"day{number}/walk.mcap.gz").write_bytes(gzip.compress(raw))
    report = convert(folder, log.parents[1] / "out", workers=1)
    assert sorted(path.name for path in report.written) == ["day1_walk.mcap", "day2_walk.mcap"]
    assert read(report.written[0]).imu.gyro.shape == (500, 3)


def test_a_log_is_not_written_over_its_packed_source(log: Path) -> None:
    log.write_bytes(zstandard.compress(log.read_bytes()))
    before = log.read_bytes()
    for out, why in ((log, "is the source itself"), (log.parent, "would replace the source")):
        with pytest.raises(ConfigError, match=why):
            convert(log, out, overwrite=True)
    assert log.read_bytes() == before
    assert left(log.parent) == ["walk.mcap"]


@pytest.mark.parametrize("ending", [*PACKERS, "zip", "tar.gz"])
def test_a_packed_log_that_is_cut_is_refused(log: Path, ending: str) -> None:
    raw, source = log.read_bytes(), log.with_name(f"walk.mcap.{ending}")
    if ending in PACKERS:
        source.write_bytes(PACKERS[ending](raw))
    else:
        (zipped if ending == "zip" else tarred)(source, {"walk.mcap": raw})
    source.write_bytes(source.read_bytes()[:-300])
    refused(source, rf"walk\.mcap\.{ending}: cannot be (read|unpacked)")


def test_a_damaged_member_of_a_zip_is_refused(log: Path) -> None:
    source = zipped(log.with_name("walk.zip"), {"walk.mcap": log.read_bytes()}, zipfile.ZIP_STORED)
    raw = bytearray(source.read_bytes())
    raw[2_000] ^= 1
    source.write_bytes(raw)
    refused(source, r"walk\.zip: cannot be read \(Bad CRC-32 for file 'walk\.mcap'\)")


def test_an_encrypted_zip_is_refused(log: Path) -> None:
    source = zipped(log.with_name("walk.zip"), {"walk.mcap": log.read_bytes()})
    raw = bytearray(source.read_bytes())
    for start, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        raw[raw.index(start) + flags] |= 1
    source.write_bytes(raw)
    refused(source, r"walk\.zip/walk\.mcap: is encrypted.*Unpack it with its password")


def test_a_member_of_a_zip_without_a_name_is_left_out(log: Path, tmp_path: Path) -> None:
    source = zipped(log.with_name("walk.zip"), {"walk.mcap": log.read_bytes(), "extra": b"1"})
    source.write_bytes(source.read_bytes().replace(b"extra", bytes(5)))
    log.unlink()
    convert(log.parent, tmp_path / "out")
    assert [path.name for path in tmp_path.glob("out/**/*.mcap")] == ["walk.mcap"]


@pytest.mark.parametrize("name", ["../walk.mcap", "/tmp/walk.mcap", "a/../../walk.mcap"])
@pytest.mark.parametrize("pack", [zipped, tarred])
def test_a_member_outside_the_archive_is_refused(log: Path, name: str, pack: Callable[..., Path]) -> None:
    refused(pack(log.with_name("walk.zip" if pack is zipped else "walk.tgz"), {name: log.read_bytes()}), "points outside")


def test_a_member_outside_a_packed_tar_is_refused(log: Path) -> None:
    tar = gzip.decompress(tarred(log.with_name("a.tgz"), {"../walk.mcap": log.read_bytes()}).read_bytes())
    log.with_name("walk.tar.xz").write_bytes(lzma.compress(tar))
    refused(log.with_name("walk.tar.xz"), "points outside")


def special(kind: bytes, target: str = "") -> tarfile.TarInfo:
    info = tarfile.TarInfo()
    info.type, info.linkname = kind, target
    return info


@pytest.mark.parametrize(
    ("member", "match"),
    [
        (special(tarfile.SYMTYPE, "../../secret.mcap"), "is a link to '../../secret.mcap'"),
        (special(tarfile.LNKTYPE, "/secret.mcap"), "is a link to '/secret.mcap'"),
        (special(tarfile.CHRTYPE), "is a device"),
        (special(tarfile.FIFOTYPE), "is a device"),
        (special(tarfile.SYMTYPE, "other.mcap"), "it holds no files"),  # inside, but never followed
    ],
)
def test_links_and_devices_are_refused(log: Path, member: tarfile.TarInfo, match: str) -> None:
    refused(tarred(log.with_name("walk.tar.gz"), {"walk.mcap": member}), match)


def test_a_link_in_a_zip_is_refused(log: Path) -> None:
    with zipfile.ZipFile(log.with_name("walk.zip"), "w") as archive:
        info = zipfile.ZipInfo("walk.mcap")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        archive.writestr(info, "../secret.mcap")
    refused(log.with_name("walk.zip"), "is a link to '../secret.mcap'")


@pytest.mark.parametrize("ending", [*PACKERS, "zip"])
def test_a_bomb_is_refused_in_little_memory(log: Path, ending: str) -> None:
    source, bomb = log.with_name(f"walk.bin.{ending}"), bytes(64 * MIB)
    if ending == "zip":
        zipped(source, {"walk.bin": bomb})
    else:
        source.write_bytes({**PACKERS, "gz": lambda raw: gzip.compress(raw, 6)}[ending](bomb))
    del bomb
    tracemalloc.start()
    refused(source, r"walk\.bin.*unpacks to .* bytes.*at most 100 to 1")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 * MIB


@pytest.mark.parametrize("ending", ["gz", "zip"])
def test_more_than_half_of_the_free_disk_is_refused(log: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = log.with_name(f"walk.mcap.{ending}")
    if ending == "zip":
        zipped(source, {"walk.mcap": log.read_bytes()})
    else:
        source.write_bytes(gzip.compress(log.read_bytes()))
    usage = shutil.disk_usage(log)._replace(free=log.stat().st_size)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    refused(source, "half of the free disk of the target.*larger disk")


def test_a_failure_names_the_packed_file(log: Path) -> None:
    source = log.with_name("walk.mcap.gz")
    source.write_bytes(gzip.compress(log.read_bytes()[:100]))
    with pytest.raises(Exception, match=r"walk\.mcap\.gz") as error:
        convert(source, log.parents[1] / "out/b.mcap")
    assert ".imutool-" not in str(error.value)
    assert left(log.parents[1] / "out") == []


def test_after_an_interrupt_nothing_is_left(log: Path) -> None:
    source = log.with_name("walk.mcap.gz")
    source.write_bytes(gzip.compress(log.read_bytes()))
    seen: list[str] = []

    def interrupt(*_: object) -> None:
        seen.extend(left(log.parents[1] / "out"))
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        convert(source, log.parents[1] / "out/b.mcap", progress=interrupt)
    assert any(name.startswith(".imutool-") for name in seen)
    assert left(log.parents[1] / "out") == ["b.mcap"]  # which was whole


def test_a_warning_about_a_packed_file_names_the_source(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = "\n".join(f"{n / 100},0.1,{n % 7 / 10},0.3,0.1,0.2,9.8" for n in range(200))
    table = f"time [s],gyr_x [rad/s],gyr_y [rad/s],gyr_z [rad/s],acc_x [m/s^2],acc_y [m/s^2],acc_z [m/s^2]\n{rows}".encode()
    source = zipped(tmp_path / "day.zip", {"ride/imu.csv": table, "ride/cut.json": b'[{"t": 1, "x": 2}, {'})
    convert(source, tmp_path / "out", workers=1)
    (said,) = (record.getMessage() for record in caplog.records if "cut.json" in record.getMessage())
    assert f"{source}/ride/cut.json" in said
