"""What is wrong in the two papers as printed, each with a proof or a counter-example that runs.

    python -m experiments.errata [--out FOLDER] [--json FILE]

Paper S: Mao et al. 2020, separable least squares.  Paper M: Mao et al. 2019, minimax.  A
counter-example gives three numbers: what the printed formula says, what the mended one says, and
the truth, found in another way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.conditions import PAPER_M_TABLE_3
from experiments.pseudo_inverse import (
    arm_points_and_axes,
    joint_jacobian_and_error,
    pseudo_inverse_step,
    separable_jacobian_and_error,
)
from experiments.sweep import Study, study_options
from minimax_cal.core.arrays import Array
from minimax_cal.core.files import write_file_atomically
from minimax_cal.core.tables import Table
from minimax_cal.robots.robot import load_robot

PrintedMendedTruth = tuple[float, float, float]  # printed, mended, truth


@dataclass(frozen=True)
class Erratum:
    """where: in which paper.  printed, mended: in words.  why: the proof or the example in words.

    example: computes the three numbers.
    """

    where: str
    printed: str
    mended: str
    why: str
    example: Callable[[], PrintedMendedTruth]


def draw_arm_and_points() -> tuple[Array, Array, Array]:
    """Parameters (39,) [m, rad], joints (20, 6) [rad] and measured points (60,) [m] of an arm."""
    rng = np.random.default_rng(0)
    at = np.concatenate([load_robot("irb2600").mdh.T.ravel(), np.zeros(9)])
    true = at + 0.02 * rng.normal(size=at.size)
    q = rng.uniform(-1.0, 1.0, (20, 6))
    points, *_ = arm_points_and_axes(true, q)
    return at + 0.02 * rng.normal(size=at.size), q, points.ravel()


def derivative_at_zero(function: Callable[[float], float]) -> float:
    """Derivative at 0 by central differences with Richardson's extrapolation."""
    wide, narrow = ((function(h) - function(-h)) / (2.0 * h) for h in (2e-4, 1e-4))
    return (4.0 * narrow - wide) / 3.0


# ---- paper S -----------------------------------------------------------------------------------


def eq_17_example() -> PrintedMendedTruth:
    """Eq. 17, its first line and its second, for residuals of 3 and 4."""
    c = np.array([3.0, 4.0])
    return 0.5 * float(np.linalg.norm(c)), 0.5 * float(c @ c), 0.5 * sum(x**2 for x in (3.0, 4.0))


def eq_7_rotation_example() -> PrintedMendedTruth:
    """Entry (1, 1) of R_i at theta = 0.3, alpha = 0.5, beta = 0.2 with and without beta."""
    t, a, b = 0.3, 0.5, 0.2
    at = np.zeros(14)  # one joint
    at[2], at[3], at[4], at[11] = t, a, b, 1.0  # the target on the x axis
    point, *_ = arm_points_and_axes(at, np.zeros((1, 1)))
    right = np.cos(t) * np.cos(b) - np.sin(t) * np.sin(a) * np.sin(b)
    return float(np.cos(t)), float(right), float(point[0, 0])


def eq_22_columns_example() -> PrintedMendedTruth:
    """How many columns the Jacobian of eq. 22 has."""
    at, q, y = draw_arm_and_points()
    _, rows, _ = separable_jacobian_and_error(at, q, y)
    lengths, angles = 2 * 6 + 6, 3 * 6 + 3
    return float(lengths), float(angles), float(len(rows))


def stale_projector_example() -> PrintedMendedTruth:
    """RMS after one step of Algorithm 1, with the projector before and after it [mm]."""
    at, q, y = draw_arm_and_points()
    best, rows, c = separable_jacobian_and_error(at, q, y)
    after = best.copy()
    step = pseudo_inverse_step(rows @ rows.T, rows @ c)
    after[12:30] += step[:18]
    after[33:36] += step[18:]
    reached, _, mended = separable_jacobian_and_error(after, q, y)
    points, *_ = arm_points_and_axes(reached, q)
    true = np.linalg.norm(y - points.ravel())
    size = 1e3 / np.sqrt(len(q))
    return (
        size * float(np.linalg.norm(c)),
        size * float(np.linalg.norm(mended)),
        size * float(true),
    )


# ---- paper M -----------------------------------------------------------------------------------


def gradient_sign_example() -> PrintedMendedTruth:
    """Derivative of F along a direction, by 2 J'r with both signs of r."""
    at, q, y = draw_arm_and_points()
    along = np.random.default_rng(1).normal(size=at.size)
    rows, e = joint_jacobian_and_error(at, q, y)  # e = y_m - f

    def F(t: float) -> float:
        points, *_ = arm_points_and_axes(at + t * along, q)
        return float(((points.ravel() - y) ** 2).sum())

    return 2.0 * float(along @ rows @ e), 2.0 * float(along @ rows @ -e), derivative_at_zero(F)


