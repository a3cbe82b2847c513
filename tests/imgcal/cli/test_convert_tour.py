"""The real files of every tool through `imgcal convert`, into every format that can be written.

Each comes out verified on known points, or is refused with one line whose reason is true.
"""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from imgcal.cli.main import main
from imgcal.formats import (
    FORMATS,
    LIMIT,
    OURS,
    ForeignCamera,
    ForeignRig,
    Format,
    fill_image_sizes,
    in_millimetres,
    load_rig,
    read_foreign_rig,
)
from imgcal.formats.conversion import NATIVE
from imgcal.formats.fitting import fit_lens as fit_a_lens
from tests.imgcal.formats.test_registry import SAMPLES

TARGETS: dict[str, Format | None] = {OURS: None, **{one.name: one for one in FORMATS if one.write is not None}}
VERIFIED = re.compile(
    r"re-read: worst difference (?P<worst>\S+) px on (?P<points>\d+) points, lens models (?P<between>\S+)"
)

fit_lens = cache(fit_a_lens)  # many formats can store the same lenses


@pytest.fixture(autouse=True)
def fit_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imgcal.formats.conversion.fit_lens", fit_lens)


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["convert", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.mark.parametrize("name", [*SAMPLES, "colmap/kapture_t265"])
def test_real_files_are_verified_in_every_format_or_refused_for_a_true_reason(
    formats: Path, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, expected = formats / name, json.loads((formats / f"{name}.expected.json").read_text())
    unit = "mm" if "mm" in expected["unit_note"].split(";")[0] else "m"
    rig, given = read_foreign_rig(source), list[object]()
    if rig.unit is None:
        given += ["--unit", unit]
    sizes = [tuple(row["image_size"]) for row in expected["cameras"][: len(rig.cameras)]]
    named = zip(rig.cameras, sizes, strict=True)
    lacking = {camera.name: size for camera, size in named if camera.image_size is None}
    given += ["--image-size", *(f"{camera}={w}x{h}" for camera, (w, h) in lacking.items())] if lacking else []
    rig = fill_image_sizes(in_millimetres(rig, name, unit), name, lacking)
    for to, target in TARGETS.items():
        least, most = (1, 256) if target is None else target.cameras
        asked = [source, "--to", to, "--out", tmp_path / to / "x", *given]
        (tmp_path / to).mkdir()
        some, names = rig.cameras, list[object]()
        if not least <= len(some) <= most:
            code, _, wrong = run(capsys, *asked)
            assert code == 2 and f"cameras, found {len(some)}: choose with --cameras\n" in wrong, (to, wrong)
            if len(some) < least:
                continue
            some = some[:most]
            names = ["--cameras", *(camera.name for camera in some)]
        holds = NATIVE if target is None else target.holds
        fits = {camera.name: fit_lens(camera.lens, camera.image_size or (0, 0), holds) for camera in some}
        code, said, wrong = run(capsys, *asked, *names)
        if code == 3:
            (camera,) = re.findall(r"camera (\S+): .* cannot say its lens", wrong)
            assert wrong.count("\n") == 1 and fits[camera].worst > LIMIT, (to, wrong)
            continue
        if code == 2:
            assert re.fullmatch(r"imgcal: --to ros: camera \S+ stands above, below, .* --cameras\n", wrong), (to, wrong)
            assert abs(direction(*some)[0]) < 0.5 + 1e-9  # more than 60 degrees off the first one's x
            continue
        assert (code, wrong) == (0, ""), (to, wrong)
        worst, between = check(said)
        assert worst < 1e-6 and between <= LIMIT, (to, said)
        if to == OURS:
            judge(load_rig(tmp_path / to / "x"), rig, expected["cameras"], between)


def direction(one: ForeignCamera, other: ForeignCamera) -> NDArray[np.float64]:
    """Where the other camera stands, in the first one's frame: a unit vector."""
    there = one.rotation @ (-other.rotation.T @ other.translation) + one.translation
    return np.asarray(there / np.linalg.norm(there))


def check(said: str) -> tuple[float, float]:
    """What the command says about the points that it has compared."""
    match = VERIFIED.search(said)
    assert match is not None and int(match["points"]) > 20, said
    return float(match["worst"]), 0.0 if match["between"] == "the" else float(match["between"])


def judge(found: Any, rig: ForeignRig, rows: list[dict[str, Any]], between: float) -> None:
    """Compare with pixels that other programs have computed."""
    assert list(found.camera_names) == rig.names
    for number, row in zip(range(found.num_cameras), rows, strict=False):
        points = torch.tensor(row["points_rig_mm"], dtype=torch.float64)
        uv = found.select([number]).project(points).uv[0].numpy()
        assert np.abs(uv - np.array(row["uv"])).max() < between + 1e-6
