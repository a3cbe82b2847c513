"""A proposer for frames where blobs fail: it fits the object's whole pattern in all cameras together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from imgcal.association import Proposal, Snapshot, lattice_shifts, near_symmetries, proposal_rows
from imgcal.detection import Frame
from imgcal.geometry import RigidTransform, geodesic_angle
from imgcal.matching.maps import Maps, surprise_maps
from imgcal.matching.poses import Matcher, Ranked, Scene, distinct_turns, search_one_camera, turns_around
from imgcal.matching.refinement import Fitted, fit_and_measure
from imgcal.types import CalibrationObject

FINEST = 4  # px per cell
CELLS_A_GAP = 5.0  # smallest distance between neighbouring fiducials in the search, in cells
TURNS = 4608  # rotations, spread over all,
TURN_APART = 0.26  # rad between neighbouring ones
KEPT = 200  # poses from the search in one camera
CLIMBING = 8
SAME = 0.6  # share of fiducials at equal places from which two poses count as the same
SURE_CAMERA = 2.0  # smallest log odds of a camera that counts for this comparison
CLEAR = 40.0  # log odds between the best pose and the best distinct one at which the search ends
FINE_CLIMBS = (0.03, 0.012)
"""Radians: steps on the finest maps."""
MOST_RIVALS = 4  # fitted as well if the best pose does not stand out clearly
PARALLAX = 60.0  # px: how far a pose from one camera may be off in the others
NEARLY = 0.07  # rad: a pose rotated further than this from the known ones gets new windows
WORTHWHILE = 0.6  # of the frames' area: larger windows are not worth it


@dataclass(frozen=True)
class MatchedFilter:
    """Find the object by its whole pattern, in all cameras together; see `Proposer`."""

    name: str = "matched"

    def propose(self, snapshot: Snapshot) -> Proposal:
        """Search one snapshot: around the known poses first, then whole frames, and finally for any pose."""
        scene = Scene(snapshot.rig, snapshot.obj, snapshot.prior_std, _distance(snapshot))
        near = _search_near(scene, snapshot)
        if near is not None and near.rig_from_object is not None and not _known_pose(near.rig_from_object, snapshot):
            # The windows were placed for another pose, so the edges may be cut off: search from the new one.
            again = replace(snapshot, candidates=(near.rig_from_object,))
            near = _search_near(replace(scene, distance=_distance(again)), again) or near
        if near is not None:
            return near
        view = View.of(scene, snapshot)
        found = view.search_known(snapshot)
        if found is None:
            if not _searchable(scene.obj):
                return Proposal.decline(snapshot, "its fiducials are too dense for a search without a known pose")
            found = view.search_anywhere()
        return view.proposal(found, snapshot)


@dataclass(frozen=True)
class View:
    """The frames of a snapshot, or windows of them, as maps at the scales of the search."""

    scene: Scene
    frames: list[Frame | None]
    dark: bool
    fine: Maps
    response: NDArray[np.float32]  # (C, sizes, H, W), see `surprise_maps`
    coarse: Maps
    close: Matcher  # on the fine maps

    @classmethod
    def of(cls, scene: Scene, snapshot: Snapshot, windows: NDArray[np.int64] | None = None) -> View:
        """Build maps of frames, or of windows (C, 4) of them: first and last columns and rows."""
        names, dark = snapshot.rig.camera_names, snapshot.detection.polarity == "dark"
        frames, masks = [snapshot.frames.get(name) for name in names], [snapshot.masks.get(name) for name in names]
        fine, response = surprise_maps(frames, FINEST, dark, masks, windows)
        close = Matcher.on(scene, fine.dilate(), _reach(scene))
        return cls(scene, frames, dark, fine, response, fine.pool(_coarsest_cell(scene)), close)

    def proposal(self, found: Ranked, snapshot: Snapshot) -> Proposal:
        """Fit and measure the best pose, and its rivals if it does not stand out clearly."""
        scene = self.scene
        margin, rivals = pose_margin(found, self.close)
        result = self._fit(found.best(1)) if margin > 0 else None
        if result is None:
            return Proposal.decline(snapshot, "no pose of the object stands out in the images", margin)
        if margin < CLEAR:
            # After the fit of rig and pose, places are compared within a cell, which does not favour chance matches.
            against = rivals.scores.total.tolist()
            for k in range(min(MOST_RIVALS, len(against))):
                rival = self._fit(rivals.select(np.array([k])))
                if rival is None:
                    continue
                # A rival that converges to the same places was none.
                other = bool(differs(rival.predicted[None], result.predicted, scene.obj)[0])
                against[k] = max(against[k], rival.log_odds(scene, self.fine)) if other else 0.0
            margin = max(margin, result.log_odds(scene, self.fine) - max([0.0, *against]))
        rows = proposal_rows(result.uv, result.sigma, result.seen, result.radius, snapshot.blobs)
        return Proposal(rows, result.rig_from_object, margin)

    def _fit(self, pose: Ranked) -> Fitted | None:
        return fit_and_measure(self.scene, pose, self.fine, self.response, self.frames, self.dark)

    def search_known(self, snapshot: Snapshot) -> Ranked | None:
        """Search at the known poses, or the origin, and around them; None = the object may be elsewhere."""
        scene, close, found = self.scene, self.close, None
        matcher = Matcher.on(scene, self.coarse, close.reach)
        known = [pose for pose in _known_poses(snapshot) if _is_in_view(pose, snapshot)]
        for turns_too in (False, True):
            for pose in known:
                if turns_too and not _searchable(scene.obj):
                    continue
                start = turns_around(pose, scene.obj) if turns_too else pose[None]
                near = matcher.climb(matcher.rank(start).best(CLIMBING))
                near = close.climb(close.rank(near.poses), FINE_CLIMBS)
                found = near if found is None else found + near
                if pose_margin(found, close)[0] > CLEAR:
                    return found
        return None if _searchable(scene.obj) else found

    def search_anywhere(self) -> Ranked:
        """Search for any pose: from one camera's image after the other, until a pose stands out."""
        scene, close, coarse = self.scene, self.close, self.coarse
        turns = distinct_turns(scene.obj, TURNS)
        reach = 4 * 2**0.5 * scene.drift + PARALLAX
        alone = Matcher.on(scene, coarse.pool(2 * coarse.factor), reach)
        matcher = Matcher.on(scene, coarse, reach)
        found: Ranked | None = None
        for camera in np.argsort(-_sum_surprises(coarse)).tolist():
            poses = search_one_camera(alone, camera, turns, min(KEPT, len(turns)))
            fresh = matcher.climb(matcher.rank(poses).best(CLIMBING))
            fresh = close.climb(close.rank(fresh.poses), FINE_CLIMBS)
            found = fresh if found is None else (found + fresh).best(2 * CLIMBING)
            if pose_margin(found, close)[0] > CLEAR:
                break
        assert found is not None
        return found


