"""Write a recalibrated rig into the user's own file: replace its numbers, and read them back before writing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from imgcal.errors import InputError, RefusedError
from imgcal.formats.conversion import fit_note, lens_refusal, millimetres
from imgcal.formats.fitting import Fit, fit_lens_like
from imgcal.formats.foreign_rig import ForeignCamera, ForeignRig, FormatError, worst_difference
from imgcal.formats.limits import LIMIT, ROUNDING
from imgcal.formats.patching import Change, TextFile, patch_bytes
from imgcal.formats.registry import find_format, is_foreign, read_back, read_foreign_rig
from imgcal.formats.source import SUFFIXES, Source
from imgcal.io import read_bytes
from imgcal.messages import name_cameras, with_article

DIGITS = (0, 9, 12, 17)  # tried in this order: those of the file first
MOST_BYTES = 2**30
STAYED = 1e-6  # px: a camera that is off by less from what the file says has not been recalibrated


@dataclass(frozen=True)
class Updated:
    """The files of a calibration with new numbers, and how well they represent the rig."""

    files: dict[str, bytes]
    title: str  # of the format
    notes: tuple[str, ...]
    changed: tuple[str, ...]  # cameras
    kept: tuple[str, ...]  # cameras that stayed as they were
    reread: float  # px, of what is read back against what was to be written
    loss: Fit | None  # of the lens that fits worst; None = all are exact
    points: int  # known points that were compared


def write_into(
    rig: ForeignRig,
    original: Sequence[Path],
    now: datetime,
    *,
    name: str | None = None,
    original_rig: str | None = None,
    unit: str | None = None,
    limit: float = LIMIT,
) -> Updated:
    """Put the cameras of a rig into the files of another tool that has them.

    Args:
        rig: in millimetres, with image sizes.
        original: the file, the folder, or the files that are one calibration.
        now: what times of calibration in the files become.
        name: of the format; None = by content.
        original_rig: which one, where the files hold several.
        unit: of the lengths in the files, where they do not say.
        limit: pixels that a lens may be off, anywhere in its image, in the model of the file.

    Raises:
        InputError: one line: the files cannot be read or are our own, have other cameras, or cannot be followed.
        RefusedError: the file's lens model does not come near enough.
    """
    where = ", ".join(map(str, original))
    for path in original:
        if path.is_file() and not is_foreign(path):
            raise InputError(f"{path}: found a rig file of imgcal, expected the calibration of another tool")
    old = read_foreign_rig(original, name, original_rig)
    title = find_format(old.format).title
    try:
        return _write_back(rig, old, original, now, unit, limit, original_rig)
    except FormatError as error:
        raise InputError(f"{where}: this is {with_article(title)}: {error}") from error


def _write_back(
    rig: ForeignRig,
    old: ForeignRig,
    original: Sequence[Path],
    now: datetime,
    unit: str | None,
    limit: float,
    original_rig: str | None,
) -> Updated:
    where, title = ", ".join(map(str, original)), find_format(old.format).title
    absent = [camera for camera in rig.names if camera not in old.names]
    if absent:
        raise InputError(
            f"{where}: found {name_cameras(old.names)}, expected also {name_cameras(absent)} of the rig: choose with "
            "--cameras, or rename"
        )
    if unit is None and old.unit is None and len(old.cameras) > 1:
        raise InputError(
            f"{where}: the file does not state its unit of length: give it with --out-unit mm, cm, m, inch"
        )
    length = millimetres(unit or old.unit or "mm", "--out-unit")
    found = {camera.name: camera for camera in rig.scale(1.0 / length, unit or old.unit or "mm").cameras}
    _check_sizes(where, old, found)
    fits: dict[str, Fit] = {}
    cameras = []
    for camera in old.cameras:
        new = found.get(camera.name)
        if new is None or _is_unchanged(camera, new):
            cameras.append(camera)
            continue
        assert new.image_size is not None
        fits[camera.name] = fit_lens_like(new.lens, new.image_size, camera.lens, camera.one_focal_length, limit)
        cameras.append(replace(new, lens=fits[camera.name].lens))
    _check_fits(fits, old, found, title, limit)
    wanted = replace(old, cameras=tuple(cameras))
    if old.root is not None:
        wanted = wanted.in_camera_frame(old.root)
    notes = _frame_notes(old, wanted, found)
    contents = {path: read_bytes(path, MOST_BYTES) for path in _list_files(original)}
    changes = _changes(old, wanted)
    sized = _fill_sizes(wanted, rig)
    for digits in DIGITS:
        files, stamps = _patch(contents, changes, digits, now)
        try:
            back = read_back(files, old.format, original_rig)
        except FormatError:
            if digits == DIGITS[-1]:
                raise
            continue  # rounded so that its values do not fit together
        if back.names != old.names:
            raise FormatError("the new file, read back, has other cameras")
        reread, points = worst_difference(sized, _fill_sizes(back, rig))
        if reread <= ROUNDING:
            break
    else:
        raise FormatError(f"the new file, read back, is {reread:.3g} px off: nothing is written")
    if digits:
        notes.append(
            f"numbers have at least {digits} digits: as many as in the file would cost more than {ROUNDING:g} px"
        )
    notes += stamps
    kept = tuple(camera.name for camera in old.cameras if camera.name not in fits)
    inexact = [fit for fit in fits.values() if not fit.exact]
    worst = max(inexact, key=lambda fit: fit.worst, default=None)
    notes += [fit_note(found[camera], fit) for camera, fit in fits.items() if not fit.exact]
    return Updated(files, title, tuple(notes), tuple(fits), kept, reread, worst, points)


def _check_sizes(where: str, old: ForeignRig, found: Mapping[str, ForeignCamera]) -> None:
    for camera in old.cameras:
        new = found.get(camera.name)
        if new is not None and None not in (new.image_size, camera.image_size) and new.image_size != camera.image_size:
            (w, h), (width, height) = camera.image_size or (0, 0), new.image_size or (0, 0)
            raise InputError(f"{where}: camera {camera.name}: found {w}x{h} pixels, the rig has {width}x{height}")


def _check_fits(
    fits: Mapping[str, Fit], old: ForeignRig, found: Mapping[str, ForeignCamera], title: str, limit: float
) -> None:
    lenses = {camera.name: camera.lens for camera in old.cameras}
    for camera, fit in fits.items():
        if not fit.worst <= limit:
            nearest = f"the nearest with the file's {len(lenses[camera].coefficients)} coefficients"
            raise RefusedError(
                lens_refusal(found[camera], fit, title, nearest, limit),
                command="--fit-limit allows more; or convert the file with --hold-distortion and calibrate again",
                python="`limit` allows more",
            )


def _is_unchanged(camera: ForeignCamera, new: ForeignCamera) -> bool:
    """Tell whether the file already has a camera as it is now."""
    one, other = (ForeignRig("", (replace(c, image_size=new.image_size),), None, "") for c in (camera, new))
    near = np.allclose(camera.centre, new.centre, rtol=1e-9, atol=1e-9)
    turned = np.allclose(camera.rotation, new.rotation, rtol=0, atol=1e-10)
    return bool(near and turned and worst_difference(other, one)[0] <= STAYED)


def _frame_notes(old: ForeignRig, wanted: ForeignRig, found: Mapping[str, ForeignCamera]) -> list[str]:
    """Report a rig whose frame is not the file's: cameras that are not in the rig would stay behind.

    Raises:
        FormatError: there are some.
    """
    pairs = [(camera, new) for camera, new in zip(old.cameras, wanted.cameras, strict=True) if camera.name in found]
    if len(pairs) < 2:
        return []
    turns = [camera.rotation.T @ new.rotation for camera, new in pairs]
    mean_left, _, mean_right = np.linalg.svd(sum(turns))
    common = mean_left @ mean_right
    apart = max(_angle(common.T @ turn) for turn in turns)
    turned = _angle(common)
    centres = np.array([[camera.centre, new.centre] for camera, new in pairs])
    means = centres.mean(axis=0)
    spread = float(np.linalg.norm(centres[:, 0] - means[0], axis=-1).max()) or 1.0
    moved = float(np.linalg.norm(means[0] - means[1]))
    left = centres[:, 0] - means[0] - (centres[:, 1] - means[1]) @ common.T
    own = float(np.linalg.norm(left, axis=-1).max())
    if not (turned > max(0.01, 5 * apart) or moved > max(0.02 * spread, 5 * own)):
        return []
    said = (
        f"all cameras together are turned by {np.degrees(turned):.2g} deg and moved by {moved / spread:.2g} of the "
        "rig's size"
    )
    behind = [camera.name for camera in old.cameras if camera.name not in found]
    if behind:
        raise FormatError(
            f"the rig is in another frame than the file ({said}), and {name_cameras(behind)}, which the rig does "
            "not have, "
            "would stay behind: convert the file itself to a rig, and recalibrate that"
        )
    return [f"the frame of the rig is not that of the file: {said}"] if old.root is None else []


def _angle(rotation: np.ndarray) -> float:
    skewed = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(np.linalg.norm(skewed), np.trace(rotation) - 1))


def _list_files(original: Sequence[Path]) -> list[Path]:
    source = Source(list(original))
    if source.alone:
        return source.files
    return [path for path in source.files if path.suffix.lower() in {*SUFFIXES, ".bin"}]


def _changes(old: ForeignRig, wanted: ForeignRig) -> dict[Path, list[Change]]:
    """Collect the numbers to replace: for each place in the files, those of the camera before and after."""
    changes: dict[Path, list[Change]] = {}
    for camera, new in zip(old.cameras, wanted.cameras, strict=True):
        if not camera.places:
            raise FormatError(f"camera {camera.name}: this format can only be read, not written back")
        for place in camera.places:
            base = place.relative_to
            before = camera if base is None else camera.in_frame_of(old.cameras[base])
            after = new if base is None else new.in_frame_of(wanted.cameras[base])
            numbers = list(place.numbers(after))
            changes.setdefault(place.path, []).append(
                Change(place.keys, list(place.numbers(before))[: len(numbers)], numbers, place.first)
            )
    return changes


def _patch(
    contents: Mapping[Path, bytes], changes: Mapping[Path, list[Change]], digits: int, now: datetime
) -> tuple[dict[str, bytes], list[str]]:
    """Patch the files of a calibration, by name; also returns notes about their time stamps."""
    files: dict[str, bytes] = {}
    notes: list[str] = []
    for path, content in contents.items():
        made = content
        if path.suffix == ".bin":
            made = patch_bytes(content, changes.get(path, []))
        elif path in changes:
            made = TextFile(content, path).patch(changes[path], digits)
            if made != content:
                made, replaced, left = TextFile(made, path).stamp(now)
                if replaced:
                    notes.append(f"{path.name}: {', '.join(replaced)} set to {now:%Y-%m-%d %H:%M:%S}")
                if left:
                    notes.append(f"{path.name}: {', '.join(left)} unchanged: a time of unknown form")
        files[path.name] = made
    return files, notes


def _fill_sizes(one: ForeignRig, rig: ForeignRig) -> ForeignRig:
    """Image sizes of the rig for cameras that have none in the file."""
    sizes = {camera.name: camera.image_size for camera in rig.cameras}
    some = next(iter(sizes.values()))
    cameras = tuple(
        replace(camera, image_size=camera.image_size or sizes.get(camera.name, some)) for camera in one.cameras
    )
    return replace(one, cameras=cameras)
