import numpy as np
import pytest

from imgcal.formats import Holds, Lens
from imgcal.formats.fitting import fit_lens, pixel_grid

SIZE = (1280, 960)


def test_what_can_be_said_is_said_exactly() -> None:
    lens = Lens((900.0, 905.0), (640.0, 480.0), (-0.1, 0.02, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0))
    fit = fit_lens(lens, SIZE, Holds((4,)))
    assert (fit.lens, fit.worst, fit.exact) == (lens, 0.0, True)


@pytest.mark.parametrize(
    ("lens", "holds", "limit"),
    [
        (Lens((900.0, 905.0), (640.0, 480.0), (0.08, -0.05, 0, 0, 0.01, 0.2, -0.04, 0.003)), Holds((5,)), 0.05),
        (Lens((1100.0, 1105.0), (640.0, 480.0), (0.02, -0.01, 0.003), "fisheye"), Holds((5,)), 0.15),
        (Lens((700.0, 705.0), (640.0, 480.0), (0.02, -0.01, 0.003), "fisheye"), Holds((5, 8)), 0.02),
        (Lens((900.0, 905.0), (640.0, 480.0), (3e-8, 1e-14), "to_ideal"), Holds((5,)), 0.01),
        (Lens((900.0, 900.0), (640.0, 480.0), (-0.3, 0.12, 0, 0, -0.03)), Holds((4,), fisheye=True), 1.2),
    ],
)
def test_another_model_takes_its_place(lens: Lens, holds: Holds, limit: float) -> None:
    fit = fit_lens(lens, SIZE, holds)
    assert not fit.exact
    uv = pixel_grid(SIZE, 50)  # points that the fit has not seen
    away = np.linalg.norm(fit.lens.project(lens.rays(uv)) - uv, axis=-1)
    assert away.max() < limit
    assert abs(away.max() - fit.worst) < 0.1 * fit.worst + 1e-6
    assert fit.rms < fit.worst


def test_the_nearest_of_several_models_is_taken() -> None:
    lens = Lens((500.0, 500.0), (640.0, 480.0), (-0.25, 0.06, 0, 0, -0.006))
    alone, both = fit_lens(lens, SIZE, Holds((4,))), fit_lens(lens, SIZE, Holds((4,), fisheye=True))
    assert both.worst <= alone.worst


def test_a_lens_without_rays_in_a_corner_has_no_place() -> None:
    folded = Lens((500.0, 500.0), (640.0, 480.0), (-0.4,))
    assert fit_lens(folded, SIZE, Holds((4,))).exact  # said as it is
    wide = Lens((300.0, 300.0), (640.0, 480.0), (), "fisheye")  # 150 degrees across the diagonal
    assert fit_lens(wide, (1600, 1200), Holds((5,))).worst == np.inf


def test_skew_is_not_said_by_a_lens_without() -> None:
    skewed = Lens((900.0, 900.0), (640.0, 480.0), (), skew=5.0)
    fit = fit_lens(skewed, SIZE, Holds((5,)))
    assert not fit.exact
    assert fit.worst > 0.5