def pose_margin(found: Ranked, matcher: Matcher) -> tuple[float, Ranked]:
    """Compare the best pose with the best distinct ones: found ones and near-symmetries of the best.

    Returns:
        Log odds against the best rival, and the rivals, the best first.
    """
    obj, best = matcher.scene.obj, found.best(1)
    motions = lattice_shifts(obj) + near_symmetries(obj, 0.1 * obj.size)
    if motions:
        rotation = torch.from_numpy(np.stack([motion.rotation for motion in motions]))
        translation = torch.from_numpy(np.stack([motion.translation for motion in motions]))
        found = found + matcher.rank(best.poses[0] @ RigidTransform(rotation, translation))
    rivals = found.select(np.flatnonzero(distinct(found, best, matcher.scene)))
    rivals = rivals.best(len(rivals.scores.total))
    return float(best.scores.total[0] - max([0.0, *rivals.scores.total])), rivals


def distinct(found: Ranked, best: Ranked, scene: Scene) -> NDArray[np.bool_]:
    """Find poses (K,) that do not put the fiducials in the same places as the best one, up to symmetries."""
    sure = best.scores.log_odds[0] > SURE_CAMERA
    return differs(_places(found, scene)[:, sure], _places(best, scene)[0, sure], scene.obj)


def differs(there: NDArray[np.float64], here: NDArray[np.float64], obj: CalibrationObject) -> NDArray[np.bool_]:
    """Compare K sets of places (K, C, N, 2) with one (C, N, 2): (K,) whether the fiducials are elsewhere."""
    gaps = np.linalg.norm(here[:, :, None] - here[:, None], axis=-1)
    gaps[:, np.arange(here.shape[1]), np.arange(here.shape[1])] = np.inf
    gap = gaps.min(-1)
    same = np.zeros(len(there))
    for motion in obj.symmetries if len(here) else []:
        turned = motion.permutation
        one = np.linalg.norm(there - here[:, turned], axis=-1) < 0.5 * gap[:, turned]
        same = np.maximum(same, one.mean((1, 2)))
    return same < SAME


def _places(found: Ranked, scene: Scene) -> NDArray[np.float64]:
    """Predicted places of all fiducials, with the shifts of the cameras: (K, C, N, 2) pixels."""
    points = found.poses.apply(scene.obj.points.to(scene.rig.focal_length))
    uv = scene.rig.expand(len(points)).project_values(points, scene.obj.radius).uv.numpy()
    return uv + found.scores.shift[:, :, None]


