"""Networks of every preset, rigs and their views."""

import torch

from imgcal.io import load_object, read_rig
from imgcal.networks import NetworkConfig, build
from imgcal.synthesis import RelativeDrift, render_views, synthesize
from imgcal.types import Views
from tests.imgcal.lensed import lensed

DRIFT = RelativeDrift(0.02, 0.02)
SMALL = ["points", "points-one-pass", "points-cnn1d", "hue-centroids", "vit", "cnn", "vit-pooled", "cnn-pooled"]


def make(preset, rig="T4", obj="asymmetric8", lens=None, **change):
    factory, thing = read_rig(rig).to(torch.float32), load_object(obj)
    factory = factory if lens is None else lensed(factory, lens)
    weights = torch.Generator().manual_seed(0)
    return build(NetworkConfig(preset=preset, change=change), factory, thing, DRIFT.std(factory), weights).eval()


def snapshots(network, count=3, drift=DRIFT):
    return synthesize(network.factory, network.obj, count, torch.Generator().manual_seed(1), drift=drift)


def views(network, made):
    uv, seen = made.projection.uv, made.projection.visible
    if network.image_options is None:
        return Views(uv=uv, seen=seen)
    size = network.factory.image_size
    return Views(images=render_views(uv, seen, size, network.obj, network.image_options, quantise=True))
