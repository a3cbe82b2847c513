"""Rigs and objects in buffers: they come out as they went in, wherever the module is."""

from dataclasses import replace

import torch

from imgcal.nn.buffers import ObjectBuffers, RigBuffers


def test_a_rig_comes_out_as_it_went_in(rig):
    found = RigBuffers(rig)()
    assert torch.equal(found.focal_length, rig.focal_length)
    assert torch.equal(found.image_size, rig.image_size)
    assert (found.camera_names, found.prior, found.name) == (rig.camera_names, rig.prior, rig.name)
    single = RigBuffers(rig).float()()
    assert single.cam_from_rig.rotation.dtype == torch.float32
    assert single.image_size.dtype == rig.image_size.dtype


def test_an_object_comes_out_as_an_exact_one(obj):
    loose = replace(obj, tolerance=torch.ones(8), radius=torch.full((8,), 3.0))
    found = ObjectBuffers(loose).to("meta")()
    assert found.points.device.type == found.radius.device.type == "meta"
    assert found.exact
    assert found.fiducial_names == obj.fiducial_names


def test_nothing_is_saved(rig, obj):
    assert RigBuffers(rig).state_dict() == ObjectBuffers(obj).state_dict() == {}
