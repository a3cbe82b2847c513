from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from imgcal.association import IdentityOptions, Proposal, Sight, Snapshot, associate, judge, proposal_rows
from imgcal.association.proposals import merge_proposal
from imgcal.errors import RefusedError
from imgcal.geometry import RigidTransform, geodesic_angle, rotation_from_vector
from imgcal.io import load_object
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections

TURN = rotation_from_vector(torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64))


@pytest.fixture(scope="module")
def truth(o10, asymmetric8):
    return simulate_truth(o10, asymmetric8, 2, torch.Generator().manual_seed(3), PhysicalDrift())


@dataclass(frozen=True)
class Oracle:
    """Proposes the truth with some noise, or what a test makes of it; snapshots come with their numbers as frames."""

    truth: object
    labels: object = None  # permutation of the fiducials
    margin: float = 100.0
    name: str = "oracle"

    def propose(self, snapshot):
        number = int(snapshot.frames["number"][0, 0])
        uv = self.truth.uv[number].double().numpy()
        uv = uv if self.labels is None else uv[:, self.labels]
        noise = np.random.default_rng(number).normal(0, 0.1, uv.shape)
        some = np.full(uv.shape[:2], 0.1)
        rows = proposal_rows(uv + noise, some, some > 0, 30 * some, snapshot.blobs)
        return Proposal(rows, self.truth.rig_from_object[number], self.margin)


def frames(number):
    return {"number": np.full((1, 1), number)}


def looked_at(truth, obj, rig, proposer, blobs, number=0):
    snapshot = Snapshot(frames(number), blobs, rig, obj, rig.prior.std(rig))
    return judge(proposer.propose(snapshot), snapshot, IdentityOptions(), error=0.3, pose_known=False)


def blobs_of(truth, number=0, share=0.0):
    """Some of the true blobs, without labels."""
    seen = true_detections(truth).of_snapshots(number, number + 1)
    kept = np.random.default_rng(0).random(len(seen)) < share
    return replace(seen.select(kept), fiducial=np.full(int(kept.sum()), -1))


def test_a_right_proposal_is_accepted_without_any_blob(truth, o10, asymmetric8):
    identity, blobs = looked_at(truth, asymmetric8, o10, Oracle(truth), blobs_of(truth))
    assert identity.status == "unique" and len(blobs) == 80 and (blobs.fiducial == -1).all()
    assert (identity.labels >= 0).mean() > 0.95
    assert identity.margin <= 100


def test_labels_are_not_believed(truth, o10, asymmetric8):
    swapped = Oracle(truth, np.array([1, 0, 2, 3, 4, 5, 7, 6]))
    identity, _ = looked_at(truth, asymmetric8, o10, swapped, blobs_of(truth))
    assert not identity.accepted and "agree" in identity.reason


def test_a_wrong_pose_and_a_narrow_margin_are_refused(truth, o10, asymmetric8):
    blobs = blobs_of(truth, share=1.0)
    turned = RigidTransform(truth.rig_from_object.rotation @ TURN, truth.rig_from_object.translation)
    wrong = Oracle(replace(truth, rig_from_object=turned))
    assert not looked_at(truth, asymmetric8, o10, wrong, blobs)[0].accepted
    narrow, _ = looked_at(truth, asymmetric8, o10, Oracle(truth, margin=5.0), blobs)
    assert not narrow.accepted and "margin" in narrow.reason


def test_a_symmetric_object_stays_ambiguous(o10):
    cube8 = load_object("cube8")
    cubes = simulate_truth(o10, cube8, 1, torch.Generator().manual_seed(3), PhysicalDrift())
    identity, _ = looked_at(cubes, cube8, o10, Oracle(cubes), blobs_of(cubes))
    assert (identity.status, identity.alternatives) == ("ambiguous", 24)


def test_where_both_see_one_thing_the_better_measured_stays(truth, o10, asymmetric8):
    blobs = blobs_of(truth, share=1.0)
    snapshot = Snapshot(frames(0), blobs, o10, asymmetric8, o10.prior.std(o10))
    proposed = Oracle(truth).propose(snapshot).detections
    sharp, labels = merge_proposal(replace(proposed, sigma=proposed.sigma / 10), blobs)
    assert len(sharp) == 80 and np.allclose(sharp.sigma, 0.01) and (labels == proposed.fiducial).all()
    dull, labels = merge_proposal(replace(proposed, sigma=proposed.sigma * 5), blobs)
    assert len(dull) == 80 and np.allclose(dull.sigma, 0.1) and (np.sort(labels) == np.sort(proposed.fiducial)).all()
    doubted, _ = merge_proposal(replace(proposed, sigma=proposed.sigma * 20), blobs)  # half hidden, says who looked
    assert len(doubted) == 80 and np.allclose(doubted.sigma, 2.0)
    differing, _ = merge_proposal(
        replace(proposed, uv=proposed.uv + np.array([0.6, 0.8]), sigma=np.full(80, 0.9)), blobs
    )
    assert len(differing) == 80 and (differing.sigma > 0.5).all()  # one of the two is wrong, whatever blobs claim
    apart = replace(proposed, uv=proposed.uv + 12, sigma=np.full(80, 30.0))
    assert len(merge_proposal(apart, blobs)[0]) > 150  # a large sigma hides no blobs that contradict


