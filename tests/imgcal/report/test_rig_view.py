"""Rigs in 3D: geometry against the cameras themselves, and the view in a real browser."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from imgcal.geometry import RigidTransform, rotation_from_vector
from imgcal.io import read_rig
from imgcal.live_page import frustum_length, frustums, up_and_forward
from imgcal.report import DrawnRig, rig_scene, rig_view_script
from tests.imgcal.report.browser import measured

if TYPE_CHECKING:
    from playwright.sync_api import BrowserContext


def test_frustums_start_at_the_camera_and_end_at_the_border_of_its_image() -> None:
    rig = read_rig("O10")
    drawn = torch.as_tensor(frustums(rig, 50.0))
    np.testing.assert_allclose(drawn[:, 0], rig.positions, atol=1e-9)
    pinhole = replace(rig, distortion=torch.zeros_like(rig.distortion))
    width, height = rig.image_size[0].tolist()
    corners = [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]
    for camera in range(rig.num_cameras):
        uv = pinhole.project(drawn[camera, 1:]).uv[camera]
        np.testing.assert_allclose(uv, corners, atol=1e-6)


@pytest.mark.parametrize("name", ["O10", "room10", "U7"])
def test_drawn_cameras_are_smaller_than_the_distance_between_neighbours(name: str) -> None:
    rig = read_rig(name)
    drawn = frustums(rig, frustum_length(rig))
    size = np.linalg.norm(drawn[:, 1:] - drawn[:, :1], axis=-1).max()
    centres = rig.positions.numpy()
    distance = np.linalg.norm(centres[:, None] - centres[None], axis=-1) + 1e9 * np.eye(len(centres))
    assert size < 0.8 * np.median(distance.min(1))


def test_up_is_what_is_up_for_most_cameras() -> None:
    ring = read_rig("room10")  # looks inward and down, z of its frame is up
    np.testing.assert_array_equal(up_and_forward(ring)[0], [0, 0, 1])
    np.testing.assert_array_equal(up_and_forward(read_rig("T4"))[0], [0, -1, 0])
    turn = RigidTransform(rotation_from_vector(torch.tensor([[0.6, 0.0, 0.0]]).double()), torch.zeros(1, 3).double())
    tilted = replace(ring, cam_from_rig=ring.cam_from_rig @ turn.inverse())
    up, _ = up_and_forward(tilted)
    np.testing.assert_allclose(up, turn.rotation[0] @ torch.tensor([0.0, 0.0, 1.0]).double(), atol=0.02)


def test_cameras_that_look_down_and_are_rolled_every_way_are_above_what_they_see() -> None:
    angles = torch.arange(10).double() * 2 * torch.pi / 10
    turns, places = torch.zeros(10, 3).double(), torch.zeros(10, 3).double()
    turns[:, 2], places[:, 0] = angles, 500.0  # on a ring, each looks along z of the rig's frame
    looking_down = replace(read_rig("room10"), cam_from_rig=RigidTransform(rotation_from_vector(turns), places))
    np.testing.assert_array_equal(up_and_forward(looking_down)[0], [0, 0, -1])


def test_forward_is_level() -> None:
    for name in ("O10", "room10", "U7", "T4", "O6"):
        scene = rig_scene([DrawnRig("factory", "--ghost", (read_rig(name),))])
        up, forward = np.array(scene["up"]), np.array(scene["forward"])
        assert abs(up @ forward) < 1e-6 and np.linalg.norm(forward) == pytest.approx(1)


def test_scene_is_json_and_has_a_step_for_each_state() -> None:
    rig = read_rig("T4")
    scene = rig_scene(
        [DrawnRig("a", "--ghost", (rig,)), DrawnRig("b", "--after", (rig, rig, rig))], np.zeros((2, 5, 3))
    )
    again = json.loads(json.dumps(scene, allow_nan=False))
    assert [len(drawn["steps"]) for drawn in again["rigs"]] == [1, 3]
    assert np.shape(again["groups"]) == (2, 5, 3)


LOOK = """
  const canvas = page.querySelector("canvas"), painter = view.painter;
  const boxes = [];
  const text = painter.text.bind(painter);
  painter.text = (words, x, y, colour, options) => { boxes.push({words, x, y}); text(words, x, y, colour, options); };
  const ends = {};
  for (const name of ["rest", "front", "side", "above"]) {
    boxes.length = 0;
    painter.look(name);
    painter.paint();
    const at = painter.points().map(painter.place);
    ends[name] = {
      left: Math.min(...at.map((p) => p[0])), right: Math.max(...at.map((p) => p[0])),
      top: Math.min(...at.map((p) => p[1])), bottom: Math.max(...at.map((p) => p[1])),
      names: boxes.filter((box) => /^cam/.test(box.words)).map((box) => ({...box})),
      up: painter.view(painter.middle.map((v, i) => v + painter.scene.up[i]))[1],
    };
  }
  const turned = (ctrlKey) => new view.WheelEvent("wheel", {deltaY: 100, ctrlKey, cancelable: true});
  const [scrolls, kept] = [canvas.dispatchEvent(turned(false)), canvas.dispatchEvent(turned(true))];
  const zooms = !kept && painter.magnified < 1;
  return {ends, scrolls, zooms, width: canvas.clientWidth, height: canvas.clientHeight};
"""


@pytest.mark.parametrize("width", [390, 1200])
def test_every_view_shows_the_whole_rig_with_names_apart(browser: BrowserContext, width: int, tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(0, 100, (3, 8, 3))
    scene = rig_scene([DrawnRig("factory", "--after", (read_rig("room10"),), filled=True)], points)
    page = tmp_path / "view.html"
    page.write_text(
        '<body style="margin:0;--after:blue"><div><canvas style="width:100%;height:360px"></canvas></div>'
        f"<script>{rig_view_script()}</script><script>window.painter = new RigView(document.querySelector('canvas'));"
        f"painter.set({json.dumps(scene)});</script>"
    )
    found = measured(browser, page, width, LOOK)
    assert found["complaints"] == []
    for name, end in found["ends"].items():
        assert end["left"] >= 0 and end["right"] <= found["width"], name
        assert end["top"] >= 0 and end["bottom"] <= found["height"], name
        drawn = end["names"]
        assert len(drawn) >= 8, name  # of ten
        for i, a in enumerate(drawn):
            assert all(abs(a["x"] - b["x"]) > 30 or abs(a["y"] - b["y"]) >= 14 for b in drawn[:i]), name
    assert found["ends"]["front"]["up"] < 0  # what is up is drawn upwards
    assert found["scrolls"] and found["zooms"]
