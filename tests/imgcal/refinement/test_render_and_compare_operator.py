"""PyTorch's own checks of the operator; `imgcal.nn.RenderAndCompare` has tests of its results."""

from dataclasses import replace

import pytest
import torch

from imgcal.geometry import RigidTransform
from imgcal.io import read_rig
from imgcal.refinement import ImageRefinementOptions, encode_image_options, refine_images_anywhere
from imgcal.refinement import render_and_compare_operator as module
from imgcal.synthesis import ImageOptions
from imgcal.types import Prediction, RigPrior
from renderers import splat

OPTIONS = ImageRefinementOptions(image=ImageOptions(96, 1.5), attempts=("near",))


def test_options_are_written_and_read():
    assert module._decode(encode_image_options(OPTIONS)) == OPTIONS


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # opcheck itself asks its copies for it
def test_is_sound(asymmetric8, monkeypatch):
    rig = read_rig("T4").expand(1)
    pose = RigidTransform.identity(1, dtype=torch.float64)
    pose.translation[:, 2] = rig.working_distance
    uv = rig.resized(torch.tensor([96, 96])).project(pose.apply(asymmetric8.points)).uv
    images = splat(uv, asymmetric8.colours, 1.5, (96, 96)).clamp(0, 1).float()
    calls, operator = [], module.OPERATOR

    def spy(*inputs, options):
        calls.append((*inputs, options))
        return operator(*inputs, options=options)

    monkeypatch.setattr(module, "OPERATOR", spy)
    guess = Prediction(rig, replace(pose, translation=pose.translation + 1))
    prior_std = RigPrior().std(rig)
    given = (guess, images, rig, asymmetric8, prior_std, encode_image_options(OPTIONS))
    _, _, converged = refine_images_anywhere(*given)
    assert converged.all()
    named = zip(operator.inputs, calls[0][:-1], strict=True)
    inputs = [x.clone().requires_grad_(name in ("images", "prior_std")) for name, x in named]
    torch.library.opcheck(torch.ops.imgcal.refine_images.default, (*inputs, calls[0][-1]))
