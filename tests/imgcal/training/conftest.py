import pytest

from imgcal import networks
from imgcal.training.experiment import Experiment, changed, load_experiment
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
        made = load_experiment(path)
        for change in changes:
            made = changed(made, change)
        return made

    return make
