import os
import signal
import threading
import time

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.live_page import Address, LivePage
from imgcal.live_page import live_page as module
from tests.imgcal.live_page.pages import ACTIONS, Client, Stream, alarm, made_state


def test_a_taken_address_is_an_error_before_anything_is_started(served, o10, asymmetric8):
    with pytest.raises(InputError, match="Address already in use"):
        LivePage(o10, asymmetric8, served.address)


def test_windows_is_refused_in_a_line(o10, asymmetric8, monkeypatch):
    monkeypatch.setattr("imgcal.live_page.live_page.sys.platform", "win32")
    with pytest.raises(InputError, match="live page: not available on Windows"):
        LivePage(o10, asymmetric8, Address(port=0))


def test_the_server_is_started_again_where_it_ended(served, o10, asymmetric8):
    reader = Stream(served)
    first = reader.wait("hello")["instance"]
    os.kill(served._server.pid, signal.SIGKILL)
    served._server.wait()
    reader.close()
    ended, again = time.monotonic() + 60, None
    while again is None and time.monotonic() < ended:
        served.publish(made_state(o10, asymmetric8, 5, events=()))
        try:
            reader = Stream(served)
            again = reader.wait("hello")["instance"]
        except (OSError, AssertionError, ValueError):
            time.sleep(0.2)
    assert again not in (None, first)
    served.publish(made_state(o10, asymmetric8, 6, events=(alarm("cam02"),)))
    assert reader.wait("events", lambda content: content)[0]["camera"] == "cam02"
    reader.close()


def test_a_server_that_ends_while_nothing_comes_is_started_again_with_what_it_knew(o10, asymmetric8):
    with LivePage(o10, asymmetric8, Address(port=0)) as page:
        page.tell(alarm("cam02"))  # shown without any state
        page.publish(made_state(o10, asymmetric8, 7))
        reader = Stream(page)
        assert reader.wait("events", lambda content: content)[0]["camera"] == "cam02"
        assert reader.wait("state")["snapshot"] == 7
        client = Client(page)
        assert client.command({"name": "acknowledge", "event": 0})[0] == 200
        assert client.command({"name": "pause"})[0] == 200
        end = time.monotonic() + 60
        while len(page.commands()) < 1 and time.monotonic() < end:
            time.sleep(0.05)
        reader.wait("controls", lambda content: content["paused"])
        reader.close()
        first = page._server.pid
        os.kill(first, signal.SIGKILL)
        end = time.monotonic() + 60
        while page._server.pid == first and time.monotonic() < end:
            time.sleep(0.05)
        assert page._server.pid != first
        reader = Stream(page)
        assert reader.wait("controls")["paused"]
        events = reader.wait("events")
        assert [(event["camera"], event["number"], event["open"]) for event in events] == [("cam02", 0, False)]
        assert reader.wait("state")["snapshot"] == 7
        reader.close()


def test_a_server_that_is_being_started_while_the_page_is_closed_is_ended(o10, asymmetric8, monkeypatch):
    page = LivePage(o10, asymmetric8, Address(port=0))
    real, begun = module.subprocess.Popen, threading.Event()

    def slow(*given, **more):
        begun.set()
        time.sleep(0.5)
        return real(*given, **more)

    monkeypatch.setattr(module.subprocess, "Popen", slow)
    first = page._server
    first.kill()
    assert begun.wait(30)
    page.close()
    page._sender.join(10)
    assert page._server is not first and page._server.returncode is not None


