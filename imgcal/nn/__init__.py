"""Differentiable modules for your own training loops: `torch.nn.Module`s over imgcal's stateless functions.

Each runs on any device in float32 and float64, with any batch axes, under `torch.compile(fullgraph=True)`,
`torch.export` (not strict), `torch.func.vmap`, `jacfwd` and `jacrev`. Importing this package makes the value types of
imgcal pytrees.
"""

from imgcal.nn import pytrees  # noqa: F401  registers the value types
from imgcal.nn.map_estimate import MapEstimate, MapSolution
from imgcal.nn.project_rig import ProjectRig
from imgcal.nn.render_and_compare import RefinedImages, RenderAndCompare
from imgcal.nn.reprojection_loss import ReprojectionLoss, project_fiducials, rms_per_axis
from imgcal.nn.soft_positions import SoftPositions
from imgcal.nn.splat_renderer import SplatRenderer

__all__ = [
    "MapEstimate",
    "MapSolution",
    "ProjectRig",
    "RefinedImages",
    "RenderAndCompare",
    "ReprojectionLoss",
    "SoftPositions",
    "SplatRenderer",
    "project_fiducials",
    "rms_per_axis",
]
