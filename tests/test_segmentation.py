"""The ridge field: its twin, its invariances, and what the learned contrast is worth."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from suturetrack.camera import StereoRig
from suturetrack.directions import direction_image, direction_key
from suturetrack.kernels import ridge, rims
from suturetrack.segmentation import (
    SegmentationConfig,
    Segmenter,
    gaussian_kernel,
)
from suturetrack.segmentation.contrast import GRAY, SIGMAS, contrast_along, contrast_at
from suturetrack.segmentation.silhouette import is_cut_out
from suturetrack.stage import Scene, open_scene
from suturetrack.stage.appearance import Picture
from suturetrack.types import Float32, Float64, Image, InputError, Seed, Stamp, StereoFrame
from tests.conftest import make_rig
from tests.reference import segmentation as reference

STAMP = Stamp(0, 0, 0)
CHANNELS = {"gray": GRAY, "blue": (1, 0, 0), "green": (0, 1, 0), "red": (0, 0, 1)}


def small_rig(width: int, height: int) -> StereoRig:
    k, none = np.array([[500.0, 0, width / 2], [0, 500.0, height / 2], [0, 0, 1]]), np.zeros(5)
    shift = np.array([-10.0, 0, 0])
    return StereoRig.from_calibration((width, height), (k, none), (k, none), np.eye(3), shift, 1e-3)


def segment(left: Image, config: SegmentationConfig, right: Image | None = None) -> Float32:
    segmenter = Segmenter(small_rig(left.shape[1], left.shape[0]), config)
    return segmenter.step(StereoFrame(STAMP, left, left if right is None else right)).left


def literal(image: Image, config: SegmentationConfig) -> Float64:
    plane = image if image.ndim == 2 else image @ np.asarray(CHANNELS[config.channel], float)
    polarity = {"auto": "dark"}.get(config.polarity, config.polarity)
    scales = [
        reference.ridge_vectors(plane, sigma, config.beta, config.c, polarity)
        for sigma in config.sigmas or SIGMAS[:1]
    ]
    return reference.blur_angles(
        reference.strongest(scales), reference.gaussian_kernel(config.blur)
    )


def assert_equal_fields(field: Float32, twin: Float64) -> None:
    """Vectors are directions: equal up to their sign."""
    error = np.minimum(np.abs(field - twin).max(-1), np.abs(field + twin).max(-1))
    assert np.mean(error > 1e-4) <= 1e-4
    assert error.max() < 5e-3


def line_image(angle: float, width: float = 2.0, dark: bool = True, size: int = 81) -> Image:
    """A soft straight thread through the middle of a gray image."""
    v, u = np.mgrid[:size, :size] - (size - 1) / 2
    distance = np.abs(np.cos(angle) * v - np.sin(angle) * u)
    share = expit(-4 * (distance - width / 2))
    return np.rint(150 + (-90 if dark else 90) * share).astype(np.uint8)


# --- equal to the literal equations ---------------------------------------------------------------


@pytest.mark.parametrize("polarity", ["dark", "bright", "both"])
@pytest.mark.parametrize("sigmas", [(1.2,), (2.4,), (1.0, 2.0)])
def test_noise_gives_the_literal_field(polarity: str, sigmas: tuple[float, ...]) -> None:
    config = SegmentationConfig(sigmas=sigmas, c=60.0, channel="green", polarity=polarity)
    image = np.random.default_rng(3).integers(0, 256, (480, 640, 3), np.uint8)
    assert_equal_fields(segment(image, config), literal(image, config))


@pytest.mark.parametrize("channel", ["gray", "red"])
@pytest.mark.parametrize("scene", ["figure8-175", "crossings"])
def test_a_scene_gives_the_literal_field(scene: str, channel: str) -> None:
    config = SegmentationConfig(c=6.0, channel=channel, polarity="both")
    image = open_scene(scene, 11).render(0)[0]
    field = segment(image, config)
    assert np.linalg.norm(field, axis=-1).max() > 0.3
    assert_equal_fields(field, literal(image, config))


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 60),
    seed=st.integers(0, 2**32 - 1),
    sigma=st.floats(0.6, 3.5),
    beta=st.floats(0.1, 1.0),
    polarity=st.sampled_from(["dark", "bright", "both"]),
    layout=st.sampled_from(["C", "F", "mirrored", "window"]),
    channel=st.sampled_from(["gray", "blue", "green", "red", None]),
)
def test_any_size_and_layout_gives_the_literal_field(
    height, width, seed, sigma, beta, polarity, layout, channel
) -> None:
    rng = np.random.default_rng(seed)
    shape = (height, width) if channel is None else (height, width, 3)
    image = rng.integers(0, 256, shape, np.uint8)
    image = np.round(cv2.GaussianBlur(image, (0, 0), 0.8)).astype(np.uint8).reshape(shape)
    config = SegmentationConfig((sigma,), beta, 20.0, 1.0, channel or "gray", polarity)
    given_image = {
        "C": image,
        "F": np.asfortranarray(image),
        "mirrored": np.ascontiguousarray(image[:, ::-1])[:, ::-1],
        "window": np.pad(image, [(3, 5), (2, 1)] + [(0, 0)] * (image.ndim - 2))[3:-5, 2:-1],
    }[layout]
    field, twin = segment(given_image, config), literal(image, config)
    error = np.minimum(np.abs(field - twin).max(-1), np.abs(field + twin).max(-1))
    # A sign decided by rounding changes single pixels; nothing else may differ.
    assert np.count_nonzero(error > 1e-4) <= 1
    assert np.linalg.norm(field, axis=-1).max() <= 1 + 1e-6


@given(st.integers(0, 2**32 - 1))
def test_vectors_at_right_angles_are_subtracted(seed: int) -> None:
    """Algorithm 1 adds where d > 0 and subtracts where d = 0, however the zeros are signed."""
    rng = np.random.default_rng(seed)
    choices = np.array([[1, 0], [0, 1], [-0.0, 0.5], [0.25, -0.0], [0, 0], [-1, 0]], np.float32)
    vectors = choices[rng.integers(0, len(choices), (9, 11))]
    padded = np.pad(np.moveaxis(vectors, -1, 0), [(0, 0), (0, 0), (2, 2)], mode="edge")
    # Taps are powers of two, so that both arithmetics are exact.
    kernel = np.exp2(-np.add.outer(abs(np.arange(-2, 3)), abs(np.arange(-2, 3)))) / 8
    out = np.empty((9, 11, 2), np.float32)
    sums = np.empty((2, 11), np.float32)
    for row in range(9):
        ridge.blur_row(padded, row, 9, kernel.astype(np.float32), sums, out[row])
    np.testing.assert_array_equal(out, reference.blur_angles(vectors.astype(float), kernel))


@pytest.mark.parametrize("size", [(21, 30), (4, 9), (1, 6), (7, 1)])
@pytest.mark.parametrize("signs", [(1, 1), (-1, -1), (-1, 1)])
def test_the_strength_is_that_of_every_fourth_row(
    size: tuple[int, int], signs: tuple[int, int]
) -> None:
    height, width = size
    plane = np.random.default_rng(3).uniform(0, 255, size).astype(np.float32)
    out = np.empty((*size, 2), np.float32)
    strength = np.empty(((height + 3) // 4, width), np.float32)
    taps, kernel = ridge.taps_of((1.2,)), gaussian_kernel(1.0)
    ridge.ridge_field(plane, *taps, (2.0, 1e-4), signs, kernel, out, strength)
    rows = np.minimum(np.arange(3, height + 3, 4), height - 1)
    twin = reference.strength(plane, 1.2, signs)[rows]
    np.testing.assert_allclose(strength, twin, rtol=1e-4)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12))
def test_of_two_fields_the_longer_vectors_are_kept(seed: int, height: int, width: int) -> None:
    rng = np.random.default_rng(seed)
    # Whole 256ths: their squares are added without rounding, however the compiler does it.
    vectors, kept = (rng.integers(-256, 257, (2, height, width, 2)) / 256).astype(np.float32)
    same = rng.random((height, width)) < 0.2
    vectors[same] = -kept[same]
    twin = reference.strongest([kept, vectors])
    ridge.keep_longer(vectors, kept)
    np.testing.assert_array_equal(kept, twin)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.floats(0.1, 2))
def test_the_pixels_of_long_vectors_come_row_by_row(
    seed: int, height: int, width: int, least: float
) -> None:
    # Whole 256ths, as above.
    vectors = np.random.default_rng(seed).integers(-256, 257, (height, width, 2)) / 256
    vectors = vectors.astype(np.float32)
    pixels = ridge.longer_than(least, vectors, np.empty(height * width, np.int32))
    assert pixels.dtype == np.uint16
    np.testing.assert_array_equal(pixels, reference.longer_than(least, vectors))


def test_a_field_tells_the_colours_of_what_looks_like_thread(distorted_rig: StereoRig) -> None:
    rng = np.random.default_rng(4)
    images = [cv2.blur(rng.integers(0, 256, (480, 640, 3), np.uint8), (5, 5)) for _ in range(2)]
    field = Segmenter(distorted_rig).step(StereoFrame(Stamp(0, 0, 0), *images))
    rectified = distorted_rig.rectify(*images)
    assert field.colours is not None
    for view, image, colours in zip(
        (field.left, field.right), rectified, field.colours, strict=True
    ):
        u, v = colours.pixels.T
        shown = np.linalg.norm(view, axis=2) > 0.1
        assert 1000 < len(u) == shown.sum()
        assert shown[v, u].all()
        np.testing.assert_array_equal(colours.bgr, image[v, u])


def test_gray_images_have_no_colours(distorted_rig: StereoRig) -> None:
    image = np.random.default_rng(5).integers(0, 256, (480, 640), np.uint8)
    frame = StereoFrame(Stamp(0, 0, 0), image, image)
    assert Segmenter(distorted_rig).step(frame).colours is None


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 64), st.floats(0.5, 0.999))
def test_the_quantile_is_within_0_4_percent(
    seed: int, height: int, width: int, share: float
) -> None:
    values = np.random.default_rng(seed).gamma(0.5, 30, (height, width)).astype(np.float32)
    twin = reference.quantile(values, share)
    assert ridge.quantile(values, share) == pytest.approx(twin, rel=0.004)


def test_the_quantile_of_nothing_is_nothing() -> None:
    assert ridge.quantile(np.zeros((4, 6), np.float32), 0.998) == 0


# --- what the field means -------------------------------------------------------------------------


@given(st.floats(0, np.pi), st.floats(1.5, 4.0))
def test_vectors_point_along_the_thread(angle: float, width: float) -> None:
    field = segment(line_image(angle, width), SegmentationConfig())
    middle = field[38:43, 38:43].reshape(-1, 2)
    strongest = middle[np.argmax(np.linalg.norm(middle, axis=1))]
    assert np.linalg.norm(strongest) > 0.3
    along = np.array([np.cos(angle), np.sin(angle)])
    assert abs(strongest @ along) > np.cos(np.radians(1.5)) * np.linalg.norm(strongest)


@pytest.mark.parametrize(
    ("polarity", "dark", "seen"),
    [
        ("dark", True, True),
        ("dark", False, False),
        ("bright", True, False),
        ("bright", False, True),
        ("both", True, True),
        ("both", False, True),
        ("auto", True, True),
    ],
)
def test_polarity_decides_which_threads_are_seen(polarity: str, dark: bool, seen: bool) -> None:
    field = segment(line_image(0.4, dark=dark), SegmentationConfig(c=10.0, polarity=polarity))
    assert (np.linalg.norm(field[40, 40]) > 0.3) == seen


def test_several_scales_see_thin_and_wide_threads() -> None:
    image = np.minimum(
        np.roll(line_image(0.0, 1.5, size=121), -40, 0),
        np.roll(line_image(0.0, 12.0, size=121), 20, 0),
    )
    rows = np.array([20, 80])
    strength = {
        sigmas: np.linalg.norm(segment(image, SegmentationConfig(sigmas, c=10.0)), axis=-1)[
            rows, 60
        ]
        for sigmas in [(1.0,), (5.0,), (1.0, 5.0)]
    }
    assert strength[(1.0,)][1] < 0.1 < 0.4 < strength[(1.0,)][0]
    assert strength[(5.0,)][1] > 0.4
    assert (strength[(1.0, 5.0)] > 0.4).all()


def test_a_rig_that_is_not_rectified_gives_rectified_pixels(distorted_rig: StereoRig) -> None:
    points = np.c_[np.linspace(-30, 30, 400), np.linspace(-25, 20, 400), np.full(400, 200.0)]
    images = []
    for pixels in distorted_rig.project_raw(points):
        image = np.full((480, 640), 170, np.uint8)
        at = np.rint(pixels * 16).astype(np.int32)
        cv2.polylines(image, [at], False, 60, 3, cv2.LINE_AA, 4)
        images.append(image)
    field = Segmenter(distorted_rig).step(StereoFrame(STAMP, *images))
    for view, pixels in zip((field.left, field.right), distorted_rig.project(points), strict=True):
        strength = np.linalg.norm(view, axis=-1)
        inner = pixels[20:-20]
        normal = np.array([-1, 1]) * np.gradient(inner, axis=0)[:, ::-1]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offsets = np.arange(-3, 3.1, 0.5)
        around = (inner[:, None] + offsets[:, None] * normal[:, None]).astype(np.float32)
        profile = cv2.remap(strength, around, None, cv2.INTER_LINEAR)
        assert np.abs(np.median(offsets[profile.argmax(1)])) <= 0.5
        assert np.median(profile.max(1)) > 0.3


def test_the_kernel_of_algorithm_1_is_a_gaussian() -> None:
    np.testing.assert_allclose(gaussian_kernel(1.3), reference.gaussian_kernel(1.3), atol=1e-7)


# --- time and memory ------------------------------------------------------------------------------


@pytest.mark.parametrize("rectified", [True, False])
def test_no_image_is_allocated_once_warm(rectified: bool, distorted_rig: StereoRig) -> None:
    scene = open_scene("figure8-107", 5)
    segmenter = Segmenter(scene.rig if rectified else distorted_rig)
    frame = StereoFrame(STAMP, *scene.render(0))
    segmenter.warm_up()
    segmenter.learn(frame, Seed(pixel=scene.seed_pixel()))
    for _ in range(3):
        segmenter.step(frame)
    tracemalloc.start()
    segmenter.step(frame)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 640 * 480 / 4


_WARMS_UP = """
import numpy as np
from suturetrack.kernels import ridge, rims, smears
from suturetrack.segmentation import Segmenter
from suturetrack.segmentation.smear import Band
from suturetrack.stage import open_scene
from suturetrack.types import Seed, Stamp, StereoFrame

