"""Windows composited front to back against whole images, pixel by pixel."""

import pytest
import torch

from renderers.compositing import Canvas, composite_windows, window_starts

SIZE, WINDOW = (9, 12), (4, 5)


def scene(batch: int, count: int, channels: int = 3):
    random = torch.Generator().manual_seed(0)
    alpha = torch.rand(batch, count, *WINDOW, generator=random, dtype=torch.float64)
    colours = torch.rand(batch, count, channels, generator=random, dtype=torch.float64)
    rows = torch.randint(0, SIZE[0] - WINDOW[0] + 1, (batch, count), generator=random)
    columns = torch.randint(0, SIZE[1] - WINDOW[1] + 1, (batch, count), generator=random)
    return alpha, colours, rows, columns


def whole(alpha, colours, rows, columns):
    """The same with an image for every window."""
    batch, count = rows.shape
    image = alpha.new_zeros(batch, colours.shape[-1], *SIZE)
    left, seen = alpha.new_ones(batch, *SIZE), []
    for n in range(count):
        opacity = alpha.new_zeros(batch, *SIZE)
        for b in range(batch):
            v, u = int(rows[b, n]), int(columns[b, n])
            opacity[b, v : v + WINDOW[0], u : u + WINDOW[1]] = alpha[b, n]
        visible = left * opacity
        image = image + visible[:, None] * colours[:, n, :, None, None]
        left = left * (1 - opacity)
        seen.append(visible.sum((1, 2)))
    return image, left, torch.stack(seen, dim=-1)


@pytest.mark.parametrize(("batch", "count", "channels"), [(1, 1, 3), (2, 7, 3), (3, 4, 1)])
def test_windows_are_composited_as_whole_images(batch: int, count: int, channels: int) -> None:
    given = scene(batch, count, channels)
    canvas = Canvas.blank(batch, channels, SIZE, like=given[0])
    seen = composite_windows(canvas, *given)
    for found, expected in zip((*canvas, seen), whole(*given), strict=True):
        torch.testing.assert_close(found, expected)


def test_light_is_kept_and_an_opaque_window_hides_what_is_behind() -> None:
    alpha, colours, rows, columns = scene(2, 3)
    rows[:], columns[:] = rows[:, :1], columns[:, :1]
    alpha[:, 0] = 1
    canvas = Canvas.blank(2, 3, SIZE, like=alpha)
    seen = composite_windows(canvas, alpha, colours, rows, columns)
    torch.testing.assert_close(seen, torch.tensor([[20.0, 0, 0]] * 2).double())
    torch.testing.assert_close(canvas.transmittance.sum((1, 2)) + seen.sum(1), torch.tensor([108.0, 108.0]).double())


def test_gradients() -> None:
    alpha, colours, rows, columns = scene(1, 3)

    def images(alpha, colours):
        canvas = Canvas.blank(1, 3, SIZE, like=alpha)
        seen = composite_windows(canvas, alpha, colours, rows, columns)
        return canvas.images, canvas.transmittance, seen

    assert torch.autograd.gradcheck(images, (alpha.requires_grad_(), colours.requires_grad_()))


def test_no_windows_leave_the_canvas_black() -> None:
    canvas = Canvas.blank(2, 3, SIZE, like=torch.zeros(1))
    none = torch.zeros(2, 0, dtype=torch.long)
    seen = composite_windows(canvas, torch.zeros(2, 0, *WINDOW), torch.zeros(2, 0, 3), none, none)
    assert seen.shape == (2, 0) and not canvas.images.any() and (canvas.transmittance == 1).all()


def test_windows_lie_around_their_centres_and_inside_the_image() -> None:
    centre = torch.tensor([-1e30, -3.0, 0.4, 5.0, 5.6, 9.9, 12.0, 1e30], dtype=torch.float64)
    starts = window_starts(centre, 5, 12)
    assert starts.tolist() == [0, 0, 0, 3, 4, 7, 7, 7]
    assert window_starts(centre, 12, 12).tolist() == [0] * 8
