"""Valid calibrations of other tools, one in each format, to be damaged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from imgcal.formats import FORMATS, Format, convert_rig, from_camera_rig, select_cameras
from imgcal.types import CameraRig

QUALISYS = """<calibration source="x"><cameras>{cameras}</cameras></calibration>"""
QUALISYS_CAMERA = """<camera active="1" serial="{name}" viewrotation="0">
<fov_video bottom="135" left="0" right="255" top="0"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" x="{place}" y="0.0" z="1.0"/>
<intrinsic focallength="9" focalLengthU="12800" focalLengthV="12800" centerPointU="8192" centerPointV="4352" skew="0"
radialDistortion1="-0.04" radialDistortion2="0.01" radialDistortion3="0" tangentalDistortion1="0"
tangentalDistortion2="0.001" sensorMaxU="16383" sensorMinU="0" sensorMaxV="8703" sensorMinV="0"/></camera>
"""
MOTIVE = """<?xml version="1.0" encoding="UTF-16LE"?>
<calibrationProfile><Calibration><Cameras>{cameras}</Cameras></Calibration></calibrationProfile>"""
MOTIVE_CAMERA = """<Camera Serial="{name}"><Attributes ImagerPixelHeight="136" ImagerPixelWidth="256"/>
<Extrinsic OrientMatrix0="1" OrientMatrix1="0" OrientMatrix2="0" OrientMatrix3="0" OrientMatrix4="1" OrientMatrix5="0"
OrientMatrix6="0" OrientMatrix7="0" OrientMatrix8="1" X="{place}" Y="1" Z="2"/>
<IntrinsicStandardCameraModel HorizontalFocalLength="200" VerticalFocalLength="200" LensCenterX="128" LensCenterY="68"
TangentialX="0" TangentialY="0.0001" k1="0.1" k2="-0.1" k3="0"/></Camera>
"""
VICON = """<Cameras VERSION="1">{cameras}</Cameras>"""
VICON_CAMERA = """<Camera DEVICEID="{name}" PIXEL_ASPECT_RATIO="1" SENSOR_SIZE="256 136" SKEW="0"><KeyFrames>
<KeyFrame FOCAL_LENGTH="200" FRAME="0" ORIENTATION="0 0 0.1 0.99" POSITION="{place} 0 1" PRINCIPAL_POINT="128 68"
VICON_RADIAL2="ViconRadial2 128 68 -3e-7 1e-12 0"/></KeyFrames></Camera>
"""
WRITTEN_BY_HAND = {
    "qualisys/a.xml": (QUALISYS, QUALISYS_CAMERA, "utf-8"),
    "motive/a.mcal": (MOTIVE, MOTIVE_CAMERA, "utf-16"),
    "vicon/a.xcp": (VICON, VICON_CAMERA, "utf-8"),
}


def prepare_foreign(folder: Path, rig: CameraRig) -> None:
    """Write a rig in every format that can be written, and small rigs in the read-only formats."""
    bare = replace(from_camera_rig(rig), own=None)
    for one in FORMATS:
        if one.write is None:
            continue
        few = select_cameras(bare, rig.camera_names[: one.cameras[1]])
        place = folder / one.name
        place.mkdir(parents=True)
        for name, content in convert_rig(few, one.name, "rig", limit=5.0).files.items():
            (place / (name or _file_name(one))).write_bytes(content)
    for name, (whole, part, encoding) in WRITTEN_BY_HAND.items():
        cameras = "".join(part.format(name=f"cam{n}", place=200.0 * n) for n in range(3))
        (folder / name).parent.mkdir()
        (folder / name).write_bytes(whole.format(cameras=cameras).encode(encoding))
    lens = {"camera_model_name": "PINHOLE", "camera_params": [200.0, 200.0, 128.0, 68.0]}
    other = {"cam_from_rig_rotation": [1.0, 0, 0, 0], "cam_from_rig_translation": [-0.2, 0, 0]}
    config = [
        {"cameras": [{"image_prefix": "a/", "ref_sensor": True, **lens}, {"image_prefix": "b/", **lens, **other}]}
    ]
    (folder / "colmap-rig-config").mkdir()
    (folder / "colmap-rig-config" / "rig_config.json").write_text(json.dumps(config))


def _file_name(one: Format) -> str:
    """Name a file with its tool's suffix, which determines how it is damaged."""
    suffixes = {"multical": ".json", "pymvg": ".json", "kalibr": ".yaml", "opencv-multiview": ".yaml"}
    return f"calibration{suffixes.get(one.name, '.toml')}"
