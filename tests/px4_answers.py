"""Asks our vehicle what a real PX4 was asked, and says where the answers differ.

    python tests/px4_answers.py [--only REGEX] [--families REGEX] [--file JSONL] [-v]

Every case gets a vehicle of its own, brought into the state the case begins in. Prints OK or DIFF for each case and
every difference; those that tests/data/px4_answers_deviations.toml allows are marked "known". Exit status 1 if there
is a difference that is not known, or a known one that does not occur.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

TESTS = Path(__file__).resolve().parent
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from px4_compare import differences, squeeze  # noqa: E402
from px4_rig import NotReached, Rig, Station, from_wire  # noqa: E402

from bridge.messages import BY_ID, BY_NAME  # noqa: E402

Json = dict[str, Any]

CASES = TESTS / "data" / "px4_answers.jsonl"
DEVIATIONS = TESTS / "data" / "px4_answers_deviations.toml"

_ANSWER = re.compile(
    r"HEARTBEAT|COMMAND_(ACK|CANCEL)|PARAM_(VALUE|ERROR)|MISSION_(COUNT|ACK|(ITEM|REQUEST)(_INT)?)|LOG_(ENTRY|DATA)|"
    r"FILE_TRANSFER_PROTOCOL|STATUSTEXT|AUTOPILOT_VERSION|PROTOCOL_VERSION|MESSAGE_INTERVAL|AVAILABLE_MODES|"
    r"COMPONENT_(INFORMATION(_BASIC)?|METADATA)|(FLIGHT|STORAGE|CAMERA)_INFORMATION|TIMESYNC|PING|SERIAL_CONTROL|"
    r"RESPONSE_EVENT_ERROR|LOGGING_ACK"
)
ANSWERS = frozenset(name for name in BY_NAME if _ANSWER.fullmatch(name))
"""Messages that count as answers; of HEARTBEAT those that say something new."""

_LOGS = re.compile('"LOG|FILE_TRANSFER|"logged"|"nolog"|SDLOG|STORAGE_INFORMATION')
"""What in a case may depend on whether its vehicle writes logs."""

EARLY_S, GRACE_S = 0.05, 0.1
"""An answer so shortly before or after the end of the last step may stand for a recorded one, but need not."""

SETTLE_S = 1.0
"""By then everything that tidying up causes has been said, a parameter's announcement last."""

PHASES_S = (0.0, 0.25, 0.5, 0.75)
"""HEARTBEAT comes once a second; which state it shows within a case depends on its phase, which nobody recorded."""


def load_cases(path: Path = CASES) -> list[Json]:
    """Read the recorded cases, in their order.

    The recorded vehicle went from case to case, so a case gets as `before` how the one before it was tidied up.
    """
    cases: list[Json] = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    for case, after in pairwise(cases):
        if not after.get("fresh") and all(case[key] == after[key] for key in ("family", "pre")):
            after["before"] = case.get("teardown", [])
    return cases


@dataclass(frozen=True)
class Deviation:
    """Differences that are meant.

    Attributes:
        reason: why, for people.
        cases: ids of the cases, regular expressions that match a whole id.
        differences: the lines that each of these cases shows; `*` stands for anything.
    """

    reason: str
    cases: tuple[str, ...]
    differences: tuple[str, ...]

    def covers(self, case_id: str) -> bool:
        return any(re.fullmatch(one, case_id) for one in self.cases)


def load_deviations(path: Path = DEVIATIONS) -> list[Deviation]:
    """Read the table of what is meant to differ."""
    tables = tomllib.loads(path.read_text(encoding="utf-8")).get("deviation", [])
    return [Deviation(one["reason"], tuple(one["cases"]), tuple(one["differences"])) for one in tables]


def judge(case_id: str, found: Sequence[str], deviations: Sequence[Deviation]) -> tuple[list[str], list[str]]:
    """Split what was found into (known, wrong); a known difference that does not occur any more is wrong."""
    patterns = [line for one in deviations if one.covers(case_id) for line in one.differences]
    known = [line for line in found if any(_fits(line, pattern) for pattern in patterns)]
    wrong = [line for line in found if line not in known]
    wrong += [
        f"stale: the deviation {pattern!r} does not occur"
        for pattern in patterns
        if not any(_fits(line, pattern) for line in found)
    ]
    return known, wrong


