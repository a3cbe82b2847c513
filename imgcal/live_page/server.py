"""The server's few answers: the page, the stream of what is new, commands, and two downloads."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import asdict, dataclass, field
from typing import Any

from imgcal.live_page.commands import Command, read_command
from imgcal.live_page.page import live_page, report_page
from imgcal.live_page.page_state import PageState
from imgcal.live_page.security import HEADERS, Allowance, Gate, Refusal

MOST_VIEWERS = 64
MOST_BODY = 1024  # bytes of a command
BODY_SECONDS = 5.0
ANSWER_SECONDS = 10.0  # for the loop's process to take a command; a busy machine needs some of them
MOST_ASKED = 64  # commands that it has not answered
ALIVE_SECONDS = 10.0  # between signs of life where nothing is new
JSON = "application/json"

Message = MutableMapping[str, Any]  # of ASGI, as the three below
Scope = Message
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Answer = tuple[int, str, bytes, dict[str, str]]  # status, type, body, further headers


@dataclass(eq=False)
class Viewer:
    """Messages that one viewer has not received yet: the latest of each key, so that they cannot pile up."""

    pending: dict[str, bytes] = field(default_factory=dict)
    news: asyncio.Event = field(default_factory=asyncio.Event)

    def add(self, messages: Mapping[str, bytes]) -> None:
        """Put messages in the place of older ones of the same keys."""
        self.pending |= messages
        self.news.set()

    def drain(self) -> bytes:
        """Take all that is pending."""
        self.news.clear()
        taken, self.pending = self.pending, {}
        return b"".join(taken.values())


class Application:
    """An ASGI application; everything that a request can reach is in this file."""

    def __init__(
        self, board: PageState, gate: Gate, rig_yaml: Callable[[], str | None], tell: Callable[[dict[str, Any]], None]
    ) -> None:
        """Start without viewers.

        Args:
            board: what is shown.
            gate: decides which requests are answered.
            rig_yaml: the present rig file; None = not known yet.
            tell: passes an object on to the loop's process.
        """
        self.board, self.gate, self._rig_yaml, self._tell = board, gate, rig_yaml, tell
        self.viewers: set[Viewer] = set()
        self._closing = False
        self._commands, self._downloads = Allowance(10, 5.0), Allowance(4, 1.0)
        self._asked: dict[int, tuple[Command, asyncio.Future[bool]]] = {}  # not answered yet, by number
        self._count = 0  # of commands
        self._cameras = tuple(board.greeting["cameras"])
        self._actions = {action.name: action for action in board.greeting["actions"]}

    def spread(self, messages: Mapping[str, bytes]) -> None:
        """Hand messages to all viewers without waiting."""
        for viewer in self.viewers:
            viewer.add(messages)

    def close(self) -> None:
        """End the streams."""
        self._closing = True
        self.spread({})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        method, path = scope["method"], scope["path"]
        if path == "/" and method == "GET" and scope["query_string"]:
            refused = self.gate.refusal("GET", path, headers)
            if refused is None or refused.status == 401:
                await _answer(send, self._admit(scope["query_string"].decode("latin-1")))
                return
        refused = self.gate.refusal(method, path, headers)
        if refused is not None:
            await _answer(send, _refusal_answer(refused))
        elif path == "/stream" and method == "GET":
            await self._stream(receive, send)
        elif path == "/command":
            await _answer(send, await self._command(method, headers, receive))
        else:
            await _answer(send, self._page(path) if method != "POST" else _refusal_answer(Refusal(405, "expected GET")))

    def _admit(self, query: str) -> Answer:
        """Exchange the token in the address for a cookie, and redirect to the address without it."""
        if not self.gate.token_of_query(query):
            return _refusal_answer(Refusal(401, "expected the token that was printed where imgcal was started"))
        cookie = f"{self.gate.cookie}={self.gate.token}; Path=/; HttpOnly; SameSite=Strict"
        return 303, "text/plain", b"", {"Location": "/", "Set-Cookie": cookie}

    def _page(self, path: str) -> Answer:
        if path == "/":
            page = live_page(self.board.greeting["title"], self.gate.token)
            return 200, "text/html; charset=utf-8", page.text.encode(), {"Content-Security-Policy": page.policy}
        if path == "/favicon.ico":
            return 204, "image/x-icon", b"", {}
        if path not in ("/rig.yaml", "/report.html"):
            return _refusal_answer(Refusal(404, "not found"))
        if not self._downloads.try_take():
            return _refusal_answer(Refusal(429, "too many downloads at once"))
        if path == "/report.html":
            page = report_page(self.board.greeting["title"], self.board.contents())
            attached = {"Content-Disposition": 'attachment; filename="report.html"'}
            return 200, "text/html; charset=utf-8", page.text.encode(), attached
        text = self._rig_yaml()
        if text is None:
            return _refusal_answer(Refusal(503, "no snapshot has come yet"))
        return 200, "application/yaml", text.encode(), {"Content-Disposition": 'attachment; filename="rig.yaml"'}

    async def _command(self, method: str, headers: Mapping[str, list[str]], receive: Receive) -> Answer:
        if method != "POST":
            return _refusal_answer(Refusal(405, "expected POST"))
        if headers.get("content-type") != [JSON]:
            return _refusal_answer(Refusal(415, f"expected {JSON}"))
        if not self._commands.try_take():
            return _refusal_answer(Refusal(429, "too many commands at once"))
        try:
            body = await asyncio.wait_for(_body(receive), BODY_SECONDS)
            given = json.loads(body)
            command = read_command(given, self._cameras, self._actions, self.board.notes.count)
        except _TooLargeError:
            return _refusal_answer(Refusal(413, f"expected at most {MOST_BODY} bytes"))
        except (ValueError, RecursionError, TimeoutError) as error:
            reason = str(error) if type(error) is ValueError else "expected a command as JSON"
            return _refusal_answer(Refusal(400, reason))
        try:
            if await self._request(command):
                return 200, JSON, b"{}", {}
            return _refusal_answer(Refusal(503, "the program that runs the rig takes no commands now"))
        except TimeoutError:
            return _refusal_answer(Refusal(504, "the program that runs the rig has not answered yet"))

    async def _request(self, command: Command) -> bool:
        """Pass a command on to the loop's process, and wait for its answer.

        Raises:
            TimeoutError: there is none yet.
        """
        if len(self._asked) >= MOST_ASKED:
            return False
        self._count += 1
        answer: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self._asked[self._count] = command, answer
        self._tell(asdict(command) | {"number": self._count})
        return await asyncio.wait_for(answer, ANSWER_SECONDS)

    def accept_answer(self, number: int, taken: bool) -> None:
        """Take the answer of the loop's process to a command, and show the command as done, however late."""
        command, answer = self._asked.pop(number)
        if taken:
            self.spread(self.board.apply_command(command))
        if not answer.done():  # who asked may have gone
            answer.set_result(taken)

    async def _stream(self, receive: Receive, send: Send) -> None:
        """Send what is new, until the viewer goes or is sent away."""
        if len(self.viewers) >= MOST_VIEWERS:
            await _answer(send, _refusal_answer(Refusal(503, f"{MOST_VIEWERS} viewers are connected already")))
            return
        viewer = Viewer()
        viewer.add(self.board.full_state())
        self.viewers.add(viewer)
        self._tell({"viewers": len(self.viewers)})
        gone = asyncio.ensure_future(_disconnected(receive))
        try:
            head = HEADERS | {"Content-Type": "text/event-stream", "X-Accel-Buffering": "no"}
            await send({"type": "http.response.start", "status": 200, "headers": _raw(head)})
            more = True
            while more and not gone.done():
                waiting = asyncio.ensure_future(viewer.news.wait())
                await asyncio.wait((waiting, gone), timeout=ALIVE_SECONDS, return_when=asyncio.FIRST_COMPLETED)
                waiting.cancel()
                chunk, more = viewer.drain() or b": still here\n\n", not self._closing
                message = {"type": "http.response.body", "body": chunk, "more_body": more}
                await send(message)
        finally:
            gone.cancel()
            self.viewers.discard(viewer)
            self._tell({"viewers": len(self.viewers)})


class _TooLargeError(Exception):
    """A body is longer than any command."""


async def _body(receive: Receive) -> bytes:
    body = b""
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > MOST_BODY:
            raise _TooLargeError
        if not message.get("more_body"):
            return body


async def _disconnected(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


async def _answer(send: Send, answer: Answer) -> None:
    status, kind, body, further = answer
    head = HEADERS | {"Content-Type": kind, "Content-Length": str(len(body))} | further
    await send({"type": "http.response.start", "status": status, "headers": _raw(head)})
    await send({"type": "http.response.body", "body": body})


def _refusal_answer(refusal: Refusal) -> Answer:
    return refusal.status, "text/plain; charset=utf-8", f"{refusal.reason}\n".encode(), {}


def _raw(headers: Mapping[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.lower().encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()]
