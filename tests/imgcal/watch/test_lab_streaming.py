import json
import os
import time

import pytest

from imgcal.errors import InputError
from imgcal.watch import Exposure, LabStreaming, Unreadable
from imgcal.watch.lab_streaming import _open_new

pytest.importorskip("pylsl", reason="no pylsl (extra lsl)")
CONFIGURATION = """
[multicast]
ResolveScope = machine
[lab]
KnownPeers = {127.0.0.1}
[log]
level = -3
"""  # this machine alone


@pytest.fixture(scope="module")
def lsl(tmp_path_factory):
    path = tmp_path_factory.mktemp("lsl") / "lsl.cfg"
    path.write_text(CONFIGURATION)
    os.environ["LSLAPICFG"] = str(path)
    import pylsl

    return pylsl


def outlet(lsl, name, kind="string", channels=1, source="one"):
    return lsl.StreamOutlet(lsl.StreamInfo(name, "Blobs", channels, 0, kind, source))


def blobs(camera, **more):
    return [json.dumps({"camera": camera, "uv": [[1.5, 2.5]], **more})]


def collect(items, enough, seconds=60.0):
    found, ends = [], time.monotonic() + seconds
    while not enough(found):
        assert time.monotonic() < ends, found
        item = next(items)
        if item is not None:
            found.append(item)
    return found


def wait_for(outlets, items):
    """Until somebody reads them; what came meanwhile."""
    found, ends = [], time.monotonic() + 60.0
    while not all(one.have_consumers() for one in outlets):
        assert time.monotonic() < ends
        item = next(items)
        found += [] if item is None else [item]
    return found


def test_blobs_of_every_stream_of_a_name_come_with_the_time_of_their_stamps(lsl):
    streams = [outlet(lsl, "imgcal-a", source=source) for source in ("left", "right")]
    outlet(lsl, "other")
    items = LabStreaming("lsl://imgcal-a").items()
    wait_for(streams, items)
    ago = 0.25  # s
    for camera, one in zip(("cam01", "cam02"), streams, strict=True):
        one.push_sample(blobs(camera), lsl.local_clock() - ago)
    streams[0].push_sample(blobs("cam01", time=12.5))
    found = collect(items, lambda found: sum(isinstance(one, Exposure) for one in found) == 3)
    times = [one.time for one in found if one.time != 12.5]
    assert {one.camera for one in found} == {"cam01", "cam02"} and len(times) == 2
    assert times == pytest.approx([time.time() - ago] * 2, abs=5.0) and times[0] == pytest.approx(times[1], abs=0.05)
    assert all(one.content.uv.tolist() == [[1.5, 2.5]] for one in found)
    items.close()


def test_garbage_is_told_and_a_stream_may_go_and_come_back(lsl):
    items, first = LabStreaming("lsl://imgcal-b").items(), outlet(lsl, "imgcal-b")
    wrong = outlet(lsl, "imgcal-b", "float32", 3, "wrong")
    found = wait_for([first], items)
    for text in ("{", "[1]", '{"camera": "cam01"}', '"time"', "x" * 5_000_000):
        first.push_sample([text])
    found += collect(items, lambda more: len(found) + len(more) >= 6)
    assert len(found) == 6 and all(isinstance(one, Unreadable) for one in found)
    assert any("expected one of text" in one.reason for one in found) and wrong
    del first
    again = outlet(lsl, "imgcal-b", source="again")
    wait_for([again], items)
    again.push_sample(blobs("cam03", time=1.0))
    assert collect(items, lambda found: any(isinstance(one, Exposure) for one in found))[-1].camera == "cam03"
    items.close()


def test_a_sender_that_restarts_is_read_once(lsl):
    items, sent = LabStreaming("lsl://imgcal-c").items(), 0
    for _ in range(3):
        sender = outlet(lsl, "imgcal-c")  # the same source each time
        wait_for([sender], items)
        collect(items, lambda found, ends=time.monotonic() + 4.0: time.monotonic() > ends)  # LSL has time to recover
        for _ in range(5):
            sender.push_sample(blobs("cam01", time=float(sent)))
            sent += 1
        found = collect(items, lambda found, ends=time.monotonic() + 2.0: time.monotonic() > ends)
        assert [one.time for one in found] == [float(number) for number in range(sent - 5, sent)]
        del sender
    items.close()


def test_a_stream_that_is_no_longer_found_is_forgotten_and_opened_again_later(lsl):
    streams = {"unplugged": None}
    assert list(_open_new([], streams, lsl)) == [] and streams == {}


@pytest.mark.parametrize("address", ["lsl://", "lsl://two words", "lsl://a/b", "tcp://127.0.0.1:1"])
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match="expected lsl://NAME"):
        next(LabStreaming(address).items())
