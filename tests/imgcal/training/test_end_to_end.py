"""Training through the refinement: weights of fiducials learn to detect outliers."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, read_rig
from imgcal.synthesis import Corruption, PoseRange, RelativeDrift
from imgcal.training.data import Source, object_to
from imgcal.training.end_to_end import end_to_end_loss
from imgcal.training.losses import RefinedLoss
from imgcal.types import Prediction

CONFIG = RefinedLoss(weight=1.0)


@pytest.fixture
def source():
    rig = read_rig("T4").to(torch.float32)
    obj = object_to(load_object("asymmetric8"), "cpu")
    return Source(rig, obj, RelativeDrift(0.02, 0.02), PoseRange.overhead(), Corruption(noise=0.1))


def test_weights_learn_to_leave_outliers_out(source):
    generator = torch.Generator().manual_seed(2)
    made = source.sample(6, generator)
    batch = source.show(made, generator)
    wrong = torch.rand(batch.views.seen.shape, generator=generator) < 0.1
    batch.views.uv[wrong] += torch.tensor([0.5, -0.5])
    log_sigma = torch.zeros(wrong.shape, requires_grad=True)
    prior_std = source.drift.std(source.factory)

    def loss():
        prediction = Prediction(batch.truth.rig, batch.truth.rig_from_object, log_sigma)
        return end_to_end_loss(prediction, batch, source, prior_std, CONFIG)

    before = loss()
    before.backward()
    assert log_sigma.grad[wrong].mean() < 0  # more sigma for outliers: less error
    with torch.no_grad():
        log_sigma[wrong] = 6.0
    assert loss() < 0.9 * before.detach()


def test_without_weight_nothing_is_computed(source):
    assert end_to_end_loss(None, None, source, None, RefinedLoss()) == 0


def test_a_network_without_weights_is_refused(source):
    generator = torch.Generator().manual_seed(2)
    batch = source.show(source.sample(2, generator), generator)
    with pytest.raises(InputError, match="trust: true"):
        end_to_end_loss(batch.truth, batch, source, source.drift.std(source.factory), CONFIG)
