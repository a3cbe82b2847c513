import json
import runpy
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.watch import Exposure, Unreadable, ZeroMQ

zmq = pytest.importorskip("zmq")
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
EXAMPLES = Path(__file__).parents[3] / "scripts" / "examples"


@pytest.fixture
def publisher(tmp_path):
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 0
        address = f"ipc://{tmp_path}/frames"
        socket.bind(address)
        yield socket, address


def first(items, send=lambda: None):
    """The first thing that comes, while something is sent again and again: a subscription takes a moment."""
    ends = time.monotonic() + 90
    for item in items:
        if item is not None:
            return item
        assert time.monotonic() < ends, "nothing comes"
        send()
    raise AssertionError("the stream has ended")


def test_blobs_frames_and_garbage(publisher):
    socket, address = publisher
    items = ZeroMQ((address,)).items()
    blobs = b'{"camera": "a", "time": 1.5, "uv": [[1, 2]]}'
    assert first(items, lambda: socket.send(blobs)).time == 1.5
    header = json.dumps({"camera": "b", "time": 2.5, "width": 3, "height": 2, "type": "uint8"}).encode()
    pixels = np.arange(6, dtype=np.uint8)
    whole = [header, pixels.tobytes()]
    messages = [whole, [header, b"12345"], [b"junk"], [b"1", b"2", b"3"], whole]
    for message in messages:
        socket.send_multipart(message)
    found = []
    while len(found) < len(messages):
        item = first(items)
        if getattr(item, "time", 0) != 1.5:
            found.append(item)
    assert [type(item) for item in found] == [Exposure, Unreadable, Unreadable, Unreadable, Exposure]
    assert (found[-1].content == pixels.reshape(2, 3)).all()
    items.close()


def test_a_publisher_that_comes_late_and_goes_away_is_waited_for(tmp_path):
    address = f"ipc://{tmp_path}/late"
    items = ZeroMQ((address,)).items()
    assert next(items) is None
    for seconds in (1.0, 2.0):
        with zmq.Context() as context, context.socket(zmq.PUB) as socket:
            socket.linger = 0
            socket.bind(address)
            message = json.dumps({"camera": "a", "time": seconds, "uv": []}).encode()
            while (item := first(items, lambda s=socket, m=message: s.send(m))).time != seconds:
                pass
            assert item.camera == "a"
    items.close()


def test_a_message_of_any_size_is_not_taken(publisher):
    socket, address = publisher
    items = ZeroMQ((address,), largest=1000, silence=0.3).items()
    blobs = b'{"camera": "a", "time": 1, "uv": []}'
    first(items, lambda: socket.send(blobs))
    socket.send(b" " * 100_000)
    later = b'{"camera": "a", "time": 2, "uv": []}'  # the connection is cut, and made again
    while first(items, lambda: socket.send(later)).time != 2:
        pass
    items.close()


def test_what_waits_is_not_given_up_where_the_reader_was_held_up(publisher):
    """With --keep-all the reader waits for the loop, which may compile for a minute."""
    socket, address = publisher
    items = ZeroMQ((address,), silence=0.3).items()

    def send(seconds):
        socket.send(json.dumps({"camera": "a", "time": seconds, "uv": []}).encode())

    first(items, lambda: send(0.0))
    for number in range(1, 101):
        send(float(number))
    time.sleep(0.6)
    found = []
    while not found or found[-1] < 100:
        found.append(first(items).time)
    assert [seconds for seconds in found if seconds] == list(range(1, 101))
    items.close()


@pytest.mark.parametrize("address", ["frames", "tcp://nowhere", "http://127.0.0.1:1", "tcp://127.0.0.1:70000"])
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match=r"address|connected"):
        next(ZeroMQ((address,)).items())


def test_the_example_in_python_sends_what_we_read(tmp_path, monkeypatch):
    address = f"ipc://{tmp_path}/example"
    monkeypatch.setattr(sys, "argv", ["send_blobs.py", address, "90"])
    sender = threading.Thread(target=runpy.run_path, args=(str(EXAMPLES / "send_blobs.py"),))
    sender.start()
    found = four_cameras(address)
    sender.join()
    assert {name: item.content.uv.shape for name, item in found.items()} == dict.fromkeys(CAMERAS, (8, 2))


def test_the_example_in_c_sends_what_we_read(tmp_path):
    if shutil.which("cc") is None or not Path("/usr/include/zmq.h").is_file():
        pytest.skip("no C compiler, or no zmq.h (Debian: libzmq3-dev): the example in C is not tried")
    program, address = tmp_path / "send_frames", f"ipc://{tmp_path}/example"
    source = str(EXAMPLES / "send_frames.c")
    subprocess.run(["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-o", program, source, "-lzmq"], check=True)
    process = subprocess.Popen([program, address, "300"])
    try:
        found = four_cameras(address)
    finally:
        process.terminate()
        process.wait(10)
    assert {name: item.content.shape for name, item in found.items()} == dict.fromkeys(CAMERAS, (480, 640))
    assert found["cam01"].content.max() == 200 and found["cam01"].time == pytest.approx(time.time(), abs=60)


def four_cameras(address):
    """The first exposure of each camera that is sent."""
    items = ZeroMQ((address,)).items()
    found = {}
    while len(found) < 4:
        item = first(items)
        assert isinstance(item, Exposure), item
        found.setdefault(item.camera, item)
    items.close()
    return found
