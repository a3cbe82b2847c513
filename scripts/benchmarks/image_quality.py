"""Are alarms about image quality right? Uneventful hours, a real stream, and cameras that get worse.

`python -m scripts.benchmarks.image_quality` runs all parts, or `--only` some and keeps the others. `hour` and most
faults use labelled blobs of the demo's world, 15 snapshots per second. Their size, sigma and visibility depend on
distance, position, direction and motion, and on arms in front of cameras. `demo` and `covered` run the demo itself
through `RigKeeper`, `frames` its rendered frames through the detector. `stream` is the real stream of ten cameras in
the folder of the captures, from frame 2400 on, after a calibration of the frames before.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

import imgcal
from imgcal.detection import detect
from imgcal.errors import InputError
from imgcal.geometry import RigidTransform
from imgcal.live_page.demonstration import AGED
from imgcal.live_page.rig_drawing import viewing_volume
from imgcal.monitoring import RigBelief
from imgcal.online import Event, ImageQuality, RigKeeper, RigState
from imgcal.synthesis import SimulatedRig
from imgcal.types import CalibrationObject, CameraRig, Detections
from scripts.output import ROOT, command, read_json, surroundings, write_json

RESULT = ROOT / "docs" / "benchmarks" / "image_quality.json"
STREAM = "wand-ten-cameras-stream"
RATE = 15.0  # snapshots per second, as in the demo
QUALITY = ("dirty", "defocused", "clean")
CAMERA, SPOILT_AT = 3, 180.0  # the camera that gets worse, and when (s)
SLOW = 600.0  # s, in which the sigmas of a camera that gets dirty slowly triple
EXPOSURE = 0.002  # s
ARMS_EVERY, ARM_SECONDS = 20.0, 3.0  # s, mean interval and duration of an arm in front of each camera
CHUNK = 900  # snapshots per simulated block


class World:
    """Labelled blobs of the demo's object, with size and sigma, and a fault of one camera.

    Args:
        seed: of all random values.
        fault: fault of `CAMERA`: none, faint, slowly, defocused, missing.
        still: seconds after which the object lies still.
        spoilt_at: seconds after which the camera gets worse.
    """

    def __init__(self, seed: int, fault: str = "none", still: float = np.inf, spoilt_at: float = SPOILT_AT) -> None:
        self.rig, self.obj = imgcal.load_rig("O10").to(torch.float64), imgcal.load_object("asymmetric8")
        volume = viewing_volume(self.rig)
        self._carried = SimulatedRig(self.rig, self.obj, volume.low, volume.high, seed)
        self._random, self.fault, self._still = np.random.default_rng(seed), fault, still
        self._spoilt_at = spoilt_at
        draw, cameras, fiducials = self._random, self.rig.num_cameras, self.obj.num_fiducials
        self._vignetting = draw.uniform(0.2, 0.7, cameras)
        self._focus = draw.uniform(0.8, 1.3, cameras)  # m, focus distance of each camera
        self._lamps = np.exp(0.2 * draw.standard_normal(fiducials))
        self._arms = np.full(cameras, -np.inf)  # s, end of each arm's presence, and which fiducials it hides
        self._hidden = np.zeros((cameras, fiducials), dtype=bool)
        self._belief = RigBelief.of_prior(self.rig, self.obj)

    def states(self, seconds: float) -> Iterator[RigState]:
        """Yield the state that a keeper would return for each snapshot."""
        count = int(seconds * RATE)
        for first in range(0, count, CHUNK):
            times = np.arange(first, min(first + CHUNK, count)) / RATE
            poses = RigidTransform.cat([_batched(self._pose(t)) for t in times])
            before = RigidTransform.cat([_batched(self._pose(t - 0.01)) for t in times])
            points = poses.apply(self.obj.points)
            seen = self.rig.expand(len(times)).project(points, self.obj.radius)
            past = self.rig.expand(len(times)).project(before.apply(self.obj.points), self.obj.radius)
            speed = (seen.uv - past.uv).norm(dim=-1).numpy() / 0.01
            centre, axis = points.mean(-2), poses.rotation[..., 2]
            ray = torch.nn.functional.normalize(self.rig.positions - centre[:, None], dim=-1)
            facing = (ray * axis[:, None]).sum(-1).abs().numpy()
            for row, time in enumerate(times):
                yield self._state(
                    first + row, time, poses[row], seen.uv[row].numpy(), seen.visible[row].numpy(),
                    seen.depth[row].numpy(), speed[row], facing[row],
                )  # fmt: skip

    def _pose(self, time: float) -> RigidTransform:
        return self._carried.pose(min(time, self._still))

    def _state(
        self, number: int, time: float, pose: RigidTransform, uv: NDArray[Any], visible: NDArray[Any],
        depth: NDArray[Any], speed: NDArray[Any], facing: NDArray[Any],
    ) -> RigState:  # fmt: skip
        draw, rig = self._random, self.rig
        half = rig.image_size.double().numpy()[:, None] / 2
        off = np.square(uv / half - 1).sum(-1) / 2
        metres, focal = depth / 1000, rig.focal_length.mean(-1).numpy()[:, None]
        bright = self._lamps * (1 - self._vignetting[:, None] * off) * (0.4 + 0.6 * facing[:, None]) / metres**2
        blur = speed * EXPOSURE
        unsharp = 0.02 * focal * np.abs(1 / metres - 1 / self._focus[:, None]) / 10
        radius = np.sqrt((5.0 * focal / depth) ** 2 + blur**2 / 4 + unsharp**2) * (1 + 0.03 * off) * bright**0.03
        sigma = 0.01 + 0.04 / bright * np.sqrt(1 + np.square(blur / radius))
        seen = visible & (draw.random(visible.shape) > 0.02) & ~self._covered_by_arms(time)
        passed = time - self._spoilt_at
        if passed >= 0:
            if self.fault == "faint":
                sigma[CAMERA] *= 2.0
            elif self.fault == "slowly":
                sigma[CAMERA] *= 1 + 2.0 * min(passed / SLOW, 1.0)
            elif self.fault == "defocused":
                radius[CAMERA] *= 1.25
            elif self.fault == "missing":  # a drop or a smear on the glass: fiducials are seen in places only
                seen[CAMERA] &= draw.random(seen.shape[1]) > 0.4
        camera, fiducial = np.nonzero(seen)
        noise = draw.standard_normal((3, len(camera)))
        blobs = Detections(
            uv=uv[camera, fiducial] + sigma[camera, fiducial, None] * noise[:2].T,
            sigma=sigma[camera, fiducial] * np.exp(0.1 * draw.standard_normal(len(camera))),
            camera=camera,
            snapshot=np.zeros(len(camera), dtype=np.int64),
            fiducial=fiducial,
            radius=radius[camera, fiducial] * np.exp(0.03 * noise[2]),
            flags=np.zeros(len(camera), dtype=np.uint8),
            camera_names=rig.camera_names,
            snapshot_names=(str(number),),
        )
        return made_state(self._belief, blobs, 1.7e9 + time, number, pose, uv)

    def _covered_by_arms(self, time: float) -> NDArray[np.bool_]:
        """Tell which fiducials are hidden from each camera by arms: (C, N) bool."""
        draw = self._random
        begins = (draw.random(len(self._arms)) < 1 / (RATE * ARMS_EVERY)) & (time > self._arms)
        self._arms[begins] = time + draw.exponential(ARM_SECONDS, begins.sum())
        self._hidden[begins] = draw.random((begins.sum(), self._hidden.shape[1])) < draw.uniform(0.2, 0.7)
        return np.asarray(self._hidden & (time < self._arms)[:, None])


def made_state(
    belief: RigBelief, blobs: Detections, time: float, number: int, pose: RigidTransform | None, uv: NDArray[Any]
) -> RigState:
    """Make a state from labelled blobs and a known rig."""
    rig, nothing = belief.rig, np.full(belief.rig.num_cameras, np.nan)
    return RigState(
        time=time, snapshot=number, belief=belief, factory=rig, cameras=dict.fromkeys(rig.camera_names, "ok"),
        sentence="", refused=None, detections=blobs, lag=np.zeros((len(blobs), 2)), predicted=uv, residual=nothing,
        rig_from_object=pose, events=(), clock_offset=nothing, clock_offset_sigma=nothing, noise=nothing, shake=nothing,
        persistent=nothing,
    )  # fmt: skip


def _batched(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(pose.rotation[None], pose.translation[None])


def labelled(seed: int, fault: str, seconds: float, still: float = np.inf) -> list[Event]:
    """Follow the labelled world; return its events."""
    world, events = World(seed, fault, still), list[Event]()
    test = ImageQuality(world.rig.num_cameras)
    for state in world.states(seconds):
        events += test(state, None, None)
    return events


def demo(seed: int, seconds: float, covered_at: float = np.inf, share: float = 1.0) -> list[Event]:
    """Run the keeper on the unlabelled demo at full rate; cover a share of a camera's image."""
    factory, obj = imgcal.load_rig("O10").to(torch.float64), imgcal.load_object("asymmetric8")
    volume, events = viewing_volume(factory), list[Event]()
    true = AGED.apply(factory, torch.Generator().manual_seed(seed))
    simulated = SimulatedRig(true, obj, volume.low, volume.high, seed)
    with RigKeeper(factory, obj) as keeper:
        for number in range(int(seconds * RATE)):
            time = number / RATE
            blobs = simulated.snapshot(time)
            if time >= covered_at:
                left = blobs.uv[:, 0] >= share * factory.image_size[CAMERA, 0].item()
                blobs = blobs.select((blobs.camera != CAMERA) | left)
            events += keeper.update(blobs, 1.7e9 + time).events
    return events


