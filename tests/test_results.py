"""The hand-over files: what goes in comes out, and nothing half-written or damaged passes."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from common import EXPECTED, named, refusals

from coursekit import results
from coursekit.results import Covariance, Quantity

pytestmark = pytest.mark.usefixtures("own_results")
CAMERA = SimpleNamespace(source="simulated", name="Simulated D435")


def test_round_trip(own_results: Path) -> None:
    quantities = {
        "fx": Quantity(612.4, "px", 0.9, "bias", "from 28 views"),
        "sigma_d": Quantity(float(np.float64(0.08)), "px", None, "noise"),
    }
    path = results.save("01_pinhole", CAMERA, quantities)
    assert path == own_results / "01_pinhole.json"
    with pytest.raises(FileNotFoundError, match="notebook 02_depth_noise has kept nothing"):
        results.load("02_depth_noise")
    loaded = results.load("01_pinhole")
    assert loaded.quantities == quantities
    assert loaded.source == "simulated"
    assert loaded.camera == "Simulated D435"
    assert loaded.versions["numpy"] == np.__version__
    assert loaded.date.endswith("+00:00")
    assert [p.name for p in own_results.iterdir()] == ["01_pinhole.json"]  # nothing left over


def test_only_quantities_are_saved(own_results: Path) -> None:
    with pytest.raises(ValueError, match=r"^quantities\['fx'\]: got float, want Quantity"):
        results.save("01_pinhole", CAMERA, {"fx": 612.4})
    assert not own_results.exists()


def test_damaged_files_are_named() -> None:
    path = results.save("01_pinhole", CAMERA, {"fx": Quantity(1.0, "px")})
    text = path.read_text(encoding="utf-8")
    for damaged in (
        text[: len(text) // 2],
        "",
        "[]",
        "\x00",
        *(text.replace(was, now) for was, now in EXPECTED["damaged_results"]),
    ):
        assert damaged != text
        path.write_text(damaged, encoding="utf-8")
        with pytest.raises(ValueError, match=r"01_pinhole\.json"):
            results.load("01_pinhole")


def test_a_covariance_goes_along(own_results: Path) -> None:
    quantities = {"fx": Quantity(612.0, "px", 0.9), "k1": Quantity(0.02, "1", 0.001)}
    matrix = np.array([[0.81, 4e-4], [4e-4, 1e-6]])
    covariances = {"intrinsics": Covariance(("fx", "k1"), matrix)}
    results.save("03_intrinsics", CAMERA, quantities, covariances)
    loaded = results.load("03_intrinsics").covariances["intrinsics"]
    assert loaded.names == ("fx", "k1")
    assert np.array_equal(loaded.matrix, matrix)
    results.save("01_pinhole", CAMERA, quantities)
    assert results.load("01_pinhole").covariances == {}


def test_a_covariance_of_something_else_is_refused(own_results: Path) -> None:
    covariance = {"K": Covariance(("fx", "cx"), np.eye(2))}
    with pytest.raises(ValueError, match=r"^covariances\['K'\]: got 'cx'"):
        results.save("03_intrinsics", CAMERA, {"fx": Quantity(1.0, "px")}, covariance)
    with pytest.raises(ValueError, match=r"^covariances\['K'\]: got ndarray"):
        results.save("03_intrinsics", CAMERA, {}, {"K": np.eye(2)})
    assert not own_results.exists()


def test_a_failed_write_leaves_the_old_file(own_results: Path) -> None:
    path = results.save("01_pinhole", CAMERA, {"fx": Quantity(1.0, "px")})
    before = path.read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="not JSON compliant"):
        results.write_json(path, {"x": float("nan")})
    with pytest.raises(TypeError):
        results.write_json(path, {"x": object()})
    assert path.read_text(encoding="utf-8") == before
    assert len(list(own_results.iterdir())) == 1
    assert json.loads(before)["quantities"]["fx"]["value"] == 1.0


def quantity(**changes):
    return Quantity(**{"value": 1.0, "unit": "px"} | changes)


def covariance(matrix):
    return Covariance(("fx", "fy"), matrix)


NO_NAMES = ("", "../escape", "a/b", "01 pinhole", ".hidden")
ASYMMETRIC, INDEFINITE = [[1.0, 0.5], [0.4, 1.0]], [[1.0, 2.0], [2.0, 1.0]]

test_what_cannot_be_is_refused = refusals(
    *named(
        quantity,
        value=[float("nan"), "3", None, 10**400, np.float32("inf")],
        sigma=[-1.0, float("inf")],
    ),
    *named(quantity, unit=[""], kind=["random"]),
    *named(lambda lesson: results.save(lesson, CAMERA, {}), lesson=NO_NAMES),
    *named(covariance, matrix=[np.eye(3), ASYMMETRIC, INDEFINITE, np.full((2, 2), np.nan)]),
)
