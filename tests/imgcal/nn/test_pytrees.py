"""Value types as trees: leaves are tensors that may be differentiated or mapped, all else is structure."""

from dataclasses import replace

import torch
from torch.utils import _pytree as pytree

from imgcal.geometry import Projection
from imgcal.nn import ProjectRig
from imgcal.types import CalibrationObject, Observations, Prediction, Views


def values(rig, obj, poses):
    uv = torch.rand(2, 4, 8, 2)
    seen = torch.rand(2, 4, 8) > 0.5
    return [
        rig,
        obj,
        CalibrationObject(obj.points, obj.colours, radius=obj.points[:, 0].abs(), scale_tolerance=0.1),
        poses(2),
        Projection(uv, uv[..., 0], seen),
        Observations(uv, uv[..., 0], seen),
        Prediction(rig.expand(2), poses(2)),
        Prediction(rig.expand(2), poses(2), uv[..., 0]),
        Views(uv=uv),
        Views(images=uv),
    ]


def test_trees_are_put_together_again(rig, obj, poses):
    for value in values(rig, obj, poses):
        leaves, spec = pytree.tree_flatten(value)
        assert all(isinstance(leaf, torch.Tensor) for leaf in leaves)
        again = pytree.tree_unflatten(leaves, spec)
        assert type(again) is type(value)
        assert pytree.tree_structure(again) == spec
        assert str(again) == str(value)


def test_constants_tell_trees_apart(rig, poses):
    spec = pytree.tree_structure(rig)
    assert pytree.tree_structure(replace(rig, image_size=rig.image_size.clone())) == spec
    assert pytree.tree_structure(replace(rig, image_size=rig.image_size + 1)) != spec
    assert pytree.tree_structure(replace(rig, name="another")) != spec


def test_structures_are_saved(rig, obj, poses):
    for value in values(rig, obj, poses):
        spec = pytree.tree_structure(value)
        assert pytree.treespec_loads(pytree.treespec_dumps(spec)) == spec


def test_an_exported_module_is_saved(rig, obj, poses, tmp_path):
    program = torch.export.export(ProjectRig(obj), (rig, poses(2)), strict=False)
    torch.export.save(program, tmp_path / "project.pt2")
    loaded = torch.export.load(tmp_path / "project.pt2").module()
    torch.testing.assert_close(loaded(rig, poses(2)).uv, ProjectRig(obj)(rig, poses(2)).uv)


def test_every_name_in_a_path_is_a_field(rig):
    paths = [pytree.keystr(path) for path, _ in pytree.tree_flatten_with_path(rig)[0]]
    assert ".focal_length" in paths
    assert ".cam_from_rig.rotation" in paths
