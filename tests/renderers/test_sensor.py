"""Grey levels: means, noise, and low light."""

import dataclasses
import math

import pytest
import torch

from renderers import SensorModel, expose


@pytest.mark.parametrize(("bit_depth", "dtype"), [(8, torch.uint8), (12, torch.uint16), (16, torch.uint16)])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_levels_and_noise(bit_depth: int, dtype: torch.dtype, polarity: str) -> None:
    full = 2**bit_depth - 1
    sensor = SensorModel(
        bit_depth=bit_depth,  # type: ignore[arg-type]
        polarity=polarity,  # type: ignore[arg-type]
        background=0.2,
        contrast=0.5,
        gradient=(0.1, -0.06),
        read_noise=3.0,
        shot_noise=4.0,
    )
    light = torch.zeros(4, 100, 200)
    light[2:] = 1.0
    frames = expose(light, sensor, generator=torch.Generator().manual_seed(3))
    assert frames.dtype == dtype
    levels = torch.from_numpy(frames.numpy().astype("float64"))
    assert levels.max() <= full
    for part, level in ((levels[:2], 0.2), (levels[2:], 0.7)):
        level, sign = (level, 1) if polarity == "bright" else (1 - level, -1)
        assert part.mean().item() == pytest.approx(level * full, abs=0.1)
        across_u = part[..., -20:].mean() - part[..., :20].mean()
        across_v = part[:, -10:].mean() - part[:, :10].mean()
        assert across_u.item() == pytest.approx(sign * 0.1 * 180 / 199 * full, abs=0.5)
        assert across_v.item() == pytest.approx(-sign * 0.06 * 90 / 99 * full, abs=0.5)
        noise = (part[0] - part[1]).std().item() / math.sqrt(2)
        assert noise == pytest.approx(math.sqrt(9 + 16 * level + 1 / 12), rel=0.05)


def test_exposure_saturates() -> None:
    light = torch.tensor([[0.0, 0.3, 0.6, 1.0]])
    quiet = SensorModel(read_noise=0.0, background=0.1, contrast=0.5)
    assert expose(light, quiet).tolist() == [[26, 64, 102, 153]]
    assert expose(light, dataclasses.replace(quiet, exposure=2.0)).tolist() == [[51, 128, 204, 255]]
    assert expose(light, dataclasses.replace(quiet, exposure=2.0, saturation=0.6)).tolist() == [[51, 128, 153, 153]]


def test_hot_pixels_belong_to_the_camera() -> None:
    sensor = SensorModel(hot_pixels=0.01, read_noise=0.0, background=0.0)
    frames = expose(torch.zeros(3, 2, 50, 60), sensor)
    assert (frames == 255).sum(dim=(-1, -2)).float().mean().item() == pytest.approx(30, abs=2)
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0, 0], frames[0, 1])
    assert not torch.equal(frames, expose(torch.zeros(3, 2, 50, 60), dataclasses.replace(sensor, hot_pixel_seed=1)))


@pytest.mark.parametrize("peak_snr", [1.0, 3.0, 10.0])
def test_low_light_has_the_promised_signal_to_noise(peak_snr):
    sensor = SensorModel.low_light(peak_snr)
    light = torch.zeros(1, 400, 400)
    light[:, :200] = 1.0
    frame = expose(light, sensor, generator=torch.Generator().manual_seed(0))[0].double()
    marker, ground = frame[:200], frame[200:]
    assert ((marker.mean() - ground.mean()) / marker.std()).item() == pytest.approx(peak_snr, rel=0.02)
    # Poisson: at a gain of one grey level an electron the variance is the mean plus that of reading.
    assert ground.var().item() == pytest.approx(ground.mean().item() + 9 + 1 / 12, rel=0.02)


def test_vignetting_darkens_the_corners_and_rows_share_their_noise():
    sensor = SensorModel(read_noise=0.0, background=0.5, contrast=0.0, vignetting=0.4, bit_depth=16)
    frame = expose(torch.zeros(1, 31, 41), sensor)[0].float() / 65535
    assert frame[15, 20].item() == pytest.approx(0.5, abs=1e-4)
    for corner in (frame[0, 0], frame[0, -1], frame[-1, 0], frame[-1, -1]):
        assert corner.item() == pytest.approx(0.3, abs=1e-4)

    rows = dataclasses.replace(sensor, vignetting=0.0, row_noise=300.0)
    frame = expose(torch.zeros(1, 2000, 20), rows, generator=torch.Generator().manual_seed(0))[0].double()
    assert frame.std(1).max() == 0
    assert frame[:, 0].std().item() == pytest.approx(300, rel=0.05)
