"""What a plan promises: growth with the number of poses, indices, power, and what to know of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.evidence.limits import ENOUGH
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.words import name_effect
from minimax_cal.planning import separating
from minimax_cal.planning.candidates import Poses, rarest
from minimax_cal.planning.designs.criteria import Criterion, inverse, sizes_of
from minimax_cal.planning.designs.exchange import Menu
from minimax_cal.planning.designs.search import DRAWS, Found, quick_design
from minimax_cal.planning.promise import INDICES, Both, Growth, Separation, observability
from minimax_cal.planning.prospect import Prospect
from minimax_cal.planning.route import Visits
from minimax_cal.planning.separating import Contest, Question
from minimax_cal.planning.task import Task

GROWTH = (0.5, 0.75, 1.0, 1.5, 2.0)  # numbers of poses to compare, as parts of those asked for
SETS = 20  # random sets of which observability indices are told


def sigmas(menu: Menu, designs: Sequence[Array], squares: Array) -> Array:
    """(d, 2) root mean and largest predicted variance of a position [m]; infinite where not told.

    squares: (w, f * f) B'B of each pose of the workspace.
    """
    cov = inverse(np.array([menu.of(chosen) for chosen in designs])).reshape(len(designs), -1)
    told = np.asarray(np.isfinite(cov).all(axis=1))
    variance = np.where(told[:, None], cov, 0.0) @ squares.T
    both = np.sqrt(np.stack([variance.mean(axis=1), variance.max(axis=1)], axis=1))
    return np.where(told[:, None], both, np.inf)


def grown(
    task: Task, menu: Menu, aim: tuple[Menu, Criterion], best: Found, drawn: int
) -> tuple[Growth, ...]:
    """What other numbers of poses would tell, planned and random ones of the first `drawn`."""
    rng, b = np.random.default_rng(task.options.seed), task.predictions
    squares = (np.swapaxes(b, 1, 2) @ b).reshape(len(b), -1)
    poses, out = len(best.design.chosen), []
    for count in sorted({max(1, round(poses * part)) for part in GROWTH}):
        if count > min(drawn, len(best.likely)):
            continue
        own = best.design.chosen
        if count != poses:
            own = quick_design(*aim, count, best.likely)
        designs = [own, *(rng.choice(drawn, count, replace=False) for _ in range(DRAWS))]
        sizes = sizes_of(aim[1], np.array([aim[0].of(one) for one in designs]))
        both = sigmas(menu, designs, squares)
        if not np.isfinite(both[0]).all() and count != poses:
            continue  # so few tell not everything
        columns = (*both.T, sizes)
        pairs = [Both(float(column[0]), float(np.median(column[1:]))) for column in columns]
        out.append(Growth(count, *pairs))
    return tuple(out)


def indices(ahead: Prospect, found: Poses, chosen: Array, seed: int) -> dict[str, Both]:
    """Observability indices of the poses chosen, and the median of random ones."""
    rng = np.random.default_rng(seed)

    def of(some: Array) -> list[float]:
        jacobian = ahead.jacobian(found.q[some], found.seen[some])
        values = np.linalg.svd(jacobian, compute_uv=False)
        whole = np.zeros(len(ahead.scale))  # fewer coordinates than parameters: the rest is 0
        whole[: len(values)] = values
        return list(observability(whole, len(some)).values())

    random = [of(rng.choice(found.drawn, len(chosen), replace=False)) for _ in range(SETS)]
    return {
        name: Both(one, float(other))
        for name, one, other in zip(INDICES, of(chosen), np.median(random, axis=0), strict=True)
    }


def separated(asked: Question, contest: Contest, stops: Visits, seen: Array) -> Separation:
    """How far the chosen poses tell two effects apart, visited in their order with all revisits."""
    final = separating.contest(asked, stops.q, seen[stops.pose], stops.via)
    planned, everything = final.everything, contest.everything
    other = ""
    if contest.alike or max(planned, everything) < ENOUGH:
        other = separating.otherwise(asked)
    return Separation(
        asked.pair.one.label,
        asked.pair.other.label,
        contest.now,
        planned,
        everything,
        ENOUGH,
        contest.alike,
        other,
    )


def remarks(task: Task, found: Poses) -> list[str]:
    """What the reader should know about how the poses were found."""
    out = ["the arm's body is a crude one and the cell is not known: check every move yourself"]
    told = {name.partition(".")[0] for name in task.ahead.names}
    terms = [term for term in task.ahead.cell.effects.terms if not term.frees_frames]
    silent_ones = [name_effect(*term.key) for term in terms if term.label not in told]
    if silent_ones:
        out.append(
            f"{', '.join(silent_ones)}: taken as known, not planned for, since the way to a pose "
            "and the time are not known yet"
        )
    if found.drawn < task.options.candidates:
        out.append(
            f"{found.drawn} candidates, not {task.options.candidates}: poses that can be taken and "
            f"seen are rare ({found.tested} were drawn); {rarest(found.rejected)}"
        )
    return out
