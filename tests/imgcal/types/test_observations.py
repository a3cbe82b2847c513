"""`Detections` and `Observations`: selections keep columns together."""

import numpy as np
import torch

from imgcal.types import UNUSABLE, BlobFlag, Detections, Observations


def detections() -> Detections:
    rows = np.arange(12)
    return Detections(
        uv=np.stack((rows, 2 * rows), axis=1).astype(float),
        sigma=0.1 + rows,
        camera=rows % 3,
        snapshot=rows // 3,
        fiducial=rows - 1,
        radius=1.0 * rows,
        flags=np.array([0, 1, 2, 4, 8, 5] * 2, dtype=np.uint8),
        camera_names=("a", "b", "c"),
        snapshot_names=("s0", "s1", "s2", "s3"),
    )


def test_select_keeps_columns_together() -> None:
    by_index, by_mask = detections().select(np.array([7, 2])), detections().select(detections().camera == 1)
    assert len(by_index) == 2
    assert by_index.uv[:, 1].tolist() == [14, 4]
    assert by_index.fiducial.tolist() == [6, 1]
    assert by_mask.snapshot.tolist() == [0, 1, 2, 3]
    assert by_mask.camera_names == ("a", "b", "c")


def test_usable_follows_the_flags() -> None:
    assert detections().usable.tolist() == [True, False, False, True, False, False] * 2
    assert not UNUSABLE & BlobFlag.SATURATED


def test_of_snapshots_renumbers() -> None:
    part = detections().of_snapshots(1, 3)
    assert part.snapshot.tolist() == [0, 0, 0, 1, 1, 1]
    assert part.snapshot_names == ("s1", "s2")
    assert part.uv[0].tolist() == [3, 6]
    assert len(detections().of_snapshots(2, 2)) == 0


def test_observations_change_type_but_not_their_mask() -> None:
    seen = torch.ones(1, 2, 3, dtype=torch.bool)
    observations = Observations(torch.zeros(1, 2, 3, 2).double(), torch.ones(1, 2, 3).double(), seen)
    changed = observations.to(torch.float32).to(device="cpu")
    assert changed.uv.dtype == changed.sigma.dtype == torch.float32
    assert changed.seen.dtype == torch.bool