def compiled():
    kernels = {**vars(ridge), **vars(rims), **vars(smears)}
    return {name: k.signatures for name, k in kernels.items() if hasattr(k, "signatures")}

scene = open_scene("two-threads", 3)
segmenter = Segmenter(scene.rig)
segmenter.warm_up()
before = {name: list(signatures) for name, signatures in compiled().items()}
frame = StereoFrame(Stamp(0, 0, 0), *scene.render(0))
segmenter.step(frame)
for name in scene.threads:
    segmenter.learn(frame, Seed(name, pixel=scene.seed_pixel(0, name)))
segmenter.step(frame)
assert segmenter.threads == scene.threads
# The thread moves fast, and is in the pictures no more.
blank = np.full_like(frame.left, 128)
painted, paint = [], Band.paint
Band.paint = lambda *args: painted.append(paint(*args))
for k in range(1, 12):
    capture_ns, shift = k * 33_000_000, 0.05 * abs(k - 6) * scene.truth(0)[0].length
    segmenter.step(StereoFrame(Stamp(k, capture_ns, 0), blank, blank))
    segmenter.follow(capture_ns, scene.truth(0)[0].points[::10] + [shift, 0, 0], scene.threads[0])
assert painted
print({name: k for name, k in compiled().items() if k != before[name]})
"""


def test_nothing_is_compiled_in_the_midst_of_a_run() -> None:
    ran = subprocess.run([sys.executable, "-c", _WARMS_UP], capture_output=True, text=True)
    assert ran.stdout == "{}\n", ran.stdout + ran.stderr


def test_a_field_lives_for_three_more_steps() -> None:
    frames = [
        StereoFrame(Stamp(i, 0, 0), image, image)
        for i, image in enumerate(line_image(0.3 * i) for i in range(4))
    ]
    segmenter = Segmenter(small_rig(81, 81))
    fields = [segmenter.step(frame) for frame in frames]
    again = [Segmenter(small_rig(81, 81), SegmentationConfig(c=9.0)).step(f) for f in frames]
    for field, alone in zip(fields, again, strict=True):
        assert abs(direction(field.left[40, 40]) - direction(alone.left[40, 40])) < 0.02
    assert len({round(direction(field.left[40, 40]), 1) for field in fields}) == 4


def direction(vector: Float32) -> float:
    return float(np.arctan2(vector[1], vector[0]) % np.pi)


# --- automatic c ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A violet thread on red and orange marbled paper."""
    return open_scene("figure8-175", 21, picture=Picture("violet", "marbled"))


