import os
import signal
import threading
import time

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.live_page.address import Address
from imgcal.live_page.live_page import LivePage
from tests.imgcal.live_page.pages import Client, Stream, alarm, made_state


def test_a_taken_address_is_an_error_before_anything_is_started(served, o10, asymmetric8):
    with pytest.raises(InputError, match="Address already in use"):
        LivePage(o10, asymmetric8, served.address)


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


def test_closing_ends_the_server_and_its_address(o10, asymmetric8):
    page = LivePage(o10, asymmetric8, Address(port=0))
    page.close()
    page.close()
    assert page._server.returncode is not None
    with LivePage(o10, asymmetric8, page.address):
        pass


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


def test_commands_that_nobody_fetches_are_bounded(served):
    from imgcal.live_page.live_page import MOST_COMMANDS

    assert served._commands.maxsize == MOST_COMMANDS
    assert served.commands() == []
