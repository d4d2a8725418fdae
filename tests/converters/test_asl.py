"""Tables to recordings: columns, exact stamps, defects with file and line, images."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imutool.converters import _asl_table, euroc, fetch, tum_vi
from imutool.errors import DataError

PARSE_LIMIT_S = 1.0  # 30 000 rows of 17 columns take about 0.1 s here; ten times that would be felt on every conversion


def spoil(files, name, line, text):
    """The files with one line (counted from one, the header's being 1) replaced."""
    lines = files[name].decode().splitlines()
    lines[line - 1] = text
    return {**files, name: ("\n".join(lines) + "\n").encode()}


@given(st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=20))
def test_scientific_stamps_are_read_to_the_last_digit(stamps):
    rows = [f"{t // 10**18}.{t % 10**18:018d}e+18,1,2,3,4,5,6" for t in stamps]
    parsed = _asl_table.parse("\n".join(rows).encode(), "t.csv", "imu")
    assert parsed.t_ns.tolist() == stamps


@given(st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=20))
def test_integer_stamps_are_read_to_the_last_digit(stamps):
    parsed = _asl_table.parse("\n".join(f"{t}, 1,2,3,4,5,6" for t in stamps).encode(), "t.csv", "imu")
    assert parsed.t_ns.tolist() == stamps


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6))
def test_numbers_are_read_as_the_nearest_float64(values):
    parsed = _asl_table.parse(f"17,{','.join(map(repr, values))}\n".encode(), "t.csv", "imu")
    assert parsed.columns["gyro"][0].tolist() == values[:3]
    assert parsed.columns["accel"][0].tolist() == values[3:]


def test_a_long_wide_table_parses_quickly():
    row = ",".join(["{}"] + ["-0.0123456789"] * 16)
    content = "\n".join(row.format(1403636579758560000 + n * 5_000_000) for n in range(30_000)).encode()
    start = time.process_time()
    parsed = _asl_table.parse(content, "t.csv", "truth")
    assert time.process_time() - start < PARSE_LIMIT_S
    assert len(parsed.t_ns) == 30_000


def test_columns_follow_the_header_whatever_their_order(make):
    files = make.files("tum_vi")
    files["mav0/mocap0/data.csv"] = (
        b"# t [ns], q_RS_x [], q_RS_y [], q_RS_z [], q_RS_w [], p_RS_R_z [m], p_RS_R_y [m], p_RS_R_x [m]\n1,0.8,0,0,0.6,3,2,1\n"
    )
    files["mav0/imu0/data.csv"] = b"#timestamp,ax,ay,az,wx,wy,wz\n1,10,20,30,1,2,3\n"
    (recording,) = tum_vi.read(make.folder("one", files))
    assert recording.truth.q_wb_wxyz.tolist() == [[0.6, 0.8, 0.0, 0.0]]
    assert recording.truth.p_wb.tolist() == [[1.0, 2.0, 3.0]]
    assert recording.imu.gyro.tolist() == [[1.0, 2.0, 3.0]]
    assert recording.imu.accel.tolist() == [[10.0, 20.0, 30.0]]


def test_without_a_header_the_documented_order_holds(make):
    files = make.files("euroc")
    for name in ("mav0/imu0/data.csv", "mav0/state_groundtruth_estimate0/data.csv"):
        files[name] = files[name].split(b"\n", 1)[1]
    (recording,) = euroc.read(make.folder("one", files))
    assert recording.imu.accel[0].tolist() == [9.0, 0.5, -0.25]
    assert recording.truth.v_w[0].tolist() == [1.0, 2.0, 3.0]


def test_both_truth_layouts_read_and_only_known_biases_are_kept(make):
    files = make.files("euroc")
    name = "mav0/state_groundtruth_estimate0/data.csv"
    (full,) = euroc.read(make.folder("full", files))
    assert full.scalars["/ground_truth/bias/gyro"].values[0].tolist() == [0.01, 0.02, 0.03]
    assert full.scalars["/ground_truth/bias/accel"].unit == "m/s^2"
    assert full.truth.v_w is not None

    unknown = spoil(files, name, 3, files[name].decode().splitlines()[2].replace("0.01,", "nan,"))
    (partly,) = euroc.read(make.folder("partly", unknown))
    assert len(partly.scalars["/ground_truth/bias/gyro"]) == len(full.truth) - 1
    assert len(partly.scalars["/ground_truth/bias/accel"]) == len(full.truth)

    pose_only = b"\n".join(b",".join(line.split(b",")[:8]) for line in files[name].splitlines())
    (poses,) = euroc.read(make.folder("poses", {**files, name: pose_only}))
    assert poses.truth.v_w is None
    assert not poses.scalars
    assert np.array_equal(poses.truth.p_wb, full.truth.p_wb)


