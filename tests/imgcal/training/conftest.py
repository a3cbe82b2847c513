import pytest

from tests.imgcal.training.toy import Toy, experiments


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """Every network that is built is the toy."""
    monkeypatch.setattr("imgcal.networks.factory.build", Toy)


@pytest.fixture
def experiment(tmp_path):
    """Make the toy's experiment with some values changed."""
    return experiments(tmp_path)
