"""The active-stereo rig: its light against geometry, its matcher against brute force, and the
noise, holes and shadows that come out, against what physics and the vendor say.

COURSEKIT_NIGHTLY=1 runs the sweep of the noise exponent with ten seeds and six distances.
"""

import warnings
from dataclasses import replace
from functools import cache

import cv2
import numba
import numpy as np
import pytest
from common import NIGHTLY, each, named, refusals
from scipy.spatial import cKDTree

from coursekit.geometry import Intrinsics, make_transform, project
from coursekit.simulation import rig as rig_module
from coursekit.simulation.rig import Rig, cost_curve, match
from coursekit.simulation.scenes import Box, artefact_scene, render, tabletop, wall_scene
from coursekit.specifications import device

UNIT = device("D435").unit
F, B = UNIT.depth.fx, UNIT.baseline_m
D435 = Rig(UNIT.depth, B)
NOISELESS = replace(D435, electrons_per_grey=1e9, read_noise_e=0.0)
MIDDLE = np.s_[120:360, 212:636]
MIDDLE_ONLY = replace(
    UNIT.depth, width=424, height=240, cx=UNIT.depth.cx - 212, cy=UNIT.depth.cy - 120
)
PROJECTOR_M = np.array([rig_module.PROJECTOR_AT * B, 0, 0])  # from the left eye


def plate(name: str, size: tuple, center: tuple, albedo: float, specular: float = 0.0) -> Box:
    T = make_transform(np.eye(3), center)
    return Box(name, np.array(size), T, (albedo,) * 3, specular=specular)


def truth_m(view) -> np.ndarray:
    return render(view.scene, view.rig.left).depth_m


def true_disparity(view) -> np.ndarray:
    return F * B / truth_m(view)


