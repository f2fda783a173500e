"""From how far the four least-squares methods converge: paper S, Table 2 and Fig. 3.

    python -m experiments.convergence [--quick] [--base-angle RAD] [--out FOLDER] ...

The starts are those of `off_starts`, all 3969 of them.  The paper prints neither the true base nor
the sizes of its errors, nor its unit of length, nor the rule of its damping; here the base is
turned by --base-angle about a random axis, the errors are those of `Setting`, and damping is
Marquardt's.  Every method runs to the letter on the paper's parameters (all, redundant ones
included, pseudo-inverse) in millimetres, those without separation in metres too: there the unit
matters.  The library's separable methods run on the identifiable parameters.  Redundant parameters
amplify rounding, so that some starts run once more, moved by no more than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import click
import numpy as np

from experiments import sweep
from experiments.off_starts import (
    CAP,
    PAPER,
    SAME,
    Outcome,
    Setting,
    grid,
    jobs_of,
    least_cost,
    run,
)
from experiments.sweep import Study, study_options
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import plain
from minimax_cal.ground.tables import Cell, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VARIANTS = (  # parameters and unit, and the methods that run on them
    *(("all, mm", method) for method in PAPER),
    *(("all, m", method) for method in ("nlgn", "nllm")),
    *(("identifiable", method) for method in ("snlgn", "snllm")),
)
SPARSE = 21  # of the starts, each so many-th both ways with --quick: too few for a verdict
PAPERS_TABLE = {  # iterations, RMS mm, seconds, converged %, to the minimum %
    "nlgn": (144.15, 77.579, 5.933, 92.89, 74.35),
    "nllm": (4595.27, 1.493, 33.931, 68.98, 68.98),
    "snlgn": (13.94, 1.493, 0.927, 100.0, 100.0),
    "snllm": (26.90, 1.493, 1.874, 100.0, 100.0),
}


def outcomes(study: Study, setting: Setting, method: str, parameters: str, every: int,
             cap: int, moved: bool = False) -> list[Outcome]:  # fmt: skip
    """All starts of one method on one set of parameters."""
    jobs = jobs_of(setting, method, parameters, every, cap, moved)
    return study.sweep(run, jobs, f"{method}, {parameters}, every {every}")


@dataclass(frozen=True)
class Row:
    """One method on one set of parameters over the grid (all starts, in the grid's order)."""

    method: str
    parameters: str
    every: int
    iterations: Array
    rms_mm: Array
    converged: Array
    minimum: Array
    seconds: float

    def cells(self) -> tuple[Cell, ...]:
        """As a line of Table 2; averages leave out the starts that do not converge."""
        kept = self.converged
        return (
            self.method.upper(),
            self.parameters,
            len(kept),
            float(self.iterations[kept].mean()) if kept.any() else np.nan,
            float(self.rms_mm[kept].mean()) if kept.any() else np.nan,
            1e3 * self.seconds / len(kept),
            100.0 * float(kept.mean()),
            100.0 * float(self.minimum.mean()),
        )


def row_of(found: Sequence[Outcome], method: str, parameters: str, every: int, least: float,
           poses: int) -> Row:  # fmt: skip
    """The outcomes of all jobs as one row."""
    cost = np.concatenate([o.cost for o in found])
    converged = np.concatenate([o.converged for o in found]).astype(bool)
    return Row(
        method,
        parameters,
        every,
        np.concatenate([o.iterations for o in found]),
        1e3 * np.sqrt(cost / poses),
        converged,
        converged & (cost <= least * SAME),
        sum(o.seconds for o in found),
    )


HEADER = ("method", "parameters", "starts", "iterations", "RMS mm", "ms a start", "converged %",
          "to the minimum %")  # fmt: skip
FORMATS = ("", "", "d", ".2f", ".3f", ".2f", ".2f", ".2f")


def table_2(rows: Sequence[Row], setting: Setting) -> Table:
    """Paper S, Table 2: ours beside theirs."""
    theirs = [
        (f"{method.upper()} (paper)", "all", 3969, *values[:2], 1e3 * values[2], *values[3:])
        for method, values in PAPERS_TABLE.items()
    ]
    return Table(
        f"convergence from off starts (base turned by {setting.base_angle:g} rad, poses within "
        f"{setting.span:g} rad, noise {1e6 * setting.noise:g} um, errors {1e3 * setting.length:g} "
        f"mm and {1e3 * setting.angle:g} mrad, transmission {1e3 * setting.transmission:g} mrad)",
        HEADER,
        (*(row.cells() for row in rows), *theirs),
        FORMATS,
    )


@dataclass(frozen=True)
class Moved:
    """Shares of the starts of one method before and after they are moved by rounding [%].

    otherwise: which end otherwise: not converged, in the minimum, or converged elsewhere.
    """

    method: str
    starts: int
    converged: tuple[float, float]
    minimum: tuple[float, float]
    otherwise: float


def moved_of(row: Row, moved: Row) -> Moved:
    """A row beside the same starts moved, of which there may be fewer."""
    place = {pair: i for i, pair in enumerate(zip(*map(tuple, grid(row.every)), strict=True))}
    same = [place[pair] for pair in zip(*map(tuple, grid(moved.every)), strict=True)]
    differ = (row.converged[same] != moved.converged) | (row.minimum[same] != moved.minimum)
    return Moved(
        row.method,
        len(same),
        (100.0 * float(row.converged[same].mean()), 100.0 * float(moved.converged.mean())),
        (100.0 * float(row.minimum[same].mean()), 100.0 * float(moved.minimum.mean())),
        100.0 * float(differ.mean()),
    )


def moved_table(found: Sequence[Moved]) -> Table:
    """What rounding does to Table 2."""
    return Table(
        "all, mm: the same starts, each value moved by a unit of rounding (relative 2e-16) or none",
        ("method", "starts", "converged %", "moved %", "to the minimum %", "moved, %",
         "end otherwise %"),
        tuple((m.method.upper(), m.starts, *m.converged, *m.minimum, m.otherwise) for m in found),
        ("", "d", *(".2f",) * 5),
    )  # fmt: skip


def separable_shares(study: Study, setting: Setting, every: int) -> tuple[int, float, float]:
    """How many starts, and which share of them SNLGN and SNLLM bring to the minimum [%]."""
    least = least_cost(setting)
    rows = [
        row_of(
            outcomes(study, setting, method, "identifiable", every, 500),
            method,
            "identifiable",
            every,
            least,
            setting.poses,
        )
        for method in ("snlgn", "snllm")
    ]
    gauss_newton, levenberg = (100.0 * float(row.minimum.mean()) for row in rows)
    return len(rows[0].minimum), gauss_newton, levenberg


def span_table(study: Study, setting: Setting, every: int) -> Table:
    """Where the claim of global convergence ends: wider poses have other minima."""
    rows: list[tuple[Cell, ...]] = []
    for span in (1.0,) if study.quick else (0.5, 1.0, 1.5, 2.0, np.pi):
        for angle in (0.0, 0.5):
            wider = replace(setting, span=span, base_angle=angle)
            rows.append((span, angle, *separable_shares(study, wider, every)))
    return Table(
        "separable methods on the identifiable parameters, from the paper's start: share of starts "
        "that reach the minimum",
        ("poses within rad", "base turned rad", "starts", "SNLGN %", "SNLLM %"),
        tuple(rows),
        (".2f", ".1f", "d", ".1f", ".1f"),
    )


def seed_table(study: Study, setting: Setting, every: int) -> Table:
    """The separable methods on other simulated arms and poses: how safe the claim is."""
    rows: list[tuple[Cell, ...]] = []
    for seed in range(setting.seed, setting.seed + (2 if study.quick else 4)):
        for angle in (0.0, 0.5):
            other = replace(setting, seed=seed, base_angle=angle)
            rows.append((seed, angle, *separable_shares(study, other, max(every, 2))))
    return Table(
        "separable methods on the identifiable parameters, other simulated arms: share of starts "
        "that reach the minimum",
        ("seed", "base turned rad", "starts", "SNLGN %", "SNLLM %"),
        tuple(rows),
        ("d", ".1f", "d", ".2f", ".2f"),
    )


def maps(rows: Sequence[Row], what: str) -> Figure:
    """Paper S, Fig. 3: a value over the grid of deviations, a panel a method."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(rows), 4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(rows), sharey=True))
    for axes, row in zip(panels, rows, strict=True):
        theta, alpha = grid(row.every)
        side = len(np.unique(theta))
        values = (row.iterations if what == "iterations" else row.rms_mm).reshape(side, side)
        values = np.where(row.converged.reshape(side, side), values, np.nan)
        known = values[np.isfinite(values)] if np.isfinite(values).any() else np.ones(1)
        least = max(known.min(), 1e-3)
        norm = LogNorm(least, max(known.max(), 10.0 * least))
        edge = (alpha.min(), alpha.max(), theta.min(), theta.max())
        image = axes.imshow(values, origin="lower", extent=edge, norm=norm, cmap="viridis")
        axes.set(title=f"{row.method.upper()}, {row.parameters}", xlabel="alpha_3 off by (rad)")
        figure.colorbar(image, ax=axes, label=what, shrink=0.8)
    panels[0].set_ylabel("theta_2 off by (rad)")
    return figure


def surface(rows: Sequence[Row]) -> Figure:
    """The RMS at the end over the deviations; starts that do not converge are left out."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * len(rows), 4), layout="constrained")
    for number, row in enumerate(rows, start=1):
        axes = figure.add_subplot(1, len(rows), number, projection="3d")
        theta, alpha = grid(row.every)
        side = len(np.unique(theta))
        height = np.log10(np.where(row.converged, row.rms_mm, np.nan)).reshape(side, side)
        axes.plot_surface(alpha.reshape(side, side), theta.reshape(side, side), height,
                          cmap="viridis")  # fmt: skip
        axes.set(title=row.method.upper(), xlabel="alpha_3 (rad)", ylabel="theta_2 (rad)",
                 zlabel="log10 RMS mm")  # fmt: skip
    return figure


@dataclass(frozen=True)
class Found:
    """Table 2, what rounding does to it, and the arm it is of."""

    rows: list[Row]
    moved: list[Moved]
    setting: Setting


def study_of(study: Study, base_angle: float = 0.3) -> Found:
    """Every variant on its starts."""
    setting = Setting(seed=study.seed + 1, base_angle=base_angle)
    least = least_cost(setting)
    cap = 100 if study.quick else CAP

    def row(parameters: str, method: str, every: int, moved: bool = False) -> Row:
        found = outcomes(study, setting, method, parameters, every, cap, moved)
        return row_of(found, method, parameters, every, least, setting.poses)

    rows = [row(*variant, SPARSE if study.quick else 1) for variant in VARIANTS]
    by = {(row.parameters, row.method): row for row in rows}
    again = [
        moved_of(by["all, mm", m], row("all, mm", m, SPARSE if study.quick else 3, moved=True))
        for m in PAPER
    ]
    return Found(rows, again, setting)


def pictures(rows: Sequence[Row], surfaces: bool) -> dict[str, Figure]:
    """Fig. 3 for each set of parameters, by file name; surfaces take their time."""
    figures = {}
    for parameters in dict.fromkeys(row.parameters for row in rows):
        chosen = [row for row in rows if row.parameters == parameters]
        name = parameters.replace(", ", "_")
        for what in ("iterations", "RMS mm"):
            figures[f"{what.split()[0].lower()}_{name}"] = maps(chosen, what)
        if surfaces:
            figures[f"surface_{name}"] = surface(chosen)
    return figures


def save(study: Study, found: Found) -> None:
    """Table 2, and how the claim of global convergence fares on other arms and wider poses."""
    rows, setting = found.rows, found.setting
    tables = [
        table_2(rows, setting),
        moved_table(found.moved),
        seed_table(study, setting, SPARSE if study.quick else 3),
        span_table(study, setting, SPARSE if study.quick else 7),
    ]
    names = [name.replace(" ", "_").replace("%", "percent") for name in HEADER]
    content = {
        "rows": plain([dict(zip(names, row.cells(), strict=True)) for row in rows]),
        "least_rms_mm": float(1e3 * np.sqrt(least_cost(setting) / setting.poses)),
    }
    study.save(tables, content, pictures(rows, not study.quick))


@click.command()
@study_options("convergence")
@click.option("--base-angle", type=float, default=0.3, show_default=True, metavar="RAD")
def main(study: Study, base_angle: float) -> None:
    """Convergence of NLGN, NLLM, SNLGN, SNLLM from off starts: paper S, Table 2, Fig. 3."""
    save(study, study_of(study, base_angle))


if __name__ == "__main__":
    sweep.start(__file__)
