"""The README and the code say the same: commands, files, scripts, tables and measured figures."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import re
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenarios import cli
from scenarios.fault_kinds import KINDS as FAULT_KINDS
from scenarios.faults import parse_faults
from scenarios.flight import FlightRecord
from scenarios.limits import LIMIT_CYCLE_RAD_S, METRICS
from scenarios.manoeuvres import KINDS, make_manoeuvre
from scenarios.run_comparison import NEITHER, SENSES
from scenarios.runner import RunOptions, run_scenario
from scenarios.scenario import list_scenarios, load_scenario
from scenarios.sweep.dataset import schema_of
from scenarios.sweep.plan import make_plan
from scenarios.sweep.sweep_file import load_sweep
from scenarios.table import COLUMNS as TABLE
from scenarios.table import cells
from scenarios.telemetry import COLUMNS
from sitl.airframe import list_airframes, load_airframe
from sitl.errors import FileError, LinkError, UsageError
from sitl.modes import EXTERNAL_MODES, MODE_NAMES
from sitl.parameters import ParameterTable
from sitl.profile import PROFILES

ROOT = Path(__file__).parents[1]
PAGES = {name: (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/architecture.md")}
README = PAGES["README.md"]
BLOCKS: list[tuple[str, str]] = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
COMMANDS = [
    line.partition("#")[0].split()[1:]
    for language, block in BLOCKS
    if language == "sh"
    for line in block.splitlines()
    if line.startswith("froude ")
]
"""Every command line shown, without the program's name."""

FILES = {
    match.group(1): block
    for language, block in BLOCKS
    if language in ("toml", "text") and (match := re.match(r"# (\S+\.(?:toml|params))\n", block))
}
"""Every file shown: its name stands in its first line."""

SCRIPTS = [block for language, block in BLOCKS if language == "python"]


def table(first: str, second: str = "") -> list[list[str]]:
    """Rows of the README's table whose head begins with these cells; backquotes and bold are taken off."""
    lines = README.splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith(f"| {first} | {second}"))
    rows = []
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            return rows
        cells = re.split(r"(?<!\\)\|", line)[1:-1]
        rows.append([re.sub(r"[`*]", "", cell).replace("\\|", "|").strip() for cell in cells])
    return rows


def shown(value: Any) -> str:
    """A value as the README writes it."""
    if value is None:
        return "airframe's"
    return ("yes" if value else "no") if isinstance(value, bool) else f"{value:g}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with every file that the README shows; the process works in it."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


# -- what can be typed -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_shown_parses(words: list[str]) -> None:
    assert callable(cli._parser().parse_args(words).run)


def test_every_command_and_option_is_in_the_contract() -> None:
    rows = {row[0].split()[1]: set(re.findall(r"--[a-z][a-z0-9-]+", row[0])) for row in table("command", "does")}
    for name in rows:
        with contextlib.redirect_stdout(io.StringIO()) as page, pytest.raises(SystemExit):
            cli.main([name, "--help"])
        assert rows[name] == set(re.findall(r"--[a-z][a-z0-9-]+", page.getvalue())) - {"--help"}, name
    (names,) = (action.choices for action in cli._parser()._actions if action.dest == "command")
    assert set(rows) == set(names)


def test_the_tolerances_of_a_comparison_are_those_of_the_code() -> None:
    rows = [
        [name, "–" if sense == NEITHER else sense, f"{tolerance:g} {METRICS[name][0]}".removesuffix(" 1")]
        for name, (sense, tolerance) in SENSES.items()
    ]
    assert table("metric", "better") == rows


FLOWN = [words for words in COMMANDS if words[0] == "fly" and any(name in " ".join(words) for name in FILES)]


