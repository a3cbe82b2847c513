"""Try thousands of damaged inputs and report faults: `python -m scripts.fuzz --minutes 10 --seed 1`.

A worker runs the cases in its own process, so that a crash or a hang is found like any other fault. An input that does
not end in a one-line message is a fault. `--only N` repeats one case and shows its traceback.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PATIENCE = 120.0  # s, time limit of one case
MOST_MEMORY = 6 * 2**30  # bytes, memory limit of a worker


def main() -> int:
    """Run the campaign and return an exit code: 1 if a fault was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of one case to repeat")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--place", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker is not None:
        return work(given.place, given.seed, given.worker)
    with tempfile.TemporaryDirectory() as place:
        if given.only is not None:
            return repeat(Path(place), given.seed, given.only)
        return campaign(Path(place), given.seed, given.minutes)


def campaign(place: Path, seed: int, minutes: float) -> int:
    """Run one worker after another until the time is up; each starts after the case that ended the one before it."""
    end, number, faults = time.monotonic() + 60 * minutes, 0, 0
    while time.monotonic() < end:
        command = [sys.executable, "-m", "scripts.fuzz", "--seed", str(seed), "--worker", str(number)]
        worker = subprocess.Popen([*command, "--place", str(place)], stdout=subprocess.PIPE)
        assert worker.stdout is not None
        number, words = _follow(worker, number, end)
        faults += len(words)
        for word in words:
            print(word, flush=True)
    print(f"{number} cases with seed {seed}: {faults} faults")
    return int(faults > 0)


def _follow(worker: subprocess.Popen[bytes], number: int, end: float) -> tuple[int, list[str]]:
    """Read a worker's output until time is up, it ends or it hangs; return the next case's number and the faults."""
    assert worker.stdout is not None
    os.set_blocking(worker.stdout.fileno(), False)
    words, pending, heard = [], b"", time.monotonic()
    while True:
        time.sleep(0.05)
        pending += worker.stdout.read() or b""
        *lines, pending = pending.split(b"\n")
        for line in lines:
            heard = time.monotonic()
            count, _, fault = line.decode(errors="replace").partition(" ")
            number = int(count) + 1
            if fault:
                words.append(f"case {count}: {fault}")
        ended = worker.poll()
        hangs = time.monotonic() - heard > PATIENCE
        if ended is not None or hangs:
            worker.kill()
            words.append(f"case {number}: " + ("hangs" if ended is None else f"the process ended with {ended}"))
            return number + 1, words
        if time.monotonic() > end:
            worker.kill()
            worker.wait()
            return number, words


def work(place: Path, seed: int, first: int) -> int:
    """Run cases and write the number of each, and its fault if there is one."""
    from scripts.fuzz.cases import case, prepare
    from scripts.fuzz.verdict import run

    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY, MOST_MEMORY))
    sound = place / "sound"
    if not sound.exists():
        prepare(sound)
    number = first
    while True:
        folder = place / "case"
        shutil.rmtree(folder, ignore_errors=True)
        made = case(sound, folder, seed, number)
        fault = run(made)
        words = f"{made.damage!r} {made.arguments[0]}: {fault!r}" if fault else ""
        sys.stdout.buffer.write(f"{number} {words}\n".encode(errors="replace"))
        sys.stdout.buffer.flush()
        number += 1


def repeat(place: Path, seed: int, number: int) -> int:
    """Run one case in the foreground, with its traceback."""
    from imgcal.cli.main import main as command
    from scripts.fuzz.cases import case, prepare

    prepare(place / "sound")
    made = case(place / "sound", place / "case", seed, number)
    print(made.damage, *map(repr, made.arguments), file=sys.stderr)
    return command([*made.arguments, "--debug"])


if __name__ == "__main__":
    sys.exit(main())