def distance_tolerance_example() -> PrintedMendedTruth:
    """c of a distance off by 0.05 mm under eps = 0.01 mm^2, which allows 0.1 mm [mm^2]."""
    off, eps = 0.05, 0.01
    return off**2, off**2 - eps, (abs(off) - np.sqrt(eps)) * (abs(off) + np.sqrt(eps))


RESTRICTION_FUNCTION_VALUES, RESTRICTION_SLOPES = (
    np.array([1.0, 0.99]),
    np.array([1.0, 0.5]),
)  # two functions and slopes, H = 1


def active_function_restriction_example() -> PrintedMendedTruth:
    """The step for two linear functions: with the active one fixed, and of the epigraph QP."""
    fixed = max(
        -RESTRICTION_SLOPES[0],
        (RESTRICTION_FUNCTION_VALUES[1] - RESTRICTION_FUNCTION_VALUES[0])
        / (RESTRICTION_SLOPES[0] - RESTRICTION_SLOPES[1]),
    )
    epigraph = -RESTRICTION_SLOPES[1]  # where the second is the larger one, which it is there
    grid = np.linspace(-2.0, 1.0, 300_001)
    model = 0.5 * grid**2 + (
        RESTRICTION_FUNCTION_VALUES[:, None] + np.outer(RESTRICTION_SLOPES, grid)
    ).max(axis=0)
    return float(fixed), float(epigraph), float(grid[model.argmin()])


def positive_part_by_entry_example() -> PrintedMendedTruth:
    """min x^2 / 2 with 1 - x <= 0 by the KKT conditions, (G')+ entry by entry and row by row."""
    G, multiplier = -1.0, 1.0
    by_entry = abs(max(G, 0.0)) * multiplier
    by_row = -G * multiplier  # the row is active: it counts whole
    return by_entry, by_row, 1.0


def step_sum_example() -> PrintedMendedTruth:
    """How far the iterates of min |x - 10| get with gamma_p = 2^-p, and with 1/p."""
    out = []
    for gamma in (2.0 ** -np.arange(1.0, 1001.0), 1.0 / np.arange(1.0, 100_001.0)):
        x = 0.0
        for step in gamma:
            x += step * np.sign(10.0 - x)
        out.append(float(x))
    return out[0], out[1], 10.0


def eq_31_factor_example() -> PrintedMendedTruth:
    """Eq. 31 for Q = x^2 / 2, y = 1, z = 0, alpha = beta = 1/2."""
    return -0.25, -0.125, 0.5 * 0.5**2 - 0.5 * (0.5 * 1.0**2) - 0.5 * 0.0


def secant_condition_example() -> PrintedMendedTruth:
    """|H s - q| after the update: divided by s's and by q's; it is to be none."""
    rng = np.random.default_rng(2)
    s = rng.normal(size=4)
    A = rng.normal(size=(4, 4))
    q = (A @ A.T + np.eye(4)) @ s
    out = []
    for divisor in (s @ s, q @ s):
        H = np.eye(4) + np.outer(q, q) / divisor - np.outer(s, s) / (s @ s)
        out.append(float(np.linalg.norm(H @ s - q)))
    return out[0], out[1], 0.0


def negative_curvature_example() -> PrintedMendedTruth:
    """H after s = 1, q = -1 from H = 1: as printed, damped by Powell; above 0 it is to be."""
    s, q, H = 1.0, -1.0, 1.0
    printed = H + q * q / (q * s) - H
    share = 0.8 * s * H * s / (s * H * s - s * q)
    damped = share * q + (1.0 - share) * H * s
    return printed, H + damped**2 / (damped * s) - H, 0.2


def full_step_example() -> PrintedMendedTruth:
    """F = 10 x^2 at x = 1 after the step of H = 1: whole, and the share that falls most."""
    step = -20.0
    return 10.0 * (1.0 + step) ** 2, 10.0 * (1.0 + 0.05 * step) ** 2, 0.0


@dataclass(frozen=True)
class WithdrawnErratum:
    """What was listed as a slip and is none.  why: in words.  numbers: that show it."""

    where: str
    listed: str
    why: str
    numbers: Callable[[], tuple[float, ...]]


def subgradient_limits_from_two_starts() -> tuple[float, ...]:
    """Where min x^2 / 2 with 1 - x <= 0 ends by eq. 22-24 as printed, from lambda = 5 and 0."""
    out = []
    for z in (5.0, 0.0):
        x = 0.0
        for k in range(1, 20_001):
            violation = max(1.0 - x, 0.0)
            slope_x = x - (z if violation > 0.0 else 0.0)
            size = np.hypot(slope_x, violation)
            if size > 0.0:
                x, z = x - slope_x / (k * size), z + violation / (k * size)
        out.append(x)
    return tuple(out)


