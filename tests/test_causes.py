"""The search for causes that both diagnoses use, on models small enough to check by hand."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2, norm
from scipy.stats import f as f_distribution

from coursekit import causes
from coursekit.causes import Hypothesis, Projection, likelihood_ratios, search


def test_the_f_test_and_the_likelihood_ratio_are_the_textbooks() -> None:
    """One hypothesis of two columns, on a part of the rows, against full least squares."""
    rng = np.random.default_rng(0)
    J, E, r = rng.normal(size=(40, 3)), rng.normal(size=(25, 2)), rng.normal(size=40)
    r[10:35] += E @ [0.7, -0.8]
    hypothesis = Hypothesis("any", E, rows=np.arange(10, 35))
    full = np.concatenate([J, hypothesis.dense(40)], axis=1)

    def rest(A: np.ndarray) -> float:
        return float(np.sum((r - A @ np.linalg.lstsq(A, r, rcond=None)[0]) ** 2))

    before, after = rest(J), rest(full)
    wanted = f_distribution.sf((before - after) / 2 / (after / 35), 2, 35)
    solution, inverse = np.linalg.lstsq(full, r, rcond=None)[0], np.linalg.inv(full.T @ full)
    test = Projection(r, J).explains(replace(hypothesis, typical=1e3))
    assert test.p_value == pytest.approx(wanted, rel=1e-9)
    assert test.coefficients == pytest.approx(solution[3:], rel=1e-9)
    assert test.covariance == pytest.approx(after / 35 * inverse[3:, 3:], rel=1e-9)
    # A unit covariance is the likelier of two here; then gain is what the squares lose.
    [known] = likelihood_ratios(r, J, [replace(hypothesis, tried=4)], [9 * np.eye(40), np.eye(40)])
    assert known.gain == pytest.approx(before - after, rel=1e-9)
    assert known.p_value == pytest.approx(4 * chi2.sf(before - after, 2), rel=1e-9)
    assert known.covariance == pytest.approx(inverse[3:, 3:], rel=1e-9)


@dataclass(frozen=True, eq=False)
class Means:
    """Numbers in groups; a group may have a mean of its own. `stubborn` groups refuse a refit."""

    values: np.ndarray
    groups: tuple[tuple[int, ...], ...]
    stubborn: tuple[int, ...] = ()
    least: float = 0.0
    taken: tuple[int, ...] = ()

    def hypotheses(self):
        for at, rows in enumerate(self.groups):
            if at not in self.taken:
                yield Hypothesis(f"group {at}", np.ones((len(rows), 1)), at, list(rows))

    def tested(self, hypotheses):
        columns = np.zeros((len(self.values), len(self.taken)))
        for column, at in enumerate(self.taken):
            columns[list(self.groups[at]), column] = 1.0
        return likelihood_ratios(self.values, columns, hypotheses, [np.eye(len(self.values))])

    def matters(self, test) -> bool:
        return abs(test.coefficients[0]) > self.least

    def accept(self, test):
        kept = replace(self, taken=(*self.taken, test.at))
        return None if test.at in self.stubborn else kept


VALUES = np.array([0.1, -0.2, 8.0, 8.3, 0.0, 5.1, 5.0, -0.1])


def test_the_strongest_is_accepted_first_and_what_it_explains_is_not_named_again() -> None:
    model = Means(VALUES, ((2, 3), (2, 3, 4), (5, 6), (0, 1)))
    found = search(model, level=1e-3)
    assert [step.test.at for step in found.accepted] == [0, 2]
    assert found.model.taken == (0, 2)
    assert found.start is model
    assert found.accepted[1].before is found.accepted[0].after
    assert found.of("group 2") == found.accepted[1:]
    assert {test.at for test in found.tested} == {1, 3}  # tested, and no longer significant


def test_what_does_not_matter_is_left_and_a_broken_promise_is_refused() -> None:
    groups = ((2, 3), (5, 6))
    assert [s.test.at for s in search(Means(VALUES, groups, least=6.0), 1e-3).accepted] == [0]
    found = search(Means(VALUES, groups, stubborn=(0,)), level=1e-3)
    assert [step.test.at for step in found.accepted] == [1]
    assert found.refused == {("group 0", 0)}


def test_rivals_are_other_causes_that_explain_nearly_as_well() -> None:
    found = search(Means(VALUES, ((2, 3), (2, 3, 4), (1, 2, 3), (5, 6))), level=1e-3)
    assert found.accepted[0].rivals == ()  # by 45 in twice the log-likelihood, it has none
    found = search(Means(VALUES, ((2, 3), (3, 2), (5, 6))), level=1e-3)
    assert [rival.cause for rival in found.accepted[0].rivals] == ["group 1"]
    assert found.accepted[1].rivals == ()


def test_log_tail_of_chi_square() -> None:
    for dof, x in ((1, 3.0), (6, 40.0), (6, 1300.0)):
        assert causes.log_chi2_tail(x, dof) == pytest.approx(chi2.logsf(x, dof), rel=1e-3)
    # chi2(1) is the square of a normal variable, whose log tail is known far out
    assert causes.log_chi2_tail(1e4, 1) == pytest.approx(np.log(2) + norm.logsf(100.0), rel=1e-3)
