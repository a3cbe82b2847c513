"""Compare detectors on simulated captures: ``python -m scripts.results.detectors``.

`tune` tries settings of the classical detector and of data association on validation captures and keeps the best for
each difficulty. `compare` then calibrates test captures, which have other seeds, with each detector, and writes the
tables of docs/results/tables.md. Earlier measurements stay in the JSON: another call adds or replaces detectors.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import torch
import tyro

from imgcal import load_object, load_rig
from imgcal.association import PipelineOptions
from imgcal.cli.compare import contender
from imgcal.detection import DetectionOptions
from imgcal.evaluation import Contender, Outcome, Scene, compare_detectors, detector_tables
from imgcal.fleet import workers
from imgcal.synthesis import DIFFICULTIES, FrameModel
from scripts.output import RESULTS, ROOT, command, fill, read_json, surroundings, write_json

TUNING, COMPARISON = "detectors-tuning.json", "detectors.json"
PAGE = ROOT / "docs" / "results" / "tables.md"
TEST, VALIDATION = 0, 1  # seeds: captures that are reported, and captures on which settings are chosen
TUNED = "classical, tuned"

# Settings to try, each for the needs of some difficulty. "blind": cameras that saw nothing keep factory values;
# "loose": blobs may lie farther from the prediction during data association; "lenient": in the result, too.
BLIND = PipelineOptions(blind_cameras=True)
LENIENT = replace(BLIND, identity_error=2.0, largest_additive_noise=5.0, most_outliers=0.5)
LARGE = DetectionOptions(max_elongation=12.0, max_radius=40.0)
VARIANTS: dict[str, tuple[DetectionOptions, PipelineOptions]] = {
    "default": (DetectionOptions(), PipelineOptions()),
    "blind": (DetectionOptions(), BLIND),
    "blind, threshold 5, dim blobs": (DetectionOptions(threshold=5.0, dim_blobs=True), BLIND),
    "blind, threshold 40": (DetectionOptions(threshold=40.0), BLIND),
    "blind, long and large": (LARGE, BLIND),
    "blind, loose": (DetectionOptions(), replace(BLIND, identity_error=1.0)),
    "lenient": (DetectionOptions(), LENIENT),
    "lenient, long and large": (LARGE, LENIENT),
}


@dataclass(frozen=True)
class Options:
    """Compare detectors on simulated captures."""

    step: Annotated[str, tyro.conf.Positional]  #: tune | compare | page
    detectors: tuple[
        Path, ...
    ] = ()  #: besides the classical one: values of `imgcal calibrate --detector`, or run folders
    captures: int = 8  #: captures per difficulty
    snapshots: int = 2  #: snapshots per capture
    difficulty: tuple[str, ...] = tuple(DIFFICULTIES)
    rig: str = "O10"
    object: str = "asymmetric8"
    address: str | None = None  #: running Ray cluster that processes the captures; None = this machine
    cores: int | None = None  #: of this machine; 1 = this process alone; None = all
    classical: bool = True  #: also measure the classical detectors
    results: Path = RESULTS


def main(arguments: list[str] | None = None) -> None:
    """Run one step."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    torch.set_num_threads(1)
    models = {name: FrameModel(difficulty=DIFFICULTIES[name]) for name in options.difficulty}
    scene = Scene(load_rig(options.rig), load_object(options.object), models, options.snapshots)
    if options.step == "tune":
        tune(scene, options)
    elif options.step == "compare":
        compare(scene, options)
    write_page(options.results)


def tune(scene: Scene, options: Options) -> None:
    """Try all variants on validation captures."""
    variants = [
        Contender(name, detection=dict.fromkeys(scene.models, detection), pipeline=pipeline)
        for name, (detection, pipeline) in VARIANTS.items()
    ]
    outcomes = _measured(variants, scene, options, VALIDATION)
    place = options.results / TUNING
    chosen: dict[str, Any] = read_json(place)["chosen"] if place.is_file() else {}
    for difficulty in scene.models:
        scores = {name: _score([one for one in outcomes if (one.contender, one.difficulty) == (name, difficulty)])
                  for name in VARIANTS}  # fmt: skip
        chosen[difficulty] = {"variant": max(scores, key=lambda name: scores[name]), "scores": scores}
    write_json(place, surroundings() | {"captures": options.captures, "snapshots": scene.snapshots}
               | {"chosen": chosen})  # fmt: skip


