"""Functions are sent by value: workers do not have this file's folder on their path."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import ray
import torch

import imgcal
from imgcal.evaluation import QUICK_BASELINES, Conditions, Protocol, evaluate
from imgcal.fleet import Engine, StoredResults, workers
from imgcal.synthesis import Corruption


def drawn(seed: int) -> dict[str, Any]:
    """Sums whose last bits depend on the number of threads, if it is not always one."""
    numbers = torch.randn(512, 512, generator=torch.Generator().manual_seed(seed))
    return {"seed": seed, "sum": float((numbers @ numbers).sum()), "row": numbers[0] @ numbers}


def refusing(seed: int) -> int:
    if seed == 3:
        raise imgcal.InputError("seed: found 3, expected another one")
    return seed


def same(one: list[dict[str, Any]], other: list[dict[str, Any]]) -> bool:
    return all(
        a["seed"] == b["seed"] and a["sum"] == b["sum"] and bool((a["row"] == b["row"]).all())
        for a, b in zip(one, other, strict=True)
    )


@pytest.fixture(autouse=True)
def by_value() -> None:
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])


@pytest.mark.usefixtures("engine")
def test_two_workers_say_what_one_process_says() -> None:
    with workers(cores=1) as here, workers(cores=2) as there:
        assert same(list(here(drawn, range(6))), list(there(drawn, range(6))))


@pytest.mark.usefixtures("engine")
def test_an_evaluation_is_the_same_wherever_it_is_done() -> None:
    known = Conditions(imgcal.load_rig("T4"), imgcal.load_object("cube8"), corruption=Corruption(noise=0.1))
    few = Protocol(count=10, trials=2, batch=4, bound_count=5)
    methods = QUICK_BASELINES | {"slow": replace(QUICK_BASELINES["MAP from PnP"], most=3, batch=2)}
    plain = evaluate(methods, known, few)
    with workers(cores=2) as mapped:
        other = evaluate(methods, known, few, mapped=mapped)
    assert len(other.rows["slow"].alone.re) == 6 and len(other.reference.bounds[0]) == 8
    for name in ("reference", *methods):
        pair = [e.reference if name == "reference" else e.rows[name].alone for e in (plain, other)]
        for mine, theirs in zip(*((*scores.trials, *scores.bounds) for scores in pair), strict=True):
            for kind in vars(mine):  # to rounding, which iterations carry further
                torch.testing.assert_close(vars(mine)[kind], vars(theirs)[kind], rtol=1e-3, atol=1e-6, equal_nan=True)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("cores", [1, 2])
def test_what_was_stopped_goes_on(tmp_path: Path, cores: int) -> None:
    kept = StoredResults(tmp_path / "kept", "drawn")
    with workers(cores=1) as mapped:
        whole = list(mapped(drawn, range(6)))
    with workers(cores=cores, kept=kept) as mapped:
        begun = mapped(drawn, [1, 4, 5])
        assert next(begun)["seed"] == 1
        begun.close()
    before = {path.name for path in kept.folder.iterdir()}
    assert kept.path(1).name in before and len(before) <= 3
    stamp = kept.path(1).stat().st_mtime_ns
    with workers(cores=cores, kept=kept) as mapped:
        assert same(list(mapped(drawn, range(6))), whole)
    assert len(list(kept.folder.iterdir())) == 6 and kept.path(1).stat().st_mtime_ns == stamp
    kept.path(2).write_bytes(b"half of")  # a disk that was full, say
    with workers(cores=cores, kept=kept) as mapped:
        assert same(list(mapped(drawn, range(6))), whole)
    assert StoredResults(kept.folder, "another matter").get(1) is None
    kept.clear()
    assert not kept.folder.exists()


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("cores", [1, 2])
def test_what_is_wrong_is_said_in_one_line(cores: int) -> None:
    with workers(cores=cores) as mapped, pytest.raises(imgcal.InputError) as caught:
        list(mapped(refusing, range(6)))
    assert type(caught.value) is imgcal.InputError and str(caught.value) == "seed: found 3, expected another one"


def test_hurried_use(engine: Engine, tmp_path: Path) -> None:
    with pytest.raises(imgcal.InputError, match="--cores: found 0"), workers(cores=0):
        pass
    (tmp_path / "file").write_text("")
    with (
        workers(cores=1, kept=StoredResults(tmp_path / "file" / "kept", "")) as mapped,
        pytest.raises(imgcal.InputError, match="cannot be written"),
    ):
        list(mapped(refusing, range(2)))
