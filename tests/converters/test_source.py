"""Hostile and damaged archives are refused with archive and member named; harmless oddities are not."""

from __future__ import annotations

import gzip
import io
import struct
import tarfile
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from imutool.converters import _archive, euroc
from imutool.converters._source import find
from imutool.errors import ConfigError, DataError

MEMORY_BOUND = 64 << 20  # far below what the bombs here unpack to, well above what reading a small archive takes


def member(name, kind=tarfile.REGTYPE, link=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, link
    return info


def refused(source, message):
    with pytest.raises(DataError, match=message) as failure:
        list(euroc.read(source))
    assert str(source) in str(failure.value)
    return failure.value


HOSTILE_NAMES = ["/etc/passwd", "../outside.csv", "mav0/../../outside.csv", "mav0\\..\\outside.csv", "C:/outside.csv"]


@pytest.mark.parametrize("name", HOSTILE_NAMES)
@pytest.mark.parametrize("form", ["zip", "tar", "tar.gz"])
def test_names_that_point_outside_are_refused(make, name, form):
    files = {**make.files("euroc"), name: b"x"}
    source = make.zip("one.zip", files) if form == "zip" else make.tar(f"one.{form}", files)
    error = refused(source, "points outside the archive")
    assert repr(name) in error.what


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("mav0/imu0/data.csv", "/etc/passwd"),
        ("mav0/state_groundtruth_estimate0/data.csv", "../imu0/data.csv"),
        ("elsewhere", "/etc/passwd"),
        ("a/elsewhere", "../../outside"),
    ],
)
@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE])
def test_links_that_would_be_read_or_leave_the_archive_are_refused(make, name, target, kind):
    files = {n: c for n, c in make.files("euroc").items() if n != name}
    refused(make.tar("one.tar", files, extra=(member(name, kind, target),)), "is a link to")


def test_a_link_in_a_zip_is_refused(make):
    files = make.files("euroc")
    content = files.pop("mav0/imu0/data.csv")
    source = make.zip("one.zip", files)
    assert content
    with zipfile.ZipFile(source, "a") as archive:
        info = zipfile.ZipInfo("mav0/imu0/data.csv")
        info.external_attr = 0o120777 << 16
        archive.writestr(info, "/etc/passwd")
    refused(source, "is a link to '/etc/passwd'")


def test_a_link_beside_the_sequence_that_stays_inside_is_not_followed_and_does_no_harm(make):
    link = member("one/dso/images", tarfile.SYMTYPE, "../mav0/cam0/data")
    files = {f"one/{name}": content for name, content in make.files("euroc").items()}
    (recording,) = euroc.read(make.tar("one.tar", files, extra=(link,)))
    assert recording.name == "one"


@pytest.mark.parametrize("kind", [tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE])
def test_devices_are_refused(make, kind):
    refused(make.tar("one.tar", make.files("euroc"), extra=(member("mav0/imu0/x", kind),)), "is a device")


def test_a_member_that_appears_twice_is_refused(make):
    source = make.tar("one.tar", make.files("euroc"), extra=(member("mav0/imu0/data.csv"),))
    refused(source, "mav0/imu0/data.csv: is in the archive twice")


def test_too_many_members_are_refused(make, monkeypatch):
    monkeypatch.setattr(_archive, "MAX_MEMBERS", 5)
    refused(make.zip("one.zip", make.files("euroc")), "more than 5 members")
    refused(make.tar("one.tar", make.files("euroc")), "more than 5 members")


@pytest.mark.parametrize("form", ["zip", "tar", "tar.gz", "folder"])
def test_a_member_larger_than_its_kind_may_be_is_refused(make, form, monkeypatch):
    monkeypatch.setitem(_archive.LIMITS, ".yaml", 10)
    source = {"zip": make.zip, "tar": make.tar, "tar.gz": make.tar, "folder": make.folder}[form](
        f"one.{form}", make.files("euroc")
    )
    error = refused(source, r"is \d+ bytes; expected at most 10")
    assert ".yaml" in str(error.where)


