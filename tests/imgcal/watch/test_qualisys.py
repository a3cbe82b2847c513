import json
import socket
import struct
from dataclasses import replace

import numpy as np
import pytest

from imgcal.errors import InputError
from imgcal.formats import parse_xml
from imgcal.io import read_rig
from imgcal.online import RigKeeper
from imgcal.watch import BlobTable, Exposure, Qualisys, SourceReader, Unreadable
from imgcal.watch.qualisys import COMMANDS, find_cameras
from tests.imgcal.streams import Stream
from tests.imgcal.watch.qtm import Qtm, frame, general, packet

RIG = read_rig("O10")
SIZES = RIG.image_size.tolist()
PARAMETERS = general(range(10), SIZES)
RANDOM = np.random.default_rng(0)
MARKERS = [RANDOM.integers(0, 64 * 500, (number, 2)) / 64 for number in (8, 0, 3, 1, 8, 8, 2, 0, 5, 8)]


def source(server, rig=RIG):
    return Qualisys(server.address, rig, silence=2.0, pause=0.0, clock=lambda: 0.0)


def read(given, enough):
    """What comes until there is enough of it."""
    items, found = given.items(), []
    while not enough(found):
        item = next(items)
        if item is not None:
            found.append(item)
    items.close()
    return found


def exposures(found):
    return [item for item in found if isinstance(item, Exposure)]


def test_an_independent_client_finds_the_same_in_our_packets():
    library = pytest.importorskip("qtm_rt.packet", reason="no qtm-rt (extra dev): nobody else reads the packets")
    theirs = library.QRTPacket(frame(5, MARKERS)[8:])
    info, cameras = theirs.get_2d_markers()
    assert (theirs.timestamp, theirs.framenumber, info.camera_count) == (50_000, 5, 10)
    with Qtm(PARAMETERS, frame(5, MARKERS)) as server:
        ours = read(source(server), lambda found: len(found) == 10)
        assert all(command.encode() + b"\0" in server.commands[0] for command in COMMANDS)
    for item, markers, places in zip(ours, cameras, MARKERS, strict=True):
        assert item.content.uv.tolist() == [[one.x / 64, one.y / 64] for one in markers] == places.tolist()
    assert [item.camera for item in ours] == list(RIG.camera_names) and {item.time for item in ours} == {0.0}


def test_every_frame_comes_through_loss_reconnects_and_garbage():
    """A thousand frames of ten cameras, a tenth lost on the way, in connections that end anywhere."""
    kept = [number for number in range(1000) if RANDOM.random() > 0.1]
    frames = [frame(number, MARKERS) for number in kept]
    wrong = [
        packet(3, b""),
        packet(3, RANDOM.bytes(200)),
        frame(7, MARKERS[:4]),
        frame(7, MARKERS, kind=9),
        packet(3, frame(7, MARKERS)[8:-40]),
        packet(3, struct.pack("<qIIII", 1, 7, 1, 0, 1)),
        packet(77, b"?"),
        packet(6, b"\x01"),
        packet(4, b""),
        packet(1, b"hello\0"),
    ]
    half = b"".join(frames[:300]) + b"".join(wrong) + b"".join(frames[300:400]) + frames[400][:-50]
    garbage = frames[400] + frames[401] + struct.pack("<II", 2**31, 3) + RANDOM.bytes(1000)
    rest = b"".join(frames[402:])
    with Qtm(PARAMETERS, half, garbage, b"", rest) as server:
        found = read(source(server), lambda items: len(items) > 60 and len(exposures(items)) == 10 * len(kept))
        assert server.connections == 4
    seen = exposures(found)
    assert [item.time for item in seen[::10]] == pytest.approx([number / 100 - kept[0] / 100 for number in kept])
    assert all(np.array_equal(item.content.uv, MARKERS[index % 10]) for index, item in enumerate(seen))
    reasons = [item.reason for item in found if isinstance(item, Unreadable)]
    assert sum("frame 7" in reason for reason in reasons) == 4 and len(reasons) == 6 + 3
    assert any("the connection was closed" in reason for reason in reasons)
    assert any("found a packet of 2,147,483,648 bytes" in reason for reason in reasons)


