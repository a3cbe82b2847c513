"""Functions that misbehave are sent by value: workers do not have this file's folder on their path."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
import ray

import imgcal
from imgcal.fleet import Done, Engine, Lost
from imgcal.fleet.engine import GRACE


def square(number: int) -> int:
    return number * number


def misbehaving(items: Sequence[str]) -> list[str]:
    for item in items:
        if item == "crash":
            os.kill(os.getpid(), signal.SIGKILL)
    return [item.upper() for item in items]


def hanging(items: Sequence[str | Path]) -> list[str]:
    """Write the number of the process into a file, and do not end."""
    for item in items:
        if isinstance(item, Path):
            item.with_suffix(".part").write_text(str(os.getpid()))
            item.with_suffix(".part").rename(item)
            time.sleep(1000)
    return [str(item).upper() for item in items]


def test_results_come_in_the_order_of_the_items(engine: Engine) -> None:
    ray.cloudpickle.register_pickle_by_value(__import__(__name__, fromlist=["square"]))
    assert list(engine.map(square, range(20))) == [n * n for n in range(20)]


def test_only_the_item_that_kills_its_process_is_lost(engine: Engine) -> None:
    ray.cloudpickle.register_pickle_by_value(__import__(__name__, fromlist=["square"]))
    outcomes = list(engine.run(misbehaving, [["a", "crash", "b"], ["c"]]))
    assert [o.item for o in outcomes if isinstance(o, Lost)] == ["crash"]
    done = [result for o in outcomes if isinstance(o, Done) for result in o.results]
    assert sorted(done) == ["A", "B", "C"]


def test_what_does_not_end_is_stopped(engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray.cloudpickle.register_pickle_by_value(__import__(__name__, fromlist=["square"]))
    outcomes = engine.run(hanging, [[tmp_path / "begun"], ["a"]], seconds=1.0)
    assert next(outcomes).results == ["A"]
    until = time.monotonic() + 120.0
    while not (tmp_path / "begun").exists() and time.monotonic() < until:
        time.sleep(0.05)
    process = int((tmp_path / "begun").read_text())
    late = SimpleNamespace(monotonic=lambda: time.monotonic() + GRACE + 2.0)  # nobody waits for so long
    monkeypatch.setattr("imgcal.fleet.engine.time", late)
    assert [(o.item, o.timed_out) for o in outcomes] == [(tmp_path / "begun", True)]
    while Path(f"/proc/{process}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{process}").exists()


def test_no_more_is_read_than_is_needed(engine: Engine) -> None:
    ray.cloudpickle.register_pickle_by_value(__import__(__name__, fromlist=["square"]))
    read = 0

    def batches() -> Iterator[list[str]]:
        nonlocal read
        for _ in range(100):
            read += 1
            yield ["a"]

    outcomes = engine.run(misbehaving, batches())
    next(outcomes)
    assert read <= 2 * engine.cores + 1
    assert len(list(outcomes)) == 99


def test_an_error_of_the_function_is_raised(engine: Engine) -> None:
    with pytest.raises(TypeError):
        list(engine.map(len, [1]))


def test_an_address_where_nobody_is_ends_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray itself would wait for minutes."""
    monkeypatch.setattr("imgcal.fleet.engine.PATIENCE", 0.5)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        for address, expected in (
            ("head", "found head"),
            (f"127.0.0.1:{port}", "timed out"),
            (f"ray://127.0.0.1:{port}", "timed out"),
            ("127.0.0.1:99999", "found no cluster"),
        ):
            with pytest.raises(imgcal.InputError, match=f"--address: .*{expected}.*HOST:PORT"), Engine(address):
                pass
    with pytest.raises(imgcal.InputError, match="found no cluster at "), Engine(f"127.0.0.1:{port}"):
        pass


def test_something_else_that_listens_is_told_from_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(imgcal.InputError, match="not Ray"), Engine(f"127.0.0.1:{server.getsockname()[1]}"):
            pass


CLUSTER = """
import time
from ray.cluster_utils import Cluster
from imgcal.fleet import Done, Engine

def slow(items):
    time.sleep(0.2)
    return [item + 1 for item in items]

if __name__ == "__main__":
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    first = cluster.add_node(num_cpus=1)
    results, died = [], False
    with Engine(cluster.address) as engine:
        for outcome in engine.run(slow, [[n] for n in range(12)]):
            assert isinstance(outcome, Done), outcome
            results += outcome.results
            if len(results) >= 3 and not died:
                died = True
                cluster.add_node(num_cpus=1)
                cluster.remove_node(first, allow_graceful=False)
    cluster.shutdown()
    print(sorted(results) == list(range(1, 13)))
"""


def test_a_node_that_dies_costs_time_only(tmp_path: Path) -> None:
    """Machines are simulated by processes; the one that works is switched off."""
    (tmp_path / "cluster.py").write_text(CLUSTER)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(tmp_path)])}
    environment |= {"RAY_worker_niceness": "0"}  # else they starve on a machine that is busy
    done = subprocess.run(
        [sys.executable, "cluster.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=240
    )
    assert done.stdout.strip().splitlines()[-1:] == ["True"], done.stderr[-2000:]
