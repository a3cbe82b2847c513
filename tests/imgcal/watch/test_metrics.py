import urllib.error
import urllib.request

import pytest

from imgcal.errors import InputError
from imgcal.live_page import Address
from imgcal.watch import CameraBlobs, Exposure, Hook, Metrics, SourceReader, Tally, Unreadable, Watch
from imgcal.watch.metrics import BUCKETS
from tests.imgcal.watch.states import RIG, KeeperOfStates, event

parser = pytest.importorskip("prometheus_client.parser")


class Given:
    live = False

    def items(self):
        yield Unreadable("junk", "cam01")
        for k in range(3):
            for camera in RIG.camera_names[: 4 - (k == 1)]:
                yield Exposure(camera, k / 60, CameraBlobs.of([]))


def scraped(metrics):
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics.port}/metrics", timeout=10) as reply:
        text = reply.read().decode()
    return {
        (sample.name, *sorted(sample.labels.values())): sample.value
        for family in parser.text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_what_is_counted_is_served(tmp_path):
    keeper, hook = KeeperOfStates(), Hook("true")
    keeper.events = {1: [event(1), event(1, "camera_lost")]}
    intake = SourceReader(Given(), RIG)
    with Watch(keeper, tmp_path, hook) as loop, Metrics(loop.tally, intake, hook, Address(port=0)) as metrics:
        assert scraped(metrics)["imgcal_snapshots_total",] == 0
        with intake:
            while (snapshot := intake.next(1.0)) is not None:
                loop.process(snapshot)
        found = scraped(metrics)
    assert found["imgcal_snapshots_total",] == 3
    assert found["imgcal_exposures_missing_total", "cam04"] == 1
    assert found["imgcal_exposures_unreadable_total", "cam01"] == 1
    assert found["imgcal_events_total", "moved"] == 1 and found["imgcal_events_total", "drift"] == 0
    assert found["imgcal_camera", "cam01", "ok"] == 1
    assert found["imgcal_update_seconds_count",] == found["imgcal_update_seconds_bucket", "+Inf"] == 3
    assert found["imgcal_shake_pixels", "cam02"] == found["imgcal_noise_pixels", "cam02"] == 0
    assert found["imgcal_clock_offset_seconds", "cam02"] == 0 == found["imgcal_stamp_offset_seconds", "cam02"]
    assert found["imgcal_rotation_radians", "cam03"] >= 0


def test_only_this_machine_may_read_it_and_the_address_may_be_taken(tmp_path):
    intake = SourceReader(Given(), RIG)
    with Metrics(Tally(), intake, None, Address(port=0)) as metrics:
        port = metrics.port
        with pytest.raises(InputError, match=rf"--metrics: 127\.0\.0\.1:{port} cannot"):
            Metrics(Tally(), intake, None, Address(port=port)).__enter__()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=2)


def test_who_asks_for_another_name_is_not_served():
    """A page of another site may let its name point to this machine."""
    with Metrics(Tally(), SourceReader(Given(), RIG), None, Address(port=0)) as metrics:
        address = f"http://127.0.0.1:{metrics.port}/metrics"
        for host in ("evil.example", "evil.example:9100", "127.0.0.1.evil.example", ""):
            with pytest.raises(urllib.error.HTTPError, match="421") as caught:
                urllib.request.urlopen(urllib.request.Request(address, headers={"Host": host}), timeout=10)
            assert b"imgcal_" not in caught.value.read()
        for host in (f"127.0.0.1:{metrics.port}", "localhost:9100", "[::1]:9100"):
            with urllib.request.urlopen(urllib.request.Request(address, headers={"Host": host}), timeout=10) as reply:
                assert b"imgcal_snapshots_total" in reply.read()


def test_times_are_counted_by_their_limits():
    tally = Tally()
    for seconds in (0.0005, BUCKETS[0], 0.0011, 100.0):
        tally.update_took(seconds)
    assert tally.took[:2] == [2, 1] and tally.took[-1] == 1
