"""What else could explain the residuals of a fit: one search for causes, under every diagnosis.

A *model* was fitted to data and leaves residuals r. A *hypothesis* is a cause that the model lacks,
such as the curvature of a board: to first order it would move the predictions by E s, with known
columns E and unknown coefficients s. The search is always the same:

*Test*: whatever the model's own columns J imitate is taken out of E. What the rest explains of r
gives the coefficients with their covariance, the *gain* (twice the log-likelihood), and a p-value:
how often chance alone would explain as much.

*Acceptance*: of the hypotheses that are significant and that matter (more than careful people have
anyhow) the strongest is taken into the model, and the model is fitted again in full. A refit that
does not keep what the linear test promised refuses the hypothesis. Then the others are tested once
more, for most causes imitate each other a little.

*Rivals*: other causes that explained nearly as much at the moment of a decision. They are recorded
beside what was accepted, and change nothing.

There are two tests, for two kinds of noise. Where its size is unknown, `Projection` estimates it
from what is left (F-test, and restricted likelihood to choose between causes). Where the residuals'
covariance is known but for a factor, `likelihood_ratios` tries a grid of factors.

A room that diagnoses writes its model as a class with four methods (`CauseModel`), and `search`
does the rest. Twelve points that ought to lie on a line, on a parabola with one of them off:

>>> from dataclasses import dataclass, replace
>>> @dataclass(frozen=True, eq=False)
... class Line:
...     x: Floats
...     y: Floats
...     curved: bool = False
...
...     @property
...     def projection(self):
...         return Projection(self.y, self.x[:, None] ** np.arange(3 if self.curved else 2))
...
...     def hypotheses(self):
...         if not self.curved:
...             yield Hypothesis("curved", self.x[:, None] ** 2)
...         worst = int(np.abs(self.projection.residuals).argmax())
...         alone = np.ones((1, 1))
...         yield Hypothesis("outlier", alone, at=worst, rows=[worst], tried=len(self.x))
...
...     def tested(self, hypotheses):
...         return [self.projection.explains(h) for h in hypotheses]
...
...     def matters(self, test):
...         return abs(test.coefficients[0]) > 0.1
...
...     def accept(self, test):
...         if test.cause == "curved":
...             return replace(self, curved=True)
...         return Line(np.delete(self.x, test.at), np.delete(self.y, test.at), self.curved)
>>> x = np.linspace(-1, 1, 12)
>>> y = 1 + x + 2 * x**2 + 0.01 * np.sin(50 * x**3)
>>> y[9] += 0.5
>>> found = search(Line(x, y), level=1e-3)
>>> for step in found.accepted:
...     print(step.test.cause, step.test.at, f"{step.test.coefficients[0]:.2f}")
curved 0 2.00
outlier 9 0.50
>>> [test.cause for test in found.tested if test.p_value < 1e-3]
[]

Source: Seber and Lee, "Linear Regression Analysis" (2003), chapters 3 and 4; Patterson and
Thompson, "Recovery of inter-block information when block sizes are unequal" (1971).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from coursekit.arrays import Floats, NDArray
from coursekit.words import Finding

IMITATED = 1e-10  # share of a column's squares that is left of it but for rounding errors
SEARCH_ROUNDS = 8  # of accepting or refusing one hypothesis
RIVAL_GAIN = 2 * math.log(20)  # a rival is at most 20 times less likely than what was accepted


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A suspected cause and what it adds to the model.

    columns (r, k): d predictions / d its coefficients, on `rows` (r,) of the residuals, all of
    them unless given. typical: what its coefficients would be when it matters. at: its place, such
    as a joint or a view. tried: how many hypotheses of this cause were looked through to find it.
    """

    cause: str
    columns: Floats
    at: int = 0
    rows: Sequence[int] | NDArray[np.intp] | slice = field(default_factory=lambda: slice(None))
    typical: float = 1.0
    tried: int = 1

    def dense(self, n: int) -> Floats:
        """The columns (n, k) on all n residuals."""
        full = np.zeros((n, self.columns.shape[1]))
        full[self.rows] = self.columns
        return full


