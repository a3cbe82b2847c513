"""Printed boards as cameras see them: poses that face the cameras, and images of the print through each lens."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from imgcal.geometry import RigidTransform, undistort
from imgcal.synthesis.captures import Frames, Truth
from imgcal.synthesis.rigs import Drift
from imgcal.synthesis.volumes import find_seen_volume, sample_volume
from imgcal.types import Board, CalibrationObject, CameraRig

Floats = NDArray[np.float64]

MOST_TILT = 0.6  # rad between a board and the camera that it faces
FLATTEST = 0.25
"""Cosine of the angle from its normal, below which a camera sees nothing of a board."""
NODES = 8
"""Pixels between rays that the lens is inverted for; those between are interpolated."""
FINER = 3
"""Rays to a pixel, across and down."""
MARGIN = 0.6
"""Of the pitch: white paper around the pattern."""
DOT = 0.3
"""Radius of circles, of the distance between neighbours."""
TEXELS = 60
"""Of a square's side, in OpenCV's picture of a ChArUco board."""
BLACK, WHITE, BACKGROUND = 35.0, 205.0, 70.0
"""Grey values of the print and of what is behind it."""
BLUR, NOISE = 0.7, 2.0
"""Standard deviations: of the lens blur, px, and of the noise, grey levels."""


def simulate_board(
    rig: CameraRig, obj: CalibrationObject, snapshots: int, generator: torch.Generator, drift: Drift | None
) -> Truth:
    """Disturb the rig once, then hold the board so that it faces one camera after the other, tilted and turned.

    Args:
        rig: the factory rig, without batch axes.
        obj: that of a board.
        snapshots: number of poses, S.
        generator: source of randomness.
        drift: how the parameters differ from the factory's; None = not at all.

    Examples:
        >>> import imgcal
        >>> rig, board = imgcal.load_rig("T4"), imgcal.load_object("charuco")
        >>> truth = simulate_board(rig, board, 3, torch.Generator().manual_seed(0), None)
        >>> truth.uv.shape, bool(truth.visible.any())
        (torch.Size([3, 4, 24, 2]), True)
    """
    true_rig = rig if drift is None else drift.apply(rig, generator)
    places = _places(rig, snapshots, generator)
    centroid = obj.points.double().mean(0)
    rotations = []
    for k, place in enumerate(places):
        camera = rig.cam_from_rig.rotation[k % rig.num_cameras].double()
        away = place - rig.positions[k % rig.num_cameras].double()
        facing = _facing(away.numpy(), camera[0].numpy())
        roll, tilt, about = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        angle = 2 * np.pi * about
        axis = np.array([np.cos(angle), np.sin(angle), 0.0]) * MOST_TILT * tilt**0.5
        turn = Rotation.from_euler("z", 2 * np.pi * roll).as_matrix() @ Rotation.from_rotvec(axis).as_matrix()
        rotations.append(facing @ turn)
    rotation = torch.from_numpy(np.stack(rotations))
    poses = RigidTransform(rotation, places - (rotation @ centroid[:, None])[..., 0])
    seen = true_rig.expand(snapshots).project(poses.apply(obj.points.double()))
    toward = poses.translation[:, None] + (rotation @ centroid[:, None]).mT - true_rig.positions.double()
    toward = toward / toward.norm(dim=-1, keepdim=True)
    frontal = (toward * rotation[:, None, :, 2]).sum(-1) > FLATTEST
    visible = seen.visible & frontal[..., None]
    board = obj.board
    if board is not None and not board.is_coded:  # OpenCV finds such boards only as a whole
        visible = visible & visible.all(-1, keepdim=True)
    return Truth(true_rig, poses, seen.uv, visible)


def _places(rig: CameraRig, count: int, generator: torch.Generator) -> torch.Tensor:
    """Where the board's middle is: (count, 3) mm."""
    if rig.volume is None and rig.working_distance is not None:
        # On the axis of one camera after the other, nearer and farther, and to its sides.
        unit = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
        camera = torch.arange(count) % rig.num_cameras
        distance = rig.working_distance * (1 + 0.25 * unit[:, 2])
        reach = 0.25 * rig.image_size[camera].double() / rig.focal_length[camera].double()
        inside = torch.cat((unit[:, :2] * reach, torch.ones_like(unit[:, :1])), 1) * distance[:, None]
        turned = (rig.cam_from_rig.rotation[camera].double().mT @ inside[..., None])[..., 0]
        return rig.positions[camera].double() + turned
    return sample_volume(rig.volume or find_seen_volume(rig), count, generator)


