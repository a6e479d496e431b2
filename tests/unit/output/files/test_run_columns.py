from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from icrtool.output.files.run_columns import FORMATTED_ROWS, StatesFormat, read_states, write_states
from icrtool.records.run import Run
from icrtool.records.tables import States

AWKWARD = [
    0.0, -0.0, 1.0, -3.0, 0.1 + 0.2, 1e-7, 5e-324, 1e-320, 1e15, 1e16, 1e22, 123456789012345680.0,
    1.7976931348623157e308, 2.2250738585072014e-308, 9007199254740993.0, 1 / 3, np.pi, -1e-5,
]  # fmt: skip


def table_of(values: np.ndarray) -> States:
    stamps = np.arange(len(values), dtype=np.int64) + 9_223_372_036_854_000_000
    return States(stamps, *(np.roll(values, shift) for shift in range(len(fields(States)) - 1)))


def assert_same_bits(one: States, other: States) -> None:
    for name, values in one.columns().items():
        found = getattr(other, name)
        assert found.dtype == values.dtype, name
        assert found.tobytes() == values.tobytes(), name


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_every_bit_comes_back(tmp_path: Path, run: Run, form: StatesFormat) -> None:
    for number, table in enumerate((run.table, table_of(np.array(AWKWARD)))):
        write_states(table, tmp_path / str(number), form)
        assert_same_bits(table, read_states(tmp_path / str(number), form))


def test_pandas_reads_the_csv_as_the_frame_of_the_run(tmp_path: Path, run: Run) -> None:
    write_states(run.table, tmp_path / "states.csv", "csv")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "states.csv"), run.states, check_exact=True)


def test_columns_of_whole_numbers_stay_floating_point(tmp_path: Path, run: Run) -> None:
    table = replace(run.table, x_icr_m=np.zeros(len(run.table)), v_left_mps=np.full(len(run.table), -2.0))
    write_states(table, tmp_path / "states.csv", "csv")
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "states.csv"), table.frame(), check_exact=True)


def test_numbers_have_their_shortest_form_and_no_quotes(tmp_path: Path) -> None:
    write_states(table_of(np.array([0.1, 0.30000000000000004, 2.5])), tmp_path / "states.csv", "csv")
    header, first = (tmp_path / "states.csv").read_text().splitlines()[:2]
    assert header.startswith("stamp_ns,t_s,north_m,east_m,heading_rad,y_icr_right_m,y_icr_left_m,x_icr_m,std_north_m,")
    assert header.endswith("std_x_icr_m,v_left_mps,v_right_mps,distance_m")
    assert first.startswith("9223372036854000000,0.1,2.5,0.30000000000000004,0.1,")


def test_numbers_that_are_none_keep_their_kind(tmp_path: Path) -> None:
    values = np.array([0.1, np.nan, np.inf, -np.inf, 1e-7])
    write_states(table_of(values), tmp_path / "states.csv", "csv")
    found = read_states(tmp_path / "states.csv", "csv")
    for name, column in table_of(values).columns().items():
        np.testing.assert_array_equal(getattr(found, name), column)


def test_rows_keep_their_order_over_many_chunks(tmp_path: Path) -> None:
    values = np.random.default_rng(1).standard_normal(3 * FORMATTED_ROWS + 17)
    write_states(table_of(values), tmp_path / "states.csv", "csv")
    assert_same_bits(table_of(values), read_states(tmp_path / "states.csv", "csv"))


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "", "stamp_ns\nx\n"])
def test_other_columns_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "states.csv").write_text(text)
    with pytest.raises(ValueError, match=r"CSV|[Cc]olumn"):
        read_states(tmp_path / "states.csv", "csv")


@pytest.mark.parametrize("whole", [True, False])
def test_a_column_of_parquet_that_comes_twice_is_refused(tmp_path: Path, *, whole: bool) -> None:
    path = tmp_path / "states.parquet"
    write_states(table_of(np.arange(5.0)), path, "parquet")
    stored = pq.read_table(path)
    pq.write_table(stored.append_column("distance_m", stored["distance_m"]), path)
    with pytest.raises(ValueError, match="columns are not"):
        read_states(path, "parquet", whole=whole)


def test_an_existing_file_is_not_overwritten(tmp_path: Path, run: Run) -> None:
    (tmp_path / "states.csv").write_text("mine")
    with pytest.raises(FileExistsError):
        write_states(run.table, tmp_path / "states.csv", "csv")
