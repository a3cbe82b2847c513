import time

from imgcal.io import read_rig
from imgcal.live_page import Address, Demonstration
from imgcal.live_page.demonstration import SETTLED
from tests.imgcal.live_page.pages import Client


def test_buttons_do_what_they_say(asymmetric8):
    with Demonstration(read_rig("T4"), asymmetric8, Address(port=0), seed=1) as shown:
        client, seconds = Client(shown.page), iter(range(1000))

        def pressed(name, **more):
            assert client.command({"name": name} | more)[0] == 200
            end = time.monotonic() + 120
            while shown.page._commands.empty() and time.monotonic() < end:
                time.sleep(0.005)
            return shown.step(next(seconds) / 15)

        state = shown.step(next(seconds) / 15)
        assert state.refused is None and set(state.cameras.values()) == {"ok"}
        before = shown.simulated.rig
        told = list(pressed("bump", camera=2).events)  # with the second snapshot
        for _ in range(SETTLED + 4):
            told += shown.step(next(seconds) / 15).events
        assert [(event.kind, event.camera) for event in told[:2]] == [("moved", "cam03")] * 2
        assert told[1].change == "rotation"
        moved = shown.simulated.rig.local(before).abs().amax(1)
        assert moved[2] > 1e-3 and moved[[0, 1, 3]].max() < 1e-9
        pressed("cover", camera=1)
        assert not (shown.simulated.snapshot(1.0).camera == 1).any()
        pressed("uncover")
        assert (shown.simulated.snapshot(1.0).camera == 1).any()
        assert pressed("away").refused and shown.simulated.away
        pressed("warm")
        assert shown.simulated.warm
        assert pressed("pause") is None and shown.step(next(seconds) / 15) is None
        assert pressed("resume") is not None
        factory = shown.keeper.factory
        pressed("factory", confirmed=True)
        assert shown.keeper.factory is not factory
