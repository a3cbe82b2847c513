"""Every preset: size, shapes, where it starts, and that the reprojection loss trains every head."""

import pytest
import torch

from imgcal.errors import InputError
from imgcal.io import load_object, load_rig
from imgcal.networks import PRESETS, NetworkConfig, build, drawing_from
from imgcal.synthesis.colour_coding import ImageOptions, render_views
from imgcal.synthesis.rigs import RelativeDrift, synthesize
from imgcal.training.losses import project_fiducials
from imgcal.types import Views

DRIFT = RelativeDrift(0.02, 0.02)
SMALL = ["points", "points-one-pass", "points-cnn1d", "vit", "cnn", "vit-pooled", "cnn-pooled"]


def make(preset, rig="T4", obj="asymmetric8", **change):
    factory, thing = load_rig(rig).to(torch.float32), load_object(obj)
    weights = torch.Generator().manual_seed(0)
    return build(NetworkConfig(preset=preset, change=change), factory, thing, DRIFT.std(factory), weights).eval()


def snapshots(network, count=3, drift=DRIFT):
    return synthesize(network.factory, network.obj, count, torch.Generator().manual_seed(1), drift=drift)


def views(network, made):
    uv, seen = made.projection.uv, made.projection.visible
    if network.image_options is None:
        return Views(uv=uv, seen=seen)
    size = network.factory.image_size
    return Views(images=render_views(uv, seen, size, network.obj, network.image_options, quantise=True))


def millions(network):
    return sum(parameter.numel() for parameter in network.parameters()) / 1e6


@pytest.mark.parametrize(
    ("preset", "expected"), [("paper-points", 33), ("paper-cnn1d", 8), ("paper-vit", 86), ("paper-cnn2d", 24)]
)
def test_presets_of_the_paper_have_its_size(preset, expected):
    assert millions(make(preset, "O10", "cube8")) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("preset", ["points", "vit", "cnn"])
def test_presets_that_ship_are_small(preset):
    assert 1 < millions(make(preset, "O10")) < 2.6


@pytest.mark.parametrize("preset", SMALL)
def test_an_untrained_network_returns_the_factory_calibration(preset):
    network = make(preset)
    predictions = network(views(network, snapshots(network)))
    assert len(predictions) == network.trunk.passes
    for prediction in predictions:
        assert torch.equal(prediction.rig.focal_length, network.factory.focal_length.expand(3, -1, -1))
        assert prediction.rig.local(network.factory).abs().max() < 1e-3


@pytest.mark.parametrize("preset", ["paper-points", "paper-cnn1d"])
def test_paper_networks_return_cameras_of_their_own(preset):
    network = make(preset, width=32, head_widths=(16,))
    (prediction,) = network(views(network, snapshots(network)))
    assert prediction.cameras_from_object.focal_length.shape == (3, 4, 2)
    rotation = prediction.cameras_from_object.cam_from_rig.rotation
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3), atol=1e-5)


@pytest.mark.parametrize("preset", ["points", "points-cnn1d", "paper-points", "vit"])
def test_reprojection_error_trains_every_parameter(preset):
    network = make(preset)
    made = snapshots(network)
    with torch.no_grad():  # away from the start, whose zero heads pass nothing on to what lies before them
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    given = views(network, made)
    errors = [project_fiducials(p.cameras_from_object, network.obj) - made.projection.uv for p in network(given)]
    torch.stack(errors).square().mean().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


@pytest.mark.parametrize("preset", ["points", "vit"])
def test_batches_do_not_mix(preset):
    network = make(preset)
    made = snapshots(network)
    given = views(network, made)
    one = Views(*(None if x is None else x[1:2] for x in (given.uv, given.seen, given.images)))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
        whole, alone = network(given)[-1], network(one)[-1]
    assert torch.allclose(whole.rig.focal_length[1:2], alone.rig.focal_length, rtol=1e-5)
    assert torch.allclose(whole.rig_from_object.rotation[1:2], alone.rig_from_object.rotation, atol=1e-5)


