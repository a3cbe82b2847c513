"""`CameraRig`: moves, resizing, selections."""

from dataclasses import replace

import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_euler
from imgcal.synthesis import PhysicalDrift, PoseRange, synthesize
from imgcal.synthesis.rigs import sample_rig_from_object
from imgcal.types import PARAMETER_NAMES, PARAMETERS, CalibrationObject, CameraRig, RigPrior
from tests.imgcal.types.same_rig import assert_same

SHAPES = [(), (1,), (2, 3), (10,)]  # the last one has as many rigs as cameras


def drifted(rig: CameraRig, *batch: int, seed: int = 0) -> CameraRig:
    return PhysicalDrift(rotation_deg=3).apply(rig, torch.Generator().manual_seed(seed), *batch)


def poses(*batch: int) -> RigidTransform:
    count = torch.Size(batch).numel()
    centroid = torch.zeros(3, dtype=torch.float64)
    return sample_rig_from_object(count, 850.0, centroid, PoseRange(), torch.Generator().manual_seed(5)).reshape(*batch)


@pytest.mark.parametrize("batch", SHAPES)
def test_difference_inverts_moved(o10: CameraRig, batch: tuple[int, ...]) -> None:
    step = torch.rand(*batch, 10, PARAMETERS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = o10.retract(step)
    assert moved.batch_shape == batch
    torch.testing.assert_close(moved.local(o10), step)
    torch.testing.assert_close(moved.cam_from_rig.inverse().translation, moved.positions)


@pytest.mark.parametrize(("name", "index"), [("rotation_y", 1), ("position_x", 3), ("fy", 7), ("cx", 8), ("p1", 12)])
def test_parameter_order(o10: CameraRig, name: str, index: int) -> None:
    assert PARAMETER_NAMES[index] == name
    step = torch.zeros(10, PARAMETERS, dtype=torch.float64)
    step[:, index] = 0.01
    moved = o10.retract(step)
    if name == "rotation_y":
        turn = rotation_from_euler(torch.tensor([0, 0.01, 0], dtype=torch.float64))
        torch.testing.assert_close(moved.cam_from_rig.rotation, turn @ o10.cam_from_rig.rotation)
        torch.testing.assert_close(moved.positions, o10.positions)
        return
    changed = {
        "position_x": (moved.positions - o10.positions)[:, 0],
        "fy": (moved.focal_length - o10.focal_length)[:, 1],
        "cx": (moved.principal_point - o10.principal_point)[:, 0],
        "p1": (moved.distortion - o10.distortion)[:, 2],
    }
    torch.testing.assert_close(changed[name], torch.full((10,), 0.01, dtype=torch.float64))


@pytest.mark.parametrize("batch", SHAPES)
def test_project_equals_camera_by_camera(
    o10: CameraRig, asymmetric8: CalibrationObject, batch: tuple[int, ...]
) -> None:
    rig, rig_from_object = drifted(o10, *batch), poses(*batch)
    found = rig.project(rig_from_object.apply(asymmetric8.points))
    assert found.uv.shape == (*batch, 10, 8, 2)
    assert found.visible.shape == found.depth.shape == (*batch, 10, 8)
    moved = rig.from_object(rig_from_object)
    for camera in range(10):
        one = moved.select([camera]).project(asymmetric8.points.expand(*batch, 8, 3))
        torch.testing.assert_close(one.uv[..., 0, :, :], found.uv[..., camera, :, :], rtol=0, atol=1e-9)


def test_project_broadcasts(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    many_points = poses(2, 3).apply(asymmetric8.points)
    torch.testing.assert_close(o10.project(many_points).uv[1, 2], o10.project(many_points[1, 2]).uv)
    many_rigs = drifted(o10, 4)
    torch.testing.assert_close(many_rigs.project(many_points[0, 0]).uv[3], many_rigs[3].project(many_points[0, 0]).uv)


def test_project_gradcheck(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    step = torch.zeros(2, 3, PARAMETERS, dtype=torch.float64, requires_grad=True)
    points = poses(2).apply(asymmetric8.points).detach().requires_grad_()
    rig = o10.select([0, 4, 7])
    assert torch.autograd.gradcheck(lambda s, p: rig.retract(s).project(p).uv / 1000, (step, points), atol=1e-6)


def test_resizing_keeps_pixel_centres(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    points = poses(3).apply(asymmetric8.points)
    small = o10.resized(torch.tensor([512, 544]))
    full, reduced = o10.project(points), small.project(points)
    scale = torch.tensor([0.25, 0.5], dtype=torch.float64)
    torch.testing.assert_close(reduced.uv + 0.5, scale * (full.uv + 0.5))
    assert torch.equal(reduced.visible, full.visible)
    assert_same(small.resized(o10.image_size), o10)
    assert small.image_size.tolist() == [[512, 544]] * 10


def test_from_object_chains(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    rig_from_object = poses(2, 3)
    torch.testing.assert_close(
        o10.from_object(rig_from_object).project(asymmetric8.points).uv,
        o10.project(rig_from_object.apply(asymmetric8.points)).uv,
    )


def test_select_index_expand_reshape(o10: CameraRig) -> None:
    rig = drifted(o10, 2, 3)
    chosen = rig.select([7, 2])
    assert chosen.camera_names == (o10.camera_names[7], o10.camera_names[2])
    torch.testing.assert_close(chosen.focal_length[1, 0, 0], rig.focal_length[1, 0, 7])
    assert_same(rig.reshape(6)[5], rig[1, 2])
    assert_same(o10.expand(4)[2], o10)
    assert rig.batch_shape == (2, 3)
    as_float = rig.to(torch.float32)
    assert as_float.focal_length.dtype == as_float.cam_from_rig.rotation.dtype == torch.float32
    assert as_float.image_size.dtype == o10.image_size.dtype


def test_prior_standard_deviations(o10: CameraRig) -> None:
    std = RigPrior(focal_length=0.02, principal_point=7, distortion=0.05, rotation=0.01, position=3).std(o10)
    assert std.shape == (10, PARAMETERS)
    expected = torch.tensor(
        [0.01] * 3 + [3] * 3 + [0.02 * 1620, 0.02 * 1621] + [7] * 2 + [0.05] * 5, dtype=torch.float64
    )
    torch.testing.assert_close(std[0], expected)


def test_drifted_rigs_differ(o10: CameraRig, asymmetric8: CalibrationObject) -> None:
    snapshots = synthesize(o10, asymmetric8, 2, torch.Generator().manual_seed(0))
    assert (snapshots.rig[0].local(snapshots.rig[1]).abs().amax(0) > 0).sum() >= 12


def test_a_rig_is_named_on_one_line_and_printed_as_a_table(o10: CameraRig) -> None:
    assert repr(o10) == "CameraRig('O10': 10 cameras, cam01 to cam10)"
    assert repr(o10.select([2])) == "CameraRig('O10': camera cam03)"
    assert str(o10.expand(4, 3)) == repr(o10.expand(4, 3)) == "CameraRig('O10' x (4, 3): 10 cameras, cam01 to cam10)"
    rows = str(o10).splitlines()
    assert len(rows) == 12 and len({len(row) for row in rows[2:]}) == 1
    assert rows[2].split()[:6] == ["cam01", "2048", "x", "1088", "1620.00", "1621.00"]
    wide = torch.nn.functional.pad(o10.distortion[:3], (0, 3))
    mixed = replace(o10.select([0, 1, 2]), distortion=wide, lens_model=("brown_conrady", "equidistant", "rational"))
    lenses = [row.rpartition(": ") for row in str(mixed).splitlines()[2:]]
    assert [before.split()[-1] for before, _, _ in lenses] == ["brown_conrady", "equidistant", "rational"]
    assert [len(after.split(", ")) for _, _, after in lenses] == [5, 4, 8]
