"""Test networks that were adapted to frames of the same rig, on degraded real frames.

    IMGCAL_CAPTURES=... python -m scripts.results.own_frames --runs out/own_frames

The sets and degradations are those of `scripts.results.degraded_captures`. One part of each set provides the labelled
crops for training (camera 1 of the lattice, camera 3 of the cavity, views 9 to 15 of the grid); every detector then
calibrates from the rest. The results record which method labelled the snapshots: if a network's proposal is rejected,
the matched filter is tried, and then blobs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor, nn

import imgcal
from imgcal.errors import RefusedError
from imgcal.evaluation import Contender, Outcome, Scene, compare_detectors
from imgcal.fleet import StoredResults, workers
from imgcal.io import MODEL
from imgcal.matching import MatchedFilter
from imgcal.networks import Evidence, InfraredNetwork, Queries, load_infrared, load_measurer
from imgcal.pipeline import LearnedMeasurer
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.pipeline.sources import Detector
from imgcal.synthesis import DIFFICULTIES, FrameModel
from imgcal.training import HELD_OUT, HELD_OUT_PATCHES, TRAIN, TRAIN_PATCHES
from imgcal.training.labelled_crops import cut_labelled
from imgcal.types import CameraRig, Detections
from scripts.output import RESULTS, ROOT, WORK, command, fill, machine, markdown, read_json, surroundings, write_json
from scripts.results import degraded_captures as captures
from scripts.results import infrared, measurer
from scripts.results.degradations import DEGRADATIONS
from tests.captures.sets import dot_grid

JSON, PAGE = RESULTS / "own_frames.json", RESULTS / "infrared.md"
MODELS = ROOT / "data" / "models"
ADAPT = {
    "dots": ("cam1",),
    "cavity": ("cam3",),
    "grid": (),
}  # cameras used for training; views, for the grid
REST = {"dots": ("cam2", "cam3"), "cavity": ("cam4",), "grid": ("cam",)}
MEASURER = "measurer"
ENCODERS = {"ir-cnn": "cnn", "ir-vit": "vit", "ir-vit-stem": "vit-stem"}
SEEDS = (0, 1, 2)
KEY = ("captures", "kind", "level", "detector")  # everything that a result depends on
SIMULATED = {"dots": (2,), "cavity": (0,), "grid": (0,)}  # seeds that calibrate simulated captures
CAPTURES, SNAPSHOTS = 3, 2  # simulated captures of each level of difficulty, and snapshots of each
EVERY = 5  # every fifth crop is held out to stop a training; results come from other cameras or views


@cache
def rest(name: str) -> captures.Task:
    """A set without the part that is used for training."""
    given = captures.task(name, captures.captures_folder())
    names = REST[name]
    rig = given.rig.select([given.rig.camera_names.index(camera) for camera in names])
    return replace(given, frames={camera: given.frames[camera] for camera in names}, rig=rig,
                   held_out=of_cameras(given.held_out, names))  # fmt: skip


def of_cameras(points: Detections, names: tuple[str, ...]) -> Detections:
    """Keep the points of some cameras."""
    number = np.array([names.index(name) if name in names else -1 for name in points.camera_names])
    kept = points.select(number[points.camera] >= 0)
    return replace(kept, camera=number[kept.camera], camera_names=names)


def prepare(runs: Path) -> None:
    """Cut the training crops, labelled by the rig that is calibrated from these frames alone."""
    for name in captures.SETS:
        given = captures.task(name, captures.captures_folder())
        if name == "grid":
            frames = {"cam": dot_grid(captures.captures_folder())[0][captures.CALIBRATE :]}
            rig: CameraRig = given.rig
        else:
            frames = {camera: given.frames[camera] for camera in ADAPT[name]}
            rig = given.rig.select([given.rig.camera_names.index(camera) for camera in ADAPT[name]])
        found = imgcal.calibrate(frames, rig, given.obj, detection=given.detection)
        blobs = imgcal.detect(frames, given.detection)
        crops, patches = cut_labelled(
            lambda s, frames=frames: {camera: each[s] for camera, each in frames.items()},  # type: ignore[misc]
            blobs, found.rig, given.obj, detection=given.detection,
        )  # fmt: skip
        folder = runs / "data" / name
        folder.mkdir(parents=True, exist_ok=True)
        for samples, train_file, held_out_file in (
            (crops, TRAIN, HELD_OUT),
            (patches, TRAIN_PATCHES, HELD_OUT_PATCHES),
        ):
            held_out = torch.arange(len(samples)) % EVERY == EVERY - 1
            samples.select(~held_out).save(folder / train_file, {"set": name})
            samples.select(held_out).save(folder / held_out_file, {"set": name})
        print(f"{name}: {len(crops)} crops, {int(crops.seen.sum())} markers", flush=True)


def trainings(runs: Path, encoders: Iterable[str], seeds: Iterable[int]) -> list[list[str]]:
    """Arguments of `imgcal train` for each adaptation."""
    made = []
    for encoder in encoders:
        start = [] if encoder == "ir-cnn" else [f"network.encoder={ENCODERS[encoder]}",
                                                f'training.init_from="{runs / encoder}"']  # fmt: skip
        for name in captures.SETS:
            for seed in seeds:
                out = adapted(runs, name, encoder, seed)
                made.append(["ir-cnn", "--from", str(runs / "data" / name), "--out", str(out),
                             "--set", *start, f"training.seed={seed}"])  # fmt: skip
    return made


def measurer_trainings(runs: Path) -> list[list[str]]:
    """Arguments of `imgcal train` for each adaptation of the measurer."""
    return [["measurer-cnn", "--from", str(runs / "data" / name), "--out", str(adapted(runs, name, MEASURER, seed)),
             "--set", f"training.seed={seed}"] for name in captures.SETS for seed in SEEDS]  # fmt: skip


def adapted(runs: Path, name: str, encoder: str, seed: int) -> Path:
    """Folder of an adaptation."""
    return runs / f"{name}-{encoder}-{seed}"


def train(runs: Path, cores: int) -> None:
    """Train the encoders' starting networks that are not shipped, and adapt all."""
    todo = []
    for encoder in ENCODERS:
        if encoder != "ir-cnn" and not (runs / encoder / MODEL).is_file():
            todo.append(["ir-cnn", "--out", str(runs / encoder), "--set", f"network.encoder={ENCODERS[encoder]}"])
    run_trainings(todo, cores)
    adaptations = [*trainings(runs, ENCODERS, SEEDS), *measurer_trainings(runs)]
    run_trainings([each for each in adaptations if not (Path(each[4]) / MODEL).is_file()], cores)