def _reach(scene: Scene) -> NDArray[np.float64]:
    """Largest shift of the images of a known pose: (C,) pixels."""
    return 4 * scene.drift + PARALLAX / 3


def _coarsest_cell(scene: Scene) -> int:
    """Pixels per cell at the start of the search."""
    gap = _gap(scene.obj) * scene.pixels_per_mm
    return int(max(FINEST, 2 ** int(np.log2(max(gap / CELLS_A_GAP, 1)))))


def _search_near(scene: Scene, snapshot: Snapshot) -> Proposal | None:
    """Search windows around the known poses; None = no known pose, or none that stands out."""
    windows = _windows(scene, snapshot)
    if windows is None:
        return None
    view = View.of(scene, snapshot, windows)
    found = view.search_known(snapshot)
    proposal = None if found is None else view.proposal(found, snapshot)
    return proposal if proposal is not None and proposal.margin > CLEAR else None


def _known_pose(pose: RigidTransform, snapshot: Snapshot) -> bool:
    """Check whether a pose is close to a known one."""
    return any(float(geodesic_angle(pose.rotation, known.rotation)) < NEARLY for known in snapshot.candidates)


def _windows(scene: Scene, snapshot: Snapshot) -> NDArray[np.int64] | None:
    """Windows that contain the object in the known poses and rotations around them: (C, 4), see `View.of`.

    Returns:
        The windows; None where no pose is known, or where they would not be much smaller than the frames.
    """
    known = [pose for pose in snapshot.candidates if _is_in_view(pose, snapshot)]
    if not known:
        return None
    poses = RigidTransform.cat(
        [turns_around(pose, scene.obj) if _searchable(scene.obj) else pose[None] for pose in known]
    )
    points = poses.apply(scene.obj.points.to(scene.rig.focal_length))
    projection = scene.rig.expand(len(points)).project_values(points, scene.obj.radius)
    size, reach = scene.rig.image_size.numpy(), _reach(scene)[:, None]
    uv, ahead = projection.uv.numpy(), projection.depth.numpy()[..., None] > 1
    low = np.where(ahead, uv, np.inf).min((0, 2)) - reach  # (C, 2)
    high = np.where(ahead, uv, -np.inf).max((0, 2)) + reach
    step = 2 * _coarsest_cell(scene)
    low = np.clip(np.floor(low / step) * step, 0, size)
    high = np.maximum(np.clip(np.ceil(high / step) * step, 0, size), low)
    if (high - low).prod(1).sum() > WORTHWHILE * size.prod(1).sum():
        return None
    return np.stack((low, high), -1).reshape(-1, 4).astype(np.int64)


def _sum_surprises(maps: Maps) -> NDArray[np.float64]:
    """Sum of the largest surprises in each camera: (C,)."""
    flat = maps.surprise.reshape(len(maps.surprise), -1)
    return np.sort(flat, axis=1)[:, -64:].sum(1)


def _gap(obj: CalibrationObject) -> float:
    """Typical distance (mm) from a fiducial to its nearest neighbour."""
    gaps = torch.cdist(obj.points, obj.points)
    gaps.fill_diagonal_(torch.inf)
    return float(gaps.min(1).values.median())


def _searchable(obj: CalibrationObject) -> bool:
    """Check that rotations between the search's samples keep most fiducials near their places."""
    return TURN_APART / 2 * obj.size < 0.6 * _gap(obj)


def _known_poses(snapshot: Snapshot) -> list[RigidTransform]:
    """Poses to try: the given ones, or the origin, where many captures have the object."""
    return list(snapshot.candidates) or [RigidTransform.identity(dtype=torch.float64)]


def _is_in_view(pose: RigidTransform, snapshot: Snapshot) -> bool:
    """Check whether any camera would see the object there."""
    points = pose.apply(snapshot.obj.points.to(snapshot.rig.focal_length))
    return bool(snapshot.rig.project_values(points).visible.any())


def _distance(snapshot: Snapshot) -> float:
    """Approximate distance of the object from the cameras, mm."""
    rig, obj = snapshot.rig, snapshot.obj
    if not snapshot.candidates and rig.working_distance is not None:
        return rig.working_distance
    for pose in _known_poses(snapshot):
        if _is_in_view(pose, snapshot):
            centre = pose.apply(obj.points.mean(0, keepdim=True))[0]
            return float((rig.positions - centre).norm(dim=-1).median())
    # Assume that the object spans a fifth of the image.
    return float((rig.focal_length.mean(-1) * obj.size / (0.2 * rig.image_size[:, 0])).median())
