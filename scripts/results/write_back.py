"""Write recalibrated rigs back into the user's own files: `python -m scripts.results.write_back`.

Originals are the real files of IMGCAL_FORMATS, and a handwritten one for each format without a real file. Each is read,
and its rig drifts. A simulated capture of the drifted rig is calibrated, and the result is written back into the file;
if the cameras have no common view, the drifted rig itself is the result. The new file is read by imgcal and by
independent readers (`plain_readers.py`), and compared with the original byte by byte. Then originals are damaged until
300 of them have been refused. Writes docs/results/write_back.json and the table of docs/formats.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from imgcal import RigPrior, calibrate, load_object, load_rig, save_rig
from imgcal.errors import InputError, RefusedError
from imgcal.formats import (
    ForeignRig,
    Lens,
    Updated,
    convert_rig,
    fill_image_sizes,
    from_camera_rig,
    in_millimetres,
    known_points,
    millimetres,
    read_foreign_rig,
    to_camera_rig,
    worst_difference,
    write_into,
)
from imgcal.formats.limits import HELD_DISTORTION
from imgcal.synthesis import PhysicalDrift, simulate_volume, true_detections
from imgcal.types import CameraRig
from scripts.fuzz.cases import Case
from scripts.fuzz.mutations import mutated
from scripts.fuzz.verdict import attempt
from scripts.output import RESULTS, ROOT, command, fill, markdown, read_json, surroundings, write_json
from scripts.results.plain_readers import READERS
from tests.imgcal.formats import originals, rigs

RESULT, PAGE = RESULTS / "write_back.json", ROOT / "docs" / "formats.md"
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
ROUNDING = 1e-3  # px, allowed rounding error of a file besides the loss of its lens model
LIMIT, ALLOWED = 0.05, 0.5  # px, allowed error of a lens: imgcal's default, and where a user allows more
CALIBRATED, CALIBRATED_HELD, DRIFTED = "calibration", "calibration, distortion held", "drift"
DAMAGED = 300
SNAPSHOTS, NOISE = 40, 0.05  # of the simulated capture; noise in px
ASSUMED_SIZE = {"opencv-stereo": (1280, 720), "easymocap": (1920, 1080), "colmap-rig-config": (2048, 1088)}


@dataclass(frozen=True)
class Original:
    """A user's calibration."""

    name: str  # name of its format
    path: Path
    unit: str | None  # if the file does not give it
    is_real: bool

    @property
    def files(self) -> list[Path]:
        """All files that belong to it."""
        return sorted(self.path.iterdir()) if self.path.is_dir() else [self.path]

    @property
    def label(self) -> str:
        """Name it for tables."""
        return self.path.name if self.is_real else "written by hand"


