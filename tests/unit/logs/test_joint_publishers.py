"""Joint states of several publishers: zeros beside the wheels are left out, sides of their own are joined."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import icrtool
from icrtool.config import load_config
from icrtool.kernels.arrays import Floats
from icrtool.logs.read_log import read_log
from support.field_logs import (
    ROBOT,
    Drive,
    Message,
    header,
    joint_states,
    made,
    make_drive,
    reference,
    write_messages,
)

DRIVE = make_drive(40.0)
KIND = "sensor_msgs/msg/JointState"


def zeros(drive: Drive, every_ns: int, *, speeds: bool, late_ns: int = 3_000_000) -> Iterator[Message]:
    for stamp_ns in range(int(drive.stamp_ns[0]), int(drive.stamp_ns[-1]), every_ns):
        values = np.zeros(2)
        message = made(
            KIND, header=header(stamp_ns + late_ns), name=["left_wheel", "right_wheel"], position=values,
            velocity=values if speeds else np.zeros(0),
        )  # fmt: skip
        yield Message(stamp_ns + late_ns, "/joint_states", KIND, message)


def apart(drive: Drive, wheels: int, late_ns: int, *, quantity: str) -> Iterator[Message]:
    """Messages of one wheel each, `wheels` of a side, the right ones later."""
    for side, angle, speed in (("left", drive.left, drive.left_radps), ("right", drive.right, drive.right_radps)):
        for wheel in range(wheels):
            for i, stamp_ns in enumerate(drive.stamp_ns.tolist()):
                sent = stamp_ns + wheel * 1_000_000 + (late_ns if side == "right" else 0)
                ahead = (sent - stamp_ns) / 1e9 * speed[i]
                message = made(
                    KIND, header=header(sent), name=[f"{side}_wheel_{wheel}"],
                    position=np.array([angle[i] + ahead] if "p" in quantity else []),
                    velocity=np.array([speed[i]] if "v" in quantity else []),
                )  # fmt: skip
                yield Message(sent, "/joint_states", KIND, message)


@pytest.mark.parametrize("every_ns", [20_000_000, 50_000_000, 100_000_000])
@pytest.mark.parametrize("speeds", [False, True])
@pytest.mark.parametrize("late_ns", [0, 3_000_000])
def test_zeros_of_a_second_publisher_are_left_out_and_named(
    tmp_path: Path, every_ns: int, speeds: bool, late_ns: int
) -> None:
    others = zeros(DRIVE, every_ns, speeds=speeds, late_ns=late_ns)
    log = read_log(
        write_messages(tmp_path / "log.mcap", joint_states(DRIVE), others, reference(DRIVE)),
        load_config(sets=ROBOT),
    )
    rows = np.searchsorted(DRIVE.stamp_ns, log.wheels.stamp_ns[:-1])
    assert len(rows) > 0.98 * len(DRIVE.stamp_ns)
    np.testing.assert_allclose(log.wheels.left[:-1], DRIVE.left_radps[rows], rtol=1e-6)
    assert any("second publisher" in one for one in log.warnings)


@pytest.mark.parametrize("every_ns", [20_000_000, 70_000_000])
@pytest.mark.parametrize("quantity", ["pv", "p", "v"])
@pytest.mark.parametrize("stale", [True, False])
def test_a_state_that_a_second_publisher_repeats_is_left_out(
    tmp_path: Path, every_ns: int, quantity: str, stale: bool
) -> None:
    at = int(np.argmax(np.abs(DRIVE.left_radps))) if stale else 0
    place, speed = (DRIVE.left[at], DRIVE.right[at]), (DRIVE.left_radps[at], DRIVE.right_radps[at])
    state, none = {"p": np.array(place), "v": np.array(speed)}, np.zeros(0)

    def sent(stamp_ns: int, values: dict[str, Floats]) -> Message:
        position, velocity = (values[one] if one in quantity else none for one in "pv")
        names = ["left_wheel", "right_wheel"]
        message = made(KIND, header=header(stamp_ns), name=names, position=position, velocity=velocity)
        return Message(stamp_ns, "/joint_states", KIND, message)

    repeated = state if stale else {one: np.zeros(2) for one in "pv"}
    begin, end = int(DRIVE.stamp_ns[0]), int(DRIVE.stamp_ns[-1])
    others = [sent(stamp_ns + 3_000_000, repeated) for stamp_ns in range(begin, end, every_ns)]
    own = [
        sent(stamp_ns, {"p": np.array([a, b]), "v": np.array([c, d])})
        for stamp_ns, a, b, c, d in zip(
            DRIVE.stamp_ns.tolist(), DRIVE.left, DRIVE.right, DRIVE.left_radps, DRIVE.right_radps, strict=True
        )
    ]
    path = write_messages(tmp_path / "log.mcap", own, others, reference(DRIVE))
    log = read_log(path, load_config(sets=ROBOT))
    rows = np.searchsorted(DRIVE.stamp_ns, log.wheels.stamp_ns[:-1])
    assert len(rows) > 0.97 * len(DRIVE.stamp_ns)
    expected = DRIVE.left_radps[rows]
    np.testing.assert_allclose(log.wheels.left[:-1], expected, rtol=1e-6, atol=0.0 if "p" not in quantity else 0.05)
    assert [one.code for one in log.notes].count("second_publisher") == 1


def test_speeds_of_an_encoder_with_few_counts_have_no_second_publisher(tmp_path: Path) -> None:
    """Speeds in steps, that go to and fro between two values."""
    sides = (np.round(side / 0.5) * 0.5 for side in (DRIVE.left_radps, DRIVE.right_radps))
    left, right = (side + 0.5 * (np.arange(len(side)) % 3 == 0) for side in sides)
    drive = DRIVE._replace(left_radps=left, right_radps=right)
    path = write_messages(tmp_path / "log.mcap", joint_states(drive), reference(DRIVE))
    log = read_log(path, load_config(sets=(*ROBOT, "wheels.quantity=velocity")))
    assert len(log.wheels.stamp_ns) == len(DRIVE.stamp_ns)
    assert not log.warnings


def test_a_robot_that_stops_often_has_no_second_publisher(tmp_path: Path) -> None:
    """Speeds alone, 0 for a second every four seconds."""
    stops = np.where(np.arange(len(DRIVE.stamp_ns)) % 80 < 20, 0.0, 1.0)
    drive = DRIVE._replace(left_radps=DRIVE.left_radps * stops, right_radps=DRIVE.right_radps * stops)
    path = write_messages(tmp_path / "log.mcap", joint_states(drive), reference(DRIVE))
    log = read_log(path, load_config(sets=(*ROBOT, "wheels.quantity=velocity")))
    assert len(log.wheels.stamp_ns) == len(DRIVE.stamp_ns)
    assert not log.warnings


@pytest.mark.parametrize("wheels", [1, 2])
@pytest.mark.parametrize("late_ns", [0, 2_000_000, 25_000_000])
def test_positions_of_wheels_in_messages_of_their_own_are_joined(tmp_path: Path, wheels: int, late_ns: int) -> None:
    path = write_messages(tmp_path / "log.mcap", apart(DRIVE, wheels, late_ns, quantity="pv"), reference(DRIVE))
    log = read_log(path, load_config(sets=ROBOT))
    rows = np.searchsorted(DRIVE.stamp_ns, log.wheels.stamp_ns[:-1])
    assert len(rows) > 0.98 * len(DRIVE.stamp_ns)
    np.testing.assert_allclose(log.wheels.left[:-1], DRIVE.left_radps[rows], atol=0.1)
    np.testing.assert_allclose(log.wheels.right[:-1], DRIVE.right_radps[rows], atol=0.1)
    assert any("has its own messages" in one for one in log.warnings)


def test_speeds_of_sides_in_messages_of_their_own_are_held(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "log.mcap", apart(DRIVE, 1, 2_000_000, quantity="v"), reference(DRIVE))
    log = read_log(path, load_config(sets=ROBOT))
    np.testing.assert_allclose(log.wheels.right, DRIVE.right_radps[: len(log.wheels.right)], rtol=1e-9)


@pytest.mark.parametrize("name", ["09_two_publishers", "13_sides_in_own_messages"])
def test_the_shared_logs_of_publishers_give_the_true_icrs(shared_logs: Path, name: str) -> None:
    """Truth: right +0.520, left -0.500, x +0.060 m."""
    config = load_config(sets=ROBOT)
    run = icrtool.fit(read_log(shared_logs / "reports" / f"{name}.mcap", config), config)
    final = run.summary["icr"]["final"]
    found = [final[one] for one in ("y_icr_right_m", "y_icr_left_m", "x_icr_m")]
    np.testing.assert_allclose(found, [0.52, -0.5, 0.06], atol=0.03)
