"""What notebook 03 teaches, against OpenCV, ranks of Jacobians and simulated sessions."""

import shutil

import cv2
import numpy as np
import pytest
from common import CHARUCO, CHECKERBOARD
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from simulated_corners import dense_jacobian

import coursekit as ck
from coursekit.geometry import Intrinsics, make_transform, project, transform_points
from coursekit.intrinsics.fit import evaluate
from coursekit.lessons import CHECKPOINTS
from coursekit.lessons import intrinsics as lesson
from coursekit.plots import intrinsics as figures
from coursekit.simulation.corner_sessions import Effects, corner_session
from tools import build_notebooks

LENS = ck.specifications.device("D435").unit.color
PINHOLE = Intrinsics(640, 480, 600.0, 610.0, 322.0, 236.0)


def tilted(x_deg: float, y_deg: float, z_m: float) -> np.ndarray:
    """A pose of the checkerboard, its middle on the optical axis."""
    rotation = Rotation.from_euler("xy", (x_deg, y_deg), degrees=True)
    middle = CHECKERBOARD.points.mean(axis=0)
    return make_transform(rotation, [0, 0, z_m] - rotation.apply(middle))


def jacobian(poses: list[np.ndarray]) -> np.ndarray:
    """d pixels / d (fx, fy, cx, cy, and six a view), without distortion, columns of length 1."""
    seen = [project(transform_points(T, CHECKERBOARD.points), PINHOLE.K) for T in poses]
    views = [ck.boards.Detection(np.arange(54), pixels, PINHOLE.size) for pixels in seen]
    given = (views, CHECKERBOARD, CHECKERBOARD.points, ("fx", "fy", "cx", "cy"), "none")
    J = dense_jacobian(evaluate(PINHOLE, np.stack(poses), *given))
    return J / np.linalg.norm(J, axis=0)


def rank(J: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(J, tol=1e-9 * len(J)))


def test_one_view_has_eight_numbers_to_give_and_two_are_enough() -> None:
    views = [tilted(30, 5, 0.5), tilted(-10, 35, 0.45)]
    assert rank(jacobian(views[:1])) == 8 < 4 + 6
    assert rank(jacobian(views)) == 4 + 12
    assert CHECKPOINTS["intrinsics.two_views"].value == 2


def test_square_on_leaves_f_and_the_distances_free() -> None:
    J = jacobian([tilted(0, 0, z) for z in np.linspace(0.3, 0.8, 12)])
    free = J.shape[1] - rank(J)
    # f with all the Z, and cx, cy each with the boards' tilt and shift
    _, _, directions = np.linalg.svd(J)
    along = directions[-free:]
    reach = np.linalg.norm(along[:, :4], axis=0)  # how much of each of K lies in what is free
    assert free >= 1
    assert reach[0] > 0.1
    assert reach[1] > 0.1


def test_the_exercises_give_opencvs_numbers() -> None:
    found, _ = corner_session(CHECKERBOARD, LENS, seed=3, views=12)
    objects = [CHECKERBOARD.points[d.ids].astype(np.float32) for d in found]
    images = [d.pixels.astype(np.float32) for d in found]
    rms, K, dist, rotations, shifts, sigmas, *_ = cv2.calibrateCameraExtended(
        objects, images, LENS.size, None, None
    )
    predicted = [
        cv2.projectPoints(o, r, t, K, dist)[0][:, 0]
        for o, r, t in zip(objects, rotations, shifts, strict=True)
    ]
    numbers = lesson.REPROJECTION_RMS.model()(np.concatenate(images), np.concatenate(predicted))
    assert numbers[2] == pytest.approx(rms, abs=1e-5)

    result = ck.intrinsics.calibrate(found, CHECKERBOARD)
    whole = dense_jacobian(result)
    scale = np.linalg.norm(whole, axis=0)  # k3 and metres differ by powers of ten
    sigma = lesson.FOCAL_SIGMA.model()(whole / scale, np.concatenate(result.residuals).ravel())
    assert sigma / scale[0] == pytest.approx(float(sigmas[0, 0]), rel=0.01)
    shared = result.equations.shared_covariance  # of corners that err each by itself
    ours = result.sigma_px * np.sqrt(shared[0, 0])
    assert sigma / scale[0] == pytest.approx(ours, rel=1e-6)
    assert result.sigma("fx") == pytest.approx(ours, rel=0.2)  # with whole views left out, too


X, Y = (a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.1, 9), np.linspace(-0.06, 0.06, 6)))


def predict(f: float, Z: float, tilt: float) -> np.ndarray:
    """The notebook's board of three unknowns."""
    depth = Z + X * np.sin(tilt)
    return np.concatenate([f * X * np.cos(tilt) / depth, f * Y / depth])


