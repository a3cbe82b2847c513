import json
import math
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import model_file
from imgcal.networks import (
    InfraredConfig,
    InfraredNetwork,
    Measurer,
    MeasurerConfig,
    load_program,
    normalize_crops,
    save_exported,
    save_onnx,
    use_generators,
)
from imgcal.networks.export import _measurer, _points, _query, difference
from imgcal.synthesis import render_crops, sample_scenes
from imgcal.types import PATCH_SIZE
from tests.imgcal.networks.making import make

EXAMPLES = Path(__file__).parents[3] / "scripts" / "examples"


@pytest.fixture
def runtime():
    pytest.importorskip("onnx", reason="no onnx (extra onnx): nothing is exported to it")
    return pytest.importorskip("onnxruntime", reason="no onnxruntime (extra onnx): nothing reads what is exported")


def rendered(fiducials):
    """Four crops of the project's own, made as those that networks are trained with, and what is expected in them."""
    draw = torch.Generator().manual_seed(2)
    return render_crops(sample_scenes(2, 2, fiducials, draw), draw)


def query_inputs(truth, fiducials=None):
    """Inputs of a query network, for an object of more fiducials than it has where so many are wanted."""
    wanted = truth.place.shape[2] if fiducials is None else fiducials
    more = (0, wanted - truth.place.shape[2])
    place = torch.nn.functional.pad(truth.expected.flatten(0, 1), (0, 0, *more))
    radius, depth = (torch.nn.functional.pad(part.flatten(0, 1), more) for part in (truth.radius, truth.depth))
    asked = torch.nn.functional.pad(torch.ones(4, truth.place.shape[2], dtype=torch.bool), more)
    return normalize_crops(truth.crops.flatten(0, 1)), place, radius, depth, asked


def run(runtime, path, program, inputs):
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    assert [one.name for one in session.get_inputs()] == list(program.inputs)
    assert [one.name for one in session.get_outputs()] == list(program.outputs)
    shapes = [json.loads(session.get_modelmeta().custom_metadata_map[name]) for name in ("inputs", "outputs")]
    assert shapes == [program.inputs, program.outputs]
    return session.run(None, {name: one.numpy() for name, one in zip(program.inputs, inputs, strict=True)})


def test_the_shipped_query_network_says_the_same_of_rendered_crops(runtime, tmp_path):
    truth = rendered(6)
    program = load_program(model_file("ir-cnn"), count=4, fiducials=8)
    assert save_onnx(program, tmp_path / "query.onnx") < 1e-5
    expected = program.module(*query_inputs(truth, 8))
    assert difference(run(runtime, tmp_path / "query.onnx", program, query_inputs(truth, 8)), expected) < 1e-5
    alone = program.module(*query_inputs(truth))  # those that are not asked for change nothing
    for one, other in zip(expected, alone, strict=True):
        torch.testing.assert_close(one[:, :6], other, atol=1e-4, rtol=1e-4)
    assert save_exported(program, tmp_path / "query.pt2") < 1e-5


def in_another_layout(tensor):
    """The same values, the last two axes swapped in memory."""
    return tensor.mT.contiguous().mT if tensor.ndim > 1 else tensor


def test_the_shipped_measurer_says_the_same_of_rendered_patches(runtime, tmp_path):
    crops = rendered(6).crops.flatten(0, 1)
    patches = normalize_crops(crops.unfold(1, PATCH_SIZE, 24).unfold(2, PATCH_SIZE, 24).flatten(0, 2))
    program = load_program(model_file("measurer-cnn"), count=len(patches))
    save_onnx(program, tmp_path / "measurer.onnx")
    inputs = patches, torch.linspace(1.0, 4.0, len(patches))
    assert difference(run(runtime, tmp_path / "measurer.onnx", program, inputs), program.module(*inputs)) < 1e-5
    save_exported(program, tmp_path / "measurer.pt2")
    loaded = torch.export.load(tmp_path / "measurer.pt2").module()
    few = tuple(in_another_layout(one[:3]) for one in inputs)
    assert difference([one.numpy() for one in loaded(*few)], program.module(*few)) < 1e-5


@pytest.mark.parametrize("kind", [pytest.param("points", marks=pytest.mark.slow), "measurer vit", "query vit"])
def test_other_networks_say_the_same(runtime, tmp_path, kind):
    with use_generators(torch.Generator().manual_seed(0)):
        if kind == "points":
            network = make("points", trunk={"width": 32, "depth": 1, "later_depth": 1, "passes": 2})
            for parameter in network.parameters():
                parameter.data += 0.02 * torch.randn(parameter.shape)
            program = _points(tmp_path, network, 1)
        elif kind == "measurer vit":
            program = _measurer(Measurer(MeasurerConfig(encoder="vit")), 3)
        else:
            program = _query(InfraredNetwork(InfraredConfig(encoder="vit", blocks=1)), 2, 5)
    program.module.eval().requires_grad_(False)
    assert save_onnx(program, tmp_path / "one.onnx") < 1e-5
    if kind == "points":
        assert save_exported(program, tmp_path / "one.pt2") < 1e-5
        loaded = torch.export.load(tmp_path / "one.pt2").module()
        for laid in (torch.Tensor.contiguous, in_another_layout):
            given = tuple(map(laid, program.example))
            assert difference([one.numpy() for one in loaded(*given)], program.module(*given)) < 1e-5


def test_a_file_that_is_no_such_network_is_refused(tmp_path):
    for path, said in (
        (model_file("cnn-O10-cube8"), "found an image network"),
        (tmp_path / "none.safetensors", "No such file"),
        (Path(__file__), "not a safetensors file"),
    ):
        with pytest.raises(InputError, match=said):
            load_program(path)


def test_other_numbers_are_told():
    assert (
        difference([np.array([1.0, np.nan])], [torch.ones(2)]) == math.inf == difference([np.ones(3)], [torch.ones(2)])
    )


def test_the_example_measures_with_numpy_alone(runtime, tmp_path):
    example = runpy.run_path(str(EXAMPLES / "run_onnx.py"))
    crops = rendered(5).crops.flatten(0, 1).double()
    crops[0, 60:] = torch.nan  # beside the image
    assert np.allclose(example["normalized"](crops.numpy()), normalize_crops(crops), atol=1e-6)
    program = load_program(model_file("measurer-cnn"))
    save_onnx(program, tmp_path / "measurer.onnx")
    v, u = np.mgrid[0:128, 0:160]
    frame = 20 + 180 / (1 + np.exp(3 * (np.hypot(u - 101.3, v - 63.8) - 3)))
    frame += np.random.default_rng(0).normal(0, 2, u.shape)
    session = runtime.InferenceSession(str(tmp_path / "measurer.onnx"))
    centre, sigma, odds = example["measure"](session, frame, (101, 64), 3.0)
    assert np.hypot(*(centre - [101.3, 63.8])) < 0.15 and sigma < 0.2 and odds > 0.9
