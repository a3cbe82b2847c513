"""Compare image encoders by difficulty of the images: ViT, CNN, and methods without learning.

Usage: python -m scripts.results.encoders out/runs/shipped-vit-cube8-seed{0,1,2} out/runs/shipped-cnn-cube8-seed{0,1,2}

Every method sees the same images of the same rigs, at each of `imgcal.synthesis.LEVELS`. Runs of one preset are seeds
of one family. Runs are added to those on the same rigs in docs/results/encoders.json. The table goes between the
markers `encoders` of docs/results/tables.md.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from imgcal.errors import InputError
from imgcal.evaluation import refine_by_positions, reprojection_error
from imgcal.io import data_path
from imgcal.networks import (
    Checkpoint,
    HueCentroidNetwork,
    ImageNetwork,
    NetworkConfig,
    Positions,
    build,
    load_checkpoint,
    warm_start,
)
from imgcal.refinement import (
    ImageRefinementOptions,
    make_prediction,
    refine_images,
    refine_points,
    refine_robustly,
    robust_pose,
)
from imgcal.synthesis import LEVELS, Corrupted, ImageOptions, synthesize
from imgcal.types import CalibrationObject, CameraRig, Prediction, Views
from scripts.output import RESULTS, command, fill, markdown, read_json, surroundings, write_json

PAGE = RESULTS / "tables.md"
MARKER = "encoders"
SUCCESS = 1.0  # px of RE below which a refined rig counts as found
NEAR = 3.0  # px of the sensor below which a position counts as right
BATCH = 10  # rigs per batch
RENDERED = 20  # rigs per level for render-and-compare, which is slow where it fails
SIGMAS = (0.1, 0.5, 2.0)  # px: methods that predict no sigma get the best of these for each level,
# and the better of two robust refinements: graduated non-convexity, and Cauchy's loss.


@dataclass(frozen=True)
class Options:
    """Measure image encoders by difficulty."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]  #: folders of training runs, or model files
    rigs: int = 100  #: a level
    seed: int = 0
    out: Path = RESULTS  #: folder of encoders.json
    page: Path = PAGE  #: page with the table
    again: bool = False  #: measure nothing: rewrite the table from the existing JSON


@dataclass(frozen=True)
class Shown:
    """Images of rigs, and the truth about them."""

    images: Tensor  # (B, C, 3, H, W)
    truth: Prediction  # (B,)
    drawn: Corrupted  # (B,)

    def __getitem__(self, rows: slice) -> Shown:
        views = Views(*(None if part is None else part[rows] for part in (self.drawn.views.uv, self.drawn.views.seen)))
        drawn = Corrupted(views, self.drawn.inlier[rows], self.drawn.fault[rows])
        return Shown(self.images[rows], self.truth[rows], drawn)


def main(arguments: list[str]) -> None:
    """Measure, write and print."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    path = options.out / "encoders.json"
    if not options.again:
        if not options.runs:
            raise InputError("found no folder of a training run, expected at least one")
        write_json(path, measured(options))
    text = table(read_json(path))
    print(text)
    fill(options.page, {MARKER: text})


@torch.no_grad()
def measured(options: Options) -> dict[str, Any]:
    """Measure all runs at all levels."""
    files = [run / "model.safetensors" if run.is_dir() else run for run in options.runs]
    models = {str(run): load_checkpoint(file) for run, file in zip(options.runs, files, strict=True)}
    first = next(iter(models.values()))
    hue = hue_network(first)
    subject = {"rigs": options.rigs, "seed": options.seed, "rig": first.rig.name, "object": first.obj.name}
    before = _before(options.out / "encoders.json", subject)
    levels: list[dict[str, Any]] = before.get("levels", [{} for _ in LEVELS])
    result: dict[str, Any] = surroundings() | subject | {"models": before.get("models", {}), "levels": levels}
    for run, one in models.items():
        result["models"][Path(run).name] = facts(one)
    for number in range(len(LEVELS)):
        shown, level = draw(first, number, options.rigs, options.seed), levels[number]
        if "hue-centroids" not in level:
            level["hue-centroids"] = of_hue(hue, shown, first)
        for run, one in models.items():
            assert isinstance(one.network, ImageNetwork)
            level[Path(run).name] = of_network(one.network, shown, one)
            print(f"level {number}, {Path(run).name}: {level[Path(run).name]}", flush=True)
        print(f"level {number}, hue: {level['hue-centroids']}", flush=True)
    return result


def _before(path: Path, subject: dict[str, Any]) -> dict[str, Any]:
    """Earlier results on the same rigs, to which runs are added."""
    found = read_json(path) if path.is_file() else {}
    return found if subject.items() <= found.items() else {}


def hue_network(like: Checkpoint) -> HueCentroidNetwork:
    """Make the baseline: hue centroids, and the trunk of the shipped point network."""
    drift = like.experiment.drift.std(like.rig).to(torch.float32)
    rig = like.rig.to(torch.float32)
    network = build(NetworkConfig(preset="hue-centroids"), rig, like.obj, drift, torch.Generator().manual_seed(0))
    warm_start(data_path("models", f"points-{like.rig.name}-{like.obj.name}.safetensors"), network)
    assert isinstance(network, HueCentroidNetwork)
    return network.eval()


def draw(model: Checkpoint, level: int, count: int, seed: int) -> Shown:
    """Draw random rigs from a model's training distribution, and render them at a level."""
    generator = torch.Generator().manual_seed(seed)
    factory, experiment = model.rig.to(torch.float32), model.experiment
    made = synthesize(factory, model.obj, count, generator, drift=experiment.drift, pose_range=experiment.poses)
    views = Views(made.projection.uv, made.projection.visible)
    given = (factory.image_size, model.obj, model.network.image_options or ImageOptions())
    images, drawn = LEVELS[level].draw(views, *given, generator)
    return Shown(images, Prediction(made.rig, made.rig_from_object), drawn)


