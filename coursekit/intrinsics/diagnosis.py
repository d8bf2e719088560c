"""How small a cause may be before `diagnose` misses it, as measured once and stored.

How large the board really is: its scale against a depth camera's Z or a robot's motion.

A board twice as large at twice the distance gives the same images, so images never show a wrong
square size; whatever else knows metres does.

What is wrong with a calibration session: causes with their evidence and their remedy.

Physical causes are found by F-tests on the residuals (`intrinsics.causes`), poor designs by what
the views look like, and a wrong square size only where something besides the images knows metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.boards import Board, Detection, Detections, Skipped
from coursekit.checks import transforms
from coursekit.geometry import invert_transform
from coursekit.intrinsics import causes
from coursekit.intrinsics.causes import Search
from coursekit.intrinsics.comparison import halves
from coursekit.intrinsics.fit import (
    MIN_CORNERS,
    MIN_VIEWS,
    CalibrationFailed,
    IntrinsicsResult,
    calibrate,
    coverage,
    tilts,
)
from coursekit.results import read_json
from coursekit.specifications import DATA
from coursekit.words import Finding, Findings

STORED = DATA / "diagnosis_power.json"


def stored_power() -> dict[str, dict[str, Any]]:
    """What `tools/make_data.py` measured: by cause its `unit`, `sizes`, `named` and `sessions`."""
    causes: dict[str, dict[str, Any]] = read_json(STORED)["causes"]
    return causes


TURNING_RAD = 0.05  # motions that turn less say nothing about the camera's place on the gripper


@dataclass(frozen=True)
class Scale:
    """How much larger the world is than the board claims: `factor` (1 is right) and its sigma."""

    factor: float
    sigma: float


def depth_scale(result: IntrinsicsResult, depth_m: Sequence[Floats]) -> Scale | None:
    """The median over the views of measured Z over the fit's Z; None with fewer than 3 views."""
    ratios = []
    for T, detection, measured in zip(
        result.T_camera_board, result.detections, depth_m, strict=True
    ):
        predicted = result.points[detection.ids] @ T[2, :3] + T[2, 3]
        valid = np.isfinite(measured) & (np.asarray(measured) > 0)
        if valid.sum() >= MIN_CORNERS:
            ratios.append(np.median(np.asarray(measured)[valid] / predicted[valid]))
    if len(ratios) < MIN_VIEWS:
        return None
    factor = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) - factor)))
    # A median of n values has 1.25 times the error of a mean. All predicted Z scale with fx.
    own = 1.25 * spread / np.sqrt(len(ratios))
    return Scale(factor, float(np.hypot(own, result.sigma("fx") / result.value("fx"))))


def robot_scale(result: IntrinsicsResult, T_base_gripper: Floats) -> Scale | None:
    """The robot's metres over the board's, from the motions between successive views.

    With B X = X A for the gripper's motion B and the camera's motion A, whose translation is
    unknown by a factor s: (R_B - I) t_X - s R_X t_A = -t_B is linear in the mount's translation
    t_X and in s, once R_X has turned the axes of A into those of B. None where too few motions
    turn, since then the two cannot be told apart.
    Source: Park and Martin, "Robot sensor calibration" (1994), with a scale added.
    """
    from scipy.spatial.transform import Rotation

    camera = invert_transform(result.T_camera_board)  # T_board_camera
    A = invert_transform(camera[:-1]) @ camera[1:]
    B = invert_transform(T_base_gripper[:-1]) @ T_base_gripper[1:]
    alpha, beta = (Rotation.from_matrix(M[:, :3, :3]).as_rotvec() for M in (A, B))
    turning = np.linalg.norm(beta, axis=1) > TURNING_RAD
    if np.linalg.matrix_rank(beta[turning], tol=TURNING_RAD) < 2:
        return None
    R_X = Rotation.align_vectors(beta[turning], alpha[turning])[0].as_matrix()
    columns = np.concatenate(
        [B[:, :3, :3] - np.eye(3), -(A[:, :3, 3] @ R_X.T)[..., None]], axis=2
    ).reshape(-1, 4)
    wanted = -B[:, :3, 3].ravel()
    solution, _, rank, _ = np.linalg.lstsq(columns, wanted, rcond=None)
    if rank < 4 or len(wanted) <= 4:
        return None
    off = wanted - columns @ solution
    variance = float(off @ off) / (len(wanted) - 4) * np.linalg.inv(columns.T @ columns)[3, 3]
    return Scale(float(solution[3]), float(np.sqrt(variance)))


