"""The task of positions: dots anywhere, and the losses of a locator."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.networks import Located, load_checkpoint, warm_start
from imgcal.training import Callbacks, load_experiment, prepare, train
from imgcal.training.positions import PositionBatch, PositionsExperiment, coarse_loss, fine_loss, random_dots

SMALL = (
    "network={preset: cnn, change: {width: 8, options: {dims: [4, 4, 8, 8], depths: [1, 1, 1, 1]}}}",
    "images={size: 32}",
    "training={steps: 4, batch_size: 4, validation_rigs: 8, validate_every: 4}",
    "levels=[0, 2]",
)


def experiment(*changes):
    return load_experiment("positions-cnn", (*SMALL, *changes), kind=PositionsExperiment)


@pytest.fixture(autouse=True)
def real(monkeypatch, toy):
    """The real networks, not the toy of this folder."""
    monkeypatch.undo()


class Kept(Callbacks):
    def __init__(self):
        self.rows, self.result = [], None

    def on_metrics(self, run, row, due):
        self.rows.append(row)

    def on_checkpoint(self, run, state, result):
        self.result = result


def test_a_training_makes_a_file_that_image_networks_start_from(tmp_path):
    kept = Kept()
    run = train(experiment(), kept)
    assert {"validation_px", "validation_lost", "validation_level2_lost"} <= {name for row in kept.rows for name in row}
    kept.result.save(tmp_path / "a.safetensors")
    network = load_checkpoint(tmp_path / "a.safetensors").network
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    left = warm_start(tmp_path / "a.safetensors", network)
    for one, other in zip(network.positions.parameters(), run.average.parameters(), strict=True):
        assert torch.equal(one, other)
    # Its trunk has learnt nothing, and replaces none that has.
    trunk = {name: parameter for name, parameter in network.named_parameters() if not name.startswith("positions.")}
    assert set(left) == set(trunk)
    assert all(not bool(parameter.any()) for parameter in trunk.values())


def test_only_networks_with_a_locator_learn_positions():
    with pytest.raises(InputError, match="task positions: found the network points, expected vit or cnn"):
        prepare(load_experiment("positions-cnn", ["network={preset: points}"]))


def test_dots_are_in_their_image_and_as_drawn_again():
    views = random_dots(300, 8, 64, torch.Generator().manual_seed(0))
    assert 0.6 < views.seen.float().mean() < 1 and views.uv.min() >= 0 and views.uv.max() <= 63
    again = random_dots(300, 8, 64, torch.Generator().manual_seed(0))
    assert torch.equal(views.uv, again.uv)


def located(logits, nowhere, uv=None, log_scale=None):
    images, fiducials = nowhere.shape
    nothing = torch.zeros(images, fiducials, 2)
    uv = nothing if uv is None else uv
    scale = torch.zeros(images, fiducials) if log_scale is None else log_scale
    return Located(uv, scale, torch.ones(images, fiducials), nothing + 8, logits, nowhere)


def test_the_cross_entropy_is_least_at_the_bilinear_shares():
    """By hand: a dot a quarter of a cell right of a centre, on a map of 4 x 4 cells of an image of 16 x 16."""
    uv = torch.tensor([[[7.0 + 0.5 - 0.5 - 0.5, 5.5]]])  # u: cell 1.25, v: cell 1
    cell = (uv + 0.5) / 4 - 0.5
    assert cell.flatten().tolist() == [1.25, 1.0]
    batch = PositionBatch(torch.zeros(1, 3, 16, 16), uv, torch.ones(1, 1, dtype=torch.bool))
    logits = torch.full((1, 1, 4, 4), -40.0)
    logits[0, 0, 1, 1], logits[0, 0, 1, 2] = torch.tensor([0.75, 0.25]).log()
    best = float(coarse_loss(located(logits, torch.full((1, 1), -40.0)), batch))
    assert best == pytest.approx(-(0.75 * torch.tensor(0.75).log() + 0.25 * torch.tensor(0.25).log()).item(), abs=1e-4)
    assert float(coarse_loss(located(logits.mT.contiguous(), torch.full((1, 1), -40.0)), batch)) > best


def test_what_is_not_seen_should_be_nowhere():
    batch = PositionBatch(torch.zeros(1, 3, 16, 16), torch.zeros(1, 1, 2), torch.zeros(1, 1, dtype=torch.bool))
    logits = torch.zeros(1, 1, 4, 4)
    sure, unsure = (float(coarse_loss(located(logits, torch.tensor([[value]])), batch)) for value in (20.0, 0.0))
    assert sure < 1e-4 and unsure == pytest.approx(torch.tensor(17.0).log().item(), abs=1e-5)


def test_the_likelihood_is_best_where_the_scale_is_the_error():
    truth = torch.tensor([[[8.5, 8.0], [20.0, 8.0]]])  # the second one is not where is looked: it does not count
    batch = PositionBatch(torch.zeros(1, 3, 32, 32), truth, torch.ones(1, 2, dtype=torch.bool))
    uv = torch.tensor([[[8.0, 8.5], [8.0, 8.0]]])

    def at(scale):
        log_scale = torch.full((1, 2), float(scale)).log()
        return float(fine_loss(located(torch.zeros(1, 2, 4, 4), torch.zeros(1, 2), uv, log_scale), batch))

    assert at(0.5) == pytest.approx(2 + 2 * torch.tensor(0.5).log().item(), abs=1e-5)
    assert at(0.5) < min(at(0.4), at(0.6))
