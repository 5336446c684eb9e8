"""Sends a vehicle what nobody should send it, for as long as it is let.

    python tests/bench/fuzz_vehicle.py --seconds 60 --seed 1

Two kinds of rounds take turns, both in vehicle time and as fast as it goes:

- **anything**: every message with senseless fields, recorded requests and their wreckage, to a new vehicle each round,
  on the ground or in the air, over datagrams or streams. Nothing may raise, the counters must add up, and it answers.
- **quiet**: what is damaged, meant for others or only asks, to one vehicle that hovers all along. Its state, its place
  and the memory of this process must not change either.

Prints counters and memory now and then. Exit status 1 if there was a finding; each one is printed with its round's seed
and the last bytes that came, and `--round SEED` plays that round again.
"""

from __future__ import annotations

import argparse
import gc
import math
import random
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

from hostile import KEY, Forge, capture_frames, captures, cut_up, damaged, mutate  # noqa: E402
from hostile_vehicle import Watched, weight  # noqa: E402

from bridge.connection import Connection  # noqa: E402
from bridge.fleet_status import FleetStatus, vehicle_status  # noqa: E402
from bridge.messages import BY_ID, BY_NAME  # noqa: E402
from bridge.signing import Signer  # noqa: E402

FRAMES = 2000
"""Frames of a round."""

MOST_GROWTH = 300_000
"""Bytes that the vehicle of the quiet rounds may come to weigh more, the vehicle's own histories included."""

MOST_RSS_GROWTH = 64 << 20
REPORT_S = 10.0
_QUIET = ("PARAM_REQUEST_READ", "MISSION_REQUEST_LIST", "LOG_REQUEST_LIST", "TIMESYNC", "PING", "REQUEST_EVENT")
_ASKING = (410, 512, 519, 520, 528)


class Finding(Exception):
    """Something that must not happen."""