def test_a_zip_bomb_is_refused_before_it_unpacks(make):
    source = make.zip("one.zip", {**make.files("euroc"), "mav0/imu0/data.csv": b"0" * (40 << 20)})
    tracemalloc.start()
    refused(source, "mav0/imu0/data.csv: unpacks to 41943040 bytes")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MEMORY_BOUND


def test_members_that_share_their_bytes_are_refused_by_their_sum(make, monkeypatch):
    """A directory whose entries all point at the same packed bytes: each is within its bound, together they never end."""
    monkeypatch.setattr(_archive, "RATIO_FREE", 1 << 20)
    source = make.zip("one.zip", {**make.files("euroc"), "mav0/cam0/data/1.png": b"0" * 900_000})
    raw = source.read_bytes()
    at = raw.rindex(b"PK\5\6")
    entry = raw[raw.rindex(b"PK\1\2") : at]
    entries = [entry.replace(b"1.png", f"{n % 10}.png".encode()) for n in range(2, 10)]
    count = struct.unpack_from("<H", raw, at + 10)[0] + len(entries)
    (start,) = struct.unpack_from("<I", raw, at + 16)
    more = b"".join(entries)
    end = raw[at : at + 8] + struct.pack("<HHII", count, count, at - start + len(more), start) + raw[at + 20 :]
    source.write_bytes(raw[:at] + more + end)
    refused(source, "unpacks to more than")


def test_a_zip_with_a_password_is_refused(make):
    source = make.zip("one.zip", make.files("euroc"))
    raw = bytearray(source.read_bytes())
    for sign, flags in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        at = raw.find(sign)
        while at >= 0:
            raw[at + flags] |= 1
            at = raw.find(sign, at + 1)
    source.write_bytes(raw)
    refused(source, "cannot be read .*(encrypted|password)")


@pytest.mark.parametrize("form", ["zip", "tar"])
@pytest.mark.parametrize("name", ["mav0/imu0/data\n.csv", "mav0/imu0/\x1b[31mdata.csv", "mav0/\u202egnp.csv"])
def test_names_with_control_characters_are_never_read_nor_said(make, form, name):
    pack = {"zip": make.zip, "tar": make.tar}[form]
    (recording,) = euroc.read(pack(f"one.{form}", {**make.files("euroc"), name: b"#\n"}))
    assert len(recording.imu)
    error = refused(pack(f"two.{form}", {f"../{name}": b"#\n"}), "points outside the archive")
    assert str(error).isprintable()


def test_a_member_that_unpacks_to_more_than_it_declares_is_cut_at_its_declared_size(make, monkeypatch):
    """A zip whose directory lies about a size: zipfile stops there and the checksum gives it away."""
    files = make.files("euroc")
    source = make.zip("one.zip", files)
    real = len(files["mav0/imu0/data.csv"])
    raw = source.read_bytes()
    assert raw.count(struct.pack("<I", real)) >= 2  # the local header and the directory
    source.write_bytes(raw.replace(struct.pack("<I", real), struct.pack("<I", 100)))
    refused(source, "mav0/imu0/data.csv: cannot be read")


@pytest.mark.parametrize("where", ["data", "long name"])
def test_a_tar_gz_bomb_is_refused_before_it_fills_the_memory(make, where):
    source = make.tmp / "one.tar.gz"
    size = 100 << 20
    header = tarfile.TarInfo("mav0/imu0/data.csv" if where == "data" else "././@LongLink")
    header.type, header.size = (tarfile.REGTYPE if where == "data" else tarfile.GNUTYPE_LONGNAME), size
    with gzip.open(source, "wb", compresslevel=6) as file:
        file.write(header.tobuf(tarfile.GNU_FORMAT))
        for _ in range(size >> 20):
            file.write(bytes(1 << 20))
        file.write(bytes(1024))
    tracemalloc.start()
    error = refused(source, "unpacks to more than|has a header of")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(source) in str(error.where)
    assert peak < MEMORY_BOUND


def test_a_sparse_member_is_refused(make):
    pax = member("mav0/imu0/data.csv")
    pax.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.minor": "0", "GNU.sparse.realsize": "1000000000000"}
    pax.size = 512
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as archive:
        archive.addfile(pax, io.BytesIO(b"0\n".ljust(512, b"\0")))
    source = make.tmp / "one.tar"
    source.write_bytes(buffer.getvalue())
    refused(source, "sparse")


