import numpy as np
import torch

from imgcal.association.blobs import gather
from imgcal.association.innovation import innovations
from imgcal.estimation.levenberg_marquardt import Solution
from imgcal.estimation.linearization import Problem, State, linearize
from imgcal.io import load_object, load_rig
from imgcal.io.resources import data_path
from imgcal.synthesis.rigs import synthesize
from imgcal.types.observations import Detections
from imgcal.types.rig import RigPrior


def test_covariance_of_an_unlabelled_fiducial_matches_the_dense_one() -> None:
    rig = load_rig(data_path("rigs", "T4.yaml")).select([0, 2])
    obj = load_object(data_path("objects", "asymmetric8.csv"))
    made = synthesize(rig, obj, 1, torch.Generator().manual_seed(0), drift=None)
    uv, pose = made.projection.uv[0], made.rig_from_object[0]
    points, centroid = obj.points - obj.points.mean(0), obj.points.mean(0)
    seen = torch.ones(1, 1, 2, 8, dtype=torch.float64)
    seen[..., 0, 3] = 0
    spread = RigPrior().std(rig)[None]
    problem = Problem(uv.mT[None, None].contiguous(), seen / 0.5, points, centroid, None, rig.expand(1), spread)
    centre = (pose.rotation @ centroid + pose.translation)[None, None]
    state = State(torch.zeros(1, 2, 15, dtype=torch.float64), pose.rotation[None, None], centre)
    squared = lambda d2: (d2, torch.ones_like(d2))  # noqa: E731
    equations = linearize(problem, state, squared)
    solution = Solution(state, equations, torch.ones(1, dtype=torch.bool), 1)

    count = 16
    camera = np.repeat([0, 1], 8)
    flags = np.zeros(count, dtype=np.uint8)
    nothing = np.full(count, -1)
    blobs = gather(
        Detections(
            uv.reshape(-1, 2).numpy(), np.full(count, 0.3), camera, np.zeros(count, dtype=np.int64), nothing,
            np.full(count, np.nan), flags, rig.camera_names, ("0",),
        ),
        rig,
    )  # fmt: skip
    labels = np.tile(np.arange(8), (1, 2, 1))
    labels[0, 0, 3] = -1
    found = innovations(blobs, labels, np.array([0.4]), problem, solution)

    # Dense: the posterior covariance is the inverse of the whole arrow; the Jacobian of the missing fiducial comes from
    # its own normal equations, J^T J = products, which for one point have rank two.
    information = torch.zeros(36, 36, dtype=torch.float64)
    for c in range(2):
        part = slice(15 * c, 15 * c + 15)
        information[part, part] = equations.camera[0, c]
        information[part, 30:] = equations.coupling[0, 0, c]
        information[30:, part] = equations.coupling[0, 0, c].mT
    information[30:, 30:] = equations.pose[0, 0]
    covariance = torch.linalg.inv(information)

    def pixel(parameters: torch.Tensor) -> torch.Tensor:
        from imgcal.estimation.linearization import moved, pose_at, rig_at

        new = moved(problem, state, parameters[:30].view(1, 2, 15), parameters[30:].view(1, 1, 6))
        return rig_at(problem, new.offset)[0].project(pose_at(problem, new)[0, 0].apply(obj.points)).uv[0, 3]

    jacobian = torch.autograd.functional.jacobian(pixel, torch.zeros(36, dtype=torch.float64))
    expected = jacobian @ covariance @ jacobian.mT + 0.25 * torch.eye(2)
    np.testing.assert_allclose(found.log_det[0, 0, 3], torch.logdet(expected).item(), atol=1e-3)
    np.testing.assert_allclose(found.uv, made.projection.uv.numpy(), atol=1e-6)
    assert np.nanmax(found.own[np.isfinite(found.own)]) < 1e-6
