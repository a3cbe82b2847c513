"""Inputs to try: a small folder of valid files, and cases that damage one thing in a copy of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

import cv2
import numpy as np
import torch

from imgcal.cli.main import main
from imgcal.io import (
    load_detections,
    load_object,
    read_frame,
    read_rig,
    save_detections,
    save_object,
    save_rig,
    yaml_text,
)
from imgcal.networks import Checkpoint, build_network, save_checkpoint
from imgcal.training import RigExperiment, load_experiment
from scripts.fuzz.foreign import prepare_foreign
from scripts.fuzz.mutations import NAMES, VALUES, mutated

SIZE = (256, 136)  # pixels: small frames are quick
TRUNK = {"width": 16, "heads": 2, "depth": 1, "later_depth": 1, "passes": 2}

OPTIONS = {
    "simulate": (
        "--snapshots", "--seed", "--kappa", "--theta-deg", "--phi-deg", "--marker-radius", "--sensor.bit-depth",
        "--sensor.blur", "--sensor.background", "--sensor.contrast", "--sensor.exposure", "--sensor.saturation",
        "--sensor.read-noise", "--sensor.shot-noise", "--sensor.hot-pixels", "--clutter-model.blobs.count", "--rig",
        "--clutter-model.blobs.radius", "--clutter-model.occluded", "--physical.position", "--drift", "--object",
    ),
    "calibrate": (
        "--snapshots", "--first-guess", "--without", "--reference", "--threshold", "--min-radius", "--max-radius",
        "--max-elongation", "--bit-depth", "--saturation", "--polarity", "--rig", "--object", "--out",
    ),
    "score": ("--snapshots", "--rig", "--object", "--threshold", "--bit-depth"),
    "render": ("--size", "--dot", "--snapshots", "--rig", "--object", "--out"),
    "convert": ("--unit", "--out-unit", "--image-size", "--distance", "--cameras", "--from", "--to", "--fit-limit"),
    "detect": ("--rig", "--snapshots", "--threshold", "--bit-depth", "--max-radius", "--out"),
    "evaluate": ("--rig", "--object", "--kappa", "--phi", "--noise", "--missing", "--swapped", "--false", "--seed"),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One attempt: a folder to work in, and the command line."""

    folder: Path
    arguments: list[str]
    damage: str  # what was damaged, in words


def prepare(folder: Path) -> None:
    """Make the valid files: rig, object, capture, detections, other images, a video, a network, an experiment."""
    folder.mkdir(parents=True)
    save_rig(read_rig("T4").resized(torch.tensor(SIZE)), folder / "rig.yaml")
    save_object(load_object("asymmetric8"), folder / "object.csv")
    made = ["simulate", "--rig", str(folder / "rig.yaml"), "--object", str(folder / "object.csv"), "--out"]
    made += [str(folder / "capture"), "--snapshots", "2", "--kappa", "0.005", "--no-clutter", "--marker-radius", "14"]
    if main(made):
        raise RuntimeError("could not make the valid capture")
    truth = load_detections(folder / "capture" / "truth" / "detections.csv")
    save_detections(truth, folder / "labelled.csv")
    save_detections(truth, folder / "labelled.csv.gz")
    if main(["detect", str(folder / "capture"), "--out", str(folder / "blobs.csv")]):
        raise RuntimeError("found no blobs in the valid capture")
    _other_frames(folder)
    _network(folder)
    prepare_foreign(folder / "foreign", read_rig(folder / "rig.yaml"))


def case(sound: Path, folder: Path, seed: int, number: int) -> Case:
    """Make the case with this seed and number, in a folder that does not exist yet."""
    random = Random(f"{seed} {number}")
    shutil.copytree(sound, folder)
    kind = random.choice(tuple(KINDS))
    arguments, damage = KINDS[kind](folder, random)
    return Case(folder, arguments, f"{kind}: {damage}")


