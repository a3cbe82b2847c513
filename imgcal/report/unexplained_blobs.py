"""Sentences about unexplained blobs, and about cameras that did not stand still, for the verdict."""

from __future__ import annotations

import numpy as np

from imgcal.pipeline import DOUBTFUL
from imgcal.report.content import ReportContent

CROWDED = 1.0
"""Blobs that belong to nothing, in parts of those that are used, from which on it is said."""


def unexplained_sentences(content: ReportContent) -> list[tuple[str, str]]:
    """Reasons for doubt, each with a remedy."""
    notes = [
        (
            f"During the capture {move}: only the snapshots since the last move are used.",
            "Fasten what has moved. For a better known rig, capture more snapshots now.",
        )
        for move in content.moves
    ]
    notes += [
        (f"{words[:1].upper()}{words[1:]}; these took no part.", "Export the frames of that camera anew, all of them.")
        for words in content.late
    ]
    notes += [
        (
            f"{words[:1].upper()}{words[1:]}.",
            "Capture some more snapshots and calibrate again: a camera that was bumped will be off in all of them.",
        )
        for words in content.doubtful
    ]
    used = np.bincount(content.detections.camera[content.used], minlength=len(content.cameras))
    blobs = np.bincount(content.detections.camera, minlength=len(content.cameras))
    if content.unexplained is not None:
        for camera in np.flatnonzero(content.unexplained > DOUBTFUL * np.maximum(content.unexplained + used, 1)):
            name = content.cameras[camera]
            notes.append((
                f"{name}: {content.unexplained[camera]} blobs may be fiducials and are not where these should be; "
                f"{used[camera]} are.",
                f"Look at the overlay of {name}: reflections where the object is hidden are harmless; a pattern beside "
                "its place means that the camera has moved, or is late.",
            ))  # fmt: skip
    crowded = [content.cameras[i] for i in np.flatnonzero(blobs - used > CROWDED * np.maximum(used, 10))]
    if crowded:
        notes.append((
            f"More blobs without a label than with one in {', '.join(crowded[:4])}{' and more' * (len(crowded) > 4)}.",
            "Cover or mask reflections there.",
        ))  # fmt: skip
    return notes
