"""Checks that a calibration must pass before it is returned: each raises its reason, or does nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions
from imgcal.errors import RefusedError
from imgcal.estimation import Estimate
from imgcal.messages import name_cameras, name_several, plural
from imgcal.pipeline.label_counts import LabelCounts
from imgcal.types import CalibrationObject, CameraRig, Observations

LEAST_EXPLAINED = 0.5
"""Minimum share of a camera's view of the object that must be where the rest of the rig expects it."""
SAME_PIXEL = 1e-3
"""Maximum difference (px) between two ways of projecting."""
LEAST_SIGHT, LEAST_BLOBS = 0.3, 4
"""Minimum number of possible fiducials, as a share of those in view, for a camera to see the object; and minimum number
of blobs, if no label of the camera fits."""


def require_cameras(seen: NDArray[np.bool_], rig: CameraRig, options: PipelineOptions) -> None:
    """Refuse if a camera has nothing in `seen` (S, C, N)."""
    blind = [rig.camera_names[i] for i in np.flatnonzero(~seen.any(axis=(0, 2)))]
    if blind and (not options.blind_cameras or len(blind) == rig.num_cameras):
        raise RefusedError(
            f"{name_cameras(blind)}: found no fiducial in any snapshot, expected some to calibrate from",
            python="rig.select leaves a camera out, PipelineOptions(blind_cameras=True) keeps its factory values",
            command="--without leaves a camera out, --blind-cameras keeps its factory values",
        )


def require_views(counts: LabelCounts, rig: CameraRig, least_share: float = LEAST_EXPLAINED) -> None:
    """Refuse if a camera sees a possible object, but hardly any of it where the rest of the rig expects it.

    Missing labels count as much against a camera as labels that did not fit.

    Args:
        counts: what each camera saw.
        rig: for the names of the cameras.
        least_share: share of a camera's view of the object that must be in place; zero = any.
    """
    kept, unexplained, expected = (count.sum(0) for count in (counts.kept, counts.unexplained, counts.expected))
    bad = (kept <= least_share * (kept + unexplained)) & (unexplained >= LEAST_SIGHT * np.maximum(expected, 1))
    bad &= (kept > 0) | (unexplained >= LEAST_BLOBS)  # a false blob or two show nothing
    if bad.any():
        camera = int(np.argmax(np.where(bad, unexplained, -1)))
        which = [rig.camera_names[i] for i in np.flatnonzero(bad)]
        raise RefusedError(
            f"{name_cameras(which)}: the other cameras put {plural(int(expected[camera]), 'fiducial')} into the image "
            f"of {rig.camera_names[camera]}, found {kept[camera]} there, and "
            f"{plural(int(unexplained[camera]), 'blob')} that belong to nothing: the image may be mirrored or turned, "
            "its frames may be of another camera or moment, or its pose or lens may differ from the rig file",
            python="correct this, or leave the camera out of the rig (rig.select) and of the detections",
            command=f"correct this, or leave out what is wrong: --without {' '.join(which)}",
        )


def require_fit(additive_noise: float, outlier_share: float, rms: float, options: PipelineOptions) -> None:
    """Refuse if residuals (px) or the share of left-out labels are larger than noise explains."""
    if additive_noise > options.largest_additive_noise:
        raise RefusedError(
            f"estimation: the best rig misses the blobs by {rms:.2f} px (RMS), of which {additive_noise:.2f} px are "
            f"not noise of the blobs, expected at most {options.largest_additive_noise:g}: the object differs from its "
            "file, labels are wrong, or the lenses are of another kind",
            python="measure the object again; if all is right, raise PipelineOptions.largest_additive_noise",
            command="measure the object again, and check labels given in the input",
        )
    if outlier_share > options.most_outliers:
        raise RefusedError(
            f"estimation: {100 * outlier_share:.0f} % of the labelled blobs do not fit any rig, expected at most "
            f"{100 * options.most_outliers:.0f} %: labels are wrong, or something moved during the capture",
            python="calibrate from fewer snapshots (Detections.of_snapshots) to find which ones fit",
            command="calibrate from fewer snapshots (--snapshots A:B) to find which ones fit",
        )


