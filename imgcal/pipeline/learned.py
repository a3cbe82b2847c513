"""A network that finds fiducials in frames: a proposer for frames in which blobs fail.

It looks where candidates of the pose put the object, in all cameras. Where it sees too little it turns the candidate
and lets the evidence of all cameras together decide. What it then claims is turned into a rig and a pose, and it looks
again, with windows that are now centred: cameras that see well so help those that do not. Its claims are proposals:
identity and the most probable rig judge them like blobs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from imgcal.association import Proposal, Snapshot, rows_of
from imgcal.detection import Frame
from imgcal.estimation import EstimationOptions, estimate
from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.networks import (
    Claims,
    Evidence,
    Expectation,
    InfraredNetwork,
    Measurer,
    claim,
    cut_crops,
    cut_patches,
    normalized,
)
from imgcal.types import CalibrationObject, CameraRig, CropPlacement, Observations

LEAST_PROBABILITY = 0.5  # of a claim
LEAST_SEEN = 0.5  # share of what is asked for, below which other poses are tried
LEAST_CLAIMS = 6  # in all cameras together, to fit a pose to
TURNS_DEG = (7.0, 13.0)  # of the candidate about each axis, where it shows too little
LOOKS = 3  # first the candidate, then what its claims make of it
LEAST_MEASURED = 0.01  # patch pixels: what the measurer cannot know better
FARTHEST = 3.0  # standard deviations of a claim, beyond its radius, that its marker may be measured off
LEAST_SIGMA = 0.1  # crop pixels: what the network cannot know better
ROBUST = EstimationOptions(loss="geman_mcclure", threshold=4.0, max_iterations=30)
OUTLIER = 5.0  # standard deviations of a claim from the fitted rig, at which it is dropped
LARGEST_SIGMA = 20.0  # px: where a claim is too vague to be one
CHANCE = 0.05  # probability that a window is not what the network takes it for


@dataclass(frozen=True)
class Sighting:
    """What one look says: H poses, C cameras, N fiducials."""

    rig: CameraRig  # that was looked with
    poses: RigidTransform  # (H,)
    evidence: Evidence  # (H C, N)
    claims: Claims  # (H C, N)
    asked: Tensor  # (H, C, N) bool

    @cached_property
    def found(self) -> Tensor:
        """How many fiducials each pose shows, expected: (H,)."""
        return self.claims.probability.view(self.asked.shape).sum((1, 2))

    @cached_property
    def margin(self) -> float:
        """Log odds of the first pose's displacements being none against the best other one, camera by camera."""
        logits, asked = self.evidence.logits, self.asked.flatten(0, 1)
        size = logits.shape[-1]
        probability = functional.avg_pool2d(logits.flatten(2).softmax(-1).unflatten(2, (size, size)), 3, 1, 1) * 9
        present = self.evidence.present.sigmoid()[..., None, None] * (1 - CHANCE)
        even = 9 / size**2
        odds = (present * probability.clamp(max=1) / even + 1 - present).log()
        joint = (odds * asked[..., None, None]).sum(1)  # of all fiducials of a camera, by common displacement
        middle = slice(size // 2 - 3, size // 2 + 3)
        here = joint[:, middle, middle].amax((1, 2))
        joint[:, middle, middle] = -torch.inf
        return float((here - joint.amax((1, 2)).clamp(min=0)).sum())


@dataclass(frozen=True)
class LearnedProposer:
    """Proposes what a query network sees."""

    network: InfraredNetwork
    measurer: Measurer
    name: str = "learned"

    @torch.no_grad()
    def propose(self, snapshot: Snapshot) -> Proposal:
        """Look at one snapshot."""
        if not snapshot.candidates:
            return Proposal.declined(snapshot, "found no pose to look around")
        view = _View.of(self.network, self.measurer, snapshot)
        looks = view.best(snapshot.rig, RigidTransform.stack(snapshot.candidates))
        if float(looks.found[0]) < LEAST_SEEN * float(looks.asked[0].sum()):
            tried = view.best(snapshot.rig, _turned(looks.poses[0], snapshot.obj))
            looks = tried if float(tried.found[0]) > float(looks.found[0]) else looks
        for _ in range(LOOKS - 1):
            fitted = view.fit(looks, view.observations(looks))
            if fitted is None:
                reason = f"found {float(looks.found[0]):.0f} of {int(looks.asked[0].sum())} fiducials in the frames"
                return Proposal.declined(snapshot, reason)
            looks = view.look(*fitted, window=self.network.config.close_window)
        return view.proposal(looks)


@dataclass(frozen=True)
class _View:
    """Crops of all cameras of a snapshot, encoded once."""

    network: InfraredNetwork
    measurer: Measurer
    snapshot: Snapshot
    frames: Mapping[str, Frame | None]  # without what is masked
    placement: CropPlacement  # (C,)
    features: Tensor  # (C, D, G, G)

    @classmethod
    def of(cls, network: InfraredNetwork, measurer: Measurer, snapshot: Snapshot) -> _View:
        rig, size = snapshot.rig, network.config.crop
        poses = RigidTransform.stack(snapshot.candidates)
        placement = Expectation.of(rig, snapshot.obj, poses).placement(rig, size)
        frames = {name: _masked(frame, snapshot.masks.get(name)) for name, frame in snapshot.frames.items()}
        crops = cut_crops(frames, rig.camera_names, placement, inverted=snapshot.detection.polarity == "dark")
        return cls(network, measurer, snapshot, frames, placement, network.encoder(normalized(crops)[:, None]))

    def look(self, rig: CameraRig, poses: RigidTransform, window: int | None = None) -> Sighting:
        """Ask for all fiducials at poses (H,)."""
        count = len(poses.rotation)
        queries = Expectation.of(rig, self.snapshot.obj, poses).queries(self.placement)
        evidence = self.network.search(self.features.repeat(count, 1, 1, 1), queries, window)
        asked = queries.asked.unflatten(0, (count, -1))
        return Sighting(rig, poses, evidence, claim(evidence, queries.asked), asked)

    def best(self, rig: CameraRig, poses: RigidTransform) -> Sighting:
        """Of poses (H,) the one that shows most in all cameras together."""
        looks = self.look(rig, poses)
        return looks if len(poses.rotation) == 1 else self.look(rig, poses[looks.found.argmax()[None]])

    def observations(self, looks: Sighting) -> Observations:
        """What the first pose claims, in image pixels: (1, C, N)."""
        claims, scale = looks.claims, self.placement.scale[:, None]
        uv = self.placement.to_image(claims.place.to(self.placement.corner))
        sigma = (claims.sigma.to(scale).square() + LEAST_SIGMA**2).sqrt() * scale
        seen = (claims.probability > LEAST_PROBABILITY) & (sigma < LARGEST_SIGMA)
        return Observations(uv[None], sigma[None], seen[None])

    def measured(self, observations: Observations, expected: Expectation) -> Observations:
        """Measure what is claimed (1, C, N) at full scale; what cannot be measured stays as it is."""
        inverted = self.snapshot.detection.polarity == "dark"
        uv, radius = observations.uv[0], expected.radius[0]
        patches, placement = cut_patches(self.frames, self.snapshot.rig.camera_names, uv, radius, inverted=inverted)
        size = radius / placement.scale
        said = self.measurer(normalized(patches.flatten(0, 1)), size.flatten().float())
        shape = size.shape
        middle = (placement.size - 1) / 2
        place = placement.to_image((said.offset.to(uv) + middle).view(*shape, 1, 2))[..., 0, :]
        sigma = (said.log_sigma.exp().to(uv).view(shape).square() + LEAST_MEASURED**2).sqrt() * placement.scale
        moved = (place - uv).norm(dim=-1)
        good = (said.valid > 0).view(shape) & (moved < FARTHEST * observations.sigma[0] + radius)
        good &= sigma < observations.sigma[0]
        uv = torch.where(good[..., None], place, uv)
        return Observations(uv[None], torch.where(good, sigma, observations.sigma[0])[None], observations.seen)

    def fit(self, looks: Sighting, observations: Observations) -> tuple[CameraRig, RigidTransform] | None:
        """The most probable rig and pose (1,) that observations (1, C, N) speak for; None = they are too few."""
        if int(observations.seen.sum()) < LEAST_CLAIMS:
            return None
        snapshot = self.snapshot
        fitted = estimate(
            observations, snapshot.rig, snapshot.obj.taken_as_exact(), looks.poses, prior_std=snapshot.prior_std,
            options=ROBUST,
        )  # fmt: skip
        if not bool(fitted.rig.focal_length.isfinite().all() & fitted.rig_from_object.translation.isfinite().all()):
            return None
        return fitted.rig, fitted.rig_from_object

    def proposal(self, looks: Sighting) -> Proposal:
        """Claims that agree with one rig and pose, as labelled blobs."""
        snapshot, expected = self.snapshot, Expectation.of(looks.rig, self.snapshot.obj, looks.poses)
        observations = self.measured(self.observations(looks), expected)
        fitted = self.fit(looks, observations)
        if fitted is None:
            return Proposal.declined(snapshot, "found hardly any fiducial in the frames", looks.margin)
        rig, poses = fitted
        expected = Expectation.of(rig, snapshot.obj, poses)
        off = (expected.uv - observations.uv).norm(dim=-1) / observations.sigma
        seen = (observations.seen & (off < OUTLIER))[0]
        if int(seen.sum()) < LEAST_CLAIMS:
            return Proposal.declined(snapshot, "found no fiducials that agree with one pose", looks.margin)
        uv, sigma, radius = (values[0].numpy() for values in (observations.uv, observations.sigma, expected.radius))
        rows = rows_of(uv, sigma, seen.numpy(), radius, snapshot.blobs)
        return Proposal(rows, poses[0], looks.margin)


def _masked(frame: np.ndarray | None, mask: np.ndarray | None) -> np.ndarray | None:
    """Paint over where not to look, with what most of the frame looks like."""
    if frame is None or mask is None:
        return frame
    return np.where(mask, np.median(frame[::8, ::8]).astype(frame.dtype), frame)


def _turned(pose: RigidTransform, obj: CalibrationObject) -> RigidTransform:
    """Turn a pose about the object's centre, about each axis both ways: (H,)."""
    axes = torch.cat((torch.eye(3), -torch.eye(3))).to(pose.rotation)
    vectors = torch.cat([axes * math.radians(angle) for angle in TURNS_DEG])
    centre = obj.points.mean(0).to(pose.rotation)
    rotation = rotation_from_vector(vectors) @ pose.rotation
    return RigidTransform(rotation, pose.rotation @ centre + pose.translation - rotation @ centre)