def test_what_is_not_seen_does_not_matter():
    network = make("points")
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    made = snapshots(network)
    seen = made.projection.visible.clone()
    seen[:, 1, 3] = False
    moved = made.projection.uv.clone()
    moved[:, 1, 3] += 500
    with torch.no_grad():
        first, second = (network(Views(uv=uv, seen=seen))[-1] for uv in (made.projection.uv, moved))
    assert torch.equal(first.rig.focal_length, second.rig.focal_length)


def test_positions_reach_the_paper_network_in_float32_under_autocast():
    network = make("paper-points", width=32, head_widths=(16,))
    seen = []
    network.embed.register_forward_hook(lambda module, given, out: seen.append(out.dtype))
    with torch.autocast("cpu", torch.bfloat16):
        network(views(network, snapshots(network)))
    assert seen == [torch.float32]


def test_autocast_leaves_geometry_alone():
    network = make("points")
    with torch.autocast("cpu", torch.bfloat16):
        prediction = network(views(network, snapshots(network)))[-1]
    assert prediction.rig.focal_length.dtype == torch.float32
    assert torch.equal(prediction.rig.focal_length, network.factory.focal_length.expand(3, -1, -1))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"preset": "pointz"}, "nearest: points"),
        ({"preset": "points", "change": {"trunk": {"widht": 3}}}, "nearest: width"),
        ({"preset": "points", "change": {"trunk": {"passes": 0}}}, "greater than or equal to 1"),
        ({"preset": "points", "change": {"trunk": {"width": 130}}}, "found width 130 and 4 heads"),
        ({"preset": "paper-points", "change": {"heads": 3}}, "found width 512 and 3 heads"),
        ({"preset": "paper-vit", "change": {"head_widths": [0]}}, "greater than or equal to 1"),
    ],
)
def test_impossible_configurations_are_refused(config, message):
    with pytest.raises(ValueError, match=message):
        NetworkConfig(**config)


@pytest.mark.parametrize(
    ("backbone", "options"),
    [
        ("swin_tiny_patch4_window7_224", {"embed_dim": 24, "depths": [1, 1], "num_heads": [1, 2]}),  # channels last
        ("mixer_s32_224", {}),  # tokens, and none before the patches
        ("mobilenetv3_small_050", {}),  # a pooled feature of another width than the map's
        ("deit_tiny_distilled_patch16_224", {"depth": 1}),  # two tokens before the patches
    ],
)
def test_any_backbone_fits(backbone, options):
    network = make("vit", backbone=backbone, options=options)
    with torch.no_grad():
        images = torch.rand(2, 3, 224, 224, generator=torch.Generator().manual_seed(0))
        shifted = images.clone()
        shifted[1, :, 112:] = 0  # the lower half of one image
        (pooled, here), (_, there) = network.backbone(images), network.backbone(shifted)
        assert pooled.shape == (2, network.bottleneck.in_features)
        assert here.shape[:2] == (2, network.belief.in_channels)
        assert here.shape[2] == here.shape[3]
        apart = (here - there).abs().sum(1)
        assert apart[0].max() == 0
        assert apart[1, -1].mean() > apart[1, 0].mean()  # rows are rows
        assert len(network(views(network, snapshots(network)))) == network.trunk.passes


@pytest.mark.parametrize(
    ("backbone", "options", "size"),
    [
        ("vit_tiny_patch16_384", {"depth": 1}, 384),
        ("vit_small_patch14_dinov2", {"depth": 1}, 518),
        ("vit_small_patch14_reg4_dinov2", {"depth": 1, "img_size": 224}, 224),
        ("eva02_tiny_patch14_336", {"depth": 1}, 336),
    ],
)
def test_a_backbone_gets_images_of_its_own_size(backbone, options, size):
    network = make("vit", backbone=backbone, options=options)
    assert network.backbone.size == (size, size) and network.image_options.size == size
    with torch.no_grad():
        assert len(network(views(network, snapshots(network)))) == network.trunk.passes


