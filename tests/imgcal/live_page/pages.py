"""States that tests make up, a large rig, and clients that ask for anything."""

import contextlib
import http.client
import json
import time

import numpy as np
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.live_page import Action
from imgcal.monitoring import RigBelief
from imgcal.online import Event, RigState
from imgcal.synthesis import Truth, true_detections
from imgcal.types import CameraRig

ACTIONS = (Action("bump", "Bump it", of_camera=True), Action("warm", "Warm up", undo="Cool down"))


def dome(count: int) -> CameraRig:
    """Cameras spread over a dome of 2.5 m, all of them upright and looking at its middle."""
    number = torch.arange(count).double()
    height, angle = 0.15 + 0.8 * (number + 0.5) / count, number * 2.399963
    level = (1 - height.square()).sqrt()
    centres = 2500.0 * torch.stack((level * angle.cos(), level * angle.sin(), height), -1)
    ahead = -centres / centres.norm(dim=-1, keepdim=True)
    right = torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0]).double().expand_as(ahead))
    right = right / right.norm(dim=-1, keepdim=True)
    rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead), 1)
    return CameraRig(
        focal_length=torch.full((count, 2), 1600.0).double(),
        principal_point=torch.tensor([[639.5, 511.5]]).double().repeat(count, 1),
        distortion=torch.zeros(count, 5).double(),
        cam_from_rig=RigidTransform(rotation, -(rotation @ centres[..., None])[..., 0]),
        image_size=torch.tensor([[1280, 1024]]).repeat(count, 1),
        camera_names=tuple(f"cam{i + 1:02d}" for i in range(count)),
        name="dome",
    )


def made_state(rig, obj, snapshot=0, now=None, health=None, events=(), place=None, **changes):
    """A state of a rig that is as its factory says, with exact blobs."""
    if place is None:
        place = torch.tensor([0.0, 0.0, rig.working_distance or 0.0]).double()
    pose = RigidTransform(rotation_from_vector(torch.tensor([0.2, 0.1, 0.3]).double()), place)
    uv = rig.project(pose.apply(obj.points), obj.radius).uv
    return RigState(
        time=time.time() if now is None else now,
        snapshot=snapshot,
        belief=RigBelief.of_prior(rig, obj),
        factory=rig,
        cameras={name: (health or {}).get(name, "ok") for name in rig.camera_names},
        sentence=changes.pop("sentence", f"all {rig.num_cameras} cameras as calibrated"),
        refused=None,
        detections=true_detections(Truth(rig, pose.reshape(1), uv[None])),
        lag=np.zeros((uv.shape[:-1].numel(), 2)),
        predicted=uv.numpy(),
        residual=np.full(rig.num_cameras, 0.07),
        rig_from_object=pose,
        events=events,
        clock_offset=np.full(rig.num_cameras, np.nan),
        clock_offset_sigma=np.full(rig.num_cameras, np.nan),
        noise=np.zeros(rig.num_cameras),
        shake=np.zeros(rig.num_cameras),
        persistent=np.zeros(rig.num_cameras),
    )


def alarm(camera, snapshot=1, message=None, since=None):
    message = message or f"{camera} turned 0.3 degrees"
    return Event(time.time(), snapshot, "moved", camera, since, "rotation", 0.3, 0.01, "deg", 99.0, message)


class Client:
    """Sends requests as nobody's browser would, too."""

    def __init__(self, page, **headers):
        self.page, self.headers = page, {"Host": f"127.0.0.1:{page.address.port}"} | headers

    def __call__(self, method, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.page.address.port, timeout=60)
        sent = {name.replace("_", "-"): v for name, v in (self.headers | headers).items() if v is not None}
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        for name, value in sent.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        answer = connection.getresponse()
        with contextlib.closing(connection):
            return answer.status, dict(answer.getheaders()), answer.read().decode()

    def token(self):
        return self("GET", "/")[2].split('"token":"')[1].split('"')[0]

    def command(self, content, patient=True, **headers):
        """Send a command; one that comes too early is sent again."""
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        given = {"Content_Type": "application/json", "X_Imgcal_Token": self.token(), "Origin": self.origin} | headers
        while True:
            answer = self("POST", "/command", body, **given)
            if answer[0] != 429 or not patient:
                return answer
            time.sleep(0.1)

    def download(self, path, seconds=60):
        """A download; one that comes too early is asked for again."""
        end = time.monotonic() + seconds
        while (answer := self("GET", path))[0] in (429, 503) and time.monotonic() < end:
            time.sleep(0.3)
        return answer

    @property
    def origin(self):
        return f"http://{self.headers['Host']}"


class Stream:
    """Reads the stream of server-sent events."""

    def __init__(self, page):
        self._connection = http.client.HTTPConnection("127.0.0.1", page.address.port, timeout=60)
        self._connection.request("GET", "/stream")
        self._answer = self._connection.getresponse()

    def wait(self, kind, until=lambda content: True):
        """The first message of a kind that is as expected."""
        name, end = None, time.monotonic() + 120
        while time.monotonic() < end:
            line = self._answer.readline().decode().rstrip("\n")
            if line.startswith("event: "):
                name = line[7:]
            elif line.startswith("data: ") and name == kind:
                content = json.loads(line[6:])
                if until(content):
                    return content
        raise AssertionError(f"no {kind} as expected")

    def close(self):
        self._answer.close()
        self._connection.close()
