"""Cameras that see something, but not the object where it should be: they are looked for until they are found.

A camera that turned a little is found from one snapshot, near where it was. One that turned far is found anywhere, by
all that it has seen since: the other cameras know where the object was. Its blobs are kept until then, whether or not
the object should be in its view by where it was.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from imgcal.association import PipelineOptions
from imgcal.geometry import RigidTransform
from imgcal.monitoring import RigBelief
from imgcal.online.camera_visibility import least_back
from imgcal.online.label_consistency import LEAST_AGREEING, Checked, check_labels
from imgcal.online.prediction_labels import (
    LEAST_BLOBS,
    LEAST_EXPLAINED,
    find_displaced_cameras,
    relabel_moved_camera,
    spare_blobs,
)
from imgcal.online.resection import labels_at, resect_camera
from imgcal.types import CalibrationObject, CameraRig, Detections

REMEMBERED = 64
"""Latest snapshots of a camera that is looked for."""
ASKED_TOGETHER = 16
"""Of them, spread over all, that are asked where the camera is."""
NEARBY_TRIES = 16
"""Snapshots in each of which a camera is looked for near its place; later only when it is looked for everywhere."""
LONGEST_REST = 512
"""Snapshots between two tries at most. A try is dear: there is one after 1, 2, 4, 8, ... snapshots."""
SUSPICIOUS = 3
"""Snapshots in a row with blobs that nothing explains, and no labels, from which a camera is looked for."""
USUAL_OF = 15
"""Snapshots that say how many blobs without a label a camera usually has."""


@dataclass(frozen=True)
class Surroundings:
    """What is known where a camera is looked for."""

    belief: RigBelief
    widest: Tensor  # (C, K) standard deviations that are not exceeded: the factory calibration's
    obj: CalibrationObject  # as it is known
    options: PipelineOptions

    @property
    def rig(self) -> CameraRig:
        """The rig as it is known."""
        return self.belief.rig

    @cached_property
    def std(self) -> Tensor:
        """How well the rig is known, with some reserve: (C, K). Dear, and asked for only where a camera is searched."""
        return torch.minimum(2 * self.belief.std(), self.widest)


@dataclass
class SearchedCamera:
    """A camera that is looked for."""

    since: float  # s
    blobs: deque[NDArray[np.float64]] = field(default_factory=lambda: deque(maxlen=REMEMBERED))  # (M, 2) px
    places: deque[Tensor] = field(default_factory=lambda: deque(maxlen=REMEMBERED))  # (N, 3) mm, of the fiducials
    taken: int = 0  # snapshots so far
    latest: int = -1  # number of the last one
    found: int = -1  # number of the last one in which it was found
    place: CameraRig | None = None  # where it was found, alone

    def add(self, number: int, uv: NDArray[np.float64], points: Tensor) -> None:
        """Keep what it sees in a snapshot; of a snapshot that is looked at again, what it sees then."""
        if number == self.latest:
            self.blobs[-1], self.places[-1] = uv, points
            return
        self.blobs.append(uv)
        self.places.append(points)
        self.taken, self.latest = self.taken + 1, number

    @property
    def due(self) -> bool:
        """Tell whether it is time to look everywhere."""
        return self.taken & (self.taken - 1) == 0 or self.taken % LONGEST_REST == 0

    def collect(self) -> tuple[list[NDArray[np.float64]], Tensor]:
        """Blobs and places of some snapshots, the last one among them."""
        some = np.unique(np.linspace(0, len(self.blobs) - 1, ASKED_TOGETHER).astype(np.int64)).tolist()
        return [self.blobs[s] for s in some], torch.stack([self.places[s] for s in some])


@dataclass
class Search:
    """Looks for cameras, snapshot after snapshot, in constant memory."""

    num_cameras: int
    sought: dict[int, SearchedCamera] = field(default_factory=dict)
    spare: deque[NDArray[np.int64]] = field(default_factory=lambda: deque(maxlen=USUAL_OF))
    vainly: dict[int, int] = field(default_factory=dict)  # camera -> snapshots in a row that nothing explains

    def label_lost_cameras(
        self, checked: Checked, known: Surroundings, time: float, number: int, doubted: frozenset[int] = frozenset()
    ) -> tuple[Checked, frozenset[int]]:
        """Label the blobs of cameras that do not see the object where it should be, where they are found.

        Args:
            checked: a snapshot, labelled as far as the rig as it is known allows.
            known: the rig and the object.
            time: of the snapshot, s.
            number: of the snapshot. The same one may come again, with other labels.
            doubted: cameras that have not seen the object where it should be for some time.

        Returns:
            The snapshot with the labels of those that were found (`off`: elsewhere, so they have moved), and the
            cameras that were not found: whatever labels they had by chance are gone, as are those of cameras in doubt.
        """
        pose = checked.rig_from_object[0]
        checked = self._drop_chance_labels(checked, known, doubted)
        suspects = self._suspects(checked.blobs, known, pose)
        if not suspects:
            return checked, frozenset()
        blobs, found, missed = checked.blobs, [], set()
        points = pose.apply(known.obj.points)
        for camera in suspects:
            rows = np.flatnonzero(blobs.camera == camera)
            sought = self.sought.setdefault(camera, SearchedCamera(time))
            sought.add(number, blobs.uv[rows], points)
            alone = np.full(len(rows), -1, dtype=np.int64)
            bare = blobs.fiducial.copy()
            bare[rows] = alone
            blobs = replace(blobs, fiducial=bare)
            labels = _find(sought, blobs, camera, known, pose)
            if labels is None:
                missed.add(camera)
                continue
            named = blobs.fiducial.copy()
            named[rows] = labels
            blobs, sought.found = replace(blobs, fiducial=named), number
            found.append(camera)
        checked = replace(checked, blobs=blobs, labels=int((blobs.fiducial >= 0).sum()))
        return self._weigh(checked, found, known) if found else checked, frozenset(missed)

    def _weigh(self, checked: Checked, found: list[int], known: Surroundings) -> Checked:
        """Tell cameras that were found where they stood, and had but lost their labels, from those that moved."""
        again = check_labels(checked.blobs, known.rig, known.obj, checked.rig_from_object, known.options)
        before, kept = _label(checked.blobs, self.num_cameras), _label(again.blobs, self.num_cameras)
        stands = ~again.off & (kept >= np.maximum(LEAST_AGREEING * before, LEAST_BLOBS))
        fiducial, off = checked.blobs.fiducial.copy(), checked.off.copy()
        for camera in found:
            off[camera] = not stands[camera]
            if stands[camera]:
                rows = checked.blobs.camera == camera
                fiducial[rows] = again.blobs.fiducial[rows]
                del self.sought[camera]
        blobs = replace(checked.blobs, fiducial=fiducial)
        return replace(checked, blobs=blobs, off=off, labels=int((fiducial >= 0).sum()))

    def _drop_chance_labels(self, checked: Checked, known: Surroundings, doubted: frozenset[int]) -> Checked:
        """Take away labels of cameras in doubt that are too few to say that they are back."""
        few = _label(checked.blobs, self.num_cameras) < least_back(known.obj.num_fiducials)
        chance = [camera for camera in (*self.sought, *doubted) if few[camera]]
        rows = np.isin(checked.blobs.camera, chance) & (checked.blobs.fiducial >= 0)
        if not rows.any():
            return checked
        blobs = replace(checked.blobs, fiducial=np.where(rows, -1, checked.blobs.fiducial))
        return replace(checked, blobs=blobs, labels=checked.labels - int(rows.sum()))

    def observe(self, blobs: Detections, number: int) -> None:
        """Note a snapshot that has been learnt: which cameras see the object again, and what is usual."""
        labelled, spare, usual = _label(blobs, self.num_cameras), self._spare(blobs), self._usual()
        for camera in range(self.num_cameras):
            vainly = spare[camera] >= LEAST_BLOBS and labelled[camera] < LEAST_BLOBS
            if vainly:
                self.vainly[camera] = self.vainly.get(camera, 0) + 1
            else:
                self.vainly.pop(camera, None)
        self.sought = {
            camera: sought
            for camera, sought in self.sought.items()
            if sought.found == number or labelled[camera] < LEAST_BLOBS
        }
        # What nothing explains is not usual.
        unexplained = np.isin(np.arange(self.num_cameras), [*self.sought, *self.vainly])
        self.spare.append(np.where(unexplained, usual.astype(np.int64), spare_blobs(blobs, self.num_cameras)))

    def lost_since(self, camera: int, time: float) -> float:
        """Since when a camera is looked for; `time` where it is not."""
        return self.sought[camera].since if camera in self.sought else time

    def _usual(self) -> NDArray[np.float64]:
        return np.median(self.spare, axis=0) if self.spare else np.zeros(self.num_cameras)

    def _spare(self, blobs: Detections) -> NDArray[np.float64]:
        """Blobs without a label beyond those that a camera usually has: (C,)."""
        return np.maximum(spare_blobs(blobs, self.num_cameras) - self._usual(), 0)

    def _suspects(self, blobs: Detections, known: Surroundings, pose: RigidTransform) -> list[int]:
        """Cameras to look for."""
        bare = spare_blobs(blobs, self.num_cameras)
        if not self.sought and bare.max(initial=0) < LEAST_BLOBS:
            return []
        labelled = _label(blobs, self.num_cameras)
        suspect = find_displaced_cameras(blobs, self._usual(), known.rig, known.obj, pose)
        for camera, times in self.vainly.items():
            suspect[camera] |= times >= SUSPICIOUS and labelled[camera] < LEAST_BLOBS
        for camera in self.sought:
            few = labelled[camera] < LEAST_BLOBS or labelled[camera] <= LEAST_EXPLAINED * (labelled + bare)[camera]
            suspect[camera] |= few
        suspect &= labelled + bare >= LEAST_BLOBS
        return np.flatnonzero(suspect).tolist()


def _label(blobs: Detections, cameras: int) -> NDArray[np.int64]:
    return np.bincount(blobs.camera[blobs.fiducial >= 0], minlength=cameras)


def _find(
    sought: SearchedCamera, blobs: Detections, camera: int, known: Surroundings, pose: RigidTransform
) -> NDArray[np.int64] | None:
    """Label the latest blobs (M,) of a camera: where it was found before, near its place, or anywhere."""
    if sought.place is not None:
        labels = labels_at(sought.blobs[-1], sought.places[-1], sought.place)
        if labels is not None:
            return labels
        sought.place = None
    if sought.taken <= NEARBY_TRIES or sought.due:
        nearby = relabel_moved_camera(blobs, camera, known.rig, known.obj, pose, known.std, known.options)
        if nearby is not None:
            return nearby.fiducial[nearby.camera == camera]
    if not sought.due:
        return None
    generator = np.random.default_rng(sought.taken)
    anywhere = resect_camera(*sought.collect(), known.rig.select([camera]), generator)
    if anywhere is None:
        return None
    sought.place = anywhere.camera
    return anywhere.labels