def thread_pixels(scene: Scene, frame: int = 0) -> Float64:
    truth = scene.truth(frame)[0]
    return scene.rig.project(truth.points)[0][truth.visible]


def on_thread(field: Float32, pixels: Float64) -> Float64:
    strength = cv2.dilate(np.linalg.norm(field, axis=-1), np.ones((3, 3)))
    u, v = np.rint(pixels).astype(int).T
    return strength[v, u]


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize("gain", [0.5, 1.3])
def test_a_step_of_the_exposure_does_not_flicker(scene: Scene, learned: bool, gain: float) -> None:
    segmenter = Segmenter(scene.rig, SegmentationConfig(channel="learned" if learned else "red"))
    pixels, strengths = thread_pixels(scene), []
    left, right = scene.render(0)
    if learned:
        segmenter.learn(StereoFrame(STAMP, left, right), Seed(pixel=scene.seed_pixel()))
    for i in range(16):
        exposure = 0.75 * (gain if i >= 8 else 1.0)
        images = [np.rint(image * exposure).astype(np.uint8) for image in (left, right)]
        field = segmenter.step(StereoFrame(Stamp(i, 0, 0), *images))
        strengths.append(np.median(on_thread(field.left, pixels)))
    assert min(strengths) > 0.3
    assert np.ptp(strengths[7:10]) < 0.03
    assert np.ptp(strengths[4:]) < 0.05


