"""What can go wrong on the wire, by who has to act.

FroudeError
 +-- UsageError
 |    +-- LinkUrlError     the address cannot be read
 |    +-- FieldError       a message was asked to carry a field it cannot (also a ValueError)
 +-- LinkError             exit status 3
      +-- PortBusy         somebody else listens there
      +-- PeerSilent       nobody answered in time
      +-- PeerLost         the peer was there and went away
      +-- LinkClosed       we closed the link and used it again
      +-- NotReady         the vehicle answers but will not become ready
      +-- AlreadyArmed     somebody is flying it
      +-- CommandRefused   the vehicle said no
      +-- UploadFailed     a parameter did not end up as asked
      +-- BoardStopped     a board's real-time simulation could not be kept up
      +-- HilUnfit         an autopilot that cannot fly our plant as it is set up

Each keeps what it names as attributes, so a runner can record a refusal as a result instead of parsing text.
"""

from __future__ import annotations

from collections.abc import Sequence

from sitl.errors import LinkError, UsageError

_RESULTS = {
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "still in progress",
    6: "cancelled",
}


class LinkUrlError(UsageError):
    """A link address that cannot be read.

    Args:
        url: the address as given.
        problem: what is wrong with it.
        remedy: how to write it.
    """

    def __init__(self, url: str, problem: str, remedy: str) -> None:
        self.url = url
        super().__init__(f"link {url!r}: {problem}. {remedy}")


class FieldError(UsageError, ValueError):
    """A value that does not fit the message field it was meant for.

    Args:
        message: MAVLink message name.
        field: field name.
        value: the value seen.
        problem: why it does not fit.
    """

    def __init__(self, message: str, field: str, value: object, problem: str) -> None:
        self.message = message
        self.field = field
        self.value = value
        super().__init__(f"{message}.{field} = {value!r}: {problem}")


class PortBusy(LinkError):
    """A local port that another program holds.

    Args:
        host: local address.
        port: local port.
    """

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self.port = port
        super().__init__(
            f"{host}:{port} is in use by another program (an earlier run, a simulator or a ground station). "
            "Stop it, or choose another port or --instance"
        )


class PeerSilent(LinkError):
    """A peer that never answered.

    Args:
        peer: the address or system that was asked.
        waited_s: how long it was given, in seconds.
        awaited: what was expected of it, for example "a HEARTBEAT".
        remedy: what to check next.
    """

    def __init__(self, peer: str, waited_s: float, awaited: str, remedy: str = "") -> None:
        self.peer = peer
        self.waited_s = waited_s
        self.awaited = awaited
        super().__init__(f"{peer}: no sign of {awaited} within {waited_s:g} s" + (f". {remedy}" if remedy else ""))


class PeerLost(LinkError):
    """A peer that was there and went away.

    Args:
        peer: its address or system.
        why: what was seen.
    """

    def __init__(self, peer: str, why: str) -> None:
        self.peer = peer
        self.why = why
        super().__init__(f"{peer} went away: {why}")


class LinkClosed(LinkError):
    """A link that was used after it was closed.

    Args:
        link: the link's name.
    """

    def __init__(self, link: str) -> None:
        self.link = link
        super().__init__(f"{link} is closed; open it again before using it")


class NotReady(LinkError):
    """A vehicle that answers but does not become ready to fly.

    Args:
        peer: its address or system.
        waited_s: how long it was given, in seconds.
        missing: what it still lacks, for example ("home position",).
    """

    def __init__(self, peer: str, waited_s: float, missing: Sequence[str]) -> None:
        self.peer = peer
        self.waited_s = waited_s
        self.missing = tuple(missing)
        super().__init__(f"{peer} is not ready after {waited_s:g} s; still missing: {', '.join(self.missing)}")


class AlreadyArmed(LinkError):
    """A vehicle that is armed before we have touched it: no gains are changed under somebody's hands.

    Args:
        peer: its address or system.
    """

    def __init__(self, peer: str) -> None:
        self.peer = peer
        super().__init__(f"{peer}: the vehicle is armed already. Land and disarm it, then fly again")


class CommandRefused(LinkError):
    """A command the vehicle answered with anything but ACCEPTED.

    Args:
        command: its name, for example "arm".
        result: MAV_RESULT as a number.
        reason: what the vehicle said about it (its last STATUSTEXT), empty when it said nothing.
    """

    def __init__(self, command: str, result: int, reason: str = "") -> None:
        self.command = command
        self.result = result
        self.reason = reason
        verdict = _RESULTS.get(result, f"MAV_RESULT {result}")
        super().__init__(f"{command}: {verdict} by the vehicle" + (f": {reason}" if reason else ""))


class UploadFailed(LinkError):
    """A parameter that did not end up as asked.

    Args:
        parameter: its name.
        wanted: the value that was sent.
        seen: the value read back, None when nothing came back.
        reason: what happened, for example "PARAM_ERROR 1 (does not exist)".
    """

    def __init__(self, parameter: str, wanted: float | int, seen: float | int | None, reason: str) -> None:
        self.parameter = parameter
        self.wanted = wanted
        self.seen = seen
        self.reason = reason
        read_back = "nothing came back" if seen is None else f"the vehicle holds {seen!r}"
        super().__init__(f"{parameter} = {wanted!r} was not taken: {reason} ({read_back})")


class BoardStopped(LinkError):
    """The simulation of a board's sensors came to a stop, so the flight is over.

    Args:
        link: the board's.
        why: what was seen.
    """

    def __init__(self, link: str, why: str) -> None:
        self.link = link
        self.why = why
        super().__init__(
            f"{link}: {why}; the flight is stopped, its result is worthless. Close other programs, or use a quicker "
            "computer"
        )


class HilUnfit(LinkError):
    """An autopilot that cannot fly our plant as it is set up.

    Args:
        peer: its link.
        findings: what is wrong and what to do, a sentence each.
    """

    def __init__(self, peer: str, findings: Sequence[str]) -> None:
        self.peer = peer
        self.findings = tuple(findings)
        super().__init__(f"{peer}: " + " ".join(findings))
