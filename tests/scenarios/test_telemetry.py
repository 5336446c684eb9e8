"""Telemetry: schema, hash and Parquet."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenarios.telemetry import COLUMNS, Telemetry
from sitl.errors import FileError, UsageError


def sample(rows: int = 50) -> Telemetry:
    rng = np.random.default_rng(5)
    columns: dict[str, Any] = {
        name: rng.standard_normal(rows) for name, column in COLUMNS.items() if column.dtype == "<f4"
    }
    columns["motor5"] = np.full(rows, np.nan)
    columns["t_s"] = 3.0 + 0.004 * np.arange(rows)
    columns["nav_state"] = [4] * rows
    columns["armed"] = [True] * rows
    columns["segment"] = [-1] * (rows // 2) + [0] * (rows - rows // 2)
    return Telemetry.from_columns(columns)


def test_every_column_has_the_schemas_type_and_length() -> None:
    telemetry = sample()
    assert list(telemetry.columns) == list(COLUMNS)
    for name, column in COLUMNS.items():
        assert telemetry[name].dtype == np.dtype(column.dtype)
        assert len(telemetry[name]) == len(telemetry) == 50
        suffix = {"rad": "_rad", "rad/s": "_rad_s", "m": "_m", "m/s": "_m_s", "s": "_s"}.get(column.unit, "")
        assert name.endswith(suffix)
        assert column.meaning


def test_columns_not_given_hold_what_missing_means() -> None:
    telemetry = Telemetry.from_columns({"t_s": [0.0, 1.0]})
    assert np.isnan(telemetry["phi_rad"]).all()
    assert not telemetry["armed"].any()
    assert (telemetry["segment"] == -1).all()
    assert len(Telemetry.empty()) == 0


def test_between_takes_both_ends() -> None:
    telemetry = Telemetry.from_columns({"t_s": [0.0, 0.1, 0.2, 0.3], "phi_rad": [0, 1, 2, 3]})
    assert list(telemetry.between(0.1, 0.2)["phi_rad"]) == [1, 2]
    assert len(telemetry.between(5, 6)) == 0


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"t_s": [0.0], "phi_deg": [1.0]}, "no column 'phi_deg' (did you mean"),
        ({"phi_rad": [0.0]}, "needs the column 't_s'"),
        ({"t_s": [0.0, 1.0], "phi_rad": [0.0]}, "has shape (1,), 't_s' has 2 rows"),
        ({"t_s": [0.0, 0.0]}, "must strictly increase"),
        ({"t_s": [0.0, np.nan]}, "must strictly increase"),
    ],
)
def test_bad_columns_are_refused(columns: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError) as error:
        Telemetry.from_columns(columns)
    assert text in str(error.value)


def test_hash_is_the_columns_bytes_in_schema_order() -> None:
    telemetry = sample()
    digest = hashlib.sha256()
    for name in COLUMNS:
        digest.update(telemetry[name].tobytes())
    assert telemetry.sha256() == digest.hexdigest()
    assert sample().sha256() == telemetry.sha256()


@given(st.sampled_from(sorted(COLUMNS)), st.integers(0, 49))
def test_hash_sees_every_value(name: str, row: int) -> None:
    telemetry = sample()
    columns = dict(telemetry.columns)
    values = columns[name].copy()
    values[row] = not values[row] if name == "armed" else values[row] + (1e-6 if name == "t_s" else 1)
    if name == "motor5":
        values[row] = 0.5
    columns[name] = values
    assert Telemetry.from_columns(columns).sha256() != telemetry.sha256()


def test_hash_does_not_depend_on_nan_payload_or_memory_layout() -> None:
    odd = np.frombuffer(np.array([0x7FC12345, 0xFFC00000], dtype="<u4").tobytes(), dtype="<f4")
    plain = Telemetry.from_columns({"t_s": [0.0, 1.0]})
    columns = {"t_s": np.array([0.0, 9.0, 1.0])[::2], "phi_rad": odd}
    assert Telemetry.from_columns(columns).sha256() == plain.sha256()


def test_parquet_round_trip_keeps_bytes_units_and_metadata(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    telemetry = sample()
    path = tmp_path / "flight.parquet"
    telemetry.to_parquet(path, {"vehicle": "ant-x", "seed": 3})
    back, about = Telemetry.from_parquet(path)
    assert back.sha256() == telemetry.sha256() == about["telemetry_sha256"]
    assert about["vehicle"] == "ant-x"
    schema = pq.read_schema(path)
    assert schema.field("p_rad_s").metadata[b"unit"] == b"rad/s"
    assert [f.name for f in tmp_path.iterdir()] == ["flight.parquet"]
    Telemetry.empty().to_parquet(path)
    assert len(Telemetry.from_parquet(path)[0]) == 0


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.parquet").write_text("not parquet")
    for name in ("absent.parquet", "text.parquet"):
        with pytest.raises(FileError, match=name):
            Telemetry.from_parquet(tmp_path / name)
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"t_s": [1.0]}), tmp_path / "other.parquet")
    with pytest.raises(FileError, match="is not telemetry of froude"):
        Telemetry.from_parquet(tmp_path / "other.parquet")
    with pytest.raises(FileError, match="cannot be written"):
        sample().to_parquet(tmp_path / "no such folder" / "x.parquet")