def depth_at_corners(
    detections: Sequence[Detection], depth_images_m: Sequence[ArrayLike]
) -> list[Floats]:
    """Z (N_i,) at the corners of each view, m: the median of the valid depths in 3x3 px, or NaN.

    depth_images_m: one (H, W) a view, aligned to the images in which the corners were found, m,
    0 or NaN where invalid. Raises ValueError for another number of images or another size.
    """
    if len(depth_images_m) != len(detections):
        raise ValueError(
            f"depth_images_m: got {len(depth_images_m)} images, want {len(detections)}, one a view"
        )
    depths = []
    for number, (detection, given) in enumerate(zip(detections, depth_images_m, strict=True)):
        image = np.asarray(given, float)
        if image.shape != detection.size[::-1]:
            raise ValueError(
                f"depth_images_m: image {number} has shape {image.shape}, want "
                f"{detection.size[::-1]}, aligned to the images of the corners"
            )
        padded = np.pad(np.where(image > 0, image, np.nan), 1, constant_values=np.nan)
        u, v = np.rint(detection.pixels).astype(int).T
        near = np.stack([padded[v + i, u + j] for i in range(3) for j in range(3)])
        some = np.isfinite(near).any(axis=0)
        z = np.full(len(u), np.nan)
        z[some] = np.nanmedian(near[:, some], axis=0)
        depths.append(z)
    return depths


FEW_VIEWS = 10  # 9 camera parameters, and one odd view must not be able to decide them
FLAT_TILT_DEG = 10.0  # at 10 deg sigma_f is three times, at 5 deg nine times that of 45 deg views
FLAT_SHARE = 0.9  # of the views; one or two tilted ones are no design
# The distortion is a polynomial in the radius: between corners it interpolates, outside it is
# free. Views pushed to the border leave 1 to 10 % of the width or height empty.
BARE_MARGIN, BARE_SIDES, ONE_BARE_MARGIN = 0.125, 2, 0.25
# Real and normal: a glass plate is flat to 0.1 mm, a fixed lens breathes 0.1 % with temperature,
# and a board held "still" moves 5 mm/s for the 20 ms that an image takes.
NORMAL_BOW_M, NORMAL_DRIFT, NORMAL_MOTION_M = 1e-4, 2e-3, 1e-4
NORMAL_LENS_PX = 0.05  # no measurement with the camera notices less
BLUR_LENGTH_PX = 2.0  # shorter motions cost a corner a fifth of its precision and no more
MANY_BLURRED = 2
GRAVE_PX = 1.0  # between the halves: less than that is for the intervals to say
LOST_PX = 12.0  # as much as two halves of ten careful views do not reach at any pixel
LAYOUT_MISFIT = 0.25  # of a square: no lens bends the lattice that much, a wrong layout does more
MOST_COLUMNS = 30  # that are tried
# A print is off by whole per cents (a page "fitted to paper"); depth cameras read 1-2 % wrong at
# 0.5 to 1 m, arms move to better than 1 %.
DEPTH_TOLERANCE, ROBOT_TOLERANCE, SCALE_SIGMAS = 0.025, 0.01, 4.0