@dataclass(frozen=True, eq=False)
class Tested:
    """What a hypothesis explains.

    gain: twice the log-likelihood. log_p: of its p-value. strength: what decides between
    hypotheses that may have different numbers of columns. size: the coefficients' rms.
    coefficients (k,), covariance (k, k): their estimate.
    """

    hypothesis: Hypothesis
    gain: float
    log_p: float
    strength: float
    size: float
    coefficients: Floats
    covariance: Floats

    @property
    def cause(self) -> str:
        """The hypothesis' cause."""
        return self.hypothesis.cause

    @property
    def at(self) -> int:
        """The hypothesis' place."""
        return self.hypothesis.at

    @property
    def p_value(self) -> float:
        """How often chance alone would explain as much."""
        return math.exp(self.log_p)

    @property
    def sigma(self) -> float:
        """The standard deviation of the first coefficient."""
        return math.sqrt(self.covariance[0, 0])


# --- the search ---


class CauseModel(Protocol):
    """A fitted model whose residuals are searched; it is never changed, `accept` gives another."""

    def hypotheses(self) -> Iterable[Hypothesis]:
        """What is suspected and not in the model."""

    def tested(self, hypotheses: Sequence[Hypothesis]) -> Sequence[Tested]:
        """The test of each hypothesis."""

    def matters(self, test: Tested) -> bool:
        """Whether the effect is larger than what careful people have."""

    def accept(self, test: Tested) -> Any:
        """The model with a cause taken in and fitted again; None where that breaks its promise."""


M = TypeVar("M", bound=CauseModel)


@dataclass(frozen=True, eq=False)
class Accepted(Generic[M]):
    """A cause that was taken in, the models before and after, and the causes that rivalled it."""

    test: Tested
    before: M
    after: M
    rivals: tuple[Tested, ...]


@dataclass(eq=False)
class CauseSearch(Generic[M]):
    """The end of a search: the model at its start and end, and what happened between.

    tested: the last round, in which nothing was acceptable any more. refused: cause and place of
    hypotheses whose refit did not keep what their test had promised.
    """

    start: M
    model: M
    accepted: list[Accepted[M]] = field(default_factory=list)
    refused: set[tuple[str, int]] = field(default_factory=set)
    tested: Sequence[Tested] = ()

    def of(self, cause: str) -> list[Accepted[M]]:
        """The accepted steps of one cause, in order."""
        return [step for step in self.accepted if step.test.cause == cause]


def search(model: M, level: float) -> CauseSearch[M]:
    """The causes that a model's residuals speak for, the strongest first.

    level: the p-value from which on a hypothesis is no chance.
    """
    found = CauseSearch(model, model)
    for _ in range(SEARCH_ROUNDS):
        open_ones = [h for h in found.model.hypotheses() if (h.cause, h.at) not in found.refused]
        found.tested = found.model.tested(open_ones)
        significant = [t for t in found.tested if t.log_p < math.log(level) and t.gain > 0]
        significant = [t for t in significant if found.model.matters(t)]
        if not significant:
            break
        best = max(significant, key=lambda test: test.strength)
        after = found.model.accept(best)
        if after is None:
            found.refused.add((best.cause, best.at))
            continue
        rivals = _rivals(best, significant)
        found.accepted.append(Accepted(best, found.model, after, rivals))
        found.model = after
    return found


def _rivals(best: Tested, tests: Iterable[Tested]) -> tuple[Tested, ...]:
    """The strongest test of each other cause that explains nearly as much as the best."""
    strongest: dict[str, Tested] = {}
    for test in sorted(tests, key=lambda test: test.strength):
        if test.cause != best.cause and test.strength > best.strength - RIVAL_GAIN:
            strongest[test.cause] = test
    return tuple(strongest.values())


# --- the test where the size of the noise is unknown ---


