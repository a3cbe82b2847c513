"""Find a camera whose image is turned, mirrored or another camera's, once a calibration has failed.

The other cameras say where the markers are in its image. In a turned image they are there only after turning it back;
those of two exchanged cameras are in each other's places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Associations, image_error
from imgcal.errors import RefusedError
from imgcal.estimation import has_poses, initial_pose
from imgcal.pipeline.labelled_capture import LabelledCapture, arrange_labels
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

UPRIGHT = "as it is"
WAYS = {
    (False, False, False): UPRIGHT,
    (False, True, True): "turned by 180 degrees",
    (False, True, False): "mirrored left to right",
    (False, False, True): "mirrored top to bottom",
    (True, True, False): "turned clockwise by 90 degrees",
    (True, False, True): "turned counterclockwise by 90 degrees",
    (True, False, False): "mirrored about the main diagonal",
    (True, True, True): "mirrored about the other diagonal",
}
"""Exchange u and v, then reverse u, then reverse v: what these do to an image."""
REACH, WIDEST = 3.0, 0.08
"""Standard deviations of the prior within which a blob is at its place, and their limit as a share of the image."""
FINER = 0.25
"""The same once the image has been shifted as a whole, as a share."""
LEAST_PLACES = 8
"""Minimum number of markers that the others put into an image."""
LEAST_SHARE = 0.5
"""Minimum share of them with a blob once the image is turned ..."""
LARGEST_OTHER = 0.5
"""... and maximum ratio of the same for any other way, the image as it is included, to that."""
LEAST_LABELLED = 0.5
"""Minimum share of the snapshots in which the object was found: few may be mistaken."""
MOST_SNAPSHOTS = 60
"""Maximum number of snapshots to compare."""


@dataclass(frozen=True)
class ImageTurn:
    """A camera whose image fits the others in one way: as it is, or once it is turned or mirrored."""

    camera: str
    way: str  # of `WAYS`
    places: int  # markers that the other cameras put into its image
    found: int  # blobs there
    found_turned: int  # blobs there if the image is turned

    @property
    def upright(self) -> bool:
        """Whether it fits as it is."""
        return self.way == UPRIGHT

    def refusal(self) -> RefusedError:
        """Say so."""
        return RefusedError(
            f"camera {self.camera}: the other cameras put {self.places} fiducials into the image of {self.camera}, "
            f"found {self.found} there, and {self.found_turned} once the image is {self.way}",
            python="correct its frames, or leave the camera out of the rig (rig.select) and of the detections",
            command=f"correct its frames, or leave it out: --without {self.camera}",
        )


def require_matching_images(
    error: RefusedError, detections: Detections, labelled: Associations, rig: CameraRig, obj: CalibrationObject
) -> None:
    """Replace a refusal if its cause is a camera whose image is turned or mirrored, or two that are exchanged.

    Args:
        error: the refusal.
        detections: all blobs.
        labelled: the same with labels.
        rig: the factory calibration.
        obj: the calibration object.

    Raises:
        RefusedError: names the camera, or both.
    """
    try:
        arranged = arrange_labels(labelled, rig, obj)
    except RefusedError:  # no snapshot is left
        return
    if len(arranged.labelled.used) < LEAST_LABELLED * len(arranged.labelled.snapshots):
        return
    _require_matching(error, detections, rig, obj, arranged)
    if (detections.fiducial >= 0).any() and obj.pose_rank == 6 and not obj.parts:
        # Labels of a turned image fit, too: take the object's poses from the other cameras alone.
        for camera in range(rig.num_cameras):
            others = arranged.observations.seen.clone()
            others[:, camera] = False
            posed = has_poses(others.numpy(), obj.points)
            if posed.sum() >= LEAST_LABELLED * len(posed):
                rest = arranged.drop_snapshots(np.flatnonzero(~posed).tolist(), rig, obj)
                poses = initial_pose(replace(rest.observations, seen=others[torch.from_numpy(posed)]), rig, obj)
                _require_matching(error, detections, rig, obj, replace(rest, poses=poses))


def _require_matching(
    error: RefusedError, detections: Detections, rig: CameraRig, obj: CalibrationObject, arranged: LabelledCapture
) -> None:
    """Replace a refusal if a camera is turned or two are exchanged, by the object's poses in a labelled capture."""
    points = arranged.poses.apply(obj.points.to(rig.focal_length))
    predicted = rig.expand(len(points)).project_values(points, obj.radius)
    seen = predicted.visible.numpy() & arranged.labelled.columns(obj)
    moments = arranged.labelled.moments[arranged.labelled.used]
    uv = predicted.uv.numpy()
    places = [
        (moments[row], uv[row, camera, fiducial])
        for camera, (row, fiducial) in enumerate(map(np.nonzero, seen.swapaxes(0, 1)))
    ]
    images = [compare_turns(detections, rig, camera, *place) for camera, place in enumerate(places)]
    known = [image for image in images if image is not None]
    turned = [image for image in known if not image.upright]
    if turned and 2 * len(turned) <= len(known):  # otherwise, the places are wrong
        raise turned[0].refusal() from error
    for pair in combinations([camera for camera, image in enumerate(images) if image is None], 2):
        exchanged = replace(detections, camera=_exchange(detections.camera, *pair))
        fits = [compare_turns(exchanged, rig, camera, *places[camera]) for camera in pair]
        if all(image is not None and image.upright for image in fits):
            first, second = (rig.camera_names[camera] for camera in pair)
            raise RefusedError(
                f"cameras {first} and {second} seem to be exchanged: the blobs of each are where the rest of the "
                "rig puts the fiducials in the other's image",
                python="exchange their names in the detections or in the rig",
                command="exchange their names in the input or in the rig file",
            ) from error


