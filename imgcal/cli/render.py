"""`imgcal render`: captured frames in, colour-coded images for the image networks out."""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
import torch

from imgcal.association import associate, match_to_rig, to_observations
from imgcal.cli import arguments
from imgcal.cli.common import check_folder, open_rig, progress, read_detections
from imgcal.errors import InputError
from imgcal.io import load_object, open_input, publishing, write_image
from imgcal.messages import plural
from imgcal.synthesis import GREY_LEVELS, ImageOptions, render_views


class Render(arguments.Render):
    """Run `imgcal render`."""

    def run(self) -> None:
        """Render and write."""
        options = ImageOptions(self.size, self.dot)
        check_folder(self.out)
        rig, obj = open_rig(self.rig), load_object(self.object)
        if any((self.out / camera).exists() for camera in rig.camera_names):
            raise InputError(f"{self.out}: found images of these cameras there already, expected a new folder")
        source = open_input(self.input, rig, obj.rows, self.videos_differ)
        detections, _ = read_detections(source, self.snapshots, self.detection, board=obj.board)
        bar = partial(progress, label="identifying")
        labelled = associate(match_to_rig(detections, rig), rig, obj, progress=bar)
        kept = labelled.detections.select(np.isin(labelled.detections.snapshot, labelled.used))
        observations = to_observations(kept, rig, obj)
        with publishing(self.out, rig.camera_names, mark=rig.camera_names[-1]) as out:
            for camera in rig.camera_names:
                (out / camera).mkdir()
            for row, snapshot in enumerate(progress(labelled.used, len(labelled.used), "rendering")):
                name = labelled.snapshots[snapshot].name
                images = render_views(observations.uv[row], observations.seen[row], rig.image_size, obj, options)
                pixels = (images * GREY_LEVELS).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
                for camera, image in zip(rig.camera_names, pixels, strict=True):
                    write_image(out / camera / f"{name}.png", image)
        refused = len(labelled.snapshots) - len(labelled.used)
        print(
            f"{plural(len(labelled.used), 'snapshot')} written to {self.out}, {refused} left out (identity refused)",
            file=sys.stderr,
        )
