"""Options of encoders: shapes only."""

import pytest

from imgcal.networks import NetworkConfig


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
