"""pycolmap's bundle adjustment of a rig with constant points, optionally with Gaussian priors by pyceres.

Both minimize with Ceres and COLMAP's analytic costs on one thread. In the camera model FULL_OPENCV, k4, k5 and k6 stay
zero, which leaves the same five distortion coefficients as in the other methods.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from scripts.benchmarks.peer import peer
from scripts.benchmarks.peers.rig_task import Array, RigAnswer, RigTask

AXIS = 1_000_000  # id of a sensor without images that defines the rig's frame, so that every camera can have a prior
DISTORTION = [4, 5, 6, 7, 8]
RATIONAL = [9, 10, 11]


def solve(task: RigTask, *, prior: bool, distortion: bool = True) -> RigAnswer:
    """Adjust the rig.

    Args:
        task: the rig's task.
        prior: add a Gaussian prior on every factory value, as imgcal does (needs pyceres); False leaves all values
            free, in the frame of the first camera.
        distortion: whether to adjust it.
    """
    pycolmap, pyceres = peer("pycolmap"), peer("pyceres")
    assert pycolmap is not None and pyceres is not None
    scene = _scene(pycolmap, task, prior)
    config, options = _settings(pycolmap, scene)
    begin = time.perf_counter()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
    problem = adjuster.problem  # keep a reference: what is added below lives only as long as this
    fixed = RATIONAL if distortion else [*DISTORTION, *RATIONAL]
    for camera in range(len(task.uv[0])):
        problem.set_manifold(scene.cameras[camera + 1].params, pyceres.SubsetManifold(12, fixed))
    if prior:
        _add_prior(problem, scene, task)
    adjuster.solve()
    seconds = time.perf_counter() - begin
    return _answer(scene, len(task.uv[0]), seconds)


def _scene(pycolmap: Any, task: RigTask, prior: bool) -> Any:
    """Make a reconstruction: one rig, a frame for each snapshot, the object as the world."""
    snapshots, cameras, fiducials, _ = task.uv.shape
    scene, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    if prior:
        axis = pycolmap.Camera(model="PINHOLE", width=2, height=2, params=[1, 1, 1, 1], camera_id=AXIS)
        scene.add_camera(axis)
        rig.add_ref_sensor(axis.sensor_id)
    # Without a prior, the first camera is the rig's frame.
    rotation, translation = task.rotation, task.translation
    if not prior:
        rotation = task.rotation @ task.rotation[0].T
        translation = task.translation - rotation @ task.translation[0]
    for c in range(cameras):
        params = np.concatenate((task.focal_length[c], task.principal_point[c], task.distortion[c], np.zeros(3)))
        width, height = task.image_size
        camera = pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params, camera_id=c + 1)
        scene.add_camera(camera)
        if c == 0 and not prior:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, _rigid(pycolmap, rotation[c], translation[c]))
    scene.add_rig(rig)
    ids = [scene.add_point3D(point, pycolmap.Track()) for point in task.points]
    for s in range(snapshots):
        _add_snapshot(pycolmap, scene, task, s, prior)
        for image in range(s * cameras + 1, (s + 1) * cameras + 1):
            for n in range(fiducials):
                scene.add_observation(ids[n], pycolmap.TrackElement(image, n))
    return scene


def _add_snapshot(pycolmap: Any, scene: Any, task: RigTask, s: int, prior: bool) -> None:
    cameras = task.uv.shape[1]
    rotation, translation = task.start_rotation[s], task.start_translation[s]
    if not prior:
        translation = task.rotation[0] @ translation + task.translation[0]
        rotation = task.rotation[0] @ rotation
    frame = pycolmap.Frame(frame_id=s + 1, rig_id=1, rig_from_world=_rigid(pycolmap, rotation, translation))
    images = []
    for c in range(cameras):
        seen = pycolmap.Point2DList([pycolmap.Point2D(place) for place in task.uv[s, c]])
        number = s * cameras + c + 1
        image = pycolmap.Image(name=f"{s}-{c}", camera_id=c + 1, image_id=number, points2D=seen)
        image.frame_id = frame.frame_id
        frame.add_data_id(image.data_id)
        images.append(image)
    scene.add_frame(frame)
    for image in images:
        scene.add_image(image)
    scene.register_frame(frame.frame_id)


def _settings(pycolmap: Any, scene: Any) -> tuple[Any, Any]:
    config = pycolmap.BundleAdjustmentConfig()
    for image in scene.images:
        config.add_image(image)
    for point in scene.point3D_ids():
        config.add_constant_point(point)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.num_threads = 1
    solver.function_tolerance = 1e-6  # Ceres' own default; with COLMAP's zero it would run all 100 iterations
    return config, options


def _add_prior(problem: Any, scene: Any, task: RigTask) -> None:
    """Add a Gaussian prior for every value, scaled to pixels, since COLMAP's residuals are not divided by sigma."""
    pyceres: Any = peer("pyceres")
    costs: Any = peer("pycolmap.cost_functions")
    pycolmap: Any = peer("pycolmap")
    sensors = scene.rigs[1].non_ref_sensors
    for c, variance in enumerate((task.prior_std / task.sigma) ** 2):
        camera = scene.cameras[c + 1]
        intrinsics = np.diag(np.concatenate((variance[6:15], np.ones(3))))
        problem.add_residual_block(pyceres.factors.NormalPrior(camera.params.copy(), intrinsics), None, [camera.params])
        cam_from_rig = sensors[camera.sensor_id].params
        factory = _rigid(pycolmap, task.rotation[c], task.translation[c])
        cost = costs.AbsolutePosePriorCost(np.diag(variance[:6]), factory)
        problem.add_residual_block(cost, None, [cam_from_rig])
        problem.set_parameter_block_variable(cam_from_rig)  # COLMAP fixes it, because the rig's frame has no images


def _answer(scene: Any, cameras: int, seconds: float) -> RigAnswer:
    rig = scene.rigs[1]
    params = np.array([scene.cameras[c + 1].params for c in range(cameras)])
    poses = np.tile(np.eye(3, 4), (cameras, 1, 1))
    for c in range(cameras):
        sensor = scene.cameras[c + 1].sensor_id
        if not rig.is_ref_sensor(sensor):
            poses[c] = rig.sensor_from_rig(sensor).matrix()
    return RigAnswer(params[:, :2], params[:, 2:4], params[:, 4:9], poses[..., :3], poses[..., 3], seconds)


def _rigid(pycolmap: Any, rotation: Array, translation: Array) -> Any:
    return pycolmap.Rigid3d(np.hstack((rotation, translation[:, None])))
