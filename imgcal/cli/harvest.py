"""`imgcal harvest`: a calibrated capture in, training data of the user's own markers out."""

from __future__ import annotations

import sys
from functools import partial

from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, parse_range, progress, read_detections
from imgcal.io import load_object, open_capture, publishing, write_text
from imgcal.pipeline import capture_sight
from imgcal.training import CARD, HELD_OUT, TRAIN, FrameDataset, harvest
from imgcal.types import CalibrationObject, CameraRig

CARD_TEXT = """# Crops of real frames

Made by `imgcal harvest` from {capture} ({snapshots} snapshots, {cameras} cameras of rig {rig}, object {object}).

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
"""


class Harvest(arguments.Harvest):
    """Run `imgcal harvest`."""

    def run(self) -> None:
        """Cut and write."""
        check_folder(self.out)
        rig, obj = open_rig(self.rig), load_object(self.object)
        obj.require_rigid("to harvest crops")
        capture = open_capture(self.capture, rig, self.videos_differ)
        detections, _ = read_detections(capture, self.snapshots, self.detection, board=obj.board)
        first, _ = parse_range(self.snapshots)
        sight = None
        if self.detector != "classical" and obj.board is None:
            sight = capture_sight(capture, self.detector, self.detection, first)
        bar = partial(progress, label="harvesting")
        splits = harvest(
            lambda snapshot: capture.frames_of(first + snapshot), detections, rig, obj,
            detection=self.detection, sight=sight, size=self.size, seed=self.seed, progress=bar,
        )  # fmt: skip
        about = {"capture": str(self.capture), "rig": rig.name, "object": obj.name, "seed": self.seed}
        with publishing(self.out, (CARD, TRAIN, HELD_OUT), mark=CARD) as out:
            for name, part in zip((TRAIN, HELD_OUT), splits, strict=True):
                part.save(out / name, about)
            write_text(out / CARD, self._card(rig, obj, len(detections.snapshot_names), *splits))
        said = [f"{len(part)} crops with {_count_markers(part)} markers" for part in splits]
        print(f"{self.out}: {said[0]} for training, {said[1]} held out", file=sys.stderr)

    def _card(
        self, rig: CameraRig, obj: CalibrationObject, snapshots: int, train: FrameDataset, held_out: FrameDataset
    ) -> str:
        """Say what is in the dataset."""
        return CARD_TEXT.format(
            capture=self.capture, snapshots=snapshots, cameras=rig.num_cameras, rig=rig.name, object=obj.name,
            train=len(train), train_seen=_count_markers(train), train_snapshots=len(train.snapshot.unique()),
            held_out=len(held_out), held_out_seen=_count_markers(held_out),
            held_out_snapshots=len(held_out.snapshot.unique()),
            folder=self.out,
        )  # fmt: skip


def _count_markers(part: FrameDataset) -> int:
    """Count the markers that crops show."""
    return int(part.seen.sum())
