"""What a calibration must pass before it is given to anybody: each check refuses with its reason, or does nothing."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.errors import RefusedError
from imgcal.estimation import Estimate
from imgcal.labelling import PipelineOptions
from imgcal.rig import PARAMETER_NAMES, CameraRig


def require_cameras(seen: NDArray[np.bool_], rig: CameraRig, options: PipelineOptions) -> None:
    """Refuse where a camera has nothing that is `seen` (S, C, N)."""
    blind = [rig.camera_names[i] for i in np.flatnonzero(~seen.any(axis=(0, 2)))]
    if blind and (not options.blind_cameras or len(blind) == rig.cameras):
        raise RefusedError(
            f"camera {', '.join(blind)}: found no fiducial in any snapshot, expected some; nothing can be said of it",
            python="rig.select leaves a camera out, PipelineOptions(blind_cameras=True) keeps its factory values",
            command="--without leaves a camera out, --blind-cameras keeps its factory values",
        )


def require_fit(model_error: float, outlier_share: float, rms: float, options: PipelineOptions) -> None:
    """Refuse where residuals (px) or the share of left-out labels are larger than noise makes them."""
    if model_error > options.largest_model_error:
        raise RefusedError(
            f"estimation: residuals of {rms:.2f} px RMS do not fit the noise: found an unexplained error "
            f"of {model_error:.2f} px, expected at most {options.largest_model_error:g}; the object, the labels or the "
            "camera model are not what they are said to be"
        )
    if outlier_share > options.most_outliers:
        raise RefusedError(
            f"estimation: {100 * outlier_share:.0f} % of the labelled blobs do not fit, expected at most "
            f"{100 * options.most_outliers:.0f} %"
        )


def require_near_prior(
    fit: Estimate, prior: Tensor, rig: CameraRig, widened: Mapping[str, float], options: PipelineOptions
) -> None:
    """Refuse where a value, or a kind of values, is farther from the factory's than the `prior` (C, 15) can bear."""
    offset, spread, std = (tensor.numpy() for tensor in (fit.solution.state.offset[0], fit.problem.spread[0], prior))
    drift = np.where(std > 0, np.abs(offset * spread) / np.maximum(std, 1e-30), 0.0)
    camera, parameter = divmod(int(drift.argmax()), drift.shape[1])
    largest = float(drift[camera, parameter])
    wide = max(widened.values(), default=1.0)
    if largest > options.largest_drift or wide > options.widest_prior:
        raise RefusedError(
            f"estimation: camera {rig.camera_names[camera]}: {PARAMETER_NAMES[parameter]} is {largest:.1f} prior "
            f"standard deviations off its factory value, expected at most {options.largest_drift:g}, and "
            f"{options.widest_prior:g} for all of a kind; cameras may be swapped, labels wrong, or the prior in the "
            "rig file too narrow"
        )


def require_most_labels(labels: NDArray[np.bool_], kept: NDArray[np.bool_], rig: CameraRig) -> None:
    """Refuse where most labels of one camera or one fiducial do not fit: they are not what they are said to be."""
    for name, axes, names in (("camera", (0, 2), rig.camera_names), ("fiducial", (0, 1), None)):
        before, after = labels.sum(axes), kept.sum(axes)
        bad = np.flatnonzero((before >= 6) & (after < 0.5 * before)).tolist()
        if bad:
            which = ", ".join(str(i) if names is None else names[i] for i in bad)
            raise RefusedError(
                f"estimation: {name} {which}: most labels do not fit the rest (frames of another moment, swapped "
                "labels, or a fiducial that has moved)"
            )