def _facing(away: Floats, right: Floats) -> Floats:
    """Rotation (3, 3) whose z axis points `away` from a camera, and whose x axis is nearly its `right`."""
    z = away / np.linalg.norm(away)
    x = right - z * (right @ z)
    x = x / np.linalg.norm(x)
    return np.stack((x, np.cross(z, x), z), axis=1)


def render_board(board: Board, rig: CameraRig, rig_from_object: RigidTransform, generator: torch.Generator) -> Frames:
    """Render a board into all cameras, each lens as it is, averaging over some rays to a pixel.

    Args:
        board: the print.
        rig: without batch axes.
        rig_from_object: of one pose, without batch axes.
        generator: of the noise.

    Returns:
        Camera name -> (H, W) uint8.
    """
    low, high = _sheet(board)
    outline = np.stack(np.meshgrid(*np.linspace(low, high, 9).T), -1).reshape(-1, 2)
    outline = np.concatenate((outline, np.zeros((len(outline), 1))), 1)
    frames: Frames = {}
    for camera, name in enumerate(rig.camera_names):
        single = rig.select([camera])
        width, height = (int(size) for size in rig.image_size[camera])
        image = np.full((height, width), BACKGROUND)
        cam_from_object = single.cam_from_rig[0] @ rig_from_object
        seen = single.project(rig_from_object.apply(torch.from_numpy(outline)))
        ahead = (cam_from_object.apply(torch.from_numpy(outline))[:, 2] > 1).all()
        facing = float(
            (cam_from_object.translation / cam_from_object.translation.norm()) @ cam_from_object.rotation[:, 2]
        )
        if bool(ahead) and facing > 0:
            uv = seen.uv[0].numpy()
            first = np.clip(np.floor(uv.min(0)) - 2, 0, (width, height)).astype(int)
            last = np.clip(np.ceil(uv.max(0)) + 3, 0, (width, height)).astype(int)
            if (last > first).all():
                image[first[1] : last[1], first[0] : last[0]] = _window(board, single, cam_from_object, first, last)
        image = cv2.GaussianBlur(image, (0, 0), BLUR)
        noise = torch.randn(image.shape, generator=generator, dtype=torch.float32).numpy()
        frames[name] = np.clip(np.rint(image + NOISE * noise), 0, 255).astype(np.uint8)
    return frames


def _window(
    board: Board,
    single: CameraRig,
    cam_from_object: RigidTransform,
    first: NDArray[np.int_],
    last: NDArray[np.int_],
) -> Floats:
    """Grey values (H, W) of the pixels from `first` to `last` (excluded)."""
    columns, rows = last - first
    ray = _rays(single, first, last).reshape(-1, 2)
    ray = np.concatenate((ray, np.ones((len(ray), 1))), 1)
    rotation, translation = cam_from_object.rotation.numpy(), cam_from_object.translation.numpy()
    direction, origin = ray @ rotation, -rotation.T @ translation
    place = np.zeros((len(ray), 2))
    for _ in range(1 if board.bend == (0.0, 0.0) else 3):  # the surface is nearly a plane: fixed points
        depth = (board.deflection_at(place) - origin[2]) / direction[:, 2]
        place = origin[:2] + direction[:, :2] * depth[:, None]
    low, high = _sheet(board)
    sheet = ((place >= low) & (place <= high)).all(1)
    white = is_white(board, place) != board.inverted
    value = np.where(sheet, np.where(white, WHITE, BLACK), BACKGROUND)
    return value.reshape(rows, FINER, columns, FINER).mean((1, 3))


