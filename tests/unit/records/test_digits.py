"""Differences print with as many digits as their standard deviation needs."""

import re
from pathlib import Path

import pytest

import icrtool
from icrtool.records.run import icr_text
from icrtool.records.text import digits_of, with_interval, with_std


@pytest.mark.parametrize(
    ("value", "std", "text"),
    [
        (0.0044, 0.0072, "+0.004 ± 0.007"),
        (0.0044, 0.0132, "+0.004 ± 0.013"),
        (-0.25, 0.31, "-0.25 ± 0.31"),
        (12.0, 3.0, "+12.00 ± 3.00"),
        (-0.0004, 0.03, "+0.00 ± 0.03"),
        (0.0, 1e-9, "+0.00000 ± 0.00000"),
    ],
)
def test_a_spread_is_never_rounded_to_one_digit_less_than_it_needs(value: float, std: float, text: str) -> None:
    assert with_std(value, std) == text


def test_an_interval_has_the_digits_it_needs_and_no_negative_zero() -> None:
    assert with_interval(-0.1213, -0.16, -0.0004) == "-0.12 m (-0.16 to +0.00)"
    assert with_interval(0.0011, -0.0052, 0.0071) == "+0.001 m (-0.005 to +0.007)"
    assert with_interval(0.5, None, 0.7) == "+0.50 m (too short for an interval)"


@pytest.mark.parametrize("std", [0.0, float("nan"), float("inf")])
def test_without_a_spread_the_least_digits_are_printed(std: float) -> None:
    assert digits_of(std, 3) == 3


def test_an_icr_that_rounds_to_zero_has_no_negative_sign() -> None:
    assert icr_text(-0.0003, 0.02) == "+0.000 ± 0.020"


def test_every_signed_number_of_fixed_digits_is_printed_without_a_negative_zero() -> None:
    sources = {path: path.read_text(encoding="utf-8") for path in Path(icrtool.__file__).parent.rglob("*.py")}
    signed = [form for text in sources.values() for form in re.findall(r":\+z?\.[\w{}()/. -]+f\}", text)]
    assert len(signed) > 20
    assert [form for form in signed if not form.startswith(":+z")] == [":+.{digits}f}"], "`signed` has no sign at zero"
