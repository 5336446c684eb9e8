from __future__ import annotations

import pytest

from sitl.ground_contact import GroundContact
from sitl.parameters import ParameterTable

STEP_US = 10_000
LOST, REGAINED = "Connection to ground station lost\t", "GCS connection regained\t"


class Ground:
    """Contact looked at every 10 ms."""

    def __init__(self, **parameters: float) -> None:
        self.parameters = ParameterTable(parameters)
        self.contact = GroundContact(self.parameters)
        self.now_us = 0

    def run(self, seconds: float, *, heard: bool) -> list[tuple[float, str]]:
        """Time passes, with a heartbeat every second or without; what was said when, s from the beginning."""
        texts, start_us = [], self.now_us
        for k in range(round(seconds * 1e6 / STEP_US)):
            if heard and k % 100 == 0:
                self.contact.heard(self.now_us)
            self.now_us += STEP_US
            text = self.contact.update(self.now_us)
            if text:
                texts.append(((self.now_us - start_us) * 1e-6, text))
        return texts


def test_who_was_never_there_is_not_lost() -> None:
    ground = Ground()
    assert ground.run(60.0, heard=False) == []
    assert not ground.contact.lost


@pytest.mark.parametrize("wait_s", [10, 5, 300])
def test_lost_after_com_dl_loss_t_and_said_once(wait_s: int) -> None:
    ground = Ground(COM_DL_LOSS_T=wait_s)
    assert ground.run(3.0, heard=True) == []
    ((said_s, text),) = ground.run(wait_s + 5.0, heard=False)
    assert text == LOST
    # the last heartbeat came a second before the silence was noted
    assert said_s == pytest.approx(wait_s - 1.0, abs=0.03)
    assert ground.contact.lost


def test_regained_with_the_first_heartbeat() -> None:
    ground = Ground()
    ground.run(1.0, heard=True)
    ground.run(12.0, heard=False)
    ((said_s, text),) = ground.run(5.0, heard=True)
    assert (text, said_s) == (REGAINED, pytest.approx(0.01, abs=1e-6))
    assert not ground.contact.lost


def test_short_silences_do_not_add_up() -> None:
    ground = Ground()
    for _ in range(4):
        assert ground.run(1.0, heard=True) == []
        assert ground.run(8.5, heard=False) == []


@pytest.mark.parametrize(("wish", "missed"), [(0, False), (1, True), (2, True), (6, True), (-1, False)])
def test_is_missed_only_if_nav_dll_act_wants_one(wish: int, missed: bool) -> None:
    ground = Ground(NAV_DLL_ACT=wish)
    assert ground.contact.missed is missed
    ground.run(1.0, heard=True)
    assert not ground.contact.missed
    ground.run(12.0, heard=False)
    assert ground.contact.missed is missed
