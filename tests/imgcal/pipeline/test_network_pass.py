"""Many small markers: tiles of a pattern that continues beyond the object cannot locate the object."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import imgcal
from imgcal.association import Proposal, Snapshot
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform
from imgcal.networks import Evidence, InfraredNetwork, Queries
from imgcal.pipeline import LearnedProposer, learned_proposer, load_proposer
from imgcal.synthesis import Difficulty, FrameModel, Truth, simulate_shots
from imgcal.types import Detections
from renderers import BlobRange, ClutterModel
from tests.imgcal.pipeline.oracles import Blind, sure_of
from tests.imgcal.plates import plate, telephoto

RIG, OBJ = telephoto(), plate()
ORIGIN = RigidTransform.identity(dtype=torch.float64)
STEP = 50 / 3  # crop pixels from one column to the next
CLUTTER = ClutterModel(
    reflections=BlobRange(4, (6.0, 30.0), (2.0, 6.0), (0.5, 2.0)),
    blobs=BlobRange(1000, (0.6, 3.0), (1.0, 1.5), (0.1, 1.5)),
)


class Brightness(nn.Module):
    """Says of each crop how bright it is."""

    def forward(self, crops: Tensor) -> Tensor:
        return crops.abs().amax((2, 3), keepdim=True)


class Columns(InfraredNetwork):
    """Sees a marker where each fiducial was first expected; in crops with light the columns go on on either side."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Brightness()
        self.first: Queries | None = None

    def search(self, features: Tensor, queries: Queries, window: int | None = None) -> Evidence:
        self.first = queries if self.first is None else self.first
        size = window or self.config.window
        steps = 2.0 * torch.arange(size) - (size - 1)
        cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1) + queries.place[:, :, None, None]
        columns = torch.arange(-2, 3)[:, None, None] * torch.tensor([STEP, 0.0])
        markers = (self.first.place + columns[:, None]).movedim(0, 2)  # (T, n, 5, 2)
        endless = (features > 0)[..., 0] | (torch.arange(5) == 2)
        there = (self.first.asked[..., None] & endless).flatten(1)
        apart = markers.flatten(1, 2)[:, None, None, None] - cells[..., None, :]
        off = apart.abs().amax(-1).masked_fill(~there[:, None, None, None], torch.inf)
        nearest = off.argmin(-1)
        offset = apart.gather(-2, nearest[..., None, None].expand(*nearest.shape, 1, 2))[..., 0, :]
        near = off.amin(-1) <= 1
        return sure_of(near, offset, cells)


def snapshot(frames: dict[str, np.ndarray], *candidates: RigidTransform) -> Snapshot:
    none, zeros = np.zeros(0, np.int64), np.zeros(0)
    blobs = Detections(
        np.zeros((0, 2)), zeros, none, none, none, zeros, zeros.astype(np.uint8), RIG.camera_names, ("0",)
    )  # fmt: skip
    return Snapshot(frames, blobs, RIG, OBJ, RIG.prior.std(RIG), candidates)


@pytest.mark.parametrize(("lit", "cameras"), [("", [0, 1]), ("b", [0]), ("ab", [])])
def test_a_camera_in_which_steps_of_the_pattern_look_alike_is_left_out(
    lit: str, cameras: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learned_proposer, "TILES_AT_ONCE", 1000)
    rng = np.random.default_rng(0)
    dark, light = np.zeros((1024, 1280), np.uint8), rng.integers(0, 99, (1024, 1280)).astype(np.uint8)
    frames = {name: light if name in lit else dark for name in RIG.camera_names}
    proposal = LearnedProposer(Columns(), Blind()).propose(snapshot(frames, ORIGIN))
    rows = proposal.detections
    assert np.unique(rows.camera).tolist() == cameras
    if not cameras:
        assert "one step of its pattern" in proposal.reason
        return
    expected = RIG.project(OBJ.points).uv.numpy()[rows.camera, rows.fiducial]
    assert len(rows) == 90 * len(cameras)
    assert np.abs(rows.uv - expected).max() < 0.5
    # A column of six markers tells one step from none: in each camera no more than that is known.
    assert 15 * len(cameras) < proposal.margin < 19 * len(cameras)


@pytest.fixture(scope="module")
def hard() -> tuple[Truth, dict[str, np.ndarray], np.ndarray]:
    """Dim dots amid a thousand others, as seen by cameras that are ten pixels off, and which of them are to be seen."""
    draw = torch.Generator().manual_seed(3)
    step = torch.zeros(2, 15, dtype=torch.float64)
    step[:, 8:10] = torch.tensor([[9.0, -5.0], [-10.0, 3.0]])
    poses = RigidTransform.stack((ORIGIN,))
    rig = RIG.retract(step)
    truth = Truth(rig, poses, rig.project(OBJ.points).uv[None])
    model = FrameModel(difficulty=Difficulty(peak_snr=(3.0, 6.0), clutter=CLUTTER, hidden=0.1), marker_radius=0.45)
    shot = next(iter(simulate_shots(truth, OBJ, model, draw)))
    return truth, shot.frames, (shot.seen > 0.25).numpy()


def test_the_shipped_network_finds_many_small_markers(hard: tuple[Truth, dict[str, np.ndarray], np.ndarray]) -> None:
    truth, frames, seen = hard
    rows = load_proposer().propose(snapshot(frames, ORIGIN)).detections
    off = np.linalg.norm(rows.uv - truth.uv[0].numpy()[rows.camera, rows.fiducial], axis=1)
    assert (off < 3).sum() > 0.95 * seen.sum()
    assert (off >= 3).sum() < 0.02 * len(rows)


class Nowhere:
    """Finds nothing."""

    name = "finder"

    def propose(self, shown: Snapshot) -> Proposal:
        return Proposal.decline(shown, "no pose of the object stands out in the images")


def test_where_no_pose_is_known_many_small_markers_are_looked_for_at_the_origin(
    hard: tuple[Truth, dict[str, np.ndarray], np.ndarray],
) -> None:
    truth, frames, _ = hard
    asking = load_proposer(finder=Nowhere())
    result = imgcal.calibrate(frames, RIG, OBJ, detector=asking)
    uv = result.rig.expand(1).project(result.rig_from_object.apply(OBJ.points)).uv
    assert float((uv - truth.uv).square().mean().sqrt()) < 0.1
    empty = {name: np.full_like(frame, 20) for name, frame in frames.items()}
    with pytest.raises(RefusedError, match="no pose of the object stands out"):
        imgcal.calibrate(empty, RIG, OBJ, detector=asking)
    # Few markers are searched for everywhere: nothing else is asked where the finder finds nothing.
    few = replace(snapshot(frames), rig=imgcal.load_rig("T4"), obj=imgcal.load_object("cube8"))
    assert asking.propose(few).reason == "no pose of the object stands out in the images"
