"""Send the blobs of a simulated rig to `imgcal watch ADDRESS --rig T4 --object asymmetric8`; a camera is bumped later.

Usage: python scripts/examples/send_blobs.py tcp://127.0.0.1:5555 [SNAPSHOTS]. A real sender needs only the lines with
zmq and json.
"""

import json
import math
import sys
import time

import torch
import zmq

import imgcal
from imgcal.geometry import RigidTransform, rotation_from_vector

RATE = 60.0  # snapshots a second

rig, obj = imgcal.load_rig("T4"), imgcal.load_object("asymmetric8")
bump = torch.zeros(rig.num_cameras, 15, dtype=torch.float64)
bump[1, 0] = math.radians(0.3)  # the second camera turns by 0.3 degrees
snapshots = int(sys.argv[2]) if len(sys.argv) > 2 else 100_000

with zmq.Context() as context, context.socket(zmq.PUB) as socket:  # a publisher never waits for its readers
    socket.bind(sys.argv[1])
    began = time.monotonic()
    for snapshot in range(snapshots):
        swing = [math.sin(snapshot * rate) for rate in (0.011, 0.017, 0.023, 0.013, 0.019, 0.007)]
        turn, shift = torch.tensor(swing, dtype=torch.float64).split(3)
        place = torch.tensor([0.0, 0.0, rig.working_distance], dtype=torch.float64) + 40.0 * shift
        points = RigidTransform(rotation_from_vector(0.4 * turn), place).apply(obj.points)  # mm, in the rig
        seen = (rig if snapshot < 1200 else rig.retract(bump)).project(points, obj.radius)
        now = time.time()
        for camera, name in enumerate(rig.camera_names):
            uv = seen.uv[camera][seen.visible[camera]]
            blobs = (uv + 0.05 * torch.randn_like(uv)).tolist()
            socket.send_string(json.dumps({"camera": name, "time": now, "uv": blobs, "sigma": 0.05}))
        time.sleep(max(0.0, began + (snapshot + 1) / RATE - time.monotonic()))  # the work takes time too
