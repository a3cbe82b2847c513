from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import load_object, read_rig
from imgcal.synthesis import RelativeDrift, Snapshots, render_views, synthesize
from imgcal.types import CalibrationObject, CameraRig, Prediction
from tests.imgcal.evaluation.conftest import conditions, sample  # noqa: F401  fixtures


@dataclass(frozen=True)
class Scene:
    """Drifted rigs with one view each, and the factory that does not know of the drift."""

    factory: CameraRig
    obj: CalibrationObject
    prior_std: Tensor
    truth: Snapshots

    @classmethod
    def make(cls, rig: str, obj: str, count: int, seed: int = 5) -> "Scene":
        factory, fiducials, drift = read_rig(rig), load_object(obj), RelativeDrift(0.05, 0.05)
        truth = synthesize(factory, fiducials, count, torch.Generator().manual_seed(seed), drift=drift)
        return cls(factory, fiducials, drift.std(factory), truth)

    def guess(self, error: float, seed: int = 1) -> Prediction:
        """Disturb truth in all parameters, as a network would, until the reprojection error is about `error` px."""
        random = torch.Generator().manual_seed(seed)
        count = len(self.truth.rig.focal_length)
        step = torch.randn(count, *self.prior_std.shape, generator=random, dtype=torch.float64) * self.prior_std
        turn, shift = torch.randn(2, count, 3, generator=random, dtype=torch.float64).unbind(0)
        pose, centroid = self.truth.rig_from_object, self.obj.points.mean(0)
        centre = pose.apply(centroid[None])[:, 0] if count else pose.translation

        def at(share: Tensor) -> Prediction:
            rotation = rotation_from_vector(0.03 * turn * share[:, None]) @ pose.rotation
            translation = centre + 15 * shift * share[:, None] - rotation @ centroid
            return Prediction(
                self.truth.rig.retract(step * share[:, None, None]), RigidTransform(rotation, translation)
            )

        share = torch.full((count,), 1e-3, dtype=torch.float64)
        for _ in range(4):
            share = share * error / self.error(at(share))
        return at(share)

    def error(self, found: Prediction) -> Tensor:
        """The paper's reprojection error of each rig, (B,) pixels."""
        uv = found.rig.project(found.rig_from_object.apply(self.obj.points)).uv
        return (uv - self.truth.projection.uv).square().mean((1, 2, 3)).sqrt()

    def images(self, seen: Tensor | None = None, uv: Tensor | None = None) -> Tensor:
        """Draw 8-bit images of the truth, or of what is said to be seen of it, at other places if given."""
        projection = self.truth.projection
        uv, seen = projection.uv if uv is None else uv, projection.visible if seen is None else seen
        return render_views(uv.float(), seen, self.factory.image_size, self.obj, quantise=True)


@pytest.fixture(scope="session")
def o10_scene() -> Scene:
    """Three rigs of ten cameras and the default object of eight fiducials."""
    return Scene.make("O10", "asymmetric8", 3)


@pytest.fixture(scope="session")
def o6_scene() -> Scene:
    """Five rigs of six cameras and the cube."""
    return Scene.make("O6", "cube8", 5)
