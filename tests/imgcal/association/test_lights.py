"""Unknown markers: which blobs belong together, and rigs that are aligned to blobs without labels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from imgcal.association import align_camera, align_rig, associate_lights, background_rows, image_error, predicted_misses
from imgcal.estimation import relative_difference
from imgcal.types import CameraRig
from scripts.benchmarks.lights import Scene, simulate


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate(markers=15, moments=16, drift=1.0, seed=1)


def wrong_labels(scene: Scene, row: np.ndarray) -> tuple[int, int]:
    """Blobs that are put together with those of another marker, and all that are put together."""
    wrong = 0
    for blobs in row:
        labels = scene.fiducial[blobs[blobs >= 0]]
        counts = np.bincount(labels[labels >= 0], minlength=1)
        wrong += len(labels) - int(counts.max())
    return wrong, int((row >= 0).sum())


def test_right_rig_puts_blobs_together(scene: Scene) -> None:
    found = associate_lights(scene.detections, scene.rig, np.full(10, 0.4))
    wrong, total = wrong_labels(scene, found.row)
    assert wrong <= 0.002 * total
    assert total >= 0.95 * (scene.fiducial >= 0).sum()
    for row, moment in zip(found.row, found.moment, strict=True):
        assert (scene.detections.snapshot[row[row >= 0]] == moment).all()


def test_one_moment_is_a_row_of_many(scene: Scene) -> None:
    whole = associate_lights(scene.detections, scene.rig, np.full(10, 0.4))
    alone = scene.detections.of_snapshots(5, 6)
    found = associate_lights(alone, scene.rig, np.full(10, 0.4))
    assert np.allclose(found.point, whole.point[whole.moment == 5])


def test_no_blobs_are_no_markers(scene: Scene) -> None:
    nothing = scene.detections.select(np.zeros(len(scene.detections), dtype=bool))
    assert len(associate_lights(nothing, scene.rig, np.full(10, 0.4))) == 0


def test_two_cameras_are_no_witness(scene: Scene) -> None:
    two = scene.detections.select(scene.detections.camera < 2)
    assert len(associate_lights(two, scene.rig, np.full(10, 0.4))) == 0


def test_alignment_makes_labels_possible(scene: Scene) -> None:
    error = np.full(10, 3.0)
    std = scene.factory.prior.std(scene.factory)  # type: ignore[union-attr]
    before = associate_lights(scene.detections, scene.factory, error)
    aligned, _ = align_rig(scene.detections, scene.factory, std)
    after = associate_lights(scene.detections, aligned, error)
    wrong, total = wrong_labels(scene, after.row)
    assert total > 3 * (before.row >= 0).sum()
    assert wrong < 0.05 * total


def test_a_camera_finds_its_place_among_the_others(scene: Scene) -> None:
    std = scene.factory.prior.std(scene.factory)  # type: ignore[union-attr]
    others = scene.detections.select(scene.detections.camera != 4)
    lights = associate_lights(others, scene.rig, np.full(10, 0.4))
    step = scene.factory.local(scene.rig)
    step[[camera for camera in range(10) if camera != 4]] = 0
    lost = scene.rig.retract(step)  # this camera is as the factory has it
    found = align_camera(scene.detections, scene.factory, std, lost, 4, lights)
    points = scene.points[:, :3].flatten(0, 1)

    def off(rig: CameraRig) -> float:
        missed = rig.select([4]).project(points).uv - scene.rig.select([4]).project(points).uv
        return float(missed.norm(dim=-1).median())

    assert off(lost) > 3
    assert off(found) < 1.0
    assert bool((relative_difference(found.select([0, 1, 2, 3]), scene.rig.select([0, 1, 2, 3])).abs() < 1e-9).all())


def test_held_out_cameras_tell_right_rigs_from_wrong_ones(scene: Scene) -> None:
    error = np.full(10, 0.4)
    others = scene.detections.select(scene.detections.camera != 2)
    lights = associate_lights(others, scene.rig, error)
    total, found, beside = predicted_misses(lights, scene.detections, scene.rig, 2, error, 4.0, 24.0)
    assert total > 100
    assert found > 0.6
    assert abs(beside) < 0.05
    step = torch.zeros(10, scene.rig.num_parameters, dtype=torch.float64)
    step[2, 8] = 4.0  # px
    total, found, beside = predicted_misses(lights, scene.detections, scene.rig.retract(step), 2, error, 4.0, 24.0)
    assert found < 0.1
    assert beside > 0.5


def test_error_in_the_image_grows_with_the_prior(scene: Scene) -> None:
    std = scene.factory.prior.std(scene.factory)  # type: ignore[union-attr]
    assert np.allclose(image_error(scene.factory, 2 * std), 2 * image_error(scene.factory, std))


def test_lamps_are_background(scene: Scene) -> None:
    detections, moments = scene.detections, len(scene.detections.snapshot_names)
    random = np.random.default_rng(0)
    lamp = np.array([[700.0, 300.0]]) + 0.1 * random.standard_normal((moments, 2))

    def more(column: np.ndarray, values: object) -> np.ndarray:
        return np.concatenate((column, np.broadcast_to(np.asarray(values, dtype=column.dtype), (moments,))))

    lit = replace(
        detections,
        uv=np.concatenate((detections.uv, lamp)),
        sigma=more(detections.sigma, 0.1),
        camera=more(detections.camera, 3),
        snapshot=more(detections.snapshot, np.arange(moments)),
        fiducial=more(detections.fiducial, -1),
        radius=more(detections.radius, np.nan),
        flags=more(detections.flags, 0),
    )
    marked = background_rows(lit)
    assert marked[-moments:].all()
    assert not marked[:-moments].any()
