"""Parameters put back onto a vehicle bit for bit, in an order that never leaves it with half a geometry."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Final

from bridge.errors import UploadFailed
from bridge.param_operation import Outcome, ParamOperation, ParamValue
from sitl.errors import LinkError
from sitl.param_corrections import companions, corrected

if TYPE_CHECKING:
    from bridge.client import Client

BOOT_S: Final = 25.0
"""Time in which a starting PX4 begins to answer parameters, s: it ignores them until its start scripts have run."""

CORRECTED_S: Final = 1.0
"""Time after which a vehicle has put right what contradicts itself, s: twice what PX4's modules take."""

_ROUNDS: Final = 2
_OUTPUT: Final = re.compile(r"(PWM_(MAIN|AUX)|HIL_ACT|SIM_GZ_EC|UAVCAN_EC)_FUNC\d+\Z")


class StillArmed(LinkError):
    """A vehicle whose parameters cannot be put back because its motors may turn.

    Args:
        peer: its link.
    """

    def __init__(self, peer: str) -> None:
        self.peer = peer
        super().__init__(
            f"{peer}: the vehicle is armed, and nothing is put back onto an armed vehicle (a PX4 takes its outputs' "
            "functions only disarmed). Land and disarm it, then run `froude restore`"
        )


def stages(names: Collection[str]) -> list[list[str]]:
    """Names in the order in which they are put back, those of one stage together.

    Rotors come before their number, so that a vehicle never mixes for rotors it does not know; outputs come after
    the number, because they name rotors. What a vehicle corrects against other parameters comes after those.

    Args:
        names: of parameters.
    """
    late = corrected(names)

    def stage(name: str) -> int:
        if name in late:
            return 4 + late.index(name)
        if name == "CA_ROTOR_COUNT":
            return 1
        if name.startswith("CA_"):
            return 0
        return 2 if _OUTPUT.match(name) else 3

    found: dict[int, list[str]] = {}
    for name in names:
        found.setdefault(stage(name), []).append(name)
    return [found[number] for number in sorted(found)]


def await_parameters(client: Client, name: str, timeout_s: float = BOOT_S) -> None:
    """Wait until a vehicle that may be starting answers parameters at all; whether it does, the next request shows.

    Args:
        client: connected. name: of any parameter. timeout_s: longest wait, s.
    """
    end_us = client.now_us() + round(timeout_s * 1e6)

    def ended(operation: ParamOperation) -> bool:
        for message, fields in client.params.poll(client.now_us()):
            client.send(message, **fields)
        return operation.done

    while client.now_us() < end_us:
        operation = client.params.start_read(name)
        client.wait_until(partial(ended, operation), timeout_s)
        if operation.result is not None and operation.result.outcome is not Outcome.TIMEOUT:
            return


def put_back(client: Client, values: Mapping[str, ParamValue]) -> None:
    """Set parameters to what they were and read every one back, after the vehicle's own corrections, too.

    Args:
        client: connected. values: name -> what it was.

    Raises:
        StillArmed: nothing is sent to an armed vehicle.
        UploadFailed: one did not end up as it was; all others have been tried.
        LinkError: the vehicle went away.
    """
    failed: UploadFailed | None = None
    for _ in range(_ROUNDS):
        failed = None
        for names in stages(values):
            if client.state.armed:
                raise StillArmed(client.link.name)
            try:
                client.upload({name: (values[name].raw, values[name].type) for name in names})
            except UploadFailed as error:
                failed = failed or error
        if failed is None and corrected(values):
            client.wait(CORRECTED_S)
            failed = _difference(client, values)
        if failed is None:
            return
    assert failed is not None
    raise failed


def _difference(client: Client, values: Mapping[str, ParamValue]) -> UploadFailed | None:
    seen = client.read_parameters(values)
    for name, value in values.items():
        if seen[name] != value:
            reason = "the vehicle itself changed it again"
            return UploadFailed(name, value.value, seen[name].value, reason)
    return None


def touched_by(names: Iterable[str]) -> tuple[str, ...]:
    """Names of all that may change when these are set: they, and what a vehicle corrects then."""
    named = tuple(dict.fromkeys(names))
    return (*named, *companions(named))