def _other_frames(folder: Path) -> None:
    """Write the same capture as TIFF, BMP, PGM, JPEG and video."""
    capture, rig = folder / "capture", read_rig(folder / "rig.yaml")
    for suffix in ("tif", "bmp", "pgm", "jpg", "avi"):
        other = folder / suffix
        (other / "frames").mkdir(parents=True)
        for camera in rig.camera_names:
            images = [read_frame(path) for path in sorted((capture / "frames" / camera).iterdir())]
            if suffix == "tif":
                cv2.imwritemulti(str(other / "frames" / f"{camera}.tif"), images)
            elif suffix == "avi":
                path = str(other / "frames" / f"{camera}.avi")
                writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE, False)
                for image in images:
                    writer.write(image)
                writer.release()
            else:
                (other / "frames" / camera).mkdir()
                for number, image in enumerate(images):
                    cv2.imwrite(str(other / "frames" / camera / f"{number}.{suffix}"), image)
    (capture / "masks").mkdir()
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.imwrite(str(capture / "masks" / f"{rig.camera_names[0]}.png"), mask)


def _network(folder: Path) -> None:
    content = {
        "format": "imgcal-experiment/1",
        "name": "tiny",
        "rig": str(folder / "rig.yaml"),
        "object": str(folder / "object.csv"),
        "poses": {"theta_deg": [0, 360], "phi_deg": [0, 30], "alpha_deg": [0, 360]},
        "drift": {"kappa_intrinsics": 0.005, "kappa_extrinsics": 0.005},
        "network": {"preset": "points", "change": {"trunk": TRUNK}},
        "training": {"steps": 1, "batch_size": 2, "validation_rigs": 0, "device": "cpu", "threads": 1},
    }
    (folder / "experiment.yaml").write_text(yaml_text(content))
    experiment = load_experiment(folder / "experiment.yaml", kind=RigExperiment)
    rig, obj = experiment.load_rig(), experiment.load_object()
    network = build_network(experiment, rig, obj, torch.Generator().manual_seed(0))
    save_checkpoint(folder / "model.safetensors", Checkpoint(network, rig, obj, experiment, {"re_px": 1.0}))


def _damage(path: Path, random: Random) -> str:
    path.write_bytes(mutated(path.read_bytes(), path.suffix, random))
    return path.name


def _subject(folder: Path) -> list[str]:
    return ["--rig", str(folder / "rig.yaml"), "--object", str(folder / "object.csv")]


def _on(folder: Path, source: str, random: Random) -> list[str]:
    """Choose a command for a capture or a table."""
    place, out = str(folder / source), ["--out", str(folder / "out")]
    commands = (
        ["calibrate", place, *_subject(folder), *out],
        ["calibrate", place, *_subject(folder), *out, "--no-report", "--blind-cameras"],
        ["score", place, *_subject(folder)],
        ["render", place, *_subject(folder), *out, "--size", "32"],
    )
    return list(random.choice(commands))


def _rig(folder: Path, random: Random) -> tuple[list[str], str]:
    return _on(folder, random.choice(("labelled.csv", "blobs.csv")), random), _damage(folder / "rig.yaml", random)


def _foreign(folder: Path, random: Random) -> tuple[list[str], str]:
    """Damage another tool's calibration, and convert it or use it as a rig."""
    place = random.choice(sorted((folder / "foreign").iterdir()))
    path = random.choice(sorted(place.iterdir()))
    damage = f"{place.name}/{_damage(path, random)}"
    given = str(random.choice((place, path)))
    if random.random() < 0.2:
        return ["score", str(folder / "labelled.csv"), "--rig", given, "--object", str(folder / "object.csv")], damage
    to = random.choice(("imgcal", "imgcal", "kalibr", "colmap", "mrcal", "anipose", "ros", "opencv-stereo"))
    arguments = ["convert", given, "--to", to, "--out", str(folder / "out")]
    if random.random() < 0.8:
        arguments += ["--unit", random.choice(("m", "mm", "inch"))]
    return arguments, damage


def _object(folder: Path, random: Random) -> tuple[list[str], str]:
    return _on(folder, random.choice(("labelled.csv", "blobs.csv")), random), _damage(folder / "object.csv", random)


def _table(folder: Path, random: Random) -> tuple[list[str], str]:
    name = random.choice(("labelled.csv", "blobs.csv", "labelled.csv.gz"))
    return _on(folder, name, random), _damage(folder / name, random)