def run_trainings(todo: list[list[str]], cores: int) -> None:
    """Run `imgcal train` with each set of arguments, `cores` at a time."""
    waiting, running = list(todo), list[subprocess.Popen[bytes]]()
    while waiting or running:
        while waiting and len(running) < cores:
            arguments = [sys.executable, "-m", "imgcal", "train", *waiting.pop(0)]
            running.append(subprocess.Popen(arguments, env={**os.environ, "OMP_NUM_THREADS": "1"}))
        if running.pop(0).wait():
            raise SystemExit("a training run failed")


class Placed(InfraredNetwork):
    """A query network on any device, for a proposer on the CPU, optionally with a useless encoder."""

    shuffled = False  # the cells of every feature map change places

    @classmethod
    def load(cls, path: Path, device: str, shuffled: bool) -> Placed:
        """Load a network."""
        torch.backends.cudnn.allow_tf32 = False  # as exact as on a CPU
        read = load_infrared(path).network
        made = cls(read.config).eval()
        made.load_state_dict(read.state_dict())
        made.to(device)
        made.encoder.register_forward_pre_hook(lambda module, crops: crops[0].to(device))
        made.encoder.register_forward_hook(made._maps)
        made.shuffled = shuffled
        return made

    def _maps(self, module: nn.Module, crops: Any, maps: Tensor) -> Tensor:
        """Return the feature maps, their cells in random order if the encoder is to be useless."""
        if not self.shuffled:
            return maps
        cells = maps.flatten(2)
        order = torch.randperm(cells.shape[-1], generator=torch.Generator().manual_seed(0))
        return cells[..., order.to(cells.device)].view_as(maps)

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        """Search where the features are; return evidence on the CPU."""
        there = Queries(*(getattr(queries, each.name).to(features.device) for each in fields(Queries)))
        found = super().search(features, there, window)
        return Evidence(*(getattr(found, each.name).cpu() for each in fields(Evidence)))


