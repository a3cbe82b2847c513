"""`LivePage`: the loop's side of the page. It hands over what is new and never waits.

The server is a process of its own, so that people who look on take nothing from the loop. `publish` keeps what came
last and returns; a thread shrinks frames and passes them on, at most so often, while somebody looks. A server that
ends is started again; the address stays open meanwhile.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import imgcal
from imgcal.errors import InputError
from imgcal.extras import missing
from imgcal.live_page.acknowledgements import Acknowledgements
from imgcal.live_page.address import Address, check_token
from imgcal.live_page.commands import Action, Command
from imgcal.live_page.contents import (
    belief_message,
    event_message,
    greeting,
    picture_message,
    state_message,
)
from imgcal.live_page.rig_drawing import viewing_volume
from imgcal.live_page.wire import frame_message
from imgcal.messages import shorten
from imgcal.online import Event, RigState
from imgcal.types import CalibrationObject, CameraRig

Frame = NDArray[np.uint8] | NDArray[np.uint16]
Message = tuple[str, Callable[[], dict[str, Any]]]  # kind, and what makes the content

STATES_A_SECOND = 10.0
PICTURES_A_SECOND = 2.0  # of each camera
BELIEF_SECONDS, USUAL_CAMERAS = 0.5, 30  # up to so many cameras; longer for more, squared
MOST_EVENTS = 1000  # that wait to be passed on
MOST_COMMANDS = 64  # that wait to be fetched
RESTART_SECONDS = 2.0  # between two starts of the server
SERVER = "from imgcal.live_page.process import main; main({listening}, {pipe})"


def _warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=2)


class LivePage:
    """A page on which a running rig is watched. A context manager: leaving it ends the server.

    Examples:
        >>> import imgcal
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> with LivePage(rig, obj, Address(port=0)) as page:
        ...     page.commands(), page.url.startswith("http://127.0.0.1:")
        ([], True)
    """

    def __init__(
        self,
        rig: CameraRig,
        obj: CalibrationObject,
        address: Address = Address(),
        *,
        token: str | None = None,
        actions: Sequence[Action] = (),
        title: str = "live",
        problem: Callable[[str], None] = _warn,
    ) -> None:
        """Open the address and start the server.

        Args:
            rig: the factory calibration, without batch axes.
            obj: the calibration object.
            address: where to listen. Any but this machine's own asks everybody for the token.
            token: for those who look on from elsewhere; None = a new one.
            actions: buttons beside those that every page has.
            title: of the page.
            problem: gets what could not be shown, once of each kind, from another thread; a warning if not given.

        Raises:
            InputError: the address is taken, the token too short, or the system is Windows.
            ModuleNotFoundError: the libraries of the extra `live` are not installed.
        """
        if sys.platform == "win32":
            raise InputError("live page: not available on Windows; run it in WSL")
        if library := missing("uvicorn"):
            raise ModuleNotFoundError(f"No module named {library!r}", name=library)
        self._token = check_token(token)
        self._listening = address.listen()
        self.address = Address(address.host, self._listening.getsockname()[1])
        self._greeting = greeting(rig, obj, viewing_volume(rig), self.address, self._token, actions, title)
        self._rig, self._obj = rig, obj
        self._latest: RigState | None = None
        self._pictured: tuple[RigState, Mapping[str, Frame | None]] | None = None  # the latest that came with frames
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._notes: Acknowledgements = self._greeting["notes"]
        self._actions = {action.name: action for action in actions}
        self._problem, self._problems = problem, set[str]()
        self._news = threading.Condition()
        self._commands: queue.Queue[Command] = queue.Queue(MOST_COMMANDS)
        self._answers: deque[dict[str, Any]] = deque()  # to commands; the server asks for no more than it waits for
        self._viewers = 0
        self._closing = False
        self._ended: socket.socket | None = None  # the pipe of a server that has ended
        self._changing = threading.Lock()  # of the server
        self._started = 0.0
        self._server: subprocess.Popen[bytes] | None = None
        self._pipe: socket.socket | None = None
        self._start()
        self._sender = threading.Thread(target=self._send, name="live page", daemon=True)
        self._sender.start()

    @property
    def url(self) -> str:
        """The address to open in a browser, with the token if one is needed."""
        return self.address.url(None if self.address.local else self._token)

    @property
    def notice(self) -> str:
        """The notice for the person who started it."""
        if self.address.local:
            return f"live page: {self.url} (this machine only)"
        return (
            f"live page: {self.url}\nanyone with this address and its token can watch and command the rig; the "
            "connection is not encrypted"
        )

    def publish(self, state: RigState, frames: Mapping[str, Frame | None] | None = None) -> None:
        """Show a new state; returns at once. States that come faster than they are shown are passed over.

        Args:
            state: what the last snapshot taught.
            frames: grey images (H, W) of this snapshot, which are not to be changed from now on. Where some states come
                without, pictures are of those that have them.
        """
        with self._news:
            self._latest = state
            if frames or self._pictured is None:
                self._pictured = (state, frames or {})
            elif not self._pictured[1]:  # there never were any: blobs alone
                self._pictured = (state, {})
            self._events.extend(state.events)
            self._news.notify()

    def tell(self, event: Event) -> None:
        """Show an event that came with no state; returns at once."""
        with self._news:
            self._events.append(event)
            self._news.notify()

    def commands(self) -> list[Command]:
        """The commands since the last call; never waits."""
        found = []
        with contextlib.suppress(queue.Empty):
            while True:
                found.append(self._commands.get_nowait())
        return found

    def close(self) -> None:
        """End the server."""
        with self._news:
            if self._closing:
                return
            self._closing = True
            self._news.notify()
        with self._changing:  # a server that is being started is ended, too
            self._stop()
        self._listening.close()
        self._sender.join(timeout=5)

    def __enter__(self) -> LivePage:
        """Return itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the server."""
        self.close()

    def _start(self) -> None:
        """Start the server, and a thread that listens to it."""
        self._started = time.monotonic()
        ours, theirs = socket.socketpair()
        code = SERVER.format(listening=self._listening.fileno(), pipe=theirs.fileno())
        # Not from the current folder, which anybody may have filled.
        path = os.pathsep.join(filter(None, (str(Path(imgcal.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
        self._server = subprocess.Popen(
            [sys.executable, "-P", "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            pass_fds=(self._listening.fileno(), theirs.fileno()),
            start_new_session=True,  # an interruption of the loop is not its own
        )
        theirs.close()
        self._pipe = ours
        with self._news:
            greeting = frame_message("greeting", self._greeting)  # with the events and commands so far
            self._answers.clear()  # whom they were for has gone
        threading.Thread(target=self._listen, args=(ours,), name="live page commands", daemon=True).start()
        ours.sendall(greeting)

    def _stop(self) -> None:
        if self._pipe is not None:
            with contextlib.suppress(OSError):
                self._pipe.shutdown(socket.SHUT_RDWR)  # the server ends with it
            self._pipe.close()
        if self._server is not None:
            try:
                self._server.wait(timeout=3)
            except subprocess.TimeoutExpired:
                self._server.kill()
                self._server.wait()

    def _listen(self, pipe: socket.socket) -> None:
        """Receive the server's lines of JSON, which it has checked, until it ends."""
        with contextlib.suppress(OSError, ValueError), pipe.makefile("r", encoding="utf-8") as lines:
            for line in lines:
                self._receive(json.loads(line))
        with self._news:
            self._ended = pipe
            self._news.notify()

    def _receive(self, content: dict[str, Any]) -> None:
        if "viewers" in content:
            self._viewers = int(content["viewers"])
        elif "problem" in content:
            self._fail(content["problem"], content["why"])
        else:
            self._receive_command(content.pop("number"), Command(**content))

    def _receive_command(self, number: int, command: Command) -> None:
        """Take a command, and answer whether the loop will get it; a page shows only accepted commands as done."""
        taken = command.event is not None  # that is the page's own affair
        try:
            self._commands.put_nowait(command)
            taken = True
        except queue.Full:
            if not taken:
                self._fail("commands", f"{MOST_COMMANDS} waiting, none fetched")
        with self._news:
            if taken:
                self._notes.apply_command(command, self._actions)
            self._answers.append({"number": number, "taken": taken})
            self._news.notify()

    def _send(self) -> None:
        """Pass on what is new until the page is closed; restart the server if it has ended."""
        courier, last = _Courier(self._rig, self._obj), None
        while not self._closing:
            with self._news:
                self._news.wait_for(self._is_news, timeout=1 / STATES_A_SECOND)
                latest, self._latest = self._latest, None
                pictured, ended = self._pictured, self._ended is self._pipe
                events = self._note_events()
                answers = [self._answers.popleft() for _ in range(len(self._answers))]
            last = latest or last
            begun = time.monotonic()
            try:
                if ended:
                    raise BrokenPipeError("the server has ended")
                self._send_all(("answer", partial(dict, answer)) for answer in answers)
                self._send_all(courier.messages(latest, events))
                if self._viewers and pictured is not None:
                    self._send_all(courier.pictures(*pictured))
            except OSError:
                with self._news:
                    self._latest = self._latest or last
                self._restart()
                courier = _Courier(self._rig, self._obj)
            time.sleep(max(0.0, 1 / STATES_A_SECOND - (time.monotonic() - begun)))

    def _note_events(self) -> list[dict[str, Any]]:
        """Record the waiting events."""
        found: list[dict[str, Any]] = []
        while self._events:
            try:
                content = event_message(self._events.popleft())
                self._notes.add_event(content)
                found.append(content)
            except Exception as error:
                self._fail("event", repr(error))
        return found

    def _is_news(self) -> bool:
        news = self._latest is not None or bool(self._events) or bool(self._answers)
        return news or self._closing or self._ended is self._pipe

    def _send_all(self, messages: Iterator[Message]) -> None:
        """Send messages; report a failure once, and send the others."""
        assert self._pipe is not None
        for kind, make in messages:
            try:
                message = frame_message(kind, make())
            except Exception as error:
                self._fail(kind, repr(error))
                continue
            self._pipe.sendall(message)

    def _fail(self, kind: str, why: str) -> None:
        if kind not in self._problems:
            self._problems.add(kind)
            with contextlib.suppress(Exception):  # a failing callback must not end the page
                self._problem(f"live page: {kind}: {shorten(why)}")

    def _restart(self) -> None:
        with self._news:
            wait = RESTART_SECONDS - (time.monotonic() - self._started)
            self._news.wait_for(lambda: self._closing, timeout=max(0.0, wait))
        with self._changing:
            if not self._closing:
                self._stop()
                self._viewers = 0
                with contextlib.suppress(OSError):
                    self._start()


