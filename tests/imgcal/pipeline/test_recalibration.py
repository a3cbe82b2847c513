import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from imgcal.association import Proposal, Sight, proposal_rows
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import relative_covariance
from imgcal.networks import InfraredNetwork
from imgcal.pipeline import LearnedProposer, calibrate, score
from imgcal.synthesis import PhysicalDrift, Truth, simulate_truth, true_detections


def capture(rig, obj, snapshots=6, noise=0.05, seed=0):
    """True rig, and labelled detections with noise and the sigma that it has."""
    truth = simulate_truth(rig, obj, snapshots, torch.Generator().manual_seed(seed), PhysicalDrift())
    table = true_detections(truth)
    table.uv[:] += noise * np.random.default_rng(seed).standard_normal(table.uv.shape)
    table.sigma[:] = max(noise, 1e-3)
    return truth.rig, table


def test_an_honest_calibration(o10, asymmetric8):
    truth, table = capture(o10, asymmetric8)
    result = calibrate(table, o10, asymmetric8)
    assert result.additive_noise == 0 and result.outliers <= 2 and not result.prior_scale
    assert 0.8 < result.chi2_per_dof < 1.2
    assert result.rig.local(truth)[:, 6:8].abs().max() < 0.2 * o10.local(truth)[:, 6:8].abs().max()
    assert result.before.rms > 50 * result.rms
    assert len(repr(result)) < 250 and "identity coded, 6 of 6 snapshots" in repr(result)
    covariance = result.estimate.covariance(reference=2)
    assert torch.equal(covariance, relative_covariance(result.estimate, 2))
    focal = covariance.diagonal().unflatten(0, (-1, 15))[:, 6:8].sqrt()
    assert ((result.rig.focal_length - truth.focal_length).abs() < 5 * focal).all()


def test_a_rig_with_gradients_is_taken_as_it_is(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 3, torch.Generator().manual_seed(1), PhysicalDrift())
    blobs = true_detections(truth)
    traced = replace(o10, focal_length=o10.focal_length.clone().requires_grad_())
    found = calibrate(blobs, traced, asymmetric8)
    assert not found.rig.focal_length.requires_grad
    assert torch.equal(found.rig.focal_length, calibrate(blobs, o10, asymmetric8).rig.focal_length)
    assert float(score(blobs, traced, asymmetric8).distances.mean()) > 5
    with pytest.raises(InputError, match="points that require gradients"):
        calibrate(blobs, o10, replace(asymmetric8, points=asymmetric8.points.clone().requires_grad_()))


