"""Renderers: pixels, colours and visibility in, images out."""

from renderers.palette import palette
from renderers.reference import ellipse_reference, splat_reference
from renderers.splat import splat

__all__ = ["ellipse_reference", "palette", "splat", "splat_reference"]
