"""The bundled message definitions parse, are complete in themselves, and carry a message through CDR and back."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

BUNDLE = Path(__file__).resolve().parents[3] / "icrtool" / "logs" / "messages" / "definitions"
FILES = sorted(BUNDLE.glob("*/*.msg"))
NAMES = [f"{file.parent.name}/msg/{file.stem}" for file in FILES]
FIELD = re.compile(r"[A-Za-z]\w*(/[A-Z]\w*)?(\[\d*\])? [a-zA-Z]\w*")
CONSTANT = re.compile(r"u?int(8|16|32) [A-Z][A-Z0-9_]*=-?\d+")
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4
ENCAPSULATION_BYTES = 4
EMPTY_HEADER_BYTES = 13
"""Two uint32 of the stamp, the length 1 of the frame's name, its closing zero."""


def parse(file: Path) -> dict[str, Any]:
    return get_types_from_msg(file.read_text(encoding="utf-8"), f"{file.parent.name}/msg/{file.stem}")


@pytest.fixture(scope="module")
def store() -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    for file in FILES:
        store.register(parse(file))
    return store


def referred(fields: list[tuple[str, Any]]) -> set[str]:
    names = set()
    for _, (node, detail) in fields:
        kind, name = detail[0] if int(node) in {ARRAY, SEQUENCE} else (node, detail)
        if int(kind) == NAME:
            names.add(name)
    return names


def make(store: Typestore, name: str, rng: np.random.Generator | None) -> Any:
    """Make a message: of zeros, or every number drawn, two elements in each list, a word in each text."""

    def base(kind: str) -> Any:
        if kind == "string":
            return "" if rng is None else "NARROW_INT"
        if rng is None:
            return np.zeros(1, dtype=kind).item()
        return rng.integers(0, 2 if kind == "bool" else 100, 1).astype(kind).item()

    def many(kind: int, inner: str, count: int) -> Any:
        if kind == NAME:
            return [make(store, inner, rng) for _ in range(count)]
        values = [base(inner) for _ in range(count)]
        return values if inner == "string" else np.array(values, dtype=inner)

    values = []
    for _, (node, detail) in store.fielddefs[name][1]:
        if int(node) == BASE:
            values.append(base(detail[0]))
        elif int(node) == NAME:
            values.append(make(store, detail, rng))
        else:
            (kind, inner), count = detail
            inner_name = inner if int(kind) == NAME else inner[0]
            length = count if int(node) == ARRAY else (0 if rng is None else 2)
            values.append(many(int(kind), inner_name, length))
    return store.types[name](*values)


def plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value) if not field.name.startswith("__")]
        return [(field, plain(getattr(value, field))) for field in fields]
    if isinstance(value, (list, np.ndarray)):
        return [plain(one) for one in value]
    return value


def test_there_are_definitions() -> None:
    assert {"jackal_msgs/msg/Feedback", "scout_msgs/msg/ScoutStatus", "ublox_msgs/msg/NavPVT"} <= set(NAMES)


def test_packages_hold_nothing_but_definitions() -> None:
    strays = [path for path in BUNDLE.glob("*/*") if path.suffix != ".msg"]
    assert strays == []


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_a_file_holds_facts_only(file: Path) -> None:
    for line in file.read_text(encoding="ascii").splitlines():
        assert FIELD.fullmatch(line) or CONSTANT.fullmatch(line), f"{file.name}: neither a field nor a constant: {line}"


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_a_file_parses_to_the_one_type_it_is_named_after(file: Path) -> None:
    assert list(parse(file)) == [f"{file.parent.name}/msg/{file.stem}"]


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_a_type_refers_only_to_types_at_hand(file: Path) -> None:
    known = {*NAMES, *get_typestore(Stores.ROS2_HUMBLE).fielddefs}
    for _, fields in parse(file).values():
        assert referred(fields) <= known


def test_no_bundled_type_stands_in_for_a_standard_one() -> None:
    assert set(NAMES).isdisjoint(get_typestore(Stores.ROS2_HUMBLE).fielddefs)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("drawn", [False, True], ids=["zeros", "drawn"])
def test_a_message_survives_cdr(store: Typestore, name: str, drawn: bool) -> None:
    message = make(store, name, np.random.default_rng(11) if drawn else None)
    raw = store.serialize_cdr(message, name)
    back = store.deserialize_cdr(raw, name)
    assert plain(back) == plain(message)
    assert bytes(store.serialize_cdr(back, name)) == bytes(raw)


@pytest.mark.parametrize(
    ("name", "body_bytes"),
    [
        # u-blox messages are laid out as the receiver sends them: the payload lengths of the UBX protocol.
        ("ublox_msgs/msg/NavPVT", 92),
        ("ublox_msgs/msg/NavRELPOSNED", 40),
        ("ublox_msgs/msg/NavRELPOSNED9", 64),
        ("ublox_msgs/msg/NavHPPOSLLH", 36),
        # sec, nanosec and 4 x float32[4]
        ("leo_msgs/msg/WheelStates", 72),
        # header to 16; two of (6 float32, bool), the second starting on a multiple of 4; two int8
        ("jackal_msgs/msg/Feedback", 16 + 28 + 24 + 1 + 2),
        ("clearpath_platform_msgs/msg/Feedback", 16 + 28 + 24 + 1 + 2),
    ],
)
def test_a_message_is_as_long_as_its_layout_says(store: Typestore, name: str, body_bytes: int) -> None:
    raw = store.serialize_cdr(make(store, name, None), name)
    assert len(raw) - ENCAPSULATION_BYTES == body_bytes


def test_headers_are_those_of_ros_2(store: Typestore) -> None:
    raw = store.serialize_cdr(make(store, "std_msgs/msg/Header", None), "std_msgs/msg/Header")
    assert len(raw) - ENCAPSULATION_BYTES == EMPTY_HEADER_BYTES


def test_constants_tell_the_carrier_phase_apart() -> None:
    constants = {
        name: value for name, _, value in parse(BUNDLE / "ublox_msgs" / "NavPVT.msg")["ublox_msgs/msg/NavPVT"][0]
    }
    assert constants["CARRIER_PHASE_FLOAT"] & constants["FLAGS_CARRIER_PHASE_MASK"] == 64
    assert constants["CARRIER_PHASE_FIXED"] & constants["FLAGS_CARRIER_PHASE_MASK"] == 128


def test_every_package_says_where_it_comes_from() -> None:
    told = re.findall(r"^- `(\w+)`: ", (BUNDLE / "SOURCES.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert told == sorted({file.parent.name for file in FILES})
