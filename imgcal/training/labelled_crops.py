"""Training data from a calibrated capture: the rig and the object's poses predict every marker in every frame.

A snapshot's pose comes from all cameras together, so frames in which detection failed get labels, too. A network then
learns your own markers, lamps, lenses and walls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from imgcal.association import (
    Associations,
    PipelineOptions,
    Progress,
    Sight,
    accepted_observations,
    associate,
    fit_snapshot_poses,
    refuse_unfit,
)
from imgcal.detection import DetectionOptions, Frame
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.matching import measure_markers
from imgcal.messages import plural
from imgcal.networks import Expectation, Tiles, cut_crops, cut_patches
from imgcal.training.frame_dataset import FrameDataset, PatchDataset
from imgcal.training.marker_appearance import fit_to_light, usual_look
from imgcal.types import CROP_SIZE, CalibrationObject, CameraRig, Detections, Observations

COPIES = 3
"""Crops per place, each with another corner and another scale."""
TURN_DEG, ASIDE = 1.5, 0.01
"""Standard deviations of the poses that crops are placed by: degrees, and parts of the distance to the object."""
BESIDE = 3.0
"""Patch pixels, each way, within which markers are beside the middle of their patches."""
BRIGHT_PIXEL = 559
"""Rank of a pixel among the 576 of a patch, in ascending order, that is as bright as its marker; ignores glints."""
LARGEST_PATCH_SIGMA = 1.0
"""Pixels: where a projection is known less well, it says nothing of a marker's exact place."""
LEAST_SEEN = 3
"""Markers that a crop must show."""
BRIGHTEST = 3
"""Crop pixels, each way, within which a marker is brightest."""
LARGEST_SIGMA = 1.0
"""Crop pixels: largest standard deviation of a projection that serves as a label."""
FARTHEST = 4.0
"""Standard deviations (plus 1.5 pixels) from its projection beyond which a measured marker is another one."""
HELD_OUT = 5
"""Number of stretches of snapshots in a row of which one is held out."""
LEAST_SNAPSHOTS = 5
"""Smallest number of snapshots that can be split; with fewer, cameras are held out."""


