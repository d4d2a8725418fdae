"""The way from a data set to logs on disk: where they go, what fails, and what an interrupt leaves."""

from __future__ import annotations

import os
import signal
import tarfile
import types
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import pool_functions
from support.loaded import loaded
from support.processes import below
from support.tables import write_csv

import imutool as imutool_api
from imutool import registry
from imutool.api.logs import convert
from imutool.conversion.workers import ConvertReport
from imutool.errors import ConfigError, DataError
from imutool.mcap_io.log import Log
from imutool.mcap_io.read import read
from imutool.recording import Imu, Recording

START_NS = 1403636579758560000
PNG = b"\x89PNG\r\n\x1a\n"


def sequence(folder: Path, *, rows: int = 50, bad_line: int | None = None, images: int = 0) -> Path:
    """A EuRoC sequence of resting samples; `bad_line` of its IMU table holds a word."""
    stamps = [START_NS + n * 5_000_000 for n in range(rows)]
    imu = ["#timestamp [ns],wx,wy,wz,ax,ay,az", *(f"{t},0.01,0.02,0.03,0,0,9.81" for t in stamps)]
    if bad_line is not None:
        imu[bad_line - 1] = imu[bad_line - 1].replace("9.81", "oops")
    truth = ["#timestamp,x,y,z,qw,qx,qy,qz", *(f"{t},1,2,3,1,0,0,0" for t in stamps)]
    for name, lines in (("imu0", imu), ("state_groundtruth_estimate0", truth)):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / "mav0" / name / "data.csv").write_text("\n".join(lines) + "\n")
    if images:
        (folder / "mav0/cam0/data").mkdir(parents=True)
        listed = [f"{t},{t}.png" for t in stamps[:images]]
        (folder / "mav0/cam0/data.csv").write_text("\n".join(["#timestamp [ns],filename", *listed]))
        for t in stamps[:images]:
            (folder / f"mav0/cam0/data/{t}.png").write_bytes(PNG + os.urandom(20_000))
    return folder


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "source"
    for name in ("a", "b", "c"):
        sequence(folder / name)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_one_sequence_goes_to_the_file_named(source, tmp_path):
    report = convert(source / "a", tmp_path / "new" / "log.mcap")
    assert report == ConvertReport([tmp_path / "new" / "log.mcap"], [], [], [])
    assert read(report.written[0]) == next(iter(registry.load("imutool.converters", "euroc").read(source / "a")))


@pytest.mark.parametrize("out", ["s3://bucket/log.mcap", "-"])
def test_a_log_is_not_written_to_a_folder_named_as_a_store(source, tmp_path, monkeypatch, out):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(ConfigError, match=r"in an object store|is a stream"):
        convert(source, out)
    assert sorted(tmp_path.iterdir()) == before


def test_one_sequence_into_a_folder_that_exists_takes_its_name(source, tmp_path):
    (tmp_path / "out").mkdir()
    assert convert(source / "a", tmp_path / "out").written == [tmp_path / "out" / "a.mcap"]


def test_one_sequence_to_a_name_with_a_slash_goes_into_a_new_folder(source, tmp_path, imutool):
    report = imutool_api.convert(source / "a", f"{tmp_path / 'logs'}/")
    assert report.written == [tmp_path / "logs" / "a.mcap"]
    assert imutool("convert", "source/b", "logs/", cwd=tmp_path).returncode == 0
    assert content(tmp_path / "logs").keys() == {"a.mcap", "b.mcap"}


@pytest.mark.parametrize("workers", [1, 2])
def test_several_sequences_go_to_a_folder_and_each_is_told_when_done(source, tmp_path, workers):
    before = content(source)
    told = []
    report = convert(source, tmp_path / "out", workers=workers, progress=lambda *args: told.append(args))
    assert report.written == [tmp_path / "out" / f"{name}.mcap" for name in "abc"]
    assert [done for done, _, _ in told] == [1, 2, 3]
    assert {total for _, total, _ in told} == {3}
    assert sorted(name for _, _, name in told) == ["a", "b", "c"]
    assert read(report.written[1]).name == "b"
    assert content(source) == before


