"""`imgcal detect`: frames in, a table of blobs out."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from imgcal.cli.common import open_rig, read_detections
from imgcal.detection import DetectionOptions
from imgcal.io import open_capture, save_detections
from imgcal.pipeline import LearnedMeasurer


@dataclass(frozen=True)
class Detect:
    """Find blobs in captured frames and measure their centres.

    Writes one row a blob: snapshot, camera, u, v, sigma (pixels), radius, flags (1 touches the border, 2 merged,
    4 saturated, 8 masked, 32 no marker, as --measurer says). Example: imgcal detect my_capture --out detections.csv
    """

    capture: Annotated[Path, tyro.conf.Positional]  #: folder with frames/<camera>/<snapshot>.png
    out: Path  #: CSV or CSV.gz to write
    rig: str | None = None  #: rig file or name, to check camera names and image sizes against
    snapshots: str | None = None  #: A:B, numbers in file order from 0, B excluded
    videos_differ: bool = False  #: accept videos whose lengths or time stamps differ: frames go together by number
    measurer: str | None = None  #: network that measures blobs again: a file, the folder of a run, or a shipped name
    detection: Annotated[DetectionOptions, tyro.conf.arg(name="")] = field(default_factory=DetectionOptions)

    def run(self) -> None:
        """Detect and write."""
        capture = open_capture(self.capture, None if self.rig is None else open_rig(self.rig), self.videos_differ)
        measurer = None if self.measurer is None else LearnedMeasurer.load(self.measurer)
        detections, _ = read_detections(capture, self.snapshots, self.detection, measurer)
        save_detections(detections, self.out)
        print(
            f"{len(detections)} blobs in {len(detections.snapshot_names)} snapshots of "
            f"{len(detections.camera_names)} cameras written to {self.out}",
            file=sys.stderr,
        )