@pytest.mark.parametrize("where_blobs_fail", [False, True])
def test_what_was_looked_at_is_in_the_table(truth, o10, asymmetric8, where_blobs_fail):
    some = true_detections(truth)
    some = some.select((some.snapshot == 1) | ((some.camera == 0) & (some.fiducial < 3)))  # of the first, three blobs
    given = replace(some, fiducial=np.full(len(some), -1))
    found = associate(given, o10, asymmetric8, sight=Sight(Oracle(truth), frames, where_blobs_fail))
    assert found.identity == "unique" and found.used == [0, 1]
    table = found.detections
    assert len(table) == 160 and (table.fiducial >= 0).mean() > 0.95 and (np.diff(table.snapshot) >= 0).all()
    error = table.uv - truth.uv.double().numpy()[table.snapshot, table.camera, table.fiducial]
    assert np.abs(error[table.fiducial >= 0]).max() < 0.6


def test_hidden_fiducials_among_false_blobs_are_no_objection(truth, o10, asymmetric8):
    """Four of ten markers show, in every camera among as many false blobs as make up for the others."""
    shown = np.random.default_rng(2).permuted(np.arange(80).reshape(10, 8) % 8 < 4, axis=1)
    false = replace(blobs_of(truth, share=1.0), uv=np.random.default_rng(1).uniform((0, 0), (2000, 1000), (80, 2)))
    snapshot = Snapshot(frames(0), false, o10, asymmetric8, o10.prior.std(o10))
    proposal = Oracle(truth).propose(snapshot)
    rows = proposal.detections
    some = replace(proposal, detections=rows.select(shown[rows.camera, rows.fiducial]))
    found, blobs = judge(some, snapshot, IdentityOptions(), error=0.3, pose_known=False)
    labelled = found.labels >= 0
    assert found.accepted and labelled.sum() > 30
    error = blobs.uv[labelled] - truth.uv[0].numpy()[blobs.camera[labelled], found.labels[labelled]]
    assert np.abs(error).max() < 1


@dataclass(frozen=True)
class NearSighted(Oracle):
    """Sees the object only within some degrees of where it is known to be."""

    degrees: float = 3.0

    def propose(self, snapshot):
        pose = self.truth.rig_from_object[int(snapshot.frames["number"][0, 0])]
        off = [float(geodesic_angle(pose.rotation, known.rotation)) for known in snapshot.candidates]
        near = np.degrees(min(off, default=np.pi)) < self.degrees
        return super().propose(snapshot) if near else Proposal.decline(snapshot, "found nothing")


@pytest.mark.parametrize(("degrees", "name"), [(3.0, "oracle"), (0.0, "classical")])
def test_where_a_proposer_finds_nothing_blobs_say_where_to_look_or_decide(truth, o10, asymmetric8, degrees, name):
    """Many fiducials cannot be searched for anywhere; and what blobs know is not lost, though they are asked last."""
    blobs = true_detections(truth)
    given = replace(blobs, fiducial=np.full(len(blobs), -1))
    found = associate(given, o10, asymmetric8, sight=Sight(NearSighted(truth, degrees=degrees), frames, False))
    assert [snapshot.found_by for snapshot in found.snapshots] == [name, name]
    assert found.identity == "unique" and (found.detections.fiducial >= 0).all()


def test_after_many_looks_in_vain_blobs_still_decide(o10, asymmetric8):
    """The object is out of sight at first, and a proposer that never finds it looks no more."""
    truth = simulate_truth(o10, asymmetric8, 12, torch.Generator().manual_seed(3), PhysicalDrift())
    seen = true_detections(truth)
    given = replace(seen, fiducial=np.full(len(seen), -1)).select((seen.snapshot >= 9) | (seen.fiducial < 2))
    found = associate(given, o10, asymmetric8, sight=Sight(NearSighted(truth, degrees=0.0), frames, False))
    assert found.used == [9, 10, 11]


@pytest.mark.parametrize("behind", [False, True])
def test_a_refused_proposal_gives_way_to_the_one_behind_it(truth, o10, asymmetric8, behind):
    """A proposer that is wrong by itself, with the oracle behind it, or nobody."""

    @dataclass(frozen=True)
    class Wrong(Oracle):
        def propose(self, snapshot):
            true = super().propose(snapshot)
            rows = replace(true.detections, fiducial=(true.detections.fiducial + 3) % 8)
            wrong = replace(true, detections=rows, margin=1.0)
            return replace(wrong, otherwise=lambda: replace(true, found_by="other")) if behind else wrong

    given = replace(blobs_of(truth), snapshot_names=("0", "1"))
    if not behind:
        with pytest.raises(RefusedError, match=r"margin of only 1\.0"):
            associate(given, o10, asymmetric8, sight=Sight(Wrong(truth), frames, True))
        return
    found = associate(given, o10, asymmetric8, sight=Sight(Wrong(truth), frames, True))
    assert [snapshot.found_by for snapshot in found.snapshots] == ["other", "other"]
