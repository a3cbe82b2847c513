"""Draw the named levels of difficulty: the same pose in one camera at every level.

    python -m scripts.results.difficulty

Writes docs/difficulty.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from imgcal.io import load_object, read_rig
from imgcal.synthesis import DIFFICULTIES, FrameModel, PhysicalDrift, simulate_frames, simulate_truth
from scripts.output import figure

PICTURE = Path("docs/difficulty.png")
CAMERA = 2
HALF = (150, 270)  # px, rows and columns shown on either side of the object
COLUMNS = 4


def main() -> None:
    """Render one snapshot at each level, and draw the surroundings of the object."""
    rig, obj = read_rig("O10").select([CAMERA]), load_object("asymmetric8")
    truth = simulate_truth(rig, obj, 1, torch.Generator().manual_seed(0), PhysicalDrift())
    u, v = truth.uv[0, 0].mean(0).round().int().tolist()
    with figure(PICTURE, COLUMNS, len(DIFFICULTIES) // COLUMNS, (11.0, 3.7)) as axes:
        for axis, (name, level) in zip(axes, DIFFICULTIES.items(), strict=True):
            frames = simulate_frames(truth, obj, FrameModel(difficulty=level), torch.Generator().manual_seed(2))
            frame = next(iter(frames))[rig.camera_names[0]]
            part = frame[max(v - HALF[0], 0) : v + HALF[0], max(u - HALF[1], 0) : u + HALF[1]].astype(float)
            axis.imshow(part, cmap="gray", vmin=np.quantile(part, 0.02), vmax=np.quantile(part, 0.999))
            axis.set_title(f"{name} (grey {part.min():.0f} to {part.max():.0f})", fontsize=8)
            axis.set_xticks([])
            axis.set_yticks([])


if __name__ == "__main__":
    main()