def rendered(seed: int, seconds: float, width: int = 1024) -> list[Event]:
    """Detect blobs in rendered frames of the demo's rig, one snapshot per second, labelled by the ground truth."""
    rig, obj = imgcal.load_rig("O10").to(torch.float64), imgcal.load_object("asymmetric8")
    volume, events = viewing_volume(rig), list[Event]()
    simulated = SimulatedRig(rig, obj, volume.low, volume.high, seed)
    small = rig.resized((rig.image_size.double() * width / rig.image_size[:, :1]).round().long())
    belief, test = RigBelief.of_prior(small, obj), ImageQuality(rig.num_cameras)
    for number in range(int(seconds)):
        simulated.snapshot(float(number))
        pose = simulated.pose(float(number))
        uv = small.project(pose.apply(obj.points), obj.radius).uv.numpy()
        blobs = nearest_labels(detect(simulated.frames(width)), uv)
        events += test(made_state(belief, blobs, 1.7e9 + number, number, pose, uv), None, None)
    return events


def nearest_labels(blobs: Detections, uv: NDArray[Any], within: float = 2.0) -> Detections:
    """Label each blob with the fiducial whose position (C, N, 2) is within this many pixels."""
    distance = np.linalg.norm(uv[blobs.camera] - blobs.uv[:, None], axis=-1)
    label = distance.argmin(1)
    return replace(blobs, fiducial=np.where(distance.min(1) <= within, label, -1))


