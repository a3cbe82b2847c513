"""Encoders by name: ours, any timm model, or a custom class; each returns a feature map at a stride of 4 pixels."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.messages import quote, shorten
from imgcal.networks.backbone_options import MOST_WEIGHTS, USUAL_SIZE
from imgcal.networks.config import Images, is_import_path
from imgcal.networks.encoders import STRIDE, CnnEncoder, VitEncoder


def make_encoder(config: Images, size: int | None) -> tuple[nn.Module, int, int]:
    """Create the encoder that an experiment names.

    Args:
        config: the encoder and its options. An import path runs the code of its module: refuse it first if the
            configuration comes from a file of unknown origin (`load_checkpoint` does).
        size: pixels, width and height of the images; None = the encoder's own.

    Returns:
        The encoder, images (I, 3, H, W) -> (I, F, H / 4, W / 4); F; and the size of the images.

    Raises:
        InputError: an unknown name, unsupported options, or an encoder that is too large.
    """
    name, options = config.backbone, config.options
    if name in ("cnn", "vit") or is_import_path(name):
        if config.pretrained:
            raise InputError(
                f"backbone {shorten(name)}: found pretrained: true, but only timm models have pretrained weights"
            )
        drawn = size or USUAL_SIZE
        if name == "cnn":
            return _count_weights(name, lambda: CnnEncoder(config.width, **options)), config.width, drawn
        if name == "vit":
            return _count_weights(name, lambda: VitEncoder(config.width, drawn, **options)), config.width, drawn
        encoder_class = _import(name)
        encoder = _count_weights(name, lambda: encoder_class(**options))
        return encoder, _check_width(encoder, name, drawn), drawn
    from imgcal.networks.timm_encoder import TimmEncoder  # takes seconds to import, so only where necessary

    timms = TimmEncoder(name, config.pretrained, options, config.width)
    return timms, config.width, size or max(timms.size)


def _import(path: str) -> Callable[..., nn.Module]:
    """Import the class that `package.module:Class` names.

    Raises:
        InputError: no such module or class, or a class that is no `nn.Module`.
    """
    module, _, name = path.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:  # importing runs the module's own code
        raise InputError(
            f"backbone: found `{shorten(path)}`, which cannot be imported: {_first_line(error)}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise InputError(f"backbone: found `{shorten(path)}`, expected a subclass of torch.nn.Module")
    return found


def _count_weights(name: str, make: Callable[[], nn.Module]) -> nn.Module:
    """Create an encoder after counting its weights, before any memory is allocated."""
    try:
        with torch.device("meta"):
            weights = sum(parameter.numel() for parameter in make().parameters())
        if weights > MOST_WEIGHTS:
            raise InputError(f"backbone {name}: found {weights:,} weights, expected at most {MOST_WEIGHTS:,}")
        return make()
    except InputError:
        raise
    except Exception as error:  # a custom class may raise anything for invalid options
        raise InputError(f"backbone {shorten(name)}: cannot be built with its options: {_first_line(error)}") from error


@torch.no_grad()
def _check_width(encoder: nn.Module, name: str, size: int) -> int:
    """Measure the number of features of an encoder's map on one image.

    Raises:
        InputError: it rejects such an image, or returns no map at a stride of 4.
    """
    was_training = encoder.training
    try:
        features = encoder.eval()(torch.zeros(1, 3, size, size))
    except Exception as error:
        raise InputError(
            f"backbone {shorten(name)}: fails on images of shape (1, 3, {size}, {size}): {_first_line(error)}"
        ) from error
    encoder.train(was_training)
    cells = -(-size // STRIDE)
    if not isinstance(features, Tensor) or features.ndim != 4 or features.shape[2:] != (cells, cells):
        found = list(features.shape) if isinstance(features, Tensor) else type(features).__name__
        raise InputError(
            f"backbone {shorten(name)}: found {found} for an image of {size} x {size} pixels, "
            f"expected features of shape (1, F, {cells}, {cells}): a stride of {STRIDE}"
        )
    return int(features.shape[1])


def _first_line(error: Exception) -> str:
    """First line of a foreign class's error, with the name of the error."""
    return quote(f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}")