def require_same_residuals(
    fit: Estimate, observations: Observations, seen: NDArray[np.bool_], obj: CalibrationObject
) -> None:
    """Project the object with the rig to be returned, and compare with the residuals to be reported.

    Shares no code with the solver. A difference means that the solver's state and its report are inconsistent.
    """
    points = fit.rig_from_object.apply(fit.points_object.unsqueeze(-3)).to(fit.rig.focal_length)
    uv = fit.rig.expand(len(points)).project_values(points, obj.radius).uv  # (S, C, N, 2)
    difference = np.abs(uv.numpy() - observations.uv.numpy() - fit.residual.numpy())[seen]
    if not (difference < SAME_PIXEL).all():
        raise RefusedError(
            "estimation: the rig that was found and its residuals do not belong together (up to "
            f"{difference.max():.2g} px apart): please report this with the data"
        )


def require_near_prior(
    fit: Estimate, prior: Tensor, rig: CameraRig, prior_scale: Mapping[str, float], options: PipelineOptions
) -> None:
    """Refuse if a value, or a kind of values, is farther from the factory's than the `prior` (C, K) allows."""
    offset, prior_std, std = (
        tensor.numpy() for tensor in (fit.solution.state.offset[0], fit.problem.prior_std[0], prior)
    )
    change = offset * prior_std
    drift = np.where(std > 0, np.abs(change) / np.maximum(std, 1e-30), 0.0)
    camera, parameter = divmod(int(drift.argmax()), drift.shape[1])
    kind = max(prior_scale, key=lambda name: prior_scale[name], default="")
    if drift[camera, parameter] > options.largest_drift:
        name = rig.parameter_names_of(camera)[parameter]
        found = (
            f"camera {rig.camera_names[camera]}: {name.replace('_', ' ')} would differ from its factory value by "
            f"{_format_value(change[camera, parameter], name)}, with a tolerance (prior) of "
            f"{_format_value(std[camera, parameter], name)} and up to {options.largest_drift:g} times as much accepted"
        )
    elif kind and prior_scale[kind] > options.widest_prior:
        found = (
            f"the {kind.replace('_', ' ')} of all cameras together would differ from the factory values "
            f"{prior_scale[kind]:.1f} times as much as its tolerance (prior) says, with {options.widest_prior:g} times "
            "as much accepted"
        )
    else:
        return
    raise RefusedError(
        f"estimation: {found}: cameras may be swapped, labels may be wrong, or the rig file belongs to another rig",
        python="if the rig has really changed that much, give it a wider prior: replace(rig, prior=RigPrior(...))",
        command="if the rig has really changed that much, write larger values under `prior` in the rig file",
    )


def require_most_labels(labels: NDArray[np.bool_], kept: NDArray[np.bool_], rig: CameraRig) -> None:
    """Refuse if most labels of one camera or one fiducial do not fit, so that they must be wrong."""
    before, after = labels.sum((0, 2)), kept.sum((0, 2))
    bad = np.flatnonzero((before >= 6) & (after < 0.5 * before)).tolist()
    if bad:
        which = [rig.camera_names[i] for i in bad]
        raise RefusedError(
            f"estimation: {name_cameras(which)}: {before[bad[0]] - after[bad[0]]} of {before[bad[0]]} labels in "
            f"{which[0]} do not fit what the other cameras see: its frames may be of another moment, or its labels of "
            "other fiducials",
            python="correct this, or leave the camera out of the rig (rig.select) and of the detections",
            command=f"correct this, or leave it out: --without {' '.join(which)}",
        )
    before, after = labels.sum((0, 1)), kept.sum((0, 1))
    bad = np.flatnonzero((before >= 6) & (after < 0.5 * before)).tolist()
    if bad:
        raise RefusedError(
            f"estimation: {name_several('fiducial', map(str, bad))} (row of the object file): "
            f"{before[bad[0]] - after[bad[0]]} of {before[bad[0]]} labels of fiducial {bad[0]} do not fit: it "
            "has moved on the object, or labels are swapped",
            python="measure it again, or leave it out of the object",
            command="measure it again, or take its row out of the object file",
        )


def _format_value(value: float, name: str) -> str:
    """Format a parameter's value for people."""
    if name.startswith("rotation"):
        return f"{math.degrees(value):.3g} deg"
    if name.startswith("position"):
        return f"{value:.3g} mm"
    return f"{value:.3g} px" if name in ("fx", "fy", "cx", "cy") else f"{value:.3g}"
