"""The dataset of a sweep: a folder of Parquet files, one a chunk, and what they were made of.

    <sweep folder>/
        sweep.json          plan, fingerprint, versions, the sweep file's text, the command
        points/chunk-00000000.parquet ...

A file is written under a temporary name, brought to the disk and moved, so one that is there is whole; the same chunk
is the same bytes whoever worked it out. One program writes at a time: it holds a lock that the system takes back when
it dies.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenarios.sweep.axes import VEHICLE
from scenarios.sweep.evaluation import STATISTICS, Columns, Task, limits_of, measured_names
from scenarios.sweep.plan import SCHEMA_VERSION, Plan
from sitl.errors import FileError, UsageError
from sitl.plain_file import check_plain

if TYPE_CHECKING:
    import pyarrow as pa

SWEEP_JSON = "sweep.json"
LARGEST_JSON = 256_000_000
LARGEST_CHUNK = 64_000_000
"""Bytes of a file of the dataset; one that is larger is none of ours."""
POINTS = "points"


def schema_of(plan: Plan) -> pa.Schema:
    """Columns of the dataset.

    Args:
        plan: of the sweep.
    """
    import pyarrow as pa

    columns = [("point", pa.int64()), ("candidate", pa.int64()), ("case", pa.int32())]
    columns += [(axis.name, pa.int64() if axis.integer else pa.float64()) for axis in plan.sweep.parameters]
    columns += [(name, _type_of(plan, name)) for name in _conditions(plan)]
    columns += [("outcome", pa.string()), ("reason", pa.string()), ("nominal_passes", pa.bool_())]
    columns += [(name, pa.float64()) for name in ("pass_pct", "pass_low_pct", "pass_high_pct")]
    columns += [(name, pa.int32()) for name in ("passes", "samples", "unstable", "cycling", "diverged")]
    columns += [(f"failing_{limit.metric}", pa.int32()) for limit in limits_of(plan)]
    for name in measured_names(plan):
        columns += [(f"{name}_{statistic}", pa.float64()) for statistic in STATISTICS]
        columns.append((f"{name}_unset", pa.int32()))
    return pa.schema(columns, metadata={"froude_sweep_schema": str(SCHEMA_VERSION), "froude_plan": plan.fingerprint})


def _conditions(plan: Plan) -> list[str]:
    return list(dict.fromkeys([VEHICLE, *plan.cases[0].conditions]))


def _type_of(plan: Plan, name: str) -> pa.DataType:
    import pyarrow as pa

    values = [case.conditions.get(name, "") for case in plan.cases]
    if all(isinstance(value, bool) for value in values):
        return pa.bool_()
    return pa.string() if any(isinstance(value, str) for value in values) else pa.float64()


def table_of(plan: Plan, task: Task, columns: Columns) -> pa.Table:
    """The rows of a chunk with the columns of their axes; UNSET is null.

    Args:
        plan: of the sweep. task: the chunk. columns: of `Evaluator.rows`.
    """
    import pyarrow as pa

    chunk, case = task.chunk, plan.cases[task.chunk.case]
    count = chunk.stop - chunk.start
    candidate = np.arange(chunk.start, chunk.stop)
    known: dict[str, Any] = {
        "point": candidate * len(plan.cases) + chunk.case,
        "candidate": candidate,
        "case": np.full(count, chunk.case),
        VEHICLE: [case.model.spec] * count,
        **{axis.name: task.values[:, k] for k, axis in enumerate(plan.sweep.parameters)},
        **{name: [value] * count for name, value in case.conditions.items()},
        **columns,
    }
    schema = schema_of(plan)
    arrays = []
    for field in schema:
        value = known[field.name]
        if pa.types.is_integer(field.type):
            value = np.asarray(value).astype(np.int64)
        elif pa.types.is_floating(field.type):
            value = np.asarray(value, dtype=np.float64)
        missing = np.isnan(value) if pa.types.is_floating(field.type) else None
        arrays.append(pa.array(value, type=field.type, mask=missing))
    return pa.Table.from_arrays(arrays, schema=schema)


class Dataset:
    """The folder of a sweep.

    Args:
        path: of the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def points(self) -> Path:
        """Where the files of the chunks are."""
        return self.path / POINTS

    def file(self, chunk: int) -> Path:
        """The file of a chunk, by number."""
        return self.points / f"chunk-{chunk:08d}.parquet"

    def create(self, plan: Plan, facts: dict[str, Any]) -> None:
        """Make the folder and `sweep.json`.

        Args:
            plan: of the sweep. facts: to keep beside it: versions, command, time.

        Raises:
            FileError: it cannot be made.
        """
        try:
            self.points.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._leave()
            raise FileError(
                self.path, f"cannot be made: {error.strerror}", "Choose another folder with --out"
            ) from error
        known = {
            "schema_version": SCHEMA_VERSION,
            "fingerprint": plan.fingerprint,
            "title": plan.sweep.title,
            "file": str(plan.sweep.path.resolve()),
            "text": plan.sweep.text,
            "points": plan.points,
            "candidates": plan.candidates,
            "cases": [case.name for case in plan.cases],
            **facts,
            "plan": plan.description(),
        }
        try:
            self._write(self.path / SWEEP_JSON, json.dumps(known, indent=2, default=str).encode() + b"\n")
        except FileError as error:
            self._leave()
            raise FileError(error.path, error.problem, "Free some space, or choose another folder with --out") from None

    def _leave(self) -> None:
        """Nothing has begun: no folder either, unless somebody else has put something in it."""
        with contextlib.suppress(OSError):
            self.points.rmdir()
        with contextlib.suppress(OSError):
            self.path.rmdir()

    def facts(self) -> dict[str, Any]:
        """What `sweep.json` says.

        Raises:
            FileError: there is none, it is damaged, or of another schema.
        """
        path = self.path / SWEEP_JSON
        check_plain(path, LARGEST_JSON)
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise FileError(self.path, f"is no sweep: it has no {SWEEP_JSON}", "Name the folder of a sweep") from None
        except OSError as error:
            raise FileError(path, f"cannot be read: {error.strerror}") from error
        except (ValueError, RecursionError) as error:
            raise FileError(path, f"is damaged: {error}", "Start the sweep anew") from error
        version = found.get("schema_version") if isinstance(found, dict) else None
        if version != SCHEMA_VERSION:
            raise FileError(
                path,
                f"schema_version = {version!r}, this program writes {SCHEMA_VERSION}",
                "Read it with the version of froude that made it, or start the sweep anew",
            )
        for key in ("fingerprint", "file", "plan", "points"):
            if key not in found:
                raise FileError(path, f"is damaged: {key} is missing", "Start the sweep anew")
        return dict(found)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Nobody else writes while this lasts.

        Raises:
            UsageError: somebody does.
        """
        try:
            handle = os.open(self.path / ".lock", os.O_CREAT | os.O_RDWR, 0o644)
        except OSError as error:
            raise FileError(self.path, f"cannot be written: {error.strerror}", "Check permissions and space") from error
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise UsageError(f"{self.path}: another froude sweep is writing here. Let it end, or stop it") from None
            for left in self.points.glob("*.part"):
                left.unlink(missing_ok=True)
            yield
        finally:
            os.close(handle)

    def write(self, plan: Plan, task: Task, columns: Columns) -> None:
        """Add the rows of a chunk.

        Args:
            plan: of the sweep. task: the chunk. columns: its rows.

        Raises:
            FileError: it cannot be written; nothing of it is left.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        sink = pa.BufferOutputStream()
        pq.write_table(table_of(plan, task, columns), sink, compression="zstd")
        self._write(self.file(task.chunk.number), sink.getvalue())

    def _write(self, path: Path, data: Any) -> None:
        part = path.with_name(path.name + ".part")
        try:
            with part.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            remedy = "Free some space, then go on with --resume"
            raise FileError(path, f"cannot be written: {error.strerror}", remedy) from error

    def done(self, plan: Plan) -> set[int]:
        """Numbers of the chunks that are there and whole.

        Args:
            plan: of the sweep; a file of another plan is not counted and will be written anew.
        """
        import pyarrow.parquet as pq

        whole = set()
        for path in self.points.glob("chunk-*.parquet"):
            number = path.stem.removeprefix("chunk-")
            if not number.isdigit() or int(number) >= plan.chunks:
                continue
            try:
                check_plain(path, LARGEST_CHUNK)
                meta = pq.read_metadata(path)
            except (OSError, ValueError, FileError):
                continue
            chunk = plan.chunk(int(number))
            named = (meta.metadata or {}).get(b"froude_plan", b"").decode()
            if named == plan.fingerprint and meta.num_rows == chunk.stop - chunk.start:
                whole.add(chunk.number)
        return whole

    def read(self, columns: Sequence[str] | None = None, chunks: Sequence[int] | None = None) -> pa.Table:
        """Rows of the dataset, in the order of the chunks.

        Args:
            columns: to read; all without. chunks: numbers; all that are there without.

        Raises:
            FileError: a file is damaged.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        paths = sorted(self.points.glob("chunk-*.parquet")) if chunks is None else [self.file(n) for n in chunks]
        tables = []
        for path in paths:
            check_plain(path, LARGEST_CHUNK)
            try:
                tables.append(pq.read_table(path, columns=None if columns is None else list(columns)))
            except (OSError, ValueError) as error:
                raise FileError(path, f"cannot be read: {error}", "Remove it and go on with --resume") from error
        if not tables:
            raise FileError(self.points, "holds no rows yet", "Let the sweep run first")
        return pa.concat_tables(tables)
