"""Do viewers of the live page slow the loop? Times a keeper's updates with and without 20 viewers, in turn.

Run as `python -m scripts.benchmarks.live_viewers`: two minutes. Updates come at a camera's rate; viewers are a process
of their own, and one of them never reads.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import imgcal
from imgcal.live_page import Address, LivePage
from imgcal.synthesis import PhysicalDrift, SimulatedRig
from scripts.output import ROOT, command, markdown, read_json, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "live_viewers.json"
LOW, HIGH = torch.tensor([[-350.0, -220.0, 650.0], [350.0, 220.0, 1050.0]], dtype=torch.float64)
READERS = """
import http.client, sys, threading
def read(port):
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.request("GET", "/stream")
    answer = connection.getresponse()
    while answer.read(65536):
        pass
for _ in range(int(sys.argv[2])):
    threading.Thread(target=read, args=(int(sys.argv[1]),), daemon=True).start()
sys.stdin.read()
"""


@dataclass(frozen=True)
class Options:
    """Measure the effect of viewers of the live page."""

    out: Path = RESULT  #: file of the result
    turns: int = 6  #: turns with viewers, and as many without
    updates: int = 300  #: updates per turn
    rate: float = 30.0  #: updates per second
    viewers: int = 20  #: that read


@contextmanager
def looked_at(page: LivePage, viewers: int) -> Iterator[None]:
    """Connect viewers, and one more that requests the stream and never reads it."""
    given = [sys.executable, "-c", READERS, str(page.address.port), str(viewers)]
    with socket.create_connection(("127.0.0.1", page.address.port)) as stuck:
        stuck.sendall(f"GET /stream HTTP/1.1\r\nHost: 127.0.0.1:{page.address.port}\r\n\r\n".encode())
        with subprocess.Popen(given, stdin=subprocess.PIPE) as readers:
            time.sleep(2.0)
            yield
            readers.kill()


def measure(options: Options) -> dict[str, Any]:
    """Time update and publication together, in turn with and without viewers, ms."""
    torch.set_num_threads(1)
    factory, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    true = PhysicalDrift(0.01, 0.1, 2e-4, 0.3, 2e-4).apply(factory, torch.Generator().manual_seed(0))
    running = SimulatedRig(true, obj, LOW, HIGH)
    frames = {name: np.zeros((1088, 2048), dtype=np.uint8) for name in factory.camera_names}
    kinds: dict[str, list[np.ndarray[Any, Any]]] = {"nobody": [], "viewers": []}
    with imgcal.RigKeeper(factory, obj) as keeper, LivePage(factory, obj, Address(port=0)) as page:
        clock = iter(range(10**9))

        def turn(count: int) -> np.ndarray[Any, Any]:
            rows = []
            begun = time.monotonic()
            for number in range(count):
                time.sleep(max(0.0, begun + number / options.rate - time.monotonic()))
                seconds = next(clock) / options.rate
                blobs = running.snapshot(seconds)
                wall, cpu = time.perf_counter(), time.thread_time()
                page.publish(keeper.update(blobs, 1e9 + seconds), frames)
                rows.append((time.perf_counter() - wall, time.thread_time() - cpu))
            return np.array(rows) * 1e3

        turn(150)  # the first updates learn the rig and compile code
        for _ in range(options.turns):
            kinds["nobody"].append(turn(options.updates))
            with looked_at(page, options.viewers):
                kinds["viewers"].append(turn(options.updates))
    rows = {}
    for name, turns in kinds.items():
        wall, cpu = np.concatenate(turns).T
        rows[name] = {
            "updates": len(wall),
            **{f"p{q}_ms": float(np.quantile(wall, q / 100)) for q in (50, 95, 99)},
            **{f"cpu_p{q}_ms": float(np.quantile(cpu, q / 100)) for q in (50, 99)},
        }
    return {"viewers": options.viewers, "rate": options.rate, "rows": rows}


def table(result: Mapping[str, Any]) -> str:
    """Make the table, as Markdown."""
    keys = ("p50_ms", "p95_ms", "p99_ms", "cpu_p50_ms", "cpu_p99_ms")
    names = {"nobody": "no viewers", "viewers": f"{result['viewers']} viewers, and one that never reads"}
    rows = [[names[name], *(f"{row[key]:.2f}" for key in keys)] for name, row in result["rows"].items()]
    return markdown(["update and publication, ms", "p50", "p95", "p99", "CPU p50", "CPU p99"], rows)


def main() -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, description=__doc__)
    before = surroundings()
    write_json(options.out, before | measure(options))
    print(table(read_json(options.out)))


if __name__ == "__main__":
    command(main)
