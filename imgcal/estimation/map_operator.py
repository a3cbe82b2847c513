"""The minimization for the most probable state as an operator of PyTorch: see `imgcal.operators`."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import torch
from torch import Tensor

from imgcal.estimation.implicit import attach_gradient
from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem, State, rig_at
from imgcal.estimation.map_estimate import EstimationOptions, equations_at, initial_state, make_loss, minimize
from imgcal.estimation.pose_initialization import initial_pose
from imgcal.geometry import ModelNames, RigidTransform, lens_label
from imgcal.operators import Operator, Tensors
from imgcal.types import CalibrationObject, CameraRig, Observations

STATE = ("offset", "rotation", "centre", "object_offset")
FACTORY = ("focal_length", "principal_point", "distortion", "camera_rotation", "camera_translation")


def map_state(problem: Problem, start: State, options: str) -> tuple[State, Tensor]:
    """Find the most probable state of a problem, differentiable in all but the object and traceable by PyTorch.

    Args:
        problem: the problem, (B,).
        start: where to start; with (B, 0) poses, `initial_pose` computes them.
        options: as `encode_options` returns them.

    Returns:
        The state, and (B,) bool: whether it has converged.
    """
    empty, rig = problem.uv.new_zeros(len(problem.uv), 0), problem.factory
    *state, converged = OPERATOR(
        problem.uv,
        problem.root_weight,
        problem.points,
        problem.centroid,
        problem.points.new_zeros(0) if problem.radius_squared is None else problem.radius_squared,
        rig.focal_length,
        rig.principal_point,
        rig.distortion,
        rig.cam_from_rig.rotation,
        rig.cam_from_rig.translation,
        rig.image_size,
        problem.prior_std,
        empty if problem.object_prior_std is None else problem.object_prior_std,
        start.offset,
        start.rotation,
        start.centre,
        empty if start.object_offset is None else start.object_offset,
        options=prepend_lenses(rig, options),
    )
    return _state(*state), converged


def encode_options(options: EstimationOptions) -> str:
    """Encode options as `map_state` takes them."""
    return json.dumps(asdict(options))


def prepend_lenses(rig: CameraRig, options: str) -> str:
    """Prepend a rig's lens models, which no tensor holds, to an operator's options."""
    return f"{','.join(rig.lens_models)}|{options}"


def split_lenses(options: str) -> tuple[ModelNames, str]:
    """Invert `prepend_lenses`."""
    names, _, rest = options.partition("|")
    return lens_label(names.split(",")), rest


def _compute(inputs: Tensors, options: str) -> Tensors:
    lenses, options = split_lenses(options)
    problem, start = _problem(lenses, *inputs[:-4]), _state(*inputs[-4:])
    how = EstimationOptions(**json.loads(options))
    if not start.rotation.shape[1]:
        obj = CalibrationObject(problem.points + problem.centroid, problem.points, radius=_radius(problem))
        seen = problem.root_weight > 0
        observations = Observations(problem.uv.mT, 1 / problem.root_weight.where(seen, 1.0), seen)
        guess = rig_at(problem, start.offset)
        own = start.object_offset
        start = replace(initial_state(problem, initial_pose(observations, guess, obj), guess), object_offset=own)
    solution = minimize(problem, start, how)
    found = solution.state
    own = problem.uv.new_zeros(len(problem.uv), 0) if found.object_offset is None else found.object_offset
    return found.offset, found.rotation, found.centre, own, solution.converged


def _attach(inputs: Tensors, outputs: Tensors, options: str) -> Tensors:
    *state, converged = outputs
    lenses, options = split_lenses(options)
    problem, found = _problem(lenses, *inputs[:-4]), _state(*state)
    loss = make_loss(EstimationOptions(**json.loads(options)))
    constant = _problem(lenses, *(tensor.detach() for tensor in inputs[:-4]))
    attached = attach_gradient(problem, Solution(found, equations_at(constant, found, loss), converged, 0), loss)
    own = state[-1] if attached.object_offset is None else attached.object_offset
    return attached.offset, attached.rotation, attached.centre, own, converged


def _like(inputs: Tensors, options: str) -> Tensors:
    uv, prior_std, object_prior_std = inputs[0], inputs[11], inputs[12]
    batch, snapshots = uv.shape[:2]
    poses = uv.new_empty(batch, snapshots, 3, 3), uv.new_empty(batch, snapshots, 3)
    offsets = uv.new_empty(prior_std.shape), uv.new_empty(object_prior_std.shape)
    return offsets[0], *poses, offsets[1], uv.new_empty(batch, dtype=torch.bool)


def _problem(
    lenses: ModelNames, uv: Tensor, root_weight: Tensor, points: Tensor, centroid: Tensor, radius_squared: Tensor,
    focal_length: Tensor, principal_point: Tensor, distortion: Tensor, rotation: Tensor, translation: Tensor,
    image_size: Tensor, prior_std: Tensor, object_prior_std: Tensor,
) -> Problem:  # fmt: skip
    transform = RigidTransform(rotation, translation)
    names = tuple(str(camera) for camera in range(len(image_size)))
    factory = CameraRig(focal_length, principal_point, distortion, transform, image_size, names, lens_model=lenses)
    return Problem(
        uv=uv,
        root_weight=root_weight,
        points=points,
        centroid=centroid,
        radius_squared=radius_squared if len(radius_squared) else None,
        factory=factory,
        prior_std=prior_std,
        object_prior_std=object_prior_std if object_prior_std.shape[1] else None,
    )


def _state(offset: Tensor, rotation: Tensor, centre: Tensor, object_offset: Tensor) -> State:
    return State(offset, rotation, centre, object_offset if object_offset.shape[1] else None)


def _radius(problem: Problem) -> Tensor | None:
    return None if problem.radius_squared is None else problem.radius_squared.sqrt()


_OBSERVED, _OBJECT = ("uv", "root_weight"), ("points", "centroid", "radius_squared")
_PRIOR = ("prior_std", "object_prior_std")
_START = ("start_offset", "start_rotation", "start_centre", "start_object_offset")

OPERATOR = Operator(
    name="map_state",
    inputs=(*_OBSERVED, *_OBJECT, *FACTORY, "image_size", *_PRIOR, *_START),
    outputs=(*STATE, "converged"),
    differentiable=frozenset((*_OBSERVED, *FACTORY, *_PRIOR, *STATE)),
    batched=frozenset((*_OBSERVED, *FACTORY, *_PRIOR, *_START, *STATE, "converged")),
    compute=_compute,
    attach=_attach,
    like=_like,
)
