"""Render-and-compare as an operator of PyTorch: see `imgcal.operators`."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from imgcal.estimation import (
    EstimationOptions,
    Solution,
    attach_gradient,
    equations_at,
    initial_state,
    make_loss,
    make_problem,
    pose_at,
    prepend_lenses,
    rig_at,
    split_lenses,
)
from imgcal.geometry import ModelNames, RigidTransform
from imgcal.operators import Operator, Tensors
from imgcal.refinement.photometric import ShiftPrior
from imgcal.refinement.render_and_compare import Dots, ImageProblem, ImageRefinementOptions, search
from imgcal.synthesis import ImageOptions
from imgcal.types import CalibrationObject, CameraRig, Observations, Prediction

RIG = ("focal_length", "principal_point", "distortion", "rotation", "translation")


def refine_images_anywhere(
    prediction: Prediction, images: Tensor, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor, options: str
) -> tuple[CameraRig, RigidTransform, Tensor]:
    """Do the work of `refine_images`, traceable by PyTorch; differentiable in the images and in the prior.

    Args:
        prediction: (B,) first guess; no gradient flows through it.
        images: (B, C, 3, size, size) in [0, 1].
        factory: (B,) the centre of the prior.
        obj: N fiducials in their colours, exact.
        prior_std: (B, C, K) standard deviation of each factory value.
        options: as `encode_image_options` returns them.

    Returns:
        (B,) rigs, poses, and whether each has converged; float64.
    """
    guess, pose = prediction.rig.to(torch.float64), prediction.rig_from_object.to(torch.float64)
    wide = factory.to(torch.float64)
    points = obj.points.to(torch.float64)
    radius = points.new_zeros(0) if obj.radius is None else obj.radius.to(points)
    *rig, rotation, translation, converged = OPERATOR(
        images,
        *_tensors(guess),
        pose.rotation,
        pose.translation,
        *_tensors(wide),
        factory.image_size,
        prior_std.to(torch.float64),
        points,
        obj.colours,
        radius,
        options=prepend_lenses(factory, options),
    )[:8]
    return _rig(rig, factory.image_size, factory.lens_model), RigidTransform(rotation, translation), converged


def encode_image_options(options: ImageRefinementOptions) -> str:
    """Encode options as `refine_images_anywhere` takes them."""
    return json.dumps(asdict(options))


def _decode(options: str) -> ImageRefinementOptions:
    values: dict[str, Any] = json.loads(options)
    values |= {name: tuple(values[name]) for name in ("blurs", "attempts")}
    for name, kind in (("image", ImageOptions), ("shift", ShiftPrior), ("estimation", EstimationOptions)):
        values[name] = kind(**values[name])
    return ImageRefinementOptions(**values)


def _compute(inputs: Tensors, options: str) -> Tensors:
    problem = _problem(inputs, options)
    lenses = problem.factory.lens_model
    guess = Prediction(_rig(inputs[1:6], inputs[13], lenses), RigidTransform(inputs[6], inputs[7]))
    result, dots = search(problem, guess, inputs[0])
    rig, pose = result.rig.resized(problem.factory.image_size), result.rig_from_object[:, 0]
    seen = (dots.uv, dots.sigma, dots.believed, dots.light, dots.colour)
    return (*_tensors(rig), pose.rotation, pose.translation, result.converged, *seen)


def _attach(inputs: Tensors, outputs: Tensors, options: str) -> Tensors:
    """Take one more step of the dots towards the images, and one of the rig towards the dots. Both are zero at the
    solution and attach the gradient.
    """
    problem, known = _problem(inputs, options), Dots(*outputs[8:])
    at_rest = problem.measure(inputs[0], known.uv, known.believed, known.colour, known.light, 1).uv
    uv = known.uv + torch.where(known.believed[..., None], at_rest - at_rest.detach(), 0.0)
    observations = Observations(uv.unsqueeze(1), known.sigma.unsqueeze(1), known.believed.unsqueeze(1))
    given = make_problem(observations, problem.rig, problem.obj, problem.image_spread)
    found = _rig(outputs[:5], inputs[13], problem.factory.lens_model).resized(problem.size)
    with torch.no_grad():
        state = initial_state(given, RigidTransform(outputs[5][:, None], outputs[6][:, None]), found)
    loss = make_loss(problem.options.estimation)
    attached = attach_gradient(given, Solution(state, equations_at(given, state, loss), outputs[7], 0), loss)
    rig, pose = rig_at(given, attached.offset).resized(problem.factory.image_size), pose_at(given, attached)[:, 0]
    return (*_tensors(rig), pose.rotation, pose.translation, *outputs[7:])


def _like(inputs: Tensors, options: str) -> Tensors:
    images, rotation, translation = inputs[0], inputs[6], inputs[7]
    count, fiducials = images.shape[:2], len(inputs[15])
    new = rotation.new_empty
    rig = tuple(new((*count, *x.shape[2:])) for x in inputs[8:13])
    flags = new((*count, fiducials), dtype=torch.bool), new(count, dtype=torch.float32)
    numbers = new((*count, fiducials), dtype=torch.int64)
    places = new((*count, fiducials, 2)), new((*count, fiducials))
    pose = torch.empty_like(rotation), torch.empty_like(translation)
    return (*rig, *pose, new(count[0], dtype=torch.bool), *places, *flags, numbers)


def _problem(inputs: Tensors, options: str) -> ImageProblem:
    lenses, options = split_lenses(options)
    image_size, prior_std, points, colours, radius = inputs[13:]
    obj = CalibrationObject(points, colours, radius=radius if len(radius) else None)
    return ImageProblem(_rig(inputs[8:13], image_size, lenses), obj, prior_std, _decode(options))


def _tensors(rig: CameraRig) -> Tensors:
    transform = rig.cam_from_rig
    return rig.focal_length, rig.principal_point, rig.distortion, transform.rotation, transform.translation


def _rig(tensors: tuple[Tensor, ...] | list[Tensor], image_size: Tensor, lenses: ModelNames) -> CameraRig:
    focal_length, principal_point, distortion, rotation, translation = tensors
    names = tuple(str(camera) for camera in range(len(image_size)))
    transform = RigidTransform(rotation, translation)
    return CameraRig(focal_length, principal_point, distortion, transform, image_size, names, lens_model=lenses)


_FACTORY = tuple(f"factory_{name}" for name in RIG)
_GUESS = (*(f"guess_{name}" for name in RIG), "pose_rotation", "pose_translation")
_FOUND = (*RIG, "object_rotation", "object_translation")
_DOTS = ("uv", "sigma", "believed", "light", "colour")

OPERATOR = Operator(
    name="refine_images",
    inputs=("images", *_GUESS, *_FACTORY, "image_size", "prior_std", "points", "colours", "radius"),
    outputs=(*_FOUND, "converged", *_DOTS),
    differentiable=frozenset(("images", *_FACTORY, "prior_std", *_FOUND)),
    batched=frozenset(("images", *_GUESS, *_FACTORY, "prior_std", *_FOUND, "converged", *_DOTS)),
    compute=_compute,
    attach=_attach,
    like=_like,
)