@pytest.mark.parametrize("preset", ["paper-vit", "vit"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"checkpoint_path": "/tmp/evil.pth"}, "checkpoint_path"),
        ({"pretrained_cfg": {"file": "/tmp/evil.pth"}}, "pretrained_cfg"),
        ({"pretrained_cfg_overlay": {"file": "/tmp/evil.pth"}}, "pretrained_cfg_overlay"),
        ({"cache_dir": "/tmp"}, "cache_dir"),
        ({"scriptable": True}, "scriptable"),
        ({"depth": 10_000_000}, "up to 128"),
        ({"embed_dim": 10**9}, "up to 8192"),
        ({"embed_dim": float("nan")}, "up to 8192"),
        ({"depths": [[3]]}, "up to 128"),
        ({"act_layer": "os.system"}, "short word"),
        ({"drop_rate": -1}, "0 to 1"),
        ({"x" * 1000: 1}, "x{37}\\.\\.\\.`"),
    ],
)
def test_options_that_are_not_of_a_shape_are_refused(preset, options, message, monkeypatch):
    monkeypatch.setattr("imgcal.networks.backbone.timm.create_model", None)
    with pytest.raises(ValueError, match=message):
        NetworkConfig(preset=preset, change={"options": options})


@pytest.mark.parametrize(
    "backbone", ["local-dir:/tmp/evil", "hf-hub:evil/vit", "/tmp/evil", "../vit_tiny_patch16_224", "x" * 150]
)
def test_a_backbone_is_no_place(backbone, monkeypatch):
    monkeypatch.setattr("imgcal.networks.backbone.timm.create_model", None)
    with pytest.raises(InputError, match="expected a timm model"):
        make("vit", backbone=backbone, options={})


def test_options_that_do_not_go_together_are_one_line():
    for options in ({"embed_dim": 100, "num_heads": 3}, {"patch_size": 0}, {"dims": [8]}, {"depth": [1, 2]}):
        with pytest.raises(InputError, match="backbone vit_tiny_patch16_224") as caught:
            make("vit", options=options)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    "change", [{"width": 4096, "depth": 64}, {"depth": 10**7}, {"width": 10**6}, {"passes": 10**6}]
)
def test_a_network_that_fits_in_no_memory_is_refused_before_it_is_built(change):
    with pytest.raises(ValueError, match=r"fits in memory|less than or equal"):
        NetworkConfig(preset="points", change={"trunk": change})


def test_the_weights_of_a_backbone_are_counted_before_they_are_made(monkeypatch):
    with pytest.raises(InputError, match=r"1,842,\d+,\d+ weights, expected at most"):
        make("vit", backbone="vit_gigantic_patch14_224", options={})


def test_an_unknown_backbone_is_refused():
    with pytest.raises(InputError, match="nearest: vit_tiny_patch16_224"):
        make("vit", backbone="vit_tiny_patch16_225")


def test_pretrained_weights_that_cannot_be_loaded_say_what_to_do(monkeypatch, tmp_path):
    def offline(*_, **__):
        raise OSError("no route to host")

    monkeypatch.setattr("imgcal.networks.backbone.timm.create_model", offline)
    with pytest.raises(InputError, match="HF_HOME"):
        make("vit", pretrained=True)


def test_a_rig_without_working_distance_is_refused():
    from dataclasses import replace

    factory = replace(load_rig("T4").to(torch.float32), working_distance=None)
    with pytest.raises(InputError, match="working_distance"):
        build(NetworkConfig(preset="points"), factory, load_object("cube8"), DRIFT.std(factory), torch.Generator())


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_changes_in_what_is_named_and_predicts_rigs(preset):
    small_image = {"vit": {"depth": 1}, "cnn": {"depths": [1, 1, 1, 1], "dims": [8, 8, 16, 16]}}
    change = {
        "paper-points": {"width": 32, "depth": 1},
        "paper-cnn1d": {"width": 32, "depth": 1},
        "paper-vit": {"backbone": "vit_tiny_patch16_224", "options": small_image["vit"], "bottleneck": 16},
        "paper-cnn2d": {"backbone": "convnext_atto", "options": small_image["cnn"], "bottleneck": 16},
    }.get(preset, {"trunk": {"width": 32, "depth": 1}})
    before, after = PRESETS[preset].model_dump(), NetworkConfig(preset=preset, change=change).variant().model_dump()
    wanted = {**change, "trunk": {**before["trunk"], **change["trunk"]}} if "trunk" in change else change
    assert after == before | wanted
    assert PRESETS[preset].model_dump() == before
    network = make(preset, **change)
    given = views(network, snapshots(network))
    for prediction in network(given):
        cameras = prediction.cameras_from_object
        assert cameras.focal_length.shape == (3, 4, 2) and cameras.cam_from_rig.translation.shape == (3, 4, 3)
        assert torch.isfinite(project_fiducials(cameras, network.obj)).all()