@pytest.mark.parametrize("form", ["zip", "tar", "tar.gz"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.6, 0.95])
def test_a_truncated_archive_is_refused(make, form, part):
    files = make.files("euroc")
    source = make.zip("one.zip", files) if form == "zip" else make.tar(f"one.{form}", files)
    whole = source.read_bytes()
    if form == "tar":  # its end is padding; cut into what matters
        whole = whole.rstrip(b"\0")
    source.write_bytes(whole[: int(len(whole) * part)])
    refused(source, "is empty|cannot be read|cut off")


def test_a_damaged_header_in_the_middle_of_a_tar_is_not_taken_for_its_end(make):
    files = make.files("euroc")
    source = make.tar("one.tar", files)
    raw = bytearray(source.read_bytes())
    at = raw.index(b"mav0/state_groundtruth_estimate0/data.csv")
    raw[at : at + 4] = b"XXXX"
    source.write_bytes(raw)
    refused(source, "cut off or damaged")


def test_damage_inside_a_zip_member_is_found_by_its_checksum(make):
    files = make.files("euroc")
    source = make.tmp / "one.zip"
    with zipfile.ZipFile(source, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    source.write_bytes(source.read_bytes().replace(b",9.003,", b",9.903,"))
    refused(source, "mav0/imu0/data.csv: cannot be read")


def test_a_member_of_a_zip_without_a_name_is_left_out(make):
    source = make.tmp / "one.zip"
    nameless = zipfile.ZipInfo("x")
    nameless.filename = ""
    with zipfile.ZipFile(source, "w") as archive:
        archive.writestr(nameless, b"1")
        for name, content in make.files("euroc").items():
            archive.writestr(name, content)
    assert [len(recording.imu) > 0 for recording in euroc.read(source)] == [True]


def test_a_text_file_named_zip_is_refused(make):
    source = make.tmp / "one.zip"
    source.write_text("<html>404</html>")
    refused(source, "not a zip file")


def test_what_a_mac_leaves_in_an_archive_is_no_sequence(make):
    extra = {"__MACOSX/mav0/._body.yaml": b"x", "__MACOSX/mav0/imu0/._data.csv": b"x"}
    assert [s.inside for s in find(make.zip("one.zip", {**make.files("euroc"), **extra}))] == [""]


def test_a_broken_archive_in_a_folder_is_listed_and_the_others_too(make):
    make.zip("good.zip", make.files("euroc"))
    (make.tmp / "broken.zip").write_bytes(b"PK not really")
    broken, good = euroc.sequences(make.tmp)
    assert (broken.name, good.name) == ("broken", "good")
    with pytest.raises(DataError, match=r"broken\.zip: cannot be read"):
        euroc.recognises(broken)
    assert euroc.recognises(good)


def test_nothing_is_written_beside_a_source(make):
    make.tar("one.tar.gz", make.files("euroc"))
    before = {path: path.stat().st_mtime_ns for path in make.tmp.rglob("*")}
    (recording,) = euroc.read(make.tmp)
    list(recording.frames["/cam0/image_raw/compressed"].each())
    assert {path: path.stat().st_mtime_ns for path in make.tmp.rglob("*")} == before


def test_a_source_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        euroc.sequences(tmp_path / "nowhere")


def test_an_archive_of_archives_is_no_sequence_itself(make):
    source = make.zip("machine_hall.zip", {"machine_hall/MH_01_easy/MH_01_easy.zip": b"PK"})
    assert euroc.sequences(source) == euroc.sequences(make.tmp) == []


@pytest.mark.parametrize("spelling", ["one", "one/mav0", ".", "mav0", "mav0/.."])
def test_a_sequence_is_named_after_its_folder_however_it_is_spelled(make, spelling, monkeypatch):
    folder = make.folder("one", make.files("euroc"))
    monkeypatch.chdir(make.tmp if spelling.startswith("one") else folder)
    assert [s.name for s in find(Path(spelling))] == ["one"]