LOOKED_FOR = (
    "mixed image sizes", "a wrong number of squares", "too few views", "a solver that stopped",
    "one view or single corners that spoil the fit", "a bowed board", "a drifting focus",
    "a rolling shutter", "a lens that the model does not describe", "motion blur",
    "views without tilt", "no corners near the image's border",
    "halves of the session that disagree",
)  # fmt: skip
SQUARES_UNSEEN = (
    "a wrong square size; images alone cannot show it, because a board twice as large at twice the "
    "distance looks the same. What would reveal it: a depth camera's Z at the corners (depth_m), "
    "a robot's known motion (T_base_gripper), or a ruler on the print."
)
RESIDUALS_UNSEEN = (
    "spoiled views and corners, bow, focus, rolling shutter and lens model; they are judged by "
    "their residuals, and views without tilt may leave the solver at a wrong camera with residuals "
    "of its own. Mend the tilt first."
)
BLUR_UNSEEN = "motion blur; these detections carry no measured blur."


def diagnose(
    detections: Sequence[Detection],
    board: Board,
    model: str = "brown_conrady",
    depth_m: Sequence[ArrayLike] | None = None,
    T_base_gripper: ArrayLike | None = None,
    result: IntrinsicsResult | None = None,
) -> Findings:
    """What is wrong with a session, the gravest first; empty when nothing is.

    depth_m: for each view the Z (N_i,) that a depth camera measured at the corners, m, 0 or NaN
    where it has none (`metric_scale.depth_at_corners` reads them from depth images).
    T_base_gripper (n, 4, 4): where the robot was in each view, the camera on its gripper and the
    board fixed (for a fixed camera and a board in the gripper give the inverses). Either reveals a
    wrong square size.
    result: the fit of exactly these detections, to save a second one.
    A healthy session gets a finding in at most 2 of 100 cases. Raises ValueError as `calibrate`
    for corners that are not usable at all, and for depth or poses that do not fit the views.
    """
    depths = _check_depths(detections, depth_m)
    poses = _check_poses(detections, T_base_gripper)
    found, used = _images(detections, board)
    unseen = [] if depths or poses is not None else [SQUARES_UNSEEN]
    if all(detections[i].blur is None for i in used):
        unseen.append(BLUR_UNSEEN)
    if len(used) < MIN_VIEWS or any(f.name == "wrong_board_size" for f in found):
        return Findings(found, LOOKED_FOR, unseen)
    views = Detections([detections[i] for i in used])
    if result is None or len(used) < len(detections):
        try:
            result = calibrate(views, board, model=model)
        except CalibrationFailed as error:
            found += [f for f in (_failed(str(error)), _no_edge_corners(views)) if f]
            return Findings(found, LOOKED_FOR, unseen)
    flat = _fronto_parallel(result)
    if flat:
        unseen.append(RESIDUALS_UNSEEN)
    else:
        found += _residuals(result, unseen)
    design = [_blur(views), flat, _no_edge_corners(views)]
    found += [finding for finding in design if finding]
    if depths:
        found += _scale_by_depth(result, [depths[i] for i in used])
    if poses is not None:
        found += _scale_by_robot(result, poses[used])
    return Findings(found, LOOKED_FOR, unseen)


# --- before a fit ---


def _images(detections: Sequence[Detection], board: Board) -> tuple[list[Finding], list[int]]:
    """Findings about the images as such, and the views that a fit can use."""
    found = []
    sizes = [d.size for d in detections]
    common = max(set(sizes), key=sizes.count) if sizes else None
    others = [d.name or f"view {i}" for i, d in enumerate(detections) if d.size != common]
    skipped: Sequence[Skipped] = getattr(detections, "skipped", ())
    others += [s.name for s in skipped if "one size" in s.reason]
    if others and common:
        found.append(_mixed_sizes(common, others))
    used = [i for i, d in enumerate(detections) if d.size == common and len(d.ids) >= MIN_CORNERS]
    layout = _layout([detections[i] for i in used], board) or _seen_otherwise(skipped, used, board)
    if layout:
        return [*found, layout], used
    if len(used) < FEW_VIEWS:
        found.append(_few_views(len(used), len(detections) + len(skipped)))
    return found, used


def _mixed_sizes(common: tuple[int, int], others: list[str]) -> Finding:
    return Finding(
        "mixed_sizes",
        "The images do not all have the same size, and one calibration is for one size.",
        f"most are {common[0]}x{common[1]} px; not so {_listed(others)}",
        "Take all views with one resolution setting. A cropped or scaled image has another K.",
    )


