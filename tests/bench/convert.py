"""A ROS 1 bag with an IMU and images to MCAP: imutool convert against rosbags-convert, in one run; and a table of text.

    python tests/bench/convert.py [--megabytes 2000]
    python tests/bench/convert.py --rows 1440000       # two hours at 200 Hz, against a python that reads them with NumPy

Each command runs alone in a process of its own, three times in turn; the least of each figure counts. rosbags-convert writes
without compression, so imutool does too in a row of its own.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import rewrite
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

RUNS = 3
IMU_HZ, CAMERA_HZ, WIDTH, HEIGHT = 200, 20, 752, 480
START_NS = 1_700_000_000_000_000_000


def write_bag(path: Path, megabytes: int) -> int:
    """Bag of raw images, about 7 MB a second, and an IMU; the number of its messages."""
    store = get_typestore(Stores.ROS1_NOETIC)
    kinds = store.types
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 255, (8, WIDTH * HEIGHT), dtype=np.uint8)
    ninth = np.zeros(9)
    zero, one = kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 9.81), kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    count = megabytes * 1_000_000 // (WIDTH * HEIGHT)
    messages = 0
    with Writer(path) as bag:
        imu = bag.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        camera = bag.add_connection("/cam/image_raw", "sensor_msgs/msg/Image", typestore=store)
        for n in range(count * IMU_HZ // CAMERA_HZ):
            t_ns = START_NS + n * 1_000_000_000 // IMU_HZ
            stamp = kinds["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
            header = kinds["std_msgs/msg/Header"](seq=n, stamp=stamp, frame_id="body")
            sample = kinds["sensor_msgs/msg/Imu"](header, one, ninth, zero, ninth, zero, ninth)
            bag.write(imu, t_ns, store.serialize_ros1(sample, sample.__msgtype__))
            messages += 1
            if n % (IMU_HZ // CAMERA_HZ) == 0:
                image = kinds["sensor_msgs/msg/Image"](header, HEIGHT, WIDTH, "mono8", 0, WIDTH, pixels[n % 8])
                bag.write(camera, t_ns, store.serialize_ros1(image, image.__msgtype__))
                messages += 1
    return messages


def write_table(path: Path, rows: int) -> None:
    """Table of a time, a gyro, an accelerometer and a temperature."""
    t_s, rng = np.arange(rows) / IMU_HZ, np.random.default_rng(1)
    gyro = np.stack([0.3 * np.sin(2.0 * np.pi * f * t_s) for f in (0.1, 0.07, 0.05)], axis=1)
    accel = np.array([0.0, 0.0, 9.81]) + 0.05 * rng.normal(size=(rows, 3))
    table = np.column_stack([t_s, gyro + 0.002 * rng.normal(size=(rows, 3)), accel, 25.0 + 0.01 * rng.normal(size=rows)])
    header = ",".join(["time", *(f"gyro_{a} (rad/s)" for a in "xyz"), *(f"acc_{a} (m/s^2)" for a in "xyz"), "temperature"])
    np.savetxt(path, table, "%.6f", ",", header=header, comments="")


def main() -> None:
    """Print a line for each command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=int, default=2000)
    parser.add_argument("--rows", type=int, help="of a table of text, instead of a bag")
    parser.add_argument("--folder", type=Path, default=None, help="where bag and logs are written, and removed")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=words.folder) as folder:
        source = Path(folder, "robot.csv" if words.rows else "robot.bag")
        convert = [sys.executable, "-m", "imutool", "convert", str(source)]
        if words.rows:
            write_table(source, words.rows)
            code = f"import numpy, sys; numpy.save(sys.argv[1], numpy.loadtxt({str(source)!r}, delimiter=',', skiprows=1))"
            commands = {
                "imutool convert": (convert, "table.mcap"),
                "numpy.loadtxt": ([sys.executable, "-c", code], "table.npy"),
            }
        else:
            print(f"{write_bag(source, words.megabytes)} messages")
            rosbags = str(Path(sys.executable).with_name("rosbags-convert"))
            commands = {
                "imutool convert": (convert, "robot.mcap"),
                "imutool convert --compression none": ([*convert, "--compression", "none"], "plain.mcap"),
                "rosbags-convert": ([rosbags, "--dst-storage", "mcap", "--src", str(source), "--dst"], "robot"),
            }
        print(f"{source.stat().st_size / 1e6:.0f} MB")
        runs: dict[str, list[rewrite.Spent]] = {name: [] for name in commands}
        sizes: dict[str, float] = {}
        for number in range(RUNS):
            for name, (command, target) in commands.items():
                out = Path(folder, f"{number}_{target}")
                runs[name].append(rewrite.timed([*command, str(out)]))
                sizes[name] = sum(path.stat().st_size for path in [out, *out.rglob("*")] if path.is_file()) / 1e6
                shutil.rmtree(out) if out.is_dir() else out.unlink()
        for name, found in runs.items():
            least = rewrite.Spent(*(min(column) for column in zip(*found, strict=True)))
            print(
                f"{name}: {least.wall:.1f} s wall, {least.cpu:.1f} s CPU, {least.peak_mb:.0f} MB; writes {sizes[name]:.0f} MB"
            )


if __name__ == "__main__":
    main()
