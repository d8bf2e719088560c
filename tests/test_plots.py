"""Figures by their data, labels and words, not by their pixels."""

from __future__ import annotations

import base64
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from coursekit import geometry, plots, specifications
from coursekit.geometry import Intrinsics
from coursekit.plots import pinhole
from coursekit.plots.interactive import label
from coursekit.simulation import tabletop

D435 = specifications.device("D435").unit
LENSES = {n: specifications.lens(n).intrinsics for n in ("opencv_left", "d405_color")}


def all_figures() -> dict[str, plots.LessonFigure]:
    depth = np.full((480, 848), 0.5, np.float32)
    depth[:5] = 0
    color = np.zeros((480, 640, 3), np.uint8)
    points = geometry.deproject_image(depth, D435.depth)
    return {
        "similar_triangles": pinhole.similar_triangles(),
        "pixel_grid": pinhole.pixel_grid(),
        "entries_of_K": pinhole.entries_of_K(tabletop(0.2), D435.depth, fx=500.0),
        "field_of_view": pinhole.field_of_view(D435.depth, D435.color, 0.45),
        "same_pixel": pinhole.same_pixel(0.1875, 0.025, 0.45, D435.depth.K),
        "displacement": pinhole.displacement(LENSES),
        "frame": pinhole.frame(SimpleNamespace(depth_m=depth, color=color)),
        "frame without colour": pinhole.frame(SimpleNamespace(depth_m=depth, color=None)),
        "point_cloud": pinhole.point_cloud(points),
    }


FIGURES = all_figures()


@pytest.mark.parametrize("name", FIGURES)
def test_every_axis_has_a_label_and_every_figure_words(name: str) -> None:
    fig = FIGURES[name]
    assert len(fig.alt) > 40
    bundle, metadata = fig._repr_mimebundle_()
    assert base64.b64decode(bundle["image/png"]).startswith(b"\x89PNG")
    assert metadata["image/png"]["alt"] == bundle["text/plain"] == fig.alt
    for ax in fig.axes:
        if ax.get_visible() and ax.get_label() != "<colorbar>":
            assert "(" in ax.get_xlabel(), f"{name}: no unit in the x label {ax.get_xlabel()!r}"
            assert ax.get_ylabel() or not ax.get_yticks().size


def test_similar_triangles_shows_f_x_over_z() -> None:
    fig = pinhole.similar_triangles(focal_length_mm=4.0, depth_m=0.8)
    sensor = fig.axes[1]
    (dot,) = [line for line in sensor.lines if line.get_marker() == "o"]
    assert dot.get_xdata()[0] == pytest.approx(4.0 * 0.10 / 0.8)
    assert "0.500 mm" in sensor.get_title()


def test_displacement_is_opencvs() -> None:
    import cv2

    lens = LENSES["opencv_left"]
    _, size = pinhole.displacement_px(lens)
    ray = np.linalg.solve(lens.K, [0, 0, 1])
    bent = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), lens.K, lens.dist)[0].ravel()
    assert size[0, 0] == pytest.approx(np.hypot(*bent), abs=1e-9)
    edge, corner = pinhole.edge_and_corner(size)
    assert (round(edge, 1), round(corner, 1)) == (33.7, 51.6)
    assert "33.7 px at an edge, 51.6 px in a corner" in FIGURES["displacement"].alt


def test_brown_conrady_is_worth_what_the_lesson_says() -> None:
    """Claim P7: single pixels to ten at the edges of narrow lenses, tens on wide ones."""
    edges = {
        name: pinhole.edge_and_corner(
            pinhole.displacement_px(specifications.lens(name).intrinsics)[1]
        )[0]
        for name in ("moveit_camera", "d405_color", "opencv_left", "duckiebot_wide")
    }
    assert edges["moveit_camera"] < edges["d405_color"] < 15
    assert edges["opencv_left"] > 20
    assert edges["duckiebot_wide"] > 50


def test_entries_of_K_moves_the_wire_frame_as_the_equation_says() -> None:
    fig = pinhole.entries_of_K(tabletop(0.2), D435.depth, cx=D435.depth.cx + 20)
    lines = [line for line in fig.axes[0].lines if len(line.get_xdata()) == 2]
    own, moved = lines[: len(lines) // 2], lines[len(lines) // 2 :]
    assert len(own) == 24  # twelve edges of the block, twelve of the cube
    shift = np.ravel([m.get_xdata() - o.get_xdata() for o, m in zip(own, moved, strict=True)])
    assert shift == pytest.approx(20.0)


def test_field_of_view_in_millimetres() -> None:
    width = 1000 * 0.45 * 848 / D435.depth.fx
    assert f"{width:.0f} mm wide" in FIGURES["field_of_view"].alt


def test_point_cloud_leaves_invalid_points_out() -> None:
    assert f"{475 * 848} points" in FIGURES["point_cloud"].alt


def test_drag_draws_its_start_and_follows_a_slider() -> None:
    drag = plots.drag(pinhole.similar_triangles, focal_length_mm=(1, 6, 2), depth_m=(0.2, 2, 1))
    panel = drag.widget()
    focal, depth, image = panel.children
    assert (focal.description, depth.description) == ("focal length (mm)", "depth (m)")
    before = image.value
    depth.value = 2.0
    assert image.value != before
    bundle, _ = drag._repr_mimebundle_()
    assert bundle["text/plain"] == pinhole.similar_triangles(2, 1).alt


def test_a_slider_starts_where_it_says_and_has_round_steps() -> None:
    drag = plots.drag(
        pinhole.similar_triangles, focal_length_mm=(1, 4, 1.93), depth_m=(0.35, 1.2, 0.45)
    )
    focal, depth, _ = drag.widget().children
    assert (focal.value, depth.value) == (1.93, 0.45)
    assert (focal.step, depth.step) == (0.01, 0.01)
    depth.value = 0.5
    assert depth.value == 0.5


@pytest.mark.parametrize("slider", [(1, 2), (2, 1, 1.5), (1, 2, 3), (1, 1, 1)])
def test_bad_sliders(slider: tuple) -> None:
    with pytest.raises(ValueError, match=r"^depth_m: "):
        plots.drag(pinhole.similar_triangles, depth_m=slider)


@pytest.mark.parametrize(
    ("name", "text"), [("focal_length_mm", "focal length (mm)"), ("cx_px", "cx (px)"), ("n", "n")]
)
def test_labels(name: str, text: str) -> None:
    assert label(name) == text


def test_colours_can_be_told_apart_without_hue() -> None:
    """Model and measured are drawn over each other most often: their lightness differs."""

    def lightness(name: str) -> float:
        return float(np.dot([0.2126, 0.7152, 0.0722], to_rgb(plots.COLORS[name])))

    assert abs(lightness("model") - lightness("measured")) > 0.05


def test_unknown_entry_of_K() -> None:
    with pytest.raises(ValueError, match="skew"):
        pinhole.entries_of_K(tabletop(0.2), Intrinsics(2, 2, 1, 1, 0, 0), skew=1.0)
