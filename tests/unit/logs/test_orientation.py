"""Quaternions as drivers write them: in order, w first, x and w swapped, on a sensor that lies on its side."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icrtool.logs.streams.headings import nose_yaw

RATE_HZ = 50.0
YAW_TOLERANCE_RAD = 1e-9


def drive(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return yaw, gyro, and the quaternion (n, 4) as x, y, z, w of a robot on uneven ground that turns both ways."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, 1 / RATE_HZ)
    yaw = 2.5 * np.sin(0.11 * t) + 0.02 * t + 0.01 * rng.normal(size=len(t))
    rate = 2.5 * 0.11 * np.cos(0.11 * t) + 0.02
    roll, pitch = 0.05 * np.sin(t), 0.08 * np.cos(0.7 * t)
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a / 2), np.sin(a / 2)) for a in (roll, pitch, yaw))
    q = [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
    return yaw, rate, np.column_stack(q)


def away(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(np.angle(np.exp(1j * (found - expected)))).max())


@pytest.mark.parametrize(
    ("fields", "words"), [((0, 1, 2, 3), ""), ((3, 0, 1, 2), "w first"), ((3, 1, 2, 0), "x and w swapped")]
)
@pytest.mark.parametrize("with_gyro", [True, False])
def test_the_yaw_is_found_whatever_the_order(fields: tuple[int, ...], words: str, with_gyro: bool) -> None:
    yaw, rate, q = drive()
    found, usable, note = nose_yaw(q[:, fields].T, rate if with_gyro else None)
    assert usable.all()
    assert away(found, yaw) < YAW_TOLERANCE_RAD
    assert (note is not None and words in note.text) if words else note is None


def test_another_order_is_not_taken_against_the_gyro() -> None:
    _, rate, q = drive()
    _, _, note = nose_yaw(q[:, (3, 0, 1, 2)].T, -rate)
    assert "w first" not in str(note)


def test_a_sensor_on_its_side_is_no_other_order() -> None:
    yaw, _, q = drive()
    x, y, z, w = q.T
    # The body's orientation times a quarter turn about x.
    h = math.sqrt(0.5)
    aside = np.column_stack([h * (x + w), h * (y + z), h * (z - y), h * (w - x)])
    found, _, note = nose_yaw(aside.T)
    assert note is not None
    assert "mounted on its side" in note.text
    offset = found - yaw
    assert float(np.abs(np.exp(1j * offset).mean())) > 0.99
