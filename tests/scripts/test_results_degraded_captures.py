import numpy as np
import pytest

from scripts.results.degradations import DEGRADATIONS, ELECTRONS, READ_NOISE, Look
from scripts.results.degraded_captures import references_of, status, tables

LOOK = Look(radius=4.0, level=200.0, ground=20.0, count=30)


def frame_of_a_dot() -> np.ndarray:
    v, u = np.mgrid[:120, :160]
    return np.where(np.hypot(u - 80, v - 60) < LOOK.radius, LOOK.level, LOOK.ground).astype(np.uint8)


def made(kind: str, level: float, seed: int = 0) -> np.ndarray:
    return DEGRADATIONS[kind].apply(frame_of_a_dot(), level, LOOK, np.random.default_rng(seed)).astype(float)


@pytest.mark.parametrize("kind", DEGRADATIONS)
def test_the_same_seed_degrades_alike_and_another_otherwise(kind):
    level = DEGRADATIONS[kind].levels[-1]
    assert (made(kind, level) == made(kind, level)).all()
    assert (made(kind, level) == made(kind, level, 1)).all() == (kind in ("clean", "blur"))


@pytest.mark.parametrize(("kind", "level"), [("blur", 1.0), ("motion", 3.0)])
def test_light_is_spread_and_its_middle_stays(kind, level):
    light = made(kind, level) - LOOK.ground
    v, u = np.mgrid[:120, :160]
    before = (frame_of_a_dot() - LOOK.ground).sum()
    assert abs(light.sum() - before) < 0.03 * before
    assert abs((light * u).sum() / light.sum() - 80) < 0.1
    assert abs((light * v).sum() / light.sum() - 60) < 0.1
    spread = (light * ((u - 80) ** 2 + (v - 60) ** 2)).sum() / light.sum() - LOOK.radius**2 / 2
    expected = 2 * (level * LOOK.radius) ** 2 if kind == "blur" else (level * LOOK.radius) ** 2 / 12
    assert abs(spread - expected) < 0.1 * expected


def test_darkness_has_the_noise_of_its_light():
    dark = made("dark", 0.4)[:40]  # ground alone
    assert abs(dark.mean() - 0.4 * LOOK.ground) < 0.1
    variance = (0.4 * LOOK.ground * ELECTRONS + READ_NOISE**2) / ELECTRONS**2 + 1 / 12
    assert abs(dark.var() - variance) < 0.1 * variance


def test_drapes_hide_as_much_as_is_said():
    for share in DEGRADATIONS["drapes"].levels:
        changed = (made("drapes", share) != frame_of_a_dot()).mean()
        assert share - 0.02 < changed < share + 0.06


def test_discs_are_as_large_and_as_bright_as_dots():
    crowd = made("discs", 1.0)
    assert crowd.max() <= LOOK.ground + 1.1 * (LOOK.level - LOOK.ground) + 1
    area = (crowd > 0.5 * (LOOK.level + LOOK.ground) - 10).sum() / (np.pi * LOOK.radius**2)
    assert 10 < area < 50  # of 31 dots, some of which cover each other or lie at the edge


def row(detector: str, kind: str, level: float, off: float | None, reason: str = "") -> dict:
    return {"captures": "dots", "kind": kind, "level": level, "seed": 0, "detector": detector, "off_px": off,
            "reason": reason, "seconds": 1.25, "labels": 9}  # fmt: skip


def test_wrong_is_more_than_a_pixel_and_five_times_the_reference():
    rows = [
        row("classical", "clean", 0.0, 0.3), row("classical", "blur", 2.0, None, "blobs: found none"),
        row("matched", "blur", 2.0, 1.4), row("auto", "blur", 2.0, 1.6), row("both", "blur", 2.0, None),
    ]  # fmt: skip
    references = references_of(rows)
    assert [status(one, references) for one in rows] == ["calibrated", "refused", "calibrated", "wrong", "wrong"]
    references = {"dots": 0.1}
    assert [status(one, references) for one in rows[2:4]] == ["wrong", "wrong"]
    assert status(row("auto", "blur", 2.0, 0.99), references) == "calibrated"


def test_tables_show_what_became_of_each_case():
    rows = [
        row("classical", "clean", 0.0, 0.3), row("classical", "blur", 2.0, None, "blobs: found none"),
        row("auto", "clean", 0.0, 0.3), row("auto", "blur", 2.0, 35.0),
    ]  # fmt: skip
    text = tables(rows)
    assert "| classical | 1 / 1 / 0 |" in text
    assert "| auto | 1 / 0 / 1 |" in text
    assert "| clean | 0.30 px, 1.2 s | 0.30 px, 1.2 s |" in text
    assert "| blur 2 | refused, 1.2 s | **wrong**, 35.00 px, 1.2 s |" in text