def test_whatever_is_damaged_raises_nothing():
    stream = bytearray(b"".join(frame(number, MARKERS) for number in range(20)))
    damaged = []
    for _ in range(60):
        copy = bytearray(stream)
        for _ in range(3):
            copy[RANDOM.integers(len(copy))] = RANDOM.integers(256)
        damaged.append(bytes(copy))
    with Qtm(PARAMETERS, *damaged, bytes(stream)) as server:
        given = replace(source(server), silence=0.2)
        found = read(given, lambda items: server.connections > 60 and len(exposures(items[-200:])) == 200)
    assert {item.camera for item in exposures(found)} == set(RIG.camera_names)


def test_the_same_events_as_from_a_file():
    """Blobs of a rig whose second camera is turned on the way."""
    stream = Stream("T4", "asymmetric8", 60, seed=3)
    bumped = stream.bumped([1], turn_deg=0.3)
    parts = [stream.blobs(s, bumped if s >= 30 else stream.true)[0] for s in range(60)]
    frames = [[part.uv[part.camera == camera] for camera in range(4)] for part in parts]
    columns = {name: [getattr(part, name) for part in parts] for name in ("camera", "fiducial", "radius", "flags")}
    table = replace(
        parts[0],
        **{name: np.concatenate(column) for name, column in columns.items()},
        uv=np.round(np.concatenate([part.uv for part in parts]) * 64) / 64,
        sigma=np.full(sum(map(len, parts)), 0.1),
        snapshot=np.repeat(np.arange(60), [len(part) for part in parts]),
        snapshot_names=tuple(map(str, range(60))),
    )
    order = np.lexsort((table.camera, table.snapshot))
    data = b"".join(frame(number, cameras) for number, cameras in enumerate(frames))
    with Qtm(general("abcd", stream.rig.image_size.tolist()), data) as server:
        live = replace(source(server, stream.rig), pause=60.0)
        found = [events(one, stream) for one in (BlobTable(table.select(order), 100.0), live)]
    assert len(found[0]) == len(found[1]) and ("moved", "cam02") in [(e["event"], e["camera"]) for e in found[0]]
    for one, other in zip(*found, strict=True):
        numbers = {name for name, value in one.items() if isinstance(value, float)}  # their times differ by rounding
        assert {name: one[name] for name in one.keys() - numbers} == {
            name: other[name] for name in one.keys() - numbers
        }
        assert [one[name] for name in numbers] == pytest.approx([other[name] for name in numbers], rel=1e-6)


def events(given, stream):
    lines = []
    with RigKeeper(stream.rig, stream.obj) as keeper, SourceReader(given, stream.rig, keep_all=True) as intake:
        for _ in range(60):
            snapshot = intake.next(60.0)
            state = keeper.update(snapshot.source(stream.rig.camera_names), snapshot.time)
            lines += [json.loads(event.to_json()) for event in state.events]
    return lines


def test_cameras_are_those_of_the_rig():
    rig = replace(RIG, camera_names=tuple(f"{number}" for number in range(10)))
    mixed = parse_xml(general([*range(9, -1, -1), "extra"], [*SIZES[::-1], (100, 100)]), "")
    assert [one and one.name for one in find_cameras(mixed, rig)] == [*map(str, range(9, -1, -1)), None]
    with Qtm(general([*range(10), "extra"], [*SIZES, (100, 100)]), frame(0, [*MARKERS, [[5, 5]]])) as server:
        found = read(source(server, rig), lambda items: len(items) == 20)
    assert {item.camera for item in exposures(found)} == set(rig.camera_names)
    width, height = SIZES[0]
    larger = [(width + 200, height + 100)] * 10
    part = parse_xml(general(range(10), larger, fov=(50, 20, 49 + width, 19 + height)), "")
    assert {(one.unit, one.corner) for one in find_cameras(part, RIG)} == {(64.0, (50.0, 20.0))}
    for text, said in (
        (general(range(4), SIZES[:4]), "found 4 cameras .* expected 10"),
        (general(range(10), larger), f"found {width + 200}x.*expected {width}x{height}"),
        ("<QTM_Parameters_Ver_1.20/>", "no cameras"),
        (PARAMETERS.replace("Marker_Res", "Video_Res"), "no Marker_Res/Width"),
    ):
        with pytest.raises(InputError, match=said):
            find_cameras(parse_xml(text, "parameters"), RIG)


@pytest.mark.parametrize(
    ("parameters", "answer", "said"),
    [
        (general(range(4), SIZES[:4]), None, "found 4 cameras"),
        ("<QTM", None, "not valid XML"),
        ("", packet(0, b"Parse error\0"), "QTM says: Parse error"),
        ("", frame(1, MARKERS), "before the parameters"),
    ],
)
def test_what_qtm_cannot_give_is_told_once_and_asked_for_again(parameters, answer, said):
    with Qtm(parameters, b"", answer=answer) as server:
        items, reasons = source(server).items(), []
        while server.connections < 4:
            item = next(items)
            reasons += [] if item is None else [item.reason]
        items.close()
    assert any(said in reason for reason in reasons)


