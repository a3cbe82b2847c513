"""Allowed options of a timm model: those of its architecture. None names a file, loads weights or runs foreign code.

An experiment may come from a model file of unknown origin, and timm loads what some of its arguments name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from imgcal.io import nearest
from imgcal.messages import list_names, shorten

MOST_WEIGHTS = 500_000_000  # of a whole network: 2 GB
USUAL_SIZE = 224  # pixels, width and height of images for encoders that take any
LARGEST = 8192  # width or size in pixels
MOST_BLOCKS = 128

BLOCKS = frozenset({"depth", "depths", "layers", "num_blocks"})
SHARES = frozenset(
    {"drop_rate", "drop_path_rate", "proj_drop_rate", "attn_drop_rate", "pos_drop_rate", "patch_drop_rate"}
)
WORDS = frozenset({"global_pool", "act_layer", "norm_layer", "stem_type"})
SIZES = frozenset(
    {
        "base_width", "cardinality", "channels", "dims", "embed_dim", "embed_dims", "head_dim", "img_size",
        "kernel_sizes", "mlp_ratio", "mlp_ratios", "num_heads", "output_stride", "patch_size", "reg_tokens",
        "stem_width", "strides", "width", "window_size",
    }
)  # fmt: skip
SWITCHES = frozenset(
    {
        "class_token", "conv_mlp", "dynamic_img_pad", "dynamic_img_size", "final_norm", "fc_norm", "no_embed_class",
        "pre_norm", "qk_norm", "qkv_bias", "strict_img_size",
    }
)  # fmt: skip
SMALL = frozenset({"init_values", "ls_init_value"})
ALLOWED = BLOCKS | SHARES | WORDS | SIZES | SWITCHES | SMALL


def check_options(options: Mapping[str, Any]) -> None:
    """Raise ValueError for an option that is not known to be harmless, or a value out of range."""
    for name, value in options.items():
        if name not in ALLOWED:
            hint = nearest(name, ALLOWED) or f", expected some of {list_names(sorted(ALLOWED))}"
            raise ValueError(f"options: found `{shorten(name)}`, which is not an allowed option{hint}")
        expected = _describe_expected(name, value)
        if expected:
            raise ValueError(f"options: {name}: found {shorten(repr(value))}, expected {expected}")


def _describe_expected(name: str, value: Any) -> str:
    """Describe the expected value; empty if the value is valid."""
    if name in WORDS:
        good = isinstance(value, str) and re.fullmatch(r"[a-z0-9_]{0,20}", value)
        return "" if good else "a short word"
    if name in SWITCHES:
        return "" if isinstance(value, bool) else "true or false"
    if name in SHARES or name in SMALL:
        return "" if _is_number(value, 0, 1) else "0 to 1"
    most = MOST_BLOCKS if name in BLOCKS else LARGEST
    values = value if isinstance(value, list | tuple) else [value]
    if 0 < len(values) <= 16 and all(_is_number(v, 0, most) for v in values):
        return ""
    return f"a number up to {most}, or a short list of them"


def _is_number(value: Any, low: float, high: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