def main() -> None:
    """Measure, and rewrite the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--damaged", type=int, default=DAMAGED, help="number of damaged originals that must be refused")
    given = parser.parse_args()
    result: dict[str, Any] = {**surroundings(), "snapshots": SNAPSHOTS, "noise_px": NOISE, "files": []}
    with tempfile.TemporaryDirectory() as place:
        cases = list(every_original(Path(place) / "originals"))
        recalibrated = []
        for number, one in enumerate(cases):
            folder = Path(place) / str(number)
            folder.mkdir()
            row = write_and_compare(one, folder)
            recalibrated.append((one, folder / "rig.yaml"))
            result["files"].append(row)
            print(json.dumps(row), flush=True)
        result["damaged"] = damage(recalibrated, given.damaged, Path(place) / "case")
        print(result["damaged"])
    write_json(RESULT, result)
    fill(PAGE, {"written back": table(read_json(RESULT))})


def every_original(folder: Path) -> Iterator[Original]:
    """Yield the real files, and a handwritten one for each format without any."""
    found = set()
    for expected in sorted(Path(os.environ["IMGCAL_FORMATS"]).rglob("*.expected.json")):
        path = expected.with_name(expected.name.removesuffix(".expected.json"))
        rig = read_foreign_rig(path)
        note = json.loads(expected.read_text("utf-8"))["unit_note"]
        unit = rig.unit or ("mm" if "mm" in note.split(";")[0] else "m")
        found.add(rig.format)
        yield Original(rig.format, path, None if rig.unit else unit, True)
    folder.mkdir()
    for name in sorted(READERS.keys() - found):
        content = by_hand(name)
        path = folder / f"{name}{'.xcp' if name == 'vicon' else '.toml'}"
        path.write_bytes(content)
        yield Original(name, path, None, False)


def by_hand(name: str) -> bytes:
    """Write a file of a format by hand: four cameras that look at one point."""
    lens = Lens((1010.5, 1010.5), (641.3, 478.9), (-0.05, 0.02, 1e-4, -2e-4, 0.003))
    rig = rigs.rig_of(*[lens] * 4, names=("0", "1", "2", "3"))
    if name == "vicon":
        return originals.vicon(rig)
    return next(iter(convert_rig(rig, name, "rig").files.values()))


def write_and_compare(one: Original, folder: Path) -> dict[str, Any]:
    """Drift, calibrate, write back and read again: a row of the table. Leaves the recalibrated rig in `rig.yaml`."""
    old = read_foreign_rig(one.path, one.name)
    known = in_millimetres(old, str(one.path), one.unit)
    known = fill_image_sizes(known, str(one.path), sizes_of(one, known))
    rig = to_camera_rig(converted_lenses(known), "rig")
    made, how, limit = recalibrate_into(one, rig, folder)
    ours = from_camera_rig(load_rig(folder / "rig.yaml"))
    out = folder / "new"
    if one.path.is_dir():
        out.mkdir()
    for name, content in made.files.items():
        (out / name if one.path.is_dir() else out).write_bytes(content)
    loss = made.loss.worst if made.loss is not None else 0.0
    own = worst_difference(ours, again(one, out, ours))[0]
    return {
        "format": one.name,
        "file": one.label,
        "real": one.is_real,
        "cameras": len(old.cameras),
        "recalibrated": len(made.changed),
        "how": how,
        "moved_px": moved(known, ours),
        "limit_px": limit,
        "loss_px": loss,
        "own_reader_px": own,
        "reader": READERS[one.name][0],
        "reader_px": by_plain_reader(one, out, old, ours),
        "numbers": compare_bytes(one, out),
    }


def recalibrate_into(one: Original, rig: CameraRig, folder: Path) -> tuple[Updated, str, float]:
    """Do what a user would until the file's lens model can express the new rig.

    Calibrate and write back. If the lens is refused, calibrate with fixed distortion, and finally allow a larger loss.

    Returns:
        The new files, the origin of their rig, and the limit. The rig is in `rig.yaml`.
    """
    held = replace(rig, prior=replace(rig.prior or RigPrior(), distortion=HELD_DISTORTION))
    refused = ""
    for how, before, limit in (
        (CALIBRATED, rig, LIMIT),
        (CALIBRATED_HELD, held, LIMIT),
        (CALIBRATED_HELD, held, ALLOWED),
    ):
        try:
            save_rig(recalibrate(before), folder / "rig.yaml")
            return put_back(one, folder, limit), how, limit
        except (InputError, RefusedError) as error:
            refused = str(error)
    save_rig(drifted(rig), folder / "rig.yaml")
    return put_back(one, folder, LIMIT), f"{DRIFTED} ({refused})", LIMIT


def put_back(one: Original, folder: Path, limit: float) -> Updated:
    """Write `rig.yaml` into the original.

    Raises:
        RefusedError: the file's lens model is wrong by more than the limit.
    """
    ours = from_camera_rig(load_rig(folder / "rig.yaml"))
    return write_into(ours, [one.path], datetime.now(), name=one.name, unit=one.unit, limit=limit)


def converted_lenses(rig: ForeignRig) -> ForeignRig:
    """Convert the lenses to those of imgcal's rig files, as `imgcal convert` does."""
    from imgcal.formats.conversion import NATIVE, fit_to_target

    return fit_to_target(rig, NATIVE, "imgcal rig").rig


def sizes_of(one: Original, rig: ForeignRig) -> dict[str, tuple[int, int]]:
    """Image sizes, if the file does not give them."""
    return {"": ASSUMED_SIZE[one.name]} if any(camera.image_size is None for camera in rig.cameras) else {}


def recalibrate(rig: CameraRig) -> CameraRig:
    """Let a rig drift, and calibrate a simulated capture of it.

    Raises:
        InputError, RefusedError: there is only one camera, or the common views do not determine the rig.
    """
    generator = torch.Generator().manual_seed(0)
    obj = load_object("asymmetric8")
    truth = simulate_volume(rig, obj, SNAPSHOTS, generator, drift_of(rig))
    seen = true_detections(truth)
    noise = NOISE * torch.randn(seen.uv.shape, generator=generator, dtype=torch.float64).numpy()
    return calibrate(replace(seen, uv=seen.uv + noise), rig, obj).rig


def drift_of(rig: CameraRig) -> PhysicalDrift:
    """Drift of a tenth of a degree, and a thousandth of the rig's size and of the focal length."""
    centres = rig.cam_from_rig.inverse().translation
    size = float((centres - centres.mean(0)).norm(dim=-1).max()) or 1000.0
    return PhysicalDrift(0.1, 1e-3 * size, 1e-3, 0.5, distortion=0.0)


def drifted(rig: CameraRig) -> CameraRig:
    """Rig after such a drift, as if it had been calibrated without error."""
    return drift_of(rig).apply(rig, torch.Generator().manual_seed(0))


def again(one: Original, out: Path, ours: ForeignRig) -> ForeignRig:
    """Read the new file with imgcal, in millimetres."""
    back = in_millimetres(read_foreign_rig(out, one.name), str(out), one.unit)
    sizes = {camera.name: camera.image_size for camera in ours.cameras}
    return replace(back, cameras=tuple(replace(camera, image_size=sizes[camera.name]) for camera in back.cameras))


def moved(before: ForeignRig, after: ForeignRig) -> float:
    """Largest motion (px) of the images of known points; positive if there was something to write."""
    return worst_difference(before, after)[0]


