import numpy as np

from imgcal.online import LightTracks
from imgcal.online.light_tracks import HIDDEN_SECONDS, STILL_SECONDS


def test_lights_keep_their_numbers_while_they_move() -> None:
    tracks = LightTracks.of(lights=4, cameras=2)
    start, speed = (
        np.array([[0.0, 0.0, 900.0], [140.0, 0.0, 900.0]]),
        np.array([[1500.0, 0.0, 0.0], [-1500.0, 0.0, 0.0]]),
    )
    assert tracks.number_lights(start, 0.0).tolist() == [0, 1]
    for frame in range(1, 12):  # they pass each other
        there = start + speed * frame / 60
        order = [1, 0] if frame % 2 else [0, 1]
        assert tracks.number_lights(there[order], frame / 60).tolist() == order


def test_a_number_is_free_again_once_its_light_is_gone() -> None:
    tracks = LightTracks.of(lights=2, cameras=1)
    here, elsewhere = np.array([[0.0, 0.0, 500.0]]), np.array([[900.0, 0.0, 500.0], [0.0, 900.0, 500.0]])
    assert tracks.number_lights(here, 0.0).tolist() == [0]
    assert tracks.number_lights(elsewhere[:1], 0.1).tolist() == [1]  # the first may come back to where it was
    assert tracks.number_lights(here, 0.2).tolist() == [0]
    assert tracks.number_lights(elsewhere[1:], 0.3 + HIDDEN_SECONDS).tolist() == [1]  # was left longest ago
    assert tracks.number_lights(elsewhere, 0.4 + HIDDEN_SECONDS).tolist() == [0, 1]
    assert tracks.number_lights(np.concatenate((here, elsewhere)), 0.5 + HIDDEN_SECONDS).tolist() == [-1, 0, 1]
    assert tracks.number_lights(np.empty((0, 3)), 2.0).tolist() == []


def test_lights_that_go_together_keep_their_numbers_from_the_first_step_on() -> None:
    """Four lights 80 mm apart, which go 60 mm a frame along their line; a fifth appears beside them, one is hidden."""
    tracks, row = LightTracks.of(lights=16, cameras=1), np.arange(5)[:, None] * np.array([80.0, 0.0, 0.0])
    step, order = np.array([60.0, 5.0, 0.0]), np.random.default_rng(2)
    for frame in range(12):
        shown = [0, 1, 2, 3] if frame < 5 else [0, 1, 2, 3, 4] if frame != 8 else [0, 1, 3, 4]
        shown = order.permutation(shown) if frame else np.array(shown)
        found = tracks.number_lights(row[shown] + frame * step, frame / 60)
        assert found.tolist() == shown.tolist(), frame


def test_numbers_that_no_light_had_come_first() -> None:
    tracks, here = LightTracks.of(lights=3, cameras=1), np.array([[0.0, 0.0, 500.0]])
    assert [tracks.number_lights(here, time).tolist() for time in (0.0, 2.0, 4.0, 6.0)] == [[0], [1], [2], [0]]


def test_a_hidden_light_that_may_be_one_of_two_comes_back_as_another_one() -> None:
    tracks = LightTracks.of(lights=8, cameras=1)
    pair = np.array([[0.0, 0.0, 900.0], [60.0, 0.0, 900.0]])
    for frame in range(4):
        assert tracks.number_lights(pair, frame / 60).tolist() == [0, 1]
    far = np.array([[2000.0, 0.0, 900.0]])
    assert tracks.number_lights(far, 4 / 60).tolist() == [2]
    # Three frames later either of the two may be there.
    assert tracks.number_lights(np.concatenate((far, pair[1:] - [30.0, 0.0, 0.0])), 7 / 60).tolist() == [2, 3]


def test_blobs_that_never_move_are_known_after_a_while() -> None:
    tracks = LightTracks.of(lights=2, cameras=2)
    camera, generator = np.array([0, 1, 1]), np.random.default_rng(1)
    doorway = np.array([[100.0, 100.0], [300.0, 40.0]])
    for frame in range(100):
        time = frame / 30
        uv = np.concatenate((doorway + 0.1 * generator.normal(size=(2, 2)), [[500.0 - 3 * frame, 200.0]]))
        still = tracks.is_still(camera, uv)
        assert still.tolist() == [time > STILL_SECONDS + 1 / 60] * 2 + [False]
        tracks.mark_still(camera, uv, np.array([False, False, frame % 2 > 0]), time)
    assert tracks.is_still(camera, np.concatenate((doorway + 7.0, [[0.0, 0.0]]))).tolist() == [False] * 3