def _few_views(used: int, given: int) -> Finding:
    return Finding(
        "few_views",
        "There are too few views to determine K, whatever the reprojection error says.",
        f"{used} usable views (at least {MIN_CORNERS} corners) of {given}; want 20 to 40, "
        f"and fewer than {FEW_VIEWS} cannot even show an odd one",
        "Take more views: tilted 30 to 45 deg about both axes, corners into the image corners.",
    )


def _layout(detections: list[Detection], board: Board) -> Finding | None:
    """Whether the corners lie as the board's do; a homography is blind to pose and K."""
    columns, rows = board.corners
    if not detections:
        return None
    highest = max(int(d.ids.max()) for d in detections)
    misfit = _lattice_misfit(detections, columns)
    if highest < columns * rows and misfit < LAYOUT_MISFIT:
        return None
    tried = {
        c: _lattice_misfit(detections[:5], c) for c in range(2, min(highest, MOST_COLUMNS) + 1)
    }
    best = min(tried, key=lambda c: tried[c], default=columns)
    fits = best != columns and tried.get(best, np.inf) < LAYOUT_MISFIT
    return Finding(
        "wrong_board_size",
        "The corners in the images do not lie as this board's corners would.",
        (
            f"corner {highest} was seen, the board has 0 to {columns * rows - 1}"
            if highest >= columns * rows
            else f"they miss the board's lattice by {misfit:.2f} squares in the median view, with "
            "any pose"
        )
        + (f"; with {best} inner corners in a row they fit" if fits else ""),
        f"The board was given as {board.text}: count the squares, in both directions, on the "
        "print (inner corners are one fewer) and detect again.",
    )


def _seen_otherwise(skipped: Sequence[Skipped], used: list[int], board: Board) -> Finding | None:
    """Whether the detector refused most images because it saw other squares in them."""
    reasons = [s.reason for s in skipped if "squares" in s.reason]
    if len(reasons) <= len(used):
        return None
    return Finding(
        "wrong_board_size",
        "The images show a board with another number of squares than was asked for.",
        f"in {len(reasons)} images the board was refused; the first: {reasons[0]}",
        f"The board was given as {board.text}: count the squares on the print and detect again.",
    )


def _lattice_misfit(detections: list[Detection], columns: int) -> float:
    """Median over the views of the rms to the best homography, in squares."""
    import cv2

    misfits = []
    for detection in detections:
        lattice = np.column_stack(np.divmod(detection.ids, columns))[:, ::-1].astype(float)
        if np.linalg.matrix_rank(lattice - lattice.mean(axis=0)) < 2:
            continue
        H, _ = cv2.findHomography(detection.pixels, lattice, 0)
        if H is None:
            misfits.append(np.inf)
            continue
        back = np.column_stack([detection.pixels, np.ones(len(lattice))]) @ H.T
        with np.errstate(all="ignore"):
            off = back[:, :2] / back[:, 2:] - lattice
        misfits.append(np.sqrt(np.mean((off**2).sum(axis=1))))
    return float(np.median(misfits)) if misfits else np.inf


# --- after a fit ---


def _residuals(result: IntrinsicsResult, unseen: list[str]) -> list[Finding]:
    """What the residuals of a fit speak for; what could not be tested is added to `unseen`."""
    state = causes.search(result)
    tests: list[Callable[[Search], Finding | None]] = [
        _spoiled_views, _bad_corners, _bow, _focus, _shutter, _lens,
    ]  # fmt: skip
    found = [finding for test in tests if (finding := test(state))]
    if not result.converged:
        found.insert(0, _failed("another step of the solver would still move the parameters"))
    try:
        apart = _halves(state, result, explained=bool(found))
    except (CalibrationFailed, np.linalg.LinAlgError) as error:
        unseen.append(
            f"whether two halves agree; one of them gives no camera to compare ({error})."
        )
        return found
    return [*found, apart] if apart else found


