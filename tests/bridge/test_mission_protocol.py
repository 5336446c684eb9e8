"""The vehicle's side of the mission protocol, against what a real PX4 answered."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from bridge.connection import Connection
from bridge.mission_progress import MissionProgress
from bridge.mission_protocol import CANCELLED, MissionServer
from bridge.plan_store import MOST_ITEMS, PlanStore
from sitl.modes import Severity

GCS, API = 0, 1
PEERS = {GCS: (255, 190), API: (245, 190)}
TICK_US = 4_000
NAN = math.nan
FENCE_WARNING = "Geofence stored, not enforced by this vehicle"
CASES = [
    case
    for line in (Path(__file__).parents[1] / "data" / "px4_answers.jsonl").read_text().splitlines()
    if (case := json.loads(line))["family"] == "mission"
]


class Ground:
    """Ground stations on two links, over real frames; keeps every answer with its time."""

    def __init__(self, **kwargs: Any) -> None:
        self.missions: list[tuple[int, int]] = []
        self.store = PlanStore(lambda items, opaque_id: self.missions.append((len(items), opaque_id)))
        self.texts: list[tuple[Severity, str]] = []
        self.server = MissionServer(self.store, say=self._say, **kwargs)
        self.now_us = 1_000_000
        self.heard: list[tuple[int, int, str, dict[str, Any]]] = []
        self.auto: list[dict[str, Any]] = []
        self._up = {link: Connection(*peer) for link, peer in PEERS.items()}
        self._up_rx = Connection(1, 1)
        self._down = Connection(1, 1)
        self._down_rx = Connection(255, 190)

    def send(self, name: str, link: int = GCS, peer: tuple[int, int] | None = None, **fields: Any) -> None:
        up = Connection(*peer) if peer else self._up[link]
        fields = {"target_system": 1, "target_component": 1, **fields}
        for message in self._up_rx.receive(up.encode(name, **fields)):
            self._keep(link, self.server.handle(message, link, self.now_us))

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / TICK_US)):
            for link in (GCS, API):
                self._keep(link, self.server.poll(link, self.now_us))
            self.now_us += TICK_US

    def ask(self, name: str, seconds: float = 0.1, **kwargs: Any) -> list[tuple[str, dict[str, Any]]]:
        """What is heard on the link after a message, texts included."""
        start = len(self.heard)
        self.send(name, **kwargs)
        self.wait(seconds)
        link = kwargs.get("link", GCS)
        return [(name, fields) for _, on, name, fields in self.heard[start:] if on == link]

    def _say(self, severity: Severity, text: str) -> None:
        self.texts.append((severity, text))
        for link in PEERS:
            self.heard.append((self.now_us, link, "STATUSTEXT", {"severity": int(severity), "text": text}))

    def _keep(self, link: int, out: list[tuple[str, dict[str, Any]]]) -> None:
        for name, fields in out:
            for message in self._down_rx.receive(self._down.encode(name, **fields)):
                self.heard.append((self.now_us, link, message.name, message.fields()))
                for rule in self.auto if link == GCS else ():
                    when = rule["when"]
                    if when["name"] == name and all(fields[key] == value for key, value in when["fields"].items()):
                        for one in rule["send"]:
                            self.send(one["name"], link, **recorded(one["fields"]))


def recorded(fields: dict[str, Any]) -> dict[str, Any]:
    return {key: NAN if value == "NaN" else value for key, value in fields.items()}


def item(seq: int, **fields: Any) -> dict[str, Any]:
    """A waypoint of the recorded missions."""
    place = {"x": 473977420, "y": 85455940, "z": 10.0}
    return {"seq": seq, "frame": 6, "command": 16, "autocontinue": 1, "param4": NAN, **place, **fields}


def as_json(value: Any) -> Any:
    """A field as the recorded answers write it."""
    if isinstance(value, float):
        return "NaN" if math.isnan(value) else float(f"{value:.7g}")
    return value


def play(ground: Ground, steps: list[dict[str, Any]]) -> None:
    for step in steps:
        for one in step.get("send", ()):
            ground.send(one["name"], API if step.get("link") == "api" else GCS, **recorded(one["fields"]))
        ground.wait(step.get("wait", 0.0))


def key_of(name: str, fields: dict[str, Any], left_out: list[str]) -> str:
    compared = {key: as_json(value) for key, value in fields.items() if key not in left_out}
    return name + json.dumps(compared, sort_keys=True)


@pytest.fixture(scope="module")
def flown() -> dict[str, tuple[list[tuple[int, int, str, dict[str, Any]]], int]]:
    """Every recorded case, in the order of the recording on one vehicle: answers differ after other cases."""
    answers = {}
    ground = Ground(progress=lambda: MissionProgress(ground.store.current, -1, False, False))
    for case in CASES:
        play(ground, case.get("setup", []))
        start, began_us = len(ground.heard), ground.now_us
        ground.auto = case.get("auto", [])
        play(ground, case["steps"])
        answers[case["id"]] = (ground.heard[start:], began_us)
        ground.auto = []
        play(ground, case.get("teardown", []))
    return answers


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["id"])
def test_answers_as_recorded_from_a_px4(case: dict[str, Any], flown: dict[str, Any]) -> None:
    heard, began_us = flown[case["id"]]
    watched = case.get("watch_last", [])
    ours: Counter[str] = Counter()
    times: dict[str, float] = {}
    last: dict[str, str] = {}
    for time_us, link, name, fields in heard:
        if link != GCS or fields.get("text") == FENCE_WARNING:
            continue
        key = key_of(name, fields, ["id", "chunk_seq"])
        if name in watched:
            last[name] = key
        elif name != "MISSION_CURRENT":
            ours[key] += 1
            times.setdefault(key, (time_us - began_us) / 1e6)
    theirs: Counter[str] = Counter()
    loose = set()
    for answer in case["answers"]:
        key = key_of(answer["name"], answer["fields"], ["id", "chunk_seq"])
        if answer.get("last"):
            assert last[answer["name"]] == key
            continue
        theirs[key] += answer.get("count", 1)
        if case.get("timeline"):
            assert times[key] == pytest.approx(answer["t"], abs=0.7)
        if case.get("loose_count") or "count_other" in answer:
            loose.add(key)
    assert set(ours) == set(theirs)
    assert {key: count for key, count in ours.items() if key not in loose} == {
        key: count for key, count in theirs.items() if key not in loose
    }


def test_a_fence_is_kept_but_said_not_to_be_enforced(flown: dict[str, Any]) -> None:
    said = {case for case, (heard, _) in flown.items() if any(f.get("text") == FENCE_WARNING for *_, f in heard)}
    assert said == {"mission-fence-upload", "mission-fence-bad"}


def upload(ground: Ground, items: list[dict[str, Any]], kind: int = 0, name: str = "MISSION_ITEM_INT") -> Any:
    ground.send("MISSION_COUNT", count=len(items), mission_type=kind)
    answers: list[tuple[str, dict[str, Any]]] = []
    for one in items:
        answers = ground.ask(name, mission_type=kind, **one)
    return answers[-1]


def download(ground: Ground, kind: int = 0, name: str = "MISSION_REQUEST_INT") -> list[dict[str, Any]]:
    [(_, count)] = ground.ask("MISSION_REQUEST_LIST", mission_type=kind)
    got = [ground.ask(name, seq=seq, mission_type=kind)[0][1] for seq in range(count["count"])]
    ground.send("MISSION_ACK", mission_type=kind)
    return got


def test_upload_silence_is_asked_every_quarter_second_and_ends_after_five() -> None:
    ground = Ground()
    ground.send("MISSION_COUNT", count=2)
    ground.wait(6.0)
    requests = [time_us for time_us, _, name, _ in ground.heard if name == "MISSION_REQUEST_INT"]
    assert len(requests) == 20
    assert {later - sooner for sooner, later in itertools.pairwise(requests)} <= {248_000, 252_000}
    assert ground.texts == [(Severity.CRITICAL, "Mission sync timeout\t")]
    assert ground.ask("MISSION_COUNT", count=2)[0][0] == "MISSION_REQUEST_INT"


@pytest.mark.parametrize(
    ("name", "fields", "text", "acknowledged"),
    [
        ("MISSION_COUNT", {"count": 2}, "WPM: IGN MISSION_COUNT: Busy\t", True),
        ("MISSION_ITEM_INT", item(0), "IGN MISSION_ITEM: Busy\t", True),
        ("MISSION_CLEAR_ALL", {}, "WPM: IGN CLEAR CMD: Busy\t", False),
        ("MISSION_SET_CURRENT", {"seq": 0}, "WPM: IGN WP CURR CMD: Busy\t", False),
        ("MISSION_REQUEST_LIST", {"mission_type": 1}, "Mission download request ignored, already active\t", False),
    ],
)
def test_an_open_list_keeps_the_link_busy_for_five_seconds(
    name: str, fields: dict[str, Any], text: str, acknowledged: bool
) -> None:
    ground = Ground()
    upload(ground, [item(0), item(1)])
    ground.send("MISSION_REQUEST_LIST")
    answers = ground.ask(name, **fields)
    assert ground.texts[-1][1] == text
    assert [(one, fields["type"]) for one, fields in answers if one == "MISSION_ACK"] == [
        ("MISSION_ACK", 1)
    ] * acknowledged
    assert ground.server.refused == 1
    ground.wait(5.1)
    assert ground.texts[-1][1] == "Mission sync timeout\t"
    ground.send("MISSION_CLEAR_ALL")
    assert ground.store.mission.items == ()


def test_the_form_of_items_is_remembered() -> None:
    ground = Ground()
    float_item = item(0, frame=3, x=47.397742, y=8.545594)
    ground.send("MISSION_COUNT", count=2)
    assert ground.ask("MISSION_ITEM", **float_item)[0][0] == "MISSION_REQUEST"
    ground.send("MISSION_ITEM", **{**float_item, "seq": 1})
    assert len(ground.store.mission.items) == 2
    assert ground.ask("MISSION_COUNT", count=1)[0][0] == "MISSION_REQUEST"
    assert ground.ask("MISSION_ACK", type=3)[0][0] == "MISSION_REQUEST_INT"
    ground.send("MISSION_ITEM_INT", **item(0))
    assert ground.ask("MISSION_COUNT", count=1)[0][0] == "MISSION_REQUEST_INT"


def test_no_space_for_more_than_px4_takes() -> None:
    ground = Ground()
    for kind, most in MOST_ITEMS.items():
        for count, answer in ((most + 1, "MISSION_ACK"), (65535, "MISSION_ACK"), (most, "MISSION_REQUEST_INT")):
            name, fields = ground.ask("MISSION_COUNT", count=count, mission_type=kind)[0]
            assert name == answer
            assert fields.get("type", 4) == 4
        ground.send("MISSION_ACK", type=CANCELLED, mission_type=kind)
    for kind in (3, 255):
        assert ground.ask("MISSION_COUNT", count=1, mission_type=kind)[0][1]["type"] == 4
        assert ground.ask("MISSION_COUNT", count=0, mission_type=kind)[0][1]["type"] == 0


def test_emptying_a_plan_that_does_not_exist_empties_none() -> None:
    ground = Ground()
    upload(ground, [item(0)])
    for kind in (3, 255):
        ground.ask("MISSION_COUNT", count=0, mission_type=kind)
    assert ground.ask("MISSION_CLEAR_ALL", mission_type=3)[0][1]["type"] == 0
    assert len(ground.store.mission.items) == 1
    ground.send("MISSION_CLEAR_ALL", mission_type=255)
    assert ground.store.mission.items == ()


def test_one_upload_at_a_time_on_all_links() -> None:
    ground = Ground()
    ground.send("MISSION_COUNT", count=1)
    assert ground.ask("MISSION_COUNT", link=API, count=1)[0][1]["type"] == 1
    assert ground.ask("MISSION_COUNT", peer=(9, 9), count=1)[0][1]["type"] == 1
    ground.send("MISSION_ITEM_INT", peer=(9, 9), **item(0))
    assert ground.texts[-1][1] == "REJ. MIS ITEM: partner id mismatch\t"
    assert not ground.store.mission.items
    ground.send("MISSION_ITEM_INT", **item(0))
    assert len(ground.store.mission.items) == 1
    ground.send("MISSION_COUNT", count=1)
    ground.server.forget(GCS)
    assert ground.ask("MISSION_COUNT", link=API, count=1)[0][0] == "MISSION_REQUEST_INT"


def test_a_refused_or_broken_upload_leaves_the_old_plan() -> None:
    ground = Ground()
    upload(ground, [item(0), item(1)])
    before = ground.store.mission
    for last in (item(1, command=31010), item(1, frame=9), item(1, frame=2), item(1, command=5100)):
        assert upload(ground, [item(0), last])[1]["type"] in (1, 2, 3)
    assert upload(ground, [item(0, command=201, param1=7.0)])[1]["type"] == 6
    ground.send("MISSION_COUNT", count=2)
    ground.send("MISSION_ITEM_INT", **item(0))
    ground.send("MISSION_ACK", type=CANCELLED)
    assert ground.ask("MISSION_ITEM_INT", **item(0))[-1][1]["type"] == 1  # never taken, so never confirmed
    ground.send("MISSION_COUNT", count=2)
    ground.send("MISSION_ITEM_INT", **item(0))
    ground.wait(6.0)
    assert ground.store.mission is before
    assert len(ground.missions) == 1


def test_another_count_begins_another_upload() -> None:
    ground = Ground()
    ground.send("MISSION_COUNT", count=1)
    ground.send("MISSION_COUNT", count=2)
    assert ground.ask("MISSION_ITEM_INT", **item(0))[0][0] == "MISSION_REQUEST_INT"
    assert not ground.store.mission.items
    assert ground.ask("MISSION_COUNT", count=2)[-1][1]["type"] == 1
    assert ground.texts[-1][1] == "WPM: REJ. CMD: Busy\t"


def test_the_last_item_once_more_is_confirmed_once_more() -> None:
    ground = Ground()
    first = upload(ground, [item(0), item(1)])
    assert ground.ask("MISSION_ITEM_INT", **item(1)) == [first]
    assert ground.ask("MISSION_ITEM_INT", **item(0))[-1][1]["type"] == 1
    assert ground.texts[-1][1] == "IGN MISSION_ITEM: No transfer\t"


def test_a_download_is_in_order_and_of_one_plan() -> None:
    ground = Ground()
    upload(ground, [item(0), item(1, z=20.0)])
    ground.send("MISSION_REQUEST_LIST")
    for seq in (0, 0, 1, 1):
        assert ground.ask("MISSION_REQUEST_INT", seq=seq)[0][1]["seq"] == seq
    ground.wait(1.0)
    assert [fields["type"] for _, fields in ground.ask("MISSION_REQUEST_INT", seq=0) if "type" in fields] == [1]
    assert ground.texts[-1][1] == "WPM: REJ. CMD: Req. WP was unexpected\t"
    ground.send("MISSION_REQUEST_LIST")
    ground.send("MISSION_CLEAR_ALL", link=API)
    assert ground.ask("MISSION_REQUEST_INT", seq=0)[-1][1]["type"] == 1


def test_the_marked_item_is_current_and_an_unknown_one_is_refused() -> None:
    asked: list[int] = []
    ground = Ground()
    ground.store = ground.server.store = PlanStore(on_current=lambda seq: not asked.append(seq) and seq != 0)
    upload(ground, [item(0), item(1, current=1)])
    assert [one["current"] for one in download(ground)] == [0, 1]
    ground.send("MISSION_SET_CURRENT", seq=2)
    assert ground.texts[-1] == (Severity.CRITICAL, "WPM: WP CURR CMD: Not in list\t")
    ground.send("MISSION_SET_CURRENT", seq=0)
    assert ground.texts[-1] == (Severity.CRITICAL, "WPM: WP CURR CMD: Error setting ID\t")
    assert asked == [1, 0]
    assert ground.store.current == 1


def test_the_same_mission_once_more_does_not_begin_anew() -> None:
    ground = Ground()
    first = upload(ground, [item(0), item(1)])
    ground.send("MISSION_SET_CURRENT", seq=1)
    assert upload(ground, [item(0), item(1)]) == first
    assert ground.missions == [(2, first[1]["opaque_id"])]
    assert ground.store.current == 1


@pytest.mark.parametrize("target", [{"target_system": 0}, {"target_system": 2}, {"target_component": 7}])
def test_what_is_for_others_changes_nothing(target: dict[str, int]) -> None:
    ground = Ground()
    upload(ground, [item(0)])
    for name in MissionServer.HANDLES:
        assert ground.ask(name, **target) == []
    assert len(ground.store.mission.items) == 1
    assert ground.server.refused == 0


def test_progress_is_reported() -> None:
    now = MissionProgress(0, -1, False, False)
    ground = Ground(progress=lambda: now)
    ground.wait(3.1)
    assert Counter(name for _, link, name, _ in ground.heard if link == GCS) == {"MISSION_CURRENT": 4}
    assert ground.heard[-1][3]["total"] == 65535
    upload(ground, [item(0), item(1)])
    ground.heard.clear()
    now = MissionProgress(1, 0, False, True)
    ground.wait(0.012)
    reports = [(name, fields["seq"]) for _, link, name, fields in ground.heard if link == GCS]
    assert reports == [("MISSION_CURRENT", 1), ("MISSION_ITEM_REACHED", 0)]
    assert ground.heard[0][3]["mission_state"] == 3
    ground.wait(15.0)
    assert sum(name == "MISSION_ITEM_REACHED" for _, link, name, _ in ground.heard if link == GCS) == 11
    now = MissionProgress(1, 1, True, False)
    ground.wait(1.1)
    assert [fields["mission_state"] for *_, name, fields in ground.heard if name == "MISSION_CURRENT"][-1] == 5
