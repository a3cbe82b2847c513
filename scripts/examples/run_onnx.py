"""Measure a marker with an exported network: NumPy and onnxruntime alone, no PyTorch and no imgcal.

Usage: imgcal export measurer-cnn --to onnx --out measurer.onnx && python scripts/examples/run_onnx.py measurer.onnx
"""

import sys
from typing import Any

import numpy as np
import onnxruntime

SIZE = 24  # pixels of a patch, each way


def normalized(patches: Any) -> Any:
    """Grey patches (M, S, S) as networks take them: less their median, over their noise, compressed; NaN becomes 0."""
    level = median(patches)
    noise = 1.05 * median(np.abs(patches[:, :, 2:] - patches[:, :, :-2]))
    largest = np.nan_to_num(np.abs(patches - level)).max((1, 2), keepdims=True)
    noise = np.maximum(np.maximum(noise, largest / 1000), 1e-6)
    return (np.arcsinh(np.nan_to_num((patches - level) / (2 * noise))) / 2).astype(np.float32)


def median(values: Any) -> Any:
    """Of what is no NaN in each patch: (M, 1, 1); of two in the middle the lower one; 0 where nothing is."""
    flat = np.sort(values.reshape(len(values), -1), axis=1)  # NaN last
    middle = np.maximum(np.isfinite(flat).sum(1) - 1, 0) // 2
    return np.nan_to_num(flat[np.arange(len(flat)), middle])[:, None, None]


def measure(session: Any, frame: Any, place: Any, radius: float) -> tuple[Any, float, float]:
    """Centre (u, v) of the marker of a radius (pixels, 3.5 at most) near a place, its sigma, and whether it is one."""
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
