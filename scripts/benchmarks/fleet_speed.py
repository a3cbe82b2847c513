"""What does a fleet cost? Captures per second, engine overhead, nodes that die, bytes, the driver's memory.

Run as `python -m scripts.benchmarks.fleet_speed`; `--only overhead` repeats one part and keeps the others. Work is
reported in CPU seconds, since other load on the machine affects these less, with rates in wall time and the load.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import tyro
from ray import cloudpickle

from imgcal.cli.main import main as imgcal_command
from imgcal.fleet import Dataset, Done, Engine, Item, Manifest, Settings, recalibrate_fleet, write_manifest
from imgcal.fleet import run as fleet_run
from imgcal.fleet.job import failed_row, process
from imgcal.io import load_object, read_rig, save_detections
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
from scripts.output import ROOT, command, fill, markdown, read_json, surroundings, write_json

RESULT, PAGE = ROOT / "docs" / "benchmarks" / "fleet_speed.json", ROOT / "docs" / "fleet.md"
DRIFT = PhysicalDrift(0.17, 1.5, 0.004, 3.0, 0.005)
KINDS = {"blobs, T4, 3 snapshots": ("T4", 3), "blobs, O10, 5 snapshots": ("O10", 5)}
FRAMES = "frames, T4, 3 snapshots"
SHARES = {"blobs, O10, 5 snapshots": 3, FRAMES: 4}
"""Divisors of the number of captures, for slower kinds."""
PLANNED, USE = 1_000_000, 0.7  # captures per day, planned utilization of the cores
TARGETS = {"blobs": 5.0, "frames": 1.0}  # overhead in % of the work


@dataclass(frozen=True)
class Options:
    """Measure fleets."""

    captures: int = 64  #: captures of blobs in each measurement
    rounds: int = 2
    rows: int = 1_000_000  #: rows of the manifest for the driver's memory
    only: tuple[str, ...] = ()  #: parts to measure again: overhead, nodes, death, bytes, memory
    out: Path = RESULT
    again: bool = False  #: measure nothing: rewrite the tables from the existing JSON


def write_blobs(path: Path, rig: str, snapshots: int, seed: int) -> None:
    """Write a table of unlabelled blobs of a drifted rig."""
    generator = torch.Generator().manual_seed(seed)
    truth = simulate_truth(read_rig(rig), load_object("asymmetric8"), snapshots, generator, DRIFT)
    seen = true_detections(truth)
    noise = np.random.default_rng(seed).normal(0.0, 0.1, seen.uv.shape)
    unlabelled = np.full(len(seen.uv), -1)
    save_detections(replace(seen, uv=seen.uv + noise, sigma=np.full(len(seen.uv), 0.1), fiducial=unlabelled), path)


def fleet_of(folder: Path, kind: str, captures: int) -> Manifest:
    """Make a manifest of devices that share eight captures; every row is processed separately."""
    rig, rows = "T4", []
    if kind == FRAMES:
        out = folder / "frames"
        if not out.exists():
            given = ["--rig", rig, "--object", "asymmetric8", "--snapshots", "3", "--out", str(out), "--seed", "1"]
            assert imgcal_command(["simulate", *given]) == 0
        paths = [out]
    else:
        rig, snapshots = KINDS[kind]
        paths = [folder / f"{rig}-{snapshots}-{seed}.csv" for seed in range(8)]
        for seed, path in enumerate(paths):
            if not path.exists():
                write_blobs(path, rig, snapshots, seed)
    for number in range(captures):
        rows.append({"capture": str(paths[number % len(paths)]), "device": f"d{number}"})
    path = folder / f"{kind.replace(', ', '-').replace(' ', '_')}-{captures}.csv"
    write_manifest(path, rows)
    return Manifest(str(path), rig, "asymmetric8")


def cpu_seconds() -> dict[str, float]:
    """CPU time of this process and its descendants, by kind of process."""
    processes: dict[int, tuple[int, str, float]] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            name, rest = (folder / "stat").read_text().partition("(")[2].rsplit(")", 1)
            title = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        fields = rest.split()
        spent = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        processes[int(folder.name)] = (int(fields[1]), title or name, spent)
    found = dict.fromkeys(("driver", "workers", "engine", "around"), 0.0)
    for pid, (_, title, spent) in processes.items():
        ancestor = pid
        while ancestor in processes and ancestor != os.getpid():
            ancestor = processes[ancestor][0]
        if ancestor == os.getpid():
            what = "driver" if pid == os.getpid() else "workers" if title.startswith("ray::_p") else "around"
            what = "engine" if "raylet/raylet " in title or "gcs_server " in title else what
            found[what if not title.startswith("ray::IDLE") else "workers"] += spent
    return found


def overhead(folder: Path, options: Options) -> dict[str, Any]:
    """Measure the engine's overhead by kind of capture: medians over rounds."""
    found: dict[str, Any] = {}
    with Engine(cores=1) as engine:
        recalibrate_fleet(fleet_of(folder, FRAMES, 2), Dataset(Path(tempfile.mkdtemp(dir=folder))), engine)
        idle, seconds = cpu_seconds(), 20.0
        time.sleep(seconds)  # CPU time of Ray's own threads and processes when idle
        now = cpu_seconds()
        idle = {name: (now[name] - idle[name]) / seconds for name in ("driver", "engine")}
        for kind in (*KINDS, FRAMES):
            captures = max(8, options.captures // SHARES.get(kind, 1))
            batch = 32 if kind != FRAMES else 8
            manifest = fleet_of(folder, kind, captures)
            rounds = []
            for number in range(options.rounds + 1):  # the first round loads and compiles code
                dataset = Dataset(Path(tempfile.mkdtemp(dir=folder)))
                began, before = time.perf_counter(), cpu_seconds()
                count = recalibrate_fleet(manifest, dataset, engine, batch=batch)
                seconds, after = time.perf_counter() - began, cpu_seconds()
                spent = {name: after[name] - before[name] - idle.get(name, 0.0) * seconds for name in after}
                assert count.status["ok"] == captures, count.status
                work = sum(dataset.latest(("cpu_seconds",))["cpu_seconds"].to_pylist())
                plain = plain_loop(manifest)
                if number:
                    rounds.append({
                        "work": work / captures, "workers": spent["workers"] / captures, "seconds": seconds / captures,
                        "driver": max(0.0, spent["driver"]) / captures,
                        "engine": max(0.0, spent["engine"]) / captures, "idle_per_s": sum(idle.values()),
                        "plain": plain,
                    })  # fmt: skip
            row = {name: median(one[name] for one in rounds) for name in rounds[0]}
            found[kind] = {"captures": captures, "batch": batch, **row}
            print(kind, found[kind], flush=True)
    return found


def plain_loop(manifest: Manifest) -> float:
    """CPU seconds per capture in a loop in this process."""
    items = [item for batch in manifest.batches(1000) for item in batch]
    torch.set_num_threads(1)
    process(items[0], Settings())
    before = time.process_time()
    for item in items:
        process(item, Settings())
    return (time.process_time() - before) / len(items)


def bytes_moved(folder: Path) -> dict[str, Any]:
    """Bytes per capture: read, sent to a worker, and sent back."""
    found = {}
    for kind in (*KINDS, FRAMES):
        items = next(fleet_of(folder, kind, 32).batches(32))
        path = Path(items[0].capture)
        files = [file for file in path.rglob("*") if file.is_file() and "truth" not in file.parts]
        read = sum(file.stat().st_size for file in files) if path.is_dir() else path.stat().st_size
        rows = [process(item, Settings()) for item in items[: 1 if kind == FRAMES else 8]]  # all different
        dataset = Dataset(Path(tempfile.mkdtemp(dir=folder)))
        with dataset.open_writer() as writer:
            writer.add([row for row in rows if row is not None])
        found[kind] = {
            "read": read,
            "to_worker": len(cloudpickle.dumps(items)) / len(items),
            "from_worker": len(cloudpickle.dumps(rows)) / len(rows),
            "stored": sum(path.stat().st_size for path in dataset.files()) / len(rows),
        }
    return found


def rates(folder: Path, options: Options) -> dict[str, Any]:
    """Measure captures per second of wall time, and CPU seconds per capture, with cores and with simulated nodes."""
    from ray.cluster_utils import Cluster

    captures = max(8, options.captures // 2)
    manifest = fleet_of(folder, next(iter(KINDS)), captures)

    def run(engine: Engine) -> dict[str, Any]:
        recalibrate_fleet(manifest, Dataset(Path(tempfile.mkdtemp(dir=folder))), engine, batch=8)  # loads, compiles
        dataset = Dataset(Path(tempfile.mkdtemp(dir=folder)))
        began, load = time.perf_counter(), os.getloadavg()[0]
        recalibrate_fleet(manifest, dataset, engine, batch=8)
        work = sum(dataset.latest(("cpu_seconds",))["cpu_seconds"].to_pylist())
        rate = captures / (time.perf_counter() - began)
        return {"rate": rate, "cpu_seconds": work / captures, "load": max(load, os.getloadavg()[0])}

    found = {}
    for cores in (1, 2):
        with Engine(cores=cores) as engine:
            found[f"{cores} core{'s'[: cores > 1]}"] = run(engine)
    for nodes in (1, 2, 4):
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        try:
            for _ in range(nodes):
                cluster.add_node(num_cpus=1)
            with Engine(cluster.address) as engine:
                found[f"{nodes} node{'s'[: nodes > 1]}"] = run(engine)
        finally:
            cluster.shutdown()
        print(found, flush=True)
    return found


def death(seconds: float = 0.5, batches: int = 60) -> dict[str, Any]:
    """Node seconds lost when one of two nodes is switched off; the work is sleep, so load has little effect."""
    from ray.cluster_utils import Cluster

    def sleeping(items: Sequence[int]) -> list[int]:
        time.sleep(seconds)
        return list(items)

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
    done, died = 0, 0.0
    try:
        with Engine(cluster.address) as engine:
            list(engine.run(sleeping, [[n] for n in range(8)]))  # start the processes
            began = time.perf_counter()
            for outcome in engine.run(sleeping, [[n] for n in range(batches)]):
                assert isinstance(outcome, Done), outcome
                done += 1
                if done == batches // 3:
                    died = time.perf_counter() - began
                    cluster.remove_node(nodes[0], allow_graceful=False)
            took = time.perf_counter() - began
    finally:
        cluster.shutdown()
    lost = 2 * died + (took - died) - batches * seconds
    return {"batch_seconds": seconds, "batches": batches, "done": done, "lost_node_seconds": lost}


def stubbed(items: Sequence[Item], settings: Settings, known: Any) -> list[dict[str, Any]]:
    """Make rows without work, to measure the driver's memory and time."""
    return [failed_row(item, "refused", "stub") | {"key": _key(item.row)} for item in items]


def _key(row: int) -> str:
    return f"{row * 0x9E3779B97F4A7C15 % 2**64:016x}{row:016x}"


def memory(folder: Path, rows: int) -> dict[str, Any]:
    """Driver's own memory for a manifest of very many rows that share a few files, without any work."""
    path = folder / "many.csv"
    with path.open("w", encoding="utf-8") as file:
        file.write("capture,device,time\n")
        for row in range(rows):
            file.write(f"{folder}/T4-3-{row % 8}.csv,d{row},{1_700_000_000 + row // 12}\n")
    curve: list[tuple[int, float]] = []

    def tell(count: Any) -> None:
        if not curve or count.read - curve[-1][0] >= rows // 20 or count.read == rows:
            status = Path("/proc/self/status").read_text()
            curve.append((count.read, int(status.partition("RssAnon:")[2].split()[0]) / 1024))

    real, fleet_run._process = fleet_run._process, stubbed  # type: ignore[assignment]
    try:
        with Engine(cores=1) as engine:
            dataset, manifest = Dataset(Path(tempfile.mkdtemp(dir=folder))), Manifest(str(path), "T4", "asymmetric8")
            before = time.process_time()
            count = recalibrate_fleet(manifest, dataset, engine, tell=tell, batch=512)
            spent = time.process_time() - before
    finally:
        fleet_run._process = real
    assert count.read == rows and count.status["refused"] == rows and len(dataset.keys()) == rows
    return {"rows": rows, "curve_mb": curve, "driver_cpu_us": 1e6 * spent / rows}


def driver(folder: Path, rows: int = 2048) -> dict[str, float]:
    """CPU seconds of the driver per capture, with rows of realistic size made without work."""
    found: dict[str, float] = {}
    real = fleet_run._process
    with Engine(cores=1) as engine:
        for kind in (*KINDS, FRAMES):
            template = process(next(fleet_of(folder, kind, 1).batches(1))[0], Settings())
            assert template is not None

            def full(items: Sequence[Item], settings: Settings, known: Any, row: Any = template) -> list[Any]:
                return [row | {"item": _key(item.row), "key": _key(item.row)} for item in items]

            manifest = fleet_of(folder, kind, rows)
            try:
                fleet_run._process = full
                recalibrate_fleet(fleet_of(folder, kind, 64), Dataset(Path(tempfile.mkdtemp(dir=folder))), engine)
                before = time.process_time()
                count = recalibrate_fleet(manifest, Dataset(Path(tempfile.mkdtemp(dir=folder))), engine)
                found[kind] = (time.process_time() - before) / rows
            finally:
                fleet_run._process = real
            assert count.status["ok"] == rows
    return found


PARTS: dict[str, Callable[[Path, Options], Any]] = {
    "bytes": lambda folder, options: bytes_moved(folder),
    "overhead": overhead,
    "driver": lambda folder, options: driver(folder),
    "death": lambda folder, options: death(),
    "nodes": rates,
    "memory": lambda folder, options: memory(folder, options.rows),
}


def engine_share(result: Mapping[str, Any]) -> dict[str, Any]:
    """Add the engine's overhead in percent of the work, and of a plain loop, to the results of each kind of capture.

    The overhead is the workers' CPU time beyond that of the captures, the driver's, and the scheduler's. The driver's
    is measured separately over thousands of rows, since it is less than Ray's idle CPU time.
    """
    found = {}
    for kind, row in result["overhead"].items():
        spent = row["workers"] + result["driver"][kind] + row["engine"]
        percent = {"percent": 100 * (spent / row["work"] - 1), "percent_plain": 100 * (spent / row["plain"] - 1)}
        found[kind] = row | {"driver": result["driver"][kind]} | percent
    return found


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables, by the names of their markers."""
    result = result | {"overhead": engine_share(result)}
    makers = {"overhead": _overhead, "nodes": _rates, "bytes": _bytes, "memory": _memory, "death": _death}
    names = {"nodes": "rates"}
    return {
        f"fleet {names.get(part, part)}": make(result[part]) if part in result else "Not measured yet."
        for part, make in makers.items()
    } | {"fleet plan": _plan(result["overhead"])}


def _plan(result: dict[str, Any]) -> str:
    seconds = {kind: row["work"] * (1 + max(row["percent"], 0.0) / 100) for kind, row in result.items()}
    cores = ", ".join(f"{PLANNED / 86_400 * value / USE:.2g} for {kind}" for kind, value in seconds.items())
    rate = PLANNED / 86_400
    return f"A million captures per day are {rate:.1f} per second. Cores needed at {100 * USE:.0f} % load: {cores}."


def _overhead(result: dict[str, Any]) -> str:
    rows = [
        [kind, str(row["captures"]), *(f"{1e3 * row[name]:.3g}" for name in ("plain", "work", "driver")),
         f"{row['percent']:+.2g} %", f"{row['percent_plain']:+.2g} %", f"{TARGETS[kind.partition(',')[0]]:g} %"]
        for kind, row in result.items()
    ]  # fmt: skip
    head = [
        "capture", "captures", "plain loop, CPU ms", "work in a worker, CPU ms", "driver, CPU ms",
        "engine overhead on the work", "on the plain loop", "target",
    ]  # fmt: skip
    idle = 1e3 * max(row["idle_per_s"] for row in result.values())
    return f"{markdown(head, rows)}\n\nEven when idle, Ray takes {idle:.0f} CPU ms per second on a machine."


def _rates(result: dict[str, Any]) -> str:
    rows = [
        [who, f"{row['rate']:.2g}", f"{1e3 * row['cpu_seconds']:.3g}", f"{row['load']:.0f}"]
        for who, row in result.items()
    ]
    return markdown(["engine", "captures per second", "CPU ms per capture", "load average"], rows)


def _bytes(result: dict[str, Any]) -> str:
    rows = [
        [kind, *(f"{row[name] / 1e3:.3g}" for name in ("read", "to_worker", "from_worker", "stored"))]
        for kind, row in result.items()
    ]
    return markdown(["kB per capture", "read", "to a worker", "back", "kept (Parquet)"], rows)


def _memory(result: dict[str, Any]) -> str:
    curve = result["curve_mb"]
    shown = [*curve[: -1 : max(1, len(curve) // 6)], curve[-1]]
    cells = ["driver, MB", *(f"{mb:.0f}" for _, mb in shown)]
    told = f"{result['driver_cpu_us']:.0f} CPU microseconds of the driver per row."
    return f"{markdown(['rows done', *(f'{rows:,}' for rows, _ in shown)], [cells])}\n\n{told}"


def _death(result: dict[str, Any]) -> str:
    return (
        f"{result['lost_node_seconds']:.1f} node seconds, with batches of {result['batch_seconds']:g} s; all "
        f"{result['done']} results arrived exactly once."
    )


def main() -> None:
    """Measure the requested parts, write the JSON, and rewrite the page."""
    options = tyro.cli(Options, description=__doc__)
    os.environ.setdefault("RAY_worker_niceness", "0")  # for simulated nodes too
    result = read_json(options.out) if options.out.is_file() else {}
    if not options.again:
        with tempfile.TemporaryDirectory() as folder:
            for name, measure in PARTS.items():
                if not options.only or name in options.only:
                    result |= surroundings() | {name: measure(Path(folder), options)}
                    write_json(options.out, result)
    if options.out.resolve() == RESULT:
        fill(PAGE, tables(result))
        print("\n\n".join(tables(result).values()))


if __name__ == "__main__":
    command(main)