def test_a_second_truth_gets_its_own_topic(make):
    files = make.files("euroc")
    header = b"#time(ns),px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx,bwy,bwz,bax,bay,baz\n"
    files["mav0/state_groundtruth_recomputed0/data.csv"] = header + b"5,1,2,3,1,0,0,0,4,5,6,7,8,9,10,11,12\n"
    (recording,) = euroc.read(make.folder("one", files))
    assert list(recording.truths) == ["/ground_truth/pose", "/ground_truth_recomputed/pose"]
    assert recording.truths["/ground_truth_recomputed/pose"].v_w.tolist() == [[4.0, 5.0, 6.0]]
    assert recording.scalars["/ground_truth_recomputed/bias/accel"].values.tolist() == [[10.0, 11.0, 12.0]]


GOOD = "1403636579778560000,0.1,-0.2,0.004,9.004,0.5,-0.25"
DEFECTS = {
    "a value that is no number": (GOOD.replace("9.004", "9.0x4"), "'9.0x4'", "a number"),
    "an empty field": (GOOD.replace("9.004", ""), "''", "a number"),
    "an underscore, which only Python reads": (GOOD.replace("9.004", "9_004"), "'9_004'", "a number"),
    "not a number": (GOOD.replace("9.004", "nan"), "nan", "finite numbers"),
    "infinity": (GOOD.replace("9.004", "inf"), "inf", "finite numbers"),
    "a column too few": (GOOD.replace(",9.004", ""), "6 columns", "7 columns"),
    "a column too many": (GOOD + ",1", "8 columns", "7 columns"),
    "time going back": (GOOD.replace("1403636579778560000", "1403636579758560001"), "1403636579758560001", "increasing"),
    "a repeated stamp": (GOOD.replace("1403636579778560000", "1403636579773560000"), "1403636579773560000", "increasing"),
    "a fraction of a nanosecond": (GOOD.replace("778560000", "778560000.5"), "778560000.5", "whole nanoseconds"),
    "a stamp beyond 63 bits": (GOOD.replace("1403636579778560000", "9" * 19), "9" * 19, "whole nanoseconds"),
    "a stamp that would fill the memory": (GOOD.replace("1403636579778560000", "1e999999999"), "1e999999999", "whole"),
    "a negative stamp": ("-" + GOOD, "-1403636579778560000", "whole nanoseconds"),
    "a cut line": ("14036365797", "1 columns", "7 columns"),
}


@pytest.mark.parametrize("defect", DEFECTS)
@pytest.mark.parametrize("form", ["folder", "zip"])
def test_a_defect_of_the_imu_is_named_with_file_line_and_value(make, defect, form):
    row, shown, expected = DEFECTS[defect]
    files = spoil(make.files("euroc"), "mav0/imu0/data.csv", 6, row)
    source = make.folder("one", files) if form == "folder" else make.zip("one.zip", files)
    with pytest.raises(DataError) as failure:
        list(euroc.read(source))
    assert str(failure.value.where) == f"{source}/mav0/imu0/data.csv:6"
    assert shown in failure.value.what
    assert expected in failure.value.expected


def test_blank_lines_do_not_shift_the_line_of_a_defect(make):
    files = spoil(make.files("euroc"), "mav0/imu0/data.csv", 6, "\n\n" + GOOD.replace("9.004", "oops"))
    with pytest.raises(DataError) as failure:
        list(euroc.read(make.folder("one", files)))
    assert str(failure.value.where).endswith("data.csv:8")


@pytest.mark.parametrize(
    ("old", "new", "shown"),
    [
        ("0.6,0.8,0.0,0.0", "0,0,0,0", "norm 0"),
        ("0.6,0.8,0.0,0.0", "0.6,nan,0.0,0.0", "nan"),
        ("1403636579768560000", "1403636579758560000", "time goes from"),
    ],
)
def test_a_defect_of_the_truth_is_named_with_its_line(make, old, new, shown):
    files, name = make.files("tum_vi"), "mav0/mocap0/data.csv"
    files = spoil(files, name, 4, files[name].decode().splitlines()[3].replace(old, new))
    with pytest.raises(DataError, match=shown) as failure:
        list(tum_vi.read(make.folder("one", files)))
    assert str(failure.value.where).endswith("mav0/mocap0/data.csv:4")