def of_network(network: ImageNetwork, shown: Shown, model: Checkpoint) -> dict[str, float]:
    """Measure a network at one level: positions, passes, both refinements, and the encoder shuffled."""
    passes, sightings = looked(network, shown)
    last = passes[-1]
    result = of_positions(sightings, shown) | {"one_pass_px": median(passes[0], shown, model)}
    result["last_pass_px"] = median(last, shown, model)
    found = refine_by_positions(last, sightings, model.rig, model.obj, model.drift_std)
    result |= refined("points", found, shown, model)
    few = slice(0, RENDERED)
    result |= refined("images", by_images(last[few], shown[few], model), shown[few], model)
    cameras = model.rig.num_cameras  # rolled by this many images, each rig gets another rig's maps
    handle = network.encoder.register_forward_hook(lambda module, inputs, output: output.roll(cameras, 0))
    spoilt, _ = looked(network, shown)
    handle.remove()
    return result | {"shuffled_px": median(spoilt[-1], shown, model)}


def of_hue(network: HueCentroidNetwork, shown: Shown, model: Checkpoint) -> dict[str, float]:
    """Measure centres by hue: with the trunk, and with robust PnP, each refined with the best sigma for the level."""
    passes, sightings = looked(network, shown)
    result = of_positions(sightings, shown) | {"one_pass_px": median(passes[0], shown, model)}
    result["last_pass_px"] = median(passes[-1], shown, model)
    best: dict[str, dict[str, float]] = {}
    for sigma in SIGMAS:
        start = pnp(sightings.views, sigma, passes[-1], model)
        for name, guess in (("points", passes[-1]), ("pnp", start)):
            for refine in (refine_robustly, by_cauchy):
                rigs = refine(guess, sightings.views, model.rig, model.obj, model.drift_std, sigma=sigma)
                found = refined(name, rigs, shown, model)
                best[name] = max(best.get(name, found), found, key=lambda one: one[f"{name}_success"])
    few = slice(0, RENDERED)
    images = refined("images", by_images(passes[-1][few], shown[few], model), shown[few], model)
    return result | best["points"] | best["pnp"] | images


def looked(network: ImageNetwork | HueCentroidNetwork, shown: Shown) -> tuple[list[Prediction], Positions]:
    """Run a network in batches: predictions of all passes, and positions."""
    parts, seen = [], []
    for start in range(0, len(shown.images), BATCH):
        sightings = network.sight(shown.images[start : start + BATCH])
        parts.append(network.trunk(sightings.uv, sightings.weight))
        seen.append(sightings)
    passes = [Prediction.cat(part) for part in zip(*parts, strict=True)]
    joined = Positions(*(torch.cat([getattr(one, name) for one in seen]) for name in ("uv", "sigma", "confidence")))
    return passes, joined


def of_positions(sightings: Positions, shown: Shown) -> dict[str, float]:
    """Errors of the positions of visible dots, in pixels of the sensor; and the share of wrong claims."""
    uv, seen = shown.drawn.views.uv, shown.drawn.views.seen
    assert uv is not None and seen is not None
    error = (sightings.uv - uv).norm(dim=-1)
    sure = sightings.views.seen
    assert sure is not None
    right = seen & (error < NEAR)
    return {
        "position_px": float(error[seen].median()),
        "position_share": float(right.sum() / seen.sum()),
        "wrong_share": float((sure & ~right).sum() / sure.sum().clamp_min(1)),
    }


def by_cauchy(
    guess: Prediction, views: Views, factory: CameraRig, obj: CalibrationObject, prior_std: Tensor, *, sigma: float
) -> Prediction:
    """Refine as for image networks, with one sigma for all points."""
    return make_prediction(refine_points(guess, views, factory, obj, prior_std, sigma))


def by_images(guess: Prediction, shown: Shown, model: Checkpoint) -> Prediction:
    """Refine by rendering and comparing images."""
    options = ImageRefinementOptions(image=model.network.image_options or ImageOptions(), position_noise=0.1)
    parts = []
    for start in range(0, len(shown.images), BATCH):
        rows = slice(start, start + BATCH)
        start_at = guess[rows].detach().to(torch.float64)
        fit, _ = refine_images(start_at, shown.images[rows], model.rig, model.obj, model.drift_std, options)
        parts.append(make_prediction(fit))
    return Prediction.cat(parts)


