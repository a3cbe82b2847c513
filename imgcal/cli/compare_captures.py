"""`imgcal compare --captures`: detectors side by side on simulated captures, from frames to a rig."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from imgcal.cli.common import check_folder, counted, open_rig
from imgcal.errors import InputError
from imgcal.io import load_object, nearest, publishing, write_text

if TYPE_CHECKING:
    from imgcal.evaluation import Contender, Scene

RESULT, TABLES = "captures.json", "captures.md"
LIMITS = {"captures": 100_000, "snapshots": 1000, "processes": 256}
SHIPPED_NETWORKS = ("learned", "both")
"""Detectors by name that are one training of a network."""
SEED = re.compile(r"(.+)-seed(\d+)")


@dataclass(frozen=True)
class Captures:
    """What captures are simulated."""

    captures: int = 0  #: so many a difficulty: compare detectors on captured frames instead of networks on points
    difficulty: tuple[str, ...] = ()  #: names as of `imgcal simulate --difficulty`; default: all
    snapshots: int = 4  #: of a capture
    processes: int = 1  #: captures at the same time

    def check(self) -> None:
        """Raise InputError where a number is out of its limits, or a difficulty is not known."""
        from imgcal.synthesis import DIFFICULTIES

        for name, most in LIMITS.items():
            if not 1 <= getattr(self, name) <= most:
                raise InputError(f"--{name}: found {getattr(self, name)}, expected 1 to {most}")
        for name in self.difficulty:
            if name not in DIFFICULTIES:
                known = nearest(name, DIFFICULTIES)
                raise InputError(f"--difficulty: found {name!r:.80}, expected some of {', '.join(DIFFICULTIES)}{known}")


def compare_captures(
    detectors: Sequence[Path], chosen: Captures, rig: str, obj: str, seed: int, out: Path | None
) -> None:
    """Calibrate simulated captures with each detector; print tables, and write them where `out` says.

    Raises:
        InputError: a detector or a difficulty that there is not.
    """
    from imgcal.evaluation import Scene, compare_detectors, detector_tables, detector_values
    from imgcal.synthesis import DIFFICULTIES, FrameModel

    chosen.check()
    if out is not None:
        check_folder(out)
    names = chosen.difficulty or tuple(DIFFICULTIES)
    models = {name: FrameModel(difficulty=DIFFICULTIES[name]) for name in names}
    scene = Scene(open_rig(rig), load_object(obj), models, chosen.snapshots)
    with counted("calibrating captures", len(models) * chosen.captures) as advance:
        outcomes = compare_detectors(
            [contender(path) for path in detectors], scene, chosen.captures, seed, chosen.processes, advance
        )
    tables = detector_tables(outcomes)
    text = f"{describe(scene, chosen.captures, seed)}\n\n" + "\n".join(table.markdown() for table in tables)
    if sys.stdout.isatty():
        for table in tables:
            Console().print(table.rich())
    else:
        print(text, end="")
    if out is not None:
        values = detector_values(outcomes, scene, {"captures": chosen.captures, "seed": seed})
        with publishing(out, (RESULT, TABLES), mark=RESULT) as folder:
            write_text(folder / RESULT, json.dumps(values, indent=1, allow_nan=False) + "\n")
            write_text(folder / TABLES, text)
        print(f"wrote {out / RESULT}\nwrote {out / TABLES}", file=sys.stderr)


def contender(path: Path) -> Contender:
    """A detector by its name, or by the folder or file of a training run, whose seed may end its name: NAME-seed2."""
    from imgcal.evaluation import Contender

    if not path.exists():
        return Contender(str(path), str(path), 0 if str(path) in SHIPPED_NETWORKS else None)
    name = path.parent.name if path.stem == "model" else path.stem
    if of_seed := SEED.fullmatch(name):
        return Contender(of_seed[1], str(path), int(of_seed[2]))
    return Contender(name, str(path), 0)


def describe(scene: Scene, captures: int, seed: int) -> str:
    """One line on what the captures were."""
    drift = ", ".join(f"{name} {value:g}" for name, value in vars(scene.drift).items())
    return (
        f"Rig {scene.rig.name}, object {scene.obj.name}, {captures} captures a difficulty of {scene.snapshots} "
        f"snapshots, seed {seed}; drift of all values, standard deviations: {drift}."
    )
