"""How many poses a second does an OpenIGTLink client get: `python -m scripts.benchmarks.open_igt_link --seconds 20`.

A simulated rig sends blobs at 60 Hz by ZeroMQ, `imgcal watch` publishes poses, and two clients of pyigtl read them: one
that keeps every message, and one that asks for the latest as pyigtl offers it. Rates are by the time stamps in the
messages. Writes docs/benchmarks/open_igt_link.json.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import pyigtl

from scripts.output import ROOT, command, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "open_igt_link.json"
EXAMPLE = ROOT / "scripts" / "examples" / "send_blobs.py"
RATE = 60.0
SETTLED = 90  # poses that are not counted: connections are made, loops are compiled
PATIENCE = 900.0  # s until the first pose


class Every(dict[str, Any]):
    """What pyigtl keeps of its messages: not only the latest of each device."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps: list[float] = []

    def __setitem__(self, device: str, message: Any) -> None:
        super().__setitem__(device, message)
        if device == "ObjectToRig":
            self.stamps.append(float(message.timestamp))


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    result = {**surroundings(), **measure(given.seconds)}
    write_json(RESULT, result)
    print(result)


def measure(seconds: float) -> dict[str, Any]:
    """Run rig, watcher and clients for a while."""
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        port, address = free_port(), f"ipc://{folder}/blobs"
        watch = ["-m", "imgcal", "watch", address, "--rig", "T4", "--object", "asymmetric8", "--out", f"{folder}/out"]
        stack.enter_context(running([str(EXAMPLE), address]))
        stack.enter_context(running([*watch, "--poses", f"igtl://{port}"]))
        every, latest = (stack.enter_context(connected(port)) for _ in range(2))
        every.incoming_messages = kept = Every()
        asked: list[float] = []
        ends = time.monotonic() + PATIENCE
        while len(kept.stamps) < SETTLED + seconds * RATE:
            if time.monotonic() > ends + seconds:
                raise RuntimeError(f"{len(kept.stamps)} poses came")
            message = latest.wait_for_message("ObjectToRig", timeout=1.0)
            if message is not None and len(kept.stamps) >= SETTLED:
                asked.append(float(message.timestamp))
        stamps = kept.stamps[SETTLED:]
        return {
            "sent_a_second": RATE,
            "seconds": stamps[-1] - stamps[0],
            "poses_a_second": rate_of(stamps),
            "poses_a_second_of_a_client_that_asks_for_the_latest": rate_of(asked),
        }


def rate_of(stamps: list[float]) -> float:
    """Messages a second, by their own times."""
    return (len(stamps) - 1) / (stamps[-1] - stamps[0])


@contextlib.contextmanager
def running(arguments: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A Python process that is ended afterwards."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=environment)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


@contextlib.contextmanager
def connected(port: int) -> Iterator[Any]:
    """A client of pyigtl, which goes on trying to connect."""
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", port)
    try:
        yield client
    finally:
        client.stop()


def free_port() -> int:
    """One that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


if __name__ == "__main__":
    command(main)
