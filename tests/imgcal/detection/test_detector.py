"""The detector against rendered discs with known centres."""

import itertools

import numpy as np
import pytest

from imgcal.detection import DetectionOptions, detect, detect_frame
from imgcal.errors import InputError
from imgcal.types import UNUSABLE, BlobFlag
from tests.imgcal.detection.discs import draw_discs, draw_patches, exposed, nearest, scattered

SHAPE = (480, 640)
GRADIENT = np.linspace(15, 40, SHAPE[1])[None, :] + np.linspace(0, 10, SHAPE[0])[:, None]


def measured(radius, *, noise=2.0, contrast=200.0, bits=8, background=20.0, frames=3, seed=0, options=None):
    """Errors (M, 2), sigmas (M,), radii (M,) and flags (M,) of the true discs, and the number of false blobs."""
    rng = np.random.default_rng(seed)
    columns, false = [], 0
    for _ in range(frames):
        uv = scattered(SHAPE, 40, rng)
        light = draw_discs(SHAPE, uv, radius, contrast=contrast, background=background)
        blobs = detect_frame(exposed(light, noise, rng, bits), options or DetectionOptions())
        rows, distance = nearest(blobs.uv, uv)
        assert distance.max() < 1.0
        false += len(blobs.uv) - len(uv)
        columns.append((blobs.uv[rows] - uv, blobs.sigma[rows], blobs.radius[rows], blobs.flags[rows]))
    return *(np.concatenate(column) for column in zip(*columns, strict=True)), false


@pytest.mark.parametrize(("radius", "limit"), [(1.5, 0.016), (3.0, 0.009), (6.0, 0.006)])
def test_centres_beat_the_reference(radius, limit):
    error, _, size, flags, false = measured(radius)
    assert np.sqrt((error**2).mean()) < limit
    assert abs(error.mean(0)).max() < 0.15 * limit + 3 * limit / np.sqrt(len(error))
    assert false == 0
    assert (flags == 0).all()
    assert np.median(size) == pytest.approx(radius, abs=0.25)


@pytest.mark.parametrize("radius", [1.5, 3.0, 6.0])
@pytest.mark.parametrize(
    ("noise", "contrast", "bits"), [(2, 200, 8), (0.5, 200, 8), (6, 200, 8), (2, 40, 8), (20, 2500, 12)]
)
def test_sigma_is_the_spread_of_the_centres(radius, noise, contrast, bits):
    error, sigma, _, _, false = measured(
        radius, noise=noise, contrast=contrast, bits=bits, background=GRADIENT * 2 ** (bits - 8), frames=2
    )
    assert 0.85 < (error / sigma[:, None]).std() < 1.18
    assert false == 0


@pytest.mark.parametrize("contrast", [400.0, 3000.0])
@pytest.mark.parametrize("radius", [1.5, 3.0, 6.0])
def test_saturated_blobs_are_flagged_and_their_sigma_covers_the_error(radius, contrast):
    error, sigma, _, flags, _ = measured(radius, contrast=contrast, frames=2)
    assert (flags == BlobFlag.SATURATED).all()
    assert 0.2 < (error / sigma[:, None]).std() < 1.25


def test_empty_and_dim_frames_hold_no_blobs():
    rng = np.random.default_rng(1)
    for frame in (
        np.zeros(SHAPE, np.uint8),
        np.full(SHAPE, 255, np.uint8),
        exposed(np.full(SHAPE, 1.0), 0.3, rng),
        exposed(GRADIENT, 3.0, rng),
        exposed(16 * GRADIENT, 40.0, rng, bits=12),
    ):
        assert len(detect_frame(frame, DetectionOptions()).uv) == 0


def test_hot_pixels_are_no_blobs_unless_the_radius_allows():
    rng = np.random.default_rng(2)
    uv = np.rint(scattered(SHAPE, 60, rng)).astype(int)
    frame = exposed(np.full(SHAPE, 20.0), 2.0, rng)
    frame[uv[:, 1], uv[:, 0]] = 250
    assert len(detect_frame(frame, DetectionOptions()).uv) == 0
    found = detect_frame(frame, DetectionOptions(min_radius=0.4)).uv
    assert len(found) == len(uv)
    assert nearest(found, uv.astype(float))[1].max() < 0.2