def _rays(single: CameraRig, first: NDArray[np.int_], last: NDArray[np.int_]) -> Floats:
    """Where the rays of a window meet the z = 1 plane: (H FINER, W FINER, 2), between those of a coarser grid."""
    weights, nodes = [], []
    for start, end in zip(first.tolist(), last.tolist(), strict=True):
        fine = (np.arange(FINER * (end - start)) + 0.5) / FINER - 0.5
        count = int(np.ceil((end - start) / NODES)) + 2
        node, share = np.divmod((fine + 1) / NODES, 1)
        weight = np.zeros((len(fine), count))
        weight[np.arange(len(fine)), node.astype(int)] = 1 - share
        weight[np.arange(len(fine)), node.astype(int) + 1] = share
        weights.append(weight)
        nodes.append(start - 1.0 + NODES * np.arange(count))
    uv = torch.from_numpy(np.stack(np.meshgrid(*nodes), -1))
    xy = (uv - single.principal_point[0].double()) / single.focal_length[0].double()
    rays, _ = undistort(xy.reshape(1, -1, 2), single.distortion.double(), single.lens_model)
    grid = rays[0].numpy().reshape(uv.shape)
    return np.stack([weights[1] @ grid[..., axis] @ weights[0].T for axis in range(2)], -1)


def _sheet(board: Board) -> tuple[Floats, Floats]:
    """Corners of the paper: (2,) and (2,) mm."""
    size = np.array([board.columns, board.rows]) * board.pitch
    low = np.zeros(2)
    if board.kind == "circles":
        low, size = board.points[:, :2].min(0) - board.pitch, np.ptp(board.points[:, :2], axis=0) + 2 * board.pitch
    margin = MARGIN * board.pitch
    return low - margin, low + size + margin


def is_white(board: Board, xy: Floats) -> NDArray[np.bool_]:
    """Tell which places (K, 2) mm of a board that is not inverted are white."""
    size = np.array([board.columns, board.rows])
    square = np.floor(xy / board.pitch).astype(np.int64)
    inside = ((square >= 0) & (square < size)).all(1)
    square = np.clip(square, 0, size - 1)
    if board.kind == "checkerboard":
        return ~inside | (square.sum(1) % 2 == 1)
    if board.kind == "circles":
        row = np.clip(np.rint(xy[:, 1] / board.pitch), 0, board.rows - 1)
        wide, shift = (2.0, row % 2) if board.asymmetric else (1.0, 0.0 * row)
        column = np.clip(np.rint((xy[:, 0] / board.pitch - shift) / wide), 0, board.columns - 1)
        nearest = board.pitch * np.stack((wide * column + shift, row), 1)
        apart = board.pitch * (2**0.5 if board.asymmetric else 1.0)
        return np.square(xy - nearest).sum(1) > (DOT * apart) ** 2
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    if board.kind == "charuco":
        ids = np.arange(board.first_id, board.first_id + board.columns * board.rows // 2, dtype=np.int32)
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.pitch, board.marker, dictionary, ids)
        made.setLegacyPattern(board.legacy)
        picture = made.generateImage((board.columns * TEXELS, board.rows * TEXELS), marginSize=0)
        column, row = np.clip(np.floor(xy / board.pitch * TEXELS).astype(np.int64), 0, size * TEXELS - 1).T
        return ~inside | (picture[row, column] > 127)
    bits = dictionary.markerSize + 2 * board.border
    column, row = square.T
    number = np.where(board.from_bottom, board.rows - 1 - row, row) * board.columns + column
    place = xy - square * board.pitch
    cell = np.floor(place / board.marker * bits).astype(np.int64)
    on_tag = inside & ((cell >= 0) & (cell < bits)).all(1)
    cell = np.clip(cell, 0, bits - 1)
    tags = np.stack(
        [
            cv2.aruco.generateImageMarker(dictionary, board.first_id + k, bits, borderBits=board.border)
            for k in range(board.columns * board.rows)
        ]
    )
    return ~on_tag | (tags[number, cell[:, 1], cell[:, 0]] > 127)