def by_plain_reader(one: Original, out: Path, old: ForeignRig, ours: ForeignRig) -> float:
    """Largest distance (px) between the projections of known points by an independent reader and by the rig."""
    alone = len(old.cameras) == 1  # and then has no pose
    placed = ours.in_camera_frame(old.root or 0) if alone or old.root is not None else ours
    scale = 1.0 / millimetres(one.unit or old.unit or "mm")
    projections = READERS[one.name][1](out)
    worst = 0.0
    for camera, points in zip(placed.cameras, known_points(placed), strict=True):
        away = projections[camera.name](points * scale) - camera.project(points)
        worst = max(worst, float(np.linalg.norm(away, axis=-1).max()))
    return worst


def compare_bytes(one: Original, out: Path) -> int:
    """Count the changed numbers.

    Raises:
        InputError: something else changed.
    """
    count = 0
    for file in one.files:
        before, after = file.read_bytes(), (out / file.name if one.path.is_dir() else out).read_bytes()
        if file.suffix == ".bin":
            if len(before) != len(after):
                raise InputError(f"{file}: found {len(after)} bytes, expected {len(before)}")
            count += different_doubles(before, after)
            continue
        texts = [content.decode("utf-16" if content[:2] == b"\xff\xfe" else "utf-8") for content in (before, after)]
        if NUMBER.sub("#", texts[0]) != NUMBER.sub("#", texts[1]):
            raise InputError(f"{file}: found other changes than numbers")
        count += sum(a != b for a, b in zip(*map(NUMBER.findall, texts), strict=True))
    return count


def different_doubles(before: bytes, after: bytes) -> int:
    """Count runs of different bytes, each within the eight bytes of a number."""
    places = np.flatnonzero(np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8))
    count, end = 0, -1
    for place in places.tolist():
        if place >= end:
            count, end = count + 1, place + 8
    return count


def damage(recalibrated: Sequence[tuple[Original, Path]], enough: int, folder: Path) -> dict[str, Any]:
    """Damage originals until enough of them are refused, and check how the command ends.

    An original that is still valid after the damage must be written correctly.
    """
    counts = {"refused": 0, "lens_refused": 0, "sound_and_right": 0}
    faults: list[str] = []
    kinds: dict[str, int] = {}
    number = 0
    while counts["refused"] < enough:
        one, rig = recalibrated[number % len(recalibrated)]
        random = Random(f"write back {number}")
        number += 1
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        place = folder / one.path.name
        (shutil.copytree if one.path.is_dir() else shutil.copyfile)(one.path, place)
        file = random.choice([place / path.name for path in one.files] if place.is_dir() else [place])
        file.chmod(0o644)
        file.write_bytes(mutated(file.read_bytes(), file.suffix, random))
        shutil.copyfile(rig, folder / "rig.yaml")
        unit = [] if one.unit is None else ["--out-unit", one.unit]
        arguments = ["convert", str(folder / "rig.yaml"), "--into", str(place), "--to", one.name]
        case = Case(folder, [*arguments, "--out", str(folder / "out"), *unit], one.name)
        code, fault = attempt(case)
        if not fault and code == 0:
            fault = wrong(one, folder)
        if fault:
            faults.append(f"{number - 1} {one.label}: {fault}")
        counts[("sound_and_right", "", "refused", "lens_refused")[code if isinstance(code, int) else 1]] += 1
        if code == 2:
            kinds[one.name] = kinds.get(one.name, 0) + 1
    return {"tried": number, **counts, "faults": faults, "refused_by_format": kinds}


def wrong(one: Original, folder: Path) -> str:
    """Describe the fault of a file that was written from a damaged original; empty if there is none."""
    ours = from_camera_rig(load_rig(folder / "rig.yaml"))
    try:
        back = again(one, folder / "out", ours)
        off = worst_difference(ours, back)[0]
    except (InputError, KeyError, ValueError) as error:
        return f"cannot be read: {error}"
    return "" if off <= 0.05 + ROUNDING else f"off by {off:.3g} px"


def table(result: dict[str, Any]) -> str:
    """Make the table of comparisons, one row per file."""
    rows = []
    for row in result["files"]:
        loss = f"{row['loss_px']:.1e}" if row["loss_px"] else "exact"
        cameras = f"{row['recalibrated']} of {row['cameras']}"
        own, other = f"{row['own_reader_px']:.1e}", f"{row['reader']}: {row['reader_px']:.1e}"
        source = row["how"].partition(" (")[0]
        rows.append((f"`{row['format']}`", row["file"], cameras, source, loss, own, other, f"{row['numbers']:,}"))
    damaged = result["damaged"]
    head = (
        "format", "original", "cameras", "new rig from", "lens loss, px", "read by us, worst px",
        "independent reader, worst px", "numbers changed",
    )  # fmt: skip
    return "\n".join(
        (
            markdown(head, rows),
            "",
            f"Damaged originals: {damaged['tried']} tried, {damaged['refused']} refused with one line and exit code 2, "
            f"{damaged['sound_and_right']} still valid and written correctly, {damaged['lens_refused']} refused for "
            f"the lens (exit code 3), {len(damaged['faults'])} faults. Nothing was written for refused ones.",
        )
    )


if __name__ == "__main__":
    command(main)
