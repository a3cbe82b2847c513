"""A network that finds fiducials in frames: a proposer for frames in which blob detection fails.

It searches, in all cameras, around the images of candidate poses. If it finds too little, it rotates the candidate, and
the evidence of all cameras together decides. A rig and a pose are fitted to the claims, and the search is repeated with
better centred windows, so that good views help bad ones. The claims are proposals: identification and estimation judge
them like blobs.

Objects of many small markers are processed in tiles. Within a lattice, neighbours look alike one step aside. All tiles
of a camera decide jointly, at the border of the lattice, which step is right; if that is close, the camera is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from imgcal.association import Proposal, Proposer, Snapshot, proposal_rows
from imgcal.detection import Frame
from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import model_file
from imgcal.matching import each_camera, measure_markers
from imgcal.networks import (
    Evidence,
    Expectation,
    InfraredNetwork,
    Measurer,
    Queries,
    Tiles,
    claim,
    cut_crops,
    cut_patches,
    load_infrared,
    load_measurer,
    normalize_crops,
)
from imgcal.pipeline.network_pass import CHANCE, NetworkPass
from imgcal.types import CalibrationObject, CameraRig, Observations

LEAST_PROBABILITY = 0.5  # minimum probability of a claim
LEAST_SEEN = 0.5  # share of the searched fiducials below which other poses are tried
CONVINCING = 0.35  # share of the fiducials in view: a wrong pose shows less by chance
LEAST_CLAIMS = 6  # minimum number of claims in all cameras for a fit
TURNS_DEG = (7.0, 13.0)  # rotations of a candidate about each axis if it shows too little
LOOKS = 3  # passes: at the candidate, then at the fits to its claims
LEAST_MEASURED = 0.01  # patch pixels: limit of the measurer's accuracy
LEAST_PRESENT = 0.1  # minimum probability that a fiducial is visible for it to be measured
GATES = (8.0, 2.5)  # px: maximum error of a measurement relative to the fit, in two rounds
LARGEST_REACH = 3.0  # px: sigmas beyond this do not widen the gate
LEAST_IN_CAMERA = 3  # minimum number of fitting fiducials for a camera to count
LEAST_SIGMA = 0.1  # crop pixels: limit of the network's accuracy
ROBUST = EstimationOptions(loss="cauchy", threshold=2.0, max_iterations=30, tolerance=1e-2)
MODEL_ERROR = 0.3  # px: error of a measurement beyond its own sigma
OUTLIER = 5.0  # standard deviations from the fit at which a claim is dropped
LARGEST_SIGMA = 20.0  # px: a claim with a larger sigma is too vague to be searched for again
VAGUE = 3.0  # px: minimum sigma at which a fiducial is not proposed
TILES_AT_ONCE = 8  # more would not fit into the caches and the memory
STEPS = 9  # compared displacements of a camera: none, and the lattice steps around it
SAME_PLACE = 4.0  # crop pixels within which two displacements give the same place
SHARED_PLACE = 0.4  # of the distance between neighbouring fiducials, within which two displacements share a place
LEAST_AHEAD = 2.0  # minimum lead, in markers at the border, of the best displacement

Fit = tuple[CameraRig, RigidTransform]
"""The most probable rig, and poses (1,)."""


@dataclass(frozen=True)
class LearnedProposer:
    """Proposes the fiducials found by a query network."""

    network: InfraredNetwork
    measurer: Measurer | None = None  # reads markers, too; None = all are fitted with one shape per camera
    finder: Proposer | None = None  # gives a pose if none is known, or the known ones show too little
    name: str = "learned"

    @torch.no_grad()
    def propose(self, snapshot: Snapshot) -> Proposal:
        """Search one snapshot around known poses and, if they show too little, around the finder's pose.

        What the finder has measured itself is behind the proposal, for where the network's is refused.
        """
        finder = self.finder
        if finder is None:
            known = bool(snapshot.candidates)
            return self._search_near(snapshot) if known else Proposal.decline(snapshot, "found no pose to start from")
        if snapshot.candidates and self._convinces(near := self._search_near(snapshot, turns_deg=()), snapshot):
            return replace(near, otherwise=lambda: replace(finder.propose(snapshot), found_by=finder.name))
        found = finder.propose(snapshot)
        if found.rig_from_object is None:
            if snapshot.candidates:
                return self._search_near(snapshot)
            return self._search_origin(snapshot) or Proposal.decline(snapshot, found.reason)
        there = replace(snapshot, candidates=(found.rig_from_object,))
        best = self._search_near(there, turns_deg=())
        if not self._convinces(best, snapshot):  # rotations cost more than the finder
            starts = [snapshot, there] if snapshot.candidates else [there]
            best = max((self._search_near(start) for start in starts), key=lambda proposal: len(proposal.detections))
        return replace(best, otherwise=lambda: replace(found, found_by=finder.name))

    def _search_origin(self, snapshot: Snapshot) -> Proposal | None:
        """Search at the rig's origin, the usual place, for an object of many small markers: the finder cannot find
        these.

        Other objects are searched for everywhere.
        """
        origin = RigidTransform.identity(dtype=snapshot.rig.focal_length.dtype)
        size = self.network.config.crop
        if not Tiles.of_object(snapshot.rig, snapshot.obj, RigidTransform.stack((origin,)), size).divided:
            return None
        proposal = self._search_near(replace(snapshot, candidates=(origin,)))
        return None if proposal.reason else proposal

    def _convinces(self, proposal: Proposal, snapshot: Snapshot) -> bool:
        """Tell whether so much is visible that the object cannot be elsewhere."""
        if proposal.rig_from_object is None:
            return False
        points = proposal.rig_from_object.apply(snapshot.obj.points)
        in_view = int(snapshot.rig.project(points).visible.sum())
        return len(proposal.detections) > CONVINCING * in_view

    def _search_near(self, snapshot: Snapshot, turns_deg: tuple[float, ...] = TURNS_DEG) -> Proposal:
        """Search around the candidates and, if they show too little, at these rotations of the best."""
        view = _View.of(self.network, self.measurer, snapshot)
        poses = RigidTransform.stack(snapshot.candidates)
        view, looks = view.align(poses[:1]) if view.tiles.divided else (view, view.near(poses, turns_deg))
        if view.tiles.divided and not looks.count:
            return Proposal.decline(
                snapshot, "too little of the object is visible to tell one step of its pattern from the next"
            )
        fitted = view.fit(looks, view.observations(looks))
        for _ in range(LOOKS - 1):
            if fitted is None:
                reason = f"found {float(looks.found[0]):.0f} of {looks.count} fiducials in the frames"
                return Proposal.decline(snapshot, reason)
            looks = view.ask(*fitted, window=self.network.config.close_window)
            fitted = view.fit(looks, view.observations(looks))
        return view.proposal(looks, fitted)


def load_proposer(
    network: str | Path = "ir-cnn", measurer: str | Path | None = "measurer-cnn", finder: Proposer | None = None
) -> LearnedProposer:
    """Load networks that work for any rig and any object.

    Args:
        network: name of a shipped query network, its file, or the folder of the run that trained it.
        measurer: the same for a measurer, used for markers where it is more accurate; None = all markers are fitted.
        finder: gives a pose if none is known.

    Raises:
        InputError: there is no such file, or it contains something else.
    """
    reader = None if measurer is None else load_measurer(model_file(measurer)).network
    read = load_infrared(model_file(network)).network
    read.encoder.to(memory_format=torch.channels_last)  # faster by a quarter on a CPU
    return LearnedProposer(read, reader, finder)


@dataclass(frozen=True)
class _View:
    """Crops of all cameras of a snapshot, encoded once."""

    network: InfraredNetwork
    measurer: Measurer | None
    snapshot: Snapshot
    frames: Mapping[str, Frame | None]  # with masked parts painted over
    tiles: Tiles
    features: Tensor  # (T, D, G, G)
    most: float = math.inf  # upper limit of the log odds, from the choice of pattern steps

    @classmethod
    def of(cls, network: InfraredNetwork, measurer: Measurer | None, snapshot: Snapshot) -> _View:
        rig, size = snapshot.rig, network.config.crop
        poses = RigidTransform.stack(snapshot.candidates)
        tiles = Tiles.of_object(rig, snapshot.obj, poses, size)
        frames = {name: _mask_frame(frame, snapshot.masks.get(name)) for name, frame in snapshot.frames.items()}
        names = tuple(rig.camera_names[camera] for camera in tiles.camera.tolist())
        crops = cut_crops(frames, names, tiles.placement, inverted=snapshot.detection.polarity == "dark")
        features = network.encoder(normalize_crops(crops)[:, None]).contiguous()
        return cls(network, measurer, snapshot, frames, tiles, features)

    def expect(self, rig: CameraRig, poses: RigidTransform) -> Expectation:
        """Project the fiducials at poses (H,)."""
        return Expectation.of(rig, self.snapshot.obj, poses, self.tiles.usual)

    def ask(
        self, rig: CameraRig, poses: RigidTransform, window: int | None = None, aside: Tensor | None = None
    ) -> NetworkPass:
        """Search for all fiducials at poses (H,), optionally displaced by crop pixels (C, 2)."""
        count, placement = len(poses.rotation), self.tiles.placement
        shift = None
        if aside is not None:
            shift = (placement.scale[:, None] * aside[self.tiles.camera]).expand(count, -1, -1)
        queries = self.tiles.arrange_expected(self.expect(rig, poses)).queries(placement, shift)
        evidence = self._search(queries, count, window)
        asked = queries.asked.unflatten(0, (count, -1))
        return NetworkPass(rig, poses, self.tiles, evidence, claim(evidence, queries.asked), asked)

    def _search(self, queries: Queries, count: int, window: int | None) -> Evidence:
        """Search for queries (H T, n) of `count` poses."""
        tiles = len(self.features)
        parts = [
            self.network.search(self.features[rows % tiles], queries.select(rows), window)
            for rows in torch.arange(count * tiles).split(TILES_AT_ONCE if self.tiles.divided else tiles)
        ]
        return Evidence.cat(parts)

    def align(self, pose: RigidTransform) -> tuple[_View, NetworkPass]:
        """Find by which step of its pattern the object (1,) is displaced in each camera.

        Returns:
            The view, without cameras whose step is ambiguous, and a pass with these displacements.
        """
        rig, window = self.snapshot.rig, self.network.config.close_window
        steps = self.ask(rig, pose).displacements(STEPS)
        looks = [self.ask(rig, pose, window, aside) for aside in steps]
        claimed = [self.observations(look) for look in looks]
        uv, seen = torch.cat([each.uv for each in claimed]), torch.cat([each.seen for each in claimed])  # (K, C, N)
        scale = self._join(self.tiles.placement.scale[:, None].expand_as(self.tiles.counts))
        both = seen & seen[:, None]
        one = both & ((uv - uv[:, None]).norm(dim=-1) < SAME_PLACE * scale)
        same = 2 * one.sum(-1) > both.sum(-1)  # steps that show the same markers in the same places are not rivals
        probability = torch.stack([self._join(look.claims.probability) for look in looks])
        places = self.expect(rig, pose).uv + (steps[:, :, None] * scale[..., None]).to(uv)
        leads = leads_at_border(places, probability, self._join(self.tiles.counts))
        least = leads.masked_fill(same, torch.inf).amin(1)  # (K, C) over the rival that comes closest ...
        ahead, best = torch.minimum(least, probability.sum(-1)).max(0)  # ... or over nothing at all
        sure, cameras = ahead >= LEAST_AHEAD, torch.arange(rig.num_cameras)
        most = -math.log(CHANCE) * float(ahead[sure].sum())
        view = replace(self, tiles=self.tiles.select_cameras(sure), most=most)
        return view, view.ask(rig, pose, window, steps[best, cameras])

    def near(self, poses: RigidTransform, turns_deg: tuple[float, ...]) -> NetworkPass:
        """The best of poses (H,); if it shows too little, also try rotated ones."""
        rig = self.snapshot.rig
        looks = self.best(rig, poses)
        if turns_deg and float(looks.found[0]) < LEAST_SEEN * looks.count:
            tried = self.best(rig, _turn_pose(looks.poses[0], self.snapshot.obj, turns_deg))
            looks = tried if float(tried.found[0]) > float(looks.found[0]) else looks
        return looks

    def best(self, rig: CameraRig, poses: RigidTransform) -> NetworkPass:
        """The pose, of (H,), that shows most in all cameras together."""
        looks = self.ask(rig, poses)
        return looks if len(poses.rotation) == 1 else self.ask(rig, poses[looks.found.argmax()[None]])

    def observations(self, looks: NetworkPass) -> Observations:
        """Claims at the first pose, in image pixels: (1, C, N)."""
        claims, placement = looks.claims, self.tiles.placement
        scale = placement.scale[:, None]
        uv = placement.to_image(claims.place.to(placement.corner))
        sigma = (claims.sigma.to(scale).square() + LEAST_SIGMA**2).sqrt() * scale
        seen = (claims.probability > LEAST_PROBABILITY) & (sigma < LARGEST_SIGMA)
        return Observations(*(self._join(values)[None] for values in (uv, sigma, seen)))

    def _join(self, values: Tensor) -> Tensor:
        """Arrange values (T, n, ...) by camera: (C, N, ...)."""
        return self.tiles.join(values, self.snapshot.rig.num_cameras, self.snapshot.obj.num_fiducials)

    def measure(self, looks: NetworkPass, expected: Expectation, gate: float) -> Observations:
        """Measure all fiducials at full scale where a fitted rig predicts them (1, C, N), if the network sees them.

        Args:
            looks: claims to keep where nothing can be measured.
            expected: predictions by the fitted rig and pose.
            gate: maximum error in pixels, in addition to what its sigma explains.
        """
        claimed = self.observations(looks)
        shown = self._join(looks.asked[0] & (looks.evidence.present.sigmoid() > LEAST_PRESENT))
        surely, last = claimed.seen[0] & shown, gate == GATES[-1]
        place, sigma, good = self._read(expected.uv[0], expected.radius[0], surely, last)
        good &= shown
        uv = torch.where(good[..., None], place, claimed.uv[0])
        sigma = torch.where(good, sigma, claimed.sigma[0])
        reach = torch.hypot(OUTLIER * sigma.clamp(max=LARGEST_REACH), sigma.new_tensor(gate))
        seen = (good | claimed.seen[0]) & ((expected.uv[0] - uv).norm(dim=-1) < reach)
        # A few fits in a camera may be chance.
        seen &= seen.sum(-1, keepdim=True) >= LEAST_IN_CAMERA
        return Observations(uv[None], sigma[None], seen[None])

    def _read(self, uv: Tensor, radius: Tensor, seen: Tensor, last: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Measurements (C, N, 2), sigmas and validity (C, N); in the last round, the more accurate source of each."""
        if self.measurer is None:
            return self._fit(uv, radius, seen)
        read = self._measure_by_network(uv, radius)
        if not last:
            return read
        place, sigma, good = self._fit(uv, radius, seen)
        better = read[2] & (~good | (read[1] < sigma))
        place, sigma = torch.where(better[..., None], read[0], place), torch.where(better, read[1], sigma)
        return place, sigma, read[2] | good

    def _measure_by_network(self, uv: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same by the measurer."""
        assert self.measurer is not None
        names, shape = self.snapshot.rig.camera_names, radius.shape
        patches, placement = cut_patches(self.frames, names, uv, radius, inverted=self._dark)
        size = (radius / placement.scale).flatten().float()
        said = self.measurer(normalize_crops(patches.flatten(0, 1)), size)
        offset = (said.offset.to(uv) + (placement.size - 1) / 2).view(*shape, 1, 2)
        sigma = (said.log_sigma.exp().to(uv).view(shape).square() + LEAST_MEASURED**2).sqrt() * placement.scale
        good = (said.valid > 0).view(shape) & (sigma < LARGEST_REACH)
        return placement.to_image(offset)[..., 0, :], sigma, good

    def _fit(self, uv: Tensor, radius: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The same by fitting the markers of each camera together."""
        place, sigma, good = uv.clone(), torch.full_like(radius, torch.inf), torch.zeros_like(seen)

        def fit(camera: int) -> None:
            frame = self.frames.get(self.snapshot.rig.camera_names[camera])
            if frame is None:
                return
            sizes, sure = radius[camera].numpy(), seen[camera].numpy()
            found = measure_markers(frame, uv[camera].numpy(), sizes, self._dark, sure)
            place[camera] = torch.from_numpy(np.nan_to_num(found.uv))
            sigma[camera], good[camera] = torch.from_numpy(found.sigma), torch.from_numpy(found.seen)

        each_camera(fit, seen.any(1).nonzero()[:, 0].tolist())
        return place, sigma, good

    @property
    def _dark(self) -> bool:
        return self.snapshot.detection.polarity == "dark"

    def fit(self, looks: NetworkPass, observations: Observations) -> Fit | None:
        """Fit a rig and a pose (1,) to observations (1, C, N); None = too few."""
        if int(observations.seen.sum()) < LEAST_CLAIMS:
            return None
        snapshot = self.snapshot
        widened = replace(observations, sigma=(observations.sigma.square() + MODEL_ERROR**2).sqrt())
        fitted = estimate(
            widened, snapshot.rig, snapshot.obj.as_exact(), looks.poses, prior_std=snapshot.prior_std,
            initial_rig=looks.rig, options=ROBUST,
        )  # fmt: skip
        if not bool(fitted.rig.focal_length.isfinite().all() & fitted.rig_from_object.translation.isfinite().all()):
            return None
        return fitted.rig, fitted.rig_from_object

    def proposal(self, looks: NetworkPass, fitted: Fit | None) -> Proposal:
        """Measure the fiducials that agree with the fitted rig and pose, as labelled blobs.

        Claims that stay vague are left out: an adapted network makes them anywhere in frames of noise.
        """
        snapshot, observations = self.snapshot, self.observations(looks)
        margin, disagree = min(looks.margin, self.most), "found hardly any fiducials that agree with one pose"
        for gate in GATES:
            if fitted is None:
                break
            observations = self.measure(looks, self.expect(*fitted), gate)
            fitted = self.fit(looks, observations)
        if fitted is None:
            return Proposal.decline(snapshot, disagree, margin)
        rig, poses = fitted
        expected = self.expect(rig, poses)
        off = (expected.uv - observations.uv).norm(dim=-1) / (observations.sigma.square() + MODEL_ERROR**2).sqrt()
        seen = (observations.seen & (off < OUTLIER) & (observations.sigma < VAGUE))[0]
        if int(seen.sum()) < LEAST_CLAIMS:
            return Proposal.decline(snapshot, disagree, margin)
        uv, sigma, radius = (values[0].numpy() for values in (observations.uv, observations.sigma, expected.radius))
        rows = proposal_rows(uv, sigma, seen.numpy(), radius, snapshot.blobs)
        return Proposal(rows, poses[0], margin)


def leads_at_border(places: Tensor, probability: Tensor, inside: Tensor) -> Tensor:
    """Compare displacements of a pattern by what they find where the other one expects nothing.

    Displaced by a step, a lattice covers itself except at its border. Where both displacements expect some fiducial,
    the network finds one for either, and differs only in how well lens and perspective fit there.

    Args:
        places: (K, C, N, 2) pixels, where K displacements expect fiducials.
        probability: (K, C, N) that the fiducial is visible there.
        inside: (C, N) fiducials to compare.

    Returns:
        Expected number of fiducials (K, K, C) that the first displacement finds where the second expects none, less
        those of the second.
    """
    count = len(places)
    leads = probability.new_zeros(count, count, places.shape[1])
    for camera, rows in enumerate(inside):
        if rows.sum() < 2:
            continue
        at, found = places[:, camera, rows], probability[:, camera, rows]
        apart = torch.cdist(at[0], at[0]).fill_diagonal_(torch.inf).amin(1).median()
        for first in range(count):
            for second in range(first):
                distance = torch.cdist(at[first], at[second])
                alone = [distance.amin(axis) > SHARED_PLACE * apart for axis in (1, 0)]
                lead = (found[first] * alone[0]).sum() - (found[second] * alone[1]).sum()
                leads[first, second, camera], leads[second, first, camera] = lead, -lead
    return leads


def _mask_frame(frame: np.ndarray | None, mask: np.ndarray | None) -> np.ndarray | None:
    """Paint over the masked parts with the frame's typical value."""
    if frame is None or mask is None:
        return frame
    return np.where(mask, np.median(frame[::8, ::8]).astype(frame.dtype), frame)


def _turn_pose(pose: RigidTransform, obj: CalibrationObject, turns_deg: tuple[float, ...]) -> RigidTransform:
    """Rotate a pose about the object's centre, in both directions about each axis: (H,)."""
    axes = torch.cat((torch.eye(3), -torch.eye(3))).to(pose.rotation)
    vectors = torch.cat([axes * math.radians(angle) for angle in turns_deg])
    centre = obj.points.mean(0).to(pose.rotation)
    rotation = rotation_from_vector(vectors) @ pose.rotation
    return RigidTransform(rotation, pose.rotation @ centre + pose.translation - rotation @ centre)