@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("words", FLOWN, ids=" ".join)
def test_the_files_shown_fly(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = cli.main([*words, "--json"])
    run = json.loads(capsys.readouterr().out)
    passed = all(flight["outcome"] == "PASS" for flight in run["flights"])
    assert status == (cli.EXIT_GATE if "--gate" in words and not passed else cli.EXIT_OK)
    assert run["complete"]
    assert all(flight["rows"] > 1000 for flight in run["flights"])
    assert (folder / run["folder"] / "compare.rrd").is_file()
    if "--junit" in words:
        junit = (folder / words[words.index("--junit") + 1]).read_text()
        assert junit.count('name="verdict"') == len(run["flights"])


@pytest.mark.parametrize("words", [words for words in COMMANDS if words[0] in ("model", "airframes")], ids=" ".join)
def test_the_models_shown_print(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == cli.EXIT_OK
    assert "derivative" in capsys.readouterr().out


def test_every_key_of_the_airframe_shown_is_needed_or_said_to_be_optional(folder: Path) -> None:
    text = FILES["my_airframe.toml"]
    for section in ("sigma", "flight_gains", "assumptions"):
        head, _, rest = text.partition(f"[{section}]")
        (folder / "less.toml").write_text(head + rest[rest.index("\n[") :], encoding="utf-8")
        assert cli.main(["model", "less.toml"]) == cli.EXIT_OK, section


REQUIRED: dict[str, dict[str, Any]] = {
    "step": {"amplitude_deg": 10.0},
    "doublet": {"amplitude_deg": 10.0},
    "3211": {"amplitude_deg": 10.0},
    "ramp": {"amplitude_deg": 10.0, "rate_deg_s": 10.0},
    "chirp": {"amplitude_deg": 5.0, "duration_s": 5.0, "f0_hz": 0.5, "f1_hz": 2.0},
    "multisine": {"peak_deg": 5.0, "duration_s": 5.0, "frequencies_hz": [1.0], "phases_rad": [0.0]},
    "track": {},
}


def test_scenarios_and_manoeuvres_are_all_named_with_their_keys() -> None:
    assert all(f"`{name}`" in README for name in list_scenarios())
    rows = {kind: keys for kind, keys, _ in table("kind", "keys")}
    assert list(rows) == list(KINDS)
    for kind, keys in rows.items():
        settings = make_manoeuvre(kind, **REQUIRED[kind]).settings
        assert set(re.findall(r"[a-z][a-z0-9_]+_(?:deg|s|hz|rad)\b|sweep|rate_deg_s", keys)) == set(settings) - {"kind"}
        for key, default in re.findall(r"(\w+_s) (\d[\d.]*)", keys):
            assert settings[key] == float(default), (kind, key)


FAULTS: dict[str, dict[str, Any]] = {
    "gust": {"wind_m_s": 1.0},
    "motor_efficiency": {"motor": 1, "efficiency_pct": 50.0},
    "motor_out": {"motor": 1},
    "motor_saturation": {"motor": 1, "most_pct": 50.0},
    "battery_sag": {"sag_pct": 10.0},
    "gyro_noise": {"noise_deg_s": 1.0},
    "gyro_bias": {"bias_deg_s": 1.0},
    "gyro_dropout": {"loss_pct": 10.0},
    "gyro_stuck": {},
    "loop_delay": {"delay_ticks": 1},
    "link_loss": {"loss_pct": 10.0},
    "link_delay": {"delay_s": 0.1},
    "link_jitter": {"jitter_s": 0.1},
    "link_duplication": {"share_pct": 10.0},
    "link_reordering": {"share_pct": 10.0},
    "link_corruption": {"share_pct": 10.0},
    "parameter": {"parameter": "MC_ROLL_P", "value": 5.0},
    "autopilot_restart": {},
}


def test_faults_are_all_named_with_their_keys() -> None:
    rows = {kind: keys for kind, keys, _ in table("fault", "keys")}
    assert list(rows) == list(FAULT_KINDS) == list(FAULTS)
    for kind, keys in rows.items():
        (fault,) = parse_faults([{"kind": kind, "at_s": 1.0, **FAULTS[kind]}], Path("fault.toml"), ())
        assert re.findall(r"(?<!\")\b[a-z_0-9]+\b(?!\")", re.sub(r" [\d.]+", "", keys)) == list(fault.settings), kind
        for key, default in re.findall(r'(\w+) "?(\w+)"?', keys):
            assert format(fault.settings[key], "g" if default.isdigit() else "") == default, (kind, key)


# -- what is promised ------------------------------------------------------------------------------------------------


def test_exit_status() -> None:
    promised = {int(row[0]): row[1] for row in table("status", "when")}
    assert list(promised) == [cli.EXIT_OK, cli.EXIT_GATE, cli.EXIT_USAGE, cli.EXIT_LINK, cli.EXIT_INTERRUPTED]
    assert "--gate" in promised[cli.EXIT_GATE]
    assert "Ctrl-C" in promised[cli.EXIT_INTERRUPTED]
    assert UsageError.exit_status == FileError.exit_status == cli.EXIT_USAGE
    assert LinkError.exit_status == cli.EXIT_LINK


def test_telemetry_columns() -> None:
    expected: list[list[str]] = []
    for column in COLUMNS.values():
        row = [column.name, np.dtype(column.dtype).name, column.unit, column.meaning]
        row = [re.sub(r"\bmotor( ?)\d", r"motor\1N", cell) for cell in row]
        if row not in expected:
            expected.append(row)
    assert table("column", "type") == expected
    assert sum(name.startswith("motor") for name in COLUMNS) == 8


def test_metrics() -> None:
    assert table("metric", "unit") == [[name, unit, meaning] for name, (unit, meaning) in METRICS.items()]


def test_profiles() -> None:
    names = ("study", "sitl", "board")
    values = {
        item: [*(shown(getattr(PROFILES[name], item)) for name in names), unit]
        for item, _, unit in PROFILES["sitl"].describe()
        if item != "name"
    }
    assert {row[0]: row[2:] for row in table("item", "what")} == values


def test_parameters() -> None:
    parameters = ParameterTable()
    count, obeyed = re.search(r"\*\*Parameters\*\*: (\d+),.*?acts on (\d+) of", README, re.DOTALL).groups()  # type: ignore[union-attr]
    assert int(count) == len(parameters)
    assert int(obeyed) == sum(parameters.spec(name).obeyed for name in parameters.names)


def test_modes() -> None:
    modes = re.search(r"\*\*Modes\*\*: (.*?)\n- \*\*", README, re.DOTALL).group(1)  # type: ignore[union-attr]
    named = re.sub(r"\s+", " ", modes)
    assert [name for mode, name in MODE_NAMES.items() if mode not in EXTERNAL_MODES and name not in named] == []


def test_every_deviation_from_a_px4_is_listed_and_no_other() -> None:
    with (ROOT / "tests/data/px4_answers_deviations.toml").open("rb") as file:
        reasons = {entry["reason"] for entry in tomllib.load(file)["deviation"]}
    listed = re.search(r"\*\*Where it answers otherwise.*?\n\n(.*?)\n\n", README, re.DOTALL).group(1)  # type: ignore[union-attr]
    assert {re.sub(r"\s+", " ", line).removesuffix(".") for line in listed.removeprefix("- ").split("\n- ")} == reasons


def test_run_json_and_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fly", "roll_step", "--gains", "px4_defaults", "--json"]) == cli.EXIT_OK
    run = json.loads(capsys.readouterr().out)
    assert [row[0] for row in table("key", "holds")] == list(run)
    assert [row[0] for row in table("key of a flight", "holds")] == list(run["flights"][0]) == list(run["baseline"])
    metric = re.search(r"A metric has (.*?)\. A value", README, re.DOTALL).group(1)  # type: ignore[union-attr]
    assert re.findall(r"`(\w+)`", metric) == list(run["flights"][0]["metrics"][0])
    there = {str(path.relative_to(run["folder"])) for path in Path(run["folder"]).rglob("*.*")}
    promised = [row[0] for row in table("file", "what")]
    slugs = ("px4_defaults", "own_ant-x")
    assert there == {name.replace("<gain set>", slug) for name in promised for slug in slugs}


def test_the_same_bytes_again_and_two_at_a_time() -> None:
    scenario = dataclasses.replace(load_scenario("roll_step"), gain_sets=("table_7_2/ANT-R", "table_2_2/ANT-X"))
    hashes = [
        [flight.telemetry_sha256 for flight in run_scenario(scenario, RunOptions(out=None, jobs=jobs)).run.flights]
        for jobs in (1, 1, 2)
    ]
    assert hashes[0] == hashes[1] == hashes[2]
    assert len(set(hashes[0])) == 2


@pytest.mark.parametrize("page", PAGES)
def test_what_is_linked_or_named_exists(page: str) -> None:
    text, base = PAGES[page], (ROOT / page).parent
    heads = {re.sub(r"[^a-z0-9 -]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)$", text, re.M)}
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("#"):
            assert link[1:] in heads, link
        elif not link.startswith("https://"):
            assert (base / link).exists(), link
    for path in re.findall(r"`((?:tests|sitl|bridge|scenarios|docs)/[\w./-]*)`", text):
        assert (ROOT / path).exists(), path


# -- sweeps ----------------------------------------------------------------------------------------------------------


def test_every_key_of_a_sweep_is_named(folder: Path) -> None:
    text = FILES["my_sweep.toml"]
    (folder / "wrong.toml").write_text(f"nonsense = 1\n{text}", encoding="utf-8")
    with pytest.raises(FileError) as error:
        load_sweep(folder / "wrong.toml")
    known = re.search(r"Keys here are (.*)", str(error.value)).group(1).rstrip(".").split(", ")  # type: ignore[union-attr]
    # a file has either of limit and limits, so only one of them is asked for
    assert {row[0] for row in table("key of a sweep", "default")} == set(known) | {"limit"}
    least = load_sweep(_written(folder / "least.toml", "[axes]\nMC_ROLL_P = [6.0, 7.0]\n"))
    defaults = {row[0]: row[1].strip('"') for row in table("key of a sweep", "default")}
    for name in ("setpoint_rate_hz", "required_pass_pct", "samples", "seed", "distribution", "spread_sigma"):
        assert defaults[name] == (value if isinstance(value := getattr(least, name), str) else f"{value:g}"), name
    assert (least.limits_name, least.design.kind) == (defaults["limits"], defaults["design"])


def _written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_the_columns_of_a_sweep_are_those_of_its_schema(folder: Path) -> None:
    plan = make_plan(load_sweep(folder / "my_sweep.toml"))
    parameters = {axis.name: "<parameter>" for axis in plan.sweep.parameters}
    conditions = {"vehicle": "<condition>", **dict.fromkeys(plan.cases[0].conditions, "<condition>")}
    metrics = "|".join(sorted(METRICS, key=len, reverse=True))
    found: dict[str, set[str]] = {}
    for field in schema_of(plan):
        name = {**parameters, **conditions}.get(field.name, field.name)
        name = re.sub(rf"^(failing_)?(?:{metrics})(?=_(?:nominal|worst|median|best|unset)$|$)", r"\1<metric>", name)
        found.setdefault(name, set()).add(str(field.type))
    rows = table("column of a sweep", "type")
    assert [row[0] for row in rows] == list(found)
    for name, types, *_ in rows:
        assert found[name] <= set(re.findall(r"\w+", types)) - {"or"}, name


def test_the_files_of_a_sweep(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = FILES["my_sweep.toml"].replace("points = 2000", "points = 24").replace("samples = 200", "samples = 2")
    (folder / "my_sweep.toml").write_text(text, encoding="utf-8")
    assert cli.main(["sweep", "my_sweep.toml", "--json"]) == cli.EXIT_OK
    there = Path(json.loads(capsys.readouterr().out)["folder"])
    promised = [re.sub(r"<\w+>", "*", name) for row in table("file of a sweep", "what") for name in row[0].split(", ")]
    promised = [f"heat_*{name}" if name.startswith(".") else name for name in promised]
    named = {path for name in promised for path in there.glob(name)}
    assert {path for path in there.rglob("*.*") if path.name != ".lock"} <= named
    kind = "best" if (there / "best.toml").exists() else "winner"
    absent = {name for name in promised if not list(there.glob(name))}
    assert absent == {
        "flights/",
        *(f"{name}.{end}" for name in {"best", "winner"} - {kind} for end in ("toml", "params")),
    }
    (script,) = (block for language, block in BLOCKS if language == "py" and "pyarrow" in block)
    done = subprocess.run([sys.executable, "-c", script], cwd=there, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "pass_pct_min" in done.stdout


# -- what was measured -----------------------------------------------------------------------------------------------


def fly(vehicle: str, gains: Sequence[str], column: str) -> dict[str, FlightRecord]:
    """Fly the library's roll step; `column` is the head of a table: "study", or a motor lag."""
    scenario = load_scenario("roll_step")
    lag = re.match(r"(\d+) ms", column)
    changes: dict[str, Any] = {"overrides": {"motor_lag_s": int(lag[1]) * 1e-3}} if lag else {"profile": "study"}
    scenario = dataclasses.replace(scenario, vehicle=vehicle, gain_sets=tuple(gains), **changes)
    run = run_scenario(scenario, RunOptions(out=None)).run
    return {flight.gain_set.name: flight for flight in run.flights}


def cell(flight: FlightRecord) -> str:
    """A flight as the README's tables show it."""

    def value(name: str) -> float | None:
        metric = flight.metric(name)
        assert metric is not None
        return metric.value

    oscillation, margin = value("oscillation_rad_s"), value("delay_margin_s")
    assert oscillation is not None
    assert margin is not None
    assert (oscillation > LIMIT_CYCLE_RAD_S) is (margin < 0.0)
    if oscillation > LIMIT_CYCLE_RAD_S:
        return f"{oscillation:.1f} rad/s at {value('oscillation_hz'):.1f} Hz; {1e3 * margin:.1f} ms"
    settled = value("settling_time_5pct_s")
    how = f"rise {value('rise_time_s'):.2f} s, droop {value('droop_deg'):.1f} deg"
    if settled is not None:
        how = f"overshoot {value('overshoot_pct'):.1f} %, settled in {settled:.2f} s"
    return f"{how}; {1e3 * margin:.1f} ms"


def same(text: str, measured: str) -> bool:
    """Words alike, numbers within 5 %: another processor rounds differently."""
    number = r"-?\d+\.\d+"
    if re.sub(number, "0", text) != re.sub(number, "0", measured):
        return False
    pairs = zip(re.findall(number, text), re.findall(number, measured), strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.05, abs=0.06) for a, b in pairs)


def head(first: str) -> list[str]:
    line = next(line for line in README.splitlines() if line.startswith(f"| {first} |"))
    return [name.strip() for name in line.split("|")[2:-1]]


@pytest.mark.parametrize("column", head("airframe"))
def test_flight_gains_of_every_airframe(column: str) -> None:
    for name, *texts in table("airframe", head("airframe")[0]):
        (flight,) = fly(name, [f"table_2_2/{name}"], column).values()
        assert same(texts[head("airframe").index(column)], cell(flight)), (name, column, cell(flight))


@pytest.mark.parametrize("column", head("gain set"))
def test_gains_of_table_7_2(column: str) -> None:
    flights = fly("ant-x", ["table_7_2"], column)
    rows = {name: texts[head("gain set").index(column)] for name, *texts in table("gain set", head("gain set")[0])}
    assert list(rows) == list(flights)
    for name, text in rows.items():
        assert same(text, cell(flights[name])), (name, column, cell(flights[name]))


def test_the_demo() -> None:
    (printed,) = (block for language, block in BLOCKS if language == "text" and "verdict" in block)
    flights = run_scenario(load_scenario("demo"), RunOptions(out=None)).run.flights
    for flight in flights:
        (line,) = (line for line in printed.splitlines() if line.startswith(flight.gain_set.name + " "))
        assert line.split()[-1] == str(flight.outcome)
        now = {column.metrics[0]: text for column, (text, _) in zip(TABLE, cells(flight), strict=True)}
        then = dict(
            zip(now, re.findall(r"[-\d.]+ @ [\d.]+|\S+", line.removeprefix(flight.gain_set.name)), strict=False)
        )
        # The phase of a limit cycle, and what depends on it, differs between processors.
        robust = ("oscillation_rad_s", "delay_margin_s") if "@" in now["oscillation_rad_s"] else now
        assert all(same(then[name], now[name]) for name in robust), (then, now)


@pytest.mark.parametrize(("name", "profile"), [("ANT-X", "sitl"), ("ADAM-0", "board")])
def test_gains_made_here(name: str, profile: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {row[0]: row[1:] for row in table("tuned for", "study")}
    assert set(rows) == {load_airframe(one).name for one in list_airframes()}
    text = rows[name][head("tuned for").index(profile)]
    assert cli.main(["tune", name.lower(), "--profile", profile, "--json"]) == cli.EXIT_OK
    made = json.loads(capsys.readouterr().out)
    (found,) = made["found"]
    worst = (found["settling_s"][0], found["overshoot_pct"][0], 1e3 * found["delay_margin_s"])
    assert made["met"]
    # the search rounds differently on another processor, and ends beside: the requirements are what is promised
    shown = [float(number) for number in re.findall(r"\d+\.\d+", text)]
    assert shown == pytest.approx(worst, rel=0.2, abs=1.0)


# -- what can be copied ----------------------------------------------------------------------------------------------


def test_scripts_are_python() -> None:
    assert len(SCRIPTS) == 2
    for script in SCRIPTS:
        compile(script, "README.md", "exec")


@pytest.fixture
def port() -> Iterator[int]:
    """A free port to which `froude sitl` sends."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        number: int = probe.getsockname()[1]
    # fmt: off
    command = [sys.executable, "-m", "scenarios.cli", "sitl", "ant-x", "--speed", "2", "--no-log",
               "--link", f"udpout://127.0.0.1:{number}#onboard"]
    # fmt: on
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE) as vehicle:
        assert vehicle.stdout is not None
        assert b"ANT-X is system 1" in vehicle.stdout.readline()
        yield number
        vehicle.terminate()
        assert vehicle.wait(10) == 0


@pytest.mark.client
@pytest.mark.parametrize("script", SCRIPTS, ids=["mavsdk", "pymavlink"])
def test_scripts_run(script: str, port: int) -> None:
    pytest.importorskip("mavsdk.asyncio")
    text = re.sub(r"127\.0\.0\.1:145[45]0", f"127.0.0.1:{port}", script)
    assert str(port) in text
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    assert "flying at" in done.stdout or "ATTITUDE" in done.stdout