def test_noise_does_not_make_the_field_flicker(scene: Scene) -> None:
    segmenter = Segmenter(scene.rig, SegmentationConfig(channel="red"))
    pixels = thread_pixels(scene)
    images = scene.render(0)
    rng, strengths = np.random.default_rng(0), []
    for i in range(12):
        noisy = [
            np.clip(np.rint(image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.uint8)
            for image in images
        ]
        field = segmenter.step(StereoFrame(Stamp(i, 0, 0), *noisy))
        strengths.append(np.median(on_thread(field.left, pixels)))
    assert np.std(strengths) < 0.01


# --- rims -----------------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**32 - 1),
    blur=st.floats(0.8, 3.0),
    reach=st.floats(2.0, 6.0),
    level=st.floats(-200.0, 0.0),
)
def test_rims_fade_as_in_the_literal_twin(
    seed: int, blur: float, reach: float, level: float
) -> None:
    rng = np.random.default_rng(seed)
    plane = cv2.GaussianBlur(rng.uniform(0, 255, (48, 64)), (0, 0), blur) + level
    field = rng.uniform(-0.3, 0.3, (48, 64, 2)).astype(np.float32)
    plane = plane.astype(np.float32)
    twin = reference.fade_rims(plane.astype(float), field.astype(float), reach)
    faded = field.copy()
    rims.fade_rims(plane, reach, faded)
    # Where a place lies halfway between two pixels, rounding may take the other one.
    assert np.mean(np.abs(faded - twin).max(-1) > 1e-3) < 0.001
    assert not np.array_equal(faded, field)


def test_rims_fade_and_threads_stay() -> None:
    """A thread alone and two side by side run to a tool that is as dark as they are."""
    rows = 30.0, 80.0, 84.5
    beside = np.abs(np.arange(161)[:, None] - rows).min(1)
    image = np.where((beside < 1.2)[:, None], 40, np.full((161, 161), 150))
    image[:, 120:] = 40
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8).astype(np.uint8)
    frame = StereoFrame(STAMP, image, image)
    plain, learned = (Segmenter(small_rig(161, 161), SegmentationConfig(c=12.0)) for _ in range(2))
    learned.learn(frame, Seed(pixel=(40.0, 30.0)))
    before, after = (np.linalg.norm(s.step(frame).left, axis=-1) for s in (plain, learned))
    rim = np.s_[45:65, 115:126]
    assert before[rim].max() > 0.4
    assert after[rim].max() < 0.05
    for row in (30, 80, 84):
        near = np.s_[row - 1 : row + 2, 20:110]
        np.testing.assert_allclose(after[near], before[near], atol=1e-6)


# --- learned contrast -----------------------------------------------------------------------------


def centre_errors(field: Float32, pixels: Float64) -> Float64:
    """How far beside the thread's middle the strongest response lies, px, within 4 px."""
    tangent = np.gradient(pixels, axis=0)
    normal = np.array([-1, 1]) * tangent[:, ::-1] / np.linalg.norm(tangent, axis=1, keepdims=True)
    offsets = np.arange(-4, 4.1, 0.25)
    around = pixels[:, None] + offsets[:, None] * normal[:, None]
    strength = np.linalg.norm(field, axis=-1)
    profile = cv2.remap(strength, around.astype(np.float32), None, cv2.INTER_LINEAR)
    return np.abs(offsets[profile.argmax(1)])


def learned_field(scene: Scene, seed: Seed, config: SegmentationConfig) -> Float32:
    segmenter = Segmenter(scene.rig, config)
    frame = StereoFrame(STAMP, *scene.render(0))
    segmenter.learn(frame, seed)
    return segmenter.step(frame).left


@pytest.mark.parametrize("rig", ["bench", "endoscope"])
@pytest.mark.parametrize("background", ["marbled", "plain"])
@pytest.mark.parametrize("thread", ["violet", "black", "blue", "undyed"])
def test_the_learned_mix_finds_the_middle_of_any_thread(
    thread: str, background: str, rig: str
) -> None:
    scene = open_scene("figure8-107", 31, rig, picture=Picture(thread, background))
    pixels = thread_pixels(scene)[5:-5]
    seed = Seed(pixel=scene.seed_pixel())
    learned = centre_errors(learned_field(scene, seed, SegmentationConfig()), pixels)
    gray = centre_errors(learned_field(scene, seed, SegmentationConfig(channel="gray")), pixels)
    assert np.mean(learned > 1) < 0.02
    assert np.mean(learned) < 0.35
    assert np.mean(learned) <= np.mean(gray)


def test_a_violet_thread_stands_out_from_red_only_in_the_learned_mix(scene: Scene) -> None:
    seed, pixels = Seed(pixel=scene.seed_pixel()), thread_pixels(scene)[5:-5]
    astray = {
        channel: np.mean(
            centre_errors(learned_field(scene, seed, SegmentationConfig(channel=channel)), pixels)
            > 1
        )
        for channel in ("learned", "red", "gray")
    }
    assert astray["learned"] < 0.01 < astray["red"] < astray["gray"]
    assert astray["gray"] > 0.1


@given(st.integers(0, 10**6), st.floats(0, 6.0), st.floats(0, 2 * np.pi))
@settings(max_examples=15)
def test_any_seed_near_the_thread_teaches(
    scene: Scene, place: int, distance: float, way: float
) -> None:
    pixels = thread_pixels(scene)
    u, v = pixels[20 + place % (len(pixels) - 40)] + distance * np.array([np.cos(way), np.sin(way)])
    field = learned_field(scene, Seed(pixel=(u, v)), SegmentationConfig())
    assert np.mean(centre_errors(field, pixels[5:-5]) > 1) < 0.02


