"""`ck.progress()`: what was answered, what is kept, what to do next."""

import contextlib
import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from common import mutants

import coursekit as ck
from coursekit import lessons, results
from coursekit.lessons.questions import Choice
from coursekit.results import Covariance, Quantity

CAMERA = SimpleNamespace(source="live", name="D435 on the bench")


@pytest.fixture(autouse=True)
def _own_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COURSEKIT_RESULTS", str(tmp_path))


def right_letter(choice: Choice) -> str:
    return next(letter for letter, option in choice.lettered().items() if option.right)


def test_a_beginner() -> None:
    now = ck.progress()
    assert [s.notebook for s in now.standings][0::4] == ["01_pinhole", "05_error_budget"]
    assert sum(s.checkpoints for s in now.standings) == len(lessons.CHECKPOINTS)
    assert sum(s.exercises[1] for s in now.standings) == len(lessons.EXERCISES)
    assert now.next.startswith("Begin with notebook 01_pinhole")
    assert "0 of" in repr(now)


def test_first_tries_later_ones_and_results() -> None:
    choices = [c for n, c in lessons.CHECKPOINTS.items() if isinstance(c, Choice)]
    one, two, three = choices[:3]
    one.answer(right_letter(one))
    two.answer(next(letter for letter in "ABC" if letter != right_letter(two)))
    two.answer(right_letter(two))
    three.answer(next(letter for letter in "ABC" if letter != right_letter(three)))
    results.save("01_pinhole", CAMERA, {"fx": Quantity(430.0, "px")})

    now = ck.progress()
    assert sum(s.first_try for s in now.standings) == 1
    assert sum(s.later for s in now.standings) == 1
    assert three.name.partition(".")[2] in {name for s in now.standings for name in s.open}
    assert now.standings[0].result.startswith("from D435 on the bench (live), 20")
    assert now.next.startswith("Next: ")
    assert "02_depth_noise" in now.next
    assert "D435 on the bench" in now._repr_html_()


def test_the_hand_in() -> None:
    said = []
    assert ck.progress().hand_in.startswith("nothing measured yet")
    for n, name in enumerate(("studio_1.measured", "studio_1_ada.zip", "studio_1.measured")):
        path = results.folder() / name
        path.touch()
        os.utime(path, (n, n))
        said.append(ck.progress().hand_in)
    assert said[0].startswith("measured, and not packed yet")
    assert said[1] == "studio_1_ada.zip in results/"
    assert said[2].endswith("older than what you measured: pack again")
    assert f"Hand-in: {said[2]}." in repr(ck.progress())


def test_a_damaged_result_is_named() -> None:
    (results.folder() / "01_pinhole.json").write_text("{", encoding="utf-8")
    now = ck.progress()
    assert "cannot be read" in now.standings[0].result
    assert "01_pinhole" in now.next


@pytest.mark.filterwarnings("ignore:progress.json is damaged")
def test_files_of_another_shape_stop_nothing() -> None:
    name = next(iter(lessons.CHECKPOINTS))
    lessons.CHECKPOINTS[name].answer("A")
    covariance = {"two": Covariance(("fx", "k1"), [[1.0, 0.0], [0.0, 1.0]])}
    quantities = {"fx": Quantity(430.0, "px", 1.0, note="a"), "k1": Quantity(0.1, "1")}
    kept = [
        results.folder() / "progress.json",
        results.save("01_pinhole", CAMERA, quantities, covariance),
    ]
    for path in kept:
        text = path.read_text(encoding="utf-8")
        for mutant in mutants(json.loads(text)):
            path.write_text(mutant, encoding="utf-8")
            assert "01_pinhole" in repr(ck.progress()) + ck.progress()._repr_html_()
            assert repr(ck.evidence(name.partition(".")[0]))
            with contextlib.suppress(ValueError):
                repr(results.load("01_pinhole"))
        path.write_text(text, encoding="utf-8")
    kept[0].write_text('{"a": 1}', encoding="utf-8")
    with pytest.warns(UserWarning, match=r"damaged .*a: got int, want list.*set aside as"):
        ck.progress()
    ck.progress()  # says it once
    assert not kept[0].exists()


def test_when_all_is_kept_it_names_what_is_open() -> None:
    for standing in ck.progress().standings:
        results.save(standing.notebook, CAMERA, {"fx": Quantity(430.0, "px")})
    assert "Still open" in ck.progress().next