def test_a_server_that_is_not_there_is_waited_for():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    items = Qualisys(f"qtm://127.0.0.1:{port}", RIG, pause=0.0).items()
    found = [next(items) for _ in range(20)]
    assert [item.reason for item in found if item] == [f"qtm://127.0.0.1:{port}: cannot connect: ECONNREFUSED"]
    items.close()


def test_time_stamps_become_times_that_go_on_after_a_reconnection():
    now = [1.7e9]
    first = frame(0, MARKERS, stamp=5_000_000) + frame(1, MARKERS, stamp=5_010_000)
    with Qtm(PARAMETERS, first, frame(2, MARKERS, stamp=7_000_000), frame(3, MARKERS, stamp=1_000)) as server:
        items, times = replace(source(server), clock=lambda: now[0]).items(), []
        while len(times) < 40:
            item = next(items)
            if isinstance(item, Exposure):
                times.append(item.time)
                now[0] += 0.1 * (len(times) == 20) + 60.0 * (len(times) == 30)
        items.close()
    assert np.round(np.array(times[::10]) - 1.7e9, 3).tolist() == [0.0, 0.01, 2.0, 60.1]


@pytest.mark.parametrize(
    ("stamps", "steps", "expected"),
    [
        ([60.0, 60.01, 0.0, 0.01], [0.0, 0.01, 3.0, 0.01], [0.0, 0.01, 3.01, 3.02]),
        ([2.0, 2.01, 0.0, 0.01], [0.0, 0.01, 0.5, 0.01], [0.0, 0.01, 0.51, 0.52]),
        ([1.0, 9.0, 9.01, 17.0], [0.0, 8.0, 0.01, 0.01], [0.0, 8.0, 8.01, 8.02]),
        ([1.0, 1.01, 1e9, 1.03, 1.04], [0.0, 0.01, 0.01, 0.01, 0.01], [0.0, 0.01, 0.02, 0.03, 0.04]),
    ],
    ids=["a new measurement", "a new measurement soon", "a leap ahead", "a damaged time stamp"],
)
@pytest.mark.parametrize("reconnects", [False, True])
def test_time_never_goes_back_or_leaps_ahead(stamps, steps, expected, reconnects):
    """QTM begins to count anew with each measurement, with or without a new connection."""
    frames = [frame(n, MARKERS, stamp=round(1e6 * stamp)) for n, stamp in enumerate(stamps)]
    cut = 2 if reconnects else len(frames)
    streams = [part for part in (b"".join(frames[:cut]), b"".join(frames[cut:])) if part]
    moments = iter(1.7e9 + np.cumsum(steps))
    with Qtm(PARAMETERS, *streams) as server:
        found = read(
            replace(source(server), clock=lambda: next(moments)), lambda some: len(exposures(some)) == 10 * len(frames)
        )
    times = [item.time - 1.7e9 for item in exposures(found)[::10]]
    assert times == pytest.approx(expected, abs=1e-3)


def test_a_stream_that_runs_ahead_of_the_clock_goes_on_after_a_reconnection():
    """A recording that is played at twice its speed: its times are ahead of the clock by more than is allowed."""
    first = b"".join(frame(n, MARKERS, stamp=2_000_000 * n) for n in range(10))
    second = b"".join(frame(n, MARKERS, stamp=2_000_000 * n) for n in range(12, 14))
    moments = iter([*np.arange(10.0), 12.0, 13.0])
    with Qtm(PARAMETERS, first, second) as server:
        found = read(
            replace(source(server), clock=lambda: 1.7e9 + next(moments)), lambda some: len(exposures(some)) == 120
        )
    times = np.array([item.time - 1.7e9 for item in exposures(found)[::10]])
    assert (np.diff(times) > 5e-3).all() and times[9] == pytest.approx(18.0) and times[10] < 19.0


@pytest.mark.parametrize(
    "address", ["qtm://", "qtm://host:0", "qtm://host:70000", "tcp://host:1", "qtm://a..b", "qtm://.:1"]
)
def test_addresses_that_are_none(address):
    with pytest.raises(InputError, match="expected an address qtm://HOST"):
        next(Qualisys(address, RIG).items())
