"""`RenderAndCompare`: the rig whose rendered images match the given ones, as a layer."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor, nn

from imgcal.geometry import RigidTransform
from imgcal.nn.buffers import ObjectBuffers, RigBuffers
from imgcal.nn.pytrees import register
from imgcal.refinement import ImageRefinementOptions, encode_image_options, refine_images_anywhere
from imgcal.types import CalibrationObject, CameraRig, Prediction, RigPrior


@dataclass(frozen=True)
class RefinedImages:
    """A rig refined on images."""

    rig: CameraRig  # (*B)
    rig_from_object: RigidTransform  # (*B)
    converged: Tensor  # (*B) bool: the images are explained; check it


register(RefinedImages)


class RenderAndCompare(nn.Module):
    """Refine a prediction on the colour-coded images from which it was made: photometric Gauss-Newton, then MAP.

    Gradients follow from the solution by the implicit function theorem. They flow to the images (with their
    Gauss-Newton curvature: exact where the images are explained), the factory rig and its prior. None flows through the
    first guess, which only starts the search. The module is one opaque operator in a compiled or
    exported graph; it computes in float64, images in float32.

    Args:
        factory: the factory rig, without batch axes; its prior says how far cameras may have drifted.
        obj: N fiducials (mm) in their colours, taken as exact.
        prior_std: (C, K) standard deviation of each factory value; None = the rig's own prior.
        options: how to compare; `options.image` gives the sizes of images and dots.

    Shape:
        - prediction: (*B) rigs and poses.
        - images: (*B, C, 3, size, size) in [0, 1].
        - Output: `RefinedImages`, in the dtype of the prediction.

    Source: docs/method.md; analysis by synthesis.

    Example:
        >>> import imgcal, torch
        >>> from imgcal.nn import ProjectRig, RenderAndCompare, SplatRenderer
        >>> from imgcal.types import Prediction
        >>> rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
        >>> pose = imgcal.RigidTransform.identity(1, dtype=rig.focal_length.dtype)
        >>> pose.translation[0, 2] = rig.working_distance
        >>> seen = ProjectRig(obj)(rig.resized(torch.tensor([224, 224])), pose)
        >>> images = SplatRenderer(obj.colours, (224, 224))(seen).clamp(0, 1)
        >>> refined = RenderAndCompare(rig, obj)(Prediction(rig.expand(1), pose), images)
        >>> bool(refined.converged)
        True
    """

    prior_std: Tensor

    def __init__(
        self,
        factory: CameraRig,
        obj: CalibrationObject,
        prior_std: Tensor | None = None,
        options: ImageRefinementOptions = ImageRefinementOptions(),
    ) -> None:
        super().__init__()
        self.factory, self.obj = RigBuffers(factory), ObjectBuffers(obj)
        prior_std = (factory.prior or RigPrior()).std(factory) if prior_std is None else prior_std
        self.register_buffer("prior_std", prior_std.clone(), persistent=False)
        self._encoded = encode_image_options(options)

    def forward(self, prediction: Prediction, images: Tensor, factory: CameraRig | None = None) -> RefinedImages:
        """Refine (*B) predictions on images (*B, C, 3, size, size); `factory` replaces the module's own factory rig."""
        batch, dtype = images.shape[:-4], prediction.rig.focal_length.dtype
        count = batch.numel()
        factory = self.factory() if factory is None else factory
        guess = Prediction(prediction.rig.expand(*batch).reshape(count), prediction.rig_from_object.reshape(count))
        prior_std = self.prior_std.expand(count, *self.prior_std.shape[-2:])
        flat = images.reshape(count, *images.shape[-4:])
        rig, pose, converged = refine_images_anywhere(
            guess, flat, factory.expand(count), self.obj(), prior_std, self._encoded
        )
        found = replace(
            factory,
            focal_length=rig.focal_length,
            principal_point=rig.principal_point,
            distortion=rig.distortion,
            cam_from_rig=rig.cam_from_rig,
        )
        return RefinedImages(found.reshape(*batch).to(dtype), pose.reshape(*batch).to(dtype), converged.reshape(batch))
