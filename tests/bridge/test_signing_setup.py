"""SETUP_SIGNING and MAV_SIGN_CFG: who may set the key of a vehicle, where it is in force, how it is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.connection import Connection
from bridge.key_file import load_key, save_key
from bridge.signing import EPOCH_US, NO_KEY, Signer, SigningKey
from bridge.signing_setup import SAVE_US, SigningSetup
from sitl.modes import Severity

NOW = 350_000_000_000_00
FIRST, SECOND = bytes(range(32)), bytes(range(50, 82))


class Bench:
    """A vehicle's end of three links, the last over USB, and what decides about signing on them."""

    def __init__(self, key: SigningKey = NO_KEY, mode: int = 0, **options: Any) -> None:
        self.links = {number: Connection(1, 1, datagram=True) for number in range(3)}
        self.mode = mode
        self.armed = False
        self.texts: list[str] = []
        self.setup = SigningSetup(
            self.links,
            key,
            mode=lambda: self.mode,
            armed=lambda: self.armed,
            say=self.say,
            usb_links={2},
            **options,
        )

    def say(self, severity: Severity, text: str) -> None:
        self.texts.append(text)

    def follow(self) -> None:
        self.setup.poll(0, 0)

    def sent(self, frame: bytes, link: int = 0) -> int:
        """Deliver a frame; return how many messages the link believed."""
        messages = self.links[link].receive(frame)
        for message in messages:
            if message.name in SigningSetup.HANDLES:
                assert self.setup.handle(message, link, 0) == []
        return len(messages)

    def ask(
        self, secret: bytes, timestamp: int = NOW, *, by: Connection | None = None, link: int = 0, **fields: Any
    ) -> None:
        """Send a SETUP_SIGNING, unsigned unless somebody signs it."""
        target = {"target_system": 1, "target_component": 1, **fields}
        station = by or Connection(255, 190)
        self.sent(station.encode("SETUP_SIGNING", secret_key=secret, initial_timestamp=timestamp, **target), link)


def station(secret: bytes, timestamp: int = NOW + 50) -> Connection:
    return Connection(255, 190, datagram=True, signer=Signer(SigningKey(secret, timestamp), 0))


def plain() -> bytes:
    return Connection(255, 190).encode("HEARTBEAT")


class TestMode:
    def test_without_a_key_nothing_is_signed_and_nothing_refused(self) -> None:
        for mode in (0, 1, 2):
            bench = Bench(mode=mode)
            for number, link in bench.links.items():
                assert link.encode("HEARTBEAT")[2] == 0
                assert bench.sent(plain(), number) == 1

    @pytest.mark.parametrize(
        ("mode", "believed"), [(0, [1, 1, 1]), (1, [0, 0, 1]), (2, [0, 0, 0]), (3, [0, 0, 0]), (-1, [0, 0, 0])]
    )
    def test_says_where_unsigned_messages_are_refused(self, mode: int, believed: list[int]) -> None:
        bench = Bench(SigningKey(FIRST, NOW), mode)
        assert [bench.sent(plain(), number) for number in bench.links] == believed

    @pytest.mark.parametrize("mode", [0, 1, 2])
    def test_with_a_key_every_link_signs_and_refuses_other_keys(self, mode: int) -> None:
        bench = Bench(SigningKey(FIRST, NOW), mode)
        ground = station(FIRST, NOW)
        for number, link in bench.links.items():
            (heard,) = ground.receive(link.encode("HEARTBEAT"))
            assert heard.raw_frame[-13] == number
            assert bench.sent(station(SECOND).encode("HEARTBEAT"), number) == 0

    def test_is_followed_while_it_runs(self) -> None:
        bench = Bench(SigningKey(FIRST, NOW))
        assert bench.sent(plain()) == 1
        bench.mode = 2
        bench.follow()
        assert bench.sent(plain()) == 0
        bench.mode = 0
        bench.follow()
        assert bench.sent(plain()) == 1

    def test_a_change_of_mode_forgets_no_stream(self) -> None:
        bench = Bench(SigningKey(FIRST, NOW))
        frame = station(FIRST).encode("HEARTBEAT")
        assert bench.sent(frame) == 1
        for bench.mode in (1, 2, 0):
            bench.follow()
            assert [bench.sent(frame, number) for number in bench.links] == [0, 0, 0]