def test_three_facts_give_f_and_its_sigma_goes_as_one_over_the_tilt_squared() -> None:
    for tilt_deg, ratio in ((10, 1.07), (40, 1.30)):  # at the same Z
        near, *_, far = predict(600, 0.5, np.radians(tilt_deg))[-9:]  # v along the lower edge
        assert near / far == pytest.approx(ratio, abs=0.01)
        assert (near - far) / (near + far) / 0.1 == pytest.approx(
            np.sin(np.radians(tilt_deg)) / 0.5
        )

    def sigma_px(tilt_deg: float, free: int) -> float:
        at, steps = np.array([600, 0.5, np.radians(tilt_deg)]), 1e-6 * np.eye(3)[:free]
        J = np.stack([(predict(*(at + h)) - predict(*(at - h))) / 2e-6 for h in steps], axis=1)
        return float(lesson.FOCAL_SIGMA.model()(J, np.full(108, 0.1)))

    assert sigma_px(2, 3) / sigma_px(4, 3) == pytest.approx(4, rel=0.03)
    assert sigma_px(2, 3) / sigma_px(8, 3) == pytest.approx(16, rel=0.08)
    assert sigma_px(2, 2) / sigma_px(4, 2) == pytest.approx(2, rel=0.01)  # the tilt known
    assert sigma_px(2, 3) == pytest.approx(162 * np.sqrt(108 / 105), abs=1)


def test_the_corners_of_p_accept_both_cameras_and_those_of_q_only_one() -> None:
    lens = ck.specifications.lens("moveit_camera").intrinsics
    of = {
        "P": corner_session(CHARUCO, lens, seed=28, effects=Effects(max_tilt_deg=3))[0],
        "Q": corner_session(CHARUCO, lens, seed=22)[0],
    }
    K = {name: ck.intrinsics.calibrate(views, CHARUCO) for name, views in of.items()}
    rms = {
        (k, c): ck.intrinsics.rms_under(K[k].intrinsics, of[c], CHARUCO.points)
        for k in of
        for c in of
    }
    assert {pair: f"{value:.3f}" for pair, value in rms.items()} == {
        ("P", "P"): "0.108", ("Q", "P"): "0.109", ("Q", "Q"): "0.107", ("P", "Q"): "0.472",
    }  # fmt: skip
    assert rms["P", "P"] == pytest.approx(K["P"].rms_px, rel=1e-3)


def test_halves_tell_bow_and_shutter_from_noise_and_share_the_bias() -> None:
    rooms = {"bow": Effects(bow_m=1e-3), "shutter": Effects(readout_s=0.02, speed_m_s=0.1)}
    rooms |= {"healthy": Effects(), "blur": Effects(blur_px=3), "one": Effects(spoiled_px=3)}
    both = {
        name: ck.intrinsics.halves(corner_session(CHARUCO, LENS, 5, effects=effects)[0], CHARUCO)
        for name, effects in rooms.items()
    }
    assert {name for name, h in both.items() if h.noise_p_value < 1e-6} == {"bow", "shutter"}
    assert all(h.p_value > 0.01 for h in both.values())  # the stated sigmas count the views
    off = [half.value("fx") - LENS.fx for half in (both["bow"].first, both["bow"].second)]
    assert off == pytest.approx([-24, -12], abs=0.6)


def test_the_smallest_rms_is_that_of_scipys_fit() -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 2 * X.size)
    for tilt in (0.0, 5.0, 20.0, 45.0):
        seen = predict(600, 0.5, np.radians(tilt)) + noise
        rms = figures._best_rms(X, Y, seen)
        for k in (0, 60, 120):
            f = figures.F_PX[k]
            cost = min(
                least_squares(lambda p, f=f, s=seen: s - predict(f, *p), [f * 0.5 / 600, a]).cost
                for a in (0.05, 0.4, 0.8)
            )
            assert rms[k] == pytest.approx(np.sqrt(4 * cost / seen.size), rel=1e-3)


@pytest.mark.usefixtures("own_results")
def test_photographs_count_from_their_folder_to_the_file_that_is_kept(tmp_path, capsys) -> None:
    folder = tmp_path / "my_photos"
    folder.mkdir()
    for number in range(6):
        shutil.copy(ck.specifications.DATA / f"intrinsics_session/view_0{number}.jpg", folder)
    notebook = build_notebooks.read(build_notebooks.NOTEBOOKS / "03_intrinsics.ipynb")
    source = {c["id"]: build_notebooks.joined(c["source"]) for c in notebook["cells"]}
    own = source["capture"].replace("my_photos = None", f"my_photos = {str(folder)!r}")
    camera = ck.open_camera("simulated", seed=7)
    names = {"ck": ck, "np": np, "camera": camera, "board": CHARUCO, "my_fx_px": (600, 620)}
    cells = map(source.get, ("views-figure", "fit", "factory-code", "reveal", "save"))
    for cell in (own, *cells):
        exec(str(cell), names)
    said = capsys.readouterr().out
    assert "come without a factory's K" in said
    assert "Nobody knows this lens's truth" in said
    kept = ck.results.load("03_intrinsics")
    assert (kept.source, kept.camera) == ("recorded", f"photographs in {folder}")