def cut_labelled(
    frames: Callable[[int], Mapping[str, Frame | None]],
    detections: Detections,
    rig: CameraRig,
    obj: CalibrationObject,
    options: PipelineOptions = PipelineOptions(),
    *,
    detection: DetectionOptions = DetectionOptions(),
    sight: Sight | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[FrameDataset, PatchDataset]:
    """Cut labelled crops, and patches of their markers, from the frames of a calibrated rig.

    Args:
        frames: maps the index of a snapshot to its frames: camera name -> (H, W).
        detections: blobs of all snapshots, cameras as in the rig.
        rig: the calibrated rig, which stays fixed.
        obj: the object.
        options: requirements on the labels that determine poses.
        detection: options with which blobs were found.
        sight: looks at frames whose blobs are inconclusive; None = such snapshots give no crops.
        seed: for the placement of crops.
        progress: wraps the loops over snapshots.

    Returns:
        Crops and patches of all snapshots that can be decided; `split` holds some of each out.

    Raises:
        RefusedError: no snapshot can be decided, or no pose fits most of them.
    """
    rig, options = rig.as_constant(), options.of_object(obj)
    labelled = associate(detections, rig, obj, options, progress, sight)
    used, observations, poses = fit_poses(labelled, rig, obj, options)
    observations, poses = fit_to_light(frames, used, rig, obj, (observations, poses), detection, options.estimation)
    generator = torch.Generator().manual_seed(seed)
    numbers: Iterable[int] = range(len(used))
    parts, patches, look = [], [], usual_look(frames, used, rig, obj, poses, detection)
    for row in progress(numbers, len(used)) if progress else numbers:
        snapshot = used[row]
        shown, pose = frames(snapshot), poses[row : row + 1]
        seen, sigma = find_visible(shown, rig, obj, pose, observations.of_snapshots([row]), detection)
        if look is not None:
            seen |= look.shows(shown, rig, Expectation.of(rig, obj, pose), detection)
        usable = seen & (sigma < LARGEST_PATCH_SIGMA)
        around = Expectation.of(rig, obj, pose)
        for _ in range(COPIES):
            own = _cut_patches(shown, rig, around, usable, detection, generator)
            patches.append(replace(own, snapshot=torch.full_like(own.snapshot, snapshot)))
            part = _cut(shown, rig, obj, pose, seen, sigma, detection, generator)
            parts.append(replace(part, snapshot=torch.full_like(part.snapshot, snapshot)))
    return FrameDataset.cat(parts), PatchDataset.cat(patches)


def fit_poses(
    labelled: Associations, rig: CameraRig, obj: CalibrationObject, options: PipelineOptions
) -> tuple[Sequence[int], Observations, RigidTransform]:
    """Fit the object's pose in every conclusive snapshot, with a fixed rig; snapshots that no pose fits are left out.

    Returns:
        Numbers of the S snapshots, observations (S, C, N) and poses (S,).

    Raises:
        RefusedError: no pose fits most of them.
    """
    observations, start = accepted_observations(labelled, rig, obj)
    poses, fits = fit_snapshot_poses(observations, rig, obj, start, options.estimation)
    used = refuse_unfit(labelled, fits, "harvest").used
    return used, observations.of_snapshots(fits), poses[fits]


def find_visible(
    frames: Mapping[str, Frame | None],
    rig: CameraRig,
    obj: CalibrationObject,
    pose: RigidTransform,
    labels: Observations,
    detection: DetectionOptions,
) -> tuple[Tensor, Tensor]:
    """Find which projected fiducials a frame shows, and the accuracy of each projection.

    Args:
        frames: of the snapshot.
        rig: the calibrated rig.
        obj: the object.
        pose: (1,) of the object.
        labels: (1, C, N) the identified fiducials.
        detection: options with which blobs were found.

    Returns:
        Whether a marker is visible (C, N), and the standard deviation (C, 1) in pixels: the RMS distance of the
        camera's labels from the projections; for a camera without labels, that of all cameras.
    """
    expected = Expectation.of(rig, obj, pose)
    uv, known = expected.uv[0], labels.seen[0]
    squared = (labels.uv[0] - uv).square().mean(-1)
    count = known.sum(1, keepdim=True)
    usual = (squared[known].mean() if bool(known.any()) else uv.new_tensor(1.0)).sqrt()
    own = (torch.where(known, squared, 0.0).sum(1, keepdim=True) / count.clamp(min=1)).sqrt()
    sigma = torch.where(count > 0, own, usual)
    seen = known & (squared.sqrt() < 1.5 + FARTHEST * usual)
    for camera, name in enumerate(rig.camera_names):
        frame, visible = frames.get(name), expected.visible[0, camera]
        if frame is None or not bool(visible.any()):
            seen[camera] = False
            continue
        radius = expected.radius[0, camera].clamp(0.5, 64).numpy()
        found = measure_markers(
            frame, uv[camera].numpy(), radius, detection.polarity == "dark", (known[camera] & visible).numpy()
        )
        apart = np.linalg.norm(found.uv - uv[camera].numpy(), axis=1)
        near = apart < 1.5 + FARTHEST * (found.sigma + float(usual))
        seen[camera] |= torch.from_numpy(found.seen & np.nan_to_num(near).astype(bool))
    return seen & expected.visible[0], sigma


def find_shown(
    frames: Mapping[str, Frame | None],
    rig: CameraRig,
    obj: CalibrationObject,
    pose: RigidTransform,
    labels: Observations,
    detection: DetectionOptions,
) -> Tensor:
    """Tell which markers the frames of a snapshot show, whatever their shape: (C, N) bool; see `find_visible`."""
    seen, _ = find_visible(frames, rig, obj, pose, labels, detection)
    look = usual_look(lambda _: frames, (0,), rig, obj, pose, detection)
    return seen if look is None else seen | look.shows(frames, rig, Expectation.of(rig, obj, pose), detection)


def _cut_patches(
    frames: Mapping[str, Frame | None],
    rig: CameraRig,
    expected: Expectation,
    usable: Tensor,
    detection: DetectionOptions,
    generator: torch.Generator,
) -> PatchDataset:
    """Cut patches of the usable (C, N) of the expected fiducials, each as if it were expected somewhere beside."""
    uv, radius = expected.uv[0], expected.radius[0].clamp(0.5, 64)
    _, usual = cut_patches({}, rig.camera_names, uv, radius)
    aside = (2 * torch.rand(uv.shape, generator=generator, dtype=uv.dtype) - 1) * BESIDE * usual.scale[..., None]
    patches, placement = cut_patches(
        frames, rig.camera_names, uv + aside, radius, inverted=detection.polarity == "dark"
    )  # fmt: skip
    light, place = patches[usable], placement.to_crop(uv[..., None, :])[..., 0, :][usable]
    ground = light.flatten(1).nanmedian(1).values.nan_to_num()[:, None, None]
    light = (light - ground).nan_to_num()
    level = light.flatten(1).kthvalue(BRIGHT_PIXEL, 1).values[:, None, None]
    kept = (level > 0).flatten()
    camera = torch.arange(rig.num_cameras)[:, None].expand_as(usable)[usable]
    reduced = (radius / placement.scale)[usable]
    middle = (placement.size - 1) / 2
    return PatchDataset(
        (light / level.clamp(min=1e-9)).clamp(-100, 100).half()[kept], reduced.float()[kept],
        (place - middle).float()[kept], camera[kept], torch.zeros(int(kept.sum()), dtype=torch.int64),
    )  # fmt: skip


Part = TypeVar("Part", FrameDataset, PatchDataset)


def split(crops: Part, snapshots: int, cameras: int) -> tuple[Part, Part]:
    """Hold out stretches of snapshots, with a gap of at least one on both sides of each; of few snapshots, cameras.

    Raises:
        RefusedError: one of the two would be empty.
    """
    if snapshots >= LEAST_SNAPSHOTS:
        stretch = max(snapshots // (2 * HELD_OUT), 1)
        number = crops.snapshot // stretch
        held_out = number % HELD_OUT == HELD_OUT - 1
        gap = max(stretch // 10, 1)
        within = crops.snapshot % stretch
        # Snapshots next to a held-out stretch belong to neither.
        beside = ((number % HELD_OUT == HELD_OUT - 2) & (within >= stretch - gap)) | (
            (number % HELD_OUT == 0) & (number > 0) & (within < gap)
        )
        train = ~held_out & ~beside
    else:
        held_out = crops.camera >= cameras - max(cameras // 3, 1)
        train = ~held_out
    if not bool(train.any() and held_out.any()):
        raise RefusedError(
            f"harvest: {crops.NOUN}: found {int(train.sum()):,} for training and {int(held_out.sum()):,} held out in "
            f"{plural(snapshots, 'snapshot')} of {plural(cameras, 'camera')}, expected some of both: "
            "capture more snapshots"
        )
    return crops.select(train), crops.select(held_out)


def _cut(
    frames: Mapping[str, Frame | None],
    rig: CameraRig,
    obj: CalibrationObject,
    pose: RigidTransform,
    seen: Tensor,
    sigma: Tensor,
    detection: DetectionOptions,
    generator: torch.Generator,
) -> FrameDataset:
    """Cut the crops of a snapshot, placed with a pose near the true one."""
    turn = np.deg2rad(TURN_DEG) * torch.randn(1, 3, generator=generator, dtype=torch.float64)
    far = (rig.positions - pose.translation).norm(dim=-1).mean()
    aside = ASIDE * far * torch.randn(1, 3, generator=generator, dtype=torch.float64)
    near = RigidTransform(rotation_from_vector(turn) @ pose.rotation, pose.translation + aside)
    tiles = Tiles.of_object(rig, obj, near, CROP_SIZE)
    queries = tiles.arrange_expected(Expectation.of(rig, obj, pose, tiles.usual)).queries(tiles.placement)
    names = tuple(rig.camera_names[camera] for camera in tiles.camera.tolist())
    light = cut_crops(frames, names, tiles.placement, inverted=detection.polarity == "dark")
    shown = seen[tiles.camera[:, None], tiles.fiducial] & queries.asked
    blur = (sigma[tiles.camera] / tiles.placement.scale[:, None]).float().expand_as(queries.radius)
    light, usable = _normalize_light(light, queries.place, shown)
    kept = (usable & (blur[:, 0] < LARGEST_SIGMA)).nonzero()[:, 0]
    nowhere = torch.zeros(len(kept), dtype=torch.int64)
    return FrameDataset(
        light[kept].half(), queries.place[kept], blur[kept], queries.radius[kept], queries.depth[kept],
        queries.asked[kept], shown[kept], tiles.camera[kept], nowhere,
    )  # fmt: skip


def _normalize_light(light: Tensor, place: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
    """Normalize brightness (T, S, S) by background and median marker; also return which crops have enough markers."""
    size = light.shape[-1]
    ground = light.flatten(1).nanmedian(1).values.nan_to_num()
    where = place.round().clamp(0, size - 1).long()
    # The brightest place of a marker need not be its middle: a ring has none there.
    brightest = functional.max_pool2d(light.nan_to_num(-torch.inf)[:, None], 2 * BRIGHTEST + 1, 1, BRIGHTEST)[:, 0]
    peak = brightest.flatten(1).gather(1, where[..., 1] * size + where[..., 0]) - ground[:, None]
    level = peak.masked_fill(~shown, torch.nan).nanmedian(1).values.nan_to_num()
    usable = (shown.sum(1) >= LEAST_SEEN) & (level > 0)
    scale = torch.where(usable, level, 1.0)
    return ((light - ground[:, None, None]) / scale[:, None, None]).clamp(-100, 100), usable