def _exchange(cameras: NDArray[np.int64], first: int, second: int) -> NDArray[np.int64]:
    return np.where(cameras == first, second, np.where(cameras == second, first, cameras))


def compare_turns(
    detections: Detections, rig: CameraRig, camera: int, moments: NDArray[np.int64], uv: NDArray[np.float64]
) -> ImageTurn | None:
    """Compare the blobs of one camera, turned in all ways, with markers that the other cameras find.

    Args:
        detections: blobs of all cameras.
        rig: the factory calibration; its prior says how far off places may be.
        camera: its number.
        moments: (P,) snapshots of the markers.
        uv: (P, 2) px, their places in the image.

    Returns:
        How the image fits; None if no way fits, several do, or fewer than `LEAST_PLACES` markers are known.
    """
    size = rig.image_size[camera].double().numpy()
    spread = float(image_error(rig, (rig.prior or RigPrior()).std(rig))[camera])
    reach = min(REACH * spread, WIDEST * size.min())
    inside = ((uv > 0) & (uv < size - 1)).all(1)
    moments, uv = moments[inside], uv[inside]
    asked = np.unique(moments)
    asked = asked[np.linspace(0, len(asked) - 1, min(len(asked), MOST_SNAPSHOTS)).astype(int)]
    own = detections.select(detections.camera == camera)
    pairs = [(own.uv[own.snapshot == moment], uv[moments == moment]) for moment in asked.tolist()]
    pairs = [(blobs, expected) for blobs, expected in pairs if len(blobs)]
    places = sum(len(expected) for _, expected in pairs)
    if places < LEAST_PLACES:
        return None
    counts = np.array([_count_found(pairs, way, size - 1, reach) for way in WAYS])
    best = int(counts.argmax())
    if counts[best] < LEAST_SHARE * places:
        return None
    if np.delete(counts, best).max() > LARGEST_OTHER * counts[best]:
        return None
    return ImageTurn(rig.camera_names[camera], list(WAYS.values())[best], places, int(counts[0]), int(counts[best]))


def _count_found(
    pairs: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]],
    way: Sequence[bool],
    last: NDArray[np.float64],
    reach: float,
) -> int:
    """Count places with a blob, once the image is turned and shifted as a whole.

    Args:
        pairs: blobs (M, 2) and places (P, 2) of each snapshot, px.
        way: how the image is turned.
        last: (2,) px, the last pixel of the turned image.
        reach: px, the largest shift.
    """
    turned = [(turn(blobs, last, way), expected) for blobs, expected in pairs]
    shift = np.zeros(2)
    for largest in (reach, FINER * reach):
        offset = np.concatenate([_nearest_offset(blobs - shift, expected) for blobs, expected in turned])
        near = offset[np.linalg.norm(offset, axis=1) < largest]
        if len(near):
            shift = shift + np.median(near, axis=0)
    return len(near)


def _nearest_offset(blobs: NDArray[np.float64], expected: NDArray[np.float64]) -> NDArray[np.float64]:
    """Offset of the blob nearest to each place: (P, 2) px."""
    offset = blobs - expected[:, None]
    nearest = np.linalg.norm(offset, axis=-1).argmin(1)
    return np.asarray(offset[np.arange(len(expected)), nearest])


def undo(way: tuple[bool, bool, bool]) -> tuple[bool, bool, bool]:
    """Return the way that turns an image back."""
    swap, reverse_u, reverse_v = way
    return (swap, reverse_v, reverse_u) if swap else way


def turn(uv: NDArray[np.float64], last: NDArray[np.float64], way: Sequence[bool]) -> NDArray[np.float64]:
    """Turn an image: exchange u and v, then reverse u, then reverse v.

    Args:
        uv: (M, 2) px.
        last: (2,) px, the last pixel of the turned image.
        way: these three.
    """
    swap, *reverse = way
    exchanged = uv[:, ::-1] if swap else uv
    return np.where(reverse, last - exchanged, exchanged)
