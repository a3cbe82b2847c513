"""`MapEstimate`: the most probable rig as a layer."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor, nn

from imgcal.estimation import (
    EstimationOptions,
    Problem,
    State,
    encode_options,
    initial_state,
    make_loss,
    make_problem,
    map_cost,
    map_state,
    object_prior_std,
    points_at,
    pose_at,
    rig_at,
)
from imgcal.geometry import RigidTransform, pose_rank
from imgcal.nn.buffers import ObjectBuffers, RigBuffers
from imgcal.nn.pytrees import register
from imgcal.types import CalibrationObject, CameraRig, Observations, RigPrior, check_rig


@dataclass(frozen=True)
class MapSolution:
    """The most probable rig and poses of the object. Gradients flow through all but `dof` and `converged`."""

    rig: CameraRig  # (*B)
    rig_from_object: RigidTransform  # (*B, S)
    points_object: Tensor  # (*B, N, 3) mm, the fiducials as estimated; as given where the object is exact
    chi2: Tensor  # (*B) sum of squared whitened residuals (robust), data and prior
    dof: Tensor  # (*B) expected chi2
    converged: Tensor  # (*B) bool: check it; a rig that has not converged is returned in its last state


register(MapSolution)


class MapEstimate(nn.Module):
    """Estimate the rig and the object's poses that best explain labelled fiducials and the factory calibration.

    Gradients follow from the solution by the implicit function theorem, independent of the iterations. They flow to the
    pixels and their sigmas, the factory rig and its prior. The module is one opaque operator in a compiled or
    exported graph, with forward and reverse derivatives, also under `torch.func.vmap`, but no second ones.

    Args:
        factory: the factory rig, (*B) or without batch axes; its prior says how far cameras may have drifted.
        obj: N fiducials (mm); where it has tolerances, its shape is estimated too.
        prior_std: (*B, C, K) standard deviation of each factory value in the order of `CameraRig.parameter_names`; zero
            keeps a value fixed; None = the rig's own prior.
        options: how to minimize.

    Raises:
        InputError: a rig or a prior with implausible values, or shapes that do not fit together.

    Shape:
        - observations: uv (*B, S, C, N, 2) pixels, sigma (*B, S, C, N) pixels, seen (*B, S, C, N).
        - factory, prior_std: replace the module's own; None = the module's.
        - rig_from_object: (*B, S) initial poses; None = computed from the observations.
        - initial_rig: (*B) initial rigs; None = the factory rig.
        - Output: `MapSolution`.

    Source: docs/method.md; implicit differentiation as in Gould et al., "Deep Declarative Networks" (PAMI 2022).

    Example:
        >>> import imgcal, torch
        >>> from imgcal.nn import MapEstimate
        >>> rig, obj = imgcal.load_rig("O10"), imgcal.load_object("asymmetric8")
        >>> pose = imgcal.RigidTransform.identity(1, dtype=rig.focal_length.dtype)
        >>> pose.translation[0, 2] = rig.working_distance
        >>> uv = rig.project(pose.apply(obj.points)).uv.requires_grad_()
        >>> sigma, seen = torch.full_like(uv[..., 0], 0.1), torch.ones_like(uv[..., 0], dtype=torch.bool)
        >>> solution = MapEstimate(rig, obj)(imgcal.Observations(uv, sigma.detach(), seen))
        >>> bool(solution.converged)
        True
        >>> solution.rig.focal_length.sum().backward()
        >>> uv.grad.shape
        torch.Size([1, 10, 8, 2])
    """

    prior_std: Tensor
    object_prior_std: Tensor | None

    def __init__(
        self,
        factory: CameraRig,
        obj: CalibrationObject,
        prior_std: Tensor | None = None,
        options: EstimationOptions = EstimationOptions(),
    ) -> None:
        super().__init__()
        check_rig(factory, any_batch=True)
        self.factory, self.obj = RigBuffers(factory), ObjectBuffers(obj)
        prior_std = (factory.prior or RigPrior()).std(factory) if prior_std is None else prior_std
        self.register_buffer("prior_std", prior_std.clone(), persistent=False)
        self.register_buffer("object_prior_std", None if obj.exact else object_prior_std(obj), persistent=False)
        self.options, self._encoded = options, encode_options(options)
        self._pose_rank = pose_rank(obj.points)

    def forward(
        self,
        observations: Observations,
        factory: CameraRig | None = None,
        prior_std: Tensor | None = None,
        rig_from_object: RigidTransform | None = None,
        initial_rig: CameraRig | None = None,
    ) -> MapSolution:
        """Estimate (*B) rigs and (*B, S) poses; arguments as under Shape."""
        factory = self.factory() if factory is None else factory
        problem = self._problem(observations, factory, self.prior_std if prior_std is None else prior_std)
        state, converged = map_state(problem, self._start(problem, rig_from_object, initial_rig), self._encoded)
        return self._solution(problem, state, converged, observations.seen)

    def _problem(self, observations: Observations, factory: CameraRig, prior_std: Tensor) -> Problem:
        problem = make_problem(observations, factory, self.obj(), prior_std)
        if self.object_prior_std is None:
            return problem
        return replace(problem, object_prior_std=self.object_prior_std.to(problem.uv).expand(len(problem.uv), -1))

    def _start(self, problem: Problem, rig_from_object: RigidTransform | None, initial_rig: CameraRig | None) -> State:
        if rig_from_object is None:  # no poses: the operator computes them
            new, count = problem.uv.new_zeros, len(problem.uv)
            poses = RigidTransform(new(count, 0, 3, 3), new(count, 0, 3))
            return initial_state(replace(problem, uv=problem.uv[:, :0]), poses, initial_rig)
        return initial_state(problem, rig_from_object, initial_rig)

    def _solution(self, problem: Problem, state: State, converged: Tensor, seen: Tensor) -> MapSolution:
        batch = seen.shape[:-3]
        cost = map_cost(problem, state, make_loss(self.options))
        dof = 2 * seen.flatten(-3).sum(-1) - self._pose_rank * seen.shape[-3]
        points = points_at(problem, state) + problem.centroid
        return MapSolution(
            rig=rig_at(problem, state.offset).reshape(*batch),
            rig_from_object=pose_at(problem, state).reshape(*batch, seen.shape[-3]),
            points_object=points.reshape(*batch, *points.shape[1:]),
            chi2=(2 * cost).reshape(batch),
            dof=dof,
            converged=converged.reshape(batch),
        )