@pytest.mark.parametrize("brightness", [0.15, 0.08, 0.04])
def test_a_dark_picture_teaches_as_a_bright_one_does(scene: Scene, brightness: float) -> None:
    pixels = thread_pixels(scene)
    left, right = ((brightness * image).astype(np.uint8) for image in scene.render(0))
    segmenter, frame = Segmenter(scene.rig), StereoFrame(STAMP, left, right)
    u, v = pixels[len(pixels) // 2]
    segmenter.learn(frame, Seed(pixel=(u, v)))
    assert not segmenter.unlearned
    assert np.mean(centre_errors(segmenter.step(frame).left, pixels[5:-5]) > 1) < 0.03


def test_a_point_teaches_as_its_pixel_does(scene: Scene) -> None:
    points = scene.truth(0)[0].points
    point = points[len(points) // 2]
    u, v = scene.rig.project_raw(point)[0]
    np.testing.assert_array_equal(
        learned_field(scene, Seed(point=tuple(point)), SegmentationConfig()),
        learned_field(scene, Seed(pixel=(u, v)), SegmentationConfig()),
    )


def test_a_seed_on_nothing_teaches_nothing(scene: Scene) -> None:
    far = np.array([[u, v] for u in range(40, 600, 40) for v in range(40, 440, 40)], float)
    distance = np.linalg.norm(far[:, None] - thread_pixels(scene), axis=2).min(1)
    image = scene.render(0)[0]
    nothing = far[distance > 40]
    assert len(nothing) > 20
    assert sum(contrast_at(image, pixel) is not None for pixel in nothing) <= len(nothing) // 20


def test_what_was_learned_at_a_seed_can_be_forgotten(scene: Scene) -> None:
    frame = StereoFrame(STAMP, *scene.render(0))
    alone, both, neither = Segmenter(scene.rig), Segmenter(scene.rig), Segmenter(scene.rig)
    good = Seed("good", pixel=scene.seed_pixel())
    wrong = Seed("wrong", pixel=tuple(thread_pixels(scene)[40]))
    alone.learn(frame, good)
    for segmenter in (both, neither):
        segmenter.learn(frame, wrong)
        segmenter.learn(frame, good)
    both.forget("wrong")
    both.forget("unknown")
    assert both.threads == ("good",)
    assert both.step(frame).left.tobytes() == alone.step(frame).left.tobytes()
    for thread in ("good", "wrong"):
        neither.forget(thread)
    untaught = Segmenter(scene.rig).step(frame).left.tobytes()
    assert neither.step(frame).left.tobytes() == untaught


def test_learned_contrast_stays_where_it_was_without_adaptation(scene: Scene) -> None:
    frame = StereoFrame(STAMP, *scene.render(0))
    bright = StereoFrame(STAMP, *(np.uint8(0.6 * image) for image in scene.render(0)))
    fields = []
    for adapt in (True, False):
        still, led = (Segmenter(scene.rig, SegmentationConfig(adapt=adapt)) for _ in range(2))
        for segmenter in (still, led):
            segmenter.learn(frame, Seed(pixel=scene.seed_pixel()))
        led.adapt(bright, thread_pixels(scene)[10:-10])
        fields.append(still.step(frame).left.tobytes() == led.step(frame).left.tobytes())
    assert fields == [False, True]


def test_a_wide_thread_gets_a_wide_filter() -> None:
    for width, lowest, highest in (
        (1.5, 1.2, 1.2),
        (10.0, 2.0, 4.0),
        (13.0, 3.0, 6.0),
        (20.0, 5.0, 9.0),
    ):
        contrast = contrast_at(line_image(0.3, width, size=641), np.array([320.0, 320.0]))
        assert contrast is not None
        assert lowest <= contrast.sigma <= highest


@pytest.mark.parametrize(
    ("scenario", "seed", "size", "width"),
    [("two-threads", 6320, (1920, 1080), 8.6), ("clutter", 6402, (1280, 720), 5.9)],
)
def test_what_runs_beside_the_shine_on_a_wide_thread_is_not_taken_for_it(
    scenario: str, seed: int, size: tuple[int, int], width: float
) -> None:
    scene = open_scene(scenario, seed, "endoscope", picture=Picture(size=size))
    contrast = contrast_at(scene.render(0)[0], np.array(scene.seed_pixel()))
    assert contrast is not None
    assert 0.3 < contrast.sigma / width < 0.6


@pytest.mark.parametrize("away", [16, 18])
def test_a_seed_teaches_a_thread_and_not_the_tool_beside_it(away: int) -> None:
    thread = 150.0 - line_image(0.2, 2.0, size=641)
    tool = np.roll(150.0 - line_image(0.2, 16.0, size=641), away, axis=0)
    image = np.rint(150 - 0.3 * thread + tool).astype(np.uint8)
    contrast = contrast_at(image, np.array([320.0, 320.0]))
    assert contrast is not None
    assert contrast.sigma < 2.0
    assert contrast.across.min() > 0.0


def test_an_enlarged_picture_shows_the_same_thread(scene: Scene) -> None:
    image, pixel = scene.render(0)[0], np.array(scene.seed_pixel())
    small = contrast_at(image, pixel)
    assert small is not None
    for times in (4, 6):
        large = cv2.resize(image, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        found = contrast_at(large, (pixel + 0.5) * times - 0.5)
        assert found is not None
        assert 0.35 < found.sigma / (times * small.sigma) < 1.7
        assert small.stands_out(found.weights) > 0.8 * small.stands_out(small.weights)


@pytest.mark.parametrize("channel", ["learned", "gray", "red"])
@pytest.mark.parametrize("coloured", [True, False])
def test_a_bright_thread_is_seen_after_the_seed(channel: str, coloured: bool) -> None:
    image = line_image(0.4, dark=False, size=161)
    if coloured:
        image = np.dstack([image, image, image])
    rig, seed = small_rig(161, 161), Seed(pixel=(80.0, 80.0))
    frame = StereoFrame(STAMP, image, image)
    segmenter = Segmenter(rig, SegmentationConfig(channel=channel))
    before = np.linalg.norm(segmenter.step(frame).left[80, 80])
    segmenter.learn(frame, seed)
    assert before < 0.15
    assert np.linalg.norm(segmenter.step(frame).left[80, 80]) > 0.4


@pytest.mark.parametrize(("width", "sigma"), [(12, 7.8), (30, 18.6)])
def test_the_contrast_of_a_wide_thread_follows_the_light(width: int, sigma: float) -> None:
    u = np.linspace(120.0, 520.0, 401)
    pixels = np.c_[u, np.interp(u, [100, 540], [200, 280])]
    across = []
    for level in (60, 110):
        image = np.full((480, 640, 3), 255, np.uint8)
        cv2.line(image, (100, 200), (540, 280), (level, level, level), width, cv2.LINE_8)
        across.append(contrast_along(image, pixels, sigma).across)
    np.testing.assert_allclose(across[1] / across[0], (255 - 110) / (255 - 60), rtol=0.02)


def test_a_channel_that_shows_nothing_of_the_thread_gives_an_empty_field() -> None:
    image = np.dstack([np.zeros((81, 81), np.uint8), line_image(0.4), line_image(0.4)])
    frame, rig = StereoFrame(STAMP, image, image), small_rig(81, 81)
    segmenter = Segmenter(rig, SegmentationConfig(channel="blue"))
    segmenter.learn(frame, Seed(pixel=(40.0, 40.0)))
    field = segmenter.step(frame)
    assert not field.left.any()


def test_threads_of_different_colours_are_seen_together() -> None:
    image = np.full((161, 161, 3), (60, 60, 190), np.uint8)
    for row, colour in ((50, (150, 40, 70)), (110, (40, 40, 40))):
        cv2.line(image, (0, row), (160, row), colour, 2, cv2.LINE_AA)
    image = np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255)
    frame = StereoFrame(STAMP, *[image.astype(np.uint8)] * 2)
    segmenter = Segmenter(small_rig(161, 161))
    segmenter.learn(frame, Seed("a", pixel=(80.0, 50.0)))
    segmenter.learn(frame, Seed("b", pixel=(80.0, 110.0)))
    strength = np.linalg.norm(segmenter.step(frame).left, axis=-1)
    assert (strength[[50, 110], 20:140].mean(1) > 0.4).all()
    assert strength[75:90, 20:140].mean() < 0.05


@pytest.mark.parametrize("other", [(250, 200, 120), (170, 90, 90)])
def test_each_of_several_threads_has_a_field_in_which_it_stands_out(
    other: tuple[int, int, int],
) -> None:
    """A dark violet thread beside a bright blue, or a faint violet one."""
    image = np.full((161, 161, 3), (60, 60, 190), np.uint8)
    for row, colour in ((50, (150, 40, 70)), (110, other)):
        cv2.line(image, (0, row), (160, row), colour, 2, cv2.LINE_AA)
    noise = np.random.default_rng(0).normal(0, 2, (2, *image.shape))
    frame = StereoFrame(STAMP, *np.clip(image + noise, 0, 255).astype(np.uint8))
    seeds = Seed("a", pixel=(80.0, 50.0)), Seed("b", pixel=(80.0, 110.0))
    segmenter = Segmenter(small_rig(161, 161))
    segmenter.learn(frame, seeds[0])
    assert not segmenter.step(frame).own
    segmenter.learn(frame, seeds[1])
    field = segmenter.step(frame)
    for i, seed in enumerate(seeds):
        alone = Segmenter(small_rig(161, 161))
        alone.learn(frame, seed)
        only, own = alone.step(frame), field.of(seed.thread)
        assert np.array_equal(own.left, only.left)
        assert np.array_equal(own.right, only.right)
        shown = np.linalg.norm(own.left, axis=-1)[[50, 110], 20:140].mean(1)
        assert shown[i] > 0.4
    for side, view in enumerate((field.left, field.right)):
        own = [views[side] for views in field.own.values()]
        assert np.array_equal(view, reference.strongest(own))
    segmenter.forget("a")
    assert segmenter.step(frame).left.tobytes() == only.left.tobytes()


@pytest.mark.parametrize("number", [221, 222])
def test_threads_that_cross_near_a_seed_are_seen_together(number: int) -> None:
    """Half of the ridge that runs on from one of the seeds is the other thread, of another colour."""
    scene = open_scene("two-threads", number)
    frame = StereoFrame(STAMP, *scene.render(0))
    segmenter = Segmenter(scene.rig)
    for thread in scene.threads:
        segmenter.learn(frame, Seed(thread, pixel=scene.seed_pixel(0, thread)))
    field = segmenter.step(frame)
    image = scene.rig.rectify(frame.left, frame.right)[0]
    for truth in scene.truth(0):
        pixels = scene.rig.project(truth.points)[0]
        u, v = np.rint(pixels).astype(int).T
        assert np.median(np.linalg.norm(field.left[v, u], axis=-1)) > 0.35
        seed = scene.rig.rectify_pixels(np.array(scene.seed_pixel(0, truth.thread)))
        learned = contrast_at(image, seed)
        assert learned is not None
        right = contrast_along(image, pixels, learned.sigma).across
        assert np.linalg.norm(learned.across - right) < 0.25 * np.linalg.norm(right)


def test_what_varies_along_the_thread_counts() -> None:
    """A black thread on a ground of several colours, seeded where it is blue."""
    scene = open_scene("clutter", 253)
    truth = scene.truth(0)[0]
    field = learned_field(scene, Seed(pixel=scene.seed_pixel()), SegmentationConfig())
    u, v = np.rint(scene.rig.project(truth.points[truth.visible])[0]).astype(int).T
    shown = np.linalg.norm(field[v, u], axis=-1)
    stretches = np.array_split(shown, 20)
    assert min(np.mean(stretch) for stretch in stretches) > 0.2


@pytest.mark.parametrize("number", [1150, 1153, 821])
def test_a_highlight_is_not_dark_where_the_thread_is(number: int) -> None:
    """Of a dark gray thread on wet red tissue, blue less red would show both alike; at 821 one is 8 px from
    the seed, and stands out more.
    """
    scene = open_scene("leaves-view", number)
    field = learned_field(scene, Seed(pixel=scene.seed_pixel()), SegmentationConfig())
    u, v = np.rint(scene.rig.project(scene.truth(0)[0].points)[0]).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < field.shape[1]) & (v < field.shape[0])
    u, v = u[inside], v[inside]
    away = np.ones(field.shape[:2], np.uint8)
    away[v, u] = 0
    is_white = (scene.render(0)[0].min(axis=2) > 225) & (cv2.erode(away, np.ones((21, 21))) > 0)
    assert np.count_nonzero(is_white) > 50
    shown = np.linalg.norm(field, axis=-1)
    assert np.quantile(shown[is_white], 0.9) < 0.25 * np.median(shown[v, u])


@pytest.mark.parametrize("number", range(4))
def test_a_black_thread_is_seen_whose_rims_a_lens_colours(number: int) -> None:
    """Its channels are a pixel apart, as at the edge of a lens: one rim is bluish, one reddish, and both are
    less like the tissue than the thread itself.
    """
    rng = np.random.default_rng(number)
    angle, along = rng.uniform(0, np.pi), np.linspace(-150, 150, 301)[:, None]
    towards = np.array([np.cos(angle), np.sin(angle)])
    v, u = np.mgrid[:400, :400] - 200.0
    ground = 120 + 24 * 12 * cv2.GaussianBlur(rng.normal(size=(400, 400)), (0, 0), 12)
    planes = []
    for shift in (1.0, 0.0, -1.0):
        distance = np.abs(u * -towards[1] + v * towards[0] - shift)
        share = expit(-2 * (distance - 2))
        planes.append(ground * (1 - share) + 15 * share)
    noisy = np.stack(planes, axis=2) + rng.normal(0, 1.5, (400, 400, 1))
    image = np.clip(noisy + rng.normal(0, 0.4, (400, 400, 3)), 0, 255).astype(np.uint8)
    frame, segmenter = StereoFrame(STAMP, image, image), Segmenter(small_rig(400, 400))
    segmenter.learn(frame, Seed(pixel=(201.0, 199.0)))
    assert segmenter.threads == ("0",)
    field, pixels = segmenter.step(frame).left, 200 + along * towards
    assert np.mean(centre_errors(field, pixels)) < 0.75
    assert np.quantile(on_thread(field, pixels), 0.05) > 0.5


@pytest.mark.parametrize("light", [(1.6, 1.0, 0.45), (0.55, 0.8, 1.15), (0.4, 0.4, 0.4)])
def test_another_exposure_and_white_balance_show_the_same(
    scene: Scene, light: tuple[float, float, float]
) -> None:
    images, pixels = scene.render(0), thread_pixels(scene)
    lit = [np.clip(np.rint(image * np.array(light)), 0, 255).astype(np.uint8) for image in images]
    segmenter = Segmenter(scene.rig)
    segmenter.learn(StereoFrame(STAMP, *images), Seed(pixel=scene.seed_pixel()))
    before, after = (
        np.median(on_thread(segmenter.step(StereoFrame(STAMP, *pair)).left, pixels))
        for pair in (images, lit)
    )
    assert before > 0.3
    assert abs(after - before) < 0.05


@pytest.mark.parametrize("thread", ["violet", "undyed"])
def test_the_contrast_follows_the_surroundings(thread: str) -> None:
    """The paper turns to tissue; who adapts sees the thread as if it were learned there."""
    scenes = [
        open_scene("figure8-107", 22, picture=Picture(thread, background))
        for background in ("marbled", "tissue")
    ]
    pairs, pixels = [scene.render(0) for scene in scenes], thread_pixels(scenes[0])
    seed = Seed(pixel=scenes[0].seed_pixel())
    following, staying, fresh = (Segmenter(scenes[0].rig) for _ in range(3))
    for segmenter in (following, staying):
        segmenter.learn(StereoFrame(STAMP, *pairs[0]), seed)
    steps = []
    for i in range(1, 20):
        share = min(i / 10, 1)
        mixed = [(1 - share) * a + share * b for a, b in zip(*pairs, strict=True)]
        frame = StereoFrame(Stamp(i, 0, 0), *(np.rint(image).astype(np.uint8) for image in mixed))
        following.adapt(frame, pixels[10:-10:10])
        steps.append(np.median(on_thread(following.step(frame).left, pixels)))
    fresh.learn(frame, seed)
    kept, lost, best = (
        np.median(on_thread(s.step(frame).left, pixels)) for s in (following, staying, fresh)
    )
    assert abs(kept - best) < 0.08
    assert abs(lost - best) > 2 * abs(kept - best)
    assert np.abs(np.diff(steps)).max() < 0.1


def test_a_thread_that_fades_at_once_is_seen_again(scene: Scene) -> None:
    """Fog comes and goes; the thread is lost in it at first."""
    clear, pixels = scene.render(0), thread_pixels(scene)
    fog = StereoFrame(STAMP, *(np.uint8(0.25 * image + 130) for image in clear))
    frame, segmenter = StereoFrame(STAMP, *clear), Segmenter(scene.rig)
    segmenter.learn(frame, Seed(pixel=scene.seed_pixel()))

    def seen(frame: StereoFrame) -> float:
        return float(np.median(on_thread(segmenter.step(frame).left, pixels)))

    before, in_fog = seen(frame), seen(fog)
    for _ in range(5):
        segmenter.fade()
    found = seen(fog)
    segmenter.adapt(fog, pixels[10:-10:10])
    held = seen(fog)
    assert in_fog < 0.2 * before
    assert found > 3 * in_fog
    assert held > 0.8 * found
    assert before > 0.3


def test_a_thread_that_was_only_hidden_is_looked_for_as_before(scene: Scene) -> None:
    frame, pixels = StereoFrame(STAMP, *scene.render(0)), thread_pixels(scene)[10:-10:10]
    lost, held = Segmenter(scene.rig), Segmenter(scene.rig)
    for segmenter in (lost, held):
        segmenter.learn(frame, Seed(pixel=scene.seed_pixel()))
    for _ in range(5):
        lost.fade()
    assert not np.array_equal(lost.step(frame).left, held.step(frame).left)
    for segmenter in (lost, held):
        segmenter.adapt(frame, pixels)
    np.testing.assert_array_equal(lost.step(frame).left, held.step(frame).left)


def test_a_curve_beside_the_thread_teaches_nothing(scene: Scene) -> None:
    frame, pixels = StereoFrame(STAMP, *scene.render(0)), thread_pixels(scene)[10:-10:10]
    led, left_alone = Segmenter(scene.rig), Segmenter(scene.rig)
    for segmenter in (led, left_alone):
        segmenter.learn(frame, Seed(pixel=scene.seed_pixel()))
    for offset in ((0, 9), (12, 0), (-20, 20)):
        led.adapt(frame, pixels + offset)
    np.testing.assert_array_equal(led.step(frame).left, left_alone.step(frame).left)


def test_a_dark_and_a_bright_thread_are_seen_together() -> None:
    image = np.full((161, 161, 3), (110, 110, 140), np.uint8)
    for row, colour in ((50, (90, 40, 60)), (110, (215, 220, 230))):
        cv2.line(image, (0, row), (160, row), colour, 2, cv2.LINE_AA)
    image = np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255)
    frame = StereoFrame(STAMP, *[image.astype(np.uint8)] * 2)
    segmenter = Segmenter(small_rig(161, 161))
    segmenter.learn(frame, Seed("a", pixel=(80.0, 50.0)))
    segmenter.learn(frame, Seed("b", pixel=(80.0, 110.0)))
    strength = np.linalg.norm(segmenter.step(frame).left, axis=-1)
    assert (strength[[50, 110], 20:140].mean(1) > 0.4).all()
    assert strength[75:90, 20:140].mean() < 0.05