@dataclass(frozen=True)
class Case:
    """One calibration."""

    captures: str
    kind: str
    level: float
    detector: str  # a name, or "ENCODER seed K", optionally followed by "shuffled"
    runs: str
    device: str  # of the query network

    @property
    def weights(self) -> Path | None:
        """File of the query network, if the detector is one."""
        encoder, _, more = self.detector.partition(" seed ")
        if encoder in ENCODERS:
            return adapted(Path(self.runs), self.captures, encoder, int(more.split()[0])) / MODEL
        return MODELS / "ir-cnn.safetensors" if self.detector == "learned" else None

    def proposer(self) -> Detector:
        """Make the detector."""
        if self.weights is None:
            return self.detector
        network = Placed.load(self.weights, self.device, self.detector.endswith(" shuffled"))
        return LearnedProposer(network, shipped_measurer(), MatchedFilter())


@cache
def shipped_measurer() -> Any:
    """The shipped measurer."""
    return load_measurer(MODELS / "measurer-cnn.safetensors").network


def measured(case: Case) -> dict[str, Any]:
    """Calibrate from the rest of a set, and score the result."""
    torch.set_num_threads(1)
    given = rest(case.captures)
    frames = given.degraded(case.kind, case.level, 0)
    row: dict[str, Any] = {name: getattr(case, name) for name in KEY}
    row |= {"machine": machine(case.device), "reason": "", "off_px": None, "labels": 0, "found_by": {}}
    try:
        found = imgcal.calibrate(frames, given.rig, given.obj, detection=given.detection, detector=case.proposer())
    except RefusedError as error:
        return {**row, "reason": str(error)}
    return {**row, "off_px": given.off(found.rig), "labels": int(found.observations.seen.sum()),
            "found_by": dict(found.detectors)}  # fmt: skip


def cases(runs: Path, detectors: Iterable[str], device: str) -> list[Case]:
    """All cases of some detectors, the slowest first."""
    return [
        Case(name, kind, level, detector, str(runs), device)
        for name in ("grid", "dots", "cavity")
        for kind, made in DEGRADATIONS.items()
        for level in made.levels
        for detector in detectors
    ]


def detectors() -> list[str]:
    """All detectors."""
    networks = [f"{encoder} seed {seed}" for encoder in ENCODERS for seed in SEEDS]
    return ["classical", "matched", "auto", "learned", *networks, "ir-cnn seed 0 shuffled"]


def measure(runs: Path, cores: int, todo: list[Case]) -> None:
    """Measure the cases that are not in the JSON yet."""
    known = read_json(JSON)["outcomes"] if JSON.is_file() else []
    there = {key(row) for row in known}
    todo = [case for case in todo if key(asdict(case)) not in there]
    with ProcessPoolExecutor(cores) as pool:
        for row in pool.map(measured, todo):
            known.append(row)
            said = row["reason"][:120] or f"{row['off_px']:.3f} px {row['found_by']}"
            print(*key(row), said, flush=True)
            write_json(JSON, {"outcomes": known})


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    """Everything that a result depends on."""
    return tuple(row[name] for name in KEY)


def tables(rows: list[dict[str, Any]]) -> str:
    """Count calibrated, refused and wrong cases of each detector, and those that each network labelled itself."""
    references = captures.references_of(rows)
    count = len({row["kind"] + str(row["level"]) for row in rows})
    lines = []
    for name in detectors():
        mine = {
            each: [row for row in rows if (row["detector"], row["captures"]) == (name, each)] for each in captures.SETS
        }
        whole = {each: found for each, found in mine.items() if len(found) == count}  # skip unfinished ones
        if not whole:
            continue
        cells = [_outcomes(whole.get(each, []), references) for each in captures.SETS]
        every = [row for found in whole.values() for row in found] if len(whole) == len(captures.SETS) else []
        own = sum("learned" in row["found_by"] for row in every)
        network = every and (" seed " in name or name == "learned")
        lines.append([name, *cells, _outcomes(every, references), str(own) if network else ""])
    head = ["calibrated / refused / wrong", *captures.SETS.values(), "all", "rigs with labels of the network"]
    return markdown(head, lines)