def scene(seed=3, shape=SHAPE):
    """A noisy frame of isolated discs of three sizes, and their centres."""
    rng = np.random.default_rng(seed)
    uv = scattered(shape, 48, rng)
    light = draw_discs(shape, uv, rng.choice([2.0, 3.0, 5.0], len(uv)), background=20.0)
    return exposed(light, 2.0, rng), uv


def assert_same_within_noise(distance, sigma):
    """Most blobs agree to the last digit.

    The grid of 4 x 4 blocks and the rounding of its means are used for finding alone, but they may change the size of a
    window, and with it the ring of pixels (and its noise) from which the background is taken.
    """
    assert np.median(distance) < 1e-6
    assert np.sqrt(((distance / sigma) ** 2).mean()) < 0.35
    assert (distance < 1.2 * sigma).all()


def test_shifted_frame_gives_shifted_blobs():
    frame, _ = scene()
    reference = detect_frame(frame, DetectionOptions())
    for right, down in ((4, 0), (0, 8), (1, 0), (2, 3)):
        moved = detect_frame(np.roll(frame, (down, right), (0, 1)), DetectionOptions())
        rows, distance = nearest(moved.uv, reference.uv + np.array([right, down]))
        assert len(moved.uv) == len(reference.uv)
        assert_same_within_noise(distance, reference.sigma)
        assert right % 4 or down % 4 or distance.max() < 1e-9
        np.testing.assert_array_equal(moved.flags[rows], reference.flags)


@pytest.mark.parametrize(("brightest", "options"), [(4300, {}), (15000, {}), (40000, {"threshold": 50.0})])
def test_one_bright_spot_hides_no_marker_of_a_deep_frame(brightest, options):
    """The full scale of 16-bit frames follows from the brightest pixel, and the smallest contrast from that."""
    shape, rng = (300, 400), np.random.default_rng(0)
    uv = scattered(shape, 60, rng)
    frame = draw_discs(shape, uv, 2.5, contrast=500.0, background=200.0) + 3 * rng.standard_normal(shape)
    frame[290:296, 390:396] = brightest
    found = detect_frame(np.rint(frame).astype(np.uint16), DetectionOptions(**options))
    assert (np.linalg.norm(found.uv[:, None] - uv, axis=-1).min(0) < 0.2).all()


def test_clipped_frames_of_14_bit_say_so():
    shape, rng = (200, 200), np.random.default_rng(0)
    uv = scattered(shape, 60, rng)
    frame = np.minimum(draw_discs(shape, uv, 5.0, contrast=40000.0, background=200.0), 16383)
    found = detect_frame(np.rint(frame).astype(np.uint16), DetectionOptions())
    assert len(found.uv) == len(uv) and (found.flags & BlobFlag.SATURATED > 0).all()


def test_bit_depths_agree():
    frame, _ = scene()
    narrow = detect_frame(frame, DetectionOptions())
    for factor, bits in ((4, 10), (16, 12), (256, 16)):
        wide = detect_frame(frame.astype(np.uint16) * factor, DetectionOptions(bit_depth=bits))
        assert len(wide.uv) == len(narrow.uv)
        rows, distance = nearest(wide.uv, narrow.uv)
        assert_same_within_noise(distance, narrow.sigma)
        np.testing.assert_allclose(wide.sigma[rows], narrow.sigma, rtol=0.2)
        np.testing.assert_allclose(wide.radius[rows], narrow.radius, rtol=0.01)


def test_dark_blobs_on_the_inverted_frame_are_the_bright_ones():
    frame, _ = scene()
    bright = detect_frame(frame, DetectionOptions())
    dark = detect_frame(255 - frame, DetectionOptions(polarity="dark"))
    assert len(dark.uv) == len(bright.uv)
    rows, distance = nearest(dark.uv, bright.uv)
    assert_same_within_noise(distance, bright.sigma)
    np.testing.assert_array_equal(dark.flags[rows], bright.flags)
    assert len(detect_frame(frame, DetectionOptions(polarity="dark")).uv) < len(bright.uv)


def test_odd_sizes_and_views_that_are_not_contiguous():
    frame, uv = scene(shape=(486, 643))
    for view in (frame, np.asfortranarray(frame), np.repeat(frame, 2, axis=1)[:, ::2]):
        blobs = detect_frame(view, DetectionOptions())
        assert nearest(blobs.uv, uv)[1].max() < 0.2


