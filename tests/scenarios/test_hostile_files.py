"""Files that somebody made to do harm: each ends in one clear line, in little time and little memory."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from scenarios.telemetry import METADATA_KEY, MOST_ROWS, Telemetry
from sitl.errors import FileError
from sitl.plain_file import LARGEST_TEXT, check_plain

MEMORY = 4_000_000_000
"""Address space of the process that reads: libraries alone reserve half of it."""
SECONDS = 120
END = "-- exit status "

ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)
FEED = ("fly", "roll_step", "--gains")


def message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


def topics(*layouts: str) -> bytes:
    return b"".join(message("F", one.encode()) for one in layouts) + message("A", b"\0\0\0vehicle_attitude")


def froude(folder: Path, *commands: Sequence[str]) -> list[tuple[int, list[str]]]:
    """Status and lines on standard error of each command, in one froude with bounded memory and time.

    One process for all: its start takes longer than their refusal.
    """
    program = (
        "import json, resource, sys\n"
        f"resource.setrlimit(resource.RLIMIT_AS, ({MEMORY}, {MEMORY}))\n"
        "from scenarios.cli import main\n"
        "for command in json.loads(sys.argv[1]):\n"
        "    try: status = main(command)\n"
        "    except SystemExit as end: status = end.code\n"
        f"    sys.stderr.write(f'{END}{{status}}\\n')\n"
    )
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", program, json.dumps(commands)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": root, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    told: list[tuple[int, list[str]]] = []
    lines: list[str] = []
    for line in done.stderr.splitlines():
        if line.startswith(END):
            told.append((int(line.removeprefix(END)), lines))
            lines = []
        else:
            lines.append(line)
    assert (done.returncode, lines, len(told)) == (0, [], len(commands)), done.stderr[-2000:]
    return told


def sparse(path: Path, size: int) -> None:
    with path.open("wb") as file:
        file.truncate(size)


def link_loop(path: Path) -> None:
    path.symlink_to(path.name)


def to_zeros(path: Path) -> None:
    path.symlink_to("/dev/zero")


HARD = {
    "pipe": lambda path: os.mkfifo(path),
    "endless device": to_zeros,
    "link loop": link_loop,
    "64 GB of nothing": lambda path: sparse(path, 64_000_000_000),
    "folder": lambda path: path.mkdir(),
}


@pytest.mark.parametrize(
    ("words", "suffix"),
    [
        (FEED, ".toml"),
        (FEED, ".params"),
        (("fly",), ".toml"),
        (("model",), ".toml"),
        (("review",), ".ulg"),
        (("review",), ".tlog"),
    ],
    ids=["gains", "ground station's gains", "scenario", "airframe", "ULog", "tlog"],
)
def test_what_is_no_plain_file_is_refused_before_it_is_read(
    tmp_path: Path, words: tuple[str, ...], suffix: str
) -> None:
    """All of them in one process: its start takes longer than their refusal."""
    names = []
    for number, (what, make) in enumerate(HARD.items()):
        make(tmp_path / f"{number}{suffix}")
        names.append((f"{number}{suffix}", what))
    program = "import sys; from scenarios.cli import main\nfor name in sys.argv[1:]: "
    program += f"print(main([*{words!r}, name, '--out', '.'] if {words!r} != ('model',) else ['model', name]))"
    done = subprocess.run(
        [sys.executable, "-c", program, *(name for name, _ in names)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    lines = done.stderr.splitlines()
    assert [len(lines), *done.stdout.split()] == [len(names), *["2"] * len(names)], done.stderr + done.stdout
    for line, (name, what) in zip(lines, names, strict=True):
        assert name in line, (what, line)


LOGS = {
    "array": ULOG + topics("vehicle_attitude:uint64_t timestamp;float[2000000000] q;"),
    "arrays": ULOG
    + topics("vehicle_attitude:uint64_t timestamp;float[65535] q;float[65535] r;float[65535] s;float[65535] t;"),
    "nested": ULOG
    + topics(
        "a0:uint8_t[1000] x;",
        *(f"a{n}:a{n - 1}[1000] x;" for n in range(1, 6)),
        "vehicle_attitude:uint64_t timestamp;a5 x;",
    ),
    "nested nothing": ULOG
    + topics("a0:;", *(f"a{n}:a{n - 1}[60000] x;" for n in range(1, 6)), "vehicle_attitude:uint64_t timestamp;a5 x;"),
    "own loop": ULOG + topics("vehicle_attitude:uint64_t timestamp;vehicle_attitude x;"),
    "unknown": ULOG + topics("vehicle_attitude:uint64_t timestamp;nothing x;"),
    "appended": ULOG + message("B", bytes(8) + b"\1" + bytes(7) + struct.pack("<QQQ", 1 << 40, 5, 1 << 63)),
    "cut": ULOG + struct.pack("<HB", 65535, ord("F")) + b"x" * 100,
    "info": ULOG + message("I", b"\xffchar[99999999] x"),
    "zeros": ULOG + bytes(200_000),
}


def test_logs_that_claim_more_than_there_is(tmp_path: Path) -> None:
    for number, log in enumerate(LOGS.values()):
        (tmp_path / f"{number}.ulg").write_bytes(log)
    told = froude(tmp_path, *(("review", f"{number}.ulg") for number in range(len(LOGS))))
    for number, (name, (status, lines)) in enumerate(zip(LOGS, told, strict=True)):
        assert (status, len(lines)) == (2, 1), (name, lines)
        assert f"{number}.ulg: " in lines[0], name


def deep(start: str, end: str, count: int = 100_000) -> str:
    return start * count + end * count


GAINS = {
    "arrays": "x = " + deep("[", "]"),
    "tables": "x = " + deep("{a=", "}"),
    "dots": ".".join(["a"] * 20_000) + " = 1",
    "digits": "x = " + "9" * 100_000,
    "huge": "[[gain_set]]\nname = 'a'\n[gain_set.parameters]\nMC_ROLL_P = " + "9" * 4_000,
    "nan": "[[gain_set]]\nname = 'a'\n[gain_set.parameters]\nMC_ROLL_P = nan",
    "inf": "[[gain_set]]\nname = 'a'\n[gain_set.parameters]\nMC_ROLL_P = -inf",
    "long": "[[gain_set]]\nname = '" + "a" * 100_000 + "'\n[gain_set.parameters]\nMC_ROLL_P = 1e400",
    "many": "[[gain_set]]\n" * 50_000,
}


def test_gains_that_no_reader_should_choke_on(tmp_path: Path) -> None:
    for number, text in enumerate(GAINS.values()):
        (tmp_path / f"gains{number}.toml").write_text(text)
    told = froude(tmp_path, *((*FEED, f"gains{number}.toml") for number in range(len(GAINS))))
    for number, (name, (status, lines)) in enumerate(zip(GAINS, told, strict=True)):
        assert (status, len(lines)) == (2, 1), (name, [line[:300] for line in lines])
        assert f"gains{number}.toml" in lines[0], name


VALUES = ("nan", "1e999", "0x1", "1_000", "9" * 5_000, "१२")


def test_parameters_of_a_ground_stations_file(tmp_path: Path) -> None:
    for number, value in enumerate(VALUES):
        (tmp_path / f"{number}.params").write_text(f"1\t1\tMC_ROLL_P\t{value}\t9\n")
    told = froude(tmp_path, *((*FEED, f"{number}.params") for number in range(len(VALUES))))
    for value, (status, lines) in zip(VALUES, told, strict=True):
        assert (status, len(lines)) == (2, 1), (value[:20], [line[:300] for line in lines])


RUNS: dict[str, str] = {
    "deep": deep("[", "]"),
    "deep objects": deep('{"a":', "}", 50_000),
    "digits": '{"schema_version": ' + "9" * 100_000 + "}",
    "infinite": '{"schema_version": 2, "seed": 1e999, "flights": [{"rows": -1e999, "metrics": [{"value": NaN}]}]}',
    "wrong kinds": '{"schema_version": 2, "flights": {"a": 1}, "scenario": [], "vehicle": 7, "twins": "x"}',
    "way out": '{"schema_version": 2, "flights": [{"gain_set": {"name": "../../x"}, "files": {"rrd": "../../../x"}}]}',
}


def test_runs_that_no_froude_wrote(tmp_path: Path) -> None:
    commands = []
    for number, text in enumerate(RUNS.values()):
        folder = tmp_path / str(number) / "20261122T200000Z_demo_ANT-X"
        (folder / "flights").mkdir(parents=True)
        (folder / "run.json").write_text(text)
        for words in (("--list",), (str(folder), "--json"), (str(folder), "--html")):
            commands.append(("review", *words, "--out", str(folder.parent)))
    for command, (status, lines) in zip(commands, froude(tmp_path, *commands), strict=True):
        assert status in (0, 2), (command, lines)
        assert not any("Traceback" in line for line in lines), (command, lines)
    for number in range(len(RUNS)):
        assert [one.name for one in (tmp_path / str(number)).iterdir()] == ["20261122T200000Z_demo_ANT-X"]


def stored(path: Path, **columns: pa.Array) -> Path:
    table = pa.table(columns)
    pq.write_table(table.replace_schema_metadata({METADATA_KEY: json.dumps({}).encode()}), path, compression="zstd")
    return path


BOMBS: dict[str, Callable[[], dict[str, pa.Array]]] = {
    f"says that it has {MOST_ROWS + 1} rows": lambda: {"t_s": pa.nulls(MOST_ROWS + 1, pa.float64())},
    "its column 't_s' has the type": lambda: {
        "t_s": pa.DictionaryArray.from_arrays(pa.array([0] * 1000), ["x" * 10**6])
    },
    "has the column 'more'": lambda: {
        "t_s": pa.array([1.0]),
        "more": pa.array([["x" * 10**6] * 100]),
    },
}


@pytest.mark.parametrize("problem", BOMBS)
def test_telemetry_that_swells_when_it_is_read(tmp_path: Path, problem: str) -> None:
    path = stored(tmp_path / "a.parquet", **BOMBS[problem]())
    assert path.stat().st_size < 1_000_000
    with pytest.raises(FileError, match=problem) as error:
        Telemetry.from_parquet(path)
    assert "\n" not in str(error.value)


def test_a_plain_file_is_let_through(tmp_path: Path) -> None:
    (tmp_path / "a.toml").touch()
    (tmp_path / "link").symlink_to("a.toml")
    check_plain(tmp_path / "link")
    check_plain(tmp_path / "missing")
    sparse(tmp_path / "large", LARGEST_TEXT + 1)
    with pytest.raises(FileError, match=f"has {LARGEST_TEXT + 1} bytes, and at most {LARGEST_TEXT} are read"):
        check_plain(tmp_path / "large")