FORKED = """
import multiprocessing, sys, torch, imgcal
from imgcal.synthesis import PhysicalDrift, simulate_truth, true_detections
torch.set_num_threads(2)
rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
truth = simulate_truth(rig, obj, 200, torch.Generator().manual_seed(1), PhysicalDrift())
blobs = true_detections(truth)
def calibrate():
    return imgcal.calibrate(blobs, rig, obj).rig.focal_length
def check(expected):
    sys.exit(0 if torch.allclose(calibrate(), expected, rtol=1e-9, atol=0) else 1)
process = multiprocessing.get_context("fork").Process(target=check, args=(calibrate(),))
process.start()
process.join(60)
print(process.exitcode)
process.kill()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not fork")
def test_a_forked_process_calibrates_like_its_parent():
    assert subprocess.run([sys.executable, "-c", FORKED], capture_output=True, check=True).stdout == b"0\n"


@pytest.mark.parametrize("hidden", [0.15, 0.4])
def test_noise_that_the_blobs_do_not_know_is_measured(hidden, o10, asymmetric8):
    _, table = capture(o10, asymmetric8, noise=0.0)
    table.uv[:] += hidden * np.random.default_rng(1).standard_normal(table.uv.shape)
    table.sigma[:] = 0.02
    result = calibrate(table, o10, asymmetric8)
    assert result.additive_noise == pytest.approx(hidden, rel=0.15)
    assert 0.75 < result.chi2_per_dof < 1.3


def test_gross_outliers_are_left_out(o10, asymmetric8):
    truth, table = capture(o10, asymmetric8)
    bad = np.random.default_rng(2).choice(len(table), 20, replace=False)
    table.uv[bad] += (7.0, -5.0)
    result = calibrate(table, o10, asymmetric8)
    assert 20 <= result.outliers <= 26
    assert result.rms < 0.085
    assert (result.rig.local(truth)[:, 6:8]).abs().max() < 3


def test_two_cameras_swapped_is_refused(o10, asymmetric8):
    _, table = capture(o10, asymmetric8)
    swapped = np.where(table.camera == 2, 3, np.where(table.camera == 3, 2, table.camera))
    with pytest.raises(RefusedError, match="factory value"):
        calibrate(replace(table, camera=swapped), o10, asymmetric8)


def test_a_camera_of_another_moment_is_refused(o10, asymmetric8):
    _, table = capture(o10, asymmetric8)
    late = np.where(table.camera == 4, (table.snapshot + 1) % 6, table.snapshot)
    with pytest.raises(RefusedError):
        calibrate(replace(table, snapshot=late), o10, asymmetric8)


def test_a_refusal_names_what_python_offers(o10, asymmetric8):
    _, table = capture(o10, asymmetric8)
    with pytest.raises(RefusedError, match=r"PipelineOptions\(blind_cameras=True\)") as refusal:
        calibrate(table.select(table.camera != 3), o10, asymmetric8)
    assert "--" not in str(refusal.value) and "--blind-cameras" in refusal.value.for_command


@dataclass(frozen=True)
class Oracle:
    """Proposes the truth; snapshots come with their numbers as frames."""

    truth: Truth
    name: str = "oracle"

    def propose(self, snapshot):
        number = int(snapshot.frames["number"][0, 0])
        some = np.full(self.truth.uv.shape[1:3], 0.1)
        rows = proposal_rows(self.truth.uv[number].numpy(), some, some > 0, 30 * some, snapshot.blobs)
        return Proposal(rows, self.truth.rig_from_object[number], 100.0)


def test_where_a_calibration_from_blobs_is_refused_the_frames_are_looked_at(o10, asymmetric8):
    """Blobs tell the pose in every snapshot, and yet they do not suffice: one camera shows none."""
    truth = simulate_truth(o10, asymmetric8, 2, torch.Generator().manual_seed(0), PhysicalDrift())
    seen = true_detections(truth)
    blobs = replace(seen, fiducial=np.full(len(seen), -1)).select(seen.camera != 3)
    with pytest.raises(RefusedError, match="found no fiducial"):
        calibrate(blobs, o10, asymmetric8)
    sight = Sight(Oracle(truth), lambda number: {"number": np.full((1, 1), number)}, where_blobs_fail=True)
    result = calibrate(blobs, o10, asymmetric8, detector=sight)
    assert dict(result.detectors) == {"oracle": 2}
    assert dict(
        calibrate(replace(seen, fiducial=np.full(len(seen), -1)), o10, asymmetric8, detector=sight).detectors
    ) == {"classical": 2}


class WithoutCamera3(LearnedProposer):
    """Proposes the truth, but nothing in one camera: every snapshot is identified, and no rig can be calibrated."""

    def propose(self, snapshot):
        assert self.finder is not None
        whole = self.finder.propose(snapshot)
        return replace(whole, detections=whole.detections.select(whole.detections.camera != 3))


def test_where_a_calibration_from_a_network_is_refused_its_finder_decides(o10, asymmetric8):
    truth = simulate_truth(o10, asymmetric8, 2, torch.Generator().manual_seed(0), PhysicalDrift())
    blobs = true_detections(truth)
    blobs = replace(blobs, fiducial=np.full(len(blobs), -1)).select(blobs.camera != 3)
    network = WithoutCamera3(InfraredNetwork(), finder=Oracle(truth))
    sight = Sight(network, lambda number: {"number": np.full((1, 1), number)}, where_blobs_fail=False)
    result = calibrate(blobs, o10, asymmetric8, detector=sight)
    assert dict(result.detectors) == {"oracle": 2}
