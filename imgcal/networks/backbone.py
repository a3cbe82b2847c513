"""timm models as image encoders with a pooled feature, and their construction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import timm
import torch
from torch import Tensor, nn

from imgcal.errors import InputError
from imgcal.io import nearest
from imgcal.messages import quote, shorten
from imgcal.networks.backbone_options import MOST_WEIGHTS, USUAL_SIZE, check_options
from imgcal.networks.encoders import resize_images


class Backbone(nn.Module):
    """A timm model without its classifier: one pooled feature per image."""

    def __init__(self, name: str, pretrained: bool, options: Mapping[str, Any], size: int | None = None) -> None:
        """Create the model; `size` (pixels) is that of the images, for models that accept any."""
        super().__init__()
        self.model: Any = make_backbone(name, pretrained, options)
        self.size = input_size(self.model, size or USUAL_SIZE)
        self.width = cast(int, getattr(self.model, "head_hidden_size", None) or self.model.num_features)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images (I, 3, H, W), resized to the encoder's size if necessary: (I, width)."""
        features = self.model.forward_features(resize_images(images, self.size))
        return self.model.forward_head(features, pre_logits=True)


def make_backbone(name: str, pretrained: bool, options: Mapping[str, Any]) -> nn.Module:
    """Create a timm model without a classifier.

    Args:
        name: as in `timm.list_models()`.
        pretrained: load the published weights; needs network access or a filled cache.
        options: further arguments of `timm.create_model`; only those in `backbone_options.ALLOWED`.

    Raises:
        InputError: unknown model, unsupported options, a model that is too large, or weights that cannot be loaded.
    """
    if not timm.is_model(name):
        known = nearest(name, timm.list_models()) if len(name) < 100 else ""
        raise InputError(f"backbone: found `{shorten(name)}`, expected a timm model{known}")
    try:
        check_options(options)
        _check_weights(name, options)
        return timm.create_model(name, pretrained=pretrained, num_classes=0, **options)
    except InputError:
        raise
    except TypeError as error:
        raise InputError(
            f"backbone {name}: found unsupported options {quote(repr(dict(options)))}: {quote(str(error))}"
        ) from error
    except (OSError, RuntimeError) as error:
        if not pretrained:
            raise InputError(f"backbone {name}: cannot be built: {_first_line(error)}") from error
        raise InputError(
            f"backbone {name}: its pretrained weights cannot be loaded ({_first_line(error)}); go online, "
            "put them into timm's cache (HF_HOME), or set pretrained: false"
        ) from error
    except Exception as error:  # invalid options raise many kinds of errors within timm
        found = f"{type(error).__name__} {_first_line(error)}".strip()
        raise InputError(f"backbone {name}: cannot be built with {quote(repr(dict(options)))}: {found}") from error


def input_size(model: Any, otherwise: int = USUAL_SIZE) -> tuple[int, int]:
    """Height and width (pixels) of the images that a timm model expects; `otherwise` if it accepts any."""
    of_patches = getattr(getattr(model, "patch_embed", None), "img_size", None)
    config = model.pretrained_cfg
    if of_patches is None and config.get("fixed_input_size"):
        of_patches = config["input_size"][-2:]
    height, width = of_patches or (otherwise, otherwise)
    return int(height), int(width)


def _check_weights(name: str, options: Mapping[str, Any]) -> None:
    """Count the weights on the meta device, before any memory is allocated."""
    with torch.device("meta"):
        outline = timm.create_model(name, pretrained=False, num_classes=0, **options)
    weights = sum(parameter.numel() for parameter in outline.parameters())
    if weights > MOST_WEIGHTS:
        raise InputError(f"backbone {name}: found {weights:,} weights, expected at most {MOST_WEIGHTS:,}")


def _first_line(error: Exception) -> str:
    return quote((str(error).splitlines() or [""])[0])