def _score(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Right minus wrong captures; the smaller error breaks ties."""
    share = sum({"calibrated": 1.0, "wrong": -1.0}.get(one.status, 0.0) for one in outcomes) / len(outcomes)
    px = [one.held_out_px for one in outcomes if one.held_out_px is not None and one.status == "calibrated"]
    return share, -round(median(px), 3) if px else -1e3


def compare(scene: Scene, options: Options) -> None:
    """Calibrate test captures, and add the outcomes to the known ones."""
    contenders = [contender(path) for path in options.detectors]
    contenders = [replace(one, pipeline=BLIND) for one in contenders]
    if options.classical:
        contenders += [Contender("classical"), *tuned(options.results, scene)]
    began, before = time.monotonic(), surroundings()
    outcomes = _measured(contenders, scene, options, TEST)
    place = options.results / COMPARISON
    known = read_json(place) if place.is_file() else {}
    same = known.get("captures") == options.captures and known.get("snapshots") == scene.snapshots
    fresh = {(one.contender, one.training_seed, one.difficulty) for one in outcomes}
    kept = [
        row
        for row in (known.get("outcomes", []) if same else [])
        if (row["contender"], row["training_seed"], row["difficulty"]) not in fresh
    ]
    result = {"rig": scene.rig.name, "object": scene.obj.name, "captures": options.captures}
    result |= {"snapshots": scene.snapshots, "drift": vars(scene.drift), "seconds": round(time.monotonic() - began)}
    write_json(place, before | result | {"outcomes": kept + [asdict(one) for one in outcomes]})


def tuned(results: Path, scene: Scene) -> list[Contender]:
    """The classical detector with the settings that were best on validation captures, per difficulty."""
    place = results / TUNING
    if not place.is_file():
        return []
    chosen: Mapping[str, Any] = read_json(place)["chosen"]
    return [
        Contender(
            TUNED, detection={difficulty: VARIANTS[variant][0]}, pipeline=VARIANTS[variant][1], only=(difficulty,)
        )
        for difficulty in scene.models
        for variant in [chosen[difficulty]["variant"]]
    ]


def _measured(contenders: Sequence[Contender], scene: Scene, options: Options, seed: int) -> tuple[Outcome, ...]:
    total, done, began = options.captures * len(scene.models), [0], time.monotonic()

    def show(count: int) -> None:
        done[0] += count
        print(f"{done[0]} of {total} captures, {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)

    with workers(options.address, options.cores) as mapped:
        return compare_detectors(contenders, scene, options.captures, seed, show, mapped)


def _order(outcome: Outcome) -> tuple[int, int]:
    """Sort key: difficulties in their usual order, the classical detector first."""
    return list(DIFFICULTIES).index(outcome.difficulty), -outcome.contender.startswith("classical")


def write_page(results: Path) -> None:
    """Write the tables into the page, if the results are the committed ones."""
    place = results / COMPARISON
    if results != RESULTS or not place.is_file():
        return
    known = read_json(place)
    outcomes = sorted((Outcome(**row) for row in known["outcomes"]), key=_order)
    text = (
        f"Rig {known['rig']}, object {known['object']}, {known['captures']} captures per difficulty with "
        f"{known['snapshots']} snapshots, drift of all 15 values of each camera."
    )
    texts = [text, *(f"{table.markdown()}".strip() for table in detector_tables(outcomes))]
    if (results / TUNING).is_file():
        chosen = read_json(results / TUNING)["chosen"]
        variants = ", ".join(f"{difficulty}: {one['variant']}" for difficulty, one in chosen.items())
        texts.append(f"Settings of the tuned classical detector: {variants}.")
    fill(PAGE, {"detectors": "\n\n".join(texts)})


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