def test_only_learned_threads_adapt(scene: Scene) -> None:
    frame = StereoFrame(STAMP, *scene.render(0))
    touched, untouched = Segmenter(scene.rig), Segmenter(scene.rig)
    touched.adapt(frame, thread_pixels(scene)[::5])
    np.testing.assert_array_equal(touched.step(frame).left, untouched.step(frame).left)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        (np.zeros((480, 640), np.uint16), None, "8-bit"),
        (np.zeros((480, 640, 3), np.float32), None, "8-bit"),
        (np.zeros((0, 0, 3), np.uint8), None, "fits the calibration"),
        (np.zeros((240, 320, 3), np.uint8), None, "fits the calibration"),
        (np.zeros((480, 640, 4), np.uint8), None, "fits the calibration"),
        (np.zeros((480, 640), np.uint8), np.zeros((480, 640, 3), np.uint8), "alike"),
        (np.zeros((480, 640), np.uint8), np.zeros((480, 320), np.uint8), "right image"),
    ],
)
def test_images_that_do_not_fit_are_refused(left, right, words: str) -> None:
    segmenter = Segmenter(make_rig())
    frame = StereoFrame(STAMP, left, left if right is None else right)
    for act in (segmenter.step, lambda f: segmenter.learn(f, Seed(pixel=(3.0, 3.0)))):
        with pytest.raises(InputError, match=words):
            act(frame)