def _failed(why: str) -> Finding:
    return Finding(
        "not_converged",
        "The solver did not arrive at a best camera, so its numbers mean nothing.",
        why,
        "Look at the other findings first (tilt, coverage, spoiled views); or start it from the "
        "factory's K (calibrate(..., guess=...)), or with a simpler model.",
    )


def _spoiled_views(state: Search) -> Finding | None:
    if not state.spoiled:
        return None
    names = [state.data.names[view] for view, _, _ in state.spoiled]
    numbers = ", ".join(f"{rms:.2f}" for _, rms, _ in state.spoiled)
    others = state.spoiled[-1][2]
    return Finding(
        "spoiled_view",
        "One view or a few do not fit the others; each pulls the whole calibration towards it.",
        f"{_listed(names)}: {numbers} px a coordinate where the other views predict the corners, "
        f"the others {others:.2f} px",
        "Look at the image: blurred, a reflection, a hand, or corners refined with a window wider "
        "than the squares, which is the detector's fault and not the view's. Detect it again with "
        "a smaller window, or leave it out.",
        state.tests[causes.VIEW].p_value,
    )


def _bad_corners(state: Search) -> Finding | None:
    if not state.corners:
        return None
    worst = sorted(state.corners, key=lambda corner: -corner[2])
    listed = [f"{state.data.names[v]} corner {k} ({off:.1f} px)" for v, k, off in worst]
    return Finding(
        "bad_corners",
        "Single corners are not where the rest of their view says.",
        f"{len(worst)} of {len(state.data.view) + len(worst)} corners, beyond what noise reaches: "
        + _listed(listed),
        "Look at them in the image (a reflection, a finger, a marker's edge taken for a corner) "
        "and leave them out.",
        state.tests[causes.CORNERS].p_value,
    )


def _bow(state: Search) -> Finding | None:
    if causes.BOW not in state.model.causes:
        return None
    sag, sigma = causes.sag(state)
    if sag < NORMAL_BOW_M:
        return None
    return Finding(
        causes.BOW,
        "The board is not flat; the fit hides its shape in the focal length and the distortion.",
        f"the corners lie {1e3 * sag:.2f} ± {1.96e3 * sigma:.2f} mm (95 %) out of one plane, from "
        f"top to bottom; with a curved board in the model fx is {_shift(state)}",
        "Glue the print to glass or an aluminium plate, check it with a straight edge, and take "
        "the views again. Until then, use calibrate(..., points=...) with the board's real shape.",
        state.tests[causes.BOW].p_value,
    )


def _focus(state: Search) -> Finding | None:
    drift = state.model.sizes.get(causes.FOCUS, 0.0)
    if drift < NORMAL_DRIFT:
        return None
    return Finding(
        causes.FOCUS,
        "The focal length changed from view to view: one K cannot describe all of them.",
        f"focal lengths differ by {100 * drift:.1f} % (standard deviation over the views), where "
        f"a fixed lens stays below {100 * NORMAL_DRIFT:.1f} %",
        "Switch autofocus off and fix focus and zoom (camera.lock()) before the first view; let "
        "the camera warm up for some minutes.",
        state.tests[causes.FOCUS].p_value,
    )


def _shutter(state: Search) -> Finding | None:
    # The size is that of one of three components of the motion.
    motion = np.sqrt(3.0) * state.model.sizes.get(causes.SHUTTER, 0.0)
    if motion < NORMAL_MOTION_M:
        return None
    return Finding(
        causes.SHUTTER,
        "Camera or board moved while the rows of an image were read one after the other, which "
        "shears the board.",
        f"{1e3 * motion:.1f} mm of motion (rms over the views) between an image's first and last "
        f"row: {1e3 * motion / 20:.2f} m/s if reading takes 20 ms",
        "Put the board or the camera down and trigger when everything is still; or use a camera "
        "with a global shutter.",
        state.tests[causes.SHUTTER].p_value,
    )


