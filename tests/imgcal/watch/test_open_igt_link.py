import socket
import struct
import time
from dataclasses import replace

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.watch import OpenIGTLink, Poses, listening_address
from imgcal.watch import open_igt_link as module
from imgcal.watch.open_igt_link import HEADER, message, status_message, transform_message
from tests.imgcal.watch.states import some_state
from tests.imgcal.watch.test_poses import record

pyigtl = pytest.importorskip("pyigtl", reason="no pyigtl (extra dev): no independent client reads the messages")


@pytest.fixture
def server():
    sink = OpenIGTLink(port=0, stalled=0.3)
    yield sink
    sink.close()


def parsed(data):
    """Messages by the independent library."""
    found = []
    while data:
        fields = pyigtl.messages.MessageBase.parse_header(data[: HEADER.size])
        end = HEADER.size + fields["body_size"]
        body, crc = data[HEADER.size : end], struct.unpack(">Q", data[HEADER.size - 8 : HEADER.size])[0]
        assert pyigtl.messages.CRC64(body) == crc
        found.append((fields, body))
        data = data[end:]
    return found


def test_messages_are_what_an_independent_library_reads_and_writes():
    one = record(5)
    ((fields, body),) = parsed(transform_message(one))
    theirs = pyigtl.TransformMessage()
    theirs.unpack(fields, body)
    assert np.allclose(theirs.matrix, one.pose.matrix()) and theirs.device_name == "ObjectToRig"
    assert theirs.timestamp == pytest.approx(one.time, abs=1e-6)
    again = pyigtl.TransformMessage(one.pose.matrix(), timestamp=1.5, device_name="ObjectToRig")
    assert again.pack() == message("TRANSFORM", "ObjectToRig", 1.5, body)
    ((fields, body),) = parsed(status_message(record(0, "degraded", "cam02 is lost – look")))
    assert fields["message_type"] == "STATUS" and struct.unpack(">Hq", body[:10]) == (13, 0)
    assert body[10:30].rstrip(b"\0") == b"degraded" and body[30:] == b"cam02 is lost ? look; +-0.17 mm, 0.099 deg\0"


def test_an_independent_client_reads_every_pose_of_a_second(server):
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", server.port)
    try:
        for number in range(60):
            one, seen, ends = record(number), None, time.monotonic() + 60
            while seen is None or seen.timestamp < one.time - 1e-4:
                assert time.monotonic() < ends, f"pose {number} does not come"
                if number == 0 or seen is None:
                    server.send(one)  # the client takes a moment to connect
                seen = client.wait_for_message("ObjectToRig", timeout=1) or seen
            assert np.allclose(seen.matrix, one.pose.matrix(), atol=1e-3)
    finally:
        client.stop()


def test_a_client_that_stops_reading_misses_poses_and_is_let_go_the_others_get_theirs(server, monkeypatch):
    monkeypatch.setattr(module, "MOST_PENDING", 4096)
    dead, alive = (socket.create_connection(("127.0.0.1", server.port)) for _ in range(2))
    dead.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    alive.settimeout(0.01)
    got, ends = b"", time.monotonic() + 60
    number = 0
    while number == 0 or len(server._clients) == 2:
        assert time.monotonic() < ends
        for _ in range(200):
            server.send(record(number))
            number += 1
        try:
            while True:
                got += alive.recv(2**20)
        except TimeoutError:
            pass
    kinds = [fields["message_type"] for fields, _ in parsed(got)]
    assert kinds.count("TRANSFORM") >= 10 and kinds[0] == "STATUS"
    dead.close(), alive.close()
    for _ in range(20):
        server.send(record(number))
    assert not server._clients


def statuses(client, count):
    """Code and text of the next messages, which must all be STATUS."""
    data, ends = b"", time.monotonic() + 60
    while data.count(b"STATUS") < count or not data.endswith(b"\0"):
        assert time.monotonic() < ends
        data += client.recv(4096)
    assert {fields["message_type"] for fields, _ in parsed(data)} == {"STATUS"}
    return [(struct.unpack(">H", body[:2])[0], body[30:].rstrip(b"\0").decode()) for _, body in parsed(data)]


def test_a_status_comes_every_second_also_while_no_snapshot_does(monkeypatch):
    monkeypatch.setattr(module, "STATUS_EVERY", 0.05)
    monkeypatch.setattr(module, "SILENT_SECONDS", 0.3)
    sink = OpenIGTLink(port=0)
    with Poses("igtl", sink, idle=0.02) as poses, socket.create_connection(("127.0.0.1", sink.port)) as client:
        client.settimeout(10)
        assert set(statuses(client, 3)) == {(16, "no snapshot has come yet; no pose")}
        poses.publish(replace(some_state(), rig_from_object=None, refused="nothing is seen"))
        found = []
        while not found or "no snapshot" not in found[-1][1]:
            found += [one for one in statuses(client, 1) if "yet" not in one[1]]
        assert found[:2] == [(16, "nothing is seen; no pose")] * 2  # usual for a moment
        assert found[-1] == (16, "no snapshot has come for 0 s; no pose")


def test_a_slow_rig_is_not_silent_between_two_snapshots(server, monkeypatch):
    seconds = iter((0.0, 10.0, 25.0, 41.0))
    monkeypatch.setattr(module.time, "monotonic", lambda: next(seconds))
    server.send(record(0)), server.send(record(1))
    assert server._record(next(seconds)).status == "ok" and server._record(next(seconds)).status == "no_object"


def test_garbage_from_a_client_is_read_over(server):
    with socket.create_connection(("127.0.0.1", server.port)) as client:
        client.sendall(b"\x00\xffGET / HTTP/1.1\r\n" * 100)
        server.send(record(0, "no_object", "nothing is seen"))
        server.send(record(1))
        client.settimeout(10)
        data = b""
        while b"TRANSFORM" not in data:
            data += client.recv(4096)
    kinds = [(fields["message_type"], body[:2]) for fields, body in parsed(data)]
    assert kinds[0] == ("STATUS", b"\0\x10") and [kind for kind, _ in kinds] == ["STATUS", "STATUS", "TRANSFORM"]


@pytest.mark.parametrize("text", ["igtl://a:b", "igtl://1:2:3", "igtl://host:70000", "tcp://127.0.0.1:1"])
def test_addresses_that_are_none(text, server):
    with pytest.raises(InputError, match="expected igtl://"):
        listening_address(text)
    with pytest.raises(InputError, match="expected an address of this machine that is free"):
        OpenIGTLink(port=server.port)
