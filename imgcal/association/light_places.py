"""Where lights are in one snapshot of a rig that is known: places on which three cameras or more agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imgcal.association.blobs import gather
from imgcal.association.light_search import find_lights
from imgcal.types import CameraRig, Detections

MOST_PLACES = 128
"""Of a snapshot; a room full of people in suits shows fewer to one rig at once."""
LEAST_ODDS, LEAST_MARGIN = 5.0, 5.0
"""Log odds of a place against false blobs, and against the best other place that takes one of its blobs."""


@dataclass(frozen=True)
class LightPlaces:
    """Lights of a snapshot, those that most surely are some first."""

    label: NDArray[np.int64]  # (M,) number of the light that a blob shows, -1 = of none
    points: NDArray[np.float64]  # (L, 3) mm in the rig's frame
    straight: NDArray[np.float64]  # (M, 2) px, blobs as a camera without distortion sees them; nan where not usable


def find_places(blobs: Detections, rig: CameraRig, error: NDArray[np.float64]) -> LightPlaces:
    """Find the places where three cameras or more agree on a light, and no other place is as likely for its blobs.

    Args:
        blobs: of one snapshot.
        rig: as it is known.
        error: (C,) px, one standard deviation of what blobs and rig may be off.

    Raises:
        InputError: see `gather`.
    """
    padded = gather(blobs, rig)
    camera, column = np.nonzero(padded.row >= 0)
    row, focal = padded.row[camera, column], rig.focal_length.mean(-1).numpy()
    xy = padded.ideal[camera, column].astype(np.float64)
    label = np.full(len(blobs), -1, dtype=np.int64)
    straight = np.full((len(blobs), 2), np.nan)
    straight[row] = xy
    start = np.concatenate(([0], np.cumsum(padded.count)))
    cameras = rig.num_cameras
    chosen, points = np.full((MOST_PLACES, cameras), -1), np.empty((MOST_PLACES, 3))
    odds, margin = np.empty(MOST_PLACES), np.empty(MOST_PLACES)
    half = 0.5 * rig.image_size.numpy() / rig.focal_length.numpy()
    place = rig.cam_from_rig.rotation.contiguous().numpy(), np.ascontiguousarray(rig.positions.numpy())
    count = find_lights(
        xy / focal[camera, None], start, *place, error / focal, half, LEAST_ODDS, chosen, points, odds, margin
    )
    sure = (margin[:count] >= LEAST_MARGIN) & ((chosen[:count] >= 0).sum(1) >= 3)
    chosen, points = chosen[:count][sure], points[:count][sure].copy()
    order = np.argsort(-(chosen >= 0).sum(1), kind="stable")
    chosen, points = chosen[order], points[order]
    light, seen_by = np.nonzero(chosen >= 0)
    label[row[chosen[light, seen_by]]] = light
    return LightPlaces(label, points, straight)