def test_a_repeated_true_stamp_keeps_the_first_pose_and_is_counted(make):
    files, name = make.files("tum_vi"), "mav0/mocap0/data.csv"
    lines = files[name].decode().splitlines()
    again = lines[3].split(",")[0] + ",99,99,99,1,0,0,0"
    files[name] = "\n".join([*lines[:4], again, again, *lines[4:]]).encode()
    (recording,) = tum_vi.read(make.folder("one", files))
    (clean,) = tum_vi.read(make.folder("clean", make.files("tum_vi")))
    assert recording.truth == clean.truth
    assert recording.metadata["imutool/repairs"]["/ground_truth/pose"].startswith("2 poses")
    assert "imutool/repairs" not in clean.metadata


def test_printed_quaternions_are_made_unit(make):
    files = make.files("tum_vi")
    files["mav0/mocap0/data.csv"] = files["mav0/mocap0/data.csv"].replace(b"0.6,0.8", b"0.6001,0.8")
    (recording,) = tum_vi.read(make.folder("one", files))
    assert np.abs(np.linalg.norm(recording.truth.q_wb_wxyz, axis=1) - 1.0).max() < 1e-15


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"#timestamp,wx,wy,wz,ax,ay,az\n", "holds no rows"),
        (b"#timestamp,wx,wy,ax,ay,az\n1,2,3,4,5,6\n", "header has 'wx' but not 'wz'"),
        (b"#timestamp,wx,wx,wz,ax,ay,az\n1,2,3,4,5,6,7\n", "twice"),
        (b"1,2,3,4,5\n", "5 columns without known names"),
        (b"#timestamp,wx,wy,wz\n1,2,3,4\n", "no columns for accel"),
        (b"\xff\xfe\x00binary", "holds no rows"),
        (b"1," * 100_000, "line is 200000 bytes long"),
    ],
)
def test_a_table_that_says_too_little_is_refused(make, content, message):
    files = {**make.files("euroc"), "mav0/imu0/data.csv": content}
    with pytest.raises(DataError, match=message) as failure:
        list(euroc.read(make.folder("one", files)))
    assert "imu0/data.csv" in str(failure.value.where)


def test_a_sequence_without_an_imu_says_so(make):
    files = make.files("euroc")
    del files["mav0/imu0/data.csv"]
    with pytest.raises(DataError, match=r"mav0/imu0/data\.csv: is missing"):
        list(euroc.read(make.zip("one.zip", files)))


def test_windows_line_ends_and_a_byte_order_mark_change_nothing(make):
    files = make.files("euroc")
    (plain,) = euroc.read(make.folder("one", files))
    name = "mav0/imu0/data.csv"
    (other,) = euroc.read(make.folder("one", {**files, name: b"\xef\xbb\xbf" + files[name].replace(b"\n", b"\r\n")}))
    assert other == plain


def test_settings_of_the_sensors_and_what_was_not_read_are_kept_as_metadata(make):
    files = make.files("euroc")
    (recording,) = euroc.read(make.zip("one.zip", files))
    assert recording.metadata["imu0/sensor.yaml"]["text"].encode() == files["mav0/imu0/sensor.yaml"]
    assert recording.metadata["body.yaml"]["text"] == "comment: made up\n"
    assert recording.metadata["imutool"] == {"format": "euroc", "sequence": "one"}
    assert list(recording.metadata["imutool/skipped"]) == ["leica0"]
    assert "imutool/losses" not in recording.metadata
    (other,) = euroc.read(make.folder("two", {**files, "mav0/imu1/data.csv": files["mav0/imu0/data.csv"]}))
    assert "is left out: of such a folder imu0" in other.metadata["imutool/losses"]["imu1"]