def _fits(line: str, pattern: str) -> bool:
    return re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), line) is not None


class Verdict(NamedTuple):
    """How a case went.

    Attributes:
        known: differences that are meant.
        wrong: differences that are not, and deviations that do not occur.
        got: what our vehicle answered.
    """

    known: list[str]
    wrong: list[str]
    got: Json


def replay(case: Json, deviations: Sequence[Deviation] = ()) -> Verdict:
    """Ask our vehicle and compare. What differs in HEARTBEAT is asked again at other phases of it; the best counts.

    Raises:
        NotReached: the vehicle does not come into the state that the case begins in.
    """
    verdicts: list[Verdict] = []
    for phase_s in PHASES_S:
        got = ask(case, phase_s)
        verdicts.append(Verdict(*judge(case["id"], differences(case, got), deviations), got))
        if case["pre"] == "boot" or not any("HEARTBEAT" in line for line in verdicts[-1].wrong):
            break
    return min(verdicts, key=lambda verdict: len(verdict.wrong))


def ask(case: Json, phase_s: float = 0.0) -> Json:
    """What a vehicle just started and brought into the case's state answers, in the form of the recordings."""
    rig = Rig(logs=_LOGS.search(json.dumps(case)) is not None)
    station = rig.station(case.get("link"))
    if case.get("kind") == "connect":
        return _connect(rig, station, case)
    rig.prepare(case["pre"])
    rig.run(phase_s)
    if case.get("kind") == "rates":
        before = station.counts.copy()
        rig.run(case["duration"])
        counts = station.counts - before
        return {"rates": {BY_ID[number].name: count / case["duration"] for number, count in counts.items()}}
    if '{"$": "hash"}' in json.dumps(case["steps"]):
        rig.learn_hash()
    return _ask(rig, station, case)


def _connect(rig: Rig, station: Station, case: Json) -> Json:
    """What a ground station sees first; one that answers does so from the first HEARTBEAT on."""
    rig.heartbeats = False
    station.keep(["HEARTBEAT"])
    rig.run_until(lambda: station.counts, 5.0, "a first message")
    begin_us = rig.now_us
    while rig.now_us - begin_us < case["duration"] * 1e6:
        rig.heartbeats = bool(case.get("heartbeat")) and station.last("HEARTBEAT") is not None
        rig.tick()
    heartbeat = station.heard[0][2] if station.heard else None
    return {
        "first": [
            {
                "name": (name := BY_ID[number].name),
                "first_t": (at_us - begin_us) * 1e-6,
                "count": station.counts[number],
            }
            | ({"fields": from_wire(heartbeat)} if name == "HEARTBEAT" and heartbeat else {})
            for number, at_us in station.first_us.items()
        ]
    }


def _ask(rig: Rig, station: Station, case: Json) -> Json:
    if case.get("before"):
        for step in case["before"]:
            _step(rig, station, step)
        rig.run(SETTLE_S)
    for step in case.get("setup", ()):
        _step(rig, station, step)
    rig.run(0.12)
    state = rig.state()
    watched = set(case.get("watch", ()))
    station.keep(ANSWERS | watched)
    begin_us = rig.now_us
    for station.step, step in enumerate(case["steps"]):
        _step(rig, station, step, case.get("auto", ()))
    end_us, end = rig.now_us, rig.state()
    last = [(name, station.last(name)) for name in case.get("watch_last", ())]
    rig.run(GRACE_S)

    answers: list[Json] = []
    for at_us, step_number, message in station.heard:
        fields = from_wire(message)
        if message.name == "HEARTBEAT":
            if all(state[key] == fields[key] for key in state):
                continue
            state = {key: fields[key] for key in state}
        if message.name == "TIMESYNC" and message.tc1 == 0:
            continue
        if message.name == "PING" and message.target_system == 0 and message.name not in watched:
            continue
        one: Json = {"t": _seconds(at_us - begin_us), "step": step_number, "name": message.name, "fields": fields}
        answers.append({**one, "late": True} if at_us > end_us - EARLY_S * 1e6 else one)
    for name, found in last:
        if found is not None and found[0] > begin_us:
            one = {"t": _seconds(found[0] - begin_us), "step": station.step, "name": name, "last": True}
            answers.append({**one, "fields": from_wire(found[1])})
    return {"answers": squeeze(answers), "end": end}


