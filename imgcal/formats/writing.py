"""Write a rig as another tool's files; they are read back and compared before they are written."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgcal.errors import InputError
from imgcal.formats.conversion import (
    NATIVE,
    StorableRig,
    fit_note,
    fit_to_target,
    from_camera_rig,
    in_millimetres,
    millimetres,
    to_camera_rig,
)
from imgcal.formats.foreign_rig import ForeignRig, FormatError, worst_difference
from imgcal.formats.format import Files
from imgcal.formats.limits import HELD_DISTORTION, LIMIT
from imgcal.formats.registry import FORMATS, find_format, read_back
from imgcal.io import POSTERIOR, RigCovariance, posterior_bytes, rig_from_text, rig_text
from imgcal.types import RigPrior

OURS = "imgcal"
MOST_PX = 1e-6  # that a file may be off when it is read back: the digits of a double


@dataclass(frozen=True)
class Written:
    """The files of a rig, and how well they represent it."""

    files: Files
    notes: tuple[str, ...]  # what the target has no place for, and which lenses were fitted
    round_trip: float  # px, of what is read back from the files against what was to be written; same lens models
    between_models: float  # px, against what was read from the source, with the source's own lens models
    points: int  # known points that were compared


def convert_rig(
    rig: ForeignRig,
    to: str,
    name: str,
    limit: float = LIMIT,
    unit: str | None = None,
    *,
    hold_distortion: bool = False,
) -> Written:
    """Make the files of a format, read them back, and compare.

    Args:
        rig: in millimetres, with image sizes.
        to: name of the format; "imgcal" = our own.
        name: of the rig, where there is a place for it.
        limit: pixels that a fitted lens may be off.
        unit: of the lengths in the files, where the format leaves that to its user; None = its custom.
        hold_distortion: write a rig file of ours whose prior keeps the distortion of the lenses in calibrations.

    Raises:
        InputError: the format is only read, or it cannot hold so many cameras.
        RefusedError: a lens cannot be expressed within `limit`.
    """
    if to == OURS:
        if unit is not None and millimetres(unit, "--out-unit") != 1.0:
            raise InputError(f"--out-unit {unit}: an imgcal rig file is always in mm")
        return _convert_to_ours(rig, name, limit, hold_distortion)
    target = find_format(to)
    if target.write is None:
        able = ", ".join(one.name for one in FORMATS if one.write is not None)
        raise InputError(
            f"--to {to}: {target.title} can only be read, or written back into its own file (--into FILE), expected "
            f"one of imgcal, {able}"
        )
    least, most = target.cameras
    if not least <= len(rig.cameras) <= most:
        count = f"{least}" if least == most else f"{least} to {most}"
        raise InputError(
            f"--to {to}: {target.title} holds {count} cameras, found {len(rig.cameras)}: choose with --cameras"
        )
    held = fit_to_target(rig, target.holds, target.title, limit)
    notes: list[str] = []
    if rig.covariance is not None:
        notes.append("standard deviations are left out: the format has no place for them")
    if rig.own is not None and rig.own.posterior is not None:
        notes.append("the posterior of the calibration is left out: the format has no place for it")
    files_unit = unit or target.unit
    if unit is not None and target.states_unit and millimetres(unit) != millimetres(target.unit):
        raise InputError(f"--out-unit {unit}: {target.title} is always in {target.unit}")
    placed = held.rig.in_camera_frame() if target.from_first else held.rig
    if target.from_first and rig.format != to and len(rig.cameras) > 1:
        notes.append(f"the frame of the files is that of camera {rig.names[0]}")
    length = millimetres(files_unit)
    notes.append(f"lengths in the files: {files_unit}")
    try:
        files = target.write(placed.scale(1.0 / length, files_unit))
    except FormatError as error:
        raise InputError(f"--to {to}: {error}") from error
    back = in_millimetres(read_back(files, to), target.name, None if target.states_unit else files_unit)
    if not target.numbers_cameras and sorted(back.names) == sorted(rig.names):
        # Files of a folder come in the order of their names.
        back = select_cameras(back, tuple(rig.names))
    elif back.names != rig.names:
        notes.append(f"the cameras have other names in the files, in this order: {', '.join(back.names[:8])}")
    return _compare(rig, held, back, files, notes)


def _convert_to_ours(rig: ForeignRig, name: str, limit: float, hold_distortion: bool) -> Written:
    """Make a rig file of ours, and the file of its posterior beside it where that still describes the rig."""
    held = fit_to_target(rig, NATIVE, "an imgcal rig file", limit)
    made = to_camera_rig(held.rig, name)
    if hold_distortion:
        made = replace(made, prior=replace(made.prior or RigPrior(), distortion=HELD_DISTORTION))
    files: Files = {}
    notes: list[str] = []
    beside: str | None = None
    if made.posterior is not None:
        posterior = None if hold_distortion else made.posterior().of_cameras(made.camera_names)
        if posterior is not None and posterior.belongs_to(made):
            beside = f"{name}{POSTERIOR}"
            files[beside] = posterior_bytes(posterior)
        else:
            notes.append("the posterior of the calibration is left out: it describes other values, or another prior")
    full = rig.covariance is not None and rig.covariance.matrix is not None
    text = rig_text(made, name, rig.covariance, full, beside)
    return _compare(rig, held, from_camera_rig(rig_from_text(text, name)), {**files, "": text.encode()}, notes)


def _compare(rig: ForeignRig, held: StorableRig, back: ForeignRig, files: Files, notes: list[str]) -> Written:
    """Compare what was read back with what was to be written, and with the source."""
    exact, _ = worst_difference(held.rig, back)
    between, points = worst_difference(rig, back)
    if not exact <= MOST_PX:
        raise RuntimeError(f"the written file, read back, is {exact:.3g} px off")
    notes += [fit_note(camera, fit) for camera, fit in zip(rig.cameras, held.fits, strict=True) if not fit.exact]
    return Written(files, tuple(notes), exact, between, points)


def select_cameras(rig: ForeignRig, names: tuple[str, ...]) -> ForeignRig:
    """Keep the cameras of some names, in that order.

    Raises:
        InputError: a name that the rig does not have, or twice.
    """
    unknown = [name for name in names if name not in rig.names]
    if unknown or len(set(names)) < len(names):
        raise InputError(
            f"--cameras: found {', '.join(names)}, expected names out of {', '.join(rig.names)}, each once"
        )
    by_name = {camera.name: camera for camera in rig.cameras}
    own = rig.own.select([rig.names.index(name) for name in names]) if rig.own is not None else None
    chosen = replace(rig, cameras=tuple(by_name[name] for name in names), covariance=None, own=own)
    return chosen if rig.covariance is None else _select_uncertainty(chosen, rig, rig.covariance)


def _select_uncertainty(chosen: ForeignRig, rig: ForeignRig, covariance: RigCovariance) -> ForeignRig:
    """What is known of the cameras that were chosen, unless it is relative to one that was not."""
    if covariance.reference_camera is not None and covariance.reference_camera not in chosen.names:
        note = f"standard deviations are left out: they are relative to camera {covariance.reference_camera}"
        return replace(chosen, notes=(*chosen.notes, note))
    index = [rig.names.index(name) for name in chosen.names]
    std, matrix = covariance.std[index], covariance.matrix
    if matrix is not None:
        size = len(rig.names)
        blocks = matrix.reshape(size, -1, size, matrix.shape[0] // size)[index][:, :, index]
        matrix = blocks.reshape(std.numel(), std.numel())
    return replace(chosen, covariance=replace(covariance, std=std, matrix=matrix))