def _outcomes(rows: list[dict[str, Any]], references: dict[str, float]) -> str:
    said = [captures.status(row, references) for row in rows]
    return " / ".join(str(said.count(kind)) for kind in ("calibrated", "refused", "wrong")) if said else ""


def measure_levels(runs: Path, count: int) -> None:
    """Measure the shipped and the adapted networks on rendered frames of all named levels of difficulty."""
    torch.set_num_threads(1)
    networks = {"shipped": ROOT / "data" / "models" / "ir-cnn.safetensors"} | {
        f"adapted to {name}, seed {seed}": adapted(runs, name, "ir-cnn", seed) / MODEL
        for name in captures.SETS for seed in SEEDS
    }  # fmt: skip
    rig, obj, rows = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8"), {}
    for name, path in networks.items():
        method, tally = LearnedProposer(load_infrared(path).network, shipped_measurer()), infrared.Tally()
        for difficulty in DIFFICULTIES.values():
            for number, case in enumerate(infrared.cases(rig, obj, difficulty, count)):
                found = lambda snapshot, method=method: method.propose(snapshot).detections  # noqa: E731
                infrared.ask(found, case, infrared.NEARLY, number, tally)
        rows[name] = tally.result()
        print(name, rows[name], flush=True)
    write_json(JSON, read_json(JSON) | {"levels": rows, "levels_snapshots": count})


def tables_of_levels(rows: dict[str, dict[str, float]]) -> str:
    """Right and wrong markers on rendered frames; of adapted networks, for each seed."""
    lines = [["shipped", _share(rows["shipped"])]]
    for name, title in captures.SETS.items():
        lines.append([f"adapted to {title}", ", ".join(_share(rows[f"adapted to {name}, seed {k}"]) for k in SEEDS)])
    return markdown(["network", "right % of visible / wrong % of claimed, all named levels"], lines)


def _share(row: dict[str, float]) -> str:
    return f"{row['right_percent']:.1f} / {row['wrong_percent']:.1f}"


def measure_measurers(runs: Path, count: int) -> None:
    """Measure the fitted ellipse, the shipped and the adapted measurers on rendered frames of the named levels."""
    torch.set_num_threads(1)
    networks = {"shipped": shipped_measurer()} | {
        f"adapted to {name}, seed {seed}": load_measurer(adapted(runs, name, MEASURER, seed) / MODEL).network
        for name in captures.SETS for seed in SEEDS
    }  # fmt: skip
    rows: dict[str, dict[str, Any]] = {}
    for level in DIFFICULTIES:
        views = list(measurer.snapshots(level, count))
        methods = {"ellipse": None} | {name: LearnedMeasurer(network) for name, network in networks.items()}
        found = {name: measurer.judged(views, method, alone=False) for name, method in methods.items()}
        keys = ("rms_px", "median_px", "p90_px")
        rows[level] = {name: {key: each[key] for key in keys} for name, each in found.items()}
        print(level, {name: each["rms_px"] for name, each in found.items()}, flush=True)
    write_json(JSON, read_json(JSON) | {"measurers": rows, "measurers_snapshots": count})


def tables_of_measurers(levels: dict[str, dict[str, dict[str, float]]]) -> str:
    """RMS and median error by level; of adapted measurers, the mean over seeds."""

    def cell(row: dict[str, dict[str, float]], names: list[str]) -> str:
        return " / ".join(f"{np.mean([row[name][key] for name in names]):.3g}" for key in ("rms_px", "median_px"))

    columns = {"ellipse": ["ellipse"], "shipped": ["shipped"]} | {
        f"adapted to {title}": [f"adapted to {name}, seed {seed}" for seed in SEEDS]
        for name, title in captures.SETS.items()
    }
    lines = [[level, *(cell(row, names) for names in columns.values())] for level, row in levels.items()]
    return markdown(["RMS / median error, px", *columns], lines)