def test_a_seed_that_no_image_shows_is_refused() -> None:
    segmenter, blank = Segmenter(make_rig()), np.zeros((480, 640, 3), np.uint8)
    for seed, words in (
        (Seed(pixel=(700.0, 5.0)), "outside the 640x480 left image"),
        (Seed(point=(0.0, 900.0, 200.0)), "outside the 640x480 left image"),
        (Seed(point=(0.0, 0.0, -200.0)), "behind the camera"),
    ):
        with pytest.raises(InputError, match=words):
            segmenter.learn(StereoFrame(STAMP, blank, blank), seed)


@pytest.mark.parametrize("u", [-0.4, 639.3])
def test_a_seed_on_the_outermost_half_pixel_teaches_its_thread(u: float) -> None:
    image = np.full((480, 640, 3), 200, np.uint8)
    cv2.line(image, (0, 240), (639, 240), (40, 40, 40), 3)
    segmenter = Segmenter(make_rig())
    segmenter.learn(StereoFrame(STAMP, image, image), Seed(pixel=(u, 240.0)))
    assert segmenter.threads == ("0",)


@pytest.mark.parametrize(
    "wrong", [{"sigmas": ()}, {"sigmas": (0.0,)}, {"beta": -1.0}, {"c": 0.0}, {"blur": 0.0}]
)
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        SegmentationConfig(**wrong)


