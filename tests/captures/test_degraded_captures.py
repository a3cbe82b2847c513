"""Real frames, made harder until blobs decide nothing: the whole pattern still shows, and calibrates right."""

import pytest
import torch

import imgcal
from scripts.results.degraded_captures import task
from tests.captures.sets import dot_grid, nominal


def test_a_lattice_is_not_seen_one_dot_aside(captures):
    """In one camera, all but an edge fits as well one dot aside: neither blobs nor the whole pattern are taken so."""
    given = task("cavity", captures)
    frames = given.degraded("discs", 4.0, seed=0)
    assert given.off(imgcal.calibrate(frames, given.rig, given.obj).rig) < 1
    result = imgcal.calibrate(frames, given.rig, given.obj, detector="matched")
    assert dict(result.detectors) == {"matched": 1}
    assert given.off(result.rig) < 1


@pytest.mark.slow
def test_a_network_tells_steps_of_a_lattice_apart_at_its_border(captures):
    """In heavy noise, all but the border is claimed one step aside as well: one camera was labelled so, 19 px off."""
    given = task("dots", captures)
    result = imgcal.calibrate(given.degraded("noise", 40.0, seed=8), given.rig, given.obj, detector="learned")
    assert dict(result.detectors) == {"learned": 1}
    assert given.off(result.rig) < 0.5


def test_many_dots_are_looked_for_where_blobs_say(captures):
    """A hundred dots in any pose are too many for the filter alone: it refused every view that blobs could read."""
    frames, obj = dot_grid(captures)
    dark = imgcal.DetectionOptions(polarity="dark")
    result = imgcal.calibrate({"cam": frames[:8]}, nominal(), obj, detection=dark, detector="matched")
    assert dict(result.detectors) == {"matched": 8}
    # From all 15 views: 540.4 and 541.9 (the captures' README).
    assert (result.rig.focal_length - torch.tensor([[540.4, 541.9]])).abs().max() < 2
