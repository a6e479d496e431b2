"""NMEA sentences: what pynmea2 reads in them is read; what has no right checksum, or makes no sense, is left out."""

from __future__ import annotations

import math
import struct
import time
from pathlib import Path

import numpy as np
import pynmea2
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from icrtool.config import Config, load_config
from icrtool.logs.messages.decoded_values import GGA, GST, HDT, NMEA_SENTENCE, RMC, _parse_degrees, parse_sentence
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.read_log import read_log
from icrtool.records.samples import FIXED_FIX, FLOAT_FIX, OTHER_FIX
from icrtool.records.tables import RobotLog
from support.field_logs import ROBOT
from support.scripts import load_script
from support.tables import channel_of, collected, read_source

ROUNDING_DEG = 1e-12
FUZZ = load_script("fuzz_nmea")
STEP_NS = 100_000_000
PATIENT = settings(suppress_health_check=[HealthCheck.too_slow])
"""On a busy machine the first drawing takes seconds."""

FIXES = st.tuples(
    st.floats(0.0, 8999.999), st.sampled_from("NS"), st.floats(0.0, 17959.999), st.sampled_from("EW"),
    st.integers(0, 9), st.floats(-400.0, 8000.0), st.floats(-100.0, 80.0),
)  # fmt: skip


def sentence(body: str) -> bytes:
    """Return a sentence with its checksum."""
    checksum = 0
    for byte in body.encode():
        checksum ^= byte
    return f"${body}*{checksum:02X}\r\n".encode()


def gga(quality: int, utc: str = "101500.00", north: str = "4806.000") -> bytes:
    return sentence(f"GNGGA,{utc},{north},N,01136.000,E,{quality},12,0.8,500.0,M,47.0,M,,")


def table_of(texts: list[bytes]) -> TopicTable:
    """Return the messages of a topic, as ROS 2 serializes them."""
    head = b"\0\1\0\0" + struct.pack("<iII", 0, 0, 1) + b"\0\0\0\0"
    messages = (head + struct.pack("<I", len(text) + 1) + text + b"\0" for text in texts)
    stamps = (STEP_NS * (1 + i) for i in range(len(texts)))
    return collected(channel_of(NMEA_SENTENCE), ("sentence",), list(zip(stamps, messages, strict=True)))