@pytest.mark.parametrize(("x", "is_said"), [(0.0, False), (0.3, True)])
def test_an_imu_that_is_mounted_apart_from_the_poses_is_said(make, x, is_said):
    mounted = f"T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, {x},\n    0, 1, 0, 0, 0, 0, 1, 0, 0.0, 0.0, 0.0, 1.0]\n"
    files = {**make.files("euroc"), "mav0/imu0/sensor.yaml": mounted.encode()}
    (recording,) = euroc.read(make.folder("one", files))
    said = recording.metadata["imutool/skipped"].get("imu0/sensor.yaml", "")
    assert said.startswith("its T_BS is not that of the poses") == is_said


@pytest.mark.parametrize("form", ["folder", "zip", "tar", "tar.gz"])
def test_images_come_out_byte_for_byte(make, form):
    files = make.files("euroc")
    source = {"folder": make.folder, "zip": make.zip, "tar": make.tar, "tar.gz": make.tar}[form](f"one.{form}", files)
    (recording,) = euroc.read(source)
    frames = recording.frames["/cam0/image_raw/compressed"]
    images = {int(n.split("/")[-1][:-4]): content for n, content in files.items() if n.endswith(".png")}
    assert (frames.format, frames.count) == ("png", len(images))
    assert dict(frames.each()) == images
    assert dict(frames.each()) == images  # and again: the writer may ask twice


def test_images_can_be_left_out(make):
    (sequence,) = euroc.sequences(make.folder("one", make.files("euroc")))
    assert not euroc.read_sequence(sequence, images=False).frames


def test_a_missing_image_is_named_with_its_line_unless_all_are_absent(make):
    files = make.files("euroc")
    images = [name for name in files if name.endswith(".png")]
    (partly,) = euroc.sequences(make.folder("partly", {n: c for n, c in files.items() if n != images[2]}))
    with pytest.raises(DataError, match=r"cam0/data\.csv:4: .* is not in the source.*`images=False`"):
        euroc.read_sequence(partly)
    assert not euroc.read_sequence(partly, images=False).frames
    (none,) = euroc.read(make.folder("none", {n: c for n, c in files.items() if n not in images}))
    assert not none.frames
    assert "none of the listed images" in none.metadata["imutool/skipped"]["cam0"]


def test_a_list_of_images_cannot_reach_outside_its_folder(make):
    files = spoil(make.files("euroc"), "mav0/cam0/data.csv", 2, "1403636579758560000,../../imu0/data.png")
    (make.tmp / "secret.png").write_bytes(b"secret")
    with pytest.raises(DataError, match="is not in the source"):
        list(euroc.read(make.folder("one", files)))


@pytest.mark.parametrize(
    ("archive", "name"),
    [
        ("dataset-room2.tar.gz", "room2"),
        ("dataset-room2_512_16.tar", "room2"),
        ("dataset-magistrale1_1024_16.tar", "magistrale1"),
        ("mine.tar", "mine"),
    ],
)
def test_tum_vi_names_are_shortened(make, archive, name):
    folder = archive.partition(".")[0]
    files = {f"{folder}/{member}": content for member, content in make.files("tum_vi").items()}
    (recording,) = tum_vi.read(make.tar(archive, files))
    assert recording.name == name


def test_fetch_stamps_do_not_pass_through_a_float(make):
    (recording,) = fetch.read(make.folder("one", make.files("fetch")))
    assert recording.imu.t_ns[1] - recording.imu.t_ns[0] == 5_000_000
    assert recording.imu.t_ns[1] == 1403636579763560000
    assert int(float(1403636579763560000)) != 1403636579763560000


def test_a_folder_in_the_form_of_euroc_keeps_its_own_truth_and_claims_no_sensor(make):
    files = make.files("euroc")
    truth = files.pop("mav0/state_groundtruth_estimate0/data.csv")
    files["mav0/gt0/data.csv"] = b"\n".join([truth.splitlines()[0], *(row + b"," for row in truth.splitlines()[1:])])
    (recording,) = euroc.read(make.folder("simulated", files))
    (original,) = euroc.read(make.folder("original", {**files, "mav0/state_groundtruth_estimate0/data.csv": truth}))
    assert list(recording.truths) == ["/ground_truth/pose"]
    assert recording.truth == original.truth
    assert "sensor" not in recording.metadata["imutool"]
    described = {**files, "mav0/imu0/sensor.yaml": b"comment: VI-Sensor IMU (ADIS16448)"}
    (recording,) = euroc.read(make.folder("renamed", described))
    assert recording.metadata["imutool"]["sensor"] == "adis16448"