def _frames(folder: Path, random: Random) -> tuple[list[str], str]:
    source = random.choice(("capture", "capture", "tif", "bmp", "pgm", "jpg", "avi"))
    files = sorted(path for path in (folder / source).rglob("*") if path.is_file() and "truth" not in path.parts)
    damage = _damage(random.choice(files), random)
    if random.random() < 0.5:
        return ["detect", str(folder / source), "--out", str(folder / "out.csv")], damage
    return _on(folder, source, random), damage


def _names(folder: Path, random: Random) -> tuple[list[str], str]:
    """Rename a file or folder of the capture."""
    paths = sorted((folder / "capture" / "frames").rglob("*"))
    path = random.choice(paths)
    name = random.choice([name for name in NAMES if name.strip(".") and not set(name) & set("/\0")])[:200]
    new = path.with_name(random.choice((name + path.suffix, name, "\udcff" + path.suffix)))
    if not new.exists():
        path.rename(new)
    return _on(folder, "capture", random), repr(new.name)


def _model(folder: Path, random: Random) -> tuple[list[str], str]:
    damage = _damage(folder / "model.safetensors", random)
    model = str(folder / "model.safetensors")
    if random.random() < 0.5:
        return ["evaluate", model, "--no-baselines", "--count", "2", "--trials", "1"], damage
    out = ["--out", str(folder / "out"), "--no-report"]
    return ["calibrate", str(folder / "labelled.csv"), *_subject(folder), *out, "--first-guess", model], damage


def _experiment(folder: Path, random: Random) -> tuple[list[str], str]:
    damage = _damage(folder / "experiment.yaml", random)
    return ["train", str(folder / "experiment.yaml"), "--out", str(folder / "out"), "--minutes", "0.02"], damage


def _setting(folder: Path, random: Random) -> tuple[list[str], str]:
    """Change an experiment on the command line."""
    experiment = json.dumps(load_experiment(folder / "experiment.yaml").model_dump())
    key = random.choice([word for word in experiment.split('"') if word.isidentifier()])
    group = random.choice(
        ("training.", "network.", "drift.", "optimizer.", "network.change.", "network.change.trunk.", "")
    )
    change = f"{group}{key}={random.choice(VALUES)}"
    arguments = ["train", str(folder / "experiment.yaml"), "--out", str(folder / "out"), "--minutes", "0.02"]
    return [*arguments, "--set", change], change[:80]


def _option(folder: Path, random: Random) -> tuple[list[str], str]:
    """Give an option a nonsensical value."""
    command = random.choice(tuple(OPTIONS))
    option = random.choice(OPTIONS[command])
    value = random.choice((*VALUES, *NAMES)).replace("\0", "")
    sound = {
        "simulate": ["simulate", *_subject(folder), "--out", str(folder / "out"), "--snapshots", "1"],
        "evaluate": ["evaluate", *_subject(folder), "--count", "2", "--trials", "1"],
        "convert": ["convert", str(folder / "foreign" / "colmap"), "--out", str(folder / "out" / "rig.yaml")],
        "detect": ["detect", str(folder / "capture"), "--out", str(folder / "out.csv")],
        "calibrate": ["calibrate", str(folder / "capture"), *_subject(folder), "--out", str(folder / "out")],
        "render": ["render", str(folder / "capture"), *_subject(folder), "--out", str(folder / "out"), "--size", "32"],
        "score": ["score", str(folder / "capture"), *_subject(folder)],
    }[command]
    if option == "--out":  # users may write anywhere, but here outputs stay in the case's folder
        value = str(folder / "out" / value.replace("..", "").lstrip("/"))
    more = [value, value] if option.endswith(("-deg", "--phi", ".radius")) else [value]
    return [*sound, option, *more], f"{command} {option} {value[:60]!r}"


KINDS: dict[str, Callable[[Path, Random], tuple[list[str], str]]] = {
    "rig": _rig,
    "foreign": _foreign,
    "object": _object,
    "table": _table,
    "frames": _frames,
    "names": _names,
    "model": _model,
    "experiment": _experiment,
    "setting": _setting,
    "option": _option,
}