def disparities(view, n: int, seed: int, rows: slice = slice(None)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([match(*(eye[rows] for eye in view.images(rng))) for _ in range(n)])


@cache
def on_wall(rig: Rig, distance: float, tilt: float = 7.0):
    """A view of a wall alone, rendered once for the tests that share it."""
    return rig.look_at(wall_scene(distance, tilt))


@cache
def on_table(distance: float):
    return D435.look_at(tabletop(distance))


@cache
def artefacts():
    """A view of all artefacts, rendered once."""
    return D435.look_at(artefact_scene())


# Light


@pytest.mark.parametrize(("error", "offset"), [(0.0, 0.0), (0.02, 0.8)])
def test_dots_are_where_geometry_puts_them_in_both_eyes(error, offset):
    """A wall square to the camera: projector, true baseline and yaw give every dot's pixel."""
    distance = 0.8
    rig = replace(NOISELESS, baseline_error=error, disparity_offset_px=offset)
    pair = on_wall(rig, distance, 0.0).images(np.random.default_rng(0))
    dots, _ = rig_module._pattern(F)
    points = dots[..., :2].reshape(-1, 2) * distance
    points = np.column_stack([points, np.full(len(points), distance)])
    points += PROJECTOR_M
    yaw = np.arctan(offset / F)
    turn = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    eyes = [points, (points - [B * (1 + error), 0, 0]) @ turn.T]
    for image, seen in zip(pair, eyes, strict=True):
        pixels = project(seen, UNIT.depth.K)
        inside = (np.abs(pixels - [424, 240]) < [300, 180]).all(axis=1)
        alone = (cKDTree(pixels).query(pixels, k=2)[0][:, 1] > 8) & inside
        found = np.array([centroid(image, pixel) for pixel in pixels[alone]])
        off = found - pixels[alone]
        assert len(off) > 150
        assert np.abs(off.mean(axis=0)).max() < 0.02
        assert off.std(axis=0).max() < 0.10  # speckle


def centroid(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    u, v = np.rint(near).astype(int)
    window = image[v - 3 : v + 4, u - 3 : u + 4].astype(float)
    weight = np.maximum(window - np.median(window), 0)
    j, i = np.mgrid[-3:4, -3:4]
    return np.array([u + (weight * i).sum() / weight.sum(), v + (weight * j).sum() / weight.sum()])


def test_brightness_follows_lambert_and_the_inverse_square():
    rig = replace(NOISELESS, exposure=3.0, ambient=0.0)
    measured, predicted = [], []
    for distance, tilt in ((0.6, 0.0), (1.2, 0.0), (0.9, 40.0)):
        view = on_wall(rig, distance, tilt)
        left = view.images(np.random.default_rng(0))[0] - rig_module.BLACK_GREY
        normal = np.array([np.sin(np.radians(tilt)), 0, -np.cos(np.radians(tilt))])
        depth_m = truth_m(view)
        for u, v in ((424, 240), (120, 240), (728, 240), (424, 90), (150, 400)):
            z = depth_m[v, u]
            point = np.array([(u - UNIT.depth.cx) / F, (v - UNIT.depth.cy) / F, 1.0]) * z
            to_lamp = PROJECTOR_M - point
            r = np.linalg.norm(to_lamp)
            measured.append(left[v - 45 : v + 46, u - 45 : u + 46].mean())
            predicted.append(abs(normal @ to_lamp) / r / r**2)
    ratio = np.array(measured) / predicted
    assert np.ptp(predicted) / np.min(predicted) > 10
    np.testing.assert_allclose(ratio / ratio.mean(), 1.0, atol=0.15)  # 80-120 dots a patch


def test_the_projector_throws_a_shadow_and_room_light_fills_it():
    near, far = 0.5, 1.0
    post = plate("post", (0.06, 1.0, 0.002), (0.0, 0.0, near + 0.001), 0.7)
    scene = (*wall_scene(far, 0.0), post)
    views = [replace(NOISELESS, ambient=a, exposure=4.0).look_at(scene) for a in (0.0, 0.2)]
    dark, room = (v.images(np.random.default_rng(0))[0][200:280].mean(axis=0) for v in views)
    edge = UNIT.depth.cx - F * 0.03 / near
    width = F * rig_module.PROJECTOR_AT * B * (1 / near - 1 / far)  # seen from the left eye
    shadow = np.arange(round(edge - width) + 2, round(edge) - 1)
    assert len(shadow) > 4
    assert np.abs(dark[shadow] - rig_module.BLACK_GREY).max() < 0.5
    assert dark[shadow[0] - 30 : shadow[0] - 5].mean() > rig_module.BLACK_GREY + 5
    wall = np.mean(scene[0].color) * 0.2 * rig_module.AMBIENT_UNIT * rig_module.GREY_PER_MS * 4.0
    assert room[shadow].mean() - rig_module.BLACK_GREY == pytest.approx(wall, rel=0.06)


def test_the_specular_lobe_is_where_a_mirror_would_show_the_projector():
    distance, half = 0.6, rig_module.PROJECTOR_AT * B / 2
    shiny = plate("shiny", (0.8, 0.5, 0.002), (0.0, 0.0, distance + 0.001), 0.5, specular=0.9)
    view = replace(NOISELESS, exposure=0.05).look_at((shiny,))
    centers = []
    for image in view.images(np.random.default_rng(0)):
        smooth = cv2.GaussianBlur(image.astype(float), (0, 0), 12) - rig_module.BLACK_GREY
        weight = np.where(smooth > 0.3 * smooth.max(), smooth, 0)
        v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
        centers.append([(weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()])
    left, right = np.array(centers) - [UNIT.depth.cx, UNIT.depth.cy]
    # The mirror point is half-way between eye and projector.
    np.testing.assert_allclose(left, [F * half / distance, 0], atol=3)
    np.testing.assert_allclose(right, [F * (half - B / 2) / distance, 0], atol=3)


def test_auto_exposure_follows_the_distance_and_a_fixed_one_does_not():
    times = [on_wall(D435, z).exposure_ms for z in (0.3, 0.6, 1.0)]
    np.testing.assert_allclose(np.array(times) / times[1], [0.25, 1, 25 / 9], rtol=0.1)
    assert on_wall(D435, 6.0).exposure_ms == rig_module.LONGEST_MS
    assert on_wall(replace(D435, exposure=8.5), 1.0).exposure_ms == 8.5


# Sensor


def test_noise_is_photons_plus_reading():
    """The photon transfer curve: variance against mean is a line of known slope and intercept."""
    view, rng = on_wall(D435, 1.0), np.random.default_rng(0)
    stack = np.stack([view.images(rng)[1] for _ in range(40)]).astype(np.float32)
    mean, variance = stack.mean(axis=0), stack.var(axis=0, ddof=1)
    bins = np.linspace(25, 180, 12)
    which = np.digitize(mean, bins)
    x = [mean[which == k].mean() - rig_module.BLACK_GREY for k in range(1, len(bins))]
    y = [variance[which == k].mean() for k in range(1, len(bins))]
    slope, intercept = np.polyfit(x, y, 1)
    assert slope == pytest.approx(1 / D435.electrons_per_grey, rel=0.03)
    wanted = (D435.read_noise_e / D435.electrons_per_grey) ** 2 + 1 / 12  # and rounding
    assert intercept == pytest.approx(wanted, rel=0.10)
    image = stack - mean
    neighbours = [np.mean(image[:, 1:] * image[:, :-1]), np.mean(image[..., 1:] * image[..., :-1])]
    frames = np.mean(image[1:] * image[:-1]) + np.mean(variance) / 40  # the mean ties frames
    assert np.abs([*neighbours, frames]).max() < 0.002 * variance.mean()


def test_fixed_pattern_stays_and_belongs_to_the_unit():
    views = [replace(NOISELESS, seed=seed, exposure=5.0).look_at(()) for seed in (0, 0, 1)]
    first, again, other = (view.images(np.random.default_rng(0))[0] for view in views)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.std() == pytest.approx(np.hypot(rig_module.DSNU_GREY, 12**-0.5), rel=0.1)


def test_the_same_seed_gives_the_same_bytes_whatever_the_thread_count():
    def shoot() -> list[bytes]:
        rig_module._light.cache_clear()
        small = replace(D435, left=MIDDLE_ONLY, drift_px=0.02, disparity_offset_px=0.1)
        view = small.look_at(artefact_scene())
        rng = np.random.default_rng(5)
        frames = [view.frame(rng, time_s=k / 30) for k in range(2)]
        return [x.tobytes() for f in frames for x in (f.left, f.right, view.depth(f, 1e-4))]

    many = shoot()
    threads, cv_threads = numba.get_num_threads(), cv2.getNumThreads()
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        one = shoot()
    finally:
        numba.set_num_threads(threads)
        cv2.setNumThreads(cv_threads)
    assert many == one
    assert many[0] != many[3]  # each frame has its own noise


# Hidden truth


def test_drift_is_a_stationary_process_with_the_stated_time():
    times = np.arange(0, 1500, 0.5)
    rigs = [replace(D435, seed=seed, drift_px=0.02, drift_time_s=3.0) for seed in range(12)]
    tracks = np.array([[rig.drift(t) for t in times] for rig in rigs])
    assert tracks.std() == pytest.approx(0.02, rel=0.05)
    assert abs(tracks.mean()) < 0.001
    for lag in (2, 6, 12):
        correlation = np.mean(tracks[:, lag:] * tracks[:, :-lag]) / tracks.var()
        assert correlation == pytest.approx(np.exp(-lag * 0.5 / 3.0), abs=0.06)
    assert D435.drift(1.0) == 0.0


def test_drift_as_a_shift_of_the_mean_image_is_close_to_an_eye_rendered_anew():
    still = replace(NOISELESS, seed=3, drift_px=0.05)
    time = next(t for t in np.arange(0, 60, 0.1) if still.drift(t) > 0.06)
    shift = still.drift(time)
    scene, rng = wall_scene(0.8), np.random.default_rng(0)
    before = replace(still, drift_px=0.0).look_at(scene).frame(rng).disparity
    shifted = still.look_at(scene).frame(rng, time).disparity
    turned = replace(still, drift_px=0.0, disparity_offset_px=shift).look_at(scene)
    rendered = turned.frame(rng).disparity
    both = (np.abs(shifted - before) < 0.5) & (np.abs(rendered - before) < 0.5) & (before > 0)
    x = np.broadcast_to((np.arange(848) - UNIT.depth.cx) / F, before.shape)
    for part in (both & (np.abs(x) < 0.2), both & (np.abs(x) > 0.7)):
        move, wanted = (shifted - before)[part].mean(), (rendered - before)[part].mean()
        assert wanted == pytest.approx(shift * (1 + (x[part] ** 2).mean()), rel=0.06)
        assert move == pytest.approx(wanted, rel=0.07)


# Matcher


def test_matcher_agrees_with_brute_force_at_random_pixels():
    rng = np.random.default_rng(0)
    left, right = artefacts().images(rng)
    disparity = match(left, right)
    v, u = np.nonzero(disparity)
    for k in rng.choice(len(u), 150, replace=False):
        if not (5 <= u[k] < 843 and 5 <= v[k] < 475):
            continue
        cost = cost_curve(left, right, u[k], v[k])
        d = int(np.nanargmin(cost))
        rise = max(cost[d - 1], cost[d + 1]) - cost[d]
        between = d + 0.5 * (cost[d - 1] - cost[d + 1]) / rise
        assert disparity[v[k], u[k]] == pytest.approx(between, abs=1e-5)
        away = np.abs(np.arange(127) - d) > 1
        assert np.nanmin(cost[away]) >= 1.12 * cost[d]


def test_each_gate_only_takes_away():
    left, right = on_table(0.45).images(np.random.default_rng(0))
    off = {"uniqueness": 0, "texture": -1.0, "left_right": 127}
    loose = match(left, right, **off)
    for gate in ({"uniqueness": 25}, {"texture": 20.0}, {"left_right": 0}):
        tight = match(left, right, **off | gate)
        kept = tight > 0
        assert np.array_equal(tight[kept], loose[kept])
        assert 0.2 < kept.mean() < (loose > 0).mean() - 0.01


def test_a_shifted_image_has_its_shift_for_disparity():
    rng = np.random.default_rng(1)
    scene = cv2.GaussianBlur(rng.uniform(0, 255, (60, 500)).astype(np.float32), (0, 0), 1.2)
    scene = (4 * (scene - 127) + 127).clip(0, 255).astype(np.uint8)
    for shift in (1, 40, 125):
        left, right = scene[:, 150:350], scene[:, 150 + shift : 350 + shift]
        inside = match(left, right)[8:-8, shift + 8 : -8]
        assert (inside > 0).mean() > 0.95
        assert inside[inside > 0].mean() == pytest.approx(shift, abs=0.01)
        np.testing.assert_allclose(inside[inside > 0], shift, atol=0.25)
    assert (match(scene[:, 150:350], scene[:, 276:476]) == 0).mean() > 0.9  # 126: no neighbour


def test_z16_rounds_to_counts_and_refuses_what_it_cannot_hold():
    disparity = np.array([[0, 0.01, 10, 21.63, 125.5]], np.float32)
    for unit in (1e-3, 1e-4):
        counts = rig_module.counts(disparity, F, B, unit)
        exact = F * B / np.where(disparity > 0, disparity.astype(float), np.inf) / unit
        wanted = np.where(exact < 65535.5, np.rint(exact), 0)
        assert counts.dtype == np.uint16
        assert np.abs(counts - wanted).max() <= (1 if unit == 1e-4 else 0)
        assert counts[0, 0] == counts[0, 1] == 0


def test_errors_hardly_depend_on_the_sub_pixel_part_of_the_disparity():
    """Pixel locking: the mean error of each sixteenth of a pixel."""
    total, count = np.zeros((2, 16))
    for seed, distance in enumerate((0.5, 0.85, 1.0, 1.4)):
        view = on_wall(replace(D435, seed=seed), distance)
        rows = slice(160, 320)
        true = true_disparity(view)[rows]
        error = match(*(eye[rows] for eye in view.images(np.random.default_rng(seed)))) - true
        good = np.abs(error) < 1
        phase = (true % 1 * 16).astype(int)[good]
        total += np.bincount(phase, error[good], 16)
        count += np.bincount(phase, minlength=16)
    assert np.ptp(total / count) <= 0.03


# What comes out


@cache
def noise(rig: Rig, distance: float, frames: int) -> tuple[float, ...]:
    """The temporal std of one pixel on the tilted wall: disparity, px; depth in 0.1 mm units, m;
    depth in 1 mm units, m.

    Pooled over the pixels of the image's middle quarter that are valid in most frames, without
    false matches (1 px and more from their pixel's median).
    """
    view = on_wall(rig, distance)
    shots = disparities(view, frames, rig.seed, slice(108, 372))[:, 12:-12, MIDDLE[1]]
    d = shots.copy()
    d[:, (d > 0).sum(axis=0) <= frames / 2] = np.nan
    d[d == 0] = np.nan
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # all-NaN pixels
        d[np.abs(d - np.nanmedian(d, axis=0)) >= 1] = np.nan
    fine, coarse = (rig_module.counts(shots, F, B, unit) * unit for unit in (1e-4, 1e-3))
    return tuple(pooled_std(np.where(np.isnan(d), np.nan, x)) for x in (d, fine, coarse))


def pooled_std(stack: np.ndarray) -> float:
    count = np.isfinite(stack).sum(axis=0)
    stack, count = stack[:, count > 1], count[count > 1]
    return float(np.sqrt(np.nansum((stack - np.nanmean(stack, 0)) ** 2) / (count - 1).sum()))


def sweep(rig: Rig) -> tuple[float, float, np.ndarray]:
    """The exponents of depth noise against Z, in 0.1 and 1 mm units; sigma_d at each distance."""
    sigma_d, fine, coarse = np.array([noise(rig, z, FRAMES) for z in NEAR_TO_FAR]).T
    powers = [np.polyfit(np.log(NEAR_TO_FAR), np.log(x), 1)[0] for x in (fine, coarse)]
    return powers[0], powers[1], sigma_d


NEAR_TO_FAR = (0.3, 0.45, 0.6, 1.0, 1.5, 2.0) if NIGHTLY else (0.3, 0.6, 1.0, 2.0)
FRAMES = 30 if NIGHTLY else 5


@pytest.mark.parametrize("seed", range(10) if NIGHTLY else (0,))
def test_depth_noise_grows_as_the_square_of_the_distance(seed):
    power, coarse, sigma_d = sweep(replace(D435, seed=seed))
    assert power == pytest.approx(2.00, abs=0.06)
    assert sigma_d.mean() == pytest.approx(0.08, abs=0.01)
    assert 1.6 < coarse < 1.9  # rounding flattens the near end


@pytest.mark.parametrize("ambient", (0.2, 0.5, 1.0) if NIGHTLY else (0.5,))
@pytest.mark.parametrize("seed", range(3) if NIGHTLY else (0,))
def test_room_light_steepens_the_curve(ambient, seed):
    """What claim D7 says of ambient light."""
    assert 2.2 <= sweep(replace(D435, seed=seed, ambient=ambient))[0] <= 2.6


@pytest.mark.parametrize(("near", "behind"), [(0.3, 0.5), (0.45, 0.5), (0.6, 0.3)])
def test_shadow_is_on_the_left_and_as_wide_as_geometry_says(near, behind):
    """What the right eye cannot see of the wall behind a post 60 mm wide.

    Any edge costs the window a few pixels more: the right one has no shadow and shows how many.
    """
    post = plate("post", (0.06, 1.5, 0.03), (0.0, 0.0, near + 0.015), 0.7)
    view = D435.look_at((*wall_scene(near + behind, 0.0), post))
    holes = (disparities(view, 3, 0, slice(110, 370))[:, 10:-10] == 0).mean((0, 1))
    left, right = UNIT.depth.cx - F * 0.03 / near, UNIT.depth.cx + F * 0.03 / near
    width = F * B * (1 / near - 1 / (near + behind))
    on_left = holes[round(left - width) - 14 : round(left) + 10].sum()
    on_right = holes[round(right) - 10 : round(right) + 14].sum()
    assert on_right < 5
    assert on_left - on_right == pytest.approx(width, abs=2)
    assert holes[round(left - width) + 2 : round(left) - 5].mean() > 0.9


@pytest.mark.parametrize("seed", range(2 if NIGHTLY else 1))
@pytest.mark.parametrize(("near", "behind"), [(0.3, 0.5), (0.45, 0.5), (0.6, 0.5), (0.45, 0.2)])
def test_flying_pixels_are_a_few_per_cent_of_the_edge(near, behind, seed):
    """Valid pixels within 8 px of the block's outline that are on neither surface (5 sigma_d)."""
    wall, block = wall_scene(near + behind, 0.0)[0], tabletop(near)[2]
    view = replace(D435, seed=seed).look_at((wall, block))
    mask = (truth_m(view) < near + 0.001).astype(np.uint8)
    square = np.ones((17, 17), np.uint8)
    band = (cv2.dilate(mask, square) - cv2.erode(mask, square)) > 0
    d = disparities(view, 3, seed)[:, band]
    valid = d > 0
    flying = valid & (np.abs(d - F * B / near) > 0.4) & (np.abs(d - F * B / (near + behind)) > 0.4)
    share = flying.sum() / valid.sum()
    assert 0.01 <= share <= 0.10
    assert 0.1 < (~valid).mean() < 0.4


def test_the_artefact_scene_shows_each_artefact():
    scene, square = artefact_scene(), np.ones((13, 13), np.uint8)
    index = render(scene, UNIT.depth).object_index
    d = disparities(artefacts(), 2, 0)
    masks = [cv2.erode((index == k).astype(np.uint8), square) > 0 for k in range(len(scene))]
    inside = dict(zip([box.name for box in scene], masks, strict=True))
    holes = {name: float((d[:, mask] == 0).mean()) for name, mask in inside.items()}
    assert min(holes["dark card"], holes["shiny plate"]) > 0.9
    assert holes["table"] < 0.15
    assert holes["60 mm block"] < 0.05
    assert (np.abs(d - true_disparity(artefacts())) > 2)[:, inside["finger"]].all()


@pytest.mark.parametrize("distance", [0.12, 0.15, 0.165])
def test_nothing_correct_under_the_minimum_range(distance):
    """And nearly all is right from there on: claim D9."""
    view = on_wall(D435, distance, 0.0)
    depth = view.depth(view.frame(np.random.default_rng(0)), 1e-4) * 1e-4
    valid = depth > 0
    assert (~valid).mean() > 0.6
    assert np.abs(depth[valid] / distance - 1).min() > 0.03
    closest = on_wall(D435, 0.18, 0.0)
    good = np.abs(disparities(closest, 1, 0)[0] - F * B / 0.18) < 0.5
    assert good[60:420, 300:780].mean() > 0.9


def test_without_a_projector_a_bland_wall_is_holes_and_a_wooden_table_is_not():
    unit = device("D405").unit
    rig = Rig(unit.depth, unit.baseline_m, projector=False, ambient=1.0)
    scene = artefact_scene(0.4)
    index = render(scene, unit.depth).object_index
    d = disparities(rig.look_at(scene), 1, 0)[0]
    valid = {box.name: (d[index == k] > 0).mean() for k, box in enumerate(scene)}
    assert valid["wall"] < 0.25
    assert valid["table"] > 0.7


# The edges of the interface


BENT = replace(UNIT.depth, model="brown_conrady", coeffs=(0.1, 0, 0, 0, 0))
GREY = np.zeros((40, 200), np.uint8)
ROOM = (plate("room", (2, 2, 2), (0, 0, 0), 0.5),)


def changed(**changes):
    return replace(D435, **changes)


test_what_cannot_be_is_refused = refusals(
    *each("baseline_m: got 0.0, want a positive", changed, "baseline_m", 0.0),
    *named(changed, baseline_error=[-1.0], disparity_offset_px=[np.nan], drift_px=[-0.1]),
    *named(changed, drift_time_s=[0], ambient=[-1], exposure=[0], read_noise_e=["6"]),
    *each("electrons_per_grey: got True", changed, "electrons_per_grey", True),
    *each("exposure: got 'manual', want \"auto\" or", changed, "exposure", "manual"),
    *each(r"left: got \(0.1, 0.0, 0.0, 0.0, 0.0\), want no coefficients", changed, "left", BENT),
    ("scene: got 'wall'", lambda: D435.look_at("wall")),
    ("camera is inside the box 'room'", lambda: D435.look_at(ROOM)),
    (r"left: got \('float64'", lambda: match(GREY.astype(float), GREY)),
    (r"right: got \('uint8', \(200,\)", lambda: match(GREY, GREY[0])),
    (r"left: got \('uint8', \(8, 200\)", lambda: match(GREY[:8], GREY[:8])),
    (r"right: got \(40, 199\), want", lambda: match(GREY, GREY[:, :-1])),
    (r"u, v: got \(3, 20\)", lambda: cost_curve(GREY, GREY, 3, 20)),
    ("depth_scale_m", lambda: rig_module.counts(np.ones((2, 2), np.float32), F, B, 0.0)),
    *each("distance_m", artefact_scene, "distance_m", 0.2, "far", np.inf),
    ("tilt_deg", lambda: wall_scene(1.0, 60)),
    ("specular", lambda: plate("p", (1, 1, 1), (0, 0, 3), 0.5, specular=1.5)),
)


def test_an_empty_or_unlit_view_is_all_holes():
    for rig, scene in ((D435, ()), (replace(D435, projector=False, ambient=0.0), wall_scene())):
        view = rig.look_at(scene)
        assert view.exposure_ms == rig_module.LONGEST_MS
        assert not view.frame(np.random.default_rng(0)).disparity.any()


def test_cost_curve_shows_the_match_and_the_images_end():
    view = on_wall(D435, 0.6, 0.0)
    left, right = view.images(np.random.default_rng(0))
    curve = cost_curve(left, right, 424, 240)
    assert curve.shape == (127,)
    assert abs(np.argmin(curve) - F * B / 0.6) < 1
    near_edge = cost_curve(left, right, 60, 240)
    assert np.isnan(near_edge[56:]).all()
    assert np.isfinite(near_edge[:56]).all()


@pytest.mark.parametrize("tilt", [0.0, 7.0, -20.0])
def test_the_wall_turns_about_the_optical_axis(tilt):
    camera = Intrinsics(848, 480, F, F, 424.0, 240.0)
    depth = render(wall_scene(0.8, tilt), camera).depth_m
    x = (np.arange(848) - 424) / F
    wanted = 0.8 / (1 - np.tan(np.radians(tilt)) * x)
    np.testing.assert_allclose(depth[[0, 240, 479]], np.broadcast_to(wanted, (3, 848)), rtol=1e-9)
