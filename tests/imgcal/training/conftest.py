import pytest

from imgcal.training import experiment_file
from tests.imgcal.training.line import EXPERIMENT as LINE
from tests.imgcal.training.line import LineExperiment
from tests.imgcal.training.toy import Toy, experiments


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """Every network that is built is the toy."""
    monkeypatch.setattr("imgcal.networks.factory.build", Toy)


@pytest.fixture
def experiment(tmp_path):
    """Make the toy's experiment with some values changed."""
    return experiments(tmp_path)


@pytest.fixture
def line(tmp_path, monkeypatch):
    """Make the experiment of a line, with some values changed."""
    monkeypatch.setitem(experiment_file.KINDS, "line", LineExperiment)
    path = tmp_path / "line.yaml"
    path.write_text(LINE)
    return lambda *changes: experiment_file.load_experiment(path, changes)