class _Courier:
    """Turns what is new into messages, and remembers what is due when."""

    def __init__(self, rig: CameraRig, obj: CalibrationObject) -> None:
        self._obj, self._cameras = obj, rig.num_cameras
        self._shown = np.full(rig.num_cameras, -1)  # snapshot of each camera's latest picture ...
        self._shown_at = np.zeros(rig.num_cameras)  # ... and when it was passed on, s
        self._belief_at = 0.0  # s
        self._belief_seconds = BELIEF_SECONDS * max(rig.num_cameras / USUAL_CAMERAS, 1.0) ** 2

    def messages(self, state: RigState | None, events: Sequence[dict[str, Any]]) -> Iterator[Message]:
        """Events, a new state, and the parts of it that are due."""
        now = time.monotonic()
        for event in events:
            yield "event", partial(dict, event)
        if state is None:
            return
        yield "state", partial(state_message, state, self._obj)
        if now - self._belief_at >= self._belief_seconds or events:
            self._belief_at = now
            yield "belief", partial(belief_message, state)

    def pictures(self, state: RigState, frames: Mapping[str, Frame | None]) -> Iterator[Message]:
        """Pictures of the cameras that have waited longest, as many as keep all of them fresh enough."""
        now = time.monotonic()
        share = int(np.ceil(self._cameras * PICTURES_A_SECOND / STATES_A_SECOND))
        waiting = np.flatnonzero((self._shown < state.snapshot) & (now - self._shown_at >= 0.9 / PICTURES_A_SECOND))
        for camera in waiting[np.argsort(self._shown_at[waiting], kind="stable")][:share].tolist():
            self._shown[camera], self._shown_at[camera] = state.snapshot, now
            yield "picture", partial(picture_message, state, camera, frames)
