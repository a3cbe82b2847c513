import json

import pytest

from imgcal.errors import InputError
from imgcal.watch import PosePublisher
from imgcal.watch.pose_zeromq import QUEUED
from tests.imgcal.watch.test_poses import record

zmq = pytest.importorskip("zmq")


def test_a_subscriber_gets_poses_and_one_that_never_reads_holds_up_nobody(tmp_path):
    address = f"ipc://{tmp_path}/poses"
    sink = PosePublisher(address)
    with zmq.Context() as context, context.socket(zmq.SUB) as socket, context.socket(zmq.SUB) as dead:
        for one in (socket, dead):
            one.linger = 0
            one.setsockopt(zmq.SUBSCRIBE, b"")
            one.connect(address)
        number = 0
        while not socket.poll(20):  # a subscription takes a moment
            sink.send(record(number))
            number += 1
            assert number < 3000
        first = json.loads(socket.recv())
        assert first["status"] == "ok" and len(first["covariance"]) == 6
        for more in range(3 * QUEUED):  # far more than anybody keeps for the other
            sink.send(record(more))
        sink.send(record(1, "no_object"))
        sink.close()


@pytest.mark.parametrize("address", ["tcp://nowhere", "tcp://127.0.0.1:70000", "udp://127.0.0.1:1"])
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match="expected tcp://HOST:PORT or ipc://PATH"):
        PosePublisher(address)


def test_an_address_that_cannot_be_published_at():
    with pytest.raises(InputError, match="cannot publish there"):
        PosePublisher("tcp://256.0.0.1:1")
