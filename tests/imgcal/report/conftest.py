"""Contents of reports as the pipeline would fill them, and fixtures of the usual ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.estimation import EstimationOptions, Gauge, estimate, predicted_error
from imgcal.io import data_path, load_object, read_rig
from imgcal.report import ReportContent, SnapshotSummary
from imgcal.synthesis import PhysicalDrift, PoseRange, synthesize
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import PARAMETERS, CameraRig, Detections, Observations, RigPrior

SIGMA = 0.05


@pytest.fixture(scope="session")
def content() -> ReportContent:
    """A sound recalibration of ten cameras, with frames and clutter."""
    return calibrated()


@pytest.fixture(scope="session")
def refused_content(content: ReportContent) -> ReportContent:
    """The same images, refused."""
    return refused(content)


@pytest.fixture(scope="session")
def single_content() -> ReportContent:
    """One camera, without clutter."""
    return calibrated(3, cameras=1, clutter=0)


@pytest.fixture(scope="session")
def plain_content() -> ReportContent:
    """Detections alone, without frames."""
    return calibrated(4, frames=False)


@pytest.fixture(scope="session")
def large_content(content: ReportContent) -> ReportContent:
    """300 snapshots of 10 cameras and 400 fiducials."""
    return enlarged(content, 300, 400)


@pytest.fixture(scope="session")
def empty_content(refused_content: ReportContent) -> ReportContent:
    """Refused because nothing at all was found."""
    none = np.zeros(len(refused_content.labels), dtype=bool)
    return replace(
        refused_content, detections=refused_content.detections.select(none), labels=refused_content.labels[none],
        frames=(), snapshots=(), seconds={}, command="", versions={},
    )  # fmt: skip


def calibrated(
    snapshots: int = 6,
    *,
    cameras: int = 10,
    frames: bool = True,
    clutter: int = 3,
    object_name: str = "asymmetric8",
    seed: int = 1,
) -> ReportContent:
    """Recalibrate a drifted O10 from noisy detections with false blobs, and fill the content."""
    generator = torch.Generator().manual_seed(seed)
    factory = read_rig(data_path("rigs", "O10.yaml")).to(torch.float64)
    factory = factory.select(range(cameras))
    obj = load_object(data_path("objects", f"{object_name}.csv"))
    obj = replace(obj, points=obj.points.to(torch.float64))
    drift = PhysicalDrift(rotation_deg=0.4, position=3.0)
    truth = synthesize(factory, obj, 1, generator, drift=drift).rig[0]
    poses = sample_rig_from_object(
        snapshots, factory.working_distance or 850.0, obj.points.mean(0), PoseRange(phi_deg=(0.0, 52.0)), generator
    )
    image = truth.expand(snapshots).project(poses.apply(obj.points))
    uv = image.uv + SIGMA * torch.randn(image.uv.shape, generator=generator, dtype=torch.float64)
    seen = image.visible & (torch.rand(image.visible.shape, generator=generator) > 0.05)
    observations = Observations(uv, torch.full(seen.shape, SIGMA, dtype=torch.float64), seen)
    after = estimate(observations, factory, obj)
    fixed = torch.zeros(cameras, PARAMETERS, dtype=torch.float64)
    before = estimate(observations, factory, obj, prior_std=fixed, options=EstimationOptions(loss="squared"))
    detections, labels, cell = _detections(observations, factory, clutter, generator)
    gauge = Gauge.from_camera(0, 1) if cameras == 1 else Gauge.from_majority(after.rig, factory)
    real = labels >= 0

    def predicted(residual: torch.Tensor) -> np.ndarray:
        out = np.full((len(labels), 2), np.nan)
        out[real] = detections.uv[real] + residual.numpy()[cell[real, 0], cell[real, 1], cell[real, 2]]
        return out

    found = np.bincount(detections.snapshot, minlength=snapshots)
    used = np.bincount(detections.snapshot[real], minlength=snapshots)
    return ReportContent(
        title="O10, recalibrated from 6 snapshots",
        status="ok",
        reason="",
        identity="unique",
        factory=factory,
        detections=detections,
        labels=labels,
        snapshots=tuple(
            SnapshotSummary(n, int(f), int(u)) for n, f, u in zip(detections.snapshot_names, found, used, strict=True)
        ),
        recalibrated=after.rig,
        predicted_before=predicted(before.residual),
        predicted_after=predicted(after.residual),
        std=gauge.std(after).numpy(),
        prior_std=gauge.prior_std(factory, RigPrior().std(factory)).numpy(),
        gauge=gauge,
        predicted=predicted_error(after),
        object_points=obj.points.numpy(),
        rig_from_object=after.rig_from_object,
        frames=tuple(_frame(detections, c, factory) for c in range(cameras)) if frames else (),
        chi2_per_dof=float(after.chi2_per_dof),
        rms_before=float(before.rms),
        rms_after=float(after.rms),
        seconds={"read": 0.31, "detect": 0.142, "identify": 0.061, "estimate": 0.0042, "covariance": 0.0061},
        command="imgcal calibrate capture --rig O10.yaml --object asymmetric8.csv --out result",
        versions={"imgcal": "0.1.0", "python": "3.11.9", "torch": "2.13.0", "opencv": "5.0.0"},
    )


def refused(content: ReportContent) -> ReportContent:
    """Turn a content into that of a refused run on the same images."""
    rejected = "5 of 8 blobs a camera explained, at least 0.45 of the visible markers needed"
    return replace(
        content, title="O10, refused", status="refused", identity="refused", recalibrated=None,
        reason="identity: no labelling wins clearly: the best two explain 31 and 30 of 80 blobs.",
        labels=np.full_like(content.labels, -1), predicted_before=None, predicted_after=None, std=None, prior_std=None,
        rig_from_object=None, predicted=None, chi2_per_dof=float("nan"), rms_before=float("nan"),
        rms_after=float("nan"),
        snapshots=tuple(SnapshotSummary(s.name, s.found, 0, rejected) for s in content.snapshots),
    )  # fmt: skip


def enlarged(content: ReportContent, snapshots: int, fiducials: int) -> ReportContent:
    """Fake a capture of many blobs out of random numbers around the content's rig."""
    rng = np.random.default_rng(0)
    cameras = len(content.cameras)
    shape = (snapshots, cameras, fiducials)
    count = int(np.prod(shape))
    snapshot, camera, fiducial = (index.ravel() for index in np.indices(shape))
    uv = rng.uniform((0, 0), (2047, 1087), (count, 2))
    detections = Detections(
        uv, np.full(count, SIGMA), camera, snapshot, np.full(count, -1), np.full(count, 3.0), np.zeros(count, np.uint8),
        content.cameras, tuple(f"{i:05d}" for i in range(snapshots)),
    )  # fmt: skip
    poses = content.rig_from_object
    assert poses is not None
    repeat = torch.arange(snapshots) % len(poses.translation)
    return replace(
        content, detections=detections, labels=fiducial,
        predicted_before=uv + rng.normal(0, 5, uv.shape), predicted_after=uv + rng.normal(0, SIGMA, uv.shape),
        snapshots=tuple(SnapshotSummary(n, count // snapshots, count // snapshots) for n in detections.snapshot_names),
        object_points=rng.uniform(-80, 80, (fiducials, 3)), rig_from_object=poses[repeat],
    )  # fmt: skip


def _detections(
    observations: Observations, rig: CameraRig, clutter: int, generator: torch.Generator
) -> tuple[Detections, np.ndarray, np.ndarray]:
    """Blobs of all that is seen, and false ones; their labels, and (snapshot, camera, fiducial) of each."""
    snapshots, cameras, _ = observations.seen.shape
    cell = observations.seen.nonzero().numpy()
    uv = observations.uv[observations.seen].numpy()
    false = torch.rand((snapshots, cameras, clutter, 2), generator=generator).numpy()
    false = false * rig.image_size.numpy()[None, :, None]
    false_cell = np.stack(np.indices((snapshots, cameras, clutter)), -1).reshape(-1, 3)
    false_cell[:, 2] = -1
    cell = np.concatenate((cell, false_cell))
    uv = np.concatenate((uv, false.reshape(-1, 2)))
    order = np.lexsort((cell[:, 1], cell[:, 0]))
    cell, uv = cell[order], uv[order]
    count = len(uv)
    detections = Detections(
        uv, np.full(count, SIGMA), cell[:, 1], cell[:, 0], np.full(count, -1), np.full(count, 4.0),
        np.zeros(count, np.uint8), rig.camera_names, tuple(f"{i:04d}" for i in range(snapshots)),
    )  # fmt: skip
    return detections, cell[:, 2].copy(), cell


def _frame(detections: Detections, camera: int, rig: CameraRig) -> np.ndarray:
    """A dim frame with a bright spot at each blob of the first snapshot."""
    width, height = (int(x) for x in rig.image_size[camera])
    rows, columns = np.mgrid[0:height, 0:width]
    rng = np.random.default_rng(camera)
    grey = 14 + 6 * columns / width + rng.normal(0, 2, (height, width))
    for u, v in detections.uv[(detections.camera == camera) & (detections.snapshot == 0)]:
        top, left = max(int(v) - 9, 0), max(int(u) - 9, 0)
        window = np.s_[top : top + 19, left : left + 19]
        grey[window] += 170 * np.exp(-0.5 * ((columns[window] - u) ** 2 + (rows[window] - v) ** 2) / 2.6**2)
    return np.clip(grey, 0, 255).astype(np.uint8)