def _lens(state: Search) -> Finding | None:
    if state.model.sizes.get(causes.LENS, 0.0) < NORMAL_LENS_PX:
        return None
    return Finding(
        causes.LENS,
        "The distortion model cannot follow this lens.",
        f"terms that it does not have explain {state.tests[causes.LENS].size:.2f} px of the "
        "residuals in the same way in all views",
        "Fit a model with more coefficients (brown_conrady has the most here); a wide-angle lens "
        "needs a fisheye or rational model. Also check that the board is flat.",
        state.tests[causes.LENS].p_value,
    )


def _halves(state: Search, result: IntrinsicsResult, explained: bool) -> Finding | None:
    """Whether two halves disagree by more than noise explains, or by so much that noise may not.

    explained: whether a cause was found, which is then why they disagree.
    """
    kept = state.kept(result.detections)
    if len(kept) < FEW_VIEWS or _no_edge_corners(result.detections):
        return None
    both = halves(kept, result.board, model=result.model)
    worst, sigma = float(np.nanmax(both.length_px)), float(np.nanmax(both.expected_px))
    unexplained = both.p_value < causes.LEVEL and worst > GRAVE_PX and not explained
    if not unexplained and min(worst, sigma) < LOST_PX:
        return None
    return Finding(
        "halves_disagree",
        "Every other view gives another camera than the views between, towards the image's edges "
        "most of all: one may not be believed there any more than the other.",
        f"the two differ by up to {worst:.0f} px over the image and by "
        f"{np.nanmedian(both.length_px):.2f} px in its median; noise alone would give a sigma "
        f"of up to {sigma:.0f} px",
        "Take more views, and more that reach the image's corners. If they still disagree, look at "
        "the images for reflections, and refine corners with a window smaller than the squares.",
        both.p_value,
    )


def _shift(state: Search) -> str:
    """How far fx moved from the plain fit, in px and per cent."""
    before, after = state.plain.camera.fx, state.model.camera.fx
    return f"{after:.1f} px, without it {before:.1f} px ({100 * (before / after - 1):+.2f} %)"


def _blur(detections: Sequence[Detection]) -> Finding | None:
    """Motion blurs along one direction, defocus along all: their difference is a length."""
    lengths = blur_lengths_px(detections)
    blurred = [i for i, length in enumerate(lengths) if length > BLUR_LENGTH_PX]
    if len(blurred) < MANY_BLURRED:
        return None
    names = [detections[i].name or f"view {i}" for i in blurred]
    return Finding(
        "motion_blur",
        "Camera or board moved during the exposure: edges are smeared along one direction.",
        f"{len(blurred)} of {len(lengths)} views smeared over {lengths[blurred].min():.1f} to "
        f"{lengths[blurred].max():.1f} px ({_listed(names)})",
        "Expose for less time with more light, put the board down, and trigger when it is still.",
    )


def blur_lengths_px(detections: Sequence[Detection]) -> Floats:
    """The length (n,) of the uniform motion that would smear each view's edges as they are, px.

    A motion over L px adds L^2 / 12 to the blur's variance along it and nothing across it. What
    all views have in common (their median) is the camera's own and is taken off. NaN where no blur
    was measured.
    """
    lengths = np.full(len(detections), np.nan)
    known = [i for i, d in enumerate(detections) if d.blur is not None]
    if known:
        blurs = np.stack([detections[i].blur for i in known])  # type: ignore[misc]
        across, along = np.linalg.eigvalsh(blurs - np.median(blurs, axis=0)).T
        lengths[known] = np.sqrt(12.0 * (along - across))
    return lengths


# --- the design of the session ---


