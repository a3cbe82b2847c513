"""Do ten cameras at 100 Hz from QTM give the same events as a file: `python -m scripts.benchmarks.qualisys_stream`.

A small server speaks QTM's protocol. It sends the markers of a simulated rig in real time: some frames are lost,
invalid packets are inserted, and the connection breaks in the middle of a packet. One camera is rotated halfway. Frames
that arrive complete are also written to a file of JSON lines, with their times of arrival. Both are watched; events and
the final rigs are compared. Writes docs/benchmarks/qualisys_stream.json.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imgcal.online import RigKeeper
from imgcal.types import CameraRig, rig_difference
from imgcal.watch import JsonLines, Qualisys, Source, SourceReader
from scripts.output import ROOT, command, surroundings, write_json
from tests.imgcal.streams import Stream
from tests.imgcal.watch.qtm import Qtm, frame, general, packet

RESULT = ROOT / "docs" / "benchmarks" / "qualisys_stream.json"
RATE = 100.0  # Hz
LOST = 0.02  # share of lost frames
BREAKS = 3  # interruptions of the connection
TURN = 0.3  # degrees, rotation of the second camera after half of the time
SIGMA = 0.07  # px
PATIENCE = 20.0  # s to wait for a snapshot

Markers = list[NDArray[np.float64]]  # (K, 2) pixels for each camera


def main() -> None:
    """Measure, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args()
    result = {**surroundings(), **measure(given.seconds)}
    write_json(RESULT, result)
    print(json.dumps(result, indent=1))


def measure(seconds: float, rig_name: str = "O10") -> dict[str, Any]:
    """Watch the stream and the file, and compare."""
    count = round(seconds * RATE)
    stream = Stream(rig_name, "asymmetric8", count, seed=3)
    frames = frames_of(stream, count)
    random = np.random.default_rng(1)
    kept = [number for number in range(count) if random.random() >= LOST]
    connections, arrive = with_faults(kept, frames, random)
    parameters = general(range(len(stream.rig.camera_names)), stream.rig.image_size.tolist())
    with Qtm(parameters, *connections) as server:
        live = Qualisys(server.address, stream.rig, pause=0.0)
        events, rig, times, unreadable = watched(live, stream, len(arrive))
        reconnections = server.connections - 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "blobs.jsonl"
        sent = zip(times, arrive, strict=True)
        path.write_text("".join(lines_of(moment, frames[number], stream.rig) for moment, number in sent))
        descriptor = os.open(path, os.O_RDONLY)
        try:
            expected, filed, _, _ = watched(JsonLines(descriptor), stream, len(arrive))
        finally:
            os.close(descriptor)
    return {
        "cameras": stream.rig.num_cameras,
        "rate_hz": RATE,
        "seconds": seconds,
        "frames_sent": len(kept),
        "frames_lost": count - len(kept),
        "snapshots": len(times),
        "time_steps_wrong": int((np.abs(np.diff(times) - np.diff(arrive) / RATE) > 1e-4).sum()),
        "unreadable_packets": unreadable,
        "reconnections": reconnections,
        "events": len(events),
        "moved": [event["camera"] for event in events if event["event"] == "moved"],
        "turned": stream.rig.camera_names[1],
        "events_that_differ": differences(events, expected),
        "rigs_differ_in": rig_difference(rig, filed),
    }


def frames_of(stream: Stream, count: int) -> list[Markers]:
    """Simulate the markers in each camera, rounded to 1/64 of a pixel."""
    bumped, found = stream.bumped([1], turn_deg=TURN), []
    for number in range(count):
        blobs, _ = stream.blobs(number, bumped if number >= count // 2 else stream.true, noise=SIGMA)
        uv = np.round(blobs.uv * 64) / 64
        found.append([uv[blobs.camera == camera] for camera in range(stream.rig.num_cameras)])
    return found


def with_faults(
    kept: Sequence[int], frames: Sequence[Markers], random: np.random.Generator
) -> tuple[list[list[tuple[float, bytes]]], list[int]]:
    """Distribute frames over connections.

    Returns:
        For each connection, the packets and their times; and the numbers of the frames that arrive complete.
    """
    parts = np.array_split(np.array(kept), BREAKS + 1)
    connections, arrive = [], []
    for number, part in enumerate(parts):
        sent: list[tuple[float, bytes]] = []
        for one in part.tolist():
            data, last = frame(one, frames[one]), one == part[-1] and number < BREAKS
            if random.random() < 0.01:
                data = garbage(one, frames[one], random) + data
            sent.append((one / RATE, data[:-40] if last else data))
            if not last:
                arrive.append(one)
        connections.append(sent)
    return connections, arrive


def garbage(number: int, markers: Markers, random: np.random.Generator) -> bytes:
    """Make an invalid packet with a correct length."""
    choices = (
        packet(3, b""),
        packet(3, random.bytes(200)),
        frame(number, markers[:3]),
        frame(number, markers, kind=9),
        packet(3, frame(number, markers)[8:-40]),
        packet(3, struct.pack("<qIIII", 1, 7, 1, 0, 1)),
        packet(77, b"?"),
        packet(1, b"hello\0"),
    )
    return choices[int(random.integers(len(choices)))]


def lines_of(moment: float, markers: Markers, rig: CameraRig) -> str:
    """Format a snapshot as lines of JSON."""
    return "".join(
        json.dumps({"camera": name, "time": moment, "uv": uv.tolist()}) + "\n"
        for name, uv in zip(rig.camera_names, markers, strict=True)
    )


def watched(source: Source, stream: Stream, count: int) -> tuple[list[dict[str, Any]], CameraRig, list[float], int]:
    """Follow a source for `count` snapshots: events, final rig, times, unreadable packets."""
    events: list[dict[str, Any]] = []
    times: list[float] = []
    with RigKeeper(stream.rig, stream.obj) as keeper, SourceReader(source, stream.rig, keep_all=True) as intake:
        while len(times) < count:
            snapshot = intake.next(PATIENCE)
            if snapshot is None:
                break
            state = keeper.update(snapshot.source(stream.rig.camera_names), snapshot.time)
            times.append(snapshot.time)
            events += [json.loads(event.to_json()) for event in state.events]
        return events, state.rig, times, intake.unreadable.total()


def differences(events: Sequence[dict[str, Any]], expected: Sequence[dict[str, Any]]) -> int:
    """Count different events; numbers may differ by a millionth, since the stream rounds times differently."""
    differ = abs(len(events) - len(expected))
    for one, other in zip(events, expected, strict=False):
        same = one.keys() == other.keys() and all(_is_same(one[key], other[key]) for key in one)
        differ += not same
    return differ


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.isclose(one, other, rtol=1e-6, atol=1e-6))
    return bool(one == other)


if __name__ == "__main__":
    command(main)
