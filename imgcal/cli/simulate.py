"""`imgcal simulate`: a synthetic capture with its truth."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from imgcal.cli.common import check_folder, open_rig, progress
from imgcal.errors import InputError
from imgcal.geometry import vector_from_rotation
from imgcal.io import (
    load_object,
    publishing,
    save_capture_settings,
    save_detections,
    save_object,
    save_rig,
    write_frame,
    write_text,
)
from imgcal.messages import shortened
from imgcal.synthesis import (
    DIFFICULTIES,
    Drift,
    FrameModel,
    HandHeld,
    PhysicalDrift,
    PoseRange,
    RelativeDrift,
    Truth,
    simulate_shots,
    simulate_truth,
    simulate_volume,
    true_detections,
)
from imgcal.types import FIDUCIAL_RADIUS, CalibrationObject, CameraRig
from renderers import ClutterModel, SensorModel

Level = Literal["clean", "low-light", "motion-blur", "clutter", "defocus", "combined", "half-hidden", "uneven"]
WRITTEN = ("capture.yaml", "rig.yaml", "object.csv", "truth", "frames")

MOST_SNAPSHOTS = 100_000


@dataclass(frozen=True)
class Simulate:
    """Make a capture: one rig that has drifted from its factory calibration, seen through realistic infrared frames.

    Writes OUT/frames/<camera>/<snapshot>.png, the factory rig and the object beside them, and OUT/truth/ with the
    drifted rig, the exact image points (labelled), the object's poses and how much of each marker is seen (seen.csv).
    --difficulty makes frames that are hard: dim, blurred by motion, out of focus, cluttered, with half-hidden markers.
    Without other options, the rig drifts by half a degree, 2 mm, 1 % and 5 px (one standard deviation: --physical.*).
    Examples: imgcal simulate --rig O10 --object asymmetric8 --out my_capture --snapshots 20
    imgcal simulate --rig room10 --object wand4 --out wand --snapshots 100 --poses hand-held --exposure-ms 2
    """

    rig: str  #: factory rig: file, or the name of a shipped one (O10, O6, U7, T4, room10)
    object: str  #: object: file, or the name of a shipped one (asymmetric8, cube8, cube27, sphere64, wand4)
    out: Path  #: folder to write; must not hold a capture yet
    snapshots: int = 10  #: number of poses of the object
    seed: int = 0  #: the same seed gives the same capture
    drift: Literal["physical", "relative", "none"] | None = None
    """physical = degrees, mm and pixels, the default; relative = the paper's value * (1 + delta), as with --kappa"""
    kappa: float | None = None
    """the paper's drift: the largest relative change of intrinsics, positions and Euler angles, 0.025 with --drift
    relative alone; of cameras that face each other, some Euler angles are large, and such cameras turn far"""
    physical: PhysicalDrift = field(default_factory=PhysicalDrift)  # standard deviations for --drift physical
    poses: Literal["hemisphere", "volume", "hand-held"] | None = None
    """where the object is: hemisphere = always at the rig's working_distance, turned, and in view of every camera (the
    paper's); volume = anywhere in the rig's volume, in view of some; hand-held = on a smooth way through it. Default:
    volume where the rig file has one or has no working_distance, and hemisphere elsewhere"""
    hand: Annotated[HandHeld, tyro.conf.arg(name="")] = field(default_factory=HandHeld)
    exposure_ms: float = 0.0  #: ms, during which the markers of a hand-held object are smeared, as fast as they move
    theta_deg: tuple[float, float] = (0.0, 360.0)  #: azimuth of the rig around the object, on the hemisphere
    phi_deg: tuple[float, float] = (0.0, 90.0)  #: angle of the rig from the object's z axis, on the hemisphere
    alpha_deg: tuple[float, float] = (0.0, 360.0)  #: roll of the rig, on the hemisphere
    marker_radius: float = 6.0  #: mm, for objects whose file gives no radius
    clutter: bool = True  #: reflections, false blobs, partly hidden markers
    difficulty: Level | None = None  #: a named level; its light and clutter replace those of the options below
    sensor: SensorModel = field(default_factory=SensorModel)
    clutter_model: ClutterModel = field(default_factory=ClutterModel)

    def run(self) -> None:
        """Simulate and write."""
        for name, least, most in (("snapshots", 1, MOST_SNAPSHOTS), ("seed", 0, 2**63 - 1)):
            if not least <= getattr(self, name) <= most:
                found = shortened(str(getattr(self, name)))
                raise InputError(f"--{name}: found {found}, expected at least {least} and at most {most}")
        if not FIDUCIAL_RADIUS.low <= self.marker_radius <= FIDUCIAL_RADIUS.high:
            raise InputError(f"--marker-radius: found {self.marker_radius}, expected {FIDUCIAL_RADIUS}")
        for name in ("theta_deg", "phi_deg", "alpha_deg"):
            low, high = getattr(self, name)
            if not -360 <= low <= high <= 360:
                option = name.replace("_", "-")
                raise InputError(
                    f"--{option}: found {low} {high}, expected two from -360 to 360, the smaller angle first"
                )
        if not 0 <= self.exposure_ms <= 1000:
            raise InputError(f"--exposure-ms: found {self.exposure_ms:g}, expected 0 to 1000 ms")
        check_folder(self.out)
        if any((self.out / name).exists() for name in ("frames", "truth")):
            raise InputError(f"{self.out}: found a capture there already, expected a new folder")
        rig, obj = open_rig(self.rig), load_object(self.object)
        generator = torch.Generator().manual_seed(self.seed)
        truth = self._truth(rig, obj, generator)
        with publishing(self.out, WRITTEN, mark="frames") as out:
            self._write(truth, rig, obj, generator, out)
        print(f"{self.snapshots} snapshots of {rig.num_cameras} cameras written to {self.out}", file=sys.stderr)

    def _write(
        self, truth: Truth, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator, out: Path
    ) -> None:
        save_capture_settings(out, self.sensor.bit_depth, note=f"simulated, seed {self.seed}")
        save_rig(rig, out / "rig.yaml")
        save_object(obj, out / "object.csv")
        _write_truth(truth, out / "truth")
        level = None if self.difficulty is None else DIFFICULTIES[self.difficulty]
        model = FrameModel(self.sensor, self.clutter_model if self.clutter else None, self.marker_radius, level)
        model = replace(model, exposure_ms=self.exposure_ms)
        for camera in rig.camera_names:
            (out / "frames" / camera).mkdir(parents=True)
        shots, rows = simulate_shots(truth, obj, model, generator), ["snapshot,camera,fiducial,seen"]
        for snapshot, shot in enumerate(progress(shots, self.snapshots, "rendering frames")):
            for (camera, image), shares in zip(shot.frames.items(), shot.seen.tolist(), strict=True):
                write_frame(out / "frames" / camera / f"{snapshot:05d}.png", image)
                rows += [f"{snapshot:05d},{camera},{n},{share:.3f}" for n, share in enumerate(shares)]
        write_text(out / "truth" / "seen.csv", "\n".join([*rows, ""]))

    def _truth(self, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator) -> Truth:
        """Disturb the rig and place the object."""
        poses = self.poses or ("hemisphere" if rig.volume is None and rig.working_distance is not None else "volume")
        if self.exposure_ms > 0 and poses != "hand-held":
            raise InputError(f"--exposure-ms: found {self.exposure_ms:g}, expected --poses hand-held with it")
        if poses == "hemisphere":
            return simulate_truth(rig, obj, self.snapshots, generator, self._drift(), self._pose_range())
        if self._pose_range() != PoseRange():
            raise InputError("--theta-deg, --phi-deg, --alpha-deg: expected only with --poses hemisphere")
        hand = self.hand if poses == "hand-held" else None
        return simulate_volume(rig, obj, self.snapshots, generator, self._drift(), hand=hand)

    def _drift(self) -> Drift | None:
        kind = self.drift or ("physical" if self.kappa is None else "relative")
        if self.kappa is not None and kind != "relative":
            raise InputError(f"--kappa: found {self.kappa:g} beside --drift {kind}, expected it with --drift relative")
        kappa = 0.025 if self.kappa is None else self.kappa
        kinds: dict[str, Drift | None] = {"physical": self.physical, "none": None}
        return kinds[kind] if kind in kinds else RelativeDrift(kappa, kappa)

    def _pose_range(self) -> PoseRange:
        return PoseRange(self.theta_deg, self.phi_deg, self.alpha_deg)


def _write_truth(truth: Truth, folder: Path) -> None:
    folder.mkdir()
    save_rig(replace(truth.rig, name=f"{truth.rig.name} drifted", prior=None), folder / "rig.yaml")
    save_detections(true_detections(truth), folder / "detections.csv")
    poses = torch.cat((vector_from_rotation(truth.rig_from_object.rotation), truth.rig_from_object.translation), dim=-1)
    rows = [f"{s:05d}," + ",".join(repr(value) for value in row) for s, row in enumerate(poses.tolist())]
    write_text(folder / "rig_from_object.csv", "\n".join(["snapshot,rx,ry,rz,tx,ty,tz", *rows]) + "\n")
