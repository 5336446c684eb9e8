"""What the ground asks of a vehicle's parameters, a set, a read or the whole list, until it has an outcome.

These are the states `bridge.param_client` drives; a caller looks at `done` and at the result.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Final

from bridge.param_protocol import Outgoing
from sitl.parameters import ParameterType, from_raw

TIMEOUT_US: Final = 500_000
"""Time an answer may take before the request is sent again, us of vehicle time."""

SILENT_TRIES: Final = 5
"""Sends after which a vehicle that answered nothing at all is given up."""

LIST_ROUNDS: Final = 15
"""Rounds in a row that bring no new value, after which a list that began to come is given up."""

LIST_AGAIN: Final = 40
"""More missing values than this are asked for by a new list, fewer one by one."""


class Outcome(enum.Enum):
    """How an operation ended."""

    VERIFIED = "verified"
    REFUSED = "refused"
    TIMEOUT = "timeout"
    MISMATCH = "mismatch"


@dataclass(frozen=True, slots=True)
class ParamValue:
    """A value with its type; two are equal only if type and bits are."""

    type: ParameterType
    raw: bytes
    """Four bytes, little-endian."""

    @property
    def value(self) -> int | float:
        """As a Python number; a REAL32 gives a float that is exactly a float32."""
        return from_raw(self.type, self.raw)

    def __str__(self) -> str:
        return f"{self.value:.9g}" if self.type == "REAL32" else str(self.value)


@dataclass(frozen=True, slots=True)
class ParamResult:
    """What became of one parameter."""

    name: str
    outcome: Outcome
    wanted: ParamValue | None
    """None for a read."""
    seen: ParamValue | None
    """Last value the vehicle stated since the operation began, None if it stated none."""
    reason: str
    """Why it is not VERIFIED; empty if it is."""
    tries: int
    """Requests sent."""


class ParamOperation:
    """A set or a read of one parameter; `result` is None until it is `done`.

    Args:
        name: the parameter.
        wanted: what to set, None to read.
        read_back: after the echo, ask once more before it counts.
    """

    __slots__ = (
        "contrary",
        "deadline_us",
        "differed",
        "name",
        "read_back",
        "reading",
        "result",
        "seen",
        "started_us",
        "tries",
        "trust_us",
        "wanted",
    )

    def __init__(self, name: str, wanted: ParamValue | None, read_back: bool = False) -> None:
        self.name = name
        self.wanted = wanted
        self.read_back = read_back
        self.reading = wanted is None  # asking for the value, not setting it
        self.result: ParamResult | None = None
        self.seen: ParamValue | None = None
        self.tries = 0
        self.differed = False  # a different value came since the last send
        self.contrary = 0  # sends that a different value followed
        self.started_us = 0
        self.deadline_us = 0
        self.trust_us = 0  # before this an answer may be an older one's

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self.result is not None

    def end(self, outcome: Outcome, reason: str = "") -> None:
        """Set the result."""
        self.result = ParamResult(self.name, outcome, self.wanted, self.seen, reason, self.tries)


class ParamList:
    """A reading of every parameter: the list once, then whatever of it was lost.

    Args:
        target_system: the vehicle.
        target_component: its component.
        window: missing values asked for at once.

    Attributes:
        values: what has come so far, by name; complete only if the outcome is VERIFIED.
        count: how many the vehicle says it has, None before its first answer.
        outcome: VERIFIED or TIMEOUT, None while under way.
        reason: why it is not VERIFIED.
    """

    def __init__(self, target_system: int, target_component: int, *, window: int = 10) -> None:
        self.values: dict[str, ParamValue] = {}
        self.count: int | None = None
        self.outcome: Outcome | None = None
        self.reason = ""
        self._target = {"target_system": target_system, "target_component": target_component}
        self._window = window
        self._names: dict[int, str] = {}  # by index
        self._asked: set[int] = set()
        self._fruitless = 0
        self._due_us = 0

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self.outcome is not None

    @property
    def missing(self) -> list[int]:
        """Indices that have not come yet, in order."""
        return [index for index in range(self.count or 0) if index not in self._names]

    def end(self, outcome: Outcome, reason: str = "") -> None:
        """Set the outcome."""
        self.outcome = outcome
        self.reason = reason

    def heard(self, index: int | None, name: str, value: ParamValue | None, count: int, now_us: int) -> None:
        """Take one PARAM_VALUE.

        Args:
            index: place in the list, None for what has none (`_HASH_CHECK`).
            name: the parameter.
            value: its value, None with `index` None.
            count: number of parameters the vehicle has.
            now_us: vehicle time, us.
        """
        if self.done:
            return
        if count != self.count:  # the first answer, or the list changed and its indices mean nothing any more
            known = self.count is not None
            self._restart(count, now_us if known else now_us + TIMEOUT_US)
        if index is None or value is None or index >= count:
            return
        self.values[name] = value
        if self._names.get(index) != name:
            self._names[index] = name
            self._fruitless = 0
            closing_gaps = bool(self._asked)
            self._asked.discard(index)
            if not closing_gaps:
                self._due_us = now_us + TIMEOUT_US
            elif not self._asked:
                self._due_us = now_us
        if len(self._names) == count:
            if len(set(self._names.values())) == count == len(self.values):
                self.end(Outcome.VERIFIED)
            else:  # a name under two indices: the order changed on the way
                self._restart(count, now_us)

    def poll(self, now_us: int) -> list[Outgoing]:
        """Requests to send now, because it begins or because nothing came for a while."""
        if self.done or now_us < self._due_us:
            return []
        missing = self.missing
        if self._fruitless >= (SILENT_TRIES if self.count is None else LIST_ROUNDS):
            self._give_up(missing)
            return []
        self._fruitless += 1
        self._due_us = now_us + TIMEOUT_US
        if self.count is None or not self._names or len(missing) > LIST_AGAIN:
            self._asked.clear()
            return [("PARAM_REQUEST_LIST", dict(self._target))]
        self._asked = set(missing[: self._window])
        return [
            ("PARAM_REQUEST_READ", {**self._target, "param_id": "", "param_index": index})
            for index in sorted(self._asked)
        ]

    def _restart(self, count: int, due_us: int) -> None:
        self.count = count
        self.values.clear()
        self._names.clear()
        self._asked.clear()
        self._due_us = due_us

    def _give_up(self, missing: list[int]) -> None:
        seconds = self._fruitless * TIMEOUT_US / 1e6
        if self.count is None:
            self.end(Outcome.TIMEOUT, f"no answer to {self._fruitless} list requests in {seconds:g} s")
        else:
            rest = f"{len(missing)} of {self.count} parameters are missing (first index {missing[0]})"
            self.end(Outcome.TIMEOUT, f"{rest}, nothing new for {seconds:g} s")
