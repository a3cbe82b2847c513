"""Find and identify fiducials in single snapshots of captured frames: networks and blobs, by level of difficulty.

`python -m scripts.results.infrared --models ir-cnn=out/ir-cnn/model.safetensors` rewrites
`docs/results/infrared.json` and the tables of `docs/results/infrared.md`. All methods get the same frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

import imgcal
from imgcal.association import IdentityOptions, Proposer, Snapshot, judge, match_to_rig, track
from imgcal.detection import detect_snapshot, to_detections
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.matching import MatchedFilter
from imgcal.networks import InfraredNetwork, Measurer, Queries, load_infrared, load_measurer
from imgcal.pipeline.learned_proposer import LearnedProposer
from imgcal.synthesis import DIFFICULTIES, Difficulty, FrameModel, PhysicalDrift, simulate_shots, simulate_truth
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior
from scripts.output import RESULTS, command, markdown, read_json, replaced, surroundings, write_json

JSON, PAGE = RESULTS / "infrared.json", RESULTS / "infrared.md"
NEAR = 5.0  # px within which a position is right: less than the radius of a marker
FAR_OFF = 20.0  # px: no measurement of the right marker has such an error
VISIBLE = 0.25  # share of a marker that must be visible for it to count
ASIDE = 8.0  # mm, one standard deviation of each coordinate of the assumed pose
NEARLY = 1.0  # degrees, rotation error of the assumed pose by default
LOST = (45.0, 120.0)  # the same, for an assumed pose that does not help
HARDER = {  # harder than any named level
    "low light, peak SNR 0.5 to 0.7": replace(DIFFICULTIES["low-light"], peak_snr=(0.5, 0.7)),
    "low light, peak SNR 0.3 to 0.4": replace(DIFFICULTIES["low-light"], peak_snr=(0.3, 0.4)),
    "combined, peak SNR 0.8 to 1.2": replace(DIFFICULTIES["combined"], peak_snr=(0.8, 1.2)),
    "clutter, 60 % hidden": replace(DIFFICULTIES["clutter"], hidden=0.6),
}
OTHERS = (("T4", "cube8"), ("U7", "cube27"), ("O6", "asymmetric8"))  # rigs and objects
OTHER_LEVELS = ("clean", "combined")


@dataclass(frozen=True)
class Case:
    """One snapshot with its ground truth."""

    snapshot: Snapshot
    uv: NDArray[np.float64]  # (C, N, 2) px
    visible: NDArray[np.bool_]  # (C, N)
    pose: RigidTransform  # (), true pose

    def believed(self, degrees: float, seed: int) -> Snapshot:
        """Return the snapshot with an assumed pose that is rotated by `degrees`, and shifted."""
        draw, obj = torch.Generator().manual_seed(seed), self.snapshot.obj
        axis = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=torch.float64), dim=0)
        aside = ASIDE * torch.randn(3, generator=draw, dtype=torch.float64)
        rotation = rotation_from_vector(axis * np.deg2rad(degrees)) @ self.pose.rotation
        centre = obj.points.mean(0)
        place = self.pose.rotation @ centre + self.pose.translation + aside
        return replace(self.snapshot, candidates=(RigidTransform(rotation, place - rotation @ centre),))


@dataclass
class Tally:
    """Counts and errors of a method over some snapshots."""

    visible: int = 0
    claimed: int = 0
    right: int = 0
    squared: float = 0.0  # px^2, summed over right positions
    whitened: float = 0.0  # the same over sigma^2
    declined: int = 0  # snapshots
    seconds: float = 0.0

    def add(self, case: Case, said: Detections, seconds: float) -> None:
        """Count one snapshot."""
        off = np.square(said.uv - case.uv[said.camera, said.fiducial]).sum(1)
        right = (off < NEAR**2) & case.visible[said.camera, said.fiducial]
        self.visible += int(case.visible.sum())
        # A barely visible marker counts neither as found nor as missed.
        self.claimed += int((right | (off >= NEAR**2)).sum())
        self.right += int(right.sum())
        self.squared += float(off[right].sum()) / 2
        self.whitened += float((off[right] / np.square(said.sigma[right])).sum()) / 2
        self.declined += len(said) == 0
        self.seconds += seconds

    def result(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "right_percent": 100 * self.right / max(self.visible, 1),
            "wrong_percent": 100 * (self.claimed - self.right) / max(self.claimed, 1),
            "rms_px": (self.squared / max(self.right, 1)) ** 0.5,
            "nees": self.whitened / max(self.right, 1),
            "visible": self.visible,
            "claimed": self.claimed,
            "declined_snapshots": self.declined,
        }


class Shuffled(InfraredNetwork):
    """A network that gets the encoder's output for other cameras."""

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Any:
        """Search the next camera's features."""
        return super().search(features.roll(1, 0), queries, window)


