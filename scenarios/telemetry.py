"""What one flight looked like: columns of equal length, one row per ATTITUDE message of the vehicle.

The set-point columns hold what the vehicle reports in ATTITUDE_TARGET, not what was sent: that is what is
scored.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sitl.errors import FileError, UsageError
from sitl.keyed_table import nearest
from sitl.plain_file import check_plain

Array = npt.NDArray[Any]
METADATA_KEY = b"froude"
MOST_ROWS = 4_000_000
"""Of a file that is read: more than four hours at 250 rows a second."""
LARGEST_PARQUET = 2_000_000_000
NO_SEGMENT = -1


@dataclass(frozen=True)
class Column:
    """One column of the telemetry.

    Attributes:
        name: with the unit as suffix.
        dtype: little-endian numpy type, the same in memory, in the hash and in Parquet.
        unit: empty for flags and indices.
        meaning: one line; frames are PX4's (body forward-right-down, local north-east-down).
        missing: value of a row, or of the whole column, that the vehicle never reported.
    """

    name: str
    dtype: str
    unit: str
    meaning: str
    missing: float | int | bool = float("nan")


def _float(name: str, unit: str, meaning: str) -> Column:
    return Column(name, "<f4", unit, meaning)


_ALL = (
    Column("t_s", "<f8", "s", "vehicle time since boot, strictly increasing (ATTITUDE.time_boot_ms)"),
    _float("phi_rad", "rad", "roll angle as the vehicle estimates it (ATTITUDE)"),
    _float("theta_rad", "rad", "pitch angle (ATTITUDE)"),
    _float("psi_rad", "rad", "heading, -pi to pi (ATTITUDE)"),
    _float("p_rad_s", "rad/s", "roll rate, body: a simulator's truth (HIL_STATE_QUATERNION), else ATTITUDE"),
    _float("q_rad_s", "rad/s", "pitch rate, body: a simulator's truth (HIL_STATE_QUATERNION), else ATTITUDE"),
    _float("r_rad_s", "rad/s", "yaw rate, body: a simulator's truth (HIL_STATE_QUATERNION), else ATTITUDE"),
    _float("phi_sp_rad", "rad", "roll set-point in force (last ATTITUDE_TARGET)"),
    _float("theta_sp_rad", "rad", "pitch set-point in force (last ATTITUDE_TARGET)"),
    _float("psi_sp_rad", "rad", "heading set-point in force (last ATTITUDE_TARGET)"),
    _float("p_sp_rad_s", "rad/s", "roll rate set-point (last ATTITUDE_TARGET)"),
    _float("q_sp_rad_s", "rad/s", "pitch rate set-point (last ATTITUDE_TARGET)"),
    _float("r_sp_rad_s", "rad/s", "yaw rate set-point (last ATTITUDE_TARGET)"),
    _float("thrust_sp", "1", "collective thrust set-point, 0 to 1 (last ATTITUDE_TARGET)"),
    _float("north_m", "m", "position north of the boot place (last LOCAL_POSITION_NED)"),
    _float("east_m", "m", "position east of the boot place (last LOCAL_POSITION_NED)"),
    _float("down_m", "m", "position below the boot place (last LOCAL_POSITION_NED)"),
    _float("v_north_m_s", "m/s", "velocity north (last LOCAL_POSITION_NED)"),
    _float("v_east_m_s", "m/s", "velocity east (last LOCAL_POSITION_NED)"),
    _float("v_down_m_s", "m/s", "velocity down (last LOCAL_POSITION_NED)"),
    *(
        _float(
            f"motor{n}",
            "1",
            f"command of PX4's motor {n}, 0 to 1; NaN: not reported (HIL_ACTUATOR_CONTROLS)",
        )
        for n in range(1, 9)
    ),
    _float("delta_lat", "1", "normalised roll torque that the motor commands produce (pseudo-inverse of the mix)"),
    _float("delta_lon", "1", "normalised pitch torque that the motor commands produce"),
    _float("phi_true_rad", "rad", "true roll angle, where the simulator tells it (HIL_STATE_QUATERNION)"),
    _float("theta_true_rad", "rad", "true pitch angle, where the simulator tells it"),
    _float("psi_true_rad", "rad", "true heading, where the simulator tells it"),
    Column("nav_state", "<i2", "", "PX4 navigation state (4 Hold, 14 Offboard, 17 Takeoff, 18 Land)", -1),
    Column("armed", "|b1", "", "armed, from HEARTBEAT", False),
    Column("segment", "<i2", "", "index into the flight's list of segments, -1 between them", NO_SEGMENT),
)
COLUMNS: Mapping[str, Column] = {column.name: column for column in _ALL}


@dataclass(frozen=True, eq=False)
class Telemetry:
    """Columns of one flight, all there, of one length, in schema order; build it with `from_columns`."""

    columns: Mapping[str, Array]

    @classmethod
    def from_columns(cls, columns: Mapping[str, npt.ArrayLike]) -> Telemetry:
        """Cast to the schema; a column that is not given is filled with its `missing` value.

        Raises:
            UsageError: no `t_s`, a name that is not in the schema, unequal lengths, or time that does not
            increase.
        """
        for name in columns:
            if name not in COLUMNS:
                raise UsageError(f"telemetry has no column {name!r}{nearest(name, COLUMNS)}")
        if "t_s" not in columns:
            raise UsageError("telemetry needs the column 't_s'")
        rows = len(np.atleast_1d(np.asarray(columns["t_s"])))
        cast: dict[str, Array] = {}
        for name, column in COLUMNS.items():
            if name in columns:
                values = np.ascontiguousarray(np.atleast_1d(np.asarray(columns[name])), dtype=column.dtype)
            else:
                values = np.full(rows, column.missing, dtype=column.dtype)
            if values.shape != (rows,):
                raise UsageError(f"telemetry column {name!r} has shape {values.shape}, 't_s' has {rows} rows")
            values.setflags(write=False)
            cast[name] = values
        if rows and not np.all(np.diff(cast["t_s"]) > 0):
            raise UsageError("telemetry column 't_s' must strictly increase")
        return cls(cast)

    @classmethod
    def empty(cls) -> Telemetry:
        """No rows: a flight that never left the ground."""
        return cls.from_columns({"t_s": []})

    def __len__(self) -> int:
        return len(self.columns["t_s"])

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def select(self, rows: Array | slice) -> Telemetry:
        """The rows of a boolean mask or slice."""
        return Telemetry({name: values[rows] for name, values in self.columns.items()})

    def between(self, start_s: float, end_s: float) -> Telemetry:
        """Rows with start_s <= t_s <= end_s."""
        first, last = np.searchsorted(self["t_s"], [start_s - 1e-9, end_s + 1e-9])
        return self.select(slice(int(first), int(last)))

    def sha256(self, names: Collection[str] = COLUMNS) -> str:
        """Fingerprint of the flight: SHA-256 of every column's little-endian bytes, in schema order.

        Args:
            names: columns that count; fewer for what an older program wrote.

        Nothing else enters (no file bytes, date or version), so anyone can recompute it from the Parquet
        file. NaNs are counted as the one quiet NaN, because their payload bits differ between processors.
        """
        digest = hashlib.sha256()
        for name, column in COLUMNS.items():
            if name not in names:
                continue
            values = self.columns[name]
            if column.dtype.startswith("<f") and np.isnan(values).any():
                values = np.where(np.isnan(values), np.array(np.nan, dtype=column.dtype), values)
            digest.update(np.ascontiguousarray(values, dtype=column.dtype).tobytes())
        return digest.hexdigest()

    def to_parquet(self, path: str | Path, metadata: Mapping[str, object] | None = None) -> None:
        """Write one row group, zstd; unit and meaning of a column are in its field metadata.

        Args:
            path: written under a temporary name beside it, then moved.
            metadata: stored as JSON under the key `froude` of the schema; the telemetry's hash is added.

        Raises:
            FileError: the disk is full or the folder cannot be written.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        path = Path(path)
        fields = [
            pa.field(
                column.name,
                pa.from_numpy_dtype(np.dtype(column.dtype)),
                metadata={"unit": column.unit, "meaning": column.meaning},
            )
            for column in _ALL
        ]
        about = dict(metadata or {}) | {"telemetry_sha256": self.sha256()}
        schema = pa.schema(fields, metadata={METADATA_KEY: json.dumps(about, sort_keys=True).encode()})
        table = pa.table([self.columns[name] for name in COLUMNS], schema=schema)
        part = path.with_name(path.name + ".part")
        try:
            # no two measured numbers are equal: a dictionary of them takes three times as long, and more room
            repeated = [column.name for column in _ALL if not column.dtype.startswith("<f")]
            pq.write_table(table, part, compression="zstd", use_dictionary=repeated)
            part.replace(path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise FileError(path, f"cannot be written: {error}", "Free some space or choose another --out") from error

    @classmethod
    def from_parquet(cls, path: str | Path) -> tuple[Telemetry, dict[str, Any]]:
        """Telemetry and metadata written by `to_parquet`; columns that an older program did not write are missing.

        Raises:
            FileError: no such file, not Parquet, not telemetry of this program, or of a newer one.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        remedy = "Give a flights/*.parquet of a run"
        check_plain(Path(path), LARGEST_PARQUET)
        try:
            # a few bytes can stand for any number of rows, and a row of texts for any number of bytes
            rows, schema = pq.read_metadata(path).num_rows, pq.read_schema(path)
            if rows > MOST_ROWS:
                raise FileError(path, f"says that it has {rows} rows; at most {MOST_ROWS} are read", remedy)
            odd = next((field for field in schema if not pa.types.is_primitive(field.type)), None)
            if odd is not None and odd.name in COLUMNS:
                raise FileError(path, f"is damaged: its column {odd.name!r} has the type {odd.type}", remedy)
            # with columns of others it is refused below, unread
            table = schema.empty_table() if set(schema.names) - set(COLUMNS) else pq.read_table(path)
        except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
            # Arrow's text may go on for lines, with its own source in it
            problem = str(error).partition("\n")[0]
            raise FileError(path, f"cannot be read as Parquet: {problem}", remedy) from error
        raw = (table.schema.metadata or {}).get(METADATA_KEY)
        if raw is None or "t_s" not in table.column_names:
            raise FileError(path, "is not telemetry of froude", remedy)
        unknown = [name for name in table.column_names if name not in COLUMNS]
        if unknown:
            problem = f"has the column {unknown[0]!r}, which this froude does not know: a newer one wrote it"
            raise FileError(path, problem, "Use the version of froude that wrote it, or a newer one")
        try:
            about = json.loads(raw)
            columns = {name: table[name].to_numpy() for name in table.column_names}
            telemetry = cls.from_columns(columns)
        except (ValueError, TypeError, pa.ArrowException, UsageError) as error:
            raise FileError(path, f"is damaged: {error}", remedy) from error
        return telemetry, dict(about)


def column_names(path: str | Path) -> tuple[str, ...]:
    """Columns that a Parquet file has.

    Raises:
        FileError: it cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return tuple(pq.read_schema(path).names)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise FileError(path, f"cannot be read as Parquet: {error}", "Give a flights/*.parquet of a run") from error
