"""Reads a debiased log with `mcap` and `mcap-ros2-support` alone: nothing of imutool is needed to use its output.

python examples/read_debiased.py debiased.mcap [/imu0]
"""

from __future__ import annotations

import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory


def main(path: str, topic: str = "/imu0") -> None:
    with open(path, "rb") as file:  # noqa: PTH123  as the readers' own documentation has it
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for record in reader.iter_metadata():
            if "model" in record.metadata:
                print(f"model {record.metadata['model']}, initial bias from {record.metadata['init_how']}")
        raw = {}
        pairs = 0
        for _, channel, message, imu in reader.iter_decoded_messages(topics=[topic, f"{topic}/debiased"]):
            if channel.topic == topic:
                raw[message.log_time, message.sequence] = imu
                continue
            before, pairs = raw.pop((message.log_time, message.sequence)), pairs + 1
            if pairs == 1:
                rate, corrected = before.angular_velocity, imu.angular_velocity
                print(f"first message: yaw rate {rate.z:.5f} rad/s, debiased {corrected.z:.5f} rad/s")
                print(f"its standard deviation: {imu.angular_velocity_covariance[8] ** 0.5:.2g} rad/s")
    print(f"{pairs} messages on {topic}/debiased, {len(raw)} raw ones without a partner")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(*sys.argv[1:])
