"""A calibration with what moved corrected, placed where new poses have it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from minimax_cal.fitting.beyond import Beyond
from minimax_cal.fitting.fit import Fit, Parameter, Parameters, Provenance
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.start import fit_base
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.judging.watching.moved import Search
from minimax_cal.judging.watching.opening import in_names
from minimax_cal.judging.watching.watched import Watched
from minimax_cal.measuring.accuracy import accuracy
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.model import model_of
from minimax_cal.modelling.parameters import links_of
from minimax_cal.solvers.status import Status


def refit(fit: Fit, watched: Watched, found: Search) -> Fit:
    """The calibration with what moved corrected, and placed where the new poses have it."""
    rows = found.last
    state = rows.state.step(rows.step)
    names, data = watched.names, watched.data
    sure = spread_of(fit, watched, found)
    known = sure.active
    cell = Cell.of(
        watched.cell.robot, state, names.target_names, watched.cell.effects, watched.cell.sessions
    )
    drawn = fit.before.robot
    nominal = Cell.of(drawn, fit_base(model_of(drawn, data), drawn.mdh).state, names.target_names)
    parameters = Parameters(told_parameters(fit, cell, nominal, sure, known), fit.known.dof)
    before, after = nominal.error(data), cell.error(data)
    nobody = np.zeros(data.poses, dtype=bool)
    links = [names.all[i] for i in range(5 * fit.robot.joints) if not rows.active[i]]
    settings = {
        **fit.options.settings(), "objective": "sum", "holdout": 0.0, "holdout_by": None,
        "fix": links, "free": (), "priors": {}, "loss": "square", "trim": 0.0,
    }  # fmt: skip
    told = ", ".join(m.parameter for m in found.named) or "nothing but frame and targets"
    return replace(
        fit,
        cell=cell,
        nominal=nominal,
        objective="sum",
        status=Status.CONVERGED,
        iterations=1,
        parameters=parameters,
        accuracy={
            "nominal": accuracy(before[:, nobody]),
            "train": accuracy(after),
            "holdout": accuracy(after[:, nobody]),
            "nominal_train": accuracy(before),
        },
        identification=Identification(
            known,
            {p.name: p.reason for p in parameters if p.reason},
            fit.identification.singular,
            np.linalg.norm(rows.jacobian, axis=0),
        ),
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
        provenance=Provenance.of(drawn, data, settings),
        claim=partial(Beyond, reason="few poses after a check: nothing is left out"),
        stated=None,
        error_crossed=np.zeros((0, 0, 3)),
    )


def told_parameters(
    fit: Fit, cell: Cell, nominal: Cell, sure: Uncertainty, known: Array
) -> tuple[Parameter, ...]:
    """Every parameter, link by link; the base along the nominal base's axes."""
    axes = nominal.base[:3, :3]

    def values(one: Cell) -> Array:
        turn = Rotation.from_matrix(axes.T @ one.base[:3, :3]).as_rotvec()
        effects = np.concatenate([np.zeros(0), *cell.effects.values])
        spots = one.target_positions.reshape(-1)
        return np.concatenate(
            [links_of(one.robot.mdh), axes.T @ one.base[:3, 3], turn, spots, effects]
        )

    now, drawn, n = values(cell), values(nominal), cell.robot.joints
    names, sigma = sure.names.all, sure.sigma
    reasons = {p.name: p.reason for p in fit.parameters}
    order = [kind * n + joint for joint in range(n) for kind in range(5)]
    return tuple(
        Parameter(
            names[i],
            float(now[i]),
            float(drawn[i]) if i < 5 * n + 6 + 3 * len(cell.target_names) else 0.0,
            float(sigma[i]),
            sure.units[i],
            bool(known[i]),
            "" if known[i] else reasons.get(names[i], "not identified"),
        )
        for i in (*order, *range(5 * n, len(names)))
    )


def spread_of(fit: Fit, watched: Watched, found: Search) -> Uncertainty:
    """What is known about the parameters then."""
    rows, names = found.last, watched.names
    factor = rows.factor(watched.root)
    covariance = factor @ factor.T
    known = in_names(fit, watched, fit.identification.active) | rows.active
    covariance[~known] = np.nan
    covariance[:, ~known] = np.nan
    old = dict(zip(fit.known.names.all, fit.known.units, strict=True))
    own = {
        name: "m" if length else "rad" for name, length in zip(names.all, names.linear, strict=True)
    }
    units = tuple(old.get(name, own[name]) for name in names.all)
    return replace(fit.known, names=names, units=units, covariance=covariance)