def pnp(views: Views, sigma: float, otherwise: Prediction, model: Checkpoint) -> Prediction:
    """Robust PnP for each rig; the pose of `otherwise` where too few points were found."""
    uv, seen = views.uv, views.seen
    assert uv is not None and seen is not None
    found = []
    for rig in range(len(uv)):
        try:
            one = Views(uv[rig : rig + 1].double(), seen[rig : rig + 1])
            found.append(robust_pose(one, model.rig, model.obj, sigma))
        except torch.linalg.LinAlgError:
            found.append(otherwise[rig : rig + 1].to(torch.float64))
    return Prediction.cat([replace(one, log_sigma=None) for one in found])


def errors(found: Prediction, shown: Shown, model: Checkpoint) -> Tensor:
    """RE of each rig on exact points, pixels; infinite where it is not finite."""
    exact = found.to(torch.float64).cameras_from_object, shown.truth.to(torch.float64).cameras_from_object
    return reprojection_error(*exact, model.obj).nan_to_num(torch.inf)


def median(found: Prediction, shown: Shown, model: Checkpoint) -> float:
    """Median RE, pixels."""
    return float(errors(found, shown, model).median())


def refined(name: str, found: Prediction, shown: Shown, model: Checkpoint) -> dict[str, float]:
    """Median RE after a refinement, and the share of rigs below `SUCCESS`."""
    re = errors(found, shown, model)
    return {f"{name}_px": float(re.median()), f"{name}_success": float((re < SUCCESS).double().mean())}


def facts(model: Checkpoint) -> dict[str, Any]:
    """Size of an encoder with its heads, and its cost per image."""
    network, experiment = model.network, model.experiment
    assert isinstance(network, ImageNetwork) and network.image_options is not None
    size = network.image_options.size
    with FlopCounterMode(display=False) as counter:
        network.positions(torch.zeros(1, 3, size, size))
    return {
        "family": experiment.network.preset,
        "parameters": sum(parameter.numel() for parameter in network.positions.parameters()),
        "flops": counter.get_total_flops(),
        "seconds": dict(model.metrics).get("seconds"),
    }


def table(result: dict[str, Any]) -> str:
    """Make a table with one line per level and family: mean over seeds, and their range."""
    head = (
        "level", "method", "seeds", "position, px", f"within {NEAR:g} px", "one pass", "last pass",
        "refined on positions", "success", "render and compare", "success", "encoder shuffled",
    )  # fmt: skip
    families: dict[str, list[str]] = {}
    for name, one in result["models"].items():
        families.setdefault(one["family"], []).append(name)
    rows = []
    for number, level in enumerate(result["levels"]):
        for family, names in families.items():
            rows.append([str(number), family, str(len(names)), *_cells([level[name] for name in names])])
        hue = level["hue-centroids"]
        rows.append([str(number), "hue-centroids", "", *_cells([hue])])
        pnp = ["", "", "", "", *_pair([hue], "pnp")]
        rows.append([str(number), "hue, robust PnP + MAP", "", *pnp])
    return "\n\n".join((_sizes(result, families), markdown(head, rows)))


def _sizes(result: dict[str, Any], families: dict[str, list[str]]) -> str:
    rows = []
    for family, names in families.items():
        first = result["models"][names[0]]
        rows.append([family, f"{first['parameters'] / 1e6:.2f} M", f"{first['flops'] / 1e9:.2f}", str(len(names))])
    return markdown(("encoder and heads", "parameters", "GFLOP per image", "seeds"), rows)


def _cells(seeds: Sequence[dict[str, float]]) -> list[str]:
    positions = [_number(seeds, "position_px"), _share(seeds, "position_share")]
    passes = [_number(seeds, "one_pass_px"), _number(seeds, "last_pass_px")]
    shuffled = _number(seeds, "shuffled_px") if "shuffled_px" in seeds[0] else ""
    return [*positions, *passes, *_pair(seeds, "points"), *_pair(seeds, "images"), shuffled]


def _pair(seeds: Sequence[dict[str, float]], name: str) -> list[str]:
    return [_number(seeds, f"{name}_px"), f"**{_share(seeds, f'{name}_success')}**"]


def _number(seeds: Sequence[dict[str, float]], name: str) -> str:
    return _ranged(seeds, name, lambda value: f"{value:.3g}")


def _share(seeds: Sequence[dict[str, float]], name: str) -> str:
    return _ranged(seeds, name, lambda value: f"{100 * value:.3g} %")


def _ranged(seeds: Sequence[dict[str, float]], name: str, show: Callable[[float], str]) -> str:
    """Mean over seeds, with the lowest and the highest if they differ."""
    values = [float("inf") if one[name] is None else one[name] for one in seeds]
    text, low, high = show(statistics.fmean(values)), show(min(values)), show(max(values))
    return text if low == high else f"{text} ({low} to {high})"


if __name__ == "__main__":
    command(lambda: main(sys.argv[1:]))
