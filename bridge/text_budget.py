"""How much a vehicle says: nobody can flood a link with texts, nor drown what the vehicle itself has to say.

budget = TextBudget()
if budget.allows("Failsafe activated", now_us): ...
"""

from __future__ import annotations

from typing import Final

AT_ONCE: Final = 50
EVERY_US: Final = 50_000
"""Texts that may be said at once, and how long it takes until there may be one more."""

NEWS_US: Final = 5_000_000
"""A text that was not said for this long is news, and half of the room is kept for news."""

_KEPT = 128


class TextBudget:
    """A number of texts that fills up again with vehicle time.

    Two of them are needed: one for what peers bring about by what they send, one for what the vehicle says by itself.
    """

    def __init__(self) -> None:
        self._room_us = AT_ONCE * EVERY_US
        self._filled_us = 0
        self._said_us: dict[str, int] = {}

    def allows(self, text: str, now_us: int) -> bool:
        """Return whether a text may be said; then it is taken for said.

        Args:
            text: the text. now_us: vehicle time.
        """
        full = AT_ONCE * EVERY_US
        self._room_us = min(full, self._room_us + now_us - self._filled_us)
        self._filled_us = now_us
        is_news = now_us - self._said_us.get(text, -NEWS_US) >= NEWS_US
        if self._room_us < (EVERY_US if is_news else full // 2 + EVERY_US):
            return False
        self._room_us -= EVERY_US
        self._said_us.pop(text, None)
        if len(self._said_us) >= _KEPT:
            del self._said_us[next(iter(self._said_us))]
        self._said_us[text] = now_us
        return True