class Projection:
    """Residuals without what a model's columns imitate, and what hypotheses explain of them.

    residuals (m,) and shared (m, g): of the whole model. own: columns (r, w) with their rows (r,),
    disjoint from block to block, for what each view or pose has of its own. weights (m,): one over
    the noise's sigma, all alike unless given.
    """

    def __init__(
        self,
        residuals: Floats,
        shared: Floats,
        own: Iterable[tuple[NDArray[np.intp], Floats]] = (),
        weights: Floats | None = None,
    ) -> None:
        self.weights = np.ones(len(residuals)) if weights is None else weights
        self._own = [(rows, _basis(block * self.weights[rows, None])) for rows, block in own]
        self._shared = np.zeros((len(residuals), 0))
        self._shared = _basis(self.remove(shared * self.weights[:, None]))
        self.rank = sum(q.shape[1] for _, q in self._own) + self._shared.shape[1]
        self.residuals = self.remove((residuals * self.weights)[:, None])[:, 0]

    def remove(self, columns: Floats) -> Floats:
        """Columns (m, k) without what the model imitates."""
        left = columns.copy()
        for rows, q in self._own:
            left[rows] -= q @ (q.T @ left[rows])
        return left - self._shared @ (self._shared.T @ left)

    def explains(self, hypothesis: Hypothesis) -> Explained:
        """What a hypothesis explains of the residuals.

        Directions in which an effect of its typical size would stay below the noise are not
        tested: they would only dilute the test.
        """
        columns = hypothesis.dense(len(self.weights)) * self.weights[:, None]
        left = self.remove(columns)
        values, vectors = np.linalg.eigh(left.T @ left)
        well = values > IMITATED * np.einsum("ij,ij->j", columns, columns).max(initial=1e-300)
        values, vectors = values[well], vectors[:, well]
        seen = vectors.T @ (left.T @ self.residuals) / np.sqrt(values)
        total, dof = float(self.residuals @ self.residuals), len(self.residuals) - self.rank
        visible = values * hypothesis.typical**2 > total / dof
        directions = vectors[:, visible] / np.sqrt(values[visible])
        coefficients, size = directions @ seen[visible], int(visible.sum())
        after = self.residuals - left @ coefficients
        squares = float((seen[visible] ** 2).sum())
        rest = max(total - squares, 1e-300) / max(dof - size, 1)
        log_p = _log_f_tail(squares / max(size, 1) / rest, size, dof - size)
        log_p = min(log_p + math.log(hypothesis.tried), 0.0)
        width, gain = likeliest_size(values, seen, total, dof)
        covariance = rest * directions @ directions.T
        return Explained(
            hypothesis, gain, log_p, gain, width, coefficients, covariance, rest, dof - size, after
        )


@dataclass(frozen=True, eq=False)
class Explained(Tested):
    """`Tested` by the F-test, of explained squares a column over the rest a degree of freedom.

    Size and strength are by restricted likelihood. rest: the variance of what is left, per degree
    of freedom; dof: of those. after (m,): the residuals without what the hypothesis explains.
    """

    rest: float
    dof: int
    after: Floats


def _log_f_tail(ratio: float, above: int, below: int) -> float:
    """log P(F > ratio); 0 where no degrees of freedom are left."""
    from scipy.stats import f

    if above < 1 or below < 1:
        return 0.0
    return math.log(max(float(f.sf(ratio, above, below)), 1e-300))


def likeliest_size(strength: Floats, seen: Floats, total: float, dof: int) -> tuple[float, float]:
    """The most likely rms of the coefficients, and twice the log-likelihood that it gains.

    strength (k,): squares that a coefficient of 1 along a direction of a hypothesis would add; seen
    (k,): the residuals along it. total: all squares; dof: their degrees of freedom. Coefficients
    are taken as drawn from a normal distribution of that width (restricted maximum likelihood):
    then three columns and ninety are compared on equal terms, one width each.
    """
    if not len(strength):
        return 0.0, 0.0
    ratios = np.concatenate([[0.0], np.geomspace(1e-3, 1e8, 200) / strength.max()])
    spread = 1.0 + ratios[:, None] * strength
    squares = total - (seen**2 * (1.0 - 1.0 / spread)).sum(axis=1)
    squares = np.maximum(squares, 1e-300)
    deviance = dof * np.log(squares / total) + np.log(spread).sum(axis=1)
    best = int(deviance.argmin())
    return float(np.sqrt(ratios[best] * squares[best] / dof)), float(-deviance[best])


