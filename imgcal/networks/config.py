"""Network configuration: presets by name, and the values that can be changed in each."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal, TypeVar

from pydantic import ConfigDict, Field, model_validator

from imgcal.io import StrictModel, nearest
from imgcal.messages import shorten
from imgcal.networks.backbone_options import MOST_WEIGHTS, check_options
from imgcal.synthesis import Drift, ImageOptions, PoseRange

Width = Annotated[int, Field(ge=1, le=4096)]
Count = Annotated[int, Field(ge=1, le=64)]
Widths = Annotated[tuple[Width, ...], Field(max_length=8)]
Encoder = Literal["transformer", "cnn1d"]
Attending = TypeVar("Attending", "PaperPoints", "TrunkConfig")


def _make_heads_whole(config: Attending) -> Attending:
    if config.encoder == "transformer" and config.width % config.heads:
        raise ValueError(
            f"found width {config.width} and {config.heads} heads, expected a width that is a multiple of the heads"
        )
    if 13 * config.width**2 * config.depth > MOST_WEIGHTS:  # of either encoder, about
        raise ValueError(f"found width {config.width} and depth {config.depth}, expected a network that fits in memory")
    return config


class PaperPoints(StrictModel):
    """The paper's point variant; it predicts values per camera, not offsets."""

    encoder: Encoder = "transformer"  # blocks of attention, or of one-dimensional convolution
    width: Width = 512  # of features
    depth: Count = 8  # blocks
    heads: Count = 4  # of attention
    camera_identity: bool = True  # the paper's CIE
    head_widths: Widths = (1024, 1024)  # of the hidden layers of the heads

    @model_validator(mode="after")
    def _check_width(self) -> PaperPoints:
        return _make_heads_whole(self)


class PaperImages(StrictModel):
    """The paper's image variant: one pooled feature per image."""

    backbone: Annotated[str, Field(max_length=200)] = "vit_base_patch16_224"  # any model of timm, by name
    pretrained: bool = False  # begin with published weights of timm
    options: dict[str, Any] = Field(default={})  # further arguments of timm.create_model: backbone_options
    bottleneck: Width = 128  # of the pooled feature of an image
    head_widths: Widths = (128,)  # of the hidden layers of the heads

    @model_validator(mode="after")
    def _check_options(self) -> PaperImages:
        check_options(self.options)
        return self


class TrunkConfig(StrictModel):
    """Our network from positions to a rig."""

    encoder: Encoder = "transformer"  # blocks of attention, or of one-dimensional convolution
    width: Width = 128  # of features
    heads: Count = 4  # of attention
    depth: Count = 5  # blocks of the first pass
    later_depth: Count = 2  # blocks of every later pass, which share their weights
    passes: Count = 3  # each sees the residuals of the previous one
    trust: bool = False  # predict how far the refinement may trust each fiducial

    @model_validator(mode="after")
    def _check_width(self) -> TrunkConfig:
        return _make_heads_whole(self)


class Points(StrictModel):
    """Our point variant."""

    trunk: TrunkConfig = TrunkConfig()


def is_import_path(backbone: str) -> bool:
    """Check whether a backbone is a custom class, `package.module:Class`, whose code would run."""
    return re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", backbone) is not None


class HueCentroids(StrictModel):
    """No encoder: positions by hue, then our trunk. The baseline of the image variants."""

    trunk: TrunkConfig = TrunkConfig()


class Images(StrictModel):
    """Our image variant: an encoder's map locates each fiducial, then our trunk follows."""

    backbone: Annotated[str, Field(max_length=200)] = "vit"  # vit or cnn, ours; a timm model; or package.module:Class
    pretrained: bool = False  # begin with published weights of timm
    options: dict[str, Any] = Field(default={})  # of the encoder; of timm models: backbone_options
    width: Width = 64  # features of the map
    trunk: TrunkConfig = TrunkConfig()

    @model_validator(mode="after")
    def _check_options(self) -> Images:
        if not is_import_path(self.backbone):
            check_options(self.options)
        return self


