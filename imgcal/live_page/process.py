"""The server's process: messages of the loop go to the board, and news of the board to the viewers."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from imgcal.live_page.page_state import PageState
from imgcal.live_page.security import Gate
from imgcal.live_page.server import Application
from imgcal.live_page.wire import read_message
from imgcal.messages import shorten

HEADER_SECONDS = 5.0
"""Within which the head of a request must have come, from its first byte or from the beginning of the connection."""
STUCK_SECONDS = 20.0
"""After which a connection is closed whose other side does not read what it is sent."""
MOST_CONNECTIONS = 256
MOST_OF_ONE_ADDRESS = 128
POLITE = 5  # how much rather the loop runs than this
GUIDANCE_SECONDS = 3.0  # rest between two computations, and twice as long as the last one took
MOST_HEADERS = 16384  # bytes
BUFFER = 1 << 20


class Connection(H11Protocol):
    """HTTP of one connection. If there are too many, the one that has waited the longest is closed."""

    def __init__(self, *given: Any, **more: Any) -> None:
        """Take uvicorn's arguments."""
        super().__init__(*given, **more)
        self.since = time.monotonic()
        self._due: asyncio.TimerHandle | None = None
        self._stuck: asyncio.TimerHandle | None = None  # set while the other side does not read

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

    def pause_writing(self) -> None:
        """Begin to wait for the other side to read."""
        super().pause_writing()
        self._stuck = self.loop.call_later(STUCK_SECONDS, self.transport.abort)

    def resume_writing(self) -> None:
        """Go on writing."""
        self._stop_stuck()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._forget()
        self._stop_stuck()
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

    def _stop_stuck(self) -> None:
        if self._stuck is not None:
            self._stuck.cancel()
            self._stuck = None

    def _end(self) -> None:
        self._due = None
        if self.waits:
            self.transport.abort()


def main(listening: int, pipe: int) -> None:
    """Serve until the loop's process closes the pipe.

    Args:
        listening: number of the open file of the socket on which viewers come.
        pipe: the same of the socket to the loop's process.
    """
    with contextlib.suppress(AttributeError, OSError):  # Windows has no such thing
        os.nice(POLITE)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(socket.socket(fileno=listening), socket.socket(fileno=pipe)))


async def _serve(listening: socket.socket, pipe: socket.socket) -> None:
    reader, writer = await asyncio.open_connection(sock=pipe, limit=BUFFER)
    try:
        _, greeting = await read_message(reader)
    except asyncio.IncompleteReadError:
        return
    board = PageState(greeting)

    def tell(content: dict[str, Any]) -> None:
        if not writer.is_closing():  # the loop may have ended
            writer.write(json.dumps(content).encode() + b"\n")

    guide = Guide(greeting, tell)
    application = Application(board, Gate(greeting["address"], greeting["token"]), guide.rig_yaml, tell)
    server = uvicorn.Server(
        uvicorn.Config(
            application, http=Connection, ws="none", lifespan="off", interface="asgi3", access_log=False,
            log_level="error", server_header=False, proxy_headers=False, limit_concurrency=2 * MOST_CONNECTIONS,
            h11_max_incomplete_event_size=MOST_HEADERS, timeout_graceful_shutdown=1, loop="asyncio",
        )
    )  # fmt: skip
    serving = asyncio.ensure_future(server.serve(sockets=[listening]))
    with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
        while True:
            kind, content = await read_message(reader)
            try:
                if kind == "belief":
                    guide.learn(content, application)
                elif kind == "answer":
                    application.accept_answer(**content)
                else:
                    application.spread(board.update(kind, content))
            except Exception as error:  # what one message holds does not end the page
                tell({"problem": kind, "why": shorten(repr(error))})
    application.close()
    server.should_exit = True
    with contextlib.suppress(asyncio.TimeoutError):
        await asyncio.wait_for(serving, 2)
    os._exit(0)  # a computation of the volume is not waited for


class Guide:
    """Computes guidance and deviations beside the server; input that arrives meanwhile is skipped."""

    def __init__(self, greeting: dict[str, Any], tell: Callable[[dict[str, Any]], None]) -> None:
        """Start from the greeting of the loop's process, with a function that sends it messages."""
        self._greeting, self._tell = greeting, tell
        self._pool = ThreadPoolExecutor(2, initializer=_use_one_thread)
        self._waiting: dict[str, dict[str, Any]] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._known: Any = None  # the latest rig and its deviations

    def learn(self, content: dict[str, Any], application: Application) -> None:
        """Take a belief, and send the results to the viewers."""
        for kind, work in (("rig", self._compare), ("volume", self._look)):
            self._waiting[kind] = content
            if kind not in self._tasks or self._tasks[kind].done():
                self._tasks[kind] = asyncio.get_running_loop().create_task(work(application))

    async def _compare(self, application: Application) -> None:
        while "rig" in self._waiting:
            found = await self._compute("rig", self._compare_change)
            if found is not None:
                application.spread(application.board.update_change(*found))

    async def _look(self, application: Application) -> None:
        loop = asyncio.get_running_loop()
        while "volume" in self._waiting:
            begun = loop.time()
            found = await self._compute("volume", self._compute_guidance)
            if found is not None:
                application.spread(application.board.update_advice(found))
            await asyncio.sleep(max(GUIDANCE_SECONDS, 2 * (loop.time() - begun)))

    async def _compute(self, kind: str, work: Callable[[dict[str, Any]], Any]) -> Any:
        """Compute the results of the latest input of a kind in a thread; None = there are none."""
        try:
            return await asyncio.get_running_loop().run_in_executor(self._pool, work, self._waiting.pop(kind))
        except Exception as error:  # the next one may do
            self._tell({"problem": kind, "why": shorten(repr(error))})
            return None

    def _compare_change(self, content: dict[str, Any]) -> Any:
        from imgcal.live_page.guidance import compare
        from imgcal.live_page.rig_drawing import arrangement

        rig, change, std = compare(content)
        self._known = rig, std
        return content["time"], arrangement(rig, self._volume()), change, std.numpy(), rig.focal_length.numpy()

    def _compute_guidance(self, content: dict[str, Any]) -> Any:
        from torch.linalg import LinAlgError

        from imgcal.errors import RefusedError
        from imgcal.live_page.guidance import compute_guidance

        try:
            return compute_guidance(content, self._greeting["points"], self._volume())
        except (RefusedError, LinAlgError):  # nothing can be said yet
            return None

    def _volume(self) -> Any:
        import torch

        from imgcal.estimation import WorkingVolume

        return WorkingVolume(*(torch.as_tensor(corner) for corner in self._greeting["volume"]))

    def rig_yaml(self) -> str | None:
        """The file of the latest rig with its deviations; None before any snapshot."""
        if self._known is None:
            return None
        from imgcal.io import RigCovariance, rig_text

        rig, std = self._known
        return rig_text(rig, covariance=RigCovariance(std))


def _use_one_thread() -> None:
    import torch

    torch.set_num_threads(1)