class Zeroed(InfraredNetwork):
    """A network whose encoder's output is zero."""

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Any:
        """Search features that are all zero."""
        return super().search(torch.zeros_like(features), queries, window)


@dataclass(frozen=True)
class Blobs:
    """The detector, then a vote of all cameras near the assumed pose."""

    name: str = "blobs"

    def labelled(self, snapshot: Snapshot) -> Detections:
        """Label the blobs that data association accepts."""
        wide = replace(snapshot.blobs, sigma=np.hypot(snapshot.blobs.sigma, 0.3))
        found = track(wide, snapshot.rig, snapshot.obj, snapshot.prior_std, snapshot.candidates[0])
        labels = found.labels if found.accepted else np.full(len(wide), -1)
        return replace(snapshot.blobs, fiducial=labels).select(labels >= 0)


def cases(rig: CameraRig, obj: CalibrationObject, difficulty: Difficulty, count: int) -> Iterator[Case]:
    """Make snapshots, each of another drifted rig."""
    draw = torch.Generator().manual_seed(20_260)
    for _ in range(count):
        truth = simulate_truth(rig, obj, 1, draw, PhysicalDrift())
        shot = next(iter(simulate_shots(truth, obj, FrameModel(difficulty=difficulty), draw)))
        blobs = match_to_rig(
            to_detections([detect_snapshot(shot.frames, imgcal.DetectionOptions())], rig.camera_names, ("0",)), rig
        )
        snapshot = Snapshot(shot.frames, blobs, rig, obj, (rig.prior or RigPrior()).std(rig))
        visible = (shot.seen > VISIBLE).numpy()
        yield Case(snapshot, truth.uv[0].numpy(), visible, truth.rig_from_object[0])


Method = Callable[[Snapshot], Detections]


def methods_of(models: dict[str, Path], measurer: Measurer | None) -> dict[str, Method]:
    """Make all methods by name, those with a disabled encoder last."""

    def proposed(proposer: Proposer) -> Method:
        return lambda snapshot: proposer.propose(snapshot).detections

    made: dict[str, Method] = {"blobs + vote": Blobs().labelled, "matched filter": proposed(MatchedFilter())}
    networks = {name: load_infrared(path).network for name, path in models.items()}
    made |= {name: proposed(LearnedProposer(network, measurer)) for name, network in networks.items()}
    for name, network in networks.items():
        for kind, word in ((Shuffled, "shuffled"), (Zeroed, "zeroed")):
            broken = kind(network.config).eval()
            broken.load_state_dict(network.state_dict())
            made[f"{name}, encoder {word}"] = proposed(LearnedProposer(broken, measurer))
    return made


