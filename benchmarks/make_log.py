"""The benchmark's robot log: a curved drive with JointState and Imu at 100 Hz, NavSatFix at 20 Hz."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pymap3d import ned2geodetic

from icrtool.logs.write_log import SensorColumns, WriteOptions, write_log

EPOCH_NS = 1_760_000_000_000_000_000
Y_RIGHT, Y_LEFT, X = 0.74, -0.73, 0.05
ROSBAG2_CHUNK_BYTES = 768 << 10
"""A chunk is closed by the message that fills it."""

CONTAINERS = {"hour.mcap": ("mcap", "zstd"), "hour.bag": ("bag", "lz4"), "hour_db3": ("db3", "none")}


def drive(seconds: float, seed: int = 1) -> SensorColumns:
    """Return the measurements of a curved drive of some seconds with known ICRs."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.01)
    v_left = 0.6 + 0.2 * np.sin(t / 7) + 0.1 * np.sin(t / 3.1)
    v_right = 0.6 - 0.2 * np.sin(t / 11) + 0.1 * np.sin(t / 5.3)
    omega = (v_left - v_right) / (Y_RIGHT - Y_LEFT)
    v_x = (v_left * Y_RIGHT - v_right * Y_LEFT) / (Y_RIGHT - Y_LEFT)

    def summed(rate: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(rate[:-1] * 0.01)])

    psi = summed(omega)
    north = summed(v_x * np.cos(psi) + omega * X * np.sin(psi))[::5]
    east = summed(v_x * np.sin(psi) - omega * X * np.cos(psi))[::5]
    noise = rng.normal(0.0, 0.01, (2, len(north)))
    latitude, longitude, height = ned2geodetic(north + noise[0], east + noise[1], 0 * north, 40.79, -77.86, 350.0)
    stamp_ns = EPOCH_NS + np.round(t * 1e9).astype(np.int64)
    return SensorColumns(
        wheel_stamp_ns=stamp_ns,
        wheel_position_left_m=summed(v_left),
        wheel_position_right_m=summed(v_right),
        wheel_v_left_mps=v_left,
        wheel_v_right_mps=v_right,
        gnss_stamp_ns=stamp_ns[::5],
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        gnss_std_m=np.full(len(north), 0.01),
        gnss_status=np.full(len(north), 2, np.int64),
        heading_stamp_ns=stamp_ns,
        heading_rad=psi + rng.normal(0.0, 0.017, len(t)),
        yaw_rate_radps=omega,
    )


def make_logs(folder: Path, seconds: float, names: Iterable[str] = CONTAINERS) -> dict[str, Path]:
    """Write the drive in each container that is named."""
    folder.mkdir(exist_ok=True)
    columns = drive(seconds)
    return {
        name: write_log(
            folder / name,
            columns,
            WriteOptions(
                container=container, wheels="joint_states", heading="enu", compression=compression,
                wheel_radius_m=0.27, track_width_m=0.61,
            ),
        )
        for name in names
        for container, compression in [CONTAINERS[name]]
    }  # fmt: skip


def add_images(log: Path, target: Path, gigabytes: float) -> Path:
    """Copy an MCAP log in chunks of rosbag2's size and add images: 640 x 480 rgb8, half as large when compressed."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    rng = np.random.default_rng(0)
    picture = rng.integers(0, 16, 640 * 480 * 3, dtype=np.uint8).tobytes()
    count = int(gigabytes * 1e9 / len(picture))
    with log.open("rb") as source, target.open("wb") as sink:
        reader = make_reader(source)
        summary = reader.get_summary()
        total = summary.statistics.message_count if summary and summary.statistics else 1
        writer = Writer(sink, chunk_size=ROSBAG2_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[int, int] = {}
        image_schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
        images = writer.register_channel("/camera/image_raw", "cdr", image_schema)
        written = 0
        for place, (schema, channel, message) in enumerate(reader.iter_messages(log_time_order=False)):
            if channel.id not in channels and schema is not None:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
            if written < count * (place + 1) // total:
                writer.add_message(images, message.log_time, picture, message.publish_time)
                written += 1
        writer.finish()
    return target