class Fuzzer:
    """Runs rounds and counts.

    Args:
        seed: of the first round.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.frames = self.rounds = 0
        self.findings: Counter[str] = Counter()
        self._last: deque[bytes] = deque(maxlen=3)
        self._pool = capture_frames()
        self._hoverer: Watched | None = None
        self._weight = 0
        targeted = ("target_system", "target")
        self._untargeted = [
            kind
            for kind in BY_ID.values()
            if kind.name != "HEARTBEAT" and not any(field.name in targeted for field in kind.fields)
        ]
        self._targeted = [kind for kind in BY_ID.values() if any(field.name in targeted for field in kind.fields)]
        self._asking = [
            Connection(255, 190).encode_fields(name, fields)
            for name, fields in captures()
            if name in _QUIET or (name == "COMMAND_LONG" and fields.get("command") in _ASKING)
        ]

    def round(self, seed: int) -> None:
        """Play one round; what goes wrong is printed and counted."""
        self.rounds += 1
        try:
            if seed % 4:
                self._anything(seed)
            else:
                self._quiet(seed)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            self.findings[what] += 1
            if self.findings[what] == 1:
                print(f"FINDING in round {seed}: {what}\n{traceback.format_exc()}")
                for data in self._last:
                    print(f"  came: {data[:300].hex()}")
            self._hoverer = None

    def line(self) -> str:
        """Return what happened so far."""
        hoverer = self._hoverer
        status = (
            "" if hoverer is None else FleetStatus(0.0, 1.0, None, (vehicle_status(hoverer.server),)).line().strip()
        )
        return f"{self.rounds} rounds, {self.frames} frames, {sum(self.findings.values())} findings; hovering: {status}"

    def _put(self, watched: Watched, data: bytes, link: int) -> None:
        self._last.append(data)
        self.frames += 1
        watched.put(data, link)

    def _anything(self, seed: int) -> None:
        rng = random.Random(seed)
        forge = Forge(seed, signer=Signer(KEY, 3))
        stream = rng.random() < 0.3
        watched = Watched(datagram=not stream)
        if rng.random() < 0.5:
            watched.hover(rng.uniform(3.0, 30.0))
        else:
            watched.run(rng.uniform(0.0, 5.0))
        for _ in range(FRAMES):
            data = self._any(rng, forge)
            pieces = cut_up(rng, data) if stream else [data]
            link = rng.randrange(2)
            for piece in pieces:
                self._put(watched, piece, link)
            if rng.random() < 0.1:
                watched.tick(rng.choice((1, 1, 1, 2, 25)))
        watched.tick(30)
        for link in (0, 1):
            if stream:
                for _ in range(20):
                    watched.send("HEARTBEAT", link, type=6)
                watched.tick()
            self._check(watched, link)

    def _any(self, rng: random.Random, forge: Forge) -> bytes:
        dice = rng.random()
        if dice < 0.35:
            return forge.frame()
        if dice < 0.55:
            return forge.frame(BY_NAME[rng.choice(captures())[0]])
        if dice < 0.7:
            return rng.choice(self._pool)
        if dice < 0.72:
            return b"".join(rng.choice(self._pool) for _ in range(rng.randint(2, 200)))
        return mutate(rng, rng.choice(self._pool), self._pool)

    def _quiet(self, seed: int) -> None:
        rng = random.Random(seed)
        forge = Forge(seed)
        if self._hoverer is None:
            self._hoverer = Watched().hover()
            self._weight = 0
        watched = self._hoverer
        before, place = watched.state(), watched.vehicle.truth.position_ned()
        for k in range(FRAMES):
            dice = rng.random()
            if dice < 0.4:
                data = damaged(rng, rng.choice(self._pool))
            elif dice < 0.6:
                data = forge.frame(rng.choice(self._untargeted), whole=True)
            elif dice < 0.8:
                data = forge.frame(rng.choice(self._targeted), whole=True, target_system=2, target=2)
            else:
                data = rng.choice(self._asking)
            self._put(watched, data, rng.randrange(2))
            if k % 3 == 0:
                watched.tick()
            if k % 300 == 0:
                for link in (0, 1):
                    watched.send("HEARTBEAT", link, type=6, autopilot=8)
        watched.tick(20)
        after = watched.state()
        for key, value in before.items():
            if after[key] != value:
                raise Finding(f"{key} changed in a quiet round")
        if math.dist(place, watched.vehicle.truth.position_ned()) > 1.0:
            raise Finding("the vehicle left its place in a quiet round")
        for link in (0, 1):
            self._check(watched, link)
        weighs = weight(watched.server)
        if self._weight and weighs > self._weight + MOST_GROWTH:
            raise Finding("the vehicle of the quiet rounds grows")
        self._weight = self._weight or weighs

    def _check(self, watched: Watched, link: int) -> None:
        if not watched.adds_up(link):
            raise Finding("the counters do not add up")
        if not watched.answers(link):
            raise Finding("the vehicle does not answer any more")


def resident_bytes() -> int:
    """Memory of this process, what waits for the collector left out."""
    gc.collect()
    status = Path("/proc/self/status")
    if not status.exists():
        return 0
    (line,) = (line for line in status.read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


def main(words: Sequence[str] | None = None) -> int:
    """Fuzz as asked for; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (60)")
    parser.add_argument("--seed", type=int, default=1, help="where chance begins (1)")
    parser.add_argument("--round", type=int, metavar="SEED", help="play one round again")
    asked = parser.parse_args(words)
    if asked.round is not None:
        fuzzer = Fuzzer(asked.round)
        fuzzer.round(asked.round)
        return bool(fuzzer.findings)
    fuzzer = Fuzzer(asked.seed)
    begin = told = time.monotonic()
    number = asked.seed * 1_000_000
    warm_bytes = 0
    while time.monotonic() - begin < asked.seconds:
        fuzzer.round(number)
        number += 1
        if not warm_bytes and time.monotonic() - begin > min(20.0, asked.seconds / 3):
            warm_bytes = resident_bytes()
        if time.monotonic() - told > REPORT_S:
            told = time.monotonic()
            print(f"{told - begin:6.0f} s  {resident_bytes() >> 20} MiB  {fuzzer.line()}", flush=True)
    grown = resident_bytes() - warm_bytes if warm_bytes else 0
    print(f"{fuzzer.line()}\nmemory: {resident_bytes() >> 20} MiB, {grown / (1 << 20):+.1f} MiB since it was warm")
    if grown > MOST_RSS_GROWTH:
        print("FINDING: the process grows")
        return 1
    return bool(fuzzer.findings)


if __name__ == "__main__":
    sys.exit(main())
