"""Measuring blobs again, with a network whose answers are prescribed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.detection import DetectionOptions, detect, detect_frame
from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.networks import Measured, Measurer
from imgcal.pipeline import LearnedMeasurer, calibrate
from imgcal.types import BlobFlag, BlobKind
from renderers import SensorModel, Spots, Surface, infrared_frames

PLACES = np.array([[40.3, 50.6], [120.8, 52.1], [60.2, 130.4], [150.5, 140.9]])
RADII = np.array([3.0, 7.0, 11.0, 6.0])


class Told(Measurer):
    """Says the same of all patches, and notes them."""

    def __init__(self, offset: tuple[float, float], sigma: float, kind: BlobKind, sure: float = 9.0) -> None:
        super().__init__()
        self.offset, self.sigma, self.kind, self.sure = offset, sigma, kind, sure

    def forward(self, patches: torch.Tensor, radius: torch.Tensor) -> Measured:
        self.patches, self.radius = patches, radius
        count = len(patches)
        kind = torch.zeros(count, 4)
        kind[:, self.kind] = self.sure
        offset = torch.tensor(self.offset).expand(count, 2)
        return Measured(offset, torch.full((count,), self.sigma).log(), kind)


@pytest.fixture(scope="module")
def scene():
    one = torch.ones(1, 4)
    shape = torch.from_numpy(RADII**2).float()[:, None, None] * torch.eye(2)
    cut = torch.tensor([1.0, 0.0, torch.inf]).repeat(1, 4, 1, 1)
    cut[0, 2, 0, 2] = 0.0  # the third one is hidden to the right of its middle
    uv = torch.from_numpy(PLACES).float()[None]
    spots = Spots(uv, shape[None], one, one > 0, one, Surface(cut))
    frame = infrared_frames(spots, (180, 200), SensorModel(), generator=torch.Generator().manual_seed(0)).frames[0]
    return frame.numpy(), detect_frame(frame.numpy(), DetectionOptions())


def test_patches_hold_the_blobs_in_their_middle(scene):
    frame, blobs = scene
    network = Told((0.0, 0.0), 0.1, BlobKind.WHOLE)
    said = LearnedMeasurer(network).measure({"frame": frame}, blobs, DetectionOptions())
    # An offset of zero is the middle of the patch: within a pixel of the blob, at the patch's scale.
    scale = np.maximum(np.round(blobs.radius / 3.5), 1)
    assert (np.abs(said.uv - blobs.uv) <= 0.51 * scale[:, None]).all()
    np.testing.assert_allclose(network.radius.numpy(), blobs.radius / scale, rtol=1e-6)
    middle = network.patches[:, 11:13, 11:13].mean((1, 2))
    assert (middle > network.patches[:, :2].mean((1, 2)) + 0.5).all()


def test_offsets_are_in_pixels_of_the_frame(scene):
    frame, blobs = scene
    here = LearnedMeasurer(Told((0.0, 0.0), 0.1, BlobKind.PARTIAL)).measure({"a": frame}, blobs, DetectionOptions())
    there = LearnedMeasurer(Told((0.5, -0.2), 0.1, BlobKind.PARTIAL)).measure({"a": frame}, blobs, DetectionOptions())
    scale = np.maximum(np.round(blobs.radius / 3.5), 1)
    np.testing.assert_allclose(there.uv - here.uv, scale[:, None] * [0.5, -0.2], atol=1e-5)
    np.testing.assert_allclose(there.sigma, scale * np.hypot(0.1, 0.02), rtol=1e-5)


def test_whole_markers_keep_their_ellipse_and_partial_ones_do_not(scene):
    frame, blobs = scene
    whole = LearnedMeasurer(Told((0.3, 0.0), 0.1, BlobKind.WHOLE))({"a": frame}, blobs, DetectionOptions())
    assert np.array_equal(whole.uv, blobs.uv) and np.array_equal(whole.flags, blobs.flags)
    partial = LearnedMeasurer(Told((0.3, 0.0), 0.1, BlobKind.PARTIAL))({"a": frame}, blobs, DetectionOptions())
    assert (partial.uv != blobs.uv).any(axis=1).all()
    assert (partial.sigma > 0.1).all()
    unsure = LearnedMeasurer(Told((0.3, 0.0), 0.1, BlobKind.PARTIAL, -1.0))({"a": frame}, blobs, DetectionOptions())
    assert np.array_equal(unsure.uv, blobs.uv)


@pytest.mark.parametrize(("kind", "flag"), [(BlobKind.MERGED, BlobFlag.MERGED), (BlobKind.FALSE, BlobFlag.REFLECTION)])
def test_what_is_no_marker_alone_is_flagged(scene, kind, flag):
    frame, blobs = scene
    flagged = LearnedMeasurer(Told((0.0, 0.0), 0.1, kind))({"a": frame}, blobs, DetectionOptions())
    assert (flagged.flags & int(flag) != 0).all()
    assert np.array_equal(flagged.uv, blobs.uv)


def test_what_is_no_network_is_said_with_what_was_expected():
    with pytest.raises(
        InputError, match=r"^measurer: found 'nothing', expected measurer-cnn \(shipped\), or a network"
    ):
        LearnedMeasurer.load("nothing")


def test_no_blobs_no_question(scene):
    frame, blobs = scene
    none = blobs.select(np.zeros(len(blobs.uv), bool))
    assert len(LearnedMeasurer(Told((0.0, 0.0), 0.1, BlobKind.WHOLE))({"a": frame}, none, DetectionOptions()).uv) == 0


def test_dark_markers_are_shown_as_bright_ones(scene):
    frame, blobs = scene
    bright, dark = (Told((0.0, 0.0), 0.1, BlobKind.WHOLE) for _ in range(2))
    LearnedMeasurer(bright).measure({"a": frame}, blobs, DetectionOptions())
    LearnedMeasurer(dark).measure({"a": 255 - frame}, blobs, replace(DetectionOptions(), polarity="dark"))
    torch.testing.assert_close(dark.patches, bright.patches)


def test_calibration_takes_it(scene):
    frame, blobs = scene
    network = Told((0.3, 0.0), 0.1, BlobKind.PARTIAL)
    shots = {"a": [frame, None, frame], "b": [None, frame, None]}
    found = detect(shots, DetectionOptions())
    again = LearnedMeasurer(network).of_snapshots(
        lambda number: {name: frames[number] for name, frames in shots.items()}, found, DetectionOptions()
    )
    one = LearnedMeasurer(network)({"a": frame}, blobs, DetectionOptions())
    for snapshot in range(3):
        np.testing.assert_allclose(again.uv[again.snapshot == snapshot], one.uv)
    rig, obj = read_rig("T4"), load_object("asymmetric8")
    with pytest.raises(InputError, match="measurer measurer: found blobs without frames"):
        calibrate(found, rig, obj, measurer=LearnedMeasurer(network))


def half_hidden(count: int):
    """A frame of markers of which a quarter to a half is hidden, and their true centres."""
    generator = torch.Generator().manual_seed(3)
    steps = 40.0 * torch.arange(1, count + 1)
    uv = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(1, -1, 2)
    uv = uv + torch.rand(uv.shape, generator=generator)
    one, angle = torch.ones(1, count**2), 2 * torch.pi * torch.rand(1, count**2, generator=generator)
    kept = 10 * (0.6 * torch.rand(1, count**2, generator=generator) - 0.1)
    cuts = torch.stack([angle.cos(), angle.sin(), kept], dim=-1)[..., None, :]
    cuts[:, ::2, :, 2] = torch.inf  # every other one is whole
    spots = Spots(uv, 100.0 * torch.eye(2).expand(*uv.shape, 2), one, one > 0, one, Surface(cuts))
    side = 40 * (count + 1)
    return infrared_frames(spots, (side, side), SensorModel(), generator=generator).frames[0].numpy(), uv[0].numpy()


def test_the_shipped_one_halves_the_error_and_lives_on_its_encoder():
    frame, truth = half_hidden(9)
    blobs = detect_frame(frame, DetectionOptions())

    def error(uv: np.ndarray) -> float:
        away = np.linalg.norm(uv[:, None] - truth, axis=-1).min(1)
        return float(np.sqrt((away**2).mean()))

    measurer = LearnedMeasurer.load("measurer-cnn")
    again = measurer({"a": frame}, blobs, DetectionOptions())
    assert error(again.uv) < 0.5 * error(blobs.uv)
    moved = np.linalg.norm(again.uv - blobs.uv, axis=1) > 0
    assert 0.3 < moved.mean() < 0.7  # whole ones keep their ellipse
    turn = torch.Generator().manual_seed(0)
    measurer.network.encoder.register_forward_hook(lambda _, __, f: f[torch.randperm(len(f), generator=turn)])
    shuffled = measurer({"a": frame}, blobs, DetectionOptions())
    assert error(shuffled.uv) > 2 * error(again.uv)
