"""Search for cameras that see something, but not the object where it should be, until they are found.

A camera that turned a little is found from one snapshot, near its last pose. One that turned far is found anywhere,
from everything it has seen since: the other cameras know where the object was. Its blobs are kept until then, whether
or not the object should be in view from its last pose.
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
from imgcal.medians import median_of_known
from imgcal.monitoring import RigBelief
from imgcal.online.camera_visibility import labels_to_reappear
from imgcal.online.label_consistency import LEAST_AGREEING, Checked, check_labels
from imgcal.online.prediction_labels import (
    LEAST_BLOBS,
    LEAST_EXPLAINED,
    find_displaced_cameras,
    may_stand,
    relabel_moved_camera,
    spare_blobs,
)
from imgcal.online.resection import labels_at, resect_camera
from imgcal.types import CalibrationObject, CameraRig, Detections, RigPrior

REMEMBERED = 64
"""Number of latest snapshots to keep for a missing camera."""
ASKED_TOGETHER = 16
"""Number of those, evenly spread, used to locate the camera."""
NEARBY_TRIES = 16
"""Number of snapshots in which a camera is searched for near its last pose; later only in a search everywhere."""
LONGEST_REST = 512
"""Maximum number of snapshots between two tries. A try is slow: they come after 1, 2, 4, 8, ... snapshots."""
SUSPICIOUS = 3
"""Successive snapshots with unexplained blobs and no labels after which a camera is searched for."""
USUAL_OF = 15
"""Number of snapshots that define a camera's usual number of unlabelled blobs."""


@dataclass(frozen=True)
class Surroundings:
    """What is known where a camera is searched for."""

    belief: RigBelief
    factory: CameraRig  # no camera is less certain than here
    obj: CalibrationObject  # as currently estimated
    options: PipelineOptions

    @property
    def rig(self) -> CameraRig:
        """The rig as currently estimated."""
        return self.belief.rig

    @cached_property
    def std(self) -> Tensor:
        """Uncertainty of the rig with a margin: (C, K). Slow; computed only when a camera is searched for."""
        return torch.minimum(2 * self.belief.std(), (self.factory.prior or RigPrior()).std(self.factory))


@dataclass
class SearchedCamera:
    """A camera that is being searched for."""

    since: float  # s
    blobs: deque[NDArray[np.float64]] = field(default_factory=lambda: deque(maxlen=REMEMBERED))  # (M, 2) px
    places: deque[Tensor] = field(default_factory=lambda: deque(maxlen=REMEMBERED))  # (N, 3) mm, fiducials
    taken: int = 0  # snapshots so far
    latest: int = -1  # number of the latest one
    found: int = -1  # number of the latest one in which it was found
    place: CameraRig | None = None  # the camera alone, where it was found

    def add(self, number: int, uv: NDArray[np.float64], points: Tensor) -> None:
        """Keep the camera's blobs in a snapshot; a repeated snapshot replaces the earlier one."""
        if number == self.latest:
            self.blobs[-1], self.places[-1] = uv, points
            return
        self.blobs.append(uv)
        self.places.append(points)
        self.taken, self.latest = self.taken + 1, number

    @property
    def due(self) -> bool:
        """Tell whether to search everywhere now."""
        return self.taken & (self.taken - 1) == 0 or self.taken % LONGEST_REST == 0

    def collect(self) -> tuple[list[NDArray[np.float64]], Tensor]:
        """Blobs and fiducials of some snapshots, including the latest one."""
        some = np.unique(np.linspace(0, len(self.blobs) - 1, ASKED_TOGETHER).astype(np.int64)).tolist()
        return [self.blobs[s] for s in some], torch.stack([self.places[s] for s in some])


@dataclass
class Search:
    """Searches for cameras, snapshot by snapshot, in constant memory."""

    num_cameras: int
    sought: dict[int, SearchedCamera] = field(default_factory=dict)
    spare: deque[NDArray[np.int64]] = field(default_factory=lambda: deque(maxlen=USUAL_OF))
    vainly: dict[int, int] = field(default_factory=dict)  # camera -> successive unexplained snapshots

    def label_lost_cameras(
        self, checked: Checked, known: Surroundings, time: float, number: int, doubted: frozenset[int] = frozenset()
    ) -> tuple[Checked, frozenset[int]]:
        """Search for cameras that do not see the object where it should be, and label their blobs if they are found.

        Args:
            checked: a snapshot, labelled as far as the current rig allows.
            known: the rig and the object.
            time: of the snapshot, s.
            number: of the snapshot. The same one may come again, with other labels.
            doubted: cameras that have not seen the object in the right place for some time.

        Returns:
            The snapshot with the labels of the cameras that were found (`off`: elsewhere, so they have moved), and the
            cameras that were not found and must have moved. Chance labels of cameras that are searched for or in doubt
            are removed.
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
        missed = {camera for camera in missed if not may_stand(blobs, camera, known.rig, known.obj, pose)}
        checked = replace(checked, blobs=blobs, labels=int((blobs.fiducial >= 0).sum()))
        return self._weigh(checked, found, known) if found else checked, frozenset(missed)

    def _weigh(self, checked: Checked, found: list[int], known: Surroundings) -> Checked:
        """Tell cameras that were found in place and only lost their labels from those that moved."""
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
        """Remove labels of cameras in doubt that are too few to show that they are back."""
        few = _label(checked.blobs, self.num_cameras) < labels_to_reappear(known.obj.num_fiducials)
        chance = [camera for camera in (*self.sought, *doubted) if few[camera]]
        rows = np.isin(checked.blobs.camera, chance) & (checked.blobs.fiducial >= 0)
        if not rows.any():
            return checked
        blobs = replace(checked.blobs, fiducial=np.where(rows, -1, checked.blobs.fiducial))
        return replace(checked, blobs=blobs, labels=checked.labels - int(rows.sum()))

    def observe(self, blobs: Detections, number: int) -> None:
        """Note, after an absorbed snapshot, which cameras see the object again and how many blobs are usual."""
        labelled, spare, usual = _label(blobs, self.num_cameras), self._count_spare_blobs(blobs), self._usual()
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
        # Unexplained blobs are not usual.
        unexplained = np.isin(np.arange(self.num_cameras), [*self.sought, *self.vainly])
        self.spare.append(np.where(unexplained, usual.astype(np.int64), spare_blobs(blobs, self.num_cameras)))

    def lost_since(self, camera: int, time: float) -> float:
        """Time since which a camera is searched for; `time` if it is not."""
        return self.sought[camera].since if camera in self.sought else time

    def _usual(self) -> NDArray[np.float64]:
        return median_of_known(np.stack(self.spare)) if self.spare else np.zeros(self.num_cameras)

    def _count_spare_blobs(self, blobs: Detections) -> NDArray[np.float64]:
        """Number of unlabelled blobs of each camera beyond its usual number: (C,)."""
        return np.maximum(spare_blobs(blobs, self.num_cameras) - self._usual(), 0)

    def _suspects(self, blobs: Detections, known: Surroundings, pose: RigidTransform) -> list[int]:
        """Cameras to search for."""
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
    """Label the latest blobs (M,) of a camera: where it was found before, near its last pose, or anywhere."""
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
    anywhere = resect_camera(*sought.collect(), known.rig.select([camera]), known.std[[camera]], generator)
    if anywhere is None:
        return None
    sought.place = anywhere.camera
    return anywhere.labels
