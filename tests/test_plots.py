"""Figures by their data, labels and words, not by their pixels."""

import base64
import html
from types import SimpleNamespace

import numpy as np
import pytest
from common import CHARUCO, by_opencv
from matplotlib.colors import to_rgb
from matplotlib.patches import Ellipse
from PIL import Image
from test_lesson_intrinsics import X, Y, predict

from coursekit import boards, budget, geometry, plots, specifications
from coursekit.attribution import simulate_misses
from coursekit.cameras import Frame
from coursekit.geometry import Intrinsics
from coursekit.hand_eye import error_study
from coursekit.intrinsics import calibrate, compare, stored_power
from coursekit.plots import depth_noise, error_budget, hand_eye, intrinsics, pinhole
from coursekit.plots.style import label
from coursekit.simulation import Effects, corner_session, default_setup, tabletop, unknown_sessions

D435 = specifications.device("D435").unit
LENSES = {n: specifications.lens(n).intrinsics for n in ("opencv_left", "d405_color")}


def pinhole_figures() -> dict[str, plots.LessonFigure]:
    depth = np.full((480, 848), 0.5, np.float32)
    depth[:5] = 0
    color = np.zeros((480, 640, 3), np.uint8)
    points = geometry.deproject_image(depth, D435.depth)
    return {
        "similar_triangles": pinhole.similar_triangles(),
        "pixel_grid": pinhole.pixel_grid(),
        "entries_of_K": pinhole.entries_of_K(tabletop(0.2), D435.depth, fx=500.0),
        "displacement": pinhole.displacement(LENSES),
        "frame": pinhole.frame(SimpleNamespace(depth_m=depth, color=color)),
        "frame without colour": pinhole.frame(SimpleNamespace(depth_m=depth, color=None)),
        "point_cloud": pinhole.point_cloud(points),
    }


@pytest.fixture(scope="module")
def figures() -> dict[str, plots.LessonFigure]:
    """Every figure of the notebooks, by its function's name."""
    first = pinhole_figures() | depth_noise_figures() | intrinsics_figures()
    return first | hand_eye_figures() | error_budget_figures()


def test_every_axis_has_a_label_and_every_figure_words(figures) -> None:
    for name, fig in figures.items():
        assert len(fig.alt) > 40, name
        for ax in fig.axes:
            if ax.get_visible() and ax.get_label() != "<colorbar>":
                assert "(" in ax.get_xlabel(), f"{name}: no unit in {ax.get_xlabel()!r}"
                shared = ax.get_shared_y_axes().get_siblings(ax)
                assert any(a.get_ylabel() for a in shared) or not ax.get_yticks().size, name


@pytest.mark.parametrize("name", ["pixel_grid", "displacement", "noise_law", "coverage", "bars"])
def test_a_notebook_gets_a_picture_and_its_words(name: str, figures) -> None:
    """Some of them here; the notebooks' own tests draw every one."""
    bundle, metadata = figures[name]._repr_mimebundle_()
    assert base64.b64decode(bundle["image/png"]).startswith(b"\x89PNG")
    assert metadata["image/png"]["alt"] == bundle["text/plain"] == figures[name].alt


def test_there_is_a_figure_of_every_function(figures) -> None:
    """That a module of `plots` calls public and that returns a figure."""
    drawing = {
        name
        for module in (pinhole, depth_noise, intrinsics, hand_eye, error_budget)
        for name, function in vars(module).items()
        if getattr(function, "__module__", "") == module.__name__ and name[0] != "_"
        if function.__annotations__["return"] == "LessonFigure"
    }
    assert drawing == {name.partition(" ")[0] for name in figures}
    assert len(drawing) == 33


def test_similar_triangles_shows_f_x_over_z() -> None:
    fig = pinhole.similar_triangles(focal_length_mm=4.0, depth_m=0.8)
    sensor = fig.axes[1]
    (dot,) = [line for line in sensor.lines if line.get_marker() == "o"]
    assert dot.get_xdata()[0] == pytest.approx(4.0 * 0.10 / 0.8)
    assert "0.500 mm" in sensor.get_title()


def test_displacement_is_opencvs(figures) -> None:
    lens = LENSES["opencv_left"]
    _, size = pinhole.displacement_px(lens)
    ray = np.linalg.solve(lens.K, [0, 0, 1])
    bent = by_opencv(ray[None], np.eye(4), lens).ravel()
    assert size[0, 0] == pytest.approx(np.hypot(*bent), abs=1e-9)
    edge, corner = pinhole.edge_and_corner(size)
    assert (round(edge, 1), round(corner, 1)) == (33.7, 51.6)
    assert "33.7 px at an edge, 51.6 px in a corner" in figures["displacement"].alt