def stream(captures: Path, step: int) -> list[Event]:
    """Follow the real stream from frame 2400 on, after a calibration of the frames before."""
    folder = captures / STREAM
    factory, obj = imgcal.load_rig(folder / "factory.yaml"), imgcal.load_object(folder / "object.csv")
    blobs = imgcal.load_detections(folder / "detections.csv.gz", factory, obj.num_fiducials)
    frames, events = [int(name) for name in blobs.snapshot_names], list[Event]()
    first = frames.index(2400)
    rig = calibrated(factory, obj, blobs.of_snapshots(0, first), 8)
    with RigKeeper(rig, obj) as keeper:
        for row in range(first, len(frames)):
            if frames[row] % step == 0:
                events += keeper.update(blobs.of_snapshots(row, row + 1), 1.7e9 + frames[row] / 60).events
    return events


def calibrated(factory: CameraRig, obj: CalibrationObject, blobs: Detections, every: int) -> CameraRig:
    """Calibrate from every `every`-th snapshot."""
    some = blobs.select(blobs.snapshot % every == 0)
    names = blobs.snapshot_names[::every]
    result = imgcal.calibrate(replace(some, snapshot=some.snapshot // every, snapshot_names=names), factory, obj)
    return result.rig


def counted(events: list[Event]) -> dict[str, Any]:
    """Count events about image quality, and give the time of the first of each kind and camera."""
    found = [event for event in events if event.kind in QUALITY]
    return {
        "dirty": sum(event.kind == "dirty" for event in found),
        "defocused": sum(event.kind == "defocused" for event in found),
        "events": [[round(float(event.time) - 1.7e9, 2), event.kind, event.camera] for event in found],
    }


def delays(events: list[Event], kind: str, at: float) -> dict[str, Any]:
    """Delay until a fault was reported, and other reports."""
    name = imgcal.load_rig("O10").camera_names[CAMERA]
    right = [event for event in events if event.kind == kind and event.camera == name and event.time >= 1.7e9 + at]
    wrong = [event for event in events if event.kind in QUALITY and event.camera != name]
    early = [event for event in events if event.kind in QUALITY and event.time < 1.7e9 + at]
    return {"seconds": float(right[0].time) - 1.7e9 - at if right else None, "false": len({*wrong, *early})}


def fault(name: str, kind: str, seconds: float = 240.0) -> Callable[[Options], dict[str, Any]]:
    """Make a part with a camera that gets worse."""
    return lambda options: {
        "runs": [delays(labelled(seed, name, SPOILT_AT + seconds), kind, SPOILT_AT) for seed in range(options.seeds)]
    }


@dataclass(frozen=True)
class Options:
    """Measure alarms about image quality."""

    out: Path = RESULT  #: file of the result
    only: tuple[str, ...] = ()  #: parts; none = all
    minutes: float = 60.0  #: duration of the uneventful labelled world; the other worlds run a sixth of it
    seeds: int = 1  #: number of seeds of the labelled world


PARTS: dict[str, Callable[[Options], dict[str, Any]]] = {
    "hour": lambda o: {"runs": [counted(labelled(seed, "none", 60 * o.minutes)) for seed in range(o.seeds)]},
    "object put down": lambda o: {
        "runs": [counted(labelled(seed, "none", 10 * o.minutes, still=100.0 + 10 * seed)) for seed in range(o.seeds)]
    },
    "demo": lambda o: counted(demo(0, 10 * o.minutes)),
    "frames": lambda o: counted(rendered(0, 10 * o.minutes)),
    "stream, every frame": lambda o: counted(stream(captures(), 1)),
    "stream, every third frame": lambda o: counted(stream(captures(), 3)),
    "covered": lambda o: delays(demo(0, 80.0, 60.0), "camera_lost", 60.0),
    "half covered": lambda o: delays(demo(0, 120.0, 60.0, 0.5), "camera_lost", 60.0),
    "fiducials missing": fault("missing", "dirty"),
    "blobs half as bright": fault("faint", "dirty"),
    "slowly dirty": fault("slowly", "dirty", SLOW),
    "defocused": fault("defocused", "defocused"),
}
QUIET = ("hour", "object put down", "demo", "frames", "stream, every frame", "stream, every third frame")
"""Parts without a fault."""


def captures() -> Path:
    """Find the folder of the captures.

    Raises:
        InputError: IMGCAL_CAPTURES is not set.
    """
    if "IMGCAL_CAPTURES" not in os.environ:
        raise InputError("IMGCAL_CAPTURES: found nothing, expected the folder of the captures")
    return Path(os.environ["IMGCAL_CAPTURES"])


def main() -> None:
    """Run the parts, then write and print the results."""
    options = tyro.cli(Options, description=__doc__)
    unknown = [name for name in options.only if name not in PARTS]
    if unknown:
        raise InputError(f"--only: found {unknown[0]!r}, expected one of {', '.join(PARTS)}")
    for name in options.only or tuple(PARTS):
        found = PARTS[name](options)
        known = read_json(options.out)["found"] if options.out.exists() else {}
        known[name] = found
        write_json(options.out, {**surroundings(), "found": {part: known[part] for part in PARTS if part in known}})
        print(name, found, flush=True)


if __name__ == "__main__":
    command(main)