def test_rescaled_weights_say_the_same_of_another_drift():
    config = NetworkConfig(preset="points", change={"trunk": {"trust": True}})
    narrow = make("points", trunk={"trust": True})
    factory, obj = narrow.factory, narrow.obj
    with torch.no_grad():
        for parameter in narrow.parameters():
            parameter += 0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(3))
    wide = build(config, factory, obj, 3 * narrow.decoder.prior_std, torch.Generator()).eval()
    wide.load_state_dict(narrow.state_dict())
    wide.trunk.rescale(narrow.decoder.prior_std)
    made = snapshots(narrow)
    with torch.no_grad():
        one, other = (network(views(narrow, made))[-1] for network in (narrow, wide))
    assert torch.allclose(one.rig.focal_length, other.rig.focal_length, rtol=1e-6)
    assert torch.allclose(one.rig.distortion, other.rig.distortion, atol=1e-6)
    assert one.log_sigma.abs().max() > 0.01
    assert torch.allclose(one.log_sigma, other.log_sigma, atol=1e-4)


@pytest.mark.parametrize("preset", ["paper-points", *SMALL])
def test_every_parameter_is_in_one_group(preset):
    network = make(preset)
    grouped = [parameter for group in network.parameter_groups().values() for parameter in group]
    assert sorted(map(id, grouped)) == sorted(map(id, network.parameters()))
    if preset == "paper-points":
        assert {"rotation", "translation", "focal_length", "principal_point", "distortion"} < set(
            network.parameter_groups()
        )


def tensors_of(record):
    """Every tensor that a rig or an object holds."""
    inner = [vars(value) if hasattr(value, "__dict__") else {} for value in vars(record).values()]
    values = [*vars(record).values(), *(value for one in inner for value in one.values())]
    return [value for value in values if isinstance(value, torch.Tensor)]


@pytest.mark.parametrize("preset", ["points", "paper-points", "vit"])
def test_a_network_moves_as_a_whole(preset):
    change = {"width": 32, "depth": 1} if preset == "paper-points" else {}
    moved = make(preset, **change).to("meta")
    held = [*moved.parameters(), *moved.buffers(), *tensors_of(moved.factory), *tensors_of(moved.obj)]
    assert {tensor.device.type for tensor in held} == {"meta"}


def test_weights_come_from_the_generator_alone():
    torch.manual_seed(5)
    before = torch.get_rng_state()
    one, same = make("points"), make("points")
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), same.parameters(), strict=True))
    first = one.trunk.first.embed[0]
    torch.manual_seed(0)  # as torch would draw them after a seed of its own
    assert torch.equal(first.weight, torch.nn.Linear(first.in_features, first.out_features).weight)


def test_layers_draw_from_a_generator_that_goes_on():
    layer, generator = torch.nn.Dropout(0.5), torch.Generator().manual_seed(3)
    with drawing_from(generator):
        first = layer(torch.ones(100))
    with pytest.raises(ZeroDivisionError), drawing_from(generator):
        raise ZeroDivisionError
    with drawing_from(generator):
        second = layer(torch.ones(100))
    torch.manual_seed(3)
    assert torch.equal(torch.cat((first, second)), torch.cat((layer(torch.ones(100)), layer(torch.ones(100)))))


def test_images_are_drawn_as_is_asked_for():
    factory, thing = load_rig("T4").to(torch.float32), load_object("asymmetric8")
    given = (factory, thing, DRIFT.std(factory), torch.Generator(), ImageOptions(size=64, dot=2.0))
    assert build(NetworkConfig(preset="vit"), *given).image_options == ImageOptions(size=64, dot=2.0)
    with pytest.raises(InputError, match="the network points takes points"):
        build(NetworkConfig(preset="points"), *given)