def test_entries_of_K_moves_the_wire_frame_as_the_equation_says() -> None:
    fig = pinhole.entries_of_K(tabletop(0.2), D435.depth, cx=D435.depth.cx + 20)
    lines = [line for line in fig.axes[0].lines if len(line.get_xdata()) == 2]
    own, moved = lines[: len(lines) // 2], lines[len(lines) // 2 :]
    assert len(own) == 24  # twelve edges of the block, twelve of the cube
    shift = np.ravel([m.get_xdata() - o.get_xdata() for o, m in zip(own, moved, strict=True)])
    assert shift == pytest.approx(20.0)


def test_point_cloud_leaves_invalid_points_out(figures) -> None:
    assert f"{475 * 848} points" in figures["point_cloud"].alt


def test_point_cloud_shows_what_is_near_from_the_side_if_there_is_anything() -> None:
    near = np.full((480, 848), 0.9, np.float32)
    near[200:280, 300:500] = 0.45
    cases = ((near, (0.45, 0.45), True), (np.full_like(near, 0.9), (0.9, 0.9), False))
    for depth, shown, says in cases:
        solid, above, _ = pinhole.point_cloud(geometry.deproject_image(depth, D435.depth)).axes
        (dots,) = solid.collections
        if says:  # one colour, one depth
            assert dots.get_clim() == above.collections[0].get_clim() == pytest.approx((0.45, 0.9))
        z = np.asarray(dots._offsets3d[1])
        assert (z.min(), z.max()) == pytest.approx(shown)
        assert ("Z < 0.6 m" in solid.get_title()) == says
        assert above.get_ylim()[1] > 0.9


def test_the_spot_has_room_on_the_sensor() -> None:
    """At every place of the notebook's sliders."""
    for focal_length, depth in ((1.0, 1.2), (4.0, 0.35)):
        sensor = pinhole.similar_triangles(focal_length, depth).axes[1]
        (spot,) = [line.get_xdata()[0] for line in sensor.lines if line.get_marker() == "o"]
        assert sensor.get_xlim()[0] < spot < sensor.get_xlim()[1] < 1.5


def test_drag_draws_its_start_and_follows_a_slider(monkeypatch) -> None:
    drag = plots.drag(
        pinhole.similar_triangles, focal_length_mm=(1, 4, 1.93), depth_m=(0.35, 1.2, 0.45)
    )
    focal, depth, image, _ = drag.widget().children
    assert (focal.description, depth.description) == ("focal length (mm)", "depth (m)")
    assert (focal.value, depth.value) == (1.93, 0.45)
    assert (focal.step, depth.step) == (0.01, 0.01)
    before = image.value
    depth.value = 0.5
    assert depth.value == 0.5
    assert image.value != before
    shown: list = []
    monkeypatch.setattr("IPython.display.display", lambda data, **_: shown.append(data))
    drag._ipython_display_()
    figure, words = shown
    assert figure["text/plain"] == pinhole.similar_triangles(1.93, 0.45).alt
    assert html.escape(figure["text/plain"]) in words["text/html"]
    assert html.escape(figure["text/plain"]) in before


@pytest.mark.parametrize("slider", [(1, 2), (2, 1, 1.5), (1, 2, 3), (1, 1, 1)])
def test_bad_sliders(slider: tuple) -> None:
    with pytest.raises(ValueError, match=r"^depth_m: "):
        plots.drag(pinhole.similar_triangles, depth_m=slider)


def test_labels() -> None:
    said = ["focal length (mm)", "cx (px)", "n"]
    assert [label(name) for name in ("focal_length_mm", "cx_px", "n")] == said


def test_colours_can_be_told_apart_without_hue() -> None:
    """Model and measured are drawn over each other most often: their lightness differs."""

    def lightness(name: str) -> float:
        return float(np.dot([0.2126, 0.7152, 0.0722], to_rgb(plots.COLORS[name])))

    assert abs(lightness("model") - lightness("measured")) > 0.05


def test_a_frame_without_any_depth_is_no_picture() -> None:
    lens = Intrinsics(8, 6, 5.0, 5.0, 3.5, 2.5)
    covered = Frame(np.zeros((6, 8), np.uint16), None, 0.001, 0.0, 1, lens)
    for drawn, of in ((pinhole.frame, covered), (pinhole.point_cloud, covered.points())):
        with pytest.raises(ValueError, match="no pixel has a depth"):
            drawn(of)


def test_unknown_entry_of_K() -> None:
    with pytest.raises(ValueError, match="skew"):
        pinhole.entries_of_K(tabletop(0.2), Intrinsics(2, 2, 1, 1, 0, 0), skew=1.0)


# --- notebook 02 ---


def depth_noise_figures() -> dict[str, plots.LessonFigure]:
    z = np.geomspace(0.3, 2.0, 20)
    law = 1000 * z**2 * 0.08 / 21.6
    image = np.random.default_rng(0).integers(0, 255, (480, 848))
    costs = np.abs(np.arange(127) - 48.3) * 10.0 + 50
    return {
        "technologies": depth_noise.technologies(447.0, 0.050, 0.08),
        "reciprocal": depth_noise.reciprocal(21.6, 0.8, 0.08),
        "prices": depth_noise.prices({"D405": (425.0, 0.018), "D435": (431.0, 0.050)}, 0.08),
        "infrared_pair": depth_noise.infrared_pair(image, image, (424, 240), 48.3, 5),
        "cost_curve": depth_noise.cost_curve(costs, 48.3),
        "depth_image": depth_noise.depth_image(
            np.ones((480, 848)), {"card": (300.0, 200.0)}, np.eye(480, 848) > 0),
        "noise_law": depth_noise.noise_law([0.3, 1.0], [0.3, 3.7], [0.01, 0.1],
                                           (z, law, 0.9 * law, 1.1 * law), {"other": (z, law)}),
        "two_eyes": depth_noise.two_eyes(431.0, 0.05, 0.5),
        "averaging": depth_noise.averaging([1, 2, 4], [1.0, 0.8, 0.7], 0.65),
    }  # fmt: skip


def test_reciprocal_is_the_derivative() -> None:
    z, fb, sigma = 0.8, 21.6, 0.08
    slope = (fb / (fb / z - 1e-6) - fb / (fb / z + 1e-6)) / 2e-6
    assert f"{1000 * slope * sigma:.2f} mm" in depth_noise.reciprocal(fb, z, sigma).alt


# --- notebook 03 ---

SESSION = specifications.DATA / "intrinsics_session"


def intrinsics_figures() -> dict[str, plots.LessonFigure]:
    found, _ = corner_session(CHARUCO, D435.color, seed=1, views=10)
    flat, _ = corner_session(CHARUCO, D435.color, seed=1, views=10, effects=Effects(max_tilt_deg=8))
    two = {"P": calibrate(flat, CHARUCO), "Q": calibrate(found, CHARUCO)}
    seen = predict(600, 0.5, np.radians(30)) + np.random.default_rng(0).normal(0, 0.1, 2 * X.size)
    shipped = [SESSION / f"view_0{n}.jpg" for n in (0, 1)]
    return {
        "best_fits": intrinsics.best_fits(X, Y, {"30 deg": seen}, 600.0),
        "views": intrinsics.views(str(SESSION), boards.detect_all(shipped, CHARUCO, False)),
        "coverage": intrinsics.coverage(two["Q"]),
        "residuals": intrinsics.residuals(two["Q"]),
        "uncertainty": intrinsics.uncertainty(two, 0.45),
        "two_sessions": intrinsics.two_sessions(two),
        "rules": intrinsics.rules(two, 0.45),
        "rooms": intrinsics.rooms(two),
        "power": intrinsics.power(stored_power()),
        "difference": intrinsics.difference(compare(two["Q"], D435.color)),
    }


def test_a_photograph_that_says_it_is_turned_is_shown_as_its_corners_were_found(tmp_path) -> None:
    said = Image.Exif()
    said[0x0112] = 6  # a quarter turn
    Image.open(SESSION / "view_00.jpg").save(tmp_path / "a.jpg", exif=said, quality=95)
    shown = intrinsics.views(tmp_path, boards.detect_all(tmp_path, CHARUCO, False)).axes[0]
    assert shown.images[0].get_array().shape == (480, 640)


def test_outlines_are_opencvs() -> None:
    found, _ = corner_session(CHARUCO, D435.color, seed=1, views=10)
    result = calibrate(found, CHARUCO)
    T, lens = result.T_camera_board[3], result.intrinsics
    rim = CHARUCO.points[[0, 7, 39, 32]]
    seen = by_opencv(rim, T, lens)
    assert intrinsics.outlines(result)[3] == pytest.approx(seen, abs=1e-6)


def test_maps_of_two_sessions_share_their_scale(figures) -> None:
    axes = figures["uncertainty"].axes
    limits = [ax.collections[0].get_clim() for ax in axes[:2]]
    assert limits[0] == limits[1]


# --- notebook 04 ---


def hand_eye_figures() -> dict[str, plots.LessonFigure]:
    mounts = ("eye_in_hand", "eye_to_hand")
    rigs = {mount.replace("_", "-"): default_setup(mount) for mount in mounts}
    joints = dict.fromkeys(rigs, (0.0, 0.7, 1.3, 0.7, 0.0, 0.0))
    counts = (12, 25)
    return {
        "mounts": hand_eye.mounts(rigs, joints),
        "study": hand_eye.study(error_study(trials=5)),
        "more_poses": hand_eye.more_poses(counts, {"a": [3.0, 2.9]}, {"a": [1.0, 0.7]}),
        "agreement": hand_eye.agreement(unknown_sessions(11)),
        "touched": hand_eye.touched([[1.0, -1.0, 0.5], [2.0, 0.0, 0.1]]),
    }


def test_the_rig_is_drawn_where_forward_kinematics_puts_it(figures) -> None:
    q = np.array([0.0, 0.7, 1.3, 0.7, 0.0, 0.0])
    rig = default_setup("eye_in_hand")
    chain = figures["mounts"].axes[0].lines[0]
    end = [places[-1] for places in chain.get_data_3d()]
    assert end == pytest.approx(list(rig.arm.forward(q)[:3, 3]))


def test_the_letters_of_the_arrows_lie_on_nothing() -> None:
    """From wherever one looks: no letter is nearer to a line, an arrow or a letter than it says."""
    rigs = {mount: default_setup(mount) for mount in ("eye_in_hand", "eye_to_hand")}
    joints = dict(
        zip(rigs, [(0, 1.1, 1.6, -1.2, 0, 0), (0, 0.86, 0.31, 0.73, 0, 1.57)], strict=True)
    )
    for view_from_deg in (-150.0, -65.0, -20.0):
        for ax in hand_eye.mounts(rigs, joints, view_from_deg).axes:
            arrows = ("T", "X", "C")
            letters = {t.get_text(): np.array(t.xy) for t in ax.texts if t.get_text() in arrows}
            assert set(letters) == set(arrows)
            away = [
                np.hypot(*(ax.transData.transform(page) - place).T).min()
                for place in letters.values()
                for line in ax.lines
                for x, y, _, w in [
                    ax.get_proj() @ [*line.get_data_3d(), np.ones_like(line.get_data_3d()[0])]
                ]
                for page in [np.column_stack([x / w, y / w])]
            ]
            assert min(away) > hand_eye.CLEAR_PX


# --- notebook 05 ---


def error_budget_figures() -> dict[str, plots.LessonFigure]:
    table = budget.lesson_budget(stated=False)
    rigs = budget.lesson_budget().draw(20_000, seed=1, directions="isotropic")
    missed = {"P": simulate_misses("perception", 8, 1)}
    others = rigs.along_m[:20] * 1000
    return {
        "bars": error_budget.bars(budget.lesson_budget()),
        "between_fingers": error_budget.between_fingers(
            budget.LESSON_GRIPPER, budget.CUBE, table.noise_covariance, (1.0, 2.0, 0.5), others
        ),
        "misses": error_budget.misses(missed),
    }


def test_the_ellipse_holds_ninety_five_of_a_hundred_grasps() -> None:
    """Given as closing, approach, lateral; seen as closing and lateral."""
    covariance = np.array([[4.0, 1.5, 0.5], [1.5, 2.0, -0.6], [0.5, -0.6, 3.0]])
    middle = np.array([1.0, -2.0, 3.0])
    fig = error_budget.between_fingers(
        budget.LESSON_GRIPPER, budget.CUBE, 1e-6 * covariance, middle
    )
    drawn = np.random.default_rng(3).multivariate_normal(middle, covariance, 40_000)
    (place,) = [p for p in fig.axes[0].patches if isinstance(p, Ellipse)]
    inside = place.get_patch_transform().inverted().transform(drawn[:, [0, 2]])
    assert np.mean(np.hypot(*inside.T) < 1) == pytest.approx(0.95, abs=0.005)


def test_bars_of_noise_shrink_with_frames_and_bias_does_not() -> None:
    one, many = budget.lesson_budget(), budget.lesson_budget().at(frames=100)
    before, after = (
        np.array([p.get_width() for p in error_budget.bars(b).axes[0].patches[1::2]])
        for b in (one, many)
    )
    kinds = np.array([row.term.kind for row in one.rows])
    assert (after / before)[kinds == "noise"] == pytest.approx([0.1, 0.1])
    assert (after == before)[kinds == "bias"].all()
