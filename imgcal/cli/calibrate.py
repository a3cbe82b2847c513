"""`imgcal calibrate`: the main job. Frames or blobs and a factory calibration in, a recalibrated rig out."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from imgcal.association import PipelineOptions
from imgcal.cli import arguments
from imgcal.cli.common import (
    RESULT,
    check_folder,
    check_inputs_survive,
    drop_cameras,
    keep_memory,
    open_rig,
    parse_range,
    progress,
    read_detections,
    require_board_files,
    select_cameras,
    start_pose,
)
from imgcal.cli.outcome import doubtful_cameras, findings, print_outcome, refused_summary, summary
from imgcal.cli.report_content import describe, describe_refusal
from imgcal.errors import InputError, RefusedError
from imgcal.estimation import Gauge
from imgcal.extras import advice, missing
from imgcal.formats import load_cameras
from imgcal.io import (
    PREVIOUS,
    Capture,
    RigCovariance,
    keep_previous,
    load_objects,
    open_input,
    publishing,
    save_detections,
    save_object,
    save_rig,
    write_text,
)
from imgcal.messages import list_names, shorten
from imgcal.pipeline import (
    Calibration,
    Detector,
    LearnedMeasurer,
    calibrate,
    calibrate_from_scratch,
    capture_sight,
    load_initializer,
)
from imgcal.types import CalibrationObject, CameraRig, Detections, limits
from imgcal.watch import STATE

RIG = "rig.yaml"
WRITTEN = ("report.html", RIG, "rig.posterior.safetensors", "object.csv", "board.yaml", RESULT)
WORST_STD = 1e6  # in any unit: what is known so badly is not known


class Calibrate(arguments.Calibrate):
    """Run `imgcal calibrate`."""

    def run(self) -> None:
        """Calibrate and write."""
        started = time.perf_counter()
        self._check_out()
        lacking = missing("jinja2") if self.report else None
        draws = self.report and lacking is None
        complete, obj = self._rig(), self._object()
        rig = drop_cameras(complete, self.without)
        reference = self._reference(rig)
        options = PipelineOptions(
            blind_cameras=self.blind_cameras,
            after_last_move=self.after_last_move,
            start_pose=start_pose(self.start_pose),
        )
        foreign = [name for name in self.without if name not in complete.camera_names]
        source = open_input(self.input, complete, obj.rows, self.videos_differ, foreign)
        self._require_frames(source, rig)
        require_board_files(self.object, source)
        measurer = None if self.measurer is None else LearnedMeasurer.load(self.measurer)
        detector = self._detector(source, measurer)
        if self.trust and self.first_guess == "none":
            raise InputError(f"--trust: found {shorten(self.trust[0])} without --first-guess, expected both")
        named, trusted = self.first_guess, self.trust
        initializer = None if named == "none" else load_initializer(named, rig, obj, trusted=trusted)
        loaded = time.perf_counter()
        detections, frames = read_detections(source, self.snapshots, self.detection, measurer, obj.board)
        detections = select_cameras(detections, rig)
        seconds = {"loading": loaded - started, "reading and detection": time.perf_counter() - loaded}
        bar = partial(progress, label="identifying")
        outcome: Calibration | RefusedError
        try:
            if self.cameras is not None:
                outcome = calibrate_from_scratch(detections, rig, obj, options, progress=bar, distance=self.distance)
                rig = outcome.factory
            else:
                outcome = calibrate(
                    detections, rig, obj, options, initializer=initializer, progress=bar, detector=detector
                )
            covariance = trusted_covariance(outcome, reference)
            seconds |= {name: value for name, value in outcome.seconds.items() if name != "detection"}
        except RefusedError as error:
            outcome = error
        if lacking:
            print(f"note: no report.html, which {advice(lacking)}", file=sys.stderr)
        earlier = (self.out / RIG).exists()
        with publishing(self.out, WRITTEN, mark=RESULT) as out:
            if isinstance(outcome, RefusedError):
                if earlier:
                    keep_previous(self.out, out, WRITTEN)
                result = refused_summary(outcome, detections, rig, seconds)
                content = describe_refusal(outcome, detections, rig, obj, frames, seconds)
            else:
                posterior = replace(outcome.posterior(), time=time.time())
                save_rig(outcome.rig, out / RIG, covariance, self.full_covariance, posterior)
                if outcome.shape and not obj.parts:
                    save_object(replace(outcome.object, board=None), out / "object.csv")
                if outcome.bend is not None:
                    save_object(outcome.object, out / "board.yaml")
                found = findings(outcome, self._gauge(outcome), covariance)
                result = summary(outcome, seconds) | found.values
                content = describe(outcome, found, rig, frames, seconds)
            if draws:
                from imgcal.report import write_report  # brings jinja2 along, which is not in the core

                write_report(content, out / "report.html")
            write_text(out / RESULT, json.dumps(result, indent=2) + "\n")
            if self.labelled is not None and not isinstance(outcome, RefusedError):
                save_detections(outcome.labelled_detections, self.labelled, obj)
        if isinstance(outcome, RefusedError):
            if earlier:
                print(f"note: the earlier calibration in {self.out} is now in {self.out / PREVIOUS}", file=sys.stderr)
            raise outcome
        for move in outcome.moved:
            print(f"{move}: only the snapshots since then are used")
        print_outcome(result, found, self.out, draws)
        for note in doubtful_cameras(outcome):
            print(f"note: {note}; see the report", file=sys.stderr)

    def _check_out(self) -> None:
        """The inputs must survive, and what else is in the folder."""
        check_folder(self.out)
        if self.labelled is not None:
            if not self.labelled.parent.is_dir() or self.labelled.is_dir():
                raise InputError(f"--labelled: found {self.labelled}, expected a file in an existing folder")
            for option, given in self._inputs():
                if self.labelled.exists() and given.exists() and self.labelled.samefile(given):
                    raise InputError(
                        f"--labelled: {self.labelled} is also the input of {option}, expected another file"
                    )
            if any(self.labelled.resolve() == (self.out / name).resolve() for name in WRITTEN):
                raise InputError(f"--labelled: {self.labelled} is written to --out, expected another file")
        replaced = list(WRITTEN)
        if (self.out / RIG).exists():
            replaced += self._previous()
        check_inputs_survive(self.out, replaced, self._inputs())
        if (self.out / STATE).exists():
            raise InputError(f"--out: {self.out} belongs to imgcal watch ({STATE}), expected another folder")

    def _previous(self) -> list[str]:
        """Files of an earlier run that a refusal would replace by those of the last one."""
        folder = self.out / PREVIOUS
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            raise InputError(f"{folder}: found a link or file, expected nothing or the folder of an earlier run")
        foreign = sorted(path.name for path in folder.glob("*") if path.name not in WRITTEN)
        if foreign:
            raise InputError(f"{folder}: found {list_names(foreign)}, expected the files of an earlier run only")
        return [f"{PREVIOUS}/{name}" for name in WRITTEN]

    def _inputs(self) -> list[tuple[str, Path]]:
        """What is read, with the names of the options."""
        given = {"--rig": self.rig, "--cameras": self.cameras, "INPUT": self.input}
        named = [(option, Path(path)) for option, path in given.items() if path is not None]
        return [*named, *(("--object", Path(path)) for path in self.object)]

    def _rig(self) -> CameraRig:
        """What is known of the cameras."""
        if (self.rig is None) == (self.cameras is None):
            if self.rig is None:
                raise InputError("missing --rig (a factory calibration) or --cameras (to calibrate without one)")
            raise InputError("found both --rig and --cameras, expected one: with or without a factory calibration")
        if self.rig is not None:
            if self.distance is not None:
                raise InputError("--distance: cannot be used with --rig, whose cameras give the scale; use --cameras")
            return open_rig(self.rig)
        if self.first_guess != "none" or self.detector != "classical":
            option = "--detector" if self.first_guess == "none" else "--first-guess"
            raise InputError(f"{option}: cannot be used with --cameras; it needs a factory calibration (--rig)")
        assert self.cameras is not None
        return load_cameras(self.cameras)

    def _object(self) -> CalibrationObject:
        """The object with its tolerances."""
        obj = load_objects(self.object)
        if not limits.TOLERANCE.low <= self.object_tolerance <= limits.TOLERANCE.high:
            raise InputError(f"--object-tolerance: found {self.object_tolerance}, expected {limits.TOLERANCE}")
        if not 0 <= self.object_scale_tolerance < 1:
            raise InputError(
                f"--object-scale-tolerance: found {self.object_scale_tolerance}, expected a share from 0 to 1"
            )
        parts = [
            replace(
                part,
                tolerance=torch.full_like(part.points[:, 0], self.object_tolerance)
                if part.tolerance is None and self.object_tolerance > 0
                else part.tolerance,
                scale_tolerance=self.object_scale_tolerance,
            )
            for part in obj.each
        ]
        return CalibrationObject.of_several(parts)

    def _require_frames(self, source: Capture | Detections, rig: CameraRig) -> None:
        """A camera whose folder is missing is not one that saw nothing."""
        if isinstance(source, Detections) or self.blind_cameras:
            return
        without = [name for name in rig.camera_names if not source.files[name]]
        if without:
            raise InputError(
                f"{source.folder / 'frames'}: found no frames of {list_names(without)}, expected some of each "
                "camera of "
                f"rig {rig.name}; --without {without[0]} leaves a camera out, --blind-cameras keeps its factory values"
            )

    def _detector(self, source: Capture | Detections, measurer: LearnedMeasurer | None) -> Detector:
        """Who finds the fiducials, with the frames of the chosen snapshots."""
        if self.detector == "classical":
            return self.detector
        if isinstance(source, Detections):
            raise InputError(f"--detector {self.detector}: found blobs in {self.input}, expected a capture with frames")
        keep_memory()
        first = parse_range(self.snapshots)[0]
        return capture_sight(source, self.detector, self.detection, first, measurer)

    def _reference(self, rig: CameraRig) -> int:
        if self.reference is None:
            return 0
        if self.reference not in rig.camera_names:
            raise InputError(f"--reference: found {self.reference}, expected one of {', '.join(rig.camera_names)}")
        return rig.camera_names.index(self.reference)

    def _gauge(self, calibration: Calibration) -> Gauge:
        """Say which cameras the report takes to have stood still."""
        rig = calibration.rig
        if self.reference is not None or rig.num_cameras == 1:
            return Gauge.from_camera(self._reference(rig), rig.num_cameras)
        return Gauge.from_majority(rig, calibration.factory)


def trusted_covariance(calibration: Calibration, reference: int) -> RigCovariance:
    """Covariance of a rig relative to one of its cameras.

    Raises:
        RefusedError: some camera is known so badly that the approximation behind the figures breaks down.
    """
    names = calibration.rig.camera_names
    covariance = RigCovariance.from_matrix(calibration.estimate.covariance(reference), len(names), names[reference])
    bad = ~(covariance.std <= WORST_STD)
    if bool(bad.any()):
        camera, parameter = bad.nonzero()[0].tolist()
        name = calibration.rig.parameter_names_of(camera)[parameter]
        raise RefusedError(
            f"covariance: {name} of camera {names[camera]} has a standard deviation of "
            f"{float(covariance.std[camera, parameter]):.2g}: the blobs carry too little information (their "
            "sigma is too large, or they all lie in one place)"
        )
    return covariance
