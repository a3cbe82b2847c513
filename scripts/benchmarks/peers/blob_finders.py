"""Blob finders of other projects: a frame (H, W) uint8 in, centres (K, 2) px out.

Each is configured as its users would for bright discs of known radius and contrast; imgcal is given neither.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from imgcal.detection import DetectionOptions, detect_frame
from imgcal.types import UNUSABLE
from scripts.benchmarks.peer import peer

Frame = NDArray[np.uint8]
Centres = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """Properties of the discs that a finder is given."""

    radius: float  # px
    contrast: float  # grey levels above the background, clipped
    noise: float  # grey levels
    background: float  # grey level of most of the frame

    @property
    def sigma(self) -> float:
        """Standard deviation (px) of the Gaussian with the moments of a disc that is blurred by 0.75 px."""
        return float(np.hypot(self.radius / 2, 0.75))

    @property
    def half(self) -> int:
        """Half size (px) of a cutout that contains the disc, its blurred edge and little else."""
        return int(np.ceil(self.radius + 2.5))


Finder = Callable[[Frame, Known], Centres]


def imgcal(frame: Frame, known: Known) -> Centres:
    """imgcal with its defaults, without the blobs that it flags as unusable."""
    blobs = detect_frame(frame, DetectionOptions())
    return blobs.uv[(blobs.flags & int(UNUSABLE)) == 0]


def threshold_centroid(frame: Frame, known: Known) -> Centres:
    """Centres of the components above half of the contrast, with equal weight for all pixels."""
    level = known.background + known.contrast / 2
    _, _, stats, centres = cv2.connectedComponentsWithStats((frame > level).astype(np.uint8))
    area = stats[1:, cv2.CC_STAT_AREA]
    return centres[1:].astype(np.float64)[
        (area > 0.3 * np.pi * known.radius**2) & (area < 3 * np.pi * known.radius**2 + 10)
    ]


def simple_blob_detector(frame: Frame, known: Known) -> Centres:
    """cv2.SimpleBlobDetector: averages centres of contours at 16 thresholds; selects by area and inertia."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.blobColor = 255
    step = known.contrast / 20
    parameters.minThreshold = known.background + 3 * step
    parameters.maxThreshold, parameters.thresholdStep = known.background + 19 * step, step
    parameters.minArea, parameters.maxArea = 0.3 * np.pi * known.radius**2, 4 * np.pi * known.radius**2 + 10
    parameters.minDistBetweenBlobs = 2 * known.radius
    parameters.filterByCircularity = parameters.filterByConvexity = False
    parameters.filterByInertia, parameters.minInertiaRatio = True, 0.15
    points = cv2.SimpleBlobDetector.create(parameters).detect(frame)
    return np.array([point.pt for point in points], np.float64).reshape(-1, 2)


def blob_log(frame: Frame, known: Known) -> Centres:
    """skimage.feature.blob_log around the known radius: centres are whole pixels."""
    sigma = known.radius / np.sqrt(2)
    find = _module("skimage.feature").blob_log
    level = 0.3 * known.contrast / 255
    found = find(frame / 255.0, min_sigma=0.8 * sigma, max_sigma=1.3 * sigma, num_sigma=4, threshold=level)
    return np.asarray(found[:, 1::-1], np.float64)


def blob_dog(frame: Frame, known: Known) -> Centres:
    """skimage.feature.blob_dog around the known radius: centres are whole pixels."""
    sigma = known.radius / np.sqrt(2)
    find = _module("skimage.feature").blob_dog
    level = 0.08 * known.contrast / 255
    found = find(frame / 255.0, min_sigma=0.6 * sigma, max_sigma=1.6 * sigma, sigma_ratio=1.3, threshold=level)
    return np.asarray(found[:, 1::-1], np.float64)


