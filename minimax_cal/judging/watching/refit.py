"""A calibration with what moved corrected, placed where new poses have it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.found import Parameters, link_by_link
from minimax_cal.fitting.identify import Identification, Reason
from minimax_cal.fitting.opened import place
from minimax_cal.ground.facts import Later
from minimax_cal.judging.watching.moved import Search
from minimax_cal.judging.watching.opening import match_names
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.modelling.cell import Cell
from minimax_cal.solvers.status import Status

NOT_IDENTIFIED = Reason("not identified")


def refit(fit: Fit, watched: Watched, found: Search) -> Fit:
    """The calibration with what moved corrected, and placed where the new poses have it."""
    rows, state = found.after.rows, found.after.state
    names, data, old = watched.names, watched.data, fit.uncertainty
    link_count = 5 * watched.cell.robot.joints
    cell = Cell.of(
        watched.cell.robot, state, names.target_names, watched.cell.effects, watched.cell.sessions
    )
    nominal = place(fit.nominal.robot, data)

    # What is known then: the calibration's covariance, updated by the new poses.
    factor = found.after.factor(watched.root)
    covariance = factor @ factor.T
    known = match_names(fit, watched, fit.identification.active) | rows.active
    covariance[~known] = np.nan
    covariance[:, ~known] = np.nan
    old_units = dict(zip(old.names.all, old.units, strict=True))
    units = tuple(
        old_units.get(name, unit) for name, unit in zip(names.all, names.units, strict=True)
    )
    uncertainty = replace(old, names=names, units=units, covariance=covariance)
    lost = [name for name, is_known in zip(names.all, uncertainty.active, strict=True)
            if not is_known]  # fmt: skip
    identification = Identification(
        uncertainty.active,
        {name: fit.identification.reasons.get(name, NOT_IDENTIFIED) for name in lost},
        fit.identification.singular,
        np.linalg.norm(rows.jacobian, axis=0),
    )

    # Every parameter, as drawn and then.
    axes, no_effects = nominal.base[:3, :3], np.zeros(names.count - names.geometric)
    drawn = replace(nominal.state, effects=no_effects).along(axes, nominal.robot)
    end = cell.state.along(axes, cell.robot)
    every = link_by_link(names, units, drawn, end, uncertainty.sigma, identification)

    # The geometry alone, with what moved in the joint fit: the data are too few to fit it anew.
    geometric = None
    if cell.effects.causes:
        change = cell.robot.mdh - fit.cell.robot.mdh
        geometric = place(fit.robot.with_mdh(fit.robot.mdh + change), data)
    settings = {  # the options of a calibration that would end there
        **fit.options.settings(), "objective": "sum", "holdout": 0.0, "holdout_by": None,
        "fix": [names.all[i] for i in range(link_count) if not rows.active[i]], "free": (),
        "priors": {}, "loss": "square", "trim": 0.0, "after_check": True,
    }  # fmt: skip
    moved = ", ".join(m.parameter for m in found.named) or "nothing but frame and targets"
    return Fit.build(
        cell, nominal, data, np.zeros(data.poses, dtype=bool),
        (nominal.error(data), cell.error(data)), settings, uncertainty,
        status=Status.CONVERGED,
        iterations=1,
        seconds=fit.seconds,
        parameters=Parameters(every, old.dof),
        identification=identification,
        notices=(f"refitted on {data.poses} poses after a check: {moved}; the rest is as it was",),
        claim=Later(partial(Beyond, reason="few poses after a check: nothing is left out")),
        set_aside=data.set_aside,
        answered=fit.answered,
        work=fit.work,
        stated_geometric=geometric,
        moved=fit.moved,
        contradictions=fit.contradictions,
    )  # fmt: skip
