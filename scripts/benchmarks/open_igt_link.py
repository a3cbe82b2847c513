"""How many poses a second does an OpenIGTLink client get: `python -m scripts.benchmarks.open_igt_link --seconds 20`.

Poses are published at 60 Hz, by the clock, and two pyigtl clients in another process read them: one keeps every
message, and one asks for the latest, as pyigtl offers it. Rates come from the time stamps in the messages. With
`--watch` also the whole chain: a simulated rig sends blobs at 60 Hz by ZeroMQ, and `imgcal watch` publishes the poses
(needs an idle machine). Writes docs/benchmarks/open_igt_link.json.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pyigtl

from imgcal.watch import OpenIGTLink
from scripts.output import ROOT, command, surroundings, write_json
from tests.imgcal.watch.test_poses import record

RESULT = ROOT / "docs" / "benchmarks" / "open_igt_link.json"
EXAMPLE = ROOT / "scripts" / "examples" / "send_blobs.py"
RATE = 60.0
SETTLED = 90  # first poses, not counted, while connections are made and loops compiled
PATIENCE = 900.0  # s to wait for the first pose


class Every(dict[str, Any]):
    """Replaces pyigtl's message buffer, to keep all messages instead of the latest per device."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps: list[float] = []

    def __setitem__(self, device: str, message: Any) -> None:
        super().__setitem__(device, message)
        if device == "ObjectToRig":
            self.stamps.append(float(message.timestamp))


def main() -> None:
    """Measure, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--watch", action="store_true", help="also measure the poses that imgcal watch publishes")
    parser.add_argument("--publish", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.publish is not None:
        publish(given.publish)
    result = {**surroundings(), **measure(given.seconds, given.watch)}
    write_json(RESULT, result)
    print(result)


def measure(seconds: float, watch: bool) -> dict[str, Any]:
    """Measure a plain publisher, and with `watch` also `imgcal watch`."""
    port = free_port()
    with running(["-m", "scripts.benchmarks.open_igt_link", "--publish", str(port)]):
        result = {"sent_a_second": RATE, "published": read(port, seconds)}
    if watch:
        result["watched"] = read_watched(seconds)
    return result


def read_watched(seconds: float) -> dict[str, Any]:
    """Measure the whole chain from blobs to poses."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        port, address = free_port(), f"ipc://{folder}/blobs"
        watch = ["-m", "imgcal", "watch", address, "--rig", "T4", "--object", "asymmetric8", "--out", f"{folder}/out"]
        stack.enter_context(running([str(EXAMPLE), address]))
        stack.enter_context(running([*watch, "--poses", f"igtl://{port}"]))
        return read(port, seconds)


def read(port: int, seconds: float) -> dict[str, Any]:
    """Connect two clients, and count the poses that each gets."""
    with connected(port) as every, connected(port) as latest:
        every.incoming_messages = kept = Every()
        asked: list[float] = []
        ends = time.monotonic() + PATIENCE
        while len(kept.stamps) <= SETTLED or kept.stamps[-1] - kept.stamps[SETTLED] < seconds:
            if time.monotonic() > ends:
                raise RuntimeError(f"received only {len(kept.stamps)} poses")
            message = latest.wait_for_message("ObjectToRig", timeout=1.0)
            if message is not None and len(kept.stamps) >= SETTLED:
                asked.append(float(message.timestamp))
    stamps = kept.stamps[SETTLED:]
    return {
        "seconds": stamps[-1] - stamps[0],
        "poses_a_second": rate_of(stamps),
        "longest_gap_ms": 1e3 * max(later - sooner for sooner, later in itertools.pairwise(stamps)),
        "poses_a_second_of_a_client_that_asks_for_the_latest": rate_of(asked),
    }


def publish(port: int) -> None:
    """Publish poses by the clock until the process is terminated."""
    sink, number, began = OpenIGTLink(port=port), 0, time.monotonic()
    while True:
        sink.send(replace(record(number), time=time.time()))
        number += 1
        time.sleep(max(0.0, began + number / RATE - time.monotonic()))


def rate_of(stamps: list[float]) -> float:
    """Messages per second, by their time stamps."""
    return (len(stamps) - 1) / (stamps[-1] - stamps[0])


@contextlib.contextmanager
def running(arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a Python process, and terminate it at the end."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=environment)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


@contextlib.contextmanager
def connected(port: int) -> Iterator[Any]:
    """Connect a pyigtl client, which retries until it succeeds."""
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
    try:
        yield client
    finally:
        client.stop()


def free_port() -> int:
    """Find a free port."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


if __name__ == "__main__":
    command(main)
