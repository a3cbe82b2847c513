"""Measure the detector beside common ones: recall, false blobs, accuracy, and frames in memory -> blobs in time.

Run from the repository root: python scripts/benchmarks/bench_detection.py [--out FILE]
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import skimage
from numpy.typing import NDArray
from skimage.feature import blob_log

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from imgcal.detection import DetectionOptions, detect_frame, detect_snapshot
from tests.imgcal.detection.discs import draw_discs, exposed, nearest, scattered

Detector = Callable[[NDArray[np.uint8], float], NDArray[np.float64]]  # frame, radius -> centres (K, 2)


def ours(frame: NDArray[np.uint8], radius: float) -> NDArray[np.float64]:
    """imgcal with its defaults: it is not told the radius."""
    return detect_frame(frame, DetectionOptions()).uv


def simple_blob_detector(frame: NDArray[np.uint8], radius: float) -> NDArray[np.float64]:
    """cv2.SimpleBlobDetector, tuned to bright blobs of the known radius."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.blobColor = 255
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 40, 220, 10
    parameters.minArea, parameters.maxArea = 0.3 * np.pi * radius**2, 5 * np.pi * radius**2
    parameters.minDistBetweenBlobs = 3
    parameters.filterByCircularity = parameters.filterByConvexity = parameters.filterByInertia = False
    points = cv2.SimpleBlobDetector.create(parameters).detect(frame)
    return np.array([point.pt for point in points], np.float64).reshape(-1, 2)


def laplacian_of_gaussian(frame: NDArray[np.uint8], radius: float) -> NDArray[np.float64]:
    """skimage.feature.blob_log around the known radius."""
    sigma = radius / np.sqrt(2)
    found = blob_log(frame / 255.0, min_sigma=0.8 * sigma, max_sigma=1.3 * sigma, num_sigma=4, threshold=0.15)
    return found[:, 1::-1]


def threshold_centroid(frame: NDArray[np.uint8], radius: float) -> NDArray[np.float64]:
    """Centres of the components above half of the contrast, all pixels counting the same."""
    return cv2.connectedComponentsWithStats((frame > 120).astype(np.uint8))[3][1:]


DETECTORS: dict[str, Detector] = {
    "imgcal": ours,
    "cv2.SimpleBlobDetector, tuned": simple_blob_detector,
    "skimage.feature.blob_log": laplacian_of_gaussian,
    "threshold centroid": threshold_centroid,
}


def accuracy(frames: int = 4) -> dict[str, dict[str, dict[str, float]]]:
    """Find discs of known centres: blur 0.7 px, 8 bit, contrast 200, noise 2 grey levels, background gradient."""
    shape, rng = (480, 640), np.random.default_rng(0)
    background = np.linspace(15, 30, shape[1])[None, :]
    table: dict[str, dict[str, dict[str, float]]] = {}
    for radius in (1.5, 3.0, 6.0):
        centres = [scattered(shape, 40, rng) for _ in range(frames)]
        views = [exposed(draw_discs(shape, uv, radius, background=background), 2.0, rng) for uv in centres]
        table[f"radius {radius} px"] = {name: score(find, views, centres, radius) for name, find in DETECTORS.items()}
    return table


def score(
    find: Detector, views: list[NDArray[np.uint8]], centres: list[NDArray[np.float64]], radius: float
) -> dict[str, float]:
    """Recall, false blobs a frame, RMS error and bias per axis, time a frame."""
    errors, false, seconds = [], 0, []
    for view, uv in zip(views, centres, strict=True):
        start = time.perf_counter()
        found = find(view, radius)
        seconds.append(time.perf_counter() - start)
        rows, distance = nearest(found, uv)
        errors.append((found[rows] - uv)[distance < 1])
        false += len(found) - int((distance < 1).sum())
    error = np.concatenate(errors)
    return {
        "recall": len(error) / sum(map(len, centres)),
        "false_per_frame": false / len(views),
        "rms_px": float(np.sqrt((error**2).mean())),
        "bias_px": float(abs(error.mean(0)).max()),
        "ms_per_frame": 1e3 * float(np.median(seconds)),
    }


def speed(repeats: int = 60) -> dict[str, object]:
    """Detect in ten frames of 2048 x 1088 with 8 fiducials of radius 3 to 5 px and 2 false blobs each."""
    shape, rng = (1088, 2048), np.random.default_rng(1)
    background = np.linspace(15, 40, shape[1])[None, :]
    frames = {}
    for camera in range(10):
        uv = rng.permutation(scattered(shape, 64, rng))[:10]
        radius = np.concatenate([rng.uniform(3, 5, 8), rng.uniform(1.5, 6, 2)])
        frames[f"cam{camera:02d}"] = exposed(draw_discs(shape, uv, radius, background=background), 2.0, rng)
    options = DetectionOptions()
    result: dict[str, object] = {"frames": "10 x 2048x1088 uint8, 10 blobs each"}
    for workers in (1, 2):
        with ThreadPoolExecutor(workers) as pool:
            seconds, cpu = [], time.process_time()
            for _ in range(repeats):
                start = time.perf_counter()
                blobs = detect_snapshot(frames, options, pool=pool)
                seconds.append(time.perf_counter() - start)
        result[f"{workers} thread{'s' * (workers > 1)}"] = {
            "blobs": len(blobs.uv),
            "ms_median": 1e3 * float(np.median(seconds)),
            "ms_p10_p90": [1e3 * float(q) for q in np.percentile(seconds, (10, 90))],
            "ms_min": 1e3 * min(seconds),
            "cpu_ms_mean": 1e3 * (time.process_time() - cpu) / repeats,
            "rigs_per_second_median": 1 / float(np.median(seconds)),
        }
    # The same frames, so that the ratio holds on any machine.
    one = next(iter(frames.values()))
    reference = min(_timed(lambda: cv2.connectedComponentsWithStats((one > 120).astype(np.uint8))) for _ in range(10))
    result["threshold and cv2.connectedComponentsWithStats, ms for 10 frames"] = 10e3 * reference
    return result


def _timed(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main() -> None:
    """Print the results and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "detection.json")
    arguments = parser.parse_args()
    machine = {"processor": platform.machine(), "cores": cv2.getNumberOfCPUs(), "python": platform.python_version()}
    machine |= {"numpy": np.__version__, "opencv": cv2.__version__, "skimage": skimage.__version__}
    results = {"machine": machine, "speed": speed(), "accuracy": accuracy()}
    text = json.dumps(results, indent=2)
    arguments.out.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
