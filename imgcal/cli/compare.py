"""`imgcal compare`: networks side by side on random rigs, or detectors on simulated captures, from frames to a rig."""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, progress_bar
from imgcal.cli.evaluate import WORK, evaluate_models, open_workers
from imgcal.errors import InputError
from imgcal.fleet import StoredResults
from imgcal.io import load_object, nearest, object_text, publishing, rig_text, write_text
from imgcal.messages import plural

if TYPE_CHECKING:
    from imgcal.evaluation import Contender, Scene

RESULT, TABLES = "captures.json", "captures.md"
LIMITS = {"captures": 100_000, "snapshots": 1000}
SHIPPED_NETWORKS = ("learned", "both")
"""Detectors by name that are one training of a network."""
SEED = re.compile(r"(.+)-seed(\d+)")
OF_BOTH = ("rig", "object", "seed", "address", "cores")
"""What a comparison of captures reads of a `Setting`, too."""


class Compare(arguments.Compare):
    """Run `imgcal compare`."""

    def run(self) -> None:
        """Compare, print and write."""
        self._check_options()
        if self.captured.captures:
            compare_captures(self.models, self.captured, self.setting, self.out)
            return
        from imgcal.pipeline import DETECTORS

        named = [path for path in self.models if str(path) in DETECTORS and not path.exists()]
        if named:
            raise InputError(
                f"compare: found {named[0]}, which is a detector, expected networks; detectors are compared on "
                "captured frames: --captures 20 simulates 20 at every difficulty"
            )
        if len(self.models) < 2:
            raise InputError(f"compare: found {plural(len(self.models), 'model')}, expected two or more")
        evaluate_models(self.models, self.setting, self.baselines, self.out)

    def _check_options(self) -> None:
        """Refuse options that are for the other kind of comparison.

        Raises:
            InputError: names the first of them, and what it is for.
        """
        unread: list[tuple[arguments.Setting | Compare | arguments.Captures, str]]
        if self.captured.captures:
            how, meant = "with", "networks on points"
            unread = [(self.setting, name) for name in vars(self.setting) if name not in OF_BOTH]
            unread.append((self, "baselines"))
        else:
            how, meant = "without", "detectors on captured frames"
            unread = [(self.captured, name) for name in vars(self.captured)]
        for options, name in unread:
            if getattr(options, name) != getattr(type(options), name):
                option = name.replace("_", "-")
                raise InputError(f"--{option}: cannot be used {how} --captures; it is for comparing {meant}")


def compare_captures(
    detectors: Sequence[Path], chosen: arguments.Captures, setting: arguments.Setting, out: Path | None
) -> None:
    """Calibrate simulated captures with each detector; print tables, and write them where `out` says.

    Args:
        detectors: names, files, or folders of training runs.
        chosen: what captures are simulated.
        setting: rig, object, seed and workers.
        out: folder to write; None = nothing is written.

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
    rig, obj = open_rig(setting.rig or "O10"), load_object(setting.object or "asymmetric8")
    scene, seed = Scene(rig, obj, models, chosen.snapshots), setting.seed
    contenders = [contender(path) for path in detectors]
    for one in contenders:
        if one.detector != "classical":
            choose_proposer(one.detector)  # found out now, not when captures are made
    total = len(models) * chosen.captures
    each = f"{plural(chosen.captures, 'capture')} of each difficulty, {', '.join(names)}"
    kept = None if out is None else StoredResults(out / WORK, _scope(contenders, scene))
    with open_workers(setting, total, kept) as mapped:
        print(f"calibrating {each}, with {', '.join(map(str, detectors))}", file=sys.stderr, flush=True)
        with progress_bar("calibrating captures", total) as advance:
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
        f"Rig {scene.rig.name}, object {scene.obj.name}, {plural(captures, 'capture')} a difficulty of "
        f"{plural(scene.snapshots, 'snapshot')}, seed {seed}; drift of all values, standard deviations: {drift}."
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
