"""[[fault]] tables: read, checked, and refused where they cannot be made to happen."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios.fault_injection import body_effect
from scenarios.fault_kinds import KINDS, Where
from scenarios.faults import Fault, check_faults, parse_faults
from scenarios.flight_faults import link_fault
from scenarios.injected_fault import InjectedFault, judge_faults
from scenarios.limits import Outcome
from scenarios.manoeuvres import make_manoeuvre
from scenarios.scenario import load_scenario
from sitl.errors import FileError, UsageError
from sitl.faults import BatterySag, Gust, GyroFault, LoopDelay, MotorFault
from sitl.vehicle_spec import resolve_vehicle

FILE = Path("my.toml")
STEP = make_manoeuvre("step", amplitude_deg=10.0, hold_s=3.0, return_s=3.0)

NEEDED: dict[str, dict[str, Any]] = {
    "gust": {"wind_m_s": 3.0},
    "motor_efficiency": {"efficiency_pct": 80.0},
    "motor_out": {"motor": 2},
    "motor_saturation": {"most_pct": 60.0},
    "battery_sag": {"sag_pct": 10.0},
    "gyro_noise": {"noise_deg_s": 5.0},
    "gyro_bias": {"bias_deg_s": -5.0},
    "gyro_dropout": {"loss_pct": 20.0},
    "gyro_stuck": {},
    "loop_delay": {"delay_ticks": 3},
    "link_loss": {"loss_pct": 30.0},
    "link_delay": {"delay_s": 0.2},
    "link_jitter": {"jitter_s": 0.2},
    "link_duplication": {"share_pct": 30.0},
    "link_reordering": {"share_pct": 30.0},
    "link_corruption": {"share_pct": 30.0},
    "parameter": {"parameter": "IMU_GYRO_CUTOFF", "value": 10.0},
    "autopilot_restart": {},
}


def read(*tables: dict[str, Any]) -> tuple[Fault, ...]:
    return parse_faults(list(tables), FILE, (STEP,))


def refused(*tables: dict[str, Any]) -> str:
    with pytest.raises(FileError) as error:
        read(*tables)
    return str(error.value)


class TestReading:
    @pytest.mark.parametrize("kind", KINDS)
    def test_every_kind_has_a_text_and_a_place(self, kind: str) -> None:
        (fault,) = read({"kind": kind, "at_s": 1.5, "manoeuvre": "step", **NEEDED[kind]})
        assert (fault.kind, fault.at_s, fault.manoeuvre, fault.duration_s) == (kind, 1.5, "step", None)
        assert 5 < len(fault.text) < 60
        assert fault.when.startswith("1.5 s into step")
        assert isinstance(fault.where, Where)
        assert all(fault.settings[key] == value for key, value in NEEDED[kind].items())

    def test_none_is_none(self) -> None:
        assert parse_faults(None, FILE, (STEP,)) == ()

    def test_texts_and_plans(self) -> None:
        faults = read(
            {"kind": "gust", "at_s": 2.0, "side_force_n": -1.5, "roll_accel_deg_s2": 30, "duration_s": 0.4},
            {"kind": "motor_out", "motor": 2, "at_s": 12.0},
            {"kind": "motor_saturation", "most_pct": 60.0, "at_s": 1.0, "manoeuvre": "step"},
            {"kind": "gyro_bias", "bias_deg_s": 2.0, "axis": "roll", "at_s": 1.0},
            {"kind": "link_loss", "loss_pct": 30.0, "direction": "to_vehicle", "at_s": 1.0},
            {"kind": "autopilot_restart", "at_s": 0.0},
        )
        assert [(fault.text, fault.when) for fault in faults] == [
            ("gust of -1.5 N sideways, +30 deg/s^2 of roll", "2 s after the take-off, for 0.4 s"),
            ("motor 2 out", "12 s after the take-off, to the end"),
            ("all motors limited to 60 % of full thrust", "1 s into step, to the end"),
            ("gyro bias of 2 deg/s in roll", "1 s after the take-off, to the end"),
            ("link loses 30 % to the vehicle", "1 s after the take-off, to the end"),
            ("autopilot restart of 3 s", "0 s after the take-off"),
        ]

    @pytest.mark.parametrize(
        ("table", "told"),
        [
            ({"kind": "gusts", "at_s": 1.0}, 'fault[0].kind: unknown kind "gusts" (did you mean "gust"?)'),
            ({"at_s": 1.0}, "fault[0].kind"),
            ({"kind": "gust", "wind_m_s": 3.0}, "fault[0].at_s"),
            ({"kind": "gust", "at_s": 1.0}, "nothing pushes"),
            ({"kind": "gust", "at_s": 1.0, "wind_ms": 3.0, "side_force_n": 1}, 'did you mean "wind_m_s"?'),
            ({"kind": "gust", "at_s": -1.0, "wind_m_s": 3.0}, "fault[0].at_s: -1 is out of range"),
            ({"kind": "gust", "at_s": math.nan, "wind_m_s": 3.0}, "fault[0].at_s"),
            ({"kind": "gust", "at_s": 6.0, "manoeuvre": "step", "wind_m_s": 3.0}, "after the end of step"),
            ({"kind": "gust", "at_s": 1.0, "manoeuvre": "stop", "wind_m_s": 1}, 'called "stop" (did you mean "step"?)'),
            ({"kind": "gust", "at_s": 1.0, "duration_s": 0.0, "wind_m_s": 3.0}, "fault[0].duration_s"),
            ({"kind": "motor_out", "at_s": 1.0}, "fault[0].motor"),
            ({"kind": "motor_out", "at_s": 1.0, "motor": 1.5}, "fault[0].motor: 1.5 is not a whole number"),
            ({"kind": "motor_out", "at_s": 1.0, "motor": 0}, "fault[0].motor: 0 is out of range"),
            ({"kind": "motor_efficiency", "at_s": 1.0, "efficiency_pct": 100.0}, "fault[0].efficiency_pct"),
            ({"kind": "gyro_bias", "at_s": 1.0, "bias_deg_s": 0.0}, "0 is no bias"),
            ({"kind": "gyro_stuck", "at_s": 1.0, "axis": "rol"}, 'did you mean "roll"?'),
            ({"kind": "link_loss", "at_s": 1.0, "loss_pct": 101.0}, "fault[0].loss_pct"),
            ({"kind": "link_loss", "at_s": 1.0, "loss_pct": 1.0, "direction": "up"}, "Known: both, to_vehicle"),
            ({"kind": "loop_delay", "at_s": 1.0, "delay_ticks": 0}, "fault[0].delay_ticks"),
            ({"kind": "parameter", "at_s": 1.0, "parameter": "MC_ROL_P", "value": 1}, 'did you mean "MC_ROLL_P"?'),
            ({"kind": "parameter", "at_s": 1.0, "parameter": "MC_AIRMODE", "value": 0.5}, "0.5 is not a whole number"),
            ({"kind": "parameter", "at_s": 1.0, "parameter": "MC_ROLL_P", "value": 1e300}, "fault[0].value"),
            ({"kind": "autopilot_restart", "at_s": 1.0, "duration_s": 1.0}, "Write boot_s"),
        ],
    )
    def test_what_is_wrong_is_named_with_what_to_do(self, table: dict[str, Any], told: str) -> None:
        text = refused(table)
        assert text.startswith("my.toml: fault[0]")
        assert told in text

    def test_the_second_of_two_is_told_apart(self) -> None:
        good = {"kind": "motor_out", "motor": 1, "at_s": 1.0}
        assert "fault[1].motor" in refused(good, good | {"motor": "one"})

    @pytest.mark.parametrize("tables", [3, "gust", [1], {"kind": "gust"}])
    def test_what_is_no_list_of_tables(self, tables: Any) -> None:
        with pytest.raises(FileError, match="is not a list of tables"):
            parse_faults(tables, FILE, (STEP,))

    def test_too_many(self) -> None:
        assert "At most 100" in refused(*[{"kind": "motor_out", "motor": 1, "at_s": 1.0}] * 101)

    @settings(max_examples=300, deadline=None)
    @given(
        st.dictionaries(
            st.sampled_from(
                ["kind", "at_s", "duration_s", "manoeuvre", *sorted({key for keys in NEEDED.values() for key in keys})]
            ),
            st.one_of(
                st.sampled_from([*KINDS, "step", "roll", "both", "MC_AIRMODE"]),
                st.floats(),
                st.integers(-(10**20), 10**20),
                st.booleans(),
                st.text(max_size=5),
                st.lists(st.integers(), max_size=2),
            ),
        ),
        st.sampled_from(sorted(KINDS)),
    )
    def test_whatever_is_written_is_a_fault_or_an_error_that_names_it(self, table: dict[str, Any], kind: str) -> None:
        table = {"kind": kind, "at_s": 1.0, **NEEDED[kind], **table}
        found: list[Fault] = []
        problem = ""
        try:
            found += read(table)
        except FileError as error:
            problem = str(error)
        assert bool(found) is not problem.startswith("my.toml: fault[0].")
        for fault in found:
            assert fault.text
            assert fault.when
            if fault.where is Where.BODY:
                body_effect(fault, 0.3)
            elif fault.where is Where.LINK:
                link_fault(fault)

    def test_in_a_file(self, tmp_path: Path) -> None:
        text = '[[manoeuvre]]\nkind = "step"\namplitude_deg = 5.0\n[[fault]]\nkind = "gust"\nat_s = 1\nwind_m_s = 2\n'
        path = tmp_path / "windy.toml"
        path.write_text(text)
        (fault,) = load_scenario(path).faults
        assert fault.kind == "gust"
        path.write_text(text.replace("[[fault]]", "[[faults]]"))
        with pytest.raises(FileError, match='did you mean "fault"'):
            load_scenario(path)


class TestEffects:
    def effect(self, kind: str, **keys: Any) -> Any:
        (fault,) = read({"kind": kind, "at_s": 1.0, **(NEEDED[kind] | keys)})
        return body_effect(fault, 0.5) if fault.where is Where.BODY else link_fault(fault)

    def test_in_si(self) -> None:
        gust = self.effect("gust", side_force_n=1.0, roll_accel_deg_s2=180.0)
        assert gust == Gust(2.0, pytest.approx(math.pi), 3.0)
        assert self.effect("motor_efficiency") == MotorFault(None, 0.8)
        assert self.effect("motor_out") == MotorFault(1, 0.0)
        assert self.effect("motor_saturation", motor=3) == MotorFault(2, 1.0, 0.6)
        assert self.effect("battery_sag") == BatterySag(pytest.approx(0.1))
        assert self.effect("loop_delay") == LoopDelay(3)
        assert self.effect("gyro_bias", axis="pitch") == GyroFault((1,), pytest.approx(-math.radians(5.0)))
        assert self.effect("gyro_dropout") == GyroFault((0, 1, 2), lost=pytest.approx(0.2))
        assert self.effect("gyro_stuck", axis="yaw") == GyroFault((2,), lost=1.0)

    def test_of_the_link(self) -> None:
        loss = self.effect("link_loss", direction="from_vehicle")
        assert (loss.loss, loss.to_vehicle, loss.from_vehicle) == (pytest.approx(0.3), False, True)
        assert self.effect("link_delay").delay_us == self.effect("link_jitter").jitter_us == 200_000
        for kind, name in (("duplication", "duplicate"), ("reordering", "reorder"), ("corruption", "corrupt")):
            shares = dataclasses.asdict(self.effect(f"link_{kind}"))
            assert {key for key in ("loss", "duplicate", "reorder", "corrupt") if shares[key]} == {name}


class TestWhatCannotBeDone:
    MODEL = resolve_vehicle("ant-x")

    def check(self, kind: str, connect: str, plant: str = "", **keys: Any) -> None:
        faults = read({"kind": kind, "at_s": 1.0, **(NEEDED[kind] | keys)})
        check_faults(faults, self.MODEL, connect, plant)

    @pytest.mark.parametrize("kind", KINDS)
    def test_with_a_vehicle_of_our_own_everything_can(self, kind: str) -> None:
        self.check(kind, "memory://")

    @pytest.mark.parametrize("kind", KINDS)
    def test_with_another_only_its_link_and_parameters(self, kind: str) -> None:
        if KINDS[kind].where in (Where.LINK, Where.PARAMETER):
            self.check(kind, "udpin://127.0.0.1:14540")
            return
        with pytest.raises(UsageError, match=r"fault\[0\] \(.*Leave out --connect"):
            self.check(kind, "udpin://127.0.0.1:14540")

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("plant", ["tcpin://127.0.0.1:4560", "/home/me/PX4-Autopilot/build/px4_sitl_default"])
    def test_with_a_real_one_on_our_plant_all_but_its_restart(self, kind: str, plant: str) -> None:
        connect = "udpin://127.0.0.1:14540" if plant.startswith("tcp") else "memory://"
        if kind != "autopilot_restart":
            self.check(kind, connect, plant)
            return
        with pytest.raises(UsageError, match="only an autopilot of our own"):
            self.check(kind, connect, plant)

    def test_a_motor_that_is_not_there(self) -> None:
        with pytest.raises(UsageError, match=r"motor 5 out\): ANT-X has 4 motors; give motor = 1 to 4"):
            self.check("motor_out", "memory://", motor=5)

    def test_a_boards_plant_is_out_of_reach(self) -> None:
        with pytest.raises(UsageError, match="a board's plant is in another process"):
            self.check("gust", "memory://", "serial:///dev/ttyACM0:921600")

    def test_a_stream_has_no_datagrams(self) -> None:
        with pytest.raises(UsageError, match="Connect over udpin"):
            self.check("link_loss", "tcpout://127.0.0.1:5760")

    @pytest.mark.parametrize(("kind", "key"), [("link_delay", "delay_s"), ("link_jitter", "jitter_s")])
    def test_nor_is_a_vehicle_elsewhere_so_late_that_it_seems_another(self, kind: str, key: str) -> None:
        self.check(kind, "udpin://127.0.0.1:14540", **{key: 0.4})
        with pytest.raises(UsageError, match="seem to have started anew"):
            self.check(kind, "udpin://127.0.0.1:14540", **{key: 0.5})

    def test_a_vehicle_elsewhere_is_not_cut_off_for_long(self) -> None:
        keys: dict[str, Any] = {"connect": "udpin://127.0.0.1:14540", "loss_pct": 100.0}
        self.check("link_loss", **keys, duration_s=2.0)
        self.check("link_loss", **keys, direction="to_vehicle")
        for more in ({}, {"duration_s": 4.0}):
            with pytest.raises(UsageError, match="would be given up, not landed"):
                self.check("link_loss", **keys, **more)


class TestVerdict:
    def fault(self, text: str, start_s: float | None) -> InjectedFault:
        return InjectedFault("gust", text, "5 s after the take-off", start_s=start_s)

    def test_what_did_not_pass_names_its_faults_in_the_order_they_began(self) -> None:
        faults = [self.fault("b", 12.0), self.fault("a", 3.04), self.fault("never", None)]
        assert judge_faults(Outcome.FAIL, "it fell", faults) == (Outcome.FAIL, "a at 3.0 s, b at 12.0 s: it fell")
        assert judge_faults(Outcome.UNSET, "why", faults[2:]) == (Outcome.UNSET, "why")

    def test_of_many_only_some(self) -> None:
        faults = [self.fault(str(n), float(n)) for n in range(5)]
        _, reason = judge_faults(Outcome.FAIL, "it fell", faults)
        assert reason == "0 at 0.0 s, 1 at 1.0 s, 2 at 2.0 s, 2 more faults: it fell"

    def test_a_flight_that_met_not_all_of_them_has_shown_nothing(self) -> None:
        faults = [self.fault("a", 1.0), self.fault("b", None)]
        reason = "b was never injected (5 s after the take-off)"
        assert judge_faults(Outcome.PASS, "", faults) == (Outcome.UNSET, reason)
        assert judge_faults(Outcome.INFO, "no limits set", faults) == (Outcome.UNSET, reason)
        assert judge_faults(Outcome.PASS, "", faults[:1]) == (Outcome.PASS, "")
