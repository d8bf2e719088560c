"""Rendered scenes against geometry done another way: triangles, planes, counting pixels."""

import cv2
import numpy as np
import pytest
from common import named, refusals
from scipy.spatial.transform import Rotation

from coursekit import geometry
from coursekit.geometry import Intrinsics, invert_transform, make_transform, project
from coursekit.simulation import Box, raycast, render, tabletop
from coursekit.specifications import device, lens

UNIT = device("D435").unit
NAMES = ["wall", "table", "60 mm block", "25 mm cube"]
WALL, TABLE, BLOCK, CUBE = range(4)


SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


def box_triangles(box: Box, T_camera_scene: np.ndarray) -> np.ndarray:
    """The 12 triangles of a box, (12, 3 corners, 3), in the camera frame."""
    corners = geometry.transform_points(T_camera_scene @ box.T_scene_box, SIGNS * box.size_m / 2)
    # of each side the corners are in the order --, -+, +-, ++
    sides = [np.flatnonzero(SIGNS[:, axis] == sign) for axis in range(3) for sign in (-1, 1)]
    return np.concatenate([corners[side[[[0, 1, 2], [3, 1, 2]]]] for side in sides])


def moeller_trumbore(rays: np.ndarray, scene: tuple[Box, ...], T_scene_camera: np.ndarray):
    """Depth along rays (n, 3) with Z = 1 and the box each hits, from triangles alone."""
    T_camera_scene = np.linalg.inv(T_scene_camera)
    triangles = np.concatenate([box_triangles(box, T_camera_scene) for box in scene])
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    edge1, edge2 = b - a, c - a
    p = np.cross(rays[:, None], edge2)
    determinant = np.einsum("rtk,tk->rt", p, edge1)
    q = np.cross(-a, edge1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = -np.einsum("rtk,tk->rt", p, a) / determinant
        v = rays @ q.T / determinant
        t = np.einsum("tk,tk->t", q, edge2) / determinant
    tolerance = 1e-12  # on the diagonal shared by two triangles either may claim the ray
    inside = (u >= -tolerance) & (v >= -tolerance) & (u + v <= 1 + tolerance) & (t > 0)
    t = np.where(inside, t, np.inf)
    nearest = t.argmin(axis=1)
    depth = t[np.arange(len(rays)), nearest]
    hit = np.isfinite(depth)
    return np.where(hit, depth, 0.0), np.where(hit, nearest // 12, -1)


def pose(yaw_pitch_roll_deg: tuple[float, float, float], translation: tuple[float, float, float]):
    """A camera that turns right by the yaw, then up by the pitch, then rolls."""
    return make_transform(Rotation.from_euler("YXZ", yaw_pitch_roll_deg, degrees=True), translation)


# librealsense's extrinsics are float32; made orthonormal to 1e-16 for a comparison to 1e-9
BESIDE = invert_transform(UNIT.T_color_depth)
BESIDE = make_transform(Rotation.from_matrix(BESIDE[:3, :3]), BESIDE[:3, 3])

CAMERAS = {
    "depth": (UNIT.depth, np.eye(4)),
    "colour beside it": (UNIT.color, BESIDE),
    "from above": (UNIT.color, pose((10, -40, 3), (0.05, -0.35, 0.10))),
    "rolled, from the side": (UNIT.depth, pose((-68, -8, 85), (0.42, -0.08, 0.33))),
    "distorted": (lens("opencv_left").intrinsics, np.eye(4)),
    "wide": (lens("duckiebot_wide").intrinsics, pose((25, -20, -10), (-0.2, -0.1, 0.05))),
}


@pytest.mark.parametrize("which", CAMERAS)
def test_random_rays_agree_with_moeller_trumbore(which):
    intrinsics, T_scene_camera = CAMERAS[which]
    scene = tabletop(0.45)
    result = render(scene, intrinsics, T_scene_camera)
    rng = np.random.default_rng(20)
    v, u = np.divmod(rng.choice(result.depth_m.size, 3000, replace=False), result.depth_m.shape[1])
    small = np.argwhere(result.object_index >= BLOCK)  # they cover few pixels: take some on purpose
    v, u = np.concatenate([np.stack([v, u]), small[rng.integers(len(small), size=500)].T], axis=1)
    pixels, dist = np.stack([u, v], -1)[:, None].astype(float), np.array(intrinsics.coeffs)
    xy = cv2.undistortPointsIter(pixels, intrinsics.K, dist, None, None, (3, 500, 1e-15))[:, 0]
    rays = np.column_stack([xy, np.ones(len(xy))])
    depth, index = moeller_trumbore(rays, scene, T_scene_camera)
    assert np.array_equal(index, result.object_index[v, u])
    assert set(index) >= {WALL, TABLE, BLOCK, CUBE}
    np.testing.assert_allclose(result.depth_m[v, u], depth, atol=1e-9, rtol=0)


@pytest.mark.parametrize("distance", [0.30, 0.45, 0.60, 1.0, 2.0])
def test_front_face_has_the_asked_depth_and_size(distance):
    scene = tabletop(distance)
    assert [box.name for box in scene] == NAMES
    result = render(scene, UNIT.depth)
    face = result.object_index == BLOCK
    assert np.abs(result.depth_m[face] - distance).max() < 1e-12
    half = UNIT.depth.fx * 0.030 / distance
    covered = np.zeros_like(face)
    first_u, first_v = (int(np.ceil(c - half)) for c in (UNIT.depth.cx, UNIT.depth.cy))
    last_u, last_v = (int(np.floor(c + half)) for c in (UNIT.depth.cx, UNIT.depth.cy))
    covered[first_v : last_v + 1, first_u : last_u + 1] = True
    np.testing.assert_array_equal(face, covered)


def test_both_cameras_see_the_whole_of_both_objects():
    for distance in (0.30, 0.45, 0.60):
        scene = tabletop(distance)
        for box in scene[BLOCK:]:
            corners = geometry.transform_points(box.T_scene_box, SIGNS * box.size_m / 2)
            for intrinsics, T in ((UNIT.depth, np.eye(4)), (UNIT.color, UNIT.T_color_depth)):
                pixels = project(geometry.transform_points(T, corners), intrinsics.K)
                assert (pixels > 20).all()
                assert (pixels < np.array(intrinsics.size) - 20).all()


def test_nothing_hit_is_depth_0_and_index_minus_1():
    one = (Box("far left", (0.1, 0.1, 0.1), pose((0, 0, 0), (-0.3, 0, 1.0)), (1, 0, 0)),)
    result = render(one, UNIT.depth)
    hit = result.object_index == 0
    assert 0 < hit.sum() < 10_000
    assert (result.object_index[~hit] == -1).all()
    assert (result.depth_m[~hit] == 0).all()
    assert (result.depth_m[hit] >= 0.95 - 1e-12).all()
    behind = render(one, UNIT.depth, pose((180, 0, 0), (0, 0, 0)))
    empty = render((), UNIT.depth)
    for result in (behind, empty):
        assert not result.depth_m.any()
        assert (result.object_index == -1).all()
        assert (result.color == result.color[0, 0]).all()


def test_a_pixel_past_the_fold_of_the_distortion_hits_nothing():
    folds = Intrinsics(320, 240, 120, 120, 160, 120, "brown_conrady", (-0.35, 0, 0, 0, 0))
    index = render(tabletop(), folds).object_index
    assert index[120, 160] == BLOCK
    assert index[0, 0] == -1


def test_colours_tell_the_objects_apart():
    result = render(tabletop(), UNIT.color, invert_transform(UNIT.T_color_depth))
    each_object = [result.color[result.object_index == i] for i in range(4)]
    wall, table, block, cube = (np.median(colors, axis=0) for colors in each_object)
    assert np.ptp(block) < 20  # grey
    assert cube[0] > cube[1] > cube[2] + 80  # orange
    assert table[0] > table[2] + 30  # brown
    assert wall.min() > block.max()  # the block stands out against the wall
    face = result.color[result.object_index == BLOCK].astype(int)
    assert face.min() > 60  # the lamp shines on the face
    assert face.max() < 255


def test_lambert_shading_of_a_wall_in_plain_light():
    """Brightness is ambient + diffuse * cosine, for a lamp at (-0.25, -0.40, -0.10) m."""
    wall = (Box("wall", (4, 4, 0.1), pose((0, 0, 0), (0, 0, 1.05)), (1.0, 0.5, 0.25)),)
    color = render(wall, UNIT.color).color
    for u, v in ((10, 20), (320, 240), (630, 470)):
        point = np.linalg.solve(UNIT.color.K, [u, v, 1])
        to_lamp = np.array([-0.25, -0.40, -0.10]) - point
        brightness = 0.42 - 0.58 * to_lamp[2] / np.linalg.norm(to_lamp)
        assert np.abs(color[v, u] - 255 * brightness * np.array([1.0, 0.5, 0.25])).max() < 0.6


@pytest.mark.parametrize("which", ["depth", "distorted"])
def test_the_colour_image_is_where_the_geometry_says(which):
    """The centre of a small plate, weighted by its colour, is where its centre projects."""
    intrinsics, _ = CAMERAS[which]
    for centre in ((0.0, 0.0, 1.0), (-0.31, 0.17, 1.0), (0.35, -0.2, 1.0)):
        plate = Box("plate", (0.06, 0.06, 1e-4), pose((0, 0, 0), centre), (1, 1, 1))
        light = render((plate,), intrinsics).color[..., 0].astype(float)
        light -= light.min()
        v, u = np.indices(light.shape)
        found = np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
        assert np.abs(found - project(centre, intrinsics.K, intrinsics.dist)).max() < 0.2


def test_the_wall_has_a_line_every_100_mm():
    rows = []
    for texture in ("grid", "plain"):
        wall = Box("wall", (4, 4, 0.1), pose((0, 0, 0), (0, 0, 1.05)), (1, 1, 1), texture)
        rows.append(render((wall,), UNIT.color).color[210, :, 0].astype(float))
    step = UNIT.color.fx * 0.100
    lines = UNIT.color.cx + step * np.arange(-5, 6)
    lines = lines[(lines > 2) & (lines < 636)]
    dark = np.flatnonzero(rows[0] < 0.95 * rows[1])
    assert len(lines) == 11
    assert np.abs(dark[:, None] - lines).min(axis=0).max() <= 1
    assert np.abs(dark[:, None] - lines).min(axis=1).max() <= 2


def test_a_ray_along_a_face_hits_where_it_should():
    unit = np.array([[0, 0, 2, 0.5, 0.5, 0.5, 1, 0, 0, 0, 1, 0, 0, 0, 1]], float)
    assert raycast.nearest_hit(unit, 0.4, -0.2, 0.0, 0.0, 0.0, 1.0) == (1.5, 0, 4, 0.4, -0.2)
    assert raycast.nearest_hit(unit, 0.6, 0.0, 0.0, 0.0, 0.0, 1.0)[1] == -1


def test_the_block_throws_its_shadow_away_from_the_lamp():
    """The lamp is up and to the left: the table is dark behind the block's right edge."""
    result = render(tabletop(0.45), UNIT.color)

    def brightness(x_m: float) -> float:
        u, v = np.rint(project((x_m, 0.030, 0.47), UNIT.color.K)).astype(int)
        assert result.object_index[v, u] == TABLE
        return result.color[v, u].astype(float).mean()

    assert brightness(0.036) < 0.8 * brightness(-0.036)


def box(**changes):
    given = {"name": "b", "size_m": (1, 1, 1), "T_scene_box": np.eye(4), "color": (1, 1, 1)}
    return Box(**given | changes)


def picture(**changes):
    given = {"scene": tabletop(), "intrinsics": UNIT.depth, "T_scene_camera": np.eye(4)}
    return render(**given | changes)


STACKED, IN_THE_BLOCK = np.stack([np.eye(4)] * 2), pose((0, 0, 0), (0, 0, 0.48))
NO_POSES = (np.eye(3), 2 * np.eye(4), STACKED, IN_THE_BLOCK)

test_bad_input_is_named = refusals(
    *named(tabletop, distance_m=[0, -1, float("nan"), "0.45", True]),
    *named(
        picture,
        scene=[tabletop()[0], ("wall",)],
        intrinsics=[UNIT.depth.K],
        T_scene_camera=NO_POSES,
    ),
    *named(box, size_m=[(1, 0, 1), (1, 1), (1, 1, np.inf)], color=[(255, 0, 0), "red"]),
    *named(box, T_scene_box=[np.diag([1, 1, -1, 1])], texture=["marble"]),
)
