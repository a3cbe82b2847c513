"""Construction of a network from its configuration."""

from __future__ import annotations

import torch
from torch import Tensor

from imgcal.errors import InputError
from imgcal.networks.config import (
    HueCentroids,
    Images,
    NetworkConfig,
    NetworkSpec,
    PaperImages,
    PaperPoints,
    PooledImages,
)
from imgcal.networks.network import Network
from imgcal.networks.parameterization import Parameterization
from imgcal.networks.randomness import use_generators
from imgcal.synthesis import ImageOptions
from imgcal.types import CalibrationObject, CameraRig

LEAST_SIZE = 20
"""Pixels: smallest images for encoders, whose maps must have at least 5 x 5 cells."""


def build(
    config: NetworkConfig,
    factory: CameraRig,
    obj: CalibrationObject,
    drift_std: Tensor,
    generator: torch.Generator,
    images: ImageOptions | None = None,
) -> Network:
    """Create an untrained network.

    Args:
        config: preset and changes.
        factory: the factory rig, float32, without batch axes.
        obj: the calibration object.
        drift_std: (C, K) prior standard deviation of the parameters (`Drift.std`), the unit of predicted offsets.
        generator: for the initial weights, on the CPU; torch's default generators keep their state.
        images: how the images of image variants are drawn; None = in the size that their encoder takes.

    Returns:
        A network in training mode, on the CPU.

    Raises:
        InputError: an unknown backbone, a rig without working distance, or `images` for a point variant.

    Examples:
        >>> import torch, imgcal
        >>> from imgcal.networks import NetworkConfig
        >>> from imgcal.synthesis import RelativeDrift, synthesize
        >>> from imgcal.types import Views
        >>> factory, obj = imgcal.load_rig("T4").to(torch.float32), imgcal.load_object("cube8")
        >>> weights = torch.Generator().manual_seed(0)
        >>> network = build(NetworkConfig(preset="points"), factory, obj, RelativeDrift().std(factory), weights)
        >>> uv = synthesize(factory, obj, 2, torch.Generator().manual_seed(0)).projection.uv
        >>> passes = network(Views(uv, torch.ones(uv.shape[:-1], dtype=torch.bool)))
        >>> len(passes), passes[-1].rig.focal_length.shape  # coarse to fine; rigs, cameras, (fx, fy)
        (3, torch.Size([2, 4, 2]))
    """
    with use_generators(generator):
        return _make(config, Parameterization(factory, obj, drift_std), images)


def _make(config: NetworkConfig, parameterization: Parameterization, images: ImageOptions | None) -> Network:
    """Create the network of a configuration; see `build`."""
    # timm takes seconds to import, so only do it where necessary.
    from imgcal.networks.points import PaperPointNetwork, PointNetwork

    variant = config.variant()
    encodes = isinstance(variant, PaperImages | PooledImages | Images)
    if encodes and images is not None and images.size < LEAST_SIZE:
        expected = f"{LEAST_SIZE} or more for network {config.preset}"
        raise InputError(f"images: size: found {images.size}, expected {expected}")
    if isinstance(variant, PaperImages | PooledImages):
        from imgcal.networks.pooled_images import PaperImageNetwork, PooledImageNetwork

        if isinstance(variant, PaperImages):
            return PaperImageNetwork(variant, parameterization, images)
        return PooledImageNetwork(variant, parameterization, images)
    if isinstance(variant, HueCentroids | Images):
        from imgcal.networks.images import HueCentroidNetwork, ImageNetwork

        if isinstance(variant, Images):
            return ImageNetwork(variant, parameterization, images)
        return HueCentroidNetwork(variant, parameterization, images)
    if images is not None:
        raise InputError(f"images: found this block, but the network {config.preset} takes points")
    if isinstance(variant, PaperPoints):
        return PaperPointNetwork(variant, parameterization)
    return PointNetwork(variant, parameterization)


def build_network(spec: NetworkSpec, rig: CameraRig, obj: CalibrationObject, generator: torch.Generator) -> Network:
    """Create the untrained network of an experiment, with float32 factory values; see `build`."""
    single = torch.float32
    prior_std = spec.drift.std(rig).to(single)
    return build(spec.network, rig.to(single), obj, prior_std, generator, spec.images)