@PATIENT
@given(FIXES)
def test_a_fix_is_where_another_library_reads_it(fix: tuple[float, str, float, str, int, float, float]) -> None:
    north, side, east, hemisphere, quality, height, undulation = fix
    # ddmm.mmmm: of the last two digits before the point no more than a degree has minutes
    north, east = (angle // 100 * 100 + 0.6 * (angle % 100) for angle in (north, east))
    fields = (
        "101500.25", f"{north:012.6f}", side, f"{east:013.6f}", hemisphere, str(quality), "12", "0.8",
        f"{height:.3f}", "M", f"{undulation:.3f}", "M", "", "",
    )  # fmt: skip
    text = str(pynmea2.GGA("GN", "GGA", fields))
    read, expected = parse_sentence(text.encode()), pynmea2.parse(text, check=True)
    assert read is not None
    assert read["sentence_kind"] == GGA
    assert read["latitude"] == pytest.approx(expected.latitude, abs=ROUNDING_DEG)
    assert read["longitude"] == pytest.approx(expected.longitude, abs=ROUNDING_DEG)
    assert read["altitude"] == pytest.approx(expected.altitude + float(expected.geo_sep), abs=1e-9)
    assert read["quality"] == quality


@PATIENT
@given(st.binary(max_size=200) | st.text("$!*,.GNAPRMCSTHD0123456789-+eEnaif\r\n", max_size=120).map(str.encode))
def test_bytes_of_any_kind_are_a_sentence_or_none(text: bytes) -> None:
    read = parse_sentence(text)
    assert read is None or all(isinstance(value, (int, float)) for value in read.values())


@PATIENT
@given(st.data())
def test_a_sentence_with_a_changed_byte_is_none(data: st.DataObject) -> None:
    text = bytearray(gga(4).strip())
    place, byte = data.draw(st.integers(1, len(text) - 1)), data.draw(st.integers(0, 255))
    same = text[place] == byte or (text[place : place + 1].lower() == bytes([byte]).lower() and place > len(text) - 3)
    text[place] = byte
    assert (parse_sentence(bytes(text)) is None) is not same


@pytest.mark.parametrize("text", [b"", b"$", b"$GNGGA*", gga(4)[:-5], gga(4).replace(b"*", b""), gga(4) * 2])
def test_a_sentence_without_its_checksum_is_none(text: bytes) -> None:
    assert parse_sentence(text) is None


@pytest.mark.parametrize(
    "field", ["nan", "inf", "1e5", "1_0", "", " 4806.0", "9" * 40, "٤٨٠٦.٠", "4806.0.0", "0x10", "-", "."]
)
def test_a_field_that_is_no_number_of_nmea_is_none(field: str) -> None:
    read = parse_sentence(gga(4, north=field))
    assert read is None or math.isnan(read["latitude"])


def test_a_sentence_that_ends_early_has_what_it_has() -> None:
    assert math.isnan(parse_sentence(sentence("GNGGA"))["latitude"])
    assert parse_sentence(sentence("GNRMC,,A"))["quality"] == 1
    assert parse_sentence(sentence("GPGSV,1,1,00")) == {}


def test_the_quality_states_how_the_position_was_solved() -> None:
    source = read_source("gnss", table_of([gga(quality) for quality in range(10)]), Config())
    assert source.usable.tolist() == [quality not in (0, 6, 7) for quality in range(10)]
    stated = dict(enumerate(source.stated_class.tolist()))
    assert (stated[4], stated[5]) == (FIXED_FIX, FLOAT_FIX)
    assert {stated[quality] for quality in (1, 2, 3, 8, 9)} == {OTHER_FIX}
    assert source.rejected == {"no fix": 3}


def test_the_mode_of_rmc_states_it_too_and_a_void_one_is_no_fix() -> None:
    body = "GPRMC,101500.00,{},4806.000,N,01136.000,E,0.1,,231126,,,{}"
    modes = [("A", "R"), ("A", "F"), ("A", "D"), ("V", "A"), ("A", "N"), ("A", "")]
    source = read_source("gnss", table_of([sentence(body.format(*mode)) for mode in modes]), Config())
    assert source.usable.tolist() == [True, True, True, False, False, True]
    assert source.stated_class.tolist()[:3] == [FIXED_FIX, FLOAT_FIX, OTHER_FIX]


def test_deviations_are_those_of_the_nearest_gst_up_to_one_and_a_half_seconds_away() -> None:
    gst = "GNGST,101500.00,5,0.02,0.01,12,{},0.5,0.02"
    texts = [gga(4)] * 30 + [sentence(gst.format(0.3)), *[gga(4)] * 10, sentence(gst.format(0.4)), *[gga(4)] * 3]
    source = read_source("gnss", table_of(texts), Config())
    near = 1.5e9 / STEP_NS
    expected = [math.nan if 30 - i >= near else 0.09 for i in range(30)] + [0.09] * 5 + [0.16] * 8
    assert source.variance[:, 0].tolist() == pytest.approx(expected, nan_ok=True)
    assert source.variance[-1, 1] == pytest.approx(0.25)


def test_a_heading_is_clockwise_from_true_north() -> None:
    texts = [sentence("GPHDT,90.0,T"), gga(4), sentence("GPHDT,,T"), sentence("GPHDT,359.5,T")]
    source = read_source("heading", table_of(texts), Config())
    assert source.convention == "ned"
    assert source.usable.tolist() == [True, False, True]
    np.testing.assert_allclose(np.degrees(source.heading_rad("ned")[source.usable]), [90.0, -0.5])


def test_sentences_are_counted_and_those_damaged_are_not_read() -> None:
    bad = bytearray(gga(4))
    bad[10] ^= 1
    table = table_of(
        [gga(4), bytes(bad), sentence("GPRMC,,V"), sentence("GPGST,"), sentence("GPHDT,1,T"), b"\xff" * 99]
    )
    assert table.unreadable == 2
    assert table.column("sentence_kind").tolist() == [GGA, RMC, GST, HDT]


def test_sentences_of_megabytes_cost_no_time() -> None:
    begin = time.process_time()
    table = table_of([b"$" + b"," * 1_000_000 + b"*00"] * 20)
    assert table.unreadable == 20
    assert time.process_time() - begin < 2.0


@pytest.mark.parametrize("north", ["4760.0001", "4799.0", "-4712.0"])
def test_more_than_sixty_minutes_or_a_minus_is_no_latitude(north: str) -> None:
    assert math.isnan(_parse_degrees(north, "N", "NS"))
    assert _parse_degrees("4730.0", "S", "NS") == -47.5


def novatel_crc(text: bytes) -> int:
    """CRC of 32 bits as the manual of NovAtel's OEM7 gives it, bit by bit."""
    crc = 0
    for byte in text:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc


def uniheading(heading: float, solution: str = "SOL_COMPUTED", kind: str = "NARROW_INT") -> bytes:
    body = f"UNIHEADINGA,97,GPS,FINE,2190,375201200,0,0,18,12;{solution},{kind},0.9931,{heading:.4f},0.5,0.0,0.31,0.62"
    return f"#{body}*{novatel_crc(body.encode()):08x}\r\n".encode()


def test_several_sentences_in_a_message_are_read_together() -> None:
    """A receiver whose epochs are logged whole: fix, deviations and heading have one stamp."""
    rest = "010,08.0,03.0,,A"
    texts = [
        sentence(f"GNRMC,101500.00,A,4806.000,N,01136.000,E,0.5,{rest}") + gga(4)
        + sentence("GNGST,101500.00,0.01,0.02,0.01,30,0.012,0.015,0.03") + sentence(f"GNHDT,{30 + i:.2f},T")
        for i in range(5)
    ]  # fmt: skip
    fixes = read_source("gnss", table_of(texts), Config())
    np.testing.assert_allclose(fixes.variance[:, 0], 0.012**2)
    assert set(fixes.stated_class) == {FIXED_FIX}
    assert np.isfinite(fixes.geodetic[:, 2]).all()
    heading = read_source("heading", table_of(texts), Config())
    np.testing.assert_allclose(np.degrees(heading.yaw_rad), 30.0 + np.arange(5))


def test_sentences_without_checksums_are_read_where_no_sentence_has_one() -> None:
    bare = [gga(4).partition(b"*")[0] for _ in range(5)]
    assert read_source("gnss", table_of(bare), Config()).usable.sum() == 5
    assert len(table_of([*bare, gga(4)])) == 1


@pytest.mark.parametrize("text", ["GNTHS,{:.2f},A", "GPHDT,{:.2f},T"])
def test_true_headings_are_read_of_either_sentence(text: str) -> None:
    found = read_source("heading", table_of([sentence(text.format(30 + i)) for i in range(5)]), Config())
    np.testing.assert_allclose(np.degrees(found.yaw_rad), 30.0 + np.arange(5))


def test_a_heading_that_is_not_valid_is_left_out() -> None:
    texts = [
        sentence("GNTHS,30.00,A"),
        sentence("GNTHS,31.00,V"),
        uniheading(32.0),
        uniheading(33.0, "INSUFFICIENT_OBS"),
    ]
    found = read_source("heading", table_of(texts), Config())
    np.testing.assert_array_equal(found.usable, [True, False, True, False])


def test_headings_of_unicore_are_read_with_their_deviation_and_checked() -> None:
    texts = [uniheading(30.0 + i) for i in range(5)]
    texts[3] = texts[3].replace(b"0.9931", b"0.9932")
    found = read_source("heading", table_of(texts), Config())
    np.testing.assert_allclose(np.degrees(found.yaw_rad), [30.0, 31.0, 32.0, 34.0])
    np.testing.assert_allclose(np.degrees(np.sqrt(found.variance)), 0.31)


def read_topic(path: Path, texts: list[bytes], stamps: list[int]) -> RobotLog:
    """Return the log of 400 wheel samples and a topic of sentences, with a message for each text."""
    FUZZ.write_sentences(path, texts, stamps, 400, 0)
    return read_log(path, load_config(sets=ROBOT))


@pytest.mark.parametrize("every", [1, 2, 3])
def test_headings_in_messages_of_their_own_have_their_own_stamps(tmp_path: Path, every: int) -> None:
    """Their number need not be that of the fixes."""
    stamps, epochs = FUZZ.drive(400)
    fix_ns, heading_ns = stamps, [one + 30_000_000 for one in stamps[::every]]
    timed = [(one, epoch[1]) for one, epoch in zip(fix_ns, epochs, strict=True)]
    timed += [(one, epoch[3]) for one, epoch in zip(heading_ns, epochs[::every], strict=True)]
    ordered = sorted(timed)
    log = read_topic(tmp_path / "log.mcap", [sentence(body) for _, body in ordered], [one for one, _ in ordered])
    assert log.gnss.stamp_ns.tolist() == fix_ns
    assert log.heading.stamp_ns.tolist() == heading_ns


def test_headings_in_bursts_are_spread_as_the_fixes_of_their_topic(tmp_path: Path) -> None:
    stamps, epochs = FUZZ.drive(400)
    whole = len(stamps) // 5 * 5
    packets = [stamps[row // 5 * 5 + 4] + row % 5 * 2_000_000 for row in range(whole)]
    chosen = [epoch[1::2] if row % 3 else epoch[1:2] for row, epoch in enumerate(epochs[:whole])]
    texts = [sentence(body) for epoch in chosen for body in epoch]
    log = read_topic(
        tmp_path / "log.mcap", texts, [one for one, epoch in zip(packets, chosen, strict=True) for _ in epoch]
    )
    assert [one.code for one in log.notes] == ["fix_bursts"]
    step_ns = stamps[1] - stamps[0]
    assert np.abs(log.gnss.stamp_ns - stamps[:whole]).max() < 0.2 * step_ns
    sent = [stamp for row, stamp in enumerate(stamps[:whole]) if row % 3]
    assert len(log.heading.stamp_ns) == len(sent)
    assert np.abs(log.heading.stamp_ns - sent).max() < 1.5 * step_ns
