"""A calibration with what moved corrected, placed where new poses have it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from minimax_cal.fitting.accuracy import accuracy
from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Fit, Provenance
from minimax_cal.fitting.found import Parameters, link_by_link
from minimax_cal.fitting.identify import Identification, Reason
from minimax_cal.fitting.opened import place
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.facts import Later
from minimax_cal.judging.watching.moved import Search
from minimax_cal.judging.watching.opening import in_names
from minimax_cal.judging.watching.placing import Rows
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell
from minimax_cal.solvers.status import Status

NOT_IDENTIFIED = Reason("not identified")


def refit(fit: Fit, watched: Watched, found: Search) -> Fit:
    """The calibration with what moved corrected, and placed where the new poses have it."""
    rows, state = found.after.rows, found.after.state
    names, data = watched.names, watched.data
    sure = spread_of(fit, watched, found)
    known = identified(fit, rows, sure)
    cell = Cell.of(
        watched.cell.robot, state, names.target_names, watched.cell.effects, watched.cell.sessions
    )
    nominal = place(fit.nominal.robot, data)
    before, after = nominal.error(data), cell.error(data)
    nobody = np.zeros(data.poses, dtype=bool)
    told = ", ".join(m.parameter for m in found.named) or "nothing but frame and targets"
    return replace(
        fit,
        cell=cell,
        nominal=nominal,
        objective="sum",
        status=Status.CONVERGED,
        iterations=1,
        parameters=parameters_of(fit, nominal, cell, sure, known),
        accuracy={
            "nominal": accuracy(before[nobody]),
            "train": accuracy(after),
            "holdout": accuracy(after[nobody]),
            "nominal_train": accuracy(before),
        },
        identification=known,
        uncertainty=sure,
        minimax=None,
        certificate=None,
        trace=(),
        data=data,
        held=nobody,
        error_nominal=before,
        error=after,
        notices=(f"refitted on {data.poses} poses after a check: {told}; the rest is as it was",),
        loss="square",
        suspects=(),
        weights=data.seen.T.astype(float),
        share=np.ones(len(names.target_names)),
        prior=np.zeros(names.count),
        widening=1.0,
        provenance=Provenance.of(fit.nominal.robot, data, settings_of(fit, rows, sure)),
        claim=Later(partial(Beyond, reason="few poses after a check: nothing is left out")),
        error_crossed=np.zeros((0, 0, 3)),
        error_drawn_crossed=np.zeros((0, 0, 3)),
        reason="",
        stated_geometric=geometric_of(fit, cell, data) if cell.effects.causes else None,
        set_aside=data.set_aside,
    )


def parameters_of(
    fit: Fit, nominal: Cell, cell: Cell, sure: Uncertainty, known: Identification
) -> Parameters:
    """Every parameter, as drawn and then."""
    names, axes = sure.names, nominal.base[:3, :3]
    blank = np.zeros(names.count - names.geometric)
    drawn = replace(nominal.state, effects=blank).along(axes, nominal.robot)
    end = cell.state.along(axes, cell.robot)
    every = link_by_link(names, sure.units, drawn, end, sure.sigma, known)
    return Parameters(every, fit.uncertainty.dof)


def settings_of(fit: Fit, rows: Rows, sure: Uncertainty) -> dict[str, Any]:
    """The options of a calibration that would end there."""
    links = [sure.names.all[i] for i in range(5 * fit.cell.robot.joints) if not rows.active[i]]
    return {
        **fit.options.settings(), "objective": "sum", "holdout": 0.0, "holdout_by": None,
        "fix": links, "free": (), "priors": {}, "loss": "square", "trim": 0.0,
        "after_check": True,
    }  # fmt: skip


def geometric_of(fit: Fit, cell: Cell, data: Measurements) -> Cell:
    """The geometry alone, with what moved in the joint fit; data: too few to fit it anew."""
    moved = cell.robot.mdh - fit.cell.robot.mdh
    return place(fit.robot.with_mdh(fit.robot.mdh + moved), data)


def identified(fit: Fit, rows: Rows, sure: Uncertainty) -> Identification:
    """What is known then, and why the rest is not."""
    lost = [name for name, known in zip(sure.names.all, sure.active, strict=True) if not known]
    return Identification(
        sure.active,
        {name: fit.identification.reasons.get(name, NOT_IDENTIFIED) for name in lost},
        fit.identification.singular,
        np.linalg.norm(rows.jacobian, axis=0),
    )


def spread_of(fit: Fit, watched: Watched, found: Search) -> Uncertainty:
    """What is known about the parameters then."""
    rows, names = found.after.rows, watched.names
    factor = found.after.factor(watched.root)
    covariance = factor @ factor.T
    known = in_names(fit, watched, fit.identification.active) | rows.active
    covariance[~known] = np.nan
    covariance[:, ~known] = np.nan
    old = dict(zip(fit.uncertainty.names.all, fit.uncertainty.units, strict=True))
    own = zip(names.all, names.units, strict=True)
    units = tuple(old.get(name, unit) for name, unit in own)
    return replace(fit.uncertainty, names=names, units=units, covariance=covariance)
