"""Many small markers on a plate, and cameras with long lenses that look at it."""

import numpy as np
import torch

from imgcal.geometry import RigidTransform
from imgcal.types import CalibrationObject, CameraRig, RigPrior


def telephoto(cameras: int = 2) -> CameraRig:
    rotation = torch.eye(3).double().expand(cameras, 3, 3)
    return CameraRig(
        torch.full((cameras, 2), 5000.0).double(), torch.tensor([[640.0, 512.0]] * cameras).double(),
        torch.zeros(cameras, 5).double(),
        RigidTransform(rotation, torch.tensor([[2.0 * c, 0.0, 500.0] for c in range(cameras)]).double()),
        torch.tensor([[1280, 1024]] * cameras), tuple("abcd"[:cameras]), "telephoto", None,
        RigPrior(focal_length=0.01, principal_point=20.0, distortion=0.05, rotation=0.005, position=3.0),
    )  # fmt: skip


def plate(columns: int = 15, rows: int = 6, radius: float | None = None) -> CalibrationObject:
    x, y = np.meshgrid(5.0 * np.arange(columns), 8.0 * np.arange(rows))
    points = torch.from_numpy(np.stack((x, y, 0 * x), -1).reshape(-1, 3))
    points = points - points.mean(0)
    size = None if radius is None else torch.full((len(points),), radius).double()
    return CalibrationObject(points, torch.zeros_like(points), size)