def _basis(columns: Floats) -> Floats:
    """An orthonormal basis of the columns, without those that the others imitate."""
    from scipy.linalg import qr

    size = np.linalg.norm(columns, axis=0)
    q, r, _ = qr(columns / np.where(size > 0, size, 1.0), mode="economic", pivoting=True)
    left = np.abs(np.diag(r))
    return np.asarray(q[:, left > IMITATED * left.max(initial=0.0)])


# --- the test where the covariance of the noise is a model ---


def likelihood_ratios(
    residuals: Floats,
    columns: Floats,
    hypotheses: Sequence[Hypothesis],
    covariances: Iterable[Floats],
) -> list[Tested]:
    """The likelihood-ratio test of each hypothesis, with the covariance that is likeliest under it.

    residuals (m,), columns (m, g): of the model. covariances (m, m): what the residuals' may be;
    each hypothesis chooses its own, as the model without any does, so that no cause passes for a
    larger noise or the other way round.
    """
    plain = np.inf
    found = [(np.inf, np.zeros(0), np.zeros((0, 0)))] * len(hypotheses)
    for covariance in covariances:
        root = np.linalg.cholesky(covariance)
        inverse_root = np.linalg.inv(root)
        information = inverse_root.T @ inverse_root
        weighted = information @ columns
        normal = np.linalg.pinv(columns.T @ weighted, rcond=1e-12, hermitian=True)
        left = information - weighted @ normal @ weighted.T
        seen = left @ residuals
        deviance = 2.0 * float(np.log(np.diag(root)).sum()) + float(residuals @ seen)
        plain = min(plain, deviance)
        for number, hypothesis in enumerate(hypotheses):
            rows, block = hypothesis.rows, hypothesis.columns
            right = block.T @ seen[rows]
            inner = block.T @ left[rows][:, rows] @ block
            own = np.asarray(np.linalg.pinv(inner, rcond=1e-9, hermitian=True), np.float64)
            now = deviance - float(right @ own @ right)
            if now < found[number][0]:
                found[number] = now, own @ right, own
    tests = []
    for hypothesis, (deviance, coefficients, own) in zip(hypotheses, found, strict=True):
        gain = plain - deviance
        log_p = log_chi2_tail(max(gain, 0.0), len(coefficients)) + math.log(hypothesis.tried)
        log_p, size = min(log_p, 0.0), float(np.sqrt(np.mean(coefficients**2)))
        tests.append(Tested(hypothesis, gain, log_p, -2 * log_p, size, coefficients, own))
    return tests


def log_chi2_tail(x: float, dof: int) -> float:
    """log P(chi2 > x), beyond what a float holds by its asymptote: causes compete out there."""
    from scipy.special import chdtrc, gammaln

    tail = float(chdtrc(dof, x))
    if tail > 1e-290:
        return math.log(tail)
    return float((dof / 2 - 1) * np.log(x / 2) - x / 2 - gammaln(dof / 2))


# --- words ---


@dataclass(frozen=True)
class DiagnosisTexts:
    """What a room's diagnosis says, from `findings.toml`: templates with names for the figures.

    findings: `says`, `evidence` and `remedy` of each. looked_for: one phrase a cause. not_tested:
    one sentence for each reason why something could not be tested. words: what else the room says.

    >>> texts = DiagnosisTexts.of("intrinsics")
    >>> texts.finding("focus_drift", drift=1.25, normal=0.2, took="").evidence[:30]
    'focal lengths differ by 1.2 % '
    """

    findings: dict[str, dict[str, str]]
    looked_for: Sequence[str]
    not_tested: dict[str, str]
    words: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, room: str) -> DiagnosisTexts:
        """The texts of one room, "intrinsics" or "hand_eye"."""
        tables = tomllib.loads(Path(__file__).with_name("findings.toml").read_text("utf-8"))
        findings = {}
        for key, entry in tables[room].pop("findings").items():
            name = entry.get("name", key)
            findings[key] = {"name": name, **tables["shared"].get(name, {}), **entry}
        return cls(findings, **tables[room])

    def finding(self, key: str, p_value: float | None = None, /, **figures: Any) -> Finding:
        """A finding with its figures."""
        entry = self.findings[key]
        says, evidence, remedy = (
            entry[part].format(**figures) for part in ("says", "evidence", "remedy")
        )
        return Finding(entry["name"], says, evidence, remedy, p_value)