@pytest.mark.parametrize("value", [0, 255])
def test_an_image_without_contrast_has_no_ridges(value: int) -> None:
    blank = np.full((480, 640, 3), value, np.uint8)
    segmenter, frame = Segmenter(make_rig()), StereoFrame(STAMP, blank, blank)
    segmenter.learn(frame, Seed(pixel=(300.0, 200.0)))
    assert not segmenter.step(frame).left.any()


# --- false colour ---------------------------------------------------------------------------------


def test_hue_is_direction_and_brightness_is_length() -> None:
    angles = np.linspace(0, np.pi, 12, endpoint=False)
    vectors = np.stack([np.cos(angles), np.sin(angles)], -1)[None].astype(np.float32)
    colours = direction_image(vectors)[0]
    np.testing.assert_array_equal(direction_image(-vectors)[0], colours)
    assert len(np.unique(colours, axis=0)) == 12
    assert (colours.max(1) == 255).all()
    np.testing.assert_allclose(direction_image(vectors / 2)[0].max(1), 128, atol=1)
    assert not direction_image(np.zeros((2, 2, 2), np.float32)).any()


def test_the_key_shows_every_direction_in_its_colour() -> None:
    key = direction_key(65)
    assert key.shape == (65, 65, 3)
    assert not key[0, 0].any()
    assert not key[32, 32].any()
    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        u, v = np.rint(32 + 22 * np.array([np.cos(angle), np.sin(angle)])).astype(int)
        at = np.array([u - 32, v - 32], np.float32) / np.hypot(u - 32, v - 32)
        expected = direction_image(at[None, None])[0, 0].astype(int)
        np.testing.assert_allclose(key[v, u], expected, atol=12)


@pytest.mark.parametrize(
    ("rim", "pale", "noise", "shadow", "expected"),
    [
        pytest.param(100.0, 1.0, 0.0, 0.0, True, id="hard rims"),
        pytest.param(100.0, 1.0, 12.0, 0.0, True, id="hard rims and noise"),
        pytest.param(2.0, 1.0, 0.0, 0.0, False, id="through a lens"),
        pytest.param(2.0, 1.0, 3.0, 0.0, False, id="through a lens, with noise"),
        pytest.param(2.0, 0.2, 0.0, 0.0, True, id="enlarged, with highlights"),
        pytest.param(2.0, 0.2, 0.0, 0.4, False, id="on paper, with a shadow"),
    ],
)
def test_a_thread_is_taken_for_cut_out_where_its_shades_say_nothing(
    rim: float, pale: float, noise: float, shadow: float, expected: bool
) -> None:
    """Through a lens, on white, its shades tell its middle better than a hard outline."""
    row = np.abs(np.arange(100) - 50.2)[:, None] + np.zeros((1, 120))
    shades = np.where(np.arange(120) % 40 < 8, pale, 1.0) * expit(rim * (3 - row))
    shades = np.maximum(shades, shadow * expit((14 - row) / 3))
    rng = np.random.default_rng(0)
    image = 255 - 150 * shades + noise * rng.standard_normal(shades.shape)
    left = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    assert is_cut_out(StereoFrame(STAMP, left, left)) == expected
    assert is_cut_out(StereoFrame(STAMP, 255 - left, 255 - left)) == expected