def star_finder(frame: Frame, known: Known, name: str) -> Centres:
    """DAOStarFinder or IRAFStarFinder of photutils on the frame without its median, and their own centroids."""
    kind, fwhm = getattr(_module("photutils.detection"), name), 2.355 * known.sigma
    roundness = (-1.0, 1.0) if name == "DAOStarFinder" else (0.0, 0.5)
    find = kind(
        0.3 * known.contrast, fwhm, min_separation=2 * known.radius, sharpness_range=None, roundness_range=roundness
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rejected sources
        found = find(_without_median(frame))
    if found is None:
        return np.zeros((0, 2))
    return np.stack([found["x_centroid"], found["y_centroid"]], 1).astype(np.float64)


def star_centroid(frame: Frame, known: Known, name: str) -> Centres:
    """Find stars, centre the cutout by a centroid, and take the named centroid of photutils."""
    centroids, data = _module("photutils.centroids"), _without_median(frame)
    start = star_finder(frame, known, "DAOStarFinder")
    if not len(start):
        return start
    offsets = np.arange(-known.half, known.half + 1)
    disc = np.hypot(offsets[:, None], offsets) <= known.radius + 2
    given: dict[str, Any] = {"footprint": disc} if name == "centroid_com" else {"box_size": len(offsets)}
    source = partial(centroids.centroid_sources, footprint=disc, centroid_func=centroids.centroid_com)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # failed fits are NaN
        for _ in range(2):
            start = np.stack(source(data, *start[_inside(start, frame)].T), 1)
        start = start[_inside(start, frame)]
        if name == "centroid_quadratic":  # works on a flat top only after smoothing
            data = np.asarray(cv2.GaussianBlur(data, (0, 0), known.sigma), np.float64)
        found = np.stack(centroids.centroid_sources(data, *start.T, centroid_func=getattr(centroids, name), **given), 1)
    return found[np.isfinite(found).all(1)]


def trackpy_locate(frame: Frame, known: Known, bandpass: bool = True) -> Centres:
    """trackpy.locate, which moves a round mask until it is centred on the centroid.

    Without its bandpass filter, the median is subtracted instead.
    """
    found = _locate(frame, known, bandpass)
    return np.asarray(found[["x", "y"]], np.float64)


def trackpy_fit(frame: Frame, known: Known) -> Centres:
    """trackpy.refine_leastsq: Gaussians fitted to the features of trackpy.locate."""
    trackpy, found = _module("trackpy"), _locate(frame, known, True, characterize=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fitted = trackpy.refine_leastsq(found, frame, _diameter(known), fit_function="gauss")
    centres = np.asarray(fitted[["x", "y"]], np.float64)
    return centres[np.isfinite(centres).all(1)]


FINDERS: dict[str, Finder] = {
    "imgcal": imgcal,
    "cv2.SimpleBlobDetector": simple_blob_detector,
    "threshold centroid": threshold_centroid,
    "trackpy.locate": trackpy_locate,
    "trackpy.locate, no bandpass": partial(trackpy_locate, bandpass=False),
    "trackpy.refine_leastsq": trackpy_fit,
    "photutils centroid_2dg": partial(star_centroid, name="centroid_2dg"),
    "photutils centroid_com": partial(star_centroid, name="centroid_com"),
    "photutils centroid_quadratic": partial(star_centroid, name="centroid_quadratic"),
    "photutils DAOStarFinder": partial(star_finder, name="DAOStarFinder"),
    "photutils IRAFStarFinder": partial(star_finder, name="IRAFStarFinder"),
    "skimage blob_log": blob_log,
    "skimage blob_dog": blob_dog,
}
SLOW = ("trackpy.refine_leastsq",)  # seconds for a hundred blobs


def present(name: str) -> bool:
    """Tell whether the packages of a finder are installed."""
    package = name.split()[0].split(".")[0]
    return package in ("imgcal", "cv2", "threshold") or peer(package) is not None


def _module(name: str) -> Any:
    module = peer(name)
    if module is None:
        raise ModuleNotFoundError(name)
    if name == "trackpy":
        module.quiet()
    return module


def _without_median(frame: Frame) -> NDArray[np.float64]:
    return frame.astype(np.float64) - float(np.median(frame))


def _inside(centres: Centres, frame: Frame) -> NDArray[np.bool_]:
    """Tell which centres lie in the frame; photutils rejects others."""
    height, width = frame.shape
    inside = (centres > 0) & (centres < (width - 1, height - 1))
    return np.asarray(inside.all(1))


def _diameter(known: Known) -> int:
    """Odd diameter (px) of trackpy's mask: the disc and its blurred edge; the best choice for radii from 1.5 to 10."""
    return 2 * int(np.ceil(known.radius + 3)) + 1


def _locate(frame: Frame, known: Known, bandpass: bool, characterize: bool = False) -> Any:
    mass = 0.4 * known.contrast * np.pi * known.radius**2
    options: dict[str, Any] = {"minmass": mass, "characterize": characterize, "separation": 2 * known.radius + 1}
    if not bandpass:
        options |= {"preprocess": False, "threshold": 4 * known.noise}
        frame = np.clip(_without_median(frame), 0, 255).astype(np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # nothing found
        return _module("trackpy").locate(frame, _diameter(known), **options)