class TestSetup:
    @pytest.mark.parametrize("link", [0, 1, 2])
    @pytest.mark.parametrize(("system", "component"), [(1, 1), (0, 1), (1, 0), (0, 0)])
    def test_the_first_key_is_taken_from_any_link(self, tmp_path: Path, link: int, system: int, component: int) -> None:
        bench = Bench(path=tmp_path / "key", mode=2)
        bench.ask(FIRST, link=link, target_system=system, target_component=component)
        assert bench.setup.key == SigningKey(FIRST, NOW)
        assert load_key(tmp_path / "key") == SigningKey(FIRST, NOW)
        assert [bench.sent(plain(), number) for number in bench.links] == [0, 0, 0]
        assert bench.sent(station(FIRST).encode("HEARTBEAT"), 1) == 1
        assert bench.texts == ["MAVLink signing key set"]

    @pytest.mark.parametrize(("system", "component"), [(2, 1), (1, 100), (2, 0), (255, 190)])
    def test_somebody_elses_key_is_not_ours(self, system: int, component: int) -> None:
        bench = Bench()
        bench.ask(FIRST, target_system=system, target_component=component)
        assert bench.setup.key == NO_KEY
        assert bench.setup.refused == 0

    @pytest.mark.parametrize("mode", [0, 1, 2])
    @pytest.mark.parametrize("link", [0, 2])
    def test_a_key_is_only_replaced_by_its_holder(self, tmp_path: Path, mode: int, link: int) -> None:
        path = tmp_path / "key"
        save_key(path, SigningKey(FIRST, NOW))
        bench = Bench(load_key(path), mode, path=path)
        for forger in (None, station(SECOND)):
            bench.ask(SECOND, by=forger, link=link)
            bench.ask(bytes(32), 0, by=forger, link=link)
        assert load_key(path) == SigningKey(FIRST, NOW)
        bench.ask(SECOND, NOW + 9, by=station(FIRST), link=link)
        assert load_key(path) == SigningKey(SECOND, NOW + 9)
        assert bench.sent(station(FIRST, NOW + 99).encode("HEARTBEAT")) == 0
        assert bench.sent(station(SECOND, NOW + 99).encode("HEARTBEAT")) == 1

    def test_a_setup_is_not_believed_twice(self) -> None:
        bench = Bench(SigningKey(FIRST, NOW))
        holder = station(FIRST)
        fields = {"target_system": 1, "target_component": 1, "initial_timestamp": NOW}
        recorded = holder.encode("SETUP_SIGNING", secret_key=SECOND, **fields)
        bench.sent(recorded)
        bench.ask(FIRST, NOW + 2 * 6_000_000, by=station(SECOND))
        assert bench.setup.key.secret == FIRST
        bench.sent(recorded)
        assert bench.setup.key.secret == FIRST

    def test_nothing_changes_while_armed(self) -> None:
        bench = Bench(SigningKey(FIRST, NOW))
        bench.armed = True
        bench.ask(SECOND, by=station(FIRST))
        assert bench.setup.key.secret == FIRST
        assert bench.texts == ["SETUP_SIGNING refused: the vehicle is armed"]
        assert bench.setup.refused == 1

    def test_a_signature_of_before_the_key_counts_for_nothing(self) -> None:
        """Two in one datagram: when the second was unframed there was no key yet that could have refused it."""
        bench = Bench()
        fields = {"target_system": 1, "target_component": 1, "initial_timestamp": NOW}
        both = Connection(255, 190).encode("SETUP_SIGNING", secret_key=FIRST, **fields) + station(SECOND).encode(
            "SETUP_SIGNING", secret_key=SECOND, **fields
        )
        assert bench.sent(both) == 2
        assert bench.setup.key.secret == FIRST
        assert bench.setup.refused == 1

    def test_the_second_copy_that_ground_stations_send_is_harmless(self) -> None:
        bench = Bench()
        bench.ask(FIRST)
        bench.ask(FIRST, NOW + 500)
        assert bench.setup.key == SigningKey(FIRST, NOW)
        assert bench.setup.refused == 0
        assert bench.texts == ["MAVLink signing key set"]

    def test_zeros_clear_the_key(self, tmp_path: Path) -> None:
        path = tmp_path / "key"
        save_key(path, SigningKey(FIRST, NOW))
        bench = Bench(load_key(path), 2, path=path)
        bench.ask(bytes(32), 0, by=station(FIRST))
        assert bench.setup.key == NO_KEY
        assert path.read_bytes() == bytes(40)
        assert [bench.sent(plain(), number) for number in bench.links] == [1, 1, 1]
        assert bench.texts == ["MAVLink signing key cleared"]
        bench.ask(bytes(32), 0)
        assert len(bench.texts) == 1

    def test_a_timestamp_beyond_48_bits_is_refused(self) -> None:
        bench = Bench()
        bench.ask(FIRST, 2**64 - 1)
        assert bench.setup.key == NO_KEY
        assert bench.setup.refused == 1

    def test_a_key_that_cannot_be_kept_is_not_in_force(self, tmp_path: Path) -> None:
        bench = Bench(path=tmp_path / "nowhere" / "key")
        bench.ask(FIRST)
        assert bench.setup.key == NO_KEY
        assert bench.setup.refused == 1
        assert "cannot be written" in bench.texts[0]
        assert bench.sent(plain()) == 1

    def test_time_starts_at_the_latest_that_is_known(self) -> None:
        ahead_us = EPOCH_US + (NOW + 700) * 10
        bench = Bench(utc_us=lambda: ahead_us)
        bench.ask(FIRST)
        assert bench.setup.key.timestamp == NOW + 700
        same = Bench(SigningKey(FIRST, NOW + 900))
        same.ask(FIRST, NOW, by=station(FIRST, NOW + 950))
        assert same.setup.key.timestamp == NOW + 951

    def test_another_key_mends_a_clock_that_was_wrong(self) -> None:
        bench = Bench(SigningKey(FIRST, NOW))
        holder = station(FIRST, NOW + 10**9)
        bench.ask(SECOND, NOW, by=holder)
        assert bench.setup.key.timestamp == NOW
        assert bench.sent(station(SECOND, NOW).encode("HEARTBEAT")) == 1

    @given(
        secret=st.binary(max_size=32),
        timestamp=st.integers(0, 2**64 - 1),
        target=st.tuples(st.integers(0, 255), st.integers(0, 255)),
        mode=st.integers(-1, 3),
        link=st.integers(0, 2),
        signed=st.booleans(),
    )
    def test_nobody_without_the_key_changes_anything(
        self, secret: bytes, timestamp: int, target: tuple[int, int], mode: int, link: int, signed: bool
    ) -> None:
        bench = Bench(SigningKey(FIRST, NOW), mode)
        by = station(SECOND) if signed else None
        bench.ask(secret, timestamp, by=by, link=link, target_system=target[0], target_component=target[1])
        assert bench.setup.key == SigningKey(FIRST, NOW)


