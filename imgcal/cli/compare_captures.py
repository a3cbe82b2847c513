"""`imgcal compare --captures`: detectors side by side on simulated captures, from frames to a rig."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, progress_bar
from imgcal.errors import InputError
from imgcal.fleet import StoredResults
from imgcal.io import load_object, nearest, object_text, publishing, rig_text, write_text

if TYPE_CHECKING:
    from imgcal.evaluation import Contender, Scene
    from imgcal.fleet import Mapper

RESULT, TABLES = "captures.json", "captures.md"
WORK = ".work"
"""Folder beside results of what has been done, until all is."""
LIMITS = {"captures": 100_000, "snapshots": 1000}
SHIPPED_NETWORKS = ("learned", "both")
"""Detectors by name that are one training of a network."""
SEED = re.compile(r"(.+)-seed(\d+)")


def compare_captures(
    detectors: Sequence[Path],
    chosen: arguments.Captures,
    rig: str,
    obj: str,
    seed: int,
    out: Path | None,
    workers: Callable[[int, StoredResults | None], AbstractContextManager[Mapper]],
) -> None:
    """Calibrate simulated captures with each detector; print tables, and write them where `out` says.

    Args:
        detectors: names, files, or folders of training runs.
        chosen: what captures are simulated.
        rig: file or name.
        obj: file or name.
        seed: the same seed gives the same captures.
        out: folder to write; None = nothing is written.
        workers: opens those who calibrate so many captures, and who keep what is done.

    Raises:
        InputError: a detector or a difficulty that there is not.
    """
    from imgcal.evaluation import Scene, compare_detectors, detector_tables, detector_values
    from imgcal.pipeline import choose_proposer
    from imgcal.synthesis import DIFFICULTIES, FrameModel

    _check(chosen)
    if out is not None:
        check_folder(out)
    names = chosen.difficulty or tuple(DIFFICULTIES)
    models = {name: FrameModel(difficulty=DIFFICULTIES[name]) for name in names}
    scene = Scene(open_rig(rig), load_object(obj), models, chosen.snapshots)
    contenders = [contender(path) for path in detectors]
    for one in contenders:
        if one.detector != "classical":
            choose_proposer(one.detector)  # found out now, not when captures are made
    total = len(models) * chosen.captures
    kept = None if out is None else StoredResults(out / WORK, _scope(contenders, scene))
    with workers(total, kept) as mapped, progress_bar("calibrating captures", total) as advance:
        outcomes = compare_detectors(contenders, scene, chosen.captures, seed, advance, mapped)
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
    if kept is not None:
        kept.clear()


def _scope(contenders: Sequence[Contender], scene: Scene) -> str:
    """What outcomes depend on beside captures: rig, object, difficulties, detectors, and what their files hold."""
    said = [rig_text(scene.rig), object_text(scene.obj), scene.models, scene.snapshots, scene.drift, scene.pose_range]
    for one in contenders:
        path = Path(str(one.detector))
        files = [file for file in (path, path / "model.safetensors") if file.is_file()]
        said += [one, *(hashlib.sha256(file.read_bytes()).hexdigest() for file in files)]
    return repr(said)


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


def _check(chosen: arguments.Captures) -> None:
    """Raise InputError where a number is out of its limits, or a difficulty is not known."""
    from imgcal.synthesis import DIFFICULTIES

    for name, most in LIMITS.items():
        if not 1 <= getattr(chosen, name) <= most:
            raise InputError(f"--{name}: found {getattr(chosen, name)}, expected 1 to {most}")
    for name in chosen.difficulty:
        if name not in DIFFICULTIES:
            known = nearest(name, DIFFICULTIES)
            raise InputError(f"--difficulty: found {name!r:.80}, expected some of {', '.join(DIFFICULTIES)}{known}")
