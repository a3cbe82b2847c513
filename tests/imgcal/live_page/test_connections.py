"""Idle connections do not block other viewers."""

import contextlib
import socket
import time

import pytest

from imgcal.live_page import Address, LivePage, live_page
from imgcal.live_page.process import HEADER_SECONDS, MOST_CONNECTIONS, MOST_OF_ONE_ADDRESS
from tests.imgcal.live_page.pages import Stream


def opened(page, source="127.0.0.1"):
    return socket.create_connection(("127.0.0.1", page.address.port), timeout=30, source_address=(source, 0))


def ended(connection, timeout):
    """Whether the other side ends it in time."""
    connection.settimeout(timeout)
    try:
        return connection.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_idle_connections_keep_nobody_out_and_are_ended(served, client):
    watching = Stream(served)
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(opened(served)) for _ in range(MOST_OF_ONE_ADDRESS + 20)]
        others = [f"127.0.0.{2 + k % 4}" for k in range(MOST_CONNECTIONS)]
        idle += [stack.enter_context(opened(served, source)) for source in others]
        assert client("GET", "/")[0] == 200
        begun = time.monotonic()
        assert all(ended(connection, 30) for connection in idle) and time.monotonic() - begun < HEADER_SECONDS + 20
    assert watching.wait("hello")  # who looks on stays
    watching.close()


def test_a_head_that_comes_byte_by_byte_is_not_waited_for_and_a_second_request_is(served):
    host = f"Host: 127.0.0.1:{served.address.port}\r\n".encode()
    with opened(served) as slow, opened(served) as twice:
        slow.sendall(b"GET / HTTP/1.1\r\n")
        for _ in range(2):
            twice.sendall(b"GET /favicon.ico HTTP/1.1\r\n" + host + b"\r\n")
            assert twice.recv(4096).startswith(b"HTTP/1.1 204")
        end = time.monotonic() + HEADER_SECONDS + 20
        alive = True
        while alive and time.monotonic() < end:
            try:
                slow.sendall(b"X")
            except ConnectionError:
                alive = False
            time.sleep(0.2)
        assert not alive


def test_a_connection_that_reads_none_of_its_answers_is_ended(o10, asymmetric8, monkeypatch):
    code = "import imgcal.live_page.process as p; p.STUCK_SECONDS = 0.5; p.main({listening}, {pipe})"
    monkeypatch.setattr(live_page, "SERVER", code)
    with LivePage(o10, asymmetric8, Address(port=0)) as page, opened(page) as stuck:
        requests = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{page.address.port}\r\n\r\n".encode() * 100
        stuck.settimeout(10)
        with pytest.raises(ConnectionError):
            while True:
                stuck.sendall(requests)
