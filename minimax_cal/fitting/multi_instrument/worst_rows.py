"""The minimax of rows: the worst part, as a wire or a target, as good as it can be made.

f_i is the mean square of the numbers of one part, with the share of what is known of the arm that a
mean square has.  Values are divided by their size at the least squares, from which the search
starts, and parameters scaled to unit curvature.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Self

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.display_text import format_counts_largest_first
from minimax_cal.core.record_fields import SEPARATE_FIELD_FORMAT, FieldFormat, derived_field
from minimax_cal.core.tables import Table
from minimax_cal.fitting.cell_fit import FIT_QP_TOLERANCE, MIN_TARGET_WEIGHT
from minimax_cal.fitting.multi_instrument.instrument_stack import InstrumentLeastSquares
from minimax_cal.fitting.options import QpSolver, build_qp_solver
from minimax_cal.modelling.parameters import ParameterValues
from minimax_cal.solvers import minimax
from minimax_cal.solvers.linearisation import FunctionsAndConstraints, Kkt, Linearisation
from minimax_cal.solvers.minimax import Optimum
from minimax_cal.solvers.status import Status

MAX_ACTIVE_ROW_GAP = 1e-6  # relative to the largest: functions so near to it decide
NO_CONSTRAINT_BOUNDS: Array = np.zeros(0)


@dataclass(frozen=True, eq=False)
class RowMinimax:
    """min over the state of the largest f_i of groups of rows, as `solvers.minimax` wants it.

    member: (k, r) how much each row's square counts in each f_i; known: the same of what is known
    of the arm.  scale: (free,) divides a step's entries.  size: divides the f_i.
    """

    problem: InstrumentLeastSquares
    member: Array
    known: float
    scale: Array
    size: float = 1.0

    @property
    def lower(self) -> Array:
        """There is no constraint."""
        return NO_CONSTRAINT_BOUNDS

    upper = lower

    @staticmethod
    def scale_at_start(
        problem: InstrumentLeastSquares, of: Array, numbers: int, start: ParameterValues
    ) -> RowMinimax:
        """Mean squares, scaled at a start.

        of: (r,) which function each row is of, -1 for none, -2 for rows that all have their share
        of.  numbers: rows behind one square, as two of a pixel.
        """
        member = (of == np.arange(of.max() + 1)[:, None]).astype(float)
        member *= numbers / member.sum(axis=1, keepdims=True)
        known = numbers / np.count_nonzero(of >= 0)
        member[:, of == -2] = known
        plain = RowMinimax(problem, member, known, np.ones(int(problem.active.sum())))
        here = plain.linearise(start)
        size = max(float(here.f.max()), 1e-18)
        mean = here.curvature(np.full(len(here.f), 1.0 / len(here.f)))
        return replace(plain, scale=np.sqrt(np.maximum(np.diag(mean) / size, 1e-30)), size=size)

    def evaluate(self, x: ParameterValues) -> FunctionsAndConstraints:
        """f, and no constraint."""
        error, _ = self.problem.stack.rows(x, np.zeros(len(self.problem.active), dtype=bool))
        off, weight = self.prior_deviation_and_weight(x)
        f = self.member @ error**2 + self.known * float(weight @ off**2)
        return FunctionsAndConstraints(f / self.size, NO_CONSTRAINT_BOUNDS)

    def linearise(self, x: ParameterValues) -> Linearisation:
        """f and its derivatives; the curvature is Gauss-Newton's 2 J'J."""
        error, jacobian = self.problem.stack.rows(x, self.problem.active)
        off, weight = self.prior_deviation_and_weight(x)
        f = self.member @ error**2 + self.known * float(weight @ off**2)
        slope = -2.0 * ((self.member * error) @ jacobian.T + self.known * weight * off)
        divisor = self.size * np.outer(self.scale, self.scale)

        def curvature(share: Array) -> Array:
            gram = (jacobian * (share @ self.member)) @ jacobian.T
            return np.asarray(2.0 * (gram + self.known * share.sum() * np.diag(weight)) / divisor)

        none = np.zeros((0, len(self.scale)))
        return Linearisation(
            f / self.size, slope / (self.size * self.scale), NO_CONSTRAINT_BOUNDS, none, curvature
        )

    def step(self, x: ParameterValues, d: Array) -> ParameterValues:
        """The state moved by a scaled step in the free parameters."""
        return self.problem.step(x, d / self.scale)

    def prior_deviation_and_weight(self, x: ParameterValues) -> tuple[Array, Array]:
        """(free,) how far the parameters are from what is known of them, and the weight of that."""
        problem, active = self.problem, self.problem.active
        return problem.known.deviation_from_mean(x, len(active))[active], np.diag(problem.prior)


@dataclass(frozen=True, eq=False)
class WorstRows:
    """What a minimax rests on.

    functions: k names of parts.  size: (k,) their RMS.  multiplier: (k,) how much each counts, of
    sum one.  before: the largest RMS of the sum.
    """

    UNIT: ClassVar[tuple[str, float]] = ("mm", 1e3)

    functions: tuple[str, ...]
    size: Annotated[Array, FieldFormat(key="rms_mm", scale=1e3)]
    multiplier: Annotated[Array, FieldFormat(key="multipliers")]
    before: Annotated[float, FieldFormat(key="sum_largest_rms_mm", scale=1e3)]
    kkt: Kkt
    answered: Annotated[Mapping[str, int], SEPARATE_FIELD_FORMAT] = field(default_factory=dict)

    @classmethod
    def from_optimum(
        cls, names: Sequence[str], before: Array, after: Array, best: Optimum[ParameterValues]
    ) -> Self:
        """Of an optimum.  before, after: (k,) RMS by part."""
        largest = float(before.max())
        return cls(tuple(names), after, best.mu, largest, best.kkt, best.answered)

    @derived_field()
    def active(self) -> tuple[str, ...]:
        """The functions that decide."""
        near = self.size**2 >= self.size.max() ** 2 * (1.0 - MAX_ACTIVE_ROW_GAP)
        return tuple(name for name, held in zip(self.functions, near, strict=True) if held)

    def sentence(self) -> str:
        """For people."""
        unit, scale = self.UNIT
        return (
            f"Worst of {len(self.functions)} in training: {scale * self.before:.4f} {unit} RMS -> "
            f"{scale * self.size.max():.4f} {unit}, held by {len(self.active)}; QPs: "
            f"{format_counts_largest_first(self.answered)}."
        )

    def table(self) -> Table:
        """Every function, the heaviest first."""
        unit, scale = self.UNIT
        every = zip(self.functions, scale * self.size, self.multiplier, strict=True)
        rows = sorted(every, key=lambda row: -row[2])
        columns = f"target | RMS {unit} .4f | multiplier .3f"
        return Table.from_rows("what decides the minimax", rows, columns)


@dataclass(frozen=True, eq=False)
class WorstPixels(WorstRows):
    """What the minimax rests on: targets in a camera, or cameras.  size, before: [px]."""

    UNIT: ClassVar[tuple[str, float]] = ("px", 1.0)

    size: Annotated[Array, FieldFormat(key="rms_px")]
    before: Annotated[float, FieldFormat(key="sum_largest_rms_px")]


@dataclass(frozen=True, eq=False)
class WorstRowsOverNoise(WorstRows):
    """What the minimax rests on where rows are in other units than metres.

    size, before: errors over sigma, the noise of their file.
    """

    UNIT: ClassVar[tuple[str, float]] = ("sigma", 1.0)

    size: Annotated[Array, FieldFormat(key="rms_over_noise")]
    before: Annotated[float, FieldFormat(key="sum_largest_rms_over_noise")]


def minimise_largest_mean_square(
    problem: InstrumentLeastSquares,
    part_indices: Array,
    numbers_per_error: int,
    start: ParameterValues,
    qp: QpSolver,
    rounding_error: float,
) -> tuple[Optimum[ParameterValues], Array, tuple[str, ...]]:
    """The minimax from a fit of the sum; (r,) how much each row counts in it; notices.

    part_indices, numbers_per_error: as of `RowMinimax.scale_at_start`.  rounding_error: a root of f
    below is of numbers that were computed, not measured.  Raises OptionError for an unknown qp.
    """
    rows = RowMinimax.scale_at_start(problem, part_indices, numbers_per_error, start)
    solver, notices = build_qp_solver(qp, FIT_QP_TOLERANCE)
    best: Optimum[ParameterValues] = minimax.solve(rows, start, solver)
    if best.status is Status.STALLED and best.value * rows.size < rounding_error**2:
        best = replace(best, status=Status.CONVERGED)
    counts = np.bincount(part_indices[part_indices >= 0])
    heavy = np.maximum(best.mu, MIN_TARGET_WEIGHT) * counts.sum() / counts
    share = np.where(
        part_indices >= 0,
        heavy[np.maximum(part_indices, 0)],
        np.where(part_indices == -2, 1.0, 0.0),
    )
    return best, share, (*notices, *(f"QP: {note}" for note in best.notes))
