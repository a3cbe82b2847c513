"""Calibrations of other tools as their users have them, with much in them that is no calibration."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from imgcal.formats import ForeignRig
from imgcal.formats.values import quaternion_from_rotation, rotation_from_vector

UPWARD = np.diag([1.0, -1.0, -1.0])


def vicon(rig: ForeignRig) -> bytes:
    """Windows line ends, thresholds, comments, single and double quotes, exponents with three digits."""
    cameras = []
    for camera in rig.cameras:
        w, x, y, z = quaternion_from_rotation(camera.rotation)
        (fx, _), (cx, cy) = camera.lens.focal_length, camera.lens.principal_point
        place = " ".join(f"{value:.12f}" for value in camera.centre)
        radial = f"{cx:.12f} {cy:.12f} -2.9612345678901e-08 1.1212345678901e-014 0"
        cameras.append(
            f'  <Camera DEVICEID=\'{camera.name}\' NAME="top 1 2 3" PIXEL_ASPECT_RATIO="1" SENSOR_SIZE="1280 960" '
            f'SKEW="0" TYPE="VantageV5" USERID="7">\n    <!-- 12.5 lux at 3 m -->\n'
            '    <ThresholdGrid DATA="0 1 1 0 255"/>'
            f'\n    <KeyFrames>\n      <KeyFrame FOCAL_LENGTH="{fx:.12f}" FRAME="0" IMAGE_ERROR="0.118"\n        '
            f'ORIENTATION="{-x:.15f} {-y:.15f} {-z:.15f} {-w:.15f}" POSITION="{place}" '
            f'PRINCIPAL_POINT="{cx:.12f} {cy:.12f}" VICON_RADIAL="-2.9612345678901e-08 1.1212345678901e-014" '
            f'VICON_RADIAL2="ViconRadial2 {radial}" WORLD_ERROR="0.25"/>\n    </KeyFrames>\n  </Camera>\n'
        )
    text = f'<?xml version="1.0" encoding="utf-8"?>\n<Cameras VERSION="6.2">\n{"".join(cameras)}</Cameras>\n'
    return text.replace("\n", "\r\n").encode()


def motive(rig: ForeignRig) -> bytes:
    """UTF-16 with a byte order mark, fifteen decimals."""
    cameras = []
    for camera in rig.cameras:
        axes = (UPWARD @ camera.rotation).T.ravel()
        turned = " ".join(f'OrientMatrix{n}="{value:.15f}"' for n, value in enumerate(axes))
        x, y, z = camera.centre / 1000
        (fx, fy), (cx, cy) = camera.lens.focal_length, camera.lens.principal_point
        k1, k2, p1, p2, k3 = camera.lens.pad(5)
        cameras.append(
            f'<Camera Serial="{camera.name}"\nExposure="250"\nName="Prime 13"\nLed="1"\n>'
            '<Attributes ImagerPixelWidth="1280" '
            f'ImagerPixelHeight="960"/><Extrinsic {turned} X="{x:.15f}" Y="{y:.15f}" Z="{z:.15f}"/>\n'
            f'<IntrinsicStandardCameraModel HorizontalFocalLength="{fx:.15f}" LensCenterX="{cx:.15f}" '
            f'LensCenterY="{cy:.15f}" VerticalFocalLength="{fy:.15f}" TangentialX="{p1:.15f}" TangentialY="{p2:.15f}" '
            f'k1="{k1:.15f}" k2="{k2:.15f}" k3="{k3:.15f}"/></Camera>\n'
        )
    text = (
        '<?xml version="1.0" encoding="UTF-16LE"?>\n<calibrationProfile version="1"><Calibration>'
        '<Date Day="14" Hour="15" Minute="12" Month="4" Second="1" Year="2026"/>\n'
        f"<Cameras>{''.join(cameras)}</Cameras></Calibration><!-- Übung 3 --></calibrationProfile>"
    )
    return b"\xff\xfe" + text.encode("utf-16-le")


def qualisys(rig: ForeignRig) -> bytes:
    """Six decimals and a time of creation."""
    cameras = []
    for camera in rig.cameras:
        axes = UPWARD @ camera.rotation
        x, y, z = camera.centre
        (fx, fy), (cx, cy) = camera.lens.focal_length, camera.lens.principal_point
        k1, k2, p1, p2, k3 = camera.lens.pad(5)
        turned = " ".join(f'r{r + 1}{c + 1}="{axes[r, c]:.9f}"' for r in range(3) for c in range(3))
        cameras.append(
            f'<camera active="1" serial="{camera.name}" avg-residual="0.402" viewrotation="0"><fov_video bottom="959" '
            f'left="0" right="1279" top="0"/>\n<transform {turned} x="{x:.6f}" y="{y:.6f}" z="{z:.6f}"/><intrinsic '
            f'focallength="9.314097" focalLengthU="{fx * 64:.6f}" focalLengthV="{fy * 64:.6f}" '
            f'centerPointU="{cx * 64:.6f}" centerPointV="{cy * 64:.6f}" skew="0" radialDistortion1="{k1:.9f}" '
            f'radialDistortion2="{k2:.9f}" radialDistortion3="{k3:.9f}" tangentalDistortion1="{p1:.9f}" '
            f'tangentalDistortion2="{p2:.9f}" sensorMaxU="81919" sensorMinU="0" sensorMaxV="61439" sensorMinV="0"/>'
            "</camera>\n"
        )
    head = '<?xml version="1.0"?>\n<calibration created="2024-03-05 10:11:12" source="x"><cameras>\n'
    return f"{head}{''.join(cameras)}</cameras></calibration>\n".encode()


def drifted(rig: ForeignRig, seed: int = 0, names: Sequence[str] = ()) -> ForeignRig:
    """Turn, move and refocus cameras a little."""
    generator = np.random.default_rng(seed)
    cameras = []
    for camera in rig.cameras:
        turn, shift, zoom, ks = (generator.normal(size=n) for n in (3, 3, 4, 3))
        if names and camera.name not in names:
            cameras.append(camera)
            continue
        rotation = rotation_from_vector(1e-3 * turn) @ camera.rotation
        size = max(1.0, float(np.linalg.norm(camera.translation)))
        lens = camera.lens
        focal = (lens.focal_length[0] + 0.3 * zoom[0], lens.focal_length[1] + 0.3 * zoom[0] + 0.01 * zoom[1])
        centre = (lens.principal_point[0] + 0.3 * zoom[2], lens.principal_point[1] + 0.3 * zoom[3])
        more = [
            k * (1 + 1e-2 * n) for k, n in zip(lens.coefficients, np.resize(ks, len(lens.coefficients)), strict=True)
        ]
        changed = replace(lens, focal_length=focal, principal_point=centre, coefficients=tuple(more))
        translation = rotation @ -camera.centre + 1e-3 * size * shift
        cameras.append(replace(camera, rotation=rotation, translation=translation, lens=changed))
    return replace(rig, cameras=tuple(cameras))