def _fronto_parallel(result: IntrinsicsResult) -> Finding | None:
    # Flat views let the solver end in a wrong minimum with a focal length several times too long,
    # and the tilts come out too large by the same factor. So they are taken as those of a lens no
    # longer than the image's diagonal; a real telephoto lens with views of 45 deg passes all the
    # same.
    fx = result.intrinsics.fx
    longest = min(1.0, float(np.hypot(*result.intrinsics.size)) / fx)
    tilt = float(np.quantile(longest * tilts(result).total_deg, FLAT_SHARE))
    if tilt >= FLAT_TILT_DEG:
        return None
    share = 100 * result.sigma("fx") / fx
    return Finding(
        "fronto_parallel",
        "The board faces the camera in nearly all views, so a longer focal length and a larger "
        "distance look the same.",
        f"{100 * FLAT_SHARE:.0f} % of the views are tilted less than {tilt:.1f} deg; fx is known "
        f"to {share:.2g} % (one sigma) at best, and may be stuck at a wrong value besides",
        "Tilt the board 30 to 45 deg about both axes, to both sides.",
    )


def _no_edge_corners(detections: Sequence[Detection]) -> Finding | None:
    seen = coverage(detections)
    bare = [margin for margin in seen.margins if margin > BARE_MARGIN]
    if len(bare) < BARE_SIDES and max(seen.margins) < ONE_BARE_MARGIN:
        return None
    left, top, right, bottom = (100 * margin for margin in seen.margins)
    return Finding(
        "no_edge_corners",
        "No corner lies near the image's border: there the distortion is extrapolated.",
        f"empty margins: left {left:.0f} %, right {right:.0f} % of the width, top {top:.0f} %, "
        f"bottom {bottom:.0f} % of the height; the outermost corner is "
        f"{100 * seen.reach:.0f} % of the way to the image's corner",
        "Push the board into the sides and corners of the image; a ChArUco board may stick out.",
    )


# --- metres from elsewhere ---


def _scale_by_depth(result: IntrinsicsResult, depths: list[Floats]) -> list[Finding]:
    return _wrong_squares(
        result, depth_scale(result, depths), DEPTH_TOLERANCE, "the depth camera's Z at the corners"
    )


def _scale_by_robot(result: IntrinsicsResult, poses: Floats) -> list[Finding]:
    return _wrong_squares(
        result, robot_scale(result, poses), ROBOT_TOLERANCE, "the robot's motion between the views"
    )


def _wrong_squares(
    result: IntrinsicsResult, scale: Scale | None, tolerance: float, source: str
) -> list[Finding]:
    if scale is None or abs(scale.factor - 1) < max(tolerance, SCALE_SIGMAS * scale.sigma):
        return []
    stated = 1e3 * result.board.square_m
    return [
        Finding(
            "wrong_square_size",
            "The squares have another size than the board claims; K is not affected, every "
            "distance is.",
            f"{source} is {scale.factor:.4f} ± {1.96 * scale.sigma:.4f} (95 %) of what the images "
            f"say: squares of {scale.factor * stated:.2f} mm, not {stated:.2f} mm",
            "Measure ten squares of the print with a caliper and give their size to the board; "
            "print at 100 %, not fitted to the page.",
        )
    ]


# --- the arguments ---


def _check_depths(
    detections: Sequence[Detection], depth_m: Sequence[ArrayLike] | None
) -> list[Floats] | None:
    if depth_m is None:
        return None
    if len(depth_m) != len(detections):
        raise ValueError(f"depth_m: got {len(depth_m)} views, want {len(detections)}")
    depths = [np.asarray(z, float) for z in depth_m]
    for number, (z, detection) in enumerate(zip(depths, detections, strict=True)):
        if z.shape != (len(detection.ids),):
            raise ValueError(
                f"depth_m: view {number} has shape {z.shape}, want ({len(detection.ids)},), one Z "
                "a corner"
            )
    return depths


def _check_poses(
    detections: Sequence[Detection], T_base_gripper: ArrayLike | None
) -> Floats | None:
    if T_base_gripper is None:
        return None
    poses = transforms("T_base_gripper", T_base_gripper)
    if poses.shape != (len(detections), 4, 4):
        raise ValueError(
            f"T_base_gripper: got shape {poses.shape}, want ({len(detections)}, 4, 4), one a view"
        )
    return poses


def _listed(names: Sequence[str], most: int = 4) -> str:
    """The first names, and how many more."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
