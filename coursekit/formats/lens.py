"""K and lens in the files of ROS, OpenCV, Kalibr, COLMAP, Open3D, and in the course's own JSON.

`read` and `write` deal in the fields of `geometry.Intrinsics`: width, height, fx, fy, cx, cy, model
and coeffs (k1, k2, p1, p2, k3), pixel (0, 0) being the centre of the first pixel. COLMAP counts
from that pixel's corner, so its cx and cy are half a pixel larger. Sources: sensor_msgs/CameraInfo
and camera_calibration_parsers (ROS), cv::FileStorage, "yaml formats" of Kalibr's wiki, COLMAP's
camera_models.h, Open3D's PinholeCameraIntrinsic.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coursekit.checks import want
from coursekit.formats import kind_of, numbers, read_text, tree

Fields = dict[str, Any]

WANTED = (
    "K and lens as ROS (camera_info), OpenCV (FileStorage), Kalibr (camchain), COLMAP "
    "(cameras.txt), Open3D or this course write them"
)
FORMATS = ("ros", "opencv", "kalibr", "colmap", "open3d", "json")
# Names that stand for one thing, as people write them, without case and underscores
WIDTH, HEIGHT = ("imagewidth", "width"), ("imageheight", "height")
MATRIX = ("cameramatrix", "k", "mtx", "intrinsicmatrix", "matrix")
COEFFS = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distortion", "dist", "d")
COEFFS += ("coeffs",)
MODEL = ("distortionmodel", "model")
WITHIN = ("lens", "intrinsics", "intrinsic", "camerainfo", "colorintrinsics")
# COLMAP's models: how many focal lengths, then which coefficients
COLMAP_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
COLMAP_LINE = re.compile(r"\s*\d+\s+[A-Z][A-Z0-9_]+\s+\d+\s+\d+(\s|$)")
COLMAP_CENTRE = 0.5  # px, what its cx and cy are larger by
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


# --- in ---


def read(
    path: str | os.PathLike[str],
    size: Sequence[int] | None = None,
    which: str | None = None,
) -> Fields:
    """The fields of a lens from any of the formats, recognised by content.

    size: (width, height) where the file has none. which: of several cameras, such as "cam0".
    Raises ValueError in a sentence, with the file's name, for everything else.
    """
    name = Path(path).name
    text = read_text(path, WANTED)
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if lines and COLMAP_LINE.match(lines[0]):
        cameras = {line.split()[0]: line.split() for line in lines}
        return _colmap(_only(cameras, which, name), name)
    tabular = kind_of(text) in ("a table of poses", "a web page", "a robot description (URDF)")
    want(not tabular, name, kind_of(text), WANTED)
    found = tree(text, name)
    want(isinstance(found, dict), name, kind_of(text), WANTED)
    chain = {key: value for key, value in found.items() if re.fullmatch(r"cam\d+", key)}
    if chain:
        return _kalibr(_only(chain, which, name), name)
    return _matrix(found, size, name, kind_of(text))


def _only(cameras: dict[str, Any], which: str | None, name: str) -> Any:
    """The camera that is asked for, or the only one."""
    if which is None and len(cameras) > 1:
        known = ", ".join(list(cameras)[:6])
        raise ValueError(f"{name}: holds {len(cameras)} cameras ({known}); say which='...'")
    which = which or next(iter(cameras))
    want(which in cameras, "which", which, f"one of {', '.join(list(cameras)[:6])}")
    return cameras[which]


def _matrix(found: dict[str, Any], size: Sequence[int] | None, name: str, kind: str) -> Fields:
    """Of ROS, OpenCV, Open3D and the course, which all name their numbers."""
    flat = {re.sub(r"[_\s]", "", key).lower(): value for key, value in found.items()}
    if "fx" not in flat and not any(key in flat for key in MATRIX):
        for key in WITHIN:
            if isinstance(flat.get(key), dict):
                return _matrix(flat[key], size, name, kind)
        want("quantities" not in flat, name, "a result that holds no lens", WANTED)
        raise ValueError(f"{name}: is {kind} without a camera matrix, want {WANTED}")
    coeffs = numbers(_first(flat, COEFFS, []), f"{name}, distortion")
    model = str(_first(flat, MODEL, "") or "").lower()
    if _truth(flat.get("fisheyemodel")) or "xi" in flat:
        model = "fisheye"
    unnamed = "distortionmodel" in flat and not model and any(coeffs)
    want(not unnamed, f"{name}, distortion_model", "", "the name of the model of its coefficients")
    sides = [_first(flat, names, None) for names in (WIDTH, HEIGHT)]
    sides = numbers(flat["imagesize"], name) if "imagesize" in flat else sides
    if None in sides:
        if size is None:
            raise ValueError(f"{name}: has no image size; say size=(width, height)")
        sides = list(size)
    _whole_image(flat, name)
    width, height = (_side(side, name) for side in sides)
    if "fx" in flat:
        (fx,), (fy,), (cx,), (cy,) = (numbers(flat.get(k), f"{name}, {k}") for k in K_NAMES)
    else:
        fx, fy, cx, cy = _pinhole(flat, name)
    model = model or ("brown_conrady" if any(coeffs) else "none")
    return _fields(width, height, fx, fy, cx, cy, model, coeffs)


K_NAMES = ("fx", "fy", "cx", "cy")


def _pinhole(flat: dict[str, Any], name: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix; Open3D's, and only that, goes column by column."""
    key = next(key for key in MATRIX if key in flat)
    K = numbers(flat[key], f"{name}, {key}")
    want(len(K) == 9, f"{name}, {key}", f"{len(K)} numbers", "9, a 3x3 matrix")
    want(any(K), f"{name}, {key}", "zeros only", "a camera that was calibrated")
    if key == "intrinsicmatrix":
        K = [K[3 * column + row] for row in range(3) for column in range(3)]
    fits = not any((K[1], K[3], K[6], K[7])) and K[8] == 1
    want(fits, f"{name}, {key}", K, "[fx, 0, cx, 0, fy, cy, 0, 0, 1]: no skew, not transposed")
    return K[0], K[4], K[2], K[5]


