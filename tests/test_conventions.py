"""geometry against librealsense, point by point and frame by frame."""

from pathlib import Path

import numpy as np
import pytest
from common import NIGHTLY
from hypothesis import given, settings
from hypothesis import strategies as st

from coursekit import geometry, kernels
from coursekit.cameras import conventions, open_camera
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense
from coursekit.cameras.recording import realsense_intrinsics
from coursekit.geometry import Intrinsics

pytest.importorskip("pyrealsense2", reason="no pyrealsense2 for this platform")

CAMERAS = 1000 if NIGHTLY else 200

RANGES = ((350, 900), (0.9, 1.1), (290, 350), (210, 270))  # f, aspect, cx, cy
COEFFS = (0.3, 0.1, 0.003, 0.003, 0.05)  # k1, k2, p1, p2, k3, of either sign
cameras = st.builds(
    lambda f, aspect, cx, cy, coeffs: Intrinsics(
        640, 480, f, f * aspect, cx, cy, "brown_conrady", coeffs
    ),
    *(st.floats(*limits) for limits in RANGES),
    st.tuples(*(st.floats(-most, most) for most in COEFFS)),
)


@pytest.mark.parametrize("model", ["brown_conrady", "none"])
@settings(max_examples=CAMERAS, deadline=None, derandomize=True)
@given(camera=cameras, seed=st.integers(0, 10**6))
def test_same_pixels_and_points_as_librealsense(model: str, camera: Intrinsics, seed: int) -> None:
    """Many cameras with 20 points each: below 2e-3 px, and back below 10 µm a metre."""
    camera = Intrinsics(**camera.to_dict() | {"model": model})
    rs = load_librealsense()
    theirs = realsense_intrinsics(rs, camera)
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.2, 4.0, 20)
    points = np.column_stack([rng.uniform(-0.45, 0.45, (20, 2)) * z[:, None], z])
    pixels = geometry.project(points, camera.K, camera.dist)
    vendor = np.array([rs.rs2_project_point_to_pixel(theirs, p) for p in points.tolist()])
    assert np.abs(vendor - pixels).max() < 2e-3
    if (
        model == "none" or abs(camera.coeffs[0]) < 0.1
    ):  # its inverse is ten rounds of fixed-point iteration
        seen = zip(pixels.tolist(), z.tolist(), strict=True)
        back = np.array([rs.rs2_deproject_pixel_to_point(theirs, uv, d) for uv, d in seen])
        assert (np.abs(back - points) / z[:, None]).max() < 1e-5


def test_the_stored_table_is_what_is_measured() -> None:
    measured, stored = conventions.measure(), conventions.stored()
    for row, was in zip(measured, stored, strict=True):
        assert (row.model, row.coefficients) == (was.model, was.coefficients)
        assert row.project_px == pytest.approx(was.project_px, abs=1e-3)
        assert row.round_trip_px == pytest.approx(was.round_trip_px, abs=1e-3)


def test_the_vendors_inverse_model_is_the_named_misconception() -> None:
    """Tangential terms after the radial factor: what exercise 1 calls a mistake is their model."""
    from coursekit.lessons.pinhole import PROJECT

    (mistake,) = [m for m in PROJECT.mistakes if m.name == "tangential_after_radial"]
    camera = Intrinsics(640, 480, 612.5, 598.0, 331.4, 236.8, "inverse_brown_conrady",
                        conventions.COEFFS["radial and tangential"])  # fmt: skip
    rs = load_librealsense()
    points = np.random.default_rng(2).uniform([-0.4, -0.3, 1], [0.4, 0.3, 2], (500, 3))
    vendor = [
        rs.rs2_project_point_to_pixel(realsense_intrinsics(rs, camera), p) for p in points.tolist()
    ]
    ours = PROJECT.model(mistake)(points, camera.K, camera.dist)
    assert np.abs(ours - vendor).max() < 2e-3


def test_a_learners_functions_beside_them() -> None:
    rows = conventions.measure(geometry.project, geometry.deproject)
    assert all(row.yours_px == row.project_px for row in rows)
    off_m = {(r.model, r.coefficients): r.yours_m for r in rows}
    assert off_m["brown_conrady", "radial and tangential"] < 1e-4
    assert off_m["modified_brown_conrady", "radial"] == pytest.approx(0.2825, abs=1e-4)
    core = conventions.measure(lambda *_: None, lambda p, z, K, _: geometry.deproject(p, z, K))
    assert {row.yours_px for row in core} == {None}
    assert core[4].model == "modified_brown_conrady"  # theirs leaves the distortion in
    assert core[4].yours_m < 1e-4
    assert core[2].yours_m > 0.1
    assert str(core[4]).endswith("37.326      -  0.000")


def test_the_stored_table_serves_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise LibraryMissing("not here")

    monkeypatch.setattr(conventions, "load_librealsense", missing)
    rows, origin = conventions.table()
    assert rows == conventions.stored()
    assert "stored" in origin


# --- depth aligned to colour ---


def vendor_align(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """librealsense's own `align` of a recording's first frame: (raw depth, aligned), counts."""
    rs = load_librealsense()
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_device_from_file(str(path), repeat_playback=False)
    profile = pipeline.start(config)
    profile.get_device().as_playback().set_real_time(False)
    try:
        frames = pipeline.wait_for_frames()
        raw = np.array(frames.get_depth_frame().get_data())
        aligned = rs.align(rs.stream.color).process(frames)
        return raw, np.array(aligned.get_depth_frame().get_data())
    finally:
        pipeline.stop()


def check_against_the_vendor(path: Path, patch: pytest.MonkeyPatch) -> None:
    """The same colour pixels are filled, and with the same depth pixel's number."""
    raw, theirs = vendor_align(path)
    sources: list[np.ndarray] = []
    footprint = kernels.nearest_footprint
    patch.setattr(
        kernels, "nearest_footprint", lambda *a: sources.append(footprint(*a)) or sources[0]
    )
    with open_camera(path) as camera:
        lenses = camera.depth, camera.color
        geometry.align_depth_to_color(raw * camera.depth_scale_m, *lenses, camera.T_color_depth)
    (source,) = sources
    ours = np.where(source >= 0, raw.ravel()[source], 0)
    both = (ours > 0) & (theirs > 0)
    assert ((ours > 0) == (theirs > 0)).mean() > 0.9999
    assert (ours == theirs)[both].mean() > 0.998  # 0.9989 to 0.9993 by which frame comes first


def test_align_is_librealsenses_on_a_simulated_recording(tabletop, monkeypatch) -> None:
    check_against_the_vendor(tabletop, monkeypatch)


@pytest.mark.real
def test_align_is_librealsenses_on_a_real_d435(real_data, monkeypatch) -> None:
    bag = real_data / "realsense_d435" / "single_depth_color_640x480.bag"
    check_against_the_vendor(bag, monkeypatch)
