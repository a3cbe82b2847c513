"""One camera that sees four fiducials: clear labellings are accepted, and no wrong label is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import relocalize
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.types import CalibrationObject, Detections, RigPrior

FLAT = np.array([[0.0, 0, 0], [220, 30, 0], [180, 190, 0], [-40, 140, 0]])
SKEW = np.array([[0.0, 0, 0], [240, 0, 0], [90, 130, 0], [-60, 60, 0]])
KNOWN = RigPrior(focal_length=0.003, principal_point=2.0, distortion=0.005, rotation=0.001, position=1.0)


def four(points=FLAT):
    return CalibrationObject(torch.from_numpy(points), torch.ones(len(points), 3, dtype=torch.float64))


def seen_by_one(o10, obj, prior, seed, extra=0):
    """A factory camera, what the drifted one sees of the object at some pose, in random order, and the labels."""
    random, generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    rig = replace(o10.select([0]), prior=prior)
    drift = torch.randn(1, 15, generator=generator, dtype=torch.float64)
    true = rig.retract(drift * prior.std(rig))
    while True:
        turn = rotation_from_vector(torch.from_numpy(random.normal(0, 0.35, 3)))
        if random.random() < 0.5:  # seen from behind: lamps shine both ways
            turn = turn @ rotation_from_vector(torch.tensor([np.pi, 0, 0], dtype=torch.float64))
        centre = torch.from_numpy(random.uniform((-150, -80, 700), (150, 80, 1500)))
        shown = true.project(RigidTransform(turn, centre - turn @ obj.points.mean(0)).apply(obj.points))
        if bool(shown.visible.all()):
            break
    truth = np.append(np.arange(obj.num_fiducials), np.full(extra, -1))
    uv = np.concatenate((shown.uv[0].numpy(), random.uniform((0, 0), (2048, 1088), (extra, 2))))
    uv += 0.1 * random.standard_normal(uv.shape)
    order, count = random.permutation(len(uv)), len(uv)
    blobs = Detections(
        uv[order], np.full(count, 0.32), np.zeros(count, np.int64), np.zeros(count, np.int64), np.full(count, -1),
        np.full(count, np.nan), np.zeros(count, np.uint8), rig.camera_names, ("0",),
    )  # fmt: skip
    return rig, blobs, truth[order]


def test_four_fiducials_in_a_plane_are_told_by_one_camera_that_is_well_known(o10):
    accepted = 0
    for seed in range(20):
        rig, blobs, truth = seen_by_one(o10, four(), KNOWN, seed)
        found = relocalize(blobs, rig, four(), KNOWN.std(rig))
        assert not (found.labels[found.labels >= 0] != truth[found.labels >= 0]).any()
        accepted += found.accepted
        if found.accepted:
            assert found.status == "unique" and (found.labels == truth).all()
            assert "next best labelling" in found.reason
    assert accepted >= 15


@pytest.mark.parametrize("extra", [0, 1])
def test_what_a_wide_prior_leaves_open_is_refused_in_words(extra, o10):
    reasons, wrong, accepted = [], 0, 0
    for seed in range(12):
        rig, blobs, truth = seen_by_one(o10, four(), RigPrior(), seed, extra)
        found = relocalize(blobs, rig, four(), RigPrior().std(rig))
        wrong += int((found.labels[found.labels >= 0] != truth[found.labels >= 0]).sum())
        accepted += found.accepted
        reasons += [] if found.accepted else [found.reason]
    assert wrong == 0 and accepted < 12
    assert all("show more" in reason and "0 %" not in reason for reason in reasons)


@pytest.mark.parametrize(("extra", "least"), [(0, 28), (1, 22)])
def test_four_fiducials_are_told_by_one_camera_with_the_usual_prior(extra, least, o10):
    """Drift is drawn from the prior: what is wide open stays refused, most is not."""
    accepted, obj = 0, four(SKEW)
    for seed in range(30):
        rig, blobs, truth = seen_by_one(o10, obj, RigPrior(), seed, extra)
        found = relocalize(blobs, rig, obj, RigPrior().std(rig))
        accepted += found.accepted
        assert not found.accepted or (found.status == "unique" and (found.labels == truth).all())
    assert accepted >= least


def test_four_blobs_of_something_else_are_refused(o10):
    rig, blobs, _ = seen_by_one(o10, four(), KNOWN, 0)
    accepted = 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        other = replace(blobs, uv=random.uniform((700, 300), (1300, 800), (4, 2)))
        accepted += relocalize(other, rig, four(), KNOWN.std(rig)).accepted
    assert accepted == 0


def test_a_square_is_ambiguous_to_one_camera(o10):
    square = four(100.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))
    rig, blobs, truth = seen_by_one(o10, square, KNOWN, 1)
    found = relocalize(blobs, rig, square, KNOWN.std(rig))
    assert (found.status, found.alternatives) == ("ambiguous", len(square.symmetries))
    assert any((motion.permutation[truth] == found.labels).all() for motion in square.symmetries)
