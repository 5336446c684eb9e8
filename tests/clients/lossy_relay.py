"""A network between a vehicle and a ground station that loses datagrams, each way, by seed."""

from __future__ import annotations

import random
import select
import socket
import threading
from types import TracebackType
from typing import Self


class LossyRelay:
    """Passes datagrams on between the vehicle that speaks to `port` and the client that listens on `client_port`.

    Args:
        client_port: of the client, on the loopback.
        loss: share of datagrams that vanish in each direction.
        seed: the same seed and traffic lose the same datagrams.

    Attributes:
        port: where the vehicle expects its ground station.
        loss: may be changed at any time.
        lost: datagrams so far that nobody got.
    """

    def __init__(self, client_port: int, loss: float, seed: int) -> None:
        self._client = ("127.0.0.1", client_port)
        self._vehicle: tuple[str, int] | None = None
        self.loss = loss
        self._chance = {side: random.Random(f"{seed} {side}") for side in ("vehicle", "client")}
        self._to_vehicle = _socket()
        self._to_client = _socket()
        self.port: int = self._to_vehicle.getsockname()[1]
        self.lost = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(timeout=5)
        self._to_vehicle.close()
        self._to_client.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for one in select.select([self._to_vehicle, self._to_client], [], [], 0.1)[0]:
                try:
                    data, sender = one.recvfrom(65536)
                    if one is self._to_vehicle:
                        self._vehicle = sender
                        if self._passes("vehicle"):
                            self._to_client.sendto(data, self._client)
                    elif self._vehicle is not None and self._passes("client"):
                        self._to_vehicle.sendto(data, self._vehicle)
                except OSError:
                    # Nobody listens there yet, or any more: lost as well.
                    self.lost += 1

    def _passes(self, side: str) -> bool:
        lost = self._chance[side].random() < self.loss
        self.lost += lost
        return not lost


def _socket() -> socket.socket:
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    one.bind(("127.0.0.1", 0))
    return one