def test_blobs_at_the_border_are_flagged():
    uv = np.array([[1.0, 100.3], [638.5, 200.2], [300.4, 0.5], [301.2, 478.6], [320.3, 240.7]])
    blobs = detect_frame(exposed(draw_discs(SHAPE, uv, 4.0), 2.0, np.random.default_rng(4)), DetectionOptions())
    rows, _ = nearest(blobs.uv, uv)
    assert [bool(flag & BlobFlag.BORDER) for flag in blobs.flags[rows]] == [True] * 4 + [False]


@pytest.mark.parametrize("radius", [3.0, 6.0])
@pytest.mark.parametrize("gap", [-1.0, 0.0, 1.0, 2.0, 3.0, 4.0])
def test_touching_blobs_are_split_or_flagged(radius, gap):
    rng = np.random.default_rng(5)
    middle = scattered(SHAPE, 64, rng)
    angle = rng.uniform(0, 2 * np.pi, len(middle))
    half = (radius + gap / 2) * np.stack([np.cos(angle), np.sin(angle)], 1)
    uv = np.concatenate([middle - half, middle + half])
    blobs = detect_frame(exposed(draw_discs(SHAPE, uv, radius), 2.0, rng), DetectionOptions())
    usable = (blobs.flags & BlobFlag.MERGED) == 0
    if usable.any():
        # An unflagged blob is one disc, and measured as such although its neighbour is near.
        rows, distance = nearest(uv, blobs.uv[usable])
        assert ((blobs.uv[usable] - uv[rows]) / blobs.sigma[usable, None]).std() < 1.3
        assert distance.max() < 0.1
    assert usable.all() if gap >= 3 else not usable.any()


@pytest.mark.parametrize("squeeze", [0.5, 0.7])
def test_discs_seen_at_an_angle_are_not_merged(squeeze):
    rng = np.random.default_rng(6)
    uv = scattered(SHAPE, 48, rng)
    blobs = detect_frame(exposed(draw_discs(SHAPE, uv, 6.0, squeeze=squeeze), 2.0, rng), DetectionOptions())
    assert len(blobs.uv) == len(uv)
    assert (blobs.flags == 0).all()


@pytest.mark.parametrize("side", [14.0, 19.0, 25.0])
@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_square_patches_seen_at_an_angle_are_not_merged(side, noise):
    rng, shape = np.random.default_rng(8), (960, 1260)
    uv = scattered(shape, 60, rng)
    angles, tilt = rng.uniform(0, 2 * np.pi, (2, len(uv))), np.radians(rng.uniform(0, 65, len(uv)))
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side / 2
    turn, roll = (np.stack([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]).transpose(2, 0, 1) for a in angles)
    corners = square @ turn.mT
    corners[..., 1] *= np.cos(tilt)[:, None]
    frame = exposed(draw_patches(shape, corners @ roll.mT + uv[:, None], contrast=150.0), noise, rng)
    blobs = detect_frame(frame, DetectionOptions())
    rows, distance = nearest(blobs.uv, uv)
    assert len(uv) >= 300 and distance.max() < 0.2
    assert ((blobs.flags[rows] & BlobFlag.MERGED) > 0).mean() <= 0.01


def test_masked_blobs_are_flagged_and_kept():
    frame, uv = scene()
    mask = np.zeros(SHAPE, np.uint8)
    mask[:, :200] = 1
    found = detect({"a": frame, "b": frame}, masks={"a": mask})
    expected = (found.camera == 0) & (np.rint(found.uv[:, 0] - found.radius) < 200)
    np.testing.assert_array_equal((found.flags & BlobFlag.MASKED) > 0, expected)
    assert expected.any()
    assert len(found) == 2 * len(uv)


def test_a_blob_that_a_mask_cuts_is_not_used():
    """As where a recorder pads the frames of a part of the sensor to full size, and the padding is masked."""
    row = 100
    uv = np.array([[40.0 + 60 * k, row + offset] for k, offset in enumerate((-3.0, -1.0, 0.0, 1.5, 3.5, 12.0))])
    frame = exposed(draw_discs(SHAPE, uv, np.full(len(uv), 5.0), contrast=150.0), 1.0, np.random.default_rng(3))
    frame[:row] = 0
    mask = np.zeros(SHAPE, np.uint8)
    mask[:row] = 255
    found = detect_frame(frame, DetectionOptions(), mask)
    usable = found.uv[(found.flags & UNUSABLE) == 0]
    assert len(usable) == 1 and np.abs(usable[0] - uv[-1]).max() < 0.05