@pytest.mark.parametrize("workers", [1, 2])
def test_a_broken_sequence_is_reported_and_the_others_are_written(source, tmp_path, workers):
    sequence(source / "broken", bad_line=7)
    (source / "empty.zip").touch()
    report = convert(source, tmp_path / "out", workers=workers)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.mcap", "b.mcap", "c.mcap"]
    assert [failure.name for failure in report.failures] == ["empty", "broken"]
    assert f"{source}/empty.zip: is empty" in report.failures[0].message
    assert f"{source}/broken/mav0/imu0/data.csv:7: column 7 is 'oops'; expected a number." in report.failures[1].message


def test_the_only_sequence_raises_its_own_error_and_leaves_nothing(tmp_path):
    sequence(tmp_path / "broken", bad_line=7)
    with pytest.raises(DataError, match=r"data\.csv:7"):
        convert(tmp_path / "broken", tmp_path / "out" / "log.mcap")
    assert not (tmp_path / "out").exists()
    (tmp_path / "kept").mkdir()
    sequence(tmp_path / "several" / "a", bad_line=7)
    sequence(tmp_path / "several" / "b", bad_line=7)
    for out in ("out", "kept"):
        assert len(convert(tmp_path / "several", tmp_path / out, workers=1).failures) == 2
    assert [(tmp_path / out).exists() for out in ("out", "kept")] == [False, True]


def test_what_is_wrong_with_the_data_names_the_file_also_where_only_a_topic_is_known(tmp_path):
    header = "time [s],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"
    rows = "".join(f"{0.01 * k:.2f},nan,nan,nan,0.0,0.1,9.8\n" for k in range(200))
    (tmp_path / "bench.csv").write_text(f"{header}\n{rows}")
    with pytest.raises(DataError, match=r"bench\.csv: /imu0: none of the 200 samples of the gyro is finite"):
        convert(tmp_path / "bench.csv", tmp_path / "out.mcap")


def test_a_table_of_one_row_has_a_row(tmp_path):
    """It was said to be text without a row of four numbers: the last line of a file was taken for one that is cut."""
    (tmp_path / "one.csv").write_text("time [s],gx,gy,gz,ax,ay,az\n0.1,0.2,0.3,0.4,0.0,0.1,9.8\n")
    with pytest.raises(ConfigError, match="'time \\[s\\]' is named as a time and does not rise: 1 different values in 1 rows"):
        convert(tmp_path / "one.csv", tmp_path / "out.mcap")


def test_sequences_are_chosen_by_name(source, tmp_path):
    sequence(source / "broken", bad_line=7)
    report = convert(source, tmp_path / "out", sequences=["a", "c"])
    assert [path.name for path in report.written] == ["a.mcap", "c.mcap"]
    assert report.failures == []
    assert convert(source, tmp_path / "b.mcap", sequences=["b"]).written == [tmp_path / "b.mcap"]


def test_an_unknown_sequence_is_refused_with_the_nearest(tmp_path):
    sequence(tmp_path / "source" / "MH_04_difficult")
    sequence(tmp_path / "source" / "V1_01_easy")
    with pytest.raises(ConfigError, match=r"'MH_4_difficult' is not in the source.*Did you mean 'MH_04_difficult'"):
        convert(tmp_path / "source", tmp_path / "out", sequences=["MH_4_difficult"])
    assert not (tmp_path / "out").exists()


def test_an_unknown_format_is_refused_with_the_nearest(source, tmp_path):
    with pytest.raises(ConfigError, match="Did you mean 'euroc'"):
        convert(source, tmp_path / "out", format="eurok")


@pytest.mark.parametrize("fix", [False, True])
@pytest.mark.parametrize("kind", ["log", "euroc"])
def test_a_pipe_gets_the_log_and_stays_a_pipe(tmp_path: Path, kind: str, fix: bool) -> None:
    """--fix put a file in place of the pipe, and as root in that of /dev/stdout; a bag's log was read from the pipe."""
    imutool_api.write(tmp_path / "log", imutool_api.example_recording(duration_s=4.0))
    sequence(tmp_path / "euroc")
    convert(tmp_path / kind, tmp_path / "file.mcap", fix=fix)
    os.mkfifo(pipe := tmp_path / "pipe")
    with ThreadPoolExecutor() as threads:
        read_bytes = threads.submit(pipe.read_bytes)
        convert(tmp_path / kind, pipe, fix=fix)
        assert read_bytes.result(30.0) == (tmp_path / "file.mcap").read_bytes()
    assert pipe.is_fifo()
    sequence(tmp_path / "another")
    with pytest.raises(ConfigError, match="do not fit into one file"):
        convert(tmp_path, pipe)
    with pytest.raises(ConfigError, match="is a pipe or a device"):
        convert(pipe, tmp_path / "out.mcap")


