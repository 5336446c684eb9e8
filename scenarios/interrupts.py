"""Ctrl-C and its relatives: stop soon, but land first, and never in the middle of writing what was flown."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from types import FrameType

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""What asks a program to stop; a vehicle in the air is landed first, whichever it is."""


class _Signals:
    """Of this process: `heard` so far, how many blocks of each kind we are in, and whether one waits for their end."""

    heard = 0
    holding = 0
    landing = 0
    waiting = False


@contextmanager
def caught(first: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Turn every signal of STOPPING into KeyboardInterrupt; does nothing outside the main thread.

    Args:
        first: called at the first signal, to say that it was heard.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(_number: int, _frame: FrameType | None) -> None:
        _Signals.heard += 1
        if _Signals.heard == 1:
            first()
        if _Signals.holding or (_Signals.landing and _Signals.heard == 1):
            _Signals.waiting = True
        else:
            raise KeyboardInterrupt

    _Signals.heard, _Signals.waiting = 0, False
    before = {number: signal.signal(number, stop) for number in STOPPING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def held() -> Iterator[None]:
    """Keep signals until the end of this block: what it writes is worth the moment it takes.

    Raises:
        KeyboardInterrupt: at the end, for a signal that came in it or in a `landing` before; one that is still in its
            `landing` waits for the end of that.
    """
    _Signals.holding += 1
    try:
        yield
    finally:
        _Signals.holding -= 1
    if _Signals.waiting and not _Signals.holding and not (_Signals.landing and _Signals.heard == 1):
        _Signals.waiting = False
        raise KeyboardInterrupt


@contextmanager
def landing() -> Iterator[None]:
    """Keep the first signal until the next `held` has ended; a second one breaks off at once."""
    _Signals.landing += 1
    try:
        yield
    finally:
        _Signals.landing -= 1


@contextmanager
def kept_from_children(*others: int) -> Iterator[None]:
    """Processes started in this block never see Ctrl-C: their parent hears it, too, and decides.

    Args:
        others: signals that are kept from them as well.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *others})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Of a worker process, at its beginning: end when the process that started it has ended, however that came.

    A killed parent tells nobody; a worker would wait for its next task for ever.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
