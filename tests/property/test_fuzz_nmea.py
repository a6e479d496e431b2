"""Logs of damaged NMEA sentences: they are read as another library reads them, or refused in one line.

The logs are the same in each run. ``make fuzz`` tries many more.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from itertools import chain
from pathlib import Path

import numpy as np
import pynmea2
import pytest

from icrtool.errors import IcrToolError
from icrtool.logs.messages.decoded_values import parse_sentence
from icrtool.logs.read_log import survey_log
from icrtool.logs.streams.assembly import assemble
from property.test_fuzz_logs import CONFIG, check_outcome
from support.scripts import load_script

FUZZ = load_script("fuzz_nmea")
ROUNDING_DEG, ROUNDING = 1e-12, 1e-9


@pytest.mark.parametrize("seed", range(25))
def test_damaged_sentences_are_read_or_refused_in_one_line(tmp_path: Path, seed: int) -> None:
    path, _ = FUZZ.write_log(tmp_path / "log.mcap", np.random.default_rng(seed))
    check_outcome(path)


@pytest.mark.parametrize("form", [0, 1])
@pytest.mark.parametrize("joined", ["one sentence in a message", "an epoch in a message"])
def test_whole_sentences_are_all_read(tmp_path: Path, form: int, joined: str) -> None:
    stamps, epochs = FUZZ.drive(30)
    lines = [[FUZZ.checked(body).encode() for body in epoch] for epoch in epochs]
    texts = [b"\r\n".join(epoch) for epoch in lines] if joined.startswith("an epoch") else list(chain(*lines))
    log = assemble(survey_log(FUZZ.write_sentences(tmp_path / "log.mcap", texts, stamps, 30, form), CONFIG), CONFIG)
    assert (len(log.wheels.stamp_ns), len(log.gnss.stamp_ns), len(log.heading.stamp_ns)) == (30, 10, 10)


@pytest.mark.parametrize("form", [3, 4])
def test_sentences_in_a_message_of_text_are_no_source(tmp_path: Path, form: int) -> None:
    stamps, epochs = FUZZ.drive(30)
    texts = [FUZZ.checked(body).encode() for epoch in epochs for body in epoch]
    path = FUZZ.write_sentences(tmp_path / "log.mcap", texts, stamps, 30, form)
    with pytest.raises(IcrToolError, match=r"/nmea \(std_msgs/String\)"):
        assemble(survey_log(path, CONFIG), CONFIG)


def test_a_position_of_a_damaged_sentence_is_where_another_library_reads_it() -> None:
    compared, damaged = 0, Counter[str]()
    for seed in range(60):
        texts, done = FUZZ.damaged(FUZZ.drive(30)[1], np.random.default_rng(seed))
        damaged.update(done)
        for text in texts:
            read = parse_sentence(text) if len(text) < 512 else None
            if read is not None and math.isfinite(read.get("latitude", math.nan)):
                fields = text.decode("ascii").split(",")
                angle = fields[2 if fields[0].endswith("GGA") else 3]
                if not re.fullmatch(r"\$[A-Z]{5}", fields[0]) or not re.fullmatch(r"\d{3,}\.\d+", angle):
                    continue  # pynmea2 reads no other talkers and angles
                expected = pynmea2.parse(text.decode("utf-8").strip(), check=True)
                assert read["latitude"] == pytest.approx(expected.latitude, abs=ROUNDING_DEG, rel=ROUNDING)
                compared += 1
    assert compared > 200
    assert set(damaged) >= {damage.__name__ for damage in (*FUZZ.BODY_DAMAGE, *FUZZ.TEXT_DAMAGE, FUZZ.long_text)}
