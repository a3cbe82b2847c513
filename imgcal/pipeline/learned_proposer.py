"""A network that finds fiducials in frames: a proposer for frames in which blobs fail.

It looks where candidates of the pose put the object, in all cameras. Where it sees too little it turns the candidate
and lets the evidence of all cameras together decide. What it then claims is turned into a rig and a pose, and it looks
again, with windows that are now centred: cameras that see well so help those that do not. Its claims are proposals:
identity and the most probable rig judge them like blobs.

Objects of many small markers are looked at in tiles. Inside a lattice neighbours look alike one step aside: all tiles
of a camera decide together by which step most of its markers are there, and where that is close the camera is left out.
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

LEAST_PROBABILITY = 0.5  # of a claim
LEAST_SEEN = 0.5  # share of what is asked for, below which other poses are tried
CONVINCING = 0.35  # share of what is in view: a wrong pose shows less of its object by chance
LEAST_CLAIMS = 6  # in all cameras together, to fit a pose to
TURNS_DEG = (7.0, 13.0)  # of the candidate about each axis, where it shows too little
LOOKS = 3  # first the candidate, then what its claims make of it
LEAST_MEASURED = 0.01  # patch pixels: what the measurer cannot know better
LEAST_PRESENT = 0.1  # probability by the network that a fiducial shows, below which it is not measured
GATES = (8.0, 2.5)  # px that a measured place may be off the fitted rig, once and again
LARGEST_REACH = 3.0  # px: larger sigmas give no right to be farther off
LEAST_IN_CAMERA = 3  # fiducials that fit, below which a camera says nothing
LEAST_SIGMA = 0.1  # crop pixels: what the network cannot know better
ROBUST = EstimationOptions(loss="cauchy", threshold=2.0, max_iterations=30, tolerance=1e-2)
MODEL_ERROR = 0.3  # px: what a measured place may be off beyond its own sigma
OUTLIER = 5.0  # standard deviations of a claim from the fitted rig, at which it is dropped
LARGEST_SIGMA = 20.0  # px: where a claim is too vague to be one
TILES_AT_ONCE = 8  # more leave the caches, and fill the memory
STEPS = 9  # displacements of a camera that are compared: none, and the steps of a lattice around it
SAME_PLACE = 4.0  # crop pixels within which two of them claim one place for a fiducial
LEAST_AHEAD = 2.0  # markers that the best one shows more than the next, below which none is known

Fit = tuple[CameraRig, RigidTransform]
"""The most probable rig, and poses (1,)."""


@dataclass(frozen=True)
class LearnedProposer:
    """Proposes what a query network sees."""

    network: InfraredNetwork
    measurer: Measurer | None = None  # reads markers, too; None = all are fitted: those of a camera share one shape
    finder: Proposer | None = None  # asked for a pose where none is known, or the known ones show too little
    name: str = "learned"

    @torch.no_grad()
    def propose(self, snapshot: Snapshot) -> Proposal:
        """Look at one snapshot: around known poses, and if they show too little, where the finder sees the object.

        Where what the network says is refused, what the finder has measured itself is proposed.
        """
        near = self._around(snapshot) if snapshot.candidates else None
        if self.finder is None:
            return near or Proposal.decline(snapshot, "found no pose to look around")
        finder = self.finder
        if near is not None and self._convinces(near, snapshot):
            return replace(near, otherwise=lambda: replace(finder.propose(snapshot), found_by=finder.name))
        found = finder.propose(snapshot)
        if found.rig_from_object is None:
            return near or self._at_origin(snapshot) or Proposal.decline(snapshot, found.reason)
        there = self._around(replace(snapshot, candidates=(found.rig_from_object,)))
        best = there if near is None or len(there.detections) > len(near.detections) else near
        return replace(best, otherwise=lambda: replace(found, found_by=finder.name))

    def _at_origin(self, snapshot: Snapshot) -> Proposal | None:
        """Look where many captures have their object, if it is one of many small markers: the finder gives up on these.

        Others are searched for everywhere.
        """
        origin = RigidTransform.identity(dtype=snapshot.rig.focal_length.dtype)
        size = self.network.config.crop
        if not Tiles.of_object(snapshot.rig, snapshot.obj, RigidTransform.stack((origin,)), size).divided:
            return None
        proposal = self._around(replace(snapshot, candidates=(origin,)))
        return None if proposal.reason else proposal

    def _convinces(self, proposal: Proposal, snapshot: Snapshot) -> bool:
        """Tell whether so much is seen that the object cannot well be elsewhere."""
        if proposal.rig_from_object is None:
            return False
        points = proposal.rig_from_object.apply(snapshot.obj.points)
        in_view = int(snapshot.rig.project(points).visible.sum())
        return len(proposal.detections) > CONVINCING * in_view

    def _around(self, snapshot: Snapshot) -> Proposal:
        view = _View.of(self.network, self.measurer, snapshot)
        poses = RigidTransform.stack(snapshot.candidates)
        view, looks = view.align(poses[:1]) if view.tiles.divided else (view, view.near(poses))
        if view.tiles.divided and not looks.count:
            return Proposal.decline(
                snapshot, "too little of the object is to be seen to tell one step of its pattern from the next"
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
    """Read networks for the frames of any rig and any object.

    Args:
        network: name of a shipped query network, its file, or the folder of the run that trained it.
        measurer: the same of a measurer, for markers that it says it knows better; None = all markers are fitted.
        finder: asked for a pose where none is known.

    Raises:
        InputError: no such file, or something else in it.
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
    frames: Mapping[str, Frame | None]  # without what is masked
    tiles: Tiles
    features: Tensor  # (T, D, G, G)
    most: float = math.inf  # log odds: what is known of whole steps of a pattern bounds what is known of the rest

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

    def expected(self, rig: CameraRig, poses: RigidTransform) -> Expectation:
        """Where poses (H,) put the fiducials."""
        return Expectation.of(rig, self.snapshot.obj, poses, self.tiles.usual)

    def ask(
        self, rig: CameraRig, poses: RigidTransform, window: int | None = None, aside: Tensor | None = None
    ) -> NetworkPass:
        """Ask for all fiducials at poses (H,), or so many crop pixels (C, 2) aside."""
        count, placement = len(poses.rotation), self.tiles.placement
        shift = None
        if aside is not None:
            shift = (placement.scale[:, None] * aside[self.tiles.camera]).expand(count, -1, -1)
        queries = self.tiles.arrange_expected(self.expected(rig, poses)).queries(placement, shift)
        evidence = self._search(queries, count, window)
        asked = queries.asked.unflatten(0, (count, -1))
        return NetworkPass(rig, poses, self.tiles, evidence, claim(evidence, queries.asked), asked)

    def _search(self, queries: Queries, count: int, window: int | None) -> Evidence:
        """Ask for queries (H T, n) of so many poses."""
        if not self.tiles.divided:
            return self.network.search(self.features.repeat(count, 1, 1, 1), queries, window)
        parts = [
            self.network.search(self.features[rows], queries.select(rows), window)
            for rows in torch.arange(len(self.features)).split(TILES_AT_ONCE)
        ]
        return Evidence.cat(parts)

    def align(self, pose: RigidTransform) -> tuple[_View, NetworkPass]:
        """Find by how much each camera sees the object (1,) aside, by which of the steps of its pattern.

        Returns:
            The view, without cameras in which steps cannot be told apart, and a look from there.
        """
        rig, window = self.snapshot.rig, self.network.config.close_window
        steps = self.ask(rig, pose).displacements(STEPS)
        looks = [self.ask(rig, pose, window, aside) for aside in steps]
        found = torch.stack([look.found_in_camera for look in looks])
        best, cameras = found.argmax(0), torch.arange(rig.num_cameras)
        claimed = [self.observations(look) for look in looks]
        uv, seen = torch.cat([each.uv for each in claimed]), torch.cat([each.seen for each in claimed])  # (K, C, N)
        both = seen & seen[best, cameras]
        near = SAME_PLACE * self._join(self.tiles.placement.scale[:, None].expand_as(self.tiles.counts))
        one = both & ((uv - uv[best, cameras]).norm(dim=-1) < near)
        # Steps from which the same markers are seen in the same places are no rivals.
        rivals = found.masked_fill(2 * one.sum(-1) > both.sum(-1), 0.0)
        ahead = found.amax(0) - rivals.amax(0)
        sure = ahead >= LEAST_AHEAD
        most = -math.log(CHANCE) * float(ahead[sure].sum())
        view = replace(self, tiles=self.tiles.select_cameras(sure), most=most)
        return view, view.ask(rig, pose, window, steps[best, cameras])

    def near(self, poses: RigidTransform) -> NetworkPass:
        """Of poses (H,), and where these show too little of others near them, the one that shows most."""
        rig = self.snapshot.rig
        looks = self.best(rig, poses)
        if float(looks.found[0]) < LEAST_SEEN * looks.count:
            tried = self.best(rig, _turn_pose(looks.poses[0], self.snapshot.obj))
            looks = tried if float(tried.found[0]) > float(looks.found[0]) else looks
        return looks

    def best(self, rig: CameraRig, poses: RigidTransform) -> NetworkPass:
        """Of poses (H,) the one that shows most in all cameras together."""
        looks = self.ask(rig, poses)
        return looks if len(poses.rotation) == 1 else self.ask(rig, poses[looks.found.argmax()[None]])

    def observations(self, looks: NetworkPass) -> Observations:
        """What the first pose claims, in image pixels: (1, C, N)."""
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
        """Measure all fiducials where a fitted rig has them (1, C, N), at full scale, as far as the network sees them.

        Args:
            looks: what was claimed: it stands where nothing can be measured.
            expected: by rig and pose.
            gate: pixels that a place may be off, beyond what its sigma explains.
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
        # What fits in hardly any place of a camera may do so by chance.
        seen &= seen.sum(-1, keepdim=True) >= LEAST_IN_CAMERA
        return Observations(uv[None], sigma[None], seen[None])

    def _read(self, uv: Tensor, radius: Tensor, seen: Tensor, last: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Places (C, N, 2), sigmas and whether they are any good (C, N); in the end each by who knows it better."""
        if self.measurer is None:
            return self._fit(uv, radius, seen)
        read = self._by_network(uv, radius)
        if not last:
            return read
        place, sigma, good = self._fit(uv, radius, seen)
        better = read[2] & (~good | (read[1] < sigma))
        place, sigma = torch.where(better[..., None], read[0], place), torch.where(better, read[1], sigma)
        return place, sigma, read[2] | good

    def _by_network(self, uv: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ask the measurer; the same."""
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
        """Fit the markers of each camera together; the same."""
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
        """The most probable rig and pose (1,) that observations (1, C, N) speak for; None = they are too few."""
        if int(observations.seen.sum()) < LEAST_CLAIMS:
            return None
        snapshot = self.snapshot
        widened = replace(observations, sigma=(observations.sigma.square() + MODEL_ERROR**2).sqrt())
        fitted = estimate(
            widened, snapshot.rig, snapshot.obj.taken_as_exact(), looks.poses, prior_std=snapshot.prior_std,
            initial_rig=looks.rig, options=ROBUST,
        )  # fmt: skip
        if not bool(fitted.rig.focal_length.isfinite().all() & fitted.rig_from_object.translation.isfinite().all()):
            return None
        return fitted.rig, fitted.rig_from_object

    def proposal(self, looks: NetworkPass, fitted: Fit | None) -> Proposal:
        """Measure what agrees with the rig and pose that the claims speak for: labelled blobs."""
        snapshot, observations = self.snapshot, self.observations(looks)
        margin = min(looks.margin, self.most)
        for gate in GATES:
            if fitted is None:
                break
            observations = self.measure(looks, self.expected(*fitted), gate)
            fitted = self.fit(looks, observations)
        if fitted is None:
            return Proposal.decline(snapshot, "found hardly any fiducials that agree with one pose", margin)
        rig, poses = fitted
        expected = self.expected(rig, poses)
        off = (expected.uv - observations.uv).norm(dim=-1) / (observations.sigma.square() + MODEL_ERROR**2).sqrt()
        seen = (observations.seen & (off < OUTLIER))[0]
        uv, sigma, radius = (values[0].numpy() for values in (observations.uv, observations.sigma, expected.radius))
        rows = proposal_rows(uv, sigma, seen.numpy(), radius, snapshot.blobs)
        return Proposal(rows, poses[0], margin)


def _mask_frame(frame: np.ndarray | None, mask: np.ndarray | None) -> np.ndarray | None:
    """Paint over where not to look, with what most of the frame looks like."""
    if frame is None or mask is None:
        return frame
    return np.where(mask, np.median(frame[::8, ::8]).astype(frame.dtype), frame)


def _turn_pose(pose: RigidTransform, obj: CalibrationObject) -> RigidTransform:
    """Turn a pose about the object's centre, about each axis both ways: (H,)."""
    axes = torch.cat((torch.eye(3), -torch.eye(3))).to(pose.rotation)
    vectors = torch.cat([axes * math.radians(angle) for angle in TURNS_DEG])
    centre = obj.points.mean(0).to(pose.rotation)
    rotation = rotation_from_vector(vectors) @ pose.rotation
    return RigidTransform(rotation, pose.rotation @ centre + pose.translation - rotation @ centre)