def test_threshold_and_radius_limits_select():
    rng = np.random.default_rng(7)
    uv = np.array([[100.2, 100.4], [200.1, 100.7], [300.8, 100.5]])
    light = draw_discs(SHAPE, uv, np.array([2.0, 4.0, 8.0]), contrast=np.array([180.0, 100.0, 50.0]))
    frame = exposed(light, 1.0, rng)

    def kept(**limits):
        distance = nearest(detect_frame(frame, DetectionOptions(**limits)).uv, uv)[1]
        return (distance < 0.5).tolist()

    assert kept() == [True, True, True]
    assert kept(threshold=75.0) == [True, True, False]
    assert kept(min_radius=3.0) == [False, True, True]
    assert kept(max_radius=6.0) == [True, True, False]


def test_cameras_are_independent_of_each_other_and_of_their_order():
    frames = {name: scene(seed)[0] for seed, name in enumerate("abc")}
    frames["wide"] = scene(9, (200, 801))[0].astype(np.uint16) * 16
    alone = {name: detect_frame(frame, DetectionOptions()) for name, frame in frames.items()}
    for names in itertools.islice(itertools.permutations(frames), 0, 24, 7):
        found = detect({name: frames[name] for name in names})
        assert found.camera_names == names
        for index, name in enumerate(names):
            rows = found.camera == index
            np.testing.assert_allclose(found.uv[rows], alone[name].uv, atol=1e-5)
            np.testing.assert_allclose(found.sigma[rows], alone[name].sigma, rtol=1e-4)


def test_several_snapshots_and_missing_cameras():
    one, two = scene(1)[0], scene(2)[0]
    found = detect({"a": [one, None, two], "b": None, "c": [None, None, one]})
    assert found.camera_names == ("a", "b", "c")
    assert len(found.snapshot_names) == 3
    count = {key: len(detect_frame(frame, DetectionOptions()).uv) for key, frame in (("one", one), ("two", two))}
    seen = {(s, c): int(((found.snapshot == s) & (found.camera == c)).sum()) for s in range(3) for c in range(3)}
    expected = dict.fromkeys(seen, 0) | {(0, 0): count["one"], (2, 0): count["two"], (2, 2): count["one"]}
    assert seen == expected
    assert (found.fiducial == -1).all()
    assert len(detect({})) == 0
    assert len(detect({"a": None})) == 0


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ({"a": 200 * np.eye(64, 3, dtype=np.uint8)[None].repeat(48, 0)}, "camera a: found a colour image"),
        ({"a": np.zeros((48, 64, 2), np.uint8)}, "camera a: found a frame of shape"),
        ({"a": np.full((48, 64), np.nan)}, "camera a: found float64"),
        ({"a": np.zeros((48, 64), np.int32)}, "camera a: found int32"),
        ({"a": "frame.png"}, "camera a: found a str"),
        ({"a": [np.zeros((48, 64), np.uint8)] * 2, "b": [None]}, "camera b: found 1 snapshots, expected 2"),
        ({"a": np.zeros((8, 64), np.uint8)}, "camera a: found a frame of 64 x 8"),
    ],
)
def test_unusable_frames_are_explained(frames, message):
    with pytest.raises(InputError, match=message) as raised:
        detect(frames)
    assert "\n" not in str(raised.value)


def test_unusable_masks_and_options_are_explained():
    frame = np.zeros((48, 64), np.uint8)
    with pytest.raises(InputError, match="mask of shape"):
        detect({"a": frame}, masks={"a": np.zeros((4, 4), bool)})
    with pytest.raises(InputError, match="masks: found camera b"):
        detect({"a": frame}, masks={"b": frame})
    with pytest.raises(InputError, match="expected at most 1023"):
        detect({"a": frame.astype(np.uint16) + 2000}, DetectionOptions(bit_depth=10))
    for wrong in (
        {"polarity": "grey"}, {"min_radius": 0.0}, {"min_radius": 9.0, "max_radius": 3.0}, {"threshold": -1.0},
        {"threshold": float("nan")}, {"bit_depth": 4}, {"saturation": 0.0}, {"max_elongation": 1.0},
    ):  # fmt: skip
        with pytest.raises(InputError, match=r"found .*, expected"):
            DetectionOptions(**wrong)


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_frames_of_8_bit_do_not_hold_12(polarity):
    frame, _ = scene()
    with pytest.raises(InputError, match="camera a: found a frame of 8 bit, expected 12 bit"):
        detect({"a": frame}, DetectionOptions(polarity=polarity, bit_depth=12))