def _whole_image(flat: dict[str, Any], name: str) -> None:
    """ValueError where ROS says that images are binned or cut out: K would belong to others."""
    for key in ("binningx", "binningy"):
        (binned,) = numbers(flat.get(key, "0"), f"{name}, {key}")
        want(binned <= 1, f"{name}, {key}", binned, "0 or 1: K of binned images is another")
    roi = flat.get("roi") if isinstance(flat.get("roi"), dict) else {}
    for key in ("x_offset", "y_offset"):
        (start,) = numbers((roi or {}).get(key, "0"), f"{name}, {key}")
        want(start == 0, f"{name}, roi", start, "no region of interest: K is the whole image's")


def _kalibr(camera: Any, name: str) -> Fields:
    want(isinstance(camera, dict), name, camera, "a camera of Kalibr's")
    for key in ("camera_model", "intrinsics", "resolution"):
        want(key in camera, name, sorted(camera), f"{key!r} in it, as Kalibr writes")
    model = camera["camera_model"]
    want(model == "pinhole", f"{name}, camera_model", model, "'pinhole': no other is supported")
    named = {"radtan": "brown_conrady", "none": "none", None: "none"}
    given = camera.get("distortion_model")
    K = numbers(camera["intrinsics"], f"{name}, intrinsics")
    want(len(K) == 4, f"{name}, intrinsics", K, "[fu, fv, pu, pv]")
    sides = camera["resolution"]
    want(isinstance(sides, list) and len(sides) == 2, f"{name}, resolution", sides, "[w, h]")
    width, height = (_side(side, name) for side in sides)
    coeffs = numbers(camera.get("distortion_coeffs", []), f"{name}, distortion_coeffs")
    want(given != "radtan" or len(coeffs) == 4, f"{name}, distortion_coeffs", coeffs, "[k1 k2 p1 p2]")
    return _fields(width, height, *K, named.get(given, str(given)), coeffs)


def _colmap(words: list[str], name: str) -> Fields:
    _, model, *values = words
    known = ", ".join(COLMAP_MODELS)
    want(model in COLMAP_MODELS, f"{name}, model", model, f"one of {known}: others are no pinhole")
    focals, names = COLMAP_MODELS[model]
    width, height, *rest = numbers(values, name)
    want(len(rest) == focals + 2 + len(names), name, words, f"{focals + 2 + len(names)} parameters")
    fx, fy = rest[0], rest[focals - 1]
    cx, cy = (centre - COLMAP_CENTRE for centre in rest[focals : focals + 2])
    by_name = dict(zip(names, rest[focals + 2 :], strict=True))
    coeffs = [by_name.get(one, 0.0) for one in ORDER]
    sides = _side(width, name), _side(height, name)
    return _fields(*sides, fx, fy, cx, cy, "brown_conrady" if names else "none", coeffs)


