"""`imgcal detect`: frames in, a table of blobs out."""

from __future__ import annotations

import sys

from imgcal.cli import arguments
from imgcal.cli.common import open_rig, read_detections
from imgcal.io import open_capture, save_detections
from imgcal.messages import plural
from imgcal.pipeline import LearnedMeasurer


class Detect(arguments.Detect):
    """Run `imgcal detect`."""

    def run(self) -> None:
        """Detect and write."""
        capture = open_capture(self.capture, None if self.rig is None else open_rig(self.rig), self.videos_differ)
        measurer = None if self.measurer is None else LearnedMeasurer.load(self.measurer)
        detections, _ = read_detections(capture, self.snapshots, self.detection, measurer)
        save_detections(detections, self.out)
        print(
            f"{plural(len(detections), 'blob')} in {plural(len(detections.snapshot_names), 'snapshot')} of "
            f"{plural(len(detections.camera_names), 'camera')} written to {self.out}",
            file=sys.stderr,
        )
