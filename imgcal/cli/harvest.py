"""`imgcal harvest`: a calibrated capture in, training data of the user's own markers out."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, parse_range, progress, read_detections
from imgcal.errors import InputError, RefusedError
from imgcal.io import load_object, open_capture, publishing, write_text
from imgcal.messages import plural
from imgcal.pipeline import capture_sight
from imgcal.training import (
    CARD,
    HELD_OUT,
    HELD_OUT_PATCHES,
    TRAIN,
    TRAIN_PATCHES,
    FrameDataset,
    PatchDataset,
    cut_labelled,
    split,
)
from imgcal.types import CalibrationObject, CameraRig

CARD_TEXT = """# Crops of real frames

Made by `{command}` from {capture} ({snapshots} snapshots, {cameras} cameras of rig {rig}, object {object}).

| file | crops | markers to be seen | snapshots |
|---|---|---|---|
| `train.safetensors` | {train} | {train_seen} | {train_snapshots} |
| `held_out.safetensors` | {held_out} | {held_out_seen} | {held_out_snapshots} |

`held_out` is for validation: other snapshots, never neighbours in time of those in `train`; of fewer than five
snapshots, other cameras.

Tensors (M crops of S x S pixels, up to N fiducials): `crops` (M, S, S) light above the ground of the crop in units of
its markers, NaN outside the image; `place` (M, N, 2) crop pixels where the calibrated rig has the fiducials, `sigma`
(M, N) its standard deviation; `radius`, `depth` (M, N) of the markers' images; `asked` (M, N) fiducials in the crop;
`seen` (M, N) markers that the frame shows; `camera`, `snapshot` (M,).

To adapt a network: `imgcal train ir-cnn --from {folder} --out adapted`.

{patches}
"""


PATCHES_TEXT = """`train_patches.safetensors` ({train}) and `held_out_patches.safetensors` ({held_out}) are for the
measurer: `imgcal train measurer-cnn --from {folder} --out measurer`. Tensors (M patches): `light` (M, 24, 24) above
the ground of the patch in units of its marker; `radius` (M,) and `offset` (M, 2) of the marker, patch pixels, from
the middle of the patch; `camera`, `snapshot` (M,)."""
NO_PATCHES = (
    "too few markers have a place that is known to a pixel. Is --rig what imgcal calibrate made of this capture, not "
    "the factory rig?"
)


class Harvest(arguments.Harvest):
    """Run `imgcal harvest`."""

    def run(self) -> None:
        """Cut and write."""
        check_folder(self.out)
        if any((self.out / name).exists() for name in (TRAIN, HELD_OUT)):
            raise InputError(f"{self.out}: found a dataset there already, expected a new folder")
        rig, obj = open_rig(self.rig), load_object(self.object)
        obj.require_rigid("to harvest crops")
        capture = open_capture(self.capture, rig, self.videos_differ)
        detections, _ = read_detections(capture, self.snapshots, self.detection, board=obj.board)
        first, _ = parse_range(self.snapshots)
        sight = None
        if self.detector != "classical" and obj.board is None:
            sight = capture_sight(capture, self.detector, self.detection, first)

        def bar(snapshots: Iterable[int], total: int) -> Iterable[int]:
            return progress(snapshots, total, "harvesting")

        crops, patches = cut_labelled(
            lambda snapshot: capture.frames_of(first + snapshot), detections, rig, obj,
            detection=self.detection, sight=sight, seed=self.seed, progress=bar,
        )  # fmt: skip
        count = len(detections.snapshot_names)
        splits = split(crops, count, rig.num_cameras)
        parts = self._split_patches(patches, count, rig.num_cameras)
        source = Source("imgcal harvest", str(self.capture), count, self.seed, rig, obj)
        write_dataset(self.out, splits, parts, source)
        said = [f"{plural(len(part), 'crop')} with {_count_markers(part)} markers" for part in splits]
        print(f"{self.out}: {said[0]} for training, {said[1]} held out", file=sys.stderr)
        if not parts:
            print(f"note: no patches for the measurer: {NO_PATCHES}", file=sys.stderr)

    def _split_patches(self, patches: PatchDataset, snapshots: int, cameras: int) -> Sequence[PatchDataset]:
        """Hold out patches like crops; none where either part would be empty: crops are of use without them."""
        try:
            return split(patches, snapshots, cameras)
        except RefusedError:
            return ()


@dataclass(frozen=True)
class Source:
    """Where the snapshots of a dataset come from."""

    command: str  # that made the dataset
    capture: str
    snapshots: int
    seed: int  # of the crops' places
    rig: CameraRig
    obj: CalibrationObject


def write_dataset(
    folder: Path, splits: Sequence[FrameDataset], patches: Sequence[PatchDataset], source: Source
) -> None:
    """Write crops and patches, each to train on and held out, and a card, in one step; patches may be missing."""
    about = {"capture": source.capture, "rig": source.rig.name, "object": source.obj.name, "seed": source.seed}
    with publishing(folder, (CARD, TRAIN, HELD_OUT, TRAIN_PATCHES, HELD_OUT_PATCHES), mark=CARD) as out:
        for name, part in zip((TRAIN, HELD_OUT), splits, strict=True):
            part.save(out / name, about)
        for name, some in zip((TRAIN_PATCHES, HELD_OUT_PATCHES), patches, strict=False):
            some.save(out / name, about)
        write_text(out / CARD, _card(folder, splits, patches, source))


def _card(folder: Path, splits: Sequence[FrameDataset], patches: Sequence[PatchDataset], source: Source) -> str:
    """Say what is in the dataset."""
    train, held_out = splits
    of_patches = f"There are no patches for the measurer: {NO_PATCHES}"
    if patches:
        of_patches = PATCHES_TEXT.format(train=len(patches[0]), held_out=len(patches[1]), folder=folder)
    return CARD_TEXT.format(
        command=source.command, capture=source.capture, snapshots=source.snapshots,
        cameras=source.rig.num_cameras, rig=source.rig.name, object=source.obj.name, folder=folder, patches=of_patches,
        train=len(train), train_seen=_count_markers(train), train_snapshots=len(train.snapshot.unique()),
        held_out=len(held_out), held_out_seen=_count_markers(held_out),
        held_out_snapshots=len(held_out.snapshot.unique()),
    )  # fmt: skip


def _count_markers(part: FrameDataset) -> int:
    """Count the markers that crops show."""
    return int(part.seen.sum())