def _fields(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float,
    model: str, coeffs: list[float],
) -> Fields:  # fmt: skip
    names = ("width", "height", "fx", "fy", "cx", "cy", "model", "coeffs")
    values = (width, height, fx, fy, cx, cy, model, tuple(coeffs) or (0.0,) * 5)
    return dict(zip(names, values, strict=True))


def _first(flat: dict[str, Any], names: Sequence[str], otherwise: Any) -> Any:
    return next((flat[name] for name in names if flat.get(name) is not None), otherwise)


def _side(value: Any, name: str) -> int:
    (side,) = numbers(value, f"{name}, image size")
    fits = side == round(side) and 1 <= side <= 100_000
    want(fits, f"{name}, image size", side, "whole numbers of pixels")
    return int(side)


def _truth(value: Any) -> bool:
    return str(value).lower() in ("1", "true")


# --- out ---


def write(fields: Fields, to: str, name: str = "camera", xml: bool = False) -> str:
    """The text of a file that holds these fields, as Brown-Conrady.

    name: of the camera. xml: OpenCV's XML in place of its YAML. Kalibr's four coefficients and
    Open3D's none are the caller's to provide: ValueError where k3, or any, would be lost.
    """
    size = [int(fields["width"]), int(fields["height"])]
    K = [float(fields[key]) for key in K_NAMES]
    coeffs = [float(value) for value in fields["coeffs"]] if fields["model"] != "none" else [0.0] * 5
    rows = [K[0], 0.0, K[2], 0.0, K[1], K[3], 0.0, 0.0, 1.0]
    if to == "ros":
        return _ros(size, rows, coeffs, name)
    if to == "opencv":
        return _opencv(size, rows, coeffs, xml)
    if to == "kalibr":
        want(coeffs[4] == 0, "to", "kalibr", "a lens without k3: Kalibr has four coefficients")
        camera = {"camera_model": "pinhole", "intrinsics": K, "distortion_model": "radtan"}
        camera |= {"distortion_coeffs": coeffs[:4], "resolution": size}
        return _yaml({"cam0": camera | {"rostopic": f"/{name}/image_raw"}})
    if to == "colmap":
        numbers_ = [*K[:2], *(centre + COLMAP_CENTRE for centre in K[2:]), *coeffs, 0.0, 0.0, 0.0]
        line = " ".join(["1", "FULL_OPENCV", *map(str, size), *map(repr, numbers_)])
        return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (cx, cy from the corner)\n{line}\n"
    if to == "open3d":
        want(not any(coeffs), "to", "open3d", "a lens without distortion: undistort images first")
        columns = [rows[3 * row + column] for column in range(3) for row in range(3)]
        fields = {"width": size[0], "height": size[1], "intrinsic_matrix": columns}
    return json.dumps(fields, indent=1, allow_nan=False) + "\n"


def _ros(size: list[int], rows: list[float], coeffs: list[float], name: str) -> str:
    square = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    projection = [*rows[:3], 0.0, *rows[3:6], 0.0, *rows[6:], 0.0]
    return _yaml(
        {
            "image_width": size[0],
            "image_height": size[1],
            "camera_name": name,
            "camera_matrix": {"rows": 3, "cols": 3, "data": rows},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": coeffs},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": square},
            "projection_matrix": {"rows": 3, "cols": 4, "data": projection},
        }
    )


def _opencv(size: list[int], rows: list[float], coeffs: list[float], xml: bool) -> str:
    import cv2
    import numpy as np

    flags = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY
    storage = cv2.FileStorage(".xml" if xml else ".yml", flags)
    storage.write("image_width", size[0])
    storage.write("image_height", size[1])
    storage.write("camera_matrix", np.reshape(rows, (3, 3)))
    storage.write("distortion_coefficients", np.reshape(coeffs, (1, 5)))
    return str(storage.releaseAndGetString())


def _yaml(content: dict[str, Any]) -> str:
    import yaml

    return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))
