"""Runs and calibrations whose JSON somebody edited: one line, or an object that can be used; never a traceback."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from click.testing import CliRunner

import icrtool
from icrtool.errors import IcrToolError
from icrtool.output.files.formats import json_bytes, open_calibration
from icrtool.output.files.run_columns import COLUMNS_OF_STATES, INTEGER_COLUMNS
from icrtool.output.run_directory import events_csv, log_of
from icrtool.output.tables.run import format_run
from support.edits import edited

LONGEST_LINE = 1000
LONGEST_S = 5.0


@pytest.fixture(scope="module")
def run_place(short_logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = icrtool.load_config(robot="husky-a200")
    place = tmp_path_factory.mktemp("edited") / "run"
    icrtool.fit(icrtool.read_log(short_logs / "field.mcap", config), config).write(place, plots=())
    return place


def write_run(place: Path, document: object) -> None:
    """Write run.json, and checksums that fit it."""
    content = document if isinstance(document, bytes) else json.dumps(document).encode()
    (place / "run.json").write_bytes(content)
    lines = (place / "B2SUMS").read_text().splitlines()
    names = [line.partition("  ")[2] for line in lines]
    sums = [hashlib.blake2b((place / name).read_bytes()).hexdigest() for name in names]
    (place / "B2SUMS").write_text("".join(f"{one}  {name}\n" for one, name in zip(sums, names, strict=True)))


def use_run(place: Path) -> None:
    run = icrtool.open_run(place)
    assert format_run(run).replace("\n", "").isprintable()
    json_bytes(run.summary)
    events_csv(run.summary["events"])
    log_of(run)
    assert np.isfinite(run.changes_s).all()
    assert run.settled_s == run.settled_s


def use_calibration(file: Path) -> None:
    found = open_calibration(file)
    assert repr(found).isprintable()
    json_bytes(found.summary())
    found.twist(1.0, 0.5)
    found.warm_start()


def test_states_whose_distance_decreases_are_refused(run_place: Path, tmp_path: Path) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    lines = (place / "states.csv").read_text().splitlines()
    cells = lines[500].split(",")
    cells[lines[0].split(",").index("distance_m")] = "0"
    lines[500] = ",".join(cells)
    (place / "states.csv").write_text("\n".join(lines) + "\n")
    write_run(place, json.loads((place / "run.json").read_text()))
    with pytest.raises(IcrToolError, match="distance of its states decreases"):
        icrtool.open_run(place)


@pytest.mark.parametrize("value", [{"model": 1e300}, {"parameters": {"b": 0}}, {"controller": {}}, {"parameters": []}])
def test_a_recommendation_of_other_types_is_refused(run_place: Path, tmp_path: Path, value: dict[str, Any]) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    document = json.loads((place / "run.json").read_text())
    write_run(place, document | {"recommended": document["recommended"] | value})
    with pytest.raises(IcrToolError, match=r"recommended"):
        icrtool.open_run(place)


def test_a_long_text_of_a_run_is_shortened(run_place: Path, tmp_path: Path) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    document = json.loads((place / "run.json").read_text())
    write_run(place, document | {"warnings": ["w" * 3000], "unusable_because": "u" * 3000, "usable": False})
    run = icrtool.open_run(place)
    assert max(map(len, run.warnings)) <= LONGEST_LINE
    assert max(map(len, format_run(run).splitlines())) <= LONGEST_LINE + 100
    write_run(place, document | {"schema": "icrtool/run/" + "9" * 3000})
    with pytest.raises(IcrToolError) as caught:
        icrtool.open_run(place)
    assert len(str(caught.value)) < LONGEST_LINE


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.stress), 11])
def test_an_edited_run_is_refused_in_one_line_or_can_be_used(run_place: Path, tmp_path: Path, every: int) -> None:
    document = json.loads((run_place / "run.json").read_text())
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    used, refusals = 0, {}
    for what, changed in edited(document, every):
        write_run(place, changed)
        try:
            use_run(place)
            used += 1
        except IcrToolError as err:
            refusals[what] = str(err)
    assert used
    assert not [what for what, text in refusals.items() if not text.isprintable() or len(text) > LONGEST_LINE]


@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"schema": ' * 50_000, b"", b"\xff\xfe", b"1" * 10_000, b"[]"])
def test_what_is_no_document_is_refused_everywhere(run_place: Path, tmp_path: Path, content: bytes) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    write_run(place, content)
    with pytest.raises(IcrToolError):
        icrtool.open_run(place)
    icrtool.open_run(run_place).write(place, plots=())  # its other files show that it was ours
    (tmp_path / "calibration.json").write_bytes(content)
    with pytest.raises(IcrToolError):
        open_calibration(tmp_path / "calibration.json")


def test_states_that_no_filter_made_are_refused(run_place: Path, tmp_path: Path) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    head, first, *others = (run_place / "states.csv").read_text().splitlines(keepends=True)
    bad = first.split(",")
    bad[2] = "nan"
    for rows in ([], [",".join(bad), *others], [*others[:5], first, *others[5:]], [first, first, *others]):
        (place / "states.csv").write_text("".join([head, *rows]))
        write_run(place, (place / "run.json").read_bytes())
        with pytest.raises(IcrToolError):
            icrtool.open_run(place)


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.stress), 7])
def test_an_edited_calibration_is_refused_in_one_line_or_can_be_used(
    run_place: Path, tmp_path: Path, every: int
) -> None:
    file = icrtool.calibrate([icrtool.open_run(run_place)]).write(tmp_path / "calibration.json")
    document = json.loads(file.read_text())
    used, refusals = 0, {}
    for what, changed in edited(document, every):
        file.write_text(json.dumps(changed))
        try:
            use_calibration(file)
            used += 1
        except IcrToolError as err:
            refusals[what] = str(err)
    assert used
    assert not [what for what, text in refusals.items() if not text.isprintable() or len(text) > LONGEST_LINE]


@pytest.mark.parametrize(
    ("section", "key", "wrong"),
    [("alignment", "wheel_scale", -1), ("alignment", "x_icr_m", None), ("gnss", "classes", 1e300)],
)
def test_a_page_of_an_edited_run_is_refused_in_one_line(
    run_place: Path, tmp_path: Path, section: str, key: str, wrong: object
) -> None:
    from icrtool.cli.commands import icrtool as command

    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    document = json.loads((place / "run.json").read_text())
    document[section][key] = wrong
    write_run(place, document)
    found = CliRunner().invoke(command, ["report", str(place), "-o", str(tmp_path / "x.html")])
    assert found.exit_code == 1
    assert f"at `$.{section}" in (found.stderr or str(found.exception))
    assert not (tmp_path / "x.html").exists()


def as_npy(file: Path, columns: dict[str, np.ndarray]) -> None:
    with file.open("wb") as stream:
        np.save(stream, columns["fixes_stamp_ns"])


def compressed(file: Path, columns: dict[str, np.ndarray]) -> None:
    np.savez_compressed(file, **{**columns, "fixes_stamp_ns": np.zeros(1_000_000, np.int64)})


def with_header(file: Path, columns: dict[str, np.ndarray], header: bytes) -> None:
    """Write the columns, one of which states another shape or type."""
    np.savez(file, **columns)
    with ZipFile(file) as stored:
        members = {name: stored.read(name) for name in stored.namelist()}
    members["fixes_stamp_ns.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with ZipFile(file, "w") as stored:
        for name, content in members.items():
            stored.writestr(name, content)


MEASUREMENTS = {
    "an array": as_npy,
    "text": lambda file, _: file.write_text("PK"),
    "compressed": compressed,
    "a shape": lambda file, columns: with_header(
        file, columns, b"{'descr': '<i8', 'fortran_order': False, 'shape': (10000000000000,)}\n"
    ),
    "nested": lambda file, columns: with_header(file, columns, b"[" * 5000 + b"\n"),
    "pickled": lambda file, columns: np.savez(file, **{**columns, "fixes_stamp_ns": np.array([{}], object)}),
    "a huge number": lambda file, columns: np.savez(
        file, **{**columns, "headings_heading_rad": columns["headings_heading_rad"] + 1e300}
    ),
    "two axes": lambda file, columns: np.savez(file, **{**columns, "fixes_north_m": np.zeros((3, 3))}),
}


@pytest.mark.parametrize("write", MEASUREMENTS.values(), ids=MEASUREMENTS)
def test_measurements_that_were_replaced_are_refused(run_place: Path, tmp_path: Path, write: Any) -> None:
    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    write(place / "measurements.npz", dict(np.load(place / "measurements.npz")))
    write_run(place, (place / "run.json").read_bytes())
    begin = time.process_time()
    with pytest.raises(IcrToolError) as err:
        icrtool.open_run(place)
    assert str(err.value).isprintable()
    assert time.process_time() - begin < LONGEST_S


@pytest.mark.parametrize("rows", [0, 5_000_000])
def test_states_of_no_row_or_far_too_many_are_refused(run_place: Path, tmp_path: Path, rows: int) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    place = Path(shutil.copytree(run_place, tmp_path / "run"))
    (place / "states.csv").unlink()
    types = {name: pa.int64() if name in INTEGER_COLUMNS else pa.float64() for name in COLUMNS_OF_STATES}
    part = pa.table({name: pa.repeat(pa.scalar(0, kind), rows // 5) for name, kind in types.items()})
    with pq.ParquetWriter(place / "states.parquet", part.schema) as writer:
        for _ in range(5 if rows else 0):
            writer.write_table(part)
    (place / "B2SUMS").write_text((place / "B2SUMS").read_text().replace("states.csv", "states.parquet"))
    write_run(place, (place / "run.json").read_bytes())
    with pytest.raises(IcrToolError, match="more than a file of its size can hold" if rows else "cannot be read"):
        icrtool.open_run(place)
