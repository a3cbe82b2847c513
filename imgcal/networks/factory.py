"""A network from its configuration."""

from __future__ import annotations

from torch import Tensor, nn

from imgcal.networks.config import Images, NetworkConfig, PaperImages, PaperPoints
from imgcal.networks.parameterization import Parameterization
from imgcal.types import CalibrationObject, CameraRig


def build(config: NetworkConfig, factory: CameraRig, obj: CalibrationObject, drift_std: Tensor) -> nn.Module:
    """Make an untrained network; its weights come from torch's default generator.

    Args:
        config: which network.
        factory: the factory rig, float32, without batch axes.
        obj: the calibration object.
        drift_std: (C, 15) spread of the rig's parameters, the unit of predicted offsets (`Drift.std`).

    Returns:
        A module that takes `Views` and returns one `Prediction` a pass, coarse to fine. Attributes: `image_options`
        (None for point variants), `factory`, `obj`, `config`.

    Raises:
        InputError: an unknown backbone, or a rig without working distance.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.networks import NetworkConfig
        >>> from imgcal.synthesis import RelativeDrift, synthesize
        >>> from imgcal.types import Views
        >>> factory, obj = imgcal.load_rig("T4").to(torch.float32), imgcal.load_object("cube8")
        >>> network = build(NetworkConfig(preset="points"), factory, obj, RelativeDrift().std(factory))
        >>> uv = synthesize(factory, obj, 2, torch.Generator().manual_seed(0)).projection.uv
        >>> passes = network(Views(uv, torch.ones(uv.shape[:-1], dtype=torch.bool)))
        >>> len(passes), passes[-1].rig.focal_length.shape  # coarse to fine; rigs, cameras, (fx, fy)
        (3, torch.Size([2, 4, 2]))
    """
    # timm takes seconds to import: only for those who need it.
    from imgcal.networks.points import PaperPointNetwork, PointNetwork

    decoder, variant = Parameterization(factory, obj, drift_std), config.variant()
    network: nn.Module
    if isinstance(variant, PaperPoints):
        network = PaperPointNetwork(variant, decoder)
    elif isinstance(variant, PaperImages):
        from imgcal.networks.images import PaperImageNetwork

        network = PaperImageNetwork(variant, decoder)
    elif isinstance(variant, Images):
        from imgcal.networks.images import ImageNetwork

        network = ImageNetwork(variant, decoder, obj.colours)
    else:
        network = PointNetwork(variant, decoder)
    network.factory, network.obj, network.config = factory, obj, config  # type: ignore[assignment]
    return network
