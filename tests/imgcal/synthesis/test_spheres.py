import numpy as np
import torch

from imgcal.synthesis.captures import sphere_images


def outline(centre, radius, count=400):
    """Points of a sphere on the circle that a camera at the origin sees as its outline."""
    distance = np.linalg.norm(centre)
    axis = centre / distance
    side = np.linalg.svd(axis[None])[2][1:]
    # The tangent circle: nearer than the centre by r^2 / d, with radius r sqrt(1 - r^2 / d^2).
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    ring = np.cos(turn)[:, None] * side[0] + np.sin(turn)[:, None] * side[1]
    return centre * (1 - (radius / distance) ** 2) + radius * np.sqrt(1 - (radius / distance) ** 2) * ring


def test_outline_of_a_sphere_lies_on_the_ellipse(o10):
    points = torch.tensor([[70.0, -40.0, 820.0], [-60.0, 50.0, 900.0], [0.0, 0.0, 700.0]], dtype=torch.float64)
    radius = torch.tensor([6.0, 12.0, 20.0], dtype=torch.float64)
    shapes = sphere_images(o10, points, radius)
    centres = o10.project(points, radius).uv
    in_cameras = o10.cam_from_rig.apply(points).numpy()
    for camera in range(o10.num_cameras):
        alone = o10.select([camera])
        for n in range(3):
            ring = torch.from_numpy(outline(in_cameras[camera, n], float(radius[n])))
            back = o10.cam_from_rig[camera].inverse().apply(ring)
            offset = (alone.project(back).uv[0] - centres[camera, n]).numpy()
            form = np.einsum("ki,ij,kj->k", offset, np.linalg.inv(shapes[camera, n].numpy()), offset)
            # First order in the distortion across the marker: some 1e-3 of its radius.
            assert np.abs(np.sqrt(form) - 1).max() < 5e-3


def test_batch_shapes(o10):
    points = torch.randn(2, 3, 5, 3, dtype=torch.float64) * 20 + torch.tensor([0.0, 0.0, 850.0])
    rigs = o10.expand(2, 3)
    shapes = sphere_images(rigs, points, torch.full((5,), 6.0, dtype=torch.float64))
    assert shapes.shape == (2, 3, 10, 5, 2, 2)
    assert torch.equal(shapes[1, 2], sphere_images(o10, points[1, 2], torch.full((5,), 6.0, dtype=torch.float64)))