def measure(methods: dict[str, Method], judged: Mapping[str, Proposer], count: int, turned: float) -> dict[str, Any]:
    """Run all methods on all cases."""
    levels: dict[str, Any] = {}
    lost = {name: {"accepted": 0, "wrong labels": 0, "refused": 0} for name in judged}
    obj, rig = imgcal.load_object("asymmetric8"), imgcal.load_rig("O10")
    for level, difficulty in DIFFICULTIES.items():
        tallies = {(name, degrees): Tally() for name in methods for degrees in (NEARLY, turned)}
        for number, case in enumerate(cases(rig, obj, difficulty, count)):
            for (name, degrees), tally in tallies.items():
                if "encoder" not in name or degrees == NEARLY:
                    ask(methods[name], case, degrees, number, tally)
            for name, proposer in judged.items():
                count_lost(proposer, case, number, lost[name])
        levels[level] = _by_name(tallies)
        print(level, {name: round(said["1"]["right_percent"], 1) for name, said in levels[level].items()}, flush=True)
    others: dict[str, Any] = {}
    for rig_name, object_name in OTHERS:
        for level in OTHER_LEVELS:
            tallies = {(name, NEARLY): Tally() for name in methods if "encoder" not in name}
            other = imgcal.load_rig(rig_name), imgcal.load_object(object_name)
            for number, case in enumerate(cases(*other, DIFFICULTIES[level], max(count // 3, 1))):
                for (name, degrees), tally in tallies.items():
                    ask(methods[name], case, degrees, number, tally)
            others[f"{rig_name}, {object_name}, {level}"] = _by_name(tallies)
    return {"snapshots": count, "turned_deg": turned, "levels": levels, "others": others, "lost": lost}


def measure_harder(methods: dict[str, Method], count: int, turned: float) -> dict[str, Any]:
    """Run all methods on cases that are hard enough to tell them apart."""
    rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
    made: dict[str, Any] = {}
    for level, difficulty in HARDER.items():
        tallies = {(name, d): Tally() for name in methods if "encoder" not in name for d in (NEARLY, turned)}
        for number, case in enumerate(cases(rig, obj, difficulty, count)):
            for (name, degrees), tally in tallies.items():
                ask(methods[name], case, degrees, number, tally)
        made[level] = _by_name(tallies)
        print(level, {name: round(said["1"]["right_percent"], 1) for name, said in made[level].items()}, flush=True)
    return {"snapshots_harder": count, "harder": made}


def count_lost(proposer: Proposer, case: Case, number: int, counted: dict[str, int]) -> None:
    """Check with data association what is proposed around an unhelpful pose."""
    snapshot = case.believed(LOST[number % len(LOST)], number)
    found, blobs = judge(proposer.propose(snapshot), snapshot, IdentityOptions(), error=0.3, pose_known=False)
    counted["accepted" if found.accepted else "refused"] += 1
    if found.accepted:
        rows = found.labels >= 0
        off = np.linalg.norm(blobs.uv[rows] - case.uv[blobs.camera[rows], found.labels[rows]], axis=1)
        counted["wrong labels"] += int((off > FAR_OFF).sum())


def ask(method: Method, case: Case, degrees: float, seed: int, tally: Tally) -> None:
    """Run a method on a case whose assumed pose is rotated."""
    snapshot = case.believed(degrees, seed)
    started = time.process_time()
    said = method(snapshot)
    tally.add(case, said, time.process_time() - started)


def _by_name(tallies: dict[tuple[str, float], Tally]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for (name, degrees), tally in tallies.items():
        if tally.visible:
            made.setdefault(name, {})[f"{degrees:g}"] = tally.result()
    return made


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Make the tables of the page."""

    def cell(said: dict[str, Any] | None) -> str:
        return "" if said is None else f"{said['right_percent']:.1f} / {said['wrong_percent']:.1f}"

    def by_level(degrees: str) -> str:
        levels = result["levels"]
        names = [name for name, said in next(iter(levels.values())).items() if degrees in said]
        rows = [[name, *(cell(levels[level].get(name, {}).get(degrees)) for level in levels)] for name in names]
        return markdown(["right % of visible / wrong % of claimed", *levels], rows)

    def accuracy() -> str:
        levels = result["levels"]
        names = [name for name in next(iter(levels.values())) if "encoder" not in name]
        rows = [
            [name, *(f"{said[name]['1']['rms_px']:.2f} / {said[name]['1']['nees']:.2f}" for said in levels.values())]
            for name in names
        ]
        return markdown(["RMS px of right positions / NEES", *levels], rows)

    harder = result["harder"]
    beyond = next(iter(harder.values()))
    others = result["others"]
    names = list(next(iter(others.values())))
    rows = [[name, *(cell(said[name]["1"]) for said in others.values())] for name in names]
    turns = [f"{name}, {d} {'degree' if d == 1 else 'degrees'} off" for name in beyond for d in beyond[name]]
    return {
        "infrared levels": by_level("1"),
        "infrared turned": f"{result['turned_deg']:g} degrees:\n\n" + by_level(f"{result['turned_deg']:g}"),
        "infrared accuracy": accuracy(),
        "infrared others": markdown(["right % / wrong %", *others], rows),
        "infrared harder": markdown(
            ["right % / wrong %", *turns],
            [[level, *(cell(row) for said in by.values() for row in said.values())] for level, by in harder.items()],
        ),
        "infrared lost": markdown(
            ["snapshots", "refused", "accepted", "labels more than 20 px off in accepted snapshots"],
            [
                [name, str(said["refused"]), str(said["accepted"]), str(said["wrong labels"])]
                for name, said in result["lost"].items()
            ],
        ),
    }


def main(
    models: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ("ir-cnn=data/models/ir-cnn.safetensors",),
    measurer: Path | None = Path("data/models/measurer-cnn.safetensors"),
    count: int = 6,
    turned: float = 12.0,
    part: Literal["all", "harder", "tables"] = "all",
) -> None:
    """Measure, write the JSON, and rewrite the tables.

    Args:
        models: NAME=FILE of query networks.
        measurer: file of a measurer, which replaces the fit for the markers that it handles; without it, fit all.
        count: snapshots per level.
        turned: degrees, error of the assumed pose in the second round.
        part: what to measure; the rest stays as it is in the JSON.
    """
    if part != "tables":
        torch.set_num_threads(1)
        paths = {name: Path(path) for name, _, path in (model.partition("=") for model in models)}
        reader = None if measurer is None else load_measurer(measurer).network
        methods = methods_of(paths, reader)
        found = read_json(JSON) if part == "harder" else {}
        if part == "all":
            proposers = {name: LearnedProposer(load_infrared(path).network, reader) for name, path in paths.items()}
            found = measure(methods, proposers, count, turned)
        write_json(JSON, {**found, **surroundings(), **measure_harder(methods, count, turned)})
    page = PAGE.read_text()
    PAGE.write_text(replaced(page, tables(read_json(JSON)), PAGE))


if __name__ == "__main__":
    command(lambda: tyro.cli(main))
