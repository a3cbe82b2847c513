"""`imgcal simulate`: a synthetic capture with its truth."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch

from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, progress
from imgcal.errors import InputError
from imgcal.geometry import vector_from_rotation
from imgcal.io import (
    load_objects,
    publishing,
    save_capture_settings,
    save_detections,
    save_object,
    save_rig,
    write_frame,
    write_text,
)
from imgcal.messages import plural, shorten
from imgcal.synthesis import (
    DIFFICULTIES,
    Drift,
    FrameModel,
    PhysicalDrift,
    PoseRange,
    RelativeDrift,
    Truth,
    join_truths,
    place_markers,
    render_board,
    simulate_board,
    simulate_shots,
    simulate_truth,
    simulate_volume,
    true_detections,
)
from imgcal.types import FIDUCIAL_RADIUS, CalibrationObject, CameraRig, limits

WRITTEN = ("capture.yaml", "rig.yaml", "object.csv", "objects", "board.yaml", "truth", "frames")

MOST_SNAPSHOTS = 100_000
LIGHTS = 15
"""Markers on a body of unknown ones, unless the user says how many."""


class Simulate(arguments.Simulate):
    """Run `imgcal simulate`."""

    def run(self) -> None:
        """Simulate and write."""
        lights = LIGHTS if self.lights is None else self.lights
        bounds = (
            ("snapshots", self.snapshots, 1, MOST_SNAPSHOTS),
            ("seed", self.seed, 0, 2**63 - 1),
            ("lights", lights, 1, limits.MOST_FIDUCIALS),
        )
        for name, value, least, most in bounds:
            if not least <= value <= most:
                found = shorten(str(value))
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
        rig, obj = open_rig(self.rig), load_objects(self.object)
        generator = torch.Generator().manual_seed(self.seed)
        if obj.has_lights:
            raise InputError("--object: found unknown markers and known objects, expected one or the other to simulate")
        are_known = not obj.unknown_markers
        if are_known and self.lights is not None:
            raise InputError(f"--lights: found {lights} with an object of known markers, expected --object lights")
        if not are_known:
            obj = place_markers(rig, lights, generator)
        truth = self._truth(rig, obj, generator)
        with publishing(self.out, WRITTEN, mark="frames") as out:
            self._write(truth, rig, obj, generator, out)
            _write_object(obj, out if are_known else out / "truth")
        what = f"{plural(self.snapshots, 'snapshot')} of {plural(rig.num_cameras, 'camera')}"
        print(f"{what} written to {self.out}", file=sys.stderr)

    def _write(
        self, truth: Truth, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator, out: Path
    ) -> None:
        save_capture_settings(
            out, self.sensor.bit_depth if obj.board is None else 8, note=f"simulated, seed {self.seed}"
        )
        save_rig(rig, out / "rig.yaml")
        _write_truth(truth, obj, out / "truth")
        if obj.board is not None:
            for snapshot in progress(range(self.snapshots), self.snapshots, "rendering frames"):
                pose = truth.rig_from_object[snapshot]
                for camera, image in render_board(obj.board, truth.rig, pose, generator).items():
                    (out / "frames" / camera).mkdir(parents=True, exist_ok=True)
                    write_frame(out / "frames" / camera / f"{snapshot:05d}.png", image)
            return
        level = None if self.difficulty is None else DIFFICULTIES[self.difficulty]
        model = FrameModel(self.sensor, self.clutter_model if self.clutter else None, self.marker_radius, level)
        model = replace(model, exposure_ms=self.exposure_ms)
        for camera in rig.camera_names:
            (out / "frames" / camera).mkdir(parents=True)
        shots = simulate_shots(truth, obj, model, generator)
        rows = ["snapshot,camera,object,fiducial,seen" if obj.parts else "snapshot,camera,fiducial,seen"]
        given = range(obj.rows) if isinstance(obj.rows, int) else obj.rows
        labels = [",".join(map(str, label)) if isinstance(label, tuple) else str(label) for label in given]
        for snapshot, shot in enumerate(progress(shots, self.snapshots, "rendering frames")):
            for (camera, image), shares in zip(shot.frames.items(), shot.seen.tolist(), strict=True):
                write_frame(out / "frames" / camera / f"{snapshot:05d}.png", image)
                rows += [f"{snapshot:05d},{camera},{n},{share:.3f}" for n, share in zip(labels, shares, strict=True)]
        write_text(out / "truth" / "seen.csv", "\n".join([*rows, ""]))

    def _truth(self, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator) -> Truth:
        """Disturb the rig once, and place each object."""
        truths: list[Truth] = []
        for part in obj.each:
            truths.append(
                self._simulate_truth(
                    truths[0].rig if truths else rig, part, generator, None if truths else self._drift()
                )
            )
        return join_truths(truths)

    def _simulate_truth(
        self, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator, drift: Drift | None
    ) -> Truth:
        if obj.board is not None:
            if self.poses is not None or self.exposure_ms > 0 or self.difficulty is not None:
                raise InputError("--poses, --exposure-ms, --difficulty: expected an object with markers, found a board")
            return simulate_board(rig, obj, self.snapshots, generator, drift)
        poses = self.poses or ("hemisphere" if rig.volume is None and rig.working_distance is not None else "volume")
        if self.exposure_ms > 0 and poses != "hand-held":
            raise InputError(f"--exposure-ms: found {self.exposure_ms:g}, expected --poses hand-held")
        if poses == "hemisphere":
            return simulate_truth(rig, obj, self.snapshots, generator, drift, self._pose_range())
        if self._pose_range() != PoseRange():
            raise InputError("--theta-deg, --phi-deg, --alpha-deg: expected only with --poses hemisphere")
        hand = self.hand if poses == "hand-held" else None
        return simulate_volume(rig, obj, self.snapshots, generator, drift, hand=hand)

    def _drift(self) -> Drift | None:
        kind = self.drift or ("physical" if self.kappa is None else "relative")
        if self.kappa is not None and kind != "relative":
            raise InputError(f"--kappa: found {self.kappa:g} with --drift {kind}, expected --drift relative")
        if self.physical != PhysicalDrift() and kind != "physical":
            raise InputError(f"--physical.*: found values with a {kind} drift, expected --drift physical")
        kappa = 0.025 if self.kappa is None else self.kappa
        if not 0 <= kappa < 1:
            raise InputError(f"--kappa: found {kappa:g}, expected 0 or more, and less than 1")
        kinds: dict[str, Drift | None] = {"physical": self.physical, "none": None}
        return kinds[kind] if kind in kinds else RelativeDrift(kappa, kappa)

    def _pose_range(self) -> PoseRange:
        return PoseRange(self.theta_deg, self.phi_deg, self.alpha_deg)


def _write_object(obj: CalibrationObject, folder: Path) -> None:
    """Write the object's file; of several objects, one each in a folder of their own."""
    if not obj.parts:
        save_object(obj, folder / ("object.csv" if obj.board is None else "board.yaml"))
        return
    (folder / "objects").mkdir()
    for part in obj.parts:
        save_object(part, folder / "objects" / f"{part.name}.csv")


def _write_truth(truth: Truth, obj: CalibrationObject, folder: Path) -> None:
    folder.mkdir()
    save_rig(replace(truth.rig, name=f"{truth.rig.name} drifted", prior=None), folder / "rig.yaml")
    save_detections(true_detections(truth), folder / "detections.csv", obj)
    rows = ["snapshot,rx,ry,rz,tx,ty,tz" + (",object" if obj.parts else "")]
    for one, part in zip(truth.parts or (truth,), obj.each, strict=True):
        where, end = one.rig_from_object, f",{part.name}" if obj.parts else ""
        poses = torch.cat((vector_from_rotation(where.rotation), where.translation), dim=-1)
        rows += [f"{s:05d}," + ",".join(map(repr, row)) + end for s, row in enumerate(poses.tolist())]
    write_text(folder / "rig_from_object.csv", "\n".join(rows) + "\n")