def rmse_reduction_in_table_3() -> tuple[float, ...]:
    """By how much RMSE(phi) falls from nominal to minimax in Table 3 [%]; the text says 67.34."""
    before, after = PAPER_M_TABLE_3["nominal"], PAPER_M_TABLE_3["minimax"]
    return (100.0 * (1.0 - after[3] / before[3]),)


def orientation_rmse_reduction() -> tuple[float, ...]:
    """By how much the RMSE of orientation falls, 0.005015 to 0.002176 rad [%]."""
    return (100.0 * (1.0 - 0.002176 / 0.005015),)


ERRATA = (
    Erratum(
        "S eq. 17, 19, 20, Algorithms 1 and 2",
        "½‖·‖₂",
        "½‖·‖₂²",
        "Residuals 3 and 4: the first line of eq. 17 is half the sum of squares, the second not. "
        "Steps 22 and 23 are those of the square.",
        eq_17_example,
    ),
    Erratum(
        "S after eq. 8",
        "R_i is a function of α_i and θ_i",
        "of α_i, θ_i and β_i, as eq. 7 has it",
        "Entry (1, 1) at θ = 0.3, α = 0.5, β = 0.2, without β and with it.",
        eq_7_rotation_example,
    ),
    Erratum(
        "S eq. 22",
        "J(ω) has a columns, the number of lengths",
        "b columns, the number of angles (eq. 12)",
        "J is the derivative by ω. Six joints: a = 18, b = 21.",
        eq_22_columns_example,
    ),
    Erratum(
        "S Algorithm 1, last line",
        "c₂(ω) from the projector at ω(κ)",
        "at ω(κ+1)",
        "RMS in mm after one step: the printed line repeats the one before the step.",
        stale_projector_example,
    ),
    Erratum(
        "M Algorithm 1, first lines",
        "r = y_m − f with ∇F = 2Jᵀr",
        "r = f − y_m, as under eq. 26",
        "Derivative of F along a direction, against finite differences: the sign is wrong.",
        gradient_sign_example,
    ),
    Erratum(
        "M Algorithm 1",
        "c_l = rtᵀrt",
        "c_l = rtᵀrt − ε, as eq. 9; ε is in mm²",
        "A distance off by 0.05 mm under ε = 0.01 mm², which allows √ε = 0.1 mm: allowed by eq. 9, "
        "a violation in Algorithm 1.",
        distance_tolerance_example,
    ),
    Erratum(
        "M eq. 20, 22, 25, 27",
        "one active index I instead of the variable D_Δxφ of eq. 13, 18",
        "the epigraph QP: min ½ΔᵀHΔ + v with F_i + ∇F_iᵀΔ − φ ≤ v",
        "Rows (∇F_i − ∇F_I)ᵀΔ + F_i − φ ≤ 0 force F_I to stay the largest: a restriction. "
        "F = (1, 0.99), slopes (1, 0.5), H = 1: the steps, and the best on a fine grid. "
        "Algorithm 1 comes near the optimum all the same (`experiments algorithm_1`).",
        active_function_restriction_example,
    ),
    Erratum(
        "M eq. 20-23 with eq. 21",
        "(Gᵀ)⁺ entry by entry",
        "the rows that are violated, whole",
        "min ½x² with 1 − x ≤ 0: G = −1, so that (Gᵀ)⁺ = 0 and stationarity gives x = 0.",
        positive_part_by_entry_example,
    ),
    Erratum(
        "M after eq. 31",
        "Σγ² < ∞",
        "Σγ² < ∞ and Σγ = ∞",
        "Steps have length γ: no iterate gets farther than Σγ. min |x − 10| from 0 with γ = 2⁻ᵖ "
        "and with 1/p.",
        step_sum_example,
    ),
    Erratum(
        "M eq. 31",
        "−αβ(y − z)ᵀH(y − z)",
        "−½αβ(y − z)ᵀH(y − z)",
        "Q = ½x², y = 1, z = 0, α = β = ½.",
        eq_31_factor_example,
    ),
    Erratum(
        "M Algorithm 1, BFGS, in one of the two texts we have",
        "qqᵀ / (sᵀs)",
        "qqᵀ / (qᵀs)",
        "|Hs − q| after the update must be 0.",
        secant_condition_example,
    ),
    Erratum(
        "M Algorithm 1, BFGS, and eq. 13, 31",
        "H is positive definite",
        "only where qᵀs > 0, which full steps do not ensure; damped by Powell it is",
        "s = 1, q = −1, H = 1.",
        negative_curvature_example,
    ),
    Erratum(
        "M Algorithm 1, States updating",
        "x(k+1) = x(k) + Δx(k)",
        "with a line search: eq. 14 promises descent for a small share of the step only",
        "F = 10x² at 1 with H = 1: F is 10 before; after the whole step, after a twentieth, and at "
        "the minimum. On arms: `experiments algorithm_1`.",
        full_step_example,
    ),
)
MINOR_SLIPS = (
    "S, section 3.1 calls Gauss-Newton NLGS and SNLGS; the tables NLGN and SNLGN.",
    "S eq. 3, entry (1, 2) prints φ for Φ.",
    "M Algorithm 1 counts j = 1:g, the parameters, where the loop is over the three reflectors i.",
    "M Algorithm 1 takes λ(k+1) and λ(k) in q; the same multipliers in both gradients are usual.",
    "M Table 4 lists the IRB 2600 as another robot, with RMSE 0.3323 mm; Table 3 has 0.372 mm.",
)
DELIBERATE_DIFFERENCES = (
    "M eq. 32, min F₁ + F₂ + F₃ subject to c(x) ≤ 0, from which Algorithm 1 starts: `calibrate` "
    "fits it without c(x) ≤ 0, which the minimax then keeps. `experiments warm_start` fits both: "
    "[side by side](papers.md#what-to-take-from-it).",
)
WITHDRAWN_ERRATA = (
    WithdrawnErratum(
        "M eq. 23, 24", "λ never falls as printed, so it cannot become the multiplier",
        "The printed iteration is the primal-dual subgradient method on (C + GΔ)⁺, whose "
        "multipliers need not be those of C: it converges in x from λ above and below the "
        "multiplier, 1. min ½x² with 1 − x ≤ 0 ends, from λ = 5 and from 0, at x =",
        subgradient_limits_from_two_starts,
    ),
    WithdrawnErratum(
        "M abstract, IV-B, V", "67.34 % less in position contradicts Table 3",
        "The paper does not say of what it is a percentage, so it contradicts nothing. No two "
        "entries of a column of Table 3 give it, nor 23.48 or 14.36 %; RMSE(φ) there falls by, in "
        "%:",
        rmse_reduction_in_table_3,
    ),
    WithdrawnErratum(
        "M IV-B", "32.76 % less in orientation contradicts the RMSE beside it",
        "32.76 % is of the orientation accuracy of eq. 5 over the poses, and the RMSE is named "
        "after it as another measure, which falls by, in %:",
        orientation_rmse_reduction,
    ),
)  # fmt: skip