def _step(rig: Rig, station: Station, step: Json, autos: Sequence[Json] = ()) -> None:
    """Send what a step sends and listen as long as it listens; `autos` are answers to what the vehicle sends."""
    sender = rig.station(step["link"]) if "link" in step else station
    for what in step.get("do", ()):
        if what in ("heartbeat_on", "heartbeat_off"):
            rig.heartbeats = what == "heartbeat_on"
        else:
            rig.stream = {"stream_hold": {"hold": True}, "stream_off": None}[what]
    if "stream" in step:
        rig.stream = step["stream"]
    for message in step.get("send", ()):
        rig.send(sender, message)
    end_us = rig.now_us + round(step.get("wait", 0.15) * 1e6)
    heard = len(station.heard)
    while rig.now_us < end_us:
        rig.tick()
        for _, _, message in station.heard[heard:]:
            for auto in autos:
                wanted = auto["when"].get("fields", {})
                if message.name == auto["when"]["name"] and wanted.items() <= message.fields().items():
                    for one in auto["send"]:
                        rig.send(station, one)
        heard = len(station.heard)


def _seconds(span_us: int) -> float:
    return round(span_us * 1e-6, 3)


def _verdicts(cases: Sequence[Json]) -> Iterator[tuple[Json, Verdict]]:
    """Verdicts for people: what goes wrong in one case does not hide the others."""
    deviations = load_deviations()
    for case in cases:
        try:
            yield case, replay(case, deviations)
        except NotReached as error:
            yield case, Verdict([], [f"state {case['pre']!r} not reached: {error}"], {})
        except Exception as error:
            yield case, Verdict([], [f"raised {type(error).__name__}: {error}"], {})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="REGEX", help="cases whose id has a match")
    parser.add_argument("--families", default="", metavar="REGEX", help="cases whose family has a match")
    parser.add_argument("--file", type=Path, default=CASES, metavar="JSONL", help="other recorded cases")
    parser.add_argument("-v", "--verbose", action="store_true", help="print what is asked and all answers, too")
    options = parser.parse_args()
    cases = [
        case
        for case in load_cases(options.file)
        if re.search(options.only, case["id"]) and re.search(options.families, case["family"])
    ]
    say = sys.stdout.write
    totals: Counter[str] = Counter()
    for case, verdict in _verdicts(cases):
        totals["DIFF" if verdict.wrong else "OK"] += 1
        say(f"{'DIFF' if verdict.wrong else 'OK  '} {case['id']}\n")
        for line in verdict.wrong:
            say(f"       {line}\n")
        for line in verdict.known:
            say(f"       known: {line}\n")
        if options.verbose:
            _tell(case, verdict.got)
        sys.stdout.flush()
    say(f"{totals['OK']} OK, {totals['DIFF']} DIFF of {len(cases)}\n")
    return 1 if totals["DIFF"] else 0


def _tell(case: Json, got: Json) -> None:
    """Print what a case asks, what a PX4 answered and what we answered."""
    sys.stdout.write(f"     = {case['desc']} (begins in {case['pre']!r})\n")
    for part in ("setup", "steps", "auto"):
        for number, step in enumerate(case.get(part, ())):
            sys.stdout.write(f"     {part} {number}: {json.dumps(step)}\n")
    for who, side in (("PX4 ", case), ("ours", got)):
        for one in [*side.get("answers", ()), *side.get("first", ())]:
            sys.stdout.write(f"     {who} {json.dumps(one)[:400]}\n")
        for key in ("end", "rates"):
            if key in side:
                sys.stdout.write(f"     {who} {key} {json.dumps(side[key])}\n")


if __name__ == "__main__":
    sys.exit(main())
