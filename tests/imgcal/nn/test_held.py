"""Rigs and objects in modules: they come back as they were, move with the module, and are no state of it."""

from dataclasses import replace

import torch
from torch import nn

from imgcal.nn.held import HeldObject, HeldRig


def test_a_rig_comes_back_and_moves_with_its_module(o10) -> None:
    module = nn.Sequential(HeldRig(o10))
    rig = module[0]()
    for name in ("focal_length", "principal_point", "distortion", "image_size"):
        assert torch.equal(getattr(rig, name), getattr(o10, name)), name
    assert torch.equal(rig.cam_from_rig.rotation, o10.cam_from_rig.rotation)
    assert rig.camera_names == o10.camera_names and rig.prior == o10.prior
    single = module.float()[0]()
    assert {single.focal_length.dtype, single.cam_from_rig.translation.dtype} == {torch.float32}
    assert single.image_size.dtype == o10.image_size.dtype  # whole numbers stay
    assert module.to("meta")[0]().distortion.device.type == "meta"
    assert not module.state_dict()


def test_an_object_comes_back_as_an_exact_one(asymmetric8) -> None:
    for radius in (None, torch.full((8,), 4.0).double()):
        obj = replace(asymmetric8, radius=radius, tolerance=torch.full((8,), 0.1).double())
        module = HeldObject(obj)
        held = module.double()()
        assert torch.equal(held.points, obj.points) and held.exact and held.name == obj.name
        assert (held.radius is None) == (radius is None)
        assert module.float()().points.dtype == torch.float32
        assert not module.state_dict()


def test_what_is_held_is_a_copy(o10) -> None:
    module = HeldRig(o10)
    with torch.no_grad():
        module.focal_length.zero_()
    assert (o10.focal_length > 0).all()