class TestKeeping:
    def test_the_timestamp_is_kept_once_a_minute_and_at_the_end(self, tmp_path: Path) -> None:
        path = tmp_path / "key"
        save_key(path, SigningKey(FIRST, NOW))
        bench = Bench(load_key(path), path=path)
        for _ in range(10):
            bench.links[0].encode("HEARTBEAT")
        bench.setup.poll(0, 0)
        bench.setup.poll(1, SAVE_US - 1)
        assert load_key(path).timestamp == NOW
        bench.setup.poll(0, SAVE_US)
        assert load_key(path).timestamp == NOW + 10
        bench.links[1].encode("HEARTBEAT")
        bench.setup.poll(0, SAVE_US + 1)
        bench.setup.forget(0)
        assert load_key(path).timestamp == NOW + 10
        bench.setup.save()
        assert load_key(path).timestamp == NOW + 11

    def test_a_file_that_somebody_opened_is_said_and_flown_on(self, tmp_path: Path) -> None:
        path = tmp_path / "key"
        save_key(path, SigningKey(FIRST, NOW))
        bench = Bench(load_key(path), path=path)
        path.chmod(0o644)
        bench.setup.poll(0, 0)
        assert bench.setup.poll(0, SAVE_US) == []
        assert "mode 0644" in bench.texts[0]

    def test_no_key_makes_no_file(self, tmp_path: Path) -> None:
        bench = Bench(path=tmp_path / "key")
        bench.setup.save()
        assert list(tmp_path.iterdir()) == []