def test_what_cannot_be_shown_is_said_once_and_all_else_is_shown(o10, asymmetric8, monkeypatch):
    told, real = [], module.state_message

    def fails(state, obj):
        if state.snapshot < 3:
            raise ValueError("odd")
        return real(state, obj)

    monkeypatch.setattr(module, "state_message", fails)
    with LivePage(o10, asymmetric8, Address(port=0), problem=told.append) as page:
        reader = Stream(page)
        for snapshot in range(5):
            page.publish(made_state(o10, asymmetric8, snapshot, events=(alarm("cam01"),)))
            time.sleep(0.2)
        assert len(reader.wait("events", lambda content: len(content) == 5)) == 5
        assert reader.wait("state", lambda content: content["snapshot"] == 4)
        page._send_all(iter([("picture", lambda: {"camera": "of no number"})]))  # what the server cannot take
        end = time.monotonic() + 60
        while len(told) < 2 and time.monotonic() < end:
            time.sleep(0.05)
        reader.close()
    assert told == ["live page: state: ValueError('odd')", "live page: picture: KeyError('jpeg')"]


def test_events_that_wait_are_bounded(o10, asymmetric8):
    page = LivePage(o10, asymmetric8, Address(port=0))
    page.close()
    for _ in range(module.MOST_EVENTS + 10):
        page.tell(alarm("cam01"))
    assert len(page._events) == module.MOST_EVENTS


def test_closing_ends_the_server_and_its_address(o10, asymmetric8):
    page = LivePage(o10, asymmetric8, Address(port=0))
    page.close()
    page.close()
    assert page._server.returncode is not None
    with LivePage(o10, asymmetric8, page.address):
        pass


def test_closing_while_somebody_looks_on_ends_the_stream_and_says_nothing(o10, asymmetric8, capfd):
    with LivePage(o10, asymmetric8, Address(port=0)) as page:
        reader = Stream(page)
        reader.wait("hello")
        server = page._server
    server.wait(timeout=30)
    reader.close()
    assert capfd.readouterr().err == ""


def test_a_viewer_that_never_reads_and_a_server_that_hangs_hold_up_nobody(served, o10, asymmetric8):
    stuck = Stream(served)  # it reads no more than the head
    reader = Stream(served)
    large = {name: np.zeros((1088, 2048), dtype=np.uint8) for name in o10.camera_names}
    slowest = 0.0
    for snapshot in range(100, 140):
        state = made_state(o10, asymmetric8, snapshot)
        begun = time.thread_time()
        served.publish(state, large)
        slowest = max(slowest, time.thread_time() - begun)
        time.sleep(0.01)
    assert slowest < 0.005
    assert reader.wait("state", lambda content: content["snapshot"] == 139)
    os.kill(served._server.pid, signal.SIGSTOP)
    try:
        done = threading.Event()

        def publish():
            for _ in range(2000):
                served.publish(state, large)
            done.set()

        threading.Thread(target=publish, daemon=True).start()
        assert done.wait(10)
    finally:
        os.kill(served._server.pid, signal.SIGCONT)
    assert Client(served)("GET", "/")[0] == 200
    for viewer in (stuck, reader):
        viewer.close()


def test_a_command_that_the_loop_never_gets_is_shown_as_done_nowhere(o10, asymmetric8, monkeypatch):
    monkeypatch.setattr(module, "MOST_COMMANDS", 1)
    told = []
    with LivePage(o10, asymmetric8, Address(port=0), actions=ACTIONS, problem=told.append) as page:
        page.tell(alarm("cam02"))
        reader, client = Stream(page), Client(page)
        reader.wait("events", lambda content: content)
        assert client.command({"name": "warm"})[0] == 200
        assert reader.wait("controls", lambda content: content["on"])["on"] == ["warm"]
        status, _, reason = client.command({"name": "pause"})
        assert status == 503 and reason == "the program that runs the rig takes no commands now\n"
        assert client.command({"name": "acknowledge", "event": 0})[0] == 200  # for that no loop is needed
        assert not reader.wait("events", lambda content: content)[0]["open"]
        late = Stream(page)
        assert late.wait("controls") == {"paused": False, "on": ["warm"]} == page._notes.controls()
        assert [command.name for command in page.commands()] == ["warm"]
        assert told == ["live page: commands: 1 waiting, none fetched"]
        assert client.command({"name": "pause"})[0] == 200 and [c.name for c in page.commands()] == ["pause"]
        for one in (reader, late):
            one.close()
