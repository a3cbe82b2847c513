"""Measure a marker with an exported network, using only NumPy and onnxruntime: no PyTorch, no imgcal.

Usage: imgcal export measurer-cnn --to onnx --out measurer.onnx && python scripts/examples/run_onnx.py measurer.onnx
"""

import sys
from typing import Any

import numpy as np
import onnxruntime

SIZE = 24  # pixels of a patch, each way


def normalized(patches: Any) -> Any:
    """Normalize grey patches (M, S, S): subtract the median, divide by the noise, compress; NaN becomes 0."""
    level = median(patches)
    noise = 1.05 * median(np.abs(patches[:, :, 2:] - patches[:, :, :-2]))
    largest = np.nan_to_num(np.abs(patches - level)).max((1, 2), keepdims=True)
    noise = np.maximum(np.maximum(noise, largest / 1000), 1e-6)
    return (np.arcsinh(np.nan_to_num((patches - level) / (2 * noise))) / 2).astype(np.float32)


def median(values: Any) -> Any:
    """Lower median of each patch, ignoring NaN: (M, 1, 1); 0 where all values are NaN."""
    flat = np.sort(values.reshape(len(values), -1), axis=1)  # NaN last
    middle = np.maximum(np.isfinite(flat).sum(1) - 1, 0) // 2
    return np.nan_to_num(flat[np.arange(len(flat)), middle])[:, None, None]


def measure(session: Any, frame: Any, place: Any, radius: float) -> tuple[Any, float, float]:
    """Measure a marker near a place: centre (u, v), sigma, probability that it is one; radius at most 3.5 pixels."""
    corner = np.round(np.asarray(place) - (SIZE - 1) / 2).astype(int)
    patch = frame[corner[1] : corner[1] + SIZE, corner[0] : corner[0] + SIZE].astype(np.float64)
    given = {"patches": normalized(patch[None]), "radius": np.array([radius], np.float32)}
    offset, log_sigma, kind = session.run(None, given)
    odds = np.exp(kind[0] - kind[0].max())
    return corner + (SIZE - 1) / 2 + offset[0], float(np.exp(log_sigma[0])), 1 - odds[3] / odds.sum()


if __name__ == "__main__":
    random, true = np.random.default_rng(0), np.array([101.3, 63.8])
    v, u = np.mgrid[0:128, 0:160]
    frame = 20 + 180 / (1 + np.exp(3 * (np.hypot(u - true[0], v - true[1]) - 3))) + random.normal(0, 2, u.shape)
    centre, sigma, odds = measure(onnxruntime.InferenceSession(sys.argv[1]), frame, np.round(true), 3.0)
    print(f"true {true}, found {centre.round(2)} +- {sigma:.2f}, a marker: {odds:.3f}")
