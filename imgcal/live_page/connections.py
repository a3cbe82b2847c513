"""Connections that wait for a request: for a few seconds, and few enough that others get through."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_SECONDS = 5.0
"""Within which the head of a request must have come, from its first byte or from the beginning of the connection."""
MOST_CONNECTIONS = 256
MOST_OF_ONE_ADDRESS = 128


class Connection(H11Protocol):
    """HTTP of one connection. If there are too many, the one that has waited the longest is closed."""

    def __init__(self, *given: Any, **more: Any) -> None:
        """Take uvicorn's arguments."""
        super().__init__(*given, **more)
        self.since = time.monotonic()
        self._due: asyncio.TimerHandle | None = None

    @property
    def waits(self) -> bool:
        """Whether no request is being answered."""
        return self.cycle is None or self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request, if there is room."""
        super().connection_made(transport)
        self._due = self.loop.call_later(HEADER_SECONDS, self._end)
        there = [other for other in self.connections if isinstance(other, Connection) and other.is_there]
        same = [other for other in there if other.address == self.address]
        for group, most in ((same, MOST_OF_ONE_ADDRESS), (there, MOST_CONNECTIONS)):
            if len(group) > most and self.is_there:
                min((other for other in group if other.waits), key=lambda other: other.since).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes; a slow header times out."""
        super().data_received(data)
        if not self.waits:
            self._forget()
        elif self._due is None:
            self._due = self.loop.call_later(HEADER_SECONDS, self._end)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._forget()
        super().connection_lost(exc)

    @property
    def is_there(self) -> bool:
        """Whether it is still open."""
        return not self.transport.is_closing()

    @property
    def address(self) -> str | None:
        """Of the other side, without the port."""
        return self.client[0] if self.client else None

    def _forget(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _end(self) -> None:
        self._due = None
        if self.waits:
            self.transport.abort()
