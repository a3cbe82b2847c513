import pytest
import torch

from imgcal.networks import Evidence, InfraredConfig, InfraredNetwork, normalize_crops
from imgcal.synthesis import render_crops, sample_scenes
from imgcal.training.infrared import evidence_at_best, make_queries, query_losses


def made_for(place: torch.Tensor, *, logit: float, present: float, spread: float) -> Evidence:
    """What a network would say that knows the places (P, N, 2)."""
    steps = 2.0 * torch.arange(8) - 7
    cells = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1) + torch.full((*place.shape[:2], 1, 1, 2), 20.0)
    offset = place[:, :, None, None] - cells
    near = (offset.abs() <= 1).all(-1)
    return Evidence(
        logit * near, offset, torch.full(near.shape, spread), torch.full(near.shape[:2], present), cells
    )  # fmt: skip


def test_who_knows_has_no_loss() -> None:
    place = torch.tensor([[[18.4, 23.1], [15.3, 20.2]]])
    yes = torch.ones(1, 2, dtype=torch.bool)
    perfect = query_losses(made_for(place, logit=30.0, present=20.0, spread=-3.0), yes, place, yes)
    assert float(perfect.cell) < 1e-4
    assert float(perfect.offset) < 1e-5
    assert float(perfect.presence) < 1e-4
    assert float(perfect.likelihood) == pytest.approx(-3.0, abs=1e-3)
    found, sigma, probability = evidence_at_best(made_for(place, logit=30.0, present=20.0, spread=-3.0))
    torch.testing.assert_close(found, place)
    assert bool((probability > 0.99).all())
    assert bool((sigma < 0.1).all())


def test_what_is_not_seen_or_outside_counts_for_presence_only() -> None:
    place = torch.tensor([[[18.4, 23.1], [90.0, 20.0]]])
    yes = torch.ones(1, 2, dtype=torch.bool)
    said = made_for(place, logit=0.0, present=4.0, spread=0.0)
    unseen = query_losses(said, yes, place, ~yes)
    assert float(unseen.cell) == 0
    assert float(unseen.presence) > 3
    # The second one lies outside of its window: it is not to be found there.
    assert float(query_losses(said, yes, place, yes).presence) == pytest.approx(2, abs=0.1)


def test_sigma_is_pulled_to_the_error() -> None:
    place = torch.tensor([[[18.4, 23.1]]])
    yes, spread = torch.ones(1, 1, dtype=torch.bool), torch.zeros((), requires_grad=True)
    said = made_for(place + 0.5, logit=30.0, present=9.0, spread=0.0)
    evidence = Evidence(said.logits, said.offset, said.log_sigma + spread, said.present, said.cells)
    (slope,) = torch.autograd.grad(query_losses(evidence, yes, place, yes).likelihood, spread)
    assert float(slope) == pytest.approx(1 - 0.25, abs=1e-4)  # falls until sigma is 0.5


@pytest.mark.parametrize("encoder", ["cnn", "vit"])
def test_every_weight_learns(encoder: str) -> None:
    torch.manual_seed(0)
    draw = torch.Generator().manual_seed(0)
    network = InfraredNetwork(InfraredConfig(encoder=encoder, channels=4, window=12, blocks=1))
    truth = render_crops(sample_scenes(3, 1, 5, draw), draw)
    queries = make_queries(truth)
    evidence = network(normalize_crops(truth.crops.flatten(0, 1)), queries)
    query_losses(evidence, queries.asked, truth.place.flatten(0, 1), truth.seen.flatten(0, 1)).total.backward()
    silent = [name for name, p in network.named_parameters() if p.grad is None or not bool(p.grad.any())]
    assert not silent
