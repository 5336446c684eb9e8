"""The key of one vehicle: where it is in force, how it is set over the wire, kept in its file.

What PX4 does (mavlink_sign_control.cpp, docs.px4.io "MAVLink Message Signing"), where its versions differ the
stricter:

- with a key, every link signs what it sends, whatever MAV_SIGN_CFG says, so that a ground station that has just set
  the key goes on hearing its vehicle;
- MAV_SIGN_CFG says where messages without a signature are refused: 0 nowhere, 1 on links that are no USB, 2 anywhere;
- without a key nothing is signed and nothing refused;
- SETUP_SIGNING sets the key of all links while disarmed, on any link; once there is a key only signed with it. A key
  of zeros with timestamp 0 clears it. It is in force when it is in its file, or not at all. There is no answer.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Final

from bridge.connection import Connection
from bridge.key_file import save_key, save_timestamp
from bridge.signing import LATEST, NO_KEY, Signer, SigningKey, Timestamps, to_timestamp
from sitl.errors import FileError
from sitl.modes import Severity

SAVE_US = 60_000_000
"""How often the key file's timestamp is brought up to date, in vehicle time: MAVLink asks for once a minute."""

_OFF, _NOT_USB = 0, 1


class SigningSetup:
    """Signing on all links of one vehicle.

    Args:
        connections: those of the vehicle's links, by link id; they get their signers at once.
        key: what `load_key` returned, or NO_KEY.
        system_id: own system.
        component_id: own component.
        mode: tells MAV_SIGN_CFG; a change is followed at the next `poll`.
        armed: whether the vehicle is armed.
        say: says something to every ground station; with a limit, for anybody can bring it about.
        utc_us: tells microseconds since 1970 UTC, 0 while unknown.
        path: the key file; None: a key set over the wire is lost at the end.
        usb_links: ids of the links over USB.

    Attributes:
        refused: SETUP_SIGNING messages for us that did not set the key.
    """

    HANDLES: Final = ("SETUP_SIGNING",)

    def __init__(
        self,
        connections: Mapping[int, Connection],
        key: SigningKey = NO_KEY,
        *,
        system_id: int = 1,
        component_id: int = 1,
        mode: Callable[[], int],
        armed: Callable[[], bool],
        say: Callable[[Severity, str], object],
        utc_us: Callable[[], int] | None = None,
        path: Path | None = None,
        usb_links: Collection[int] = (),
    ) -> None:
        self.refused = 0
        self._connections = connections
        self._ids = (system_id, component_id)
        self._read_mode, self._armed, self._say, self._utc_us = mode, armed, say, utc_us
        self._path = path
        self._usb_links = frozenset(usb_links)
        self._save_us: int | None = None
        self._key = key
        self._timestamps = Timestamps(key.timestamp, utc_us)
        self._mode = mode()
        self._apply()

    @property
    def key(self) -> SigningKey:
        """The key with the newest timestamp, as it belongs into its file; NO_KEY where there is none."""
        return SigningKey(self._key.secret, self._timestamps.newest) if self._key.initialised else NO_KEY

    def handle(self, msg: Any, link_id: int, now_us: int) -> list[tuple[str, dict[str, Any]]]:
        """Set the key as a SETUP_SIGNING says, or refuse it; always in silence on the wire but for a text."""
        if msg.target_system not in (0, self._ids[0]) or msg.target_component not in (0, self._ids[1]):
            return []
        # That it is new was verified by its link's signer on the way in: with a key all links have one. The signature
        # is looked at again because the key may have come into force between this message and the one before.
        if self._key.initialised and not (msg.signed and self._key.made(msg.raw_frame)):
            # Ground stations send it twice because nothing answers; the second one may come unsigned.
            if not self._key.same_secret(SigningKey(msg.secret_key)):
                self._refuse("not signed with the present key")
            return []
        if msg.initial_timestamp > LATEST:
            self._refuse(f"timestamp {msg.initial_timestamp} does not fit 48 bits")
        elif self._armed():
            self._refuse("the vehicle is armed")
        else:
            self._set(SigningKey(msg.secret_key, msg.initial_timestamp))
        return []

    def poll(self, link_id: int, now_us: int) -> list[tuple[str, dict[str, Any]]]:
        """Follow MAV_SIGN_CFG, and keep the timestamp once a minute; nothing is ever due on the wire."""
        mode = self._read_mode()
        if mode != self._mode:
            self._mode = mode
            self._apply()
        if self._save_us is None:
            self._save_us = now_us + SAVE_US
        elif now_us >= self._save_us:
            self._save_us = now_us + SAVE_US
            try:
                self.save()
            except FileError as error:
                self._say(Severity.WARNING, f"Signing timestamp not kept: {error.problem}")
        return []

    def forget(self, link_id: int) -> None:
        """Nothing: what a peer that went away has signed must not be believed again."""

    def save(self) -> None:
        """Keep the newest timestamp in the key file; the last thing to do before the program ends.

        Raises:
            FileError: the file cannot be written, or is no longer for its owner only.
        """
        if self._path is not None and self._key.initialised:
            save_timestamp(self._path, self.key)

    def _set(self, asked: SigningKey) -> None:
        """Put a key into its file, then into force."""
        key = asked
        if key.initialised:
            # The same key goes on where it is; for another one time may start earlier, which mends a wrong clock.
            same = self._key.initialised and key.same_secret(self._key)
            now = 0 if self._utc_us is None else to_timestamp(self._utc_us())
            key = SigningKey(key.secret, max(key.timestamp, now, self._timestamps.newest if same else 0))
        elif not self._key.initialised:
            return
        if self._path is not None:
            try:
                save_key(self._path, key)
            except FileError as error:
                self._refuse(error.problem)
                return
        if key.initialised and key.same_secret(self._key):
            self._timestamps.newest = key.timestamp
        else:
            self._timestamps = Timestamps(key.timestamp, self._utc_us)
        self._key = key
        self._apply()
        self._say(Severity.NOTICE, "MAVLink signing key " + ("set" if key.initialised else "cleared"))

    def _apply(self) -> None:
        """Give every link the signer that the key and MAV_SIGN_CFG ask for."""
        for link_id, connection in self._connections.items():
            if not self._key.initialised:
                connection.signer = None
                continue
            require = self._mode != _OFF and not (self._mode == _NOT_USB and link_id in self._usb_links)
            connection.signer = Signer(self._key, link_id, require=require, timestamps=self._timestamps)

    def _refuse(self, reason: str) -> None:
        self.refused += 1
        self._say(Severity.WARNING, f"SETUP_SIGNING refused: {reason}")