class PooledImages(StrictModel):
    """An image variant whose trunk gets one pooled feature per image and no positions."""

    backbone: Annotated[str, Field(max_length=200)] = "vit_tiny_patch16_224"  # any model of timm, by name
    pretrained: bool = False  # begin with published weights of timm
    options: dict[str, Any] = Field(default={})  # further arguments of timm.create_model: backbone_options
    bottleneck: Width = 128  # of the pooled feature of an image
    trunk: TrunkConfig = TrunkConfig()

    @model_validator(mode="after")
    def _check_options(self) -> PooledImages:
        check_options(self.options)
        return self


Variant = PaperPoints | PaperImages | Points | HueCentroids | Images | PooledImages

# Half a million parameters each, fast on a CPU: patches of 32 pixels, or a narrow ConvNeXt; for pooled features.
SMALL_VIT = {"patch_size": 32, "embed_dim": 96, "depth": 3, "num_heads": 3}
SMALL_CNN = {"depths": [1, 1, 2, 1], "dims": [16, 32, 64, 128]}

PRESETS: dict[str, Variant] = {
    "paper-points": PaperPoints(),
    "paper-cnn1d": PaperPoints(encoder="cnn1d", depth=4, head_widths=(512,)),
    "paper-vit": PaperImages(),
    "paper-cnn2d": PaperImages(backbone="resnet50"),
    "points": Points(),
    "points-one-pass": Points(trunk=TrunkConfig(passes=1)),
    "points-cnn1d": Points(trunk=TrunkConfig(encoder="cnn1d")),
    "hue-centroids": HueCentroids(),
    "vit": Images(backbone="vit"),
    "cnn": Images(backbone="cnn"),
    "vit-pooled": PooledImages(backbone="vit_tiny_patch16_224", options=SMALL_VIT),
    "cnn-pooled": PooledImages(backbone="convnext_atto", options=SMALL_CNN),
}


class NetworkConfig(StrictModel):
    """The block `network` of an experiment file: a preset and its changes.

    Examples:
        >>> NetworkConfig(preset="points", change={"trunk": {"passes": 2}}).variant().trunk.passes
        2
    """

    preset: str  # a kind of network, by name
    change: dict[str, Any] = Field(default={})  # values of the preset to replace, by name; groups within groups

    @model_validator(mode="after")
    def _check_preset(self) -> NetworkConfig:
        if self.preset not in PRESETS:
            hint = nearest(self.preset, PRESETS) or list_choices(PRESETS)
            raise ValueError(f"found preset `{shorten(self.preset)}`{hint}")
        self.variant()
        return self

    def variant(self) -> Variant:
        """The preset with its changes.

        Raises:
            ValueError: a change to an unknown key, or an invalid value (pydantic's ValidationError).
        """
        preset = PRESETS[self.preset]
        values = preset.model_dump()
        if "backbone" in self.change and "options" in values:
            values["options"] = {}  # the preset's options belong to its own encoder
        return type(preset).model_validate(_merge(values, self.change, self.preset), strict=False)


class NetworkSpec(StrictModel):
    """The blocks of an experiment that define a network and its training target; other blocks are kept unchanged.

    `imgcal.training.Experiment` is a subclass that also defines the other blocks.
    """

    model_config = ConfigDict(extra="allow")

    network: NetworkConfig
    images: ImageOptions | None = None  # how the images of image variants are drawn
    poses: PoseRange = PoseRange()
    drift: Drift


Spec = TypeVar("Spec", bound=NetworkSpec)


def drop_pretrained(spec: Spec) -> Spec:
    """Copy a spec without pretrained weights, for when other weights replace them."""
    if "pretrained" not in spec.network.change:
        return spec
    plain = spec.network.model_copy(update={"change": {**spec.network.change, "pretrained": False}})
    return spec.model_copy(update={"network": plain})


def list_choices(names: Iterable[str]) -> str:
    """Describe the allowed choices."""
    return ", expected one of " + ", ".join(names)


def _merge(values: dict[str, Any], change: dict[str, Any], where: str) -> dict[str, Any]:
    merged = dict(values)
    for name, value in change.items():
        if name not in values:
            hint = nearest(name, values) or list_choices(values)
            raise ValueError(f"found `{shorten(name)}` in the changes of {where}{hint}")
        inner = isinstance(values[name], dict) and isinstance(value, dict) and name != "options"
        merged[name] = _merge(values[name], value, f"{where}: {name}") if inner else value
    return merged