def is_confirmed_by_example(erratum: Erratum) -> bool:
    """Whether the mended formula gives the truth, to 0.1 %, and the printed one does not."""
    printed, mended, truth = erratum.example()
    near = 1e-3 * max(abs(truth), abs(printed))
    return abs(mended - truth) <= near < abs(printed - truth)


def format_errata_markdown() -> str:
    """The list in Markdown, as docs/errata.md has it."""
    lines = []
    for number, one in enumerate(ERRATA, start=1):
        # what is nothing but rounding differs between machines
        printed, mended, truth = (f"{round(value, 12):.5g}" for value in one.example())
        lines += [
            f"{number}. **{one.where}.** Printed: {one.printed}. Right: {one.mended}.  ",
            f"   {one.why} Printed gives {printed}, mended {mended}; truth {truth}.",
        ]
    lines += ["", "Slips without consequence:", "", *(f"- {x}" for x in MINOR_SLIPS)]
    lines += [
        "",
        "Where what we compute is not the paper's letter:",
        "",
        *(f"- {x}" for x in DELIBERATE_DIFFERENCES),
    ]
    lines += ["", "Listed here before, and wrongly so, for these are none:", ""]
    for none in WITHDRAWN_ERRATA:
        numbers = ", ".join(f"{value:.7g}" for value in none.numbers())
        lines.append(f"- **{none.where}.** We said: {none.listed}. {none.why} {numbers}.")
    return "\n".join([*lines, ""])


def build_errata_table() -> Table:
    """The numbers of the counter-examples."""
    return Table.from_rows(
        "errata: what the printed formula gives, the mended one, and the truth",
        ((one.where, *one.example()) for one in ERRATA),
        "where | printed .5g | mended .5g | truth .5g",
    )


def run_all_cases(_: Study) -> Sequence[Erratum]:
    """All of them."""
    return ERRATA


def save_results(study: Study, _: Sequence[Erratum]) -> None:
    """The numbers, and the list."""
    study.save([build_errata_table()], {"rows": build_errata_table().to_records()})
    write_file_atomically(study.out / "list.md", format_errata_markdown())


@study_options("errata")
def main(study: Study) -> None:
    """Errata of both papers, each with its counter-example."""
    save_results(study, run_all_cases(study))
