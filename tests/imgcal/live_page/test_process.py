"""What is downloaded and shown belongs to one moment, however long the accuracy over the volume takes."""

import asyncio
import json
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from imgcal.io import read_rig
from imgcal.live_page import Address, guidance
from imgcal.live_page.contents import belief_message, greeting
from imgcal.live_page.page_state import PageState, camera_sigmas
from imgcal.live_page.process import Guide
from imgcal.live_page.rig_drawing import viewing_volume
from tests.imgcal.live_page.pages import ACTIONS, made_state


def test_the_rig_is_the_latest_with_its_own_deviations_while_the_volume_is_computed(
    o10, asymmetric8, monkeypatch, tmp_path
):
    first, step = made_state(o10, asymmetric8, now=1.0), torch.zeros(10, 15).double()
    step[6, 1] = 0.005
    known = replace(first.belief, rig=first.belief.rig.retract(step), factor=3 * first.belief.factor)
    last, waiting = replace(first, time=2.0, belief=known), threading.Event()
    monkeypatch.setattr(guidance, "compute_guidance", lambda *_: waiting.wait(60) and None)
    given = greeting(o10, asymmetric8, viewing_volume(o10), Address(), "token" * 5, ACTIONS, "live")
    board = PageState(given)
    guide, application = Guide(given, lambda _: None), SimpleNamespace(board=board, spread=lambda _: None)

    async def learn() -> list[str]:
        found = [guide.rig_yaml()]
        for state in (first, last):
            guide.learn(belief_message(state), application)
            await asyncio.wait_for(guide._tasks["rig"], 60)
            found.append(guide.rig_yaml())
        waiting.set()
        return found

    nothing, *texts = asyncio.run(learn())
    assert nothing is None
    for text, state in zip(texts, (first, last), strict=True):
        (tmp_path / "rig.yaml").write_text(text)
        rig = read_rig(tmp_path / "rig.yaml")
        assert torch.allclose(rig.positions, state.rig.positions, atol=1e-6)
        assert "std" in text
    history = json.loads(board.full_state()["history"].decode().split("data: ")[1])["fine"]
    assert history["value"][6][0] == pytest.approx([0, np.rad2deg(0.005)], abs=1e-3)
    sigma = [camera_sigmas(state.std.numpy(), o10.focal_length.numpy())[6, 0] for state in (first, last)]
    assert history["sigma"][6][0] == pytest.approx(sigma, rel=1e-3) and sigma[1] < sigma[0] / 2
