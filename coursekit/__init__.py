"""Camera models, calibration and hand-eye: the machinery behind the course's five notebooks.

Rooms are loaded when they are first used, so that `import coursekit as ck` costs nothing. This is
the map. A room imports only rooms that stand above it, those in its last column; `arrays`, `checks`
and `words` serve them all.

| room | holds | talks in | imports |
|---|---|---|---|
| `arrays` | types of arrays | `Floats`, `Window`, `Interval` | - |
| `checks` | checks of arguments, one line each | `ValueError`: NAME: got ..., want ... | - |
| `words` | tables, plurals, wrapped lines, p-values; what a diagnosis found | text and HTML, `Findings` | - |
| `kernels` | whole images at a time, compiled with numba | arrays | - |
| `formats` | files of other programs: lenses, tables of poses, transforms | dictionaries of fields, (4, 4) transforms | - |
| `geometry` | `project` and `deproject`, rigid transforms and small motions | `Intrinsics`, (4, 4) transforms | `kernels`, `formats` |
| `specifications` | devices, lenses and published noise, from tables in data/ | `Device`, `Unit` | `geometry` |
| `results` | the files by which a notebook hands over what it found, and `export` | `Result`, results/*.json | `formats`, `geometry` |
| `stereo` | depth from disparity: its noise, its bias, a block's face | `WindowStats`, `NoiseFit`, `BiasFit` | `geometry` |
| `boards` | calibration boards: drawn, found, corners refined, is it seen from here | `Board`, `Detection(s)` | `geometry` |
| `causes` | the search for what else explains residuals; both diagnoses use it | `Hypothesis`, `Tested` | - |
| `intrinsics` | K and distortion: fitted, how well known, what is wrong with a session | `IntrinsicsResult`, `Findings` | `geometry`, `specifications`, `results`, `boards`, `causes` |
| `arm` | the WidowX: kinematics, and how an arm errs | `Arm`, joint angles, (4, 4) poses | `geometry`, `specifications` |
| `hand_eye` | where the camera is: AX = XB, refined, how good, what is wrong | `HandEyeSession`, `HandEyeResult` | `formats`, `geometry`, `results`, `boards`, `causes`, `intrinsics`, `arm` |
| `budget` | errors in millimetres at the gripper, added up | `View`, `ErrorTerm`, `ErrorBudget` | `geometry`, `specifications`, `results`, `stereo`, `intrinsics`, `arm`, `hand_eye` |
| `attribution` | whose fault misses are | (n, 3) misses, `Attribution` | `geometry`, `results`, `arm`, `budget` |
| `simulation` | scenes, light, infrared, boards and arms that do not exist | `Scene`, `Rig`, sessions with their truth | `geometry`, `specifications`, `boards`, `arm`, `hand_eye` |
| `cameras` | one camera: live, recorded or simulated; capturing a session | `Camera`, `Frame(s)` | `geometry`, `specifications`, `results`, `boards`, `simulation` |
| `lessons` | questions, exercises with their named mistakes, progress | answers, `Verdict` | `geometry`, `specifications`, `results` |
| `plots` | one module of figures a notebook | `LessonFigure` | `geometry`, `boards`, `intrinsics`, `hand_eye`, `budget`, `attribution`, `simulation`, `cameras` |
| `submission` | handing in and grading the studio exercise | `Submission`, bundles (.zip), HTML pages | `specifications`, `results`, `stereo`, `cameras`, `lessons` |
| `doctor` | what works on this computer, and what to do about the rest | lines of text | `results`, `stereo`, `cameras` |
| `cli` | the command `coursekit` | arguments, exit codes | `formats`, `geometry`, `results`, `boards`, `intrinsics`, `hand_eye`, `cameras`, `submission`, `doctor` |

Where a thing is: open the room's `__init__.py`; it begins with the room's question or equation and
lists what the room offers. A module is named for what is in it.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from coursekit import (
        arm,
        attribution,
        boards,
        budget,
        cameras,
        geometry,
        hand_eye,
        intrinsics,
        lessons,
        plots,
        results,
        simulation,
        specifications,
        stereo,
        submission,
    )
    from coursekit.cameras import my_unit, open_camera, place
    from coursekit.cameras.capture import capture
    from coursekit.lessons import check, checkpoint, evidence
    from coursekit.lessons.overview import progress
    from coursekit.plots import drag
    from coursekit.results import export
    from coursekit.submission.submit import submit

_FUNCTIONS = {
    "capture": "coursekit.cameras.capture",
    "my_unit": "coursekit.cameras",
    "open_camera": "coursekit.cameras",
    "place": "coursekit.cameras",
    "check": "coursekit.lessons",
    "checkpoint": "coursekit.lessons",
    "evidence": "coursekit.lessons",
    "progress": "coursekit.lessons.overview",
    "drag": "coursekit.plots",
    "export": "coursekit.results",
    "submit": "coursekit.submission.submit",
}


def __getattr__(name: str) -> Any:
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(_FUNCTIONS[name]), name)
    try:
        return importlib.import_module(f"coursekit.{name}")
    except ModuleNotFoundError as error:
        if error.name != f"coursekit.{name}":
            raise
        raise AttributeError(f"module 'coursekit' has no attribute {name!r}") from None


def __dir__() -> list[str]:
    return [*_FUNCTIONS, *(room.name for room in pkgutil.iter_modules(__path__))]
