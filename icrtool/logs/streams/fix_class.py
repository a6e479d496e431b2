"""How a receiver solved its position: RTK fixed, RTK float or other, from its status, flags, mode or position type."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, NOT_STATED, OTHER_FIX, RTK_FIX

GBAS = 2
"""NavSatStatus: 2 is fixed or float, drivers differ. A log without any of these states nothing about the solution."""

GPSFIX_STATUS = {
    0: OTHER_FIX, 1: OTHER_FIX, GBAS: RTK_FIX, 18: OTHER_FIX, 19: FIXED_FIX, 20: FLOAT_FIX, 33: OTHER_FIX,
}  # fmt: skip
"""GPSStatus of gps_msgs: 18 DGPS, 19 and 20 RTK, 33 WAAS."""

UBLOX_CARRIER = {0: OTHER_FIX, 1: FLOAT_FIX, 2: FIXED_FIX}
"""carrSoln of u-blox, bits 6 and 7 of NavPVT.flags."""

NMEA_QUALITY = {1: OTHER_FIX, 2: OTHER_FIX, 3: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 8: OTHER_FIX, 9: OTHER_FIX}
"""Quality of GGA: single, differential, PPS, RTK fixed and float, simulated, SBAS of NovAtel.

The others are no fixes: 0 none, 6 dead reckoning, 7 typed in.
"""

XBOT_FLAGS = {0: OTHER_FIX, 1: OTHER_FIX, 2: FIXED_FIX, 3: FIXED_FIX, 4: FLOAT_FIX, 5: FLOAT_FIX}
"""Low bits of the flags of xbot_msgs/AbsolutePose: 1 corrections, 2 RTK fixed, 4 RTK float."""

SEPTENTRIO_MODE = {1: OTHER_FIX, 2: OTHER_FIX, 4: FIXED_FIX, 5: FLOAT_FIX, 6: OTHER_FIX, 7: FIXED_FIX, 8: FLOAT_FIX}
"""Low bits of the mode: stand-alone, DGPS, RTK fixed and float, SBAS, moving-base fixed and float."""

NOVATEL_TYPES = {32: FLOAT_FIX, 33: FLOAT_FIX, 34: FLOAT_FIX, 48: FIXED_FIX, 49: FIXED_FIX, 50: FIXED_FIX,
                 51: FIXED_FIX, 55: FLOAT_FIX, 56: FIXED_FIX}  # fmt: skip
"""Position types of NovAtel, numbered as in novatel_oem7_msgs; all others have neither fixed nor float ambiguities."""


def class_by_status(table: TopicTable, codes: Mapping[int, int] | None = None) -> Bytes | None:
    """Return the class (n,) by ``status.status``, of NavSatFix or by `codes`; None where the status states no class.

    Many drivers of NavSatFix write 0 for every fix: a log without a single GBAS (2) states no class.
    """
    status = table.integers("status.status")
    if status is None:
        return None
    if codes is None:
        if not (status == GBAS).any():
            return None
        return np.where(status == GBAS, RTK_FIX, OTHER_FIX).astype(np.uint8)
    classes = _looked_up(status, codes, NOT_STATED)
    informative = (classes == FIXED_FIX) | (classes == FLOAT_FIX) | (classes == RTK_FIX)
    return classes if informative.any() else None


def class_by_carrier(flags: Ints | None) -> Bytes | None:
    """Return the class (n,) by the carrier solution in u-blox flags (n,)."""
    return None if flags is None else class_by_code((flags >> 6) & 3, UBLOX_CARRIER)


def class_by_code(values: Ints | None, codes: Mapping[int, int]) -> Bytes | None:
    """Return the class (n,) by codes (n,); those that are not known state none."""
    return None if values is None else _looked_up(values, codes, NOT_STATED)


def class_by_mode(modes: Ints | None) -> Bytes | None:
    """Return the class (n,) by the mode of a Septentrio block (n,)."""
    return None if modes is None else _looked_up(modes & 0x0F, SEPTENTRIO_MODE, OTHER_FIX)


def class_by_type(table: TopicTable, path: str) -> Bytes | None:
    """Return the class (n,) by a NovAtel position type, which is a word (``NARROW_INT``) or a number."""
    if path in table.texts:
        codes, texts = table.words(path)
        by_word = [_of_word(text) for text in texts]
        return np.array([*by_word, NOT_STATED], np.uint8)[codes]
    values = table.integers(path)
    return None if values is None else _looked_up(values, NOVATEL_TYPES, OTHER_FIX)


def _of_word(text: str) -> int:
    if not text:
        return NOT_STATED
    if text.endswith(("_FLOAT", "RTKFLOAT")):
        return FLOAT_FIX
    return FIXED_FIX if text.endswith(("_INT", "RTKFIXED", "RTK_DIRECT_INS")) else OTHER_FIX


def _looked_up(values: Ints, codes: Mapping[int, int], otherwise: int) -> Bytes:
    classes = np.full(len(values), otherwise, np.uint8)
    for value, code in codes.items():
        classes[values == value] = code
    return classes
