from dataclasses import replace

import numpy as np


def shuffled(table, snapshots, seed=1):
    """The table, with the labels of each camera shuffled in some snapshots."""
    random, fiducial = np.random.default_rng(seed), table.fiducial.copy()
    for s in snapshots:
        for camera in range(len(table.camera_names)):
            rows = np.flatnonzero((table.snapshot == s) & (table.camera == camera))
            fiducial[rows] = random.permutation(fiducial[rows])
    return replace(table, fiducial=fiducial)