@pytest.mark.parametrize(
    "kind", ["empty folder", "folder of notes", "folder of arrays", "text file", "empty file", "header alone"]
)
def test_where_nothing_is_recognised_the_message_says_what_was_looked_for(tmp_path, kind):
    source = tmp_path / "source"
    texts = {"text file": "notes", "empty file": "", "header alone": "time,gx,gy,gz,ax,ay,az\n"}
    if kind in texts:
        source = tmp_path / "notes.txt"
        source.write_text(texts[kind])
    else:
        source.mkdir()
        if kind == "folder of notes":
            (source / "notes.txt").write_text("notes")
        if kind == "folder of arrays":
            np.savez(source / "reward.npz", reward=np.arange(20.0))
    what, fix = {
        "empty folder": (": it holds no files", "See whether the recording lies elsewhere"),
        "folder of notes": ("", "Name the file, or a folder nearer to it: four levels"),
        "folder of arrays": ("", "tables that show no IMU, as reward.npz, are left out"),
        "empty file": (": it is empty", "See whether the recorder"),
    }.get(kind, (": it is text without a row of four numbers.*", "See whether the recorder"))
    with pytest.raises(DataError, match=rf"no sequence found{what}; expected a ROS bag, an MCAP log.*{fix}"):
        convert(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_log_that_is_not_of_the_format_is_told_which_one_was_expected(tmp_path):
    imutool_api.write(tmp_path / "log.mcap", imutool_api.example_recording())
    expected = r"no sequence found; expected a recording of the format euroc. Leave `format` out: then the recording"
    with pytest.raises(DataError, match=expected):
        convert(tmp_path / "log.mcap", tmp_path / "out", format="euroc")


def test_an_existing_log_is_kept_unless_overwriting_is_asked_for(source, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "b.mcap").write_bytes(b"precious")
    with pytest.raises(ConfigError, match="exists"):
        convert(source, tmp_path / "out")
    assert content(tmp_path / "out") == {"b.mcap": b"precious"}  # and the others were not begun
    assert len(convert(source, tmp_path / "out", overwrite=True).written) == 3


@pytest.mark.parametrize("suffix", ["mcap", "MCAP"])
def test_several_sequences_do_not_go_into_one_file(source, tmp_path, suffix):
    with pytest.raises(ConfigError, match="several sequences do not fit into one file"):
        convert(source, tmp_path / f"out.{suffix}")


@pytest.mark.parametrize("given", ["absolute", "relative", "."])
def test_sequences_of_one_name_have_their_folders_in_front_of_it(source, tmp_path, monkeypatch, given):
    sequence(source / "copy" / "a")
    sequence(source / "copy" / "older" / "a")
    monkeypatch.chdir(source if given == "." else source.parent)
    convert({"absolute": source, "relative": Path(source.name), ".": Path()}[given], tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "a.mcap",
        "b.mcap",
        "c.mcap",
        "copy_a.mcap",
        "copy_older_a.mcap",
    }


def test_two_sequences_that_still_have_one_name_are_refused(source, tmp_path):
    sequence(source / "copy" / "older" / "a")
    sequence(source / "copy_older" / "a")
    with pytest.raises(ConfigError, match="two sequences are named copy_older_a"):
        convert(source, tmp_path / "out")
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_a_source_is_never_the_target(tmp_path):
    folder = sequence(tmp_path / "one")
    archive = tmp_path / "one.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for name, data in content(folder).items():
            file.writestr(name, data)
    before = content(tmp_path)
    with pytest.raises(ConfigError, match="is the source itself"):
        convert(archive, archive, overwrite=True)
    with pytest.raises(ConfigError, match="is the source itself"):
        convert(folder, folder / "mav0/imu0/data.csv", overwrite=True)
    assert content(tmp_path) == before


@pytest.mark.parametrize("metadata", [True, False])
def test_no_part_of_a_bag_is_the_target(tmp_path, metadata):
    imutool_api.write(tmp_path / "log.mcap", imutool_api.example_recording(duration_s=4.0))
    imutool_api.export(tmp_path / "log.mcap", bag := tmp_path / "bag", format="rosbag2")
    if not metadata:
        (bag / "metadata.yaml").unlink()
    (bag / "bag_0.mcap").rename(part := bag / "bag.mcap" if metadata else bag / "bag_0.mcap")
    if metadata:
        (bag / "metadata.yaml").write_text((bag / "metadata.yaml").read_text().replace("bag_0.mcap", "bag.mcap"))
    before = content(tmp_path)
    for out in (part, *[bag][: int(metadata)]):
        with pytest.raises(ConfigError, match="is the source itself"):
            convert(bag, out, overwrite=True)
    assert content(tmp_path) == before


def test_a_log_takes_the_place_of_a_log_alone(source, tmp_path):
    (tmp_path / "b.csv").write_text("the second word of *.csv")
    with pytest.raises(ConfigError, match="is no MCAP log"):
        convert(source / "a", tmp_path / "b.csv", overwrite=True)
    assert (tmp_path / "b.csv").read_text() == "the second word of *.csv"


@pytest.mark.parametrize("out", ["map.toml", "poses.csv"])
def test_a_map_and_the_poses_that_it_names_are_never_the_target(tmp_path, out):
    rows = "".join(f"{n * 10**7},0,0,0,0,0,9.81\n" for n in range(400))
    (tmp_path / "imu.csv").write_text(f"t,gx,gy,gz,ax,ay,az\n{rows}")
    (tmp_path / "poses.csv").write_text("t,qw,qx,qy,qz\n" + "".join(f"{n * 10**7},1,0,0,0\n" for n in range(400)))
    (tmp_path / "map.toml").write_text(
        'time = "t"\ntime_unit = "ns"\ngyro = ["gx", "gy", "gz"]\ngyro_unit = "rad/s"\naccel = ["ax", "ay", "az"]\n'
        'accel_unit = "m/s^2"\ntruth_file = "poses.csv"\nquaternion_wxyz = ["qw", "qx", "qy", "qz"]\n'
    )
    before = content(tmp_path)
    (tmp_path / "link").symlink_to(out)
    with pytest.raises(ConfigError, match="is the source itself"):
        convert(tmp_path / "imu.csv", tmp_path / "link", mapping=tmp_path / "map.toml", overwrite=True)
    (tmp_path / "link").unlink()
    assert content(tmp_path) == before


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc, a place even root cannot write to")
def test_a_read_only_target_is_refused(source):
    with pytest.raises(ConfigError, match=r"/proc/a\.mcap: cannot be written"):
        convert(source / "a", Path("/proc/a.mcap"))
    with pytest.raises(ConfigError, match=r"/proc/a\.mcap: cannot be written"):  # and no temporary folder next to it
        convert(source / "a", Path("/proc/a.mcap"), fix=True)
    with pytest.raises(ConfigError, match="/proc/imutool: cannot be made"):
        convert(source, Path("/proc/imutool"))


def test_a_target_below_a_file_is_refused(source, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="cannot be made"):
        convert(source / "a", tmp_path / "file" / "a.mcap")


def test_images_are_written_unless_left_out(tmp_path):
    source = sequence(tmp_path / "one", images=5)
    topic = "/cam0/image_raw/compressed"
    convert(source, tmp_path / "with.mcap")
    convert(source, tmp_path / "without.mcap", images=False)
    images = {int(path.stem): path.read_bytes() for path in (source / "mav0/cam0/data").iterdir()}
    assert dict(read(tmp_path / "with.mcap").frames[topic].each()) == images
    with Log(tmp_path / "without.mcap") as log:
        assert topic not in log.topics


def test_an_interrupt_ends_all_processes_and_leaves_nothing_half_written(tmp_path):
    """Small sequences end first; the interrupt comes while large ones are being written."""
    sequence(tmp_path / "source" / "a")
    for name in ("b", "c"):
        sequence(tmp_path / "source" / name, rows=1500, images=1500)
    before = content(tmp_path / "source")
    children = set(below(os.getpid()))

    def interrupt(done, total, name):
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        convert(tmp_path / "source", tmp_path / "out", workers=2, progress=interrupt)
    assert set(below(os.getpid())) == children
    left = {name: (tmp_path / "out" / name) for name in content(tmp_path / "out")}
    assert set(left) <= {"a.mcap", "b.mcap", "c.mcap"}
    assert all(read(path).name == path.stem for path in left.values())
    assert content(tmp_path / "source") == before


def test_a_process_that_dies_is_a_failure_of_its_sequence_not_of_the_tool(source, tmp_path, monkeypatch):
    monkeypatch.setattr("imutool.conversion.workers.convert_numbered", pool_functions.end_at_first)
    report = convert(source, tmp_path / "out", workers=2)
    assert [failure.name for failure in report.failures] == ["a"]
    assert "its process died (exit code 9)" in report.failures[0].message
    assert [path.name for path in report.written] == ["b.mcap", "c.mcap"]


@pytest.fixture
def outside(monkeypatch):
    """A converter of another package that has `read` alone."""
    module = types.ModuleType("outside")
    imu = Imu(np.arange(5) * 10, np.zeros((5, 3)), np.ones((5, 3)))
    module.read = lambda source: (Recording(name, imu) for name in source.read_text().split())
    known, real = registry.names, registry.load
    monkeypatch.setattr(registry, "names", lambda group: [*known(group), "outside"])
    monkeypatch.setattr(registry, "load", lambda group, name, *at: module if name == "outside" else real(group, name, *at))
    return module


def test_a_converter_that_only_reads_is_used_on_request(outside, tmp_path):
    (tmp_path / "list.txt").write_text("x y")
    report = convert(tmp_path / "list.txt", tmp_path / "out", format="outside")
    assert [path.name for path in report.written] == ["x.mcap", "y.mcap"]
    assert convert(tmp_path / "list.txt", tmp_path / "y.mcap", format="outside", sequences=["y"]).written
    with pytest.raises(DataError, match="no sequence found"):
        convert(tmp_path / "list.txt", tmp_path / "out2")
    with pytest.raises(ConfigError, match="is the source itself"):
        convert(tmp_path / "list.txt", tmp_path / "list.txt", format="outside", sequences=["y"], overwrite=True)
    assert (tmp_path / "list.txt").read_text() == "x y"
    (tmp_path / "list.txt").write_text("x x")
    with pytest.raises(ConfigError, match="two sequences are named x"):
        convert(tmp_path / "list.txt", tmp_path / "out", format="outside", overwrite=True)


def test_what_two_converters_claim_must_be_decided(source, tmp_path, monkeypatch, outside):
    euroc = registry.load("imutool.converters", "euroc")
    outside.sequences, outside.recognises = euroc.sequences, lambda sequence: True
    with pytest.raises(ConfigError, match="is recognised as euroc and outside"):
        convert(source, tmp_path / "out")


def test_converting_needs_no_torch():
    code = "import imutool.conversion.run, imutool.log_info.inspection"
    assert loaded(code, {"torch", "rosbags", "rerun", "matplotlib"}) == []


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (b"#RAWIMUSXA,COM1,0,81.5,FINESTEERING,1691,410338.819,00000020,3fdf,43495;00,11,1691\n", "NovAtel receiver.*CSV"),
        (b"%RAWIMUSXA,2209,491674.014;04,41,2209,491674.013699,ea59fe00,329308016,-2706935\n", "NovAtel receiver.*CSV"),
        (b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n", "blackbox log of Betaflight.*blackbox_decode"),
        (bytes.fromhex("00060d058847e8f3fd0900000000"), "telemetry log of MAVLink.*vehicle's own log"),
        (b"\xa3\x95\x80\x027ATT\0fffffffffffff", "sdlog2 log of PX4.*sdlog2_dump.py"),
        (b"\x75\x65\x80\x38", "MicroStrain.*SensorConnect"),
        (b"MD\xfc\x03\x64\xba", "Axivity sensor.*OmGUI"),
        (b"Device Identity\r\nDevice Unique Serial Code:1\r\n", "GENEActiv.*with a gyro"),
        (b"\x0e\x10\x9d\x05\x40\x00\x00\x00.FIT", "FIT file.*gyroscope_data"),
        (b"\x00\x00\x00\x14ftypmp41", "a video.*telemetry"),
        (b'<?xml version="1.0" encoding="UTF-8"?>\n<mvnx version="4">', "Xsens MVN.*sensors measured"),
        (b'<?xml version="1.0"?>\n<!-- ' + 300 * b"a" + b' -->\n<mvnx version="3">', "Xsens MVN.*sensors measured"),
        (b"\x20\x0c" + 8 * (b"\xfa\xff\x36\x44" + bytes(69)), "Xsens sensor.*MT Manager"),
        (b"\x80\x04\x95\x0f\x00\x00\x00\x00\x00\x00\x00}\x94\x8c\x03acc\x94K\x01s.", "pickle of Python.*numpy.savez"),
        (b"\x02P,\x00", "C3D file.*together with the table"),
        (
            b"#group,false\r\n#default,_result\r\n,table,_time,_value,_field\r\n,0,2024-05-01T12:00:00Z,0.1,gx\r\n",
            r"long.*Pivot",
        ),
        (b"Series;Time;Value\ngx;2024-05-01 12:00:00;0.1\n", r"long table.*Pivot"),
        (b"timestamp,sensor,axis,value\n0.0,gyro,x,0.1\n", r"long table.*Pivot"),
        (b"\xaa\x44\x13\x28\x45\x01", "NovAtel receiver.*CSV"),
        (b"\xed\xa1\xda\x01" + bytes(8), "log of LCM.*lcm-gen"),
        (bytes(8) + b"\xa4\x03" + bytes(6) + b"\x08\x01\x10\x00", "record of Apollo.*cyber_record"),
        (b"#ROSRECORD V1.2\n", "bag of ROS before 2010.*rosbag filter"),
        (b"VisionRecord", "VRS recording.*CSV"),
        (b"RRF2\x00\x00", "recording of Rerun.*the log"),
        (b"\xd4\xc3\xb2\xa1\x02\x00\x04\x00", "pcap.*Replay"),
        (b"MDF     4.10    ", "measurement file.*asammdf"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:5f5b\nsize 42586\n", "pointer of Git LFS.*git lfs pull"),
        (b'"property","value"\n"version","1.1.13"\n', "no sequence found; expected a ROS bag"),  # of phyphox
        (b"neither one nor the other", "no sequence found; expected a ROS bag"),
    ],
)
def test_a_format_that_is_known_but_not_read_says_what_to_do(start: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "flight.dat").write_bytes(start + bytes(3000))
    with pytest.raises(DataError, match=said):
        convert(tmp_path / "flight.dat", tmp_path / "out.mcap")


def test_recordings_of_one_name_say_which_file_they_are_of(tmp_path: Path) -> None:
    """A folder's only table has the folder's name, and recordings of one table that of the table."""
    names = ["trial", "time_s", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    rows = [[trial, n / 100, 0.1, 0.2, 0.3, 0.0, 0.0, 9.81 + 0.01 * (n % 3)] for trial in (1, 2) for n in range(50)]
    whole, one = ([np.array(column) for column in zip(*part, strict=True)] for part in (rows, rows[:50]))
    for folder, file in (("day1/path2", "left"), ("day2/path2", "right"), ("A", "rest"), ("B", "rest")):
        (tmp_path / folder).mkdir(parents=True)
        write_csv(tmp_path / folder / f"{file}.csv", names[1:], one[1:])
    for folder in ("A", "B"):
        write_csv(tmp_path / folder / "all.csv", names, whole)
    written = convert(tmp_path, tmp_path / "out", workers=1).written
    expected = [f"{folder}_{name}" for folder in "AB" for name in ("all_trial_1", "all_trial_2", "rest")]
    assert sorted(path.stem for path in written) == [*expected, "day1_path2_left", "day2_path2_right"]


def test_pointers_of_git_lfs_are_named_whatever_reads_such_files(tmp_path: Path) -> None:
    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:5f5b\nsize 4\n"
    (tmp_path / "bag").mkdir()
    stated = "{version: 5, storage_identifier: sqlite3, relative_file_paths: [a_0.db3], message_count: 4}"
    (tmp_path / "bag/metadata.yaml").write_text(f"rosbag2_bagfile_information: {stated}\n")
    for name in ("walk.bag", "walk.zip", "bag/a_0.db3", "gt.csv"):
        (tmp_path / name).write_bytes(pointer)
    for name in ("walk.bag", "walk.zip", "bag"):
        with pytest.raises(DataError, match=r"pointer of Git LFS.*git lfs pull"):
            convert(tmp_path / name, tmp_path / "out.mcap")
    (tmp_path / "walk").mkdir()
    (tmp_path / "gt.csv").rename(tmp_path / "walk/gt.csv")
    names = ["time_s", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    write_csv(tmp_path / "walk/imu.csv", names, [np.arange(50) / 100, *np.full((5, 50), 0.1), np.full(50, 9.8)])
    assert "gt.csv: pointers of Git LFS" in convert(tmp_path / "walk", tmp_path / "walk.mcap").losses[0]


@pytest.mark.parametrize("closed", ["locked", "locked/imu.csv"])
def test_what_may_not_be_read_is_named_and_stops_no_other_recording(tmp_path: Path, monkeypatch, closed: str) -> None:
    names = ["time_s", *(f"gyro_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz")]
    for folder in ("locked", "open"):
        (tmp_path / folder).mkdir()
        write_csv(tmp_path / folder / "imu.csv", names, [np.arange(50) / 100, *np.full((5, 50), 0.1), np.full(50, 9.8)])
    access, opened = os.access, Path.open

    def is_closed(path: Path) -> bool:  # chmod does not stop root
        return path.is_relative_to(tmp_path / closed)

    def open_allowed(path: Path, *args, **options):
        if is_closed(path):
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *args, **options)

    monkeypatch.setattr(os, "access", lambda path, mode: not is_closed(Path(path)) and access(path, mode))
    monkeypatch.setattr(Path, "open", open_allowed)
    report = convert(tmp_path, tmp_path / "out", workers=1)
    assert [path.name for path in report.written] == ["out"]
    assert report.losses[0].startswith(str(Path(closed)))
    assert " may not be read and is left out. Give yourself the right" in report.losses[0]
    if closed != "locked":
        with pytest.raises(DataError, match=r"imu\.csv may not be read"):
            convert(tmp_path / "locked", tmp_path / "other")


def test_a_folder_without_a_recording_says_of_which_format_most_of_its_known_files_are(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        (tmp_path / f"imu{number}.mat").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:5f5b\nsize 4\n")
    (tmp_path / "film.mp4").write_bytes(b"\x00\x00\x00\x14ftypmp41" + bytes(100))
    with pytest.raises(DataError, match=r"of imu1\.mat and 2 others, it is a pointer of Git LFS.*git lfs pull"):
        convert(tmp_path, tmp_path / "out")


def test_a_folder_of_own_logs_alone_can_be_converted_again_but_never_what_it_wrote_itself(source, tmp_path):
    logs = tmp_path / "logs"
    assert len(convert(source, logs).written) == 3
    for overwrite in (False, True):
        again = convert(logs, logs / "again", overwrite=overwrite)
        assert sorted(path.name for path in again.written) == ["a.mcap", "b.mcap", "c.mcap"]
    sequence(logs / "raw")
    (written,) = convert(logs, tmp_path / "beside").written  # own logs next to a source are none
    assert read(written).name == "raw"


@pytest.mark.parametrize("ending", ["zip", "tar"])
def test_an_archive_in_which_nothing_is_found_says_to_unpack_it(tmp_path, ending):
    for name in ("IMU.txt", "GPS.txt"):
        (tmp_path / name).write_text("what was seen on the way\n" * 9)
    archive = tmp_path / f"log.{ending}"
    if ending == "zip":
        with zipfile.ZipFile(archive, "w") as file:
            [file.write(tmp_path / name, name) for name in ("IMU.txt", "GPS.txt")]
    else:
        with tarfile.open(archive, "w") as file:
            [file.add(tmp_path / name, name) for name in ("IMU.txt", "GPS.txt")]
    with pytest.raises(DataError, match=rf"log\.{ending}: no sequence found: nothing in the archive.*Unpack it"):
        convert(archive, tmp_path / "log.mcap")


def test_what_holds_for_several_logs_is_said_once(tmp_path, imutool):
    """A question about ten tables is a page, not ten."""
    rng = np.random.default_rng(0)
    for name, size in (("walk_1", 1.0), ("walk_2", 2.0), ("walk_3", 1.0)):
        (tmp_path / "tables" / name).mkdir(parents=True)
        rows = [
            f"{k / 100:.2f},{','.join(f'{size * x:.4f}' for x in rng.normal(size=3))},0,0,9.8" for k in range(400)
        ]  # the rates show no unit
        (tmp_path / "tables" / name / "imu.csv").write_text("\n".join(["time [s],gyr_x,gyr_y,gyr_z,acc_x,acc_y,acc_z", *rows]))
    refused = imutool("convert", "tables", "logs", cwd=tmp_path)
    assert refused.returncode == DataError.exit_code
    assert refused.stderr.count("the meaning of its columns is not certain") == 3
    assert refused.stderr.count('gyro_unit = "?"') == 1
    assert refused.stderr.count("completed: the same as above") == 2
    told = imutool("convert", "tables", "logs", "--map", "gyro_unit=rad/s", cwd=tmp_path)
    assert told.returncode == 0, told.stderr
    assert told.stderr.count("gravity in m/s^2") == 1
    assert "walk_1.mcap and 2 others: the median acceleration is 9.8: gravity in m/s^2" in " ".join(told.stderr.split())


def test_tables_of_one_program_hold_quaternions_in_one_order(tmp_path: Path) -> None:
    """Motion about one axis fits both orders, and what the other tables show counts for it, too."""
    t = np.arange(1500) * 0.01
    swings = {
        "a": np.stack([np.sin(t), 0.7 * np.cos(1.3 * t), np.sin(0.6 * t)], axis=1),
        "b": np.stack([0.5 * np.cos(t), np.sin(0.8 * t), 0.9 * np.sin(1.1 * t)], axis=1),
        "flat": np.outer(np.sin(t), [0.0, 0.0, 1.0]),
    }
    header = ["time [s]", *(f"gyr_{a} [rad/s]" for a in "xyz"), *(f"acc_{a} [m/s^2]" for a in "xyz"), *(f"p{a}" for a in "xyz")]
    for name, angles in swings.items():
        turned = Rotation.from_euler("zyx", angles[:, ::-1])
        gyro = np.gradient(turned.as_rotvec(), t, axis=0) if name == "flat" else _rates(turned, 0.01)
        accel = turned.inv().apply([0.0, 0.0, 9.81])
        rows = np.hstack([t[:, None], gyro, accel, np.zeros((len(t), 3)), turned.as_quat()])
        (tmp_path / "in").mkdir(exist_ok=True)
        names = ",".join([*header, *(f"robot_quat_{n}" for n in range(4))])
        np.savetxt(tmp_path / f"in/{name}.csv", rows, "%.9f", ",", header=names, comments="")
    report = convert(tmp_path / "in", tmp_path / "out", workers=1)
    assert [note.partition(":")[0] for note in report.notes if "as one program wrote them" in note] == ["flat.mcap"]
    for log in report.written:
        with Log(log) as opened:
            mapped = opened.metadata()["imutool/map"]
        assert mapped["quaternion_wxyz"] == "robot_quat_3, robot_quat_0, robot_quat_1, robot_quat_2"


def _rates(turned: Rotation, step_s: float) -> np.ndarray:
    """Angular rates of rotations in the axes of their body."""
    between = (turned[:-1].inv() * turned[1:]).as_rotvec() / step_s
    return np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])


def test_an_acquisition_of_st_is_named(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/lsm6dsv16x_gyro.dat").write_bytes(bytes(range(256)) * 20)
    (tmp_path / "run/device_config.json").write_text('{"devices": []}')
    with pytest.raises(DataError, match=r"an acquisition of ST's High Speed Datalog.*Export it as CSV"):
        convert(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("jumps", [False, True])
def test_a_topic_on_a_clock_of_its_own_is_no_jump_of_the_clock(tmp_path: Path, jumps: bool, imutool) -> None:
    """As GNSS next to an IMU, in seconds of the week and since the start."""
    t_s, vectors = np.arange(300) / 100.0, np.random.default_rng(5).normal([0, 0, 0, 0, 0, 9.81], 0.1, (300, 6))
    t_s[150:] += 7200.0 * jumps
    (tmp_path / "drive").mkdir()
    names = ["t [s]", *(f"g{a} [rad/s]" for a in "xyz"), *(f"a{a} [m/s^2]" for a in "xyz")]
    write_csv(tmp_path / "drive/imu.csv", names, [t_s, *vectors.T])
    write_csv(tmp_path / "drive/gps.csv", ["tow [s]", "lat", "lon"], [511_000.0 + t_s[:150:10], t_s[:150:10], t_s[:150:10]])
    convert(tmp_path / "drive", tmp_path / "log.mcap")
    with Log(tmp_path / "log.mcap") as log:
        assert {"/imu0", "/gps_lat"} <= {*log.topics}
    done = imutool("convert", "log.mcap", "fixed.mcap", "--fix", cwd=tmp_path)
    assert done.returncode == 0
    told = [line for line in done.stderr.splitlines() if "the clock jumps by +7200.01 s" in line]
    assert len(told) == jumps
    assert "other" not in "".join(told)
    assert done.stderr.count("the clock jumps") == jumps
