"""The proposer with networks that know the truth: its use of their evidence."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

import imgcal
from imgcal.association import PipelineOptions, Proposal, Snapshot
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import data_path
from imgcal.networks import Evidence, Expectation, InfraredNetwork, Measured, Measurer, Queries
from imgcal.pipeline import LearnedMeasurer, LearnedProposer, load_proposer
from imgcal.pipeline.learned_proposer import leads_at_border
from imgcal.synthesis import DIFFICULTIES, FrameModel, PhysicalDrift, Truth, simulate_frames, simulate_truth
from imgcal.types import Detections, RigPrior
from tests.imgcal.pipeline.oracles import Blind, sure_of

RIG, OBJ = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")


class Knowing(InfraredNetwork):
    """Sees the fiducials in their true places, if they are in their windows, and nothing elsewhere."""

    def __init__(self, place: Tensor, seen: Tensor) -> None:
        super().__init__()
        self.place, self.seen = place, seen  # (C, N, 2) crop pixels, (C, N)

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        size, count = window or self.config.window, len(queries.place) // len(self.place)
        steps = 2.0 * torch.arange(size) - (size - 1)
        cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1) + queries.place[:, :, None, None]
        place, seen = self.place.repeat(count, 1, 1), self.seen.repeat(count, 1)
        offset = place[:, :, None, None] - cells
        near = (offset.abs() <= 1).all(-1) & seen[..., None, None]
        return sure_of(near, offset, cells)


@dataclass(frozen=True)
class Scene:
    truth: Truth
    snapshot: Snapshot
    place: Tensor  # (C, N, 2) crop pixels, of the crops that the proposer cuts


def scene(degrees: float = 1.0, seed: int = 0) -> Scene:
    draw = torch.Generator().manual_seed(seed)
    truth = simulate_truth(RIG, OBJ, 1, draw, PhysicalDrift())
    axis = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=torch.float64), dim=0)
    turn, pose, centre = rotation_from_vector(axis * np.deg2rad(degrees)), truth.rig_from_object[0], OBJ.points.mean(0)
    rotation = turn @ pose.rotation
    candidate = RigidTransform(rotation, pose.rotation @ centre + pose.translation - rotation @ centre)
    names = RIG.camera_names
    frames = {name: np.zeros((1088, 2048), np.uint8) for name in names}
    none, zeros = np.zeros(0, np.int64), np.zeros(0)
    blobs = Detections(
        np.zeros((0, 2)), zeros, none, none, none, zeros, zeros.astype(np.uint8), names, ("00000",)
    )  # fmt: skip
    snapshot = Snapshot(frames, blobs, RIG, OBJ, RigPrior().std(RIG), (candidate,))
    poses = RigidTransform(candidate.rotation[None], candidate.translation[None])
    placement = Expectation.of(RIG, OBJ, poses).placement(RIG, 96)
    return Scene(truth, snapshot, placement.to_crop(truth.uv[0]).float())


def proposer(place: Tensor, seen: Tensor) -> LearnedProposer:
    torch.manual_seed(0)
    return LearnedProposer(Knowing(place, seen), Blind())


@pytest.mark.parametrize("degrees", [1.0, 12.0])
def test_what_the_network_sees_is_proposed(degrees: float) -> None:
    made = scene(degrees)
    seen = torch.ones(made.place.shape[:-1], dtype=torch.bool)
    seen[1, 2] = seen[3, :4] = False
    proposal = proposer(made.place, seen).propose(made.snapshot)
    assert not proposal.reason
    rows = proposal.detections
    expected = made.truth.uv[0].numpy()[rows.camera, rows.fiducial]
    assert np.abs(rows.uv - expected).max() < 0.1
    assert len(rows) == int(seen.sum())
    assert proposal.margin > 20
    assert proposal.rig_from_object is not None
    turned = proposal.rig_from_object.rotation.mT @ made.truth.rig_from_object.rotation[0]
    assert float(torch.rad2deg(torch.acos((turned.trace() - 1) / 2))) < 1.5


def test_claims_that_fit_no_rig_are_dropped() -> None:
    made = scene(seed=1)
    place = made.place.clone()
    place[0, 3] += 9.0  # some 60 pixels beside where rig and pose have it
    seen = torch.ones(place.shape[:-1], dtype=torch.bool)
    rows = proposer(place, seen).propose(made.snapshot).detections
    assert not ((rows.camera == 0) & (rows.fiducial == 3)).any()
    assert len(rows) == int(seen.sum()) - 1


def test_it_declines_where_nothing_is_seen_and_where_nobody_knows_where_to_look() -> None:
    made = scene()
    nothing = torch.zeros(made.place.shape[:-1], dtype=torch.bool)
    proposal = proposer(made.place, nothing).propose(made.snapshot)
    assert proposal.reason
    assert len(proposal.detections) == 0
    lost = replace(made.snapshot, candidates=())
    assert "no pose" in proposer(made.place, ~nothing).propose(lost).reason


@dataclass(frozen=True)
class InVain:
    """Finds nothing."""

    name: str = "finder"

    def propose(self, snapshot: Snapshot) -> Proposal:
        return Proposal.decline(snapshot, "no pose of the object stands out in the images")


def test_it_says_what_the_finder_says_where_that_finds_nothing() -> None:
    made = scene()
    seen = torch.ones(made.place.shape[:-1], dtype=torch.bool)
    asking = replace(proposer(made.place, seen), finder=InVain())
    declined = asking.propose(replace(made.snapshot, candidates=()))
    assert declined.reason == "no pose of the object stands out in the images"


@dataclass(frozen=True)
class Finder:
    """Knows a pose."""

    pose: RigidTransform
    name: str = "finder"

    def propose(self, snapshot: Snapshot) -> Proposal:
        return replace(Proposal.decline(snapshot, "says where, not what"), rig_from_object=self.pose)


@pytest.mark.parametrize("known", [True, False])
def test_a_finder_is_asked_where_the_known_pose_shows_nothing(known: bool) -> None:
    made = scene(2.0)
    (near,) = made.snapshot.candidates
    turn = rotation_from_vector(torch.tensor([1.2, -1.5, 0.6], dtype=torch.float64))
    away = RigidTransform(turn @ near.rotation, near.translation)
    snapshot = replace(made.snapshot, candidates=(away,) if known else ())
    alone = proposer(made.place, torch.ones(made.place.shape[:-1], dtype=torch.bool))
    assert len(alone.propose(snapshot).detections) < 11
    found = replace(alone, finder=Finder(near)).propose(snapshot)
    expected = made.truth.uv[0].numpy()[found.detections.camera, found.detections.fiducial]
    assert len(found.detections) == 32
    assert np.abs(found.detections.uv - expected).max() < 0.1


class Guessing(Knowing):
    """Also claims, vaguely, every fiducial that it does not see: in the middle of its window."""

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        found = super().search(features, queries, window)
        offset = queries.place[:, :, None, None] - found.cells
        guessed = (offset.abs() <= 1).all(-1) & (found.present < 0)[..., None, None]
        vague = sure_of(guessed, offset, found.cells)
        return Evidence(
            found.logits + vague.logits, torch.where(guessed[..., None], offset, found.offset),
            torch.where(guessed, 0.0, found.log_sigma), found.present.maximum(vague.present), found.cells,
        )  # fmt: skip


def test_vague_claims_at_a_wrong_pose_do_not_count_against_the_finder() -> None:
    made = scene(2.0)
    (near,) = made.snapshot.candidates
    turn = rotation_from_vector(torch.tensor([1.2, -1.5, 0.6], dtype=torch.float64))
    away = replace(made.snapshot, candidates=(RigidTransform(turn @ near.rotation, near.translation),))
    guessing = Guessing(made.place, torch.ones(made.place.shape[:-1], dtype=torch.bool))
    alone = LearnedProposer(guessing, Blind())
    found = replace(alone, finder=Finder(near)).propose(away).detections
    expected = made.truth.uv[0].numpy()[found.camera, found.fiducial]
    assert len(found) == 32
    assert np.abs(found.uv - expected).max() < 0.1


def test_vague_claims_alone_are_no_proposal() -> None:
    made = scene()
    nothing = torch.zeros(made.place.shape[:-1], dtype=torch.bool)
    proposal = LearnedProposer(Guessing(made.place, nothing), Blind()).propose(made.snapshot)
    assert proposal.reason == "found hardly any fiducials that agree with one pose"


@pytest.fixture(scope="module")
def dim() -> tuple[Truth, Snapshot]:
    """A snapshot in low light, of a rig whose pose is believed to be turned by eight degrees."""
    made, draw = scene(8.0, seed=2), torch.Generator().manual_seed(5)
    frames = next(iter(simulate_frames(made.truth, OBJ, FrameModel(difficulty=DIFFICULTIES["low-light"]), draw)))
    return made.truth, replace(made.snapshot, frames=frames)


def right_share(proposal: Proposal, truth: Truth) -> float:
    rows = proposal.detections
    off = np.linalg.norm(rows.uv - truth.uv[0].numpy()[rows.camera, rows.fiducial], axis=1)
    return float((off < 8).sum()) / truth.uv[0][..., 0].numel()


def test_the_shipped_network_finds_fiducials_and_lives_on_its_encoder(dim: tuple[Truth, Snapshot]) -> None:
    truth, snapshot = dim
    whole = load_proposer()
    found = whole.propose(snapshot)
    assert right_share(found, truth) > 0.9
    assert len(found.detections) * 0.95 <= right_share(found, truth) * truth.uv[0][..., 0].numel()
    encoder = whole.network.encoder
    handle = encoder.register_forward_hook(lambda module, given, features: features.roll(1, 0))
    assert right_share(whole.propose(snapshot), truth) < 0.2
    handle.remove()
    encoder.register_forward_hook(lambda module, given, features: torch.zeros_like(features))
    assert right_share(whole.propose(snapshot), truth) < 0.2


def test_calibrate_takes_it_by_name_and_by_file(dim: tuple[Truth, Snapshot]) -> None:
    truth, snapshot = dim
    options = PipelineOptions(start_pose=snapshot.candidates[0])
    by_name = imgcal.calibrate(snapshot.frames, RIG, OBJ, options, detector="learned")
    path = str(data_path("models", "ir-cnn.safetensors"))
    by_file = imgcal.calibrate(snapshot.frames, RIG, OBJ, options, detector=path)
    assert torch.equal(by_name.rig.focal_length, by_file.rig.focal_length)
    uv = by_name.rig.expand(1).project(by_name.rig_from_object.apply(OBJ.points)).uv
    assert float((uv - truth.uv).square().mean().sqrt()) < 1.0
    with pytest.raises(InputError, match=r"lerned.*nearest: learned"):
        imgcal.calibrate(snapshot.frames, RIG, OBJ, options, detector="lerned")


class Vague(Measurer):
    """Says that each marker is in the middle of its patch, or anywhere."""

    def forward(self, patches: Tensor, radius: Tensor) -> Measured:
        kind = torch.tensor([9.0, 0.0, 0.0, 0.0]).expand(len(patches), 4)
        return Measured(torch.zeros(len(patches), 2), torch.full((len(patches),), 3.0), kind)


def test_what_the_measurer_does_not_know_well_is_fitted(dim: tuple[Truth, Snapshot]) -> None:
    _, snapshot = dim
    fitted = load_proposer(measurer=None)
    alone = fitted.propose(snapshot).detections
    both = replace(fitted, measurer=Vague()).propose(snapshot).detections
    assert len(both) >= 0.9 * len(alone)
    assert np.median(both.sigma) < 1.2 * np.median(alone.sigma) < 2


def test_a_measurer_is_told_to_calibrate_by_name(dim: tuple[Truth, Snapshot]) -> None:
    truth, snapshot = dim
    options = PipelineOptions(start_pose=snapshot.candidates[0])
    given = LearnedMeasurer.load("measurer-cnn")
    read = imgcal.calibrate(snapshot.frames, RIG, OBJ, options, detector="learned", measurer=given)
    other = LearnedMeasurer(Vague())
    fitted = imgcal.calibrate(snapshot.frames, RIG, OBJ, options, detector="learned", measurer=other)
    assert not torch.equal(fitted.rig.focal_length, read.rig.focal_length)
    uv = read.rig.expand(1).project(read.rig_from_object.apply(OBJ.points)).uv
    assert float((uv - truth.uv).square().mean().sqrt()) < 1.5


def test_steps_of_a_lattice_differ_at_its_border() -> None:
    column, row = torch.meshgrid(torch.arange(6.0), torch.arange(5.0), indexing="ij")
    lattice = 20 * torch.stack((column, row), -1).flatten(0, 1)
    beside = lattice + torch.tensor([21.0, 0.5])  # a step, not quite: lens and perspective
    places = torch.stack((lattice, beside))[:, None]
    probability = torch.full((2, 1, 30), 0.7)
    probability[1] = 0.9  # where both expect dots, the network likes the wrong step more ...
    probability[0, 0, :5], probability[1, 0, -5:] = 0.9, 0.2  # ... but beyond the border there is nothing
    assert probability[1].sum() > probability[0].sum()
    leads = leads_at_border(places, probability, torch.ones(1, 30, dtype=torch.bool))
    assert leads[0, 1].tolist() == pytest.approx([5 * (0.9 - 0.2)])
    torch.testing.assert_close(leads, -leads.transpose(0, 1))
    none = leads_at_border(places, probability, torch.zeros(1, 30, dtype=torch.bool))
    assert not none.any()
