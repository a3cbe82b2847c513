"""Show what encoders of infrared crops look at: the pixels that the probability of a fiducial's true cell depends on.

`python -m scripts.results.saliency out/runs/ir-cnn-seed0 out/runs/ir-vit-seed0 ...` draws crops with a map for each
network: the gradient of the log probability of the true cell of one fiducial with respect to each pixel. The table
gives the radii around the fiducial that contain half, and nine tenths, of it: means over all fiducials of many crops.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from imgcal.networks import InfraredNetwork, load_infrared
from imgcal.training import InfraredTask, change_experiment, load_experiment
from imgcal.training.infrared_task import CropBatch
from scripts.output import RED, RESULTS, command, figure, fill, markdown, surroundings, write_json

JSON, PICTURE = RESULTS / "saliency.json", RESULTS / "saliency.png"
PAGE = RESULTS / "infrared.md"
SEED = 77
SHARES = (0.5, 0.9)


@dataclass(frozen=True)
class Options:
    """Show what infrared networks look at."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]  #: folders of training runs of infrared networks
    crops: int = 96
    shown: int = 5  #: crops in the picture


def main(options: Options) -> None:
    """Measure, draw and write the results."""
    networks = {
        run.name.partition("-seed")[0]: load_infrared(run / "model.safetensors").network for run in options.runs
    }
    batch = crops_of(next(iter(networks.values())), options.crops)
    fiducial = (batch.seen & batch.queries.asked).float().argmax(1)  # (P,) the first visible one
    rows = torch.arange(len(fiducial))
    rows = rows[(batch.seen & batch.queries.asked)[rows, fiducial]]
    maps = {name: saliency(network, batch, fiducial) for name, network in networks.items()}
    place = batch.place[rows, fiducial[rows]]
    reach = {name: [float(r.mean()) for r in reaches(found[rows], place)] for name, found in maps.items()}
    draw(batch, maps, rows[: options.shown], fiducial)
    write_json(JSON, surroundings() | {"crops": len(rows), "shares": SHARES, "reach_px": reach})
    table = [[name, *(f"{value:.1f}" for value in values)] for name, values in reach.items()]
    head = ["encoder", *(f"{share:.0%} within, crop pixels" for share in SHARES)]
    fill(PAGE, {"infrared saliency": markdown(head, table)})
    print(markdown(head, table))


def crops_of(network: InfraredNetwork, count: int) -> CropBatch:
    """Draw crops that were not used for training."""
    experiment = change_experiment(load_experiment("ir-cnn"), f"network.encoder={network.config.encoder}")
    task = experiment.make_task(torch.device("cpu"), count, torch.Generator(), fresh=False)
    assert isinstance(task, InfraredTask)
    return task.batch(count, torch.Generator().manual_seed(SEED))


def saliency(network: InfraredNetwork, batch: CropBatch, fiducial: Tensor) -> Tensor:
    """Absolute gradient of a fiducial's log probability at its true cell with respect to each pixel: (P, S, S)."""
    crops = batch.crops.detach().clone().requires_grad_()
    evidence = network(crops, batch.queries, batch.window)
    rows = torch.arange(len(fiducial))
    cells, logits = evidence.cells[rows, fiducial].flatten(1, 2), evidence.logits[rows, fiducial].flatten(1)
    nearest = (cells - batch.place[rows, fiducial][:, None]).square().sum(-1).argmin(1)
    logits.log_softmax(-1)[rows, nearest].sum().backward()
    assert crops.grad is not None
    return crops.grad.abs()


def reaches(maps: Tensor, place: Tensor) -> list[Tensor]:
    """Distances (P,) in crop pixels from places (P, 2) within which `SHARES` of maps (P, S, S) lie."""
    steps = torch.arange(maps.shape[-1], dtype=maps.dtype)
    off = (steps - place[:, 0, None]).square()[:, None, :] + (steps - place[:, 1, None]).square()[:, :, None]
    distance, order = off.sqrt().flatten(1).sort(1)
    share = maps.flatten(1).gather(1, order).cumsum(1)
    share = share / share[:, -1:]
    within = ((share < part).sum(1, keepdim=True).clamp(max=distance.shape[1] - 1) for part in SHARES)
    return [distance.gather(1, index)[:, 0] for index in within]


def draw(batch: CropBatch, maps: dict[str, Tensor], rows: Tensor, fiducial: Tensor) -> None:
    """Draw one column per crop: the crop with the fiducial marked, then one row per network."""
    columns = len(rows)
    with figure(PICTURE, columns, 1 + len(maps), (2.0 * columns, 2.0 * (1 + len(maps)))) as panels:
        for column, row in enumerate(rows.tolist()):
            u, v = batch.place[row, fiducial[row]].tolist()
            for line, (name, image) in enumerate([("crop", batch.crops), *maps.items()]):
                axes = panels[line * columns + column]
                shown = image[row] if line == 0 else image[row] / image[row].max()
                axes.imshow(shown.numpy() ** (1.0 if line == 0 else 0.5), cmap="gray" if line == 0 else "magma")
                axes.plot(
                    u, v, "o", markersize=12, fillstyle="none", color=RED if line == 0 else "white", linewidth=0.8
                )
                axes.set_xticks([])
                axes.set_yticks([])
                axes.set_ylabel(name if column == 0 else "")


if __name__ == "__main__":
    command(lambda: main(tyro.cli(Options, description=__doc__)))
