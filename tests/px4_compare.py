"""Compares what a vehicle answered with what a PX4 answered: the rules of the recordings.

A case was recorded twice; `vary` names the fields that differed or are noise, `build` those that depend on the build
and not on the protocol. Numbers inside texts and the order between different messages are not compared.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator
from typing import Any

Json = dict[str, Any]

CLOCKS = {"time_boot_ms", "time_usec", "time_unix_usec", "ts1", "tc1", "timestamp"}
BY_CHANCE = re.compile(r"RTL: |\)?\t$|Preflight: GPS|\[cal\] progress")
"""Texts that depend on where the vehicle is or on noise."""

MANY = 40
"""More of one message than this become one entry, a summary."""

_TOLERANCE = {"ATTITUDE_TARGET": 0.02, "LOCAL_POSITION_NED": 1.0, "POSITION_TARGET_LOCAL_NED": 1.0}
_TIME_S, _HEARTBEAT_TIME_S = 0.7, 1.1  # HEARTBEAT comes once a second, at any phase
_RATE, _RATE_HZ = 0.12, 0.15
_BEGINS_WITH = {
    "offboard": (145, 393216, 4),
    "hover": (157, 50593792, 4),
    "ground": (29, 50593792, 3),
    "armed": (157, 50593792, 4),
}
_TELLS_APART = {
    "COMMAND_ACK": ("command", "result"),
    "STATUSTEXT": ("text", "chunk_seq"),
    "PARAM_VALUE": ("param_id",),
    "PARAM_ERROR": ("error",),
    "HEARTBEAT": ("base_mode", "custom_mode"),
    "MISSION_REQUEST_INT": ("seq",),
    "MISSION_REQUEST": ("seq",),
    "MISSION_ITEM_INT": ("seq",),
    "MISSION_ACK": ("type", "mission_type"),
    "MISSION_COUNT": ("mission_type",),
    "AVAILABLE_MODES": ("mode_index",),
    "LOG_DATA": ("ofs",),
}


def differences(case: Json, got: Json) -> list[str]:
    """What differs between a recorded case and what a vehicle answered, one line each."""
    if case.get("informative"):
        return []
    if "rates" in case:
        return list(_rates(case["rates"], got["rates"]))
    if "first" in case:
        return list(_connect(case["first"], got["first"]))
    found = list(_answers(case, got))
    if case.get("end_matters", True) and "end_other" not in case:
        found += [
            f"end HEARTBEAT.{key}: expected {value}, got {got['end'][key]}"
            for key, value in case["end"].items()
            if got["end"][key] != value
        ]
    return found


def squeeze(answers: list[Json]) -> list[Json]:
    """Answers as the recordings keep them: equal ones in a step counted, many of one message summed up.

    Those that are `late` need not be there: one that repeats another goes into its `late_count`.
    """
    by_name: dict[str, list[Json]] = {}
    for one in answers:
        if not one.get("late"):
            by_name.setdefault(one["name"], []).append(one)
    kept: list[Json] = []
    for one in answers:
        same_name = by_name.get(one["name"], [])
        if len(same_name) > MANY:
            if one is same_name[0]:
                kept.append(_summary(same_name))
            continue
        twin = next((other for other in kept if _repeats(one, other)), None)
        if twin is None:
            kept.append({**one})
        else:
            counter = "late_count" if one.get("late") and not twin.get("late") else "count"
            twin[counter] = twin.get(counter, counter == "count") + 1
    return kept


def show(answer: Json) -> str:
    """An answer in short."""
    fields = answer.get("fields", {})
    if answer["name"] == "STATUSTEXT":
        return f"STATUSTEXT {fields['severity']} {fields['text']!r}"
    if answer["name"] == "COMMAND_ACK":
        return f"COMMAND_ACK {fields['command']} result {fields['result']}"
    if answer["name"] == "HEARTBEAT":
        state = (fields["base_mode"], fields["custom_mode"], fields["system_status"])
        return "HEARTBEAT base {} mode {} status {}".format(*state)
    return f"{answer['name']} {json.dumps(fields)[:160]}"


def _rates(expected: Json, got: Json) -> Iterator[str]:
    for name, pair in expected.items():
        slack = max(_RATE * max(pair), _RATE_HZ)
        if not min(pair) - slack <= got.get(name, 0.0) <= max(pair) + slack:
            yield f"rate {name}: expected {min(pair)}..{max(pair)} Hz, got {got.get(name, 0.0)}"
    for name, hz in got.items():
        if name not in expected and hz >= 0.1 and name not in ("PARAM_VALUE", "STATUSTEXT", "EVENT"):
            yield f"rate {name}: not expected, got {hz}"


def _connect(expected: list[Json], got: list[Json]) -> Iterator[str]:
    have = {one["name"]: one for one in got}
    for one in expected:
        if one.get("sometimes"):
            continue
        if one["name"] not in have:
            yield f"missing {one['name']} (first at {one['first_t']} s)"
            continue
        for key, value in one.get("fields", {}).items():
            ours = have[one["name"]].get("fields", {}).get(key)
            if key not in CLOCKS and not _same(value, ours):
                yield f"{one['name']}.{key}: expected {value!r}, got {ours!r}"
    known = {one["name"] for one in expected}
    yield from (f"extra {name}" for name in have if name not in known)


def _answers(case: Json, got: Json) -> Iterator[str]:
    ours = list(_relevant(case, got["answers"]))
    both_list_logs = all(any(one["name"] == "LOG_ENTRY" for one in side) for side in (case["answers"], ours))
    for theirs, mine in _align(case["answers"], ours):
        if theirs is not None and mine is not None:
            yield from _pair(case, theirs, mine)
            continue
        alone = theirs or mine
        assert alone is not None
        if alone.get("sometimes") or alone.get("late"):
            continue
        if alone["name"] == "LOG_ENTRY" and both_list_logs:
            continue  # how many logs there are is history
        if alone["name"] == "STATUSTEXT" and BY_CHANCE.match(alone["fields"]["text"]):
            continue
        yield ("missing " if mine is None else "extra ") + show(alone)


def _pair(case: Json, theirs: Json, mine: Json) -> Iterator[str]:
    """Differences between a recorded answer and ours to the same question."""
    name = theirs["name"]
    skip = {*theirs.get("vary", ()), *theirs.get("build", ())}
    if name == "PARAM_VALUE" and theirs.get("summary"):
        skip |= {"param_value", "param_id", "param_type"}  # whichever parameter is first
    for part in ("fields",) if "fields" in theirs else ("first", "second", "last"):
        expected, have = _flat(theirs[part]), _flat(mine[part])
        for key, value in expected.items():
            if name == "PARAM_VALUE" and key == "param_index" and key not in theirs.get("vary", ()):
                # Which one it is depends on the build, whether it has one does not.
                if (value == 65535) != (have.get(key) == 65535):
                    yield f"{name}.{key}: expected {value}, got {have.get(key)}"
                continue
            if skip & {key, key.partition(".")[0]} or key.rpartition(".")[2] in CLOCKS:
                continue
            alike = _words(value) == _words(have.get(key)) if key == "text" else False
            if not alike and not _same(value, have.get(key), _TOLERANCE.get(name, 1e-5)):
                yield f"{name}.{key}: expected {value!r}, got {have.get(key)!r}"
        if not theirs.get("summary"):
            yield from (f"{name}.{key}: extra field" for key in have if key not in expected and key not in skip)
    if theirs.get("summary"):
        for key in ("hash_checks", "in_index_order", "sorted_by_name"):
            if key in theirs and theirs[key] != mine.get(key) and "n_other" not in theirs:
                yield f"{name} {key}: expected {theirs[key]}, got {mine.get(key)}"
    elif name != "PARAM_VALUE" and "count_other" not in theirs and not case.get("loose_count"):
        wanted, count = theirs.get("count", 1), mine.get("count", 1)
        if not count <= wanted <= count + mine.get("late_count", 0):
            yield f"{show(theirs)}: expected {wanted} times, got {count}"
    if case.get("timeline") and not theirs.get("sometimes"):
        early, late = sorted((theirs["t"], theirs.get("t_other", theirs["t"])))
        slack = case.get("t_tol", _HEARTBEAT_TIME_S if name == "HEARTBEAT" else _TIME_S)
        if not early - slack <= mine["t"] <= late + slack:
            yield f"{show(theirs)}: expected at {early}..{late} s, got {mine['t']} s"


def _relevant(case: Json, answers: Iterable[Json]) -> Iterator[Json]:
    """Our answers without what the recordings leave out too."""
    asked = json.dumps([case.get("steps"), case.get("auto")])
    lists = any(part in asked for part in ("PARAM_REQUEST_LIST", '"param_index": 0', '"param_index": 7'))
    first = True
    for one in answers:
        name, fields = one["name"], one.get("fields", {})
        if name == "HEARTBEAT" and "summary" not in one:
            state = (fields["base_mode"], fields["custom_mode"], fields["system_status"])
            late = first and state == _BEGINS_WITH.get(case["pre"])  # the state it began in, reported late
            first = False
            if late:
                continue
        if name in case.get("ignore", ()):
            continue
        if name == "STATUSTEXT" and re.match(r"\[logger\]|Preflight Fail: Battery unhealthy", fields.get("text", "")):
            continue
        if one.get("last") and case["pre"] == "offboard" and case["end"]["custom_mode"] != 393216:
            continue  # another mode flies by then
        if name == "SERIAL_CONTROL" and name not in asked:
            continue
        if name == "PARAM_VALUE" and "summary" not in one and not lists and f'"{fields["param_id"]}"' not in asked:
            continue  # an announcement of a parameter which the case does not name
        yield one


def _align(theirs: list[Json], ours: list[Json]) -> Iterator[tuple[Json | None, Json | None]]:
    """Pairs that belong together, one of them None where it has no partner; each message name on its own."""
    for name in dict.fromkeys(one["name"] for one in theirs + ours):
        first = [one for one in theirs if one["name"] == name]
        second = [one for one in ours if one["name"] == name]
        keys = [_key(one) for one in first], [_key(one) for one in second]
        for what, i, i_end, j, j_end in difflib.SequenceMatcher(None, *keys, autojunk=False).get_opcodes():
            if what == "equal":
                yield from zip(first[i:i_end], second[j:j_end], strict=True)
            else:
                yield from ((one, None) for one in first[i:i_end])
                yield from ((None, one) for one in second[j:j_end])


def _key(one: Json) -> tuple[str, ...]:
    name = one["name"]
    if one.get("summary") or one.get("last"):
        return (name, "summary" if one.get("summary") else "last")
    fields = one["fields"]
    parts = [_words(fields[key]) if key == "text" else str(fields[key]) for key in _TELLS_APART.get(name, ())]
    if name == "FILE_TRANSFER_PROTOCOL":
        parts += [str(fields["payload"].get(key)) for key in ("opcode", "req_opcode", "seq", "error")]
    return (name, *parts)


def _summary(answers: list[Json]) -> Json:
    first, second, last = answers[0], answers[1], answers[-1]
    fields = {"first": first["fields"], "second": second["fields"], "last": last["fields"]}
    entry: Json = {**first, **fields, "summary": True, "n": len(answers), "t_last": last["t"]}
    del entry["fields"]
    if first["name"] == "PARAM_VALUE":
        names = [one["fields"]["param_id"] for one in answers]
        indices = [one["fields"]["param_index"] for one in answers if one["fields"]["param_index"] != 65535]
        plain = [name for name in names if not name.startswith("_")]
        entry["hash_checks"] = names.count("_HASH_CHECK")
        entry["in_index_order"] = indices == sorted(indices)
        entry["sorted_by_name"] = plain == sorted(plain)
    return entry


def _repeats(one: Json, other: Json) -> bool:
    if any(side.get(what) for side in (one, other) for what in ("summary", "last")):
        return False
    return all(one[what] == other[what] for what in ("name", "step", "fields"))


def _flat(fields: Json, prefix: str = "") -> Json:
    flat: Json = {}
    for key, value in fields.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _same(one: Any, other: Any, tolerance: float = 1e-5) -> bool:
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(_same(*pair, tolerance) for pair in zip(one, other, strict=True))
    if isinstance(one, (int, float)) and isinstance(other, (int, float)) and float in (type(one), type(other)):
        return abs(one - other) <= max(tolerance, 1e-6 * max(abs(one), abs(other)))
    return bool(one == other)


def _words(text: object) -> str:
    """A text without the names of logs and without numbers."""
    return re.sub(r"log/\S+|[-+]?\d+(\.\d+)?", "#", str(text))
