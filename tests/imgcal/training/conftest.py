import pytest

from imgcal import networks
from imgcal.training.experiment import Experiment, load_experiment
from tests.imgcal.training.toy import EXPERIMENT, Toy


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """Every network that is built is the toy."""
    monkeypatch.setattr(networks, "build", Toy)


@pytest.fixture
def experiment(tmp_path):
    """Make the toy's experiment with some values changed."""

    def make(*changes: str) -> Experiment:
        path = tmp_path / "toy.yaml"
        path.write_text(EXPERIMENT)
        return load_experiment(path, changes)

    return make