def calibrate_simulated(runs: Path) -> tuple[Outcome, ...]:
    """Calibrate simulated captures of all levels with the matched filter, the shipped and the adapted networks."""
    levels = {name: FrameModel(difficulty=each) for name, each in (infrared.HARDER | DIFFICULTIES).items()}
    scene = Scene(imgcal.load_rig("O10"), imgcal.load_object("asymmetric8"), levels, SNAPSHOTS)
    networks = [Contender(f"adapted to {captures.SETS[name]}", str(adapted(runs, name, "ir-cnn", seed)), seed)
                for name, seeds in SIMULATED.items() for seed in seeds]  # fmt: skip
    detectors = (Contender("matched filter", "matched"), Contender("shipped", "learned"), *networks)
    kept = StoredResults(WORK / "own_frames", repr((SNAPSHOTS, detectors)))
    with workers(cores=1, kept=kept) as mapped:
        return compare_detectors(
            detectors, scene, CAPTURES, progress=lambda _: print(end=".", flush=True), mapped=mapped
        )


def tables_of_calibrations(outcomes: Sequence[Outcome]) -> str:
    """Count outcomes of simulated captures, and compare errors on those that every detector calibrates."""
    lost = {(one.difficulty, one.capture) for one in outcomes if one.status != "calibrated"}
    lines = {name: [name] for name in dict.fromkeys(one.contender for one in outcomes)}
    for levels in (DIFFICULTIES, infrared.HARDER):
        for name, line in lines.items():
            mine = [one for one in outcomes if one.contender == name and one.difficulty in levels]
            seeds = dict.fromkeys(one.training_seed for one in mine)
            line.append(", ".join(counts([one for one in mine if one.training_seed == seed]) for seed in seeds))
            errors = [one.held_out_px for one in mine if (one.difficulty, one.capture) not in lost]
            line.append(f"{median(error for error in errors if error is not None):.3f}" if errors else "")
    head = ["calibrated / refused / wrong", "named levels", "median px", "harder levels", "median px"]
    return markdown(head, list(lines.values()))


def counts(outcomes: Sequence[Outcome]) -> str:
    """Calibrated, refused and wrong."""
    said = [one.status for one in outcomes]
    return " / ".join(str(said.count(kind)) for kind in ("calibrated", "refused", "wrong"))


def main(
    runs: Path,
    steps: tuple[str, ...] = ("prepare", "train", "measure", "levels", "measurers", "calibrations", "page"),
    cores: int = 1,
    only: tuple[str, ...] = (),
    device: str = "cpu",
    count: int = 3,
) -> None:
    """Adapt, calibrate, and write the JSON and the table.

    Args:
        runs: folder of data sets and training runs.
        steps: prepare, train, measure, levels, measurers, calibrations, page.
        cores: processes at once.
        only: detectors to measure; none = all.
        device: of the query networks.
        count: snapshots of each named level of difficulty.
    """
    if "prepare" in steps:
        prepare(runs)
    if "train" in steps:
        train(runs, cores)
    if "measure" in steps:
        measure(runs, cores, cases(runs, only or detectors(), device))
    if "levels" in steps:
        measure_levels(runs, count)
    if "measurers" in steps:
        measure_measurers(runs, count)
    if "calibrations" in steps:
        outcomes = [asdict(one) for one in calibrate_simulated(runs)]
        write_json(JSON, read_json(JSON) | {"calibrations": outcomes, "calibrations_measured_on": surroundings()})
    if "page" in steps:
        found = read_json(JSON)
        fill(PAGE, {
            "own frames": tables(found["outcomes"]),
            "own frames levels": tables_of_levels(found["levels"]),
            "own frames measurers": tables_of_measurers(found["measurers"]),
            "own frames calibrations": tables_of_calibrations([Outcome(**row) for row in found["calibrations"]]),
        })  # fmt: skip


if __name__ == "__main__":
    command(lambda: tyro.cli(main, args=sys.argv[1:], description=__doc__))
