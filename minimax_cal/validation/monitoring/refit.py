"""A calibration with what moved corrected, placed where new poses have it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from minimax_cal.core.record_fields import LazyValue
from minimax_cal.fitting.fit import Fit
from minimax_cal.fitting.identification import Identification, NotIdentifiedReason
from minimax_cal.fitting.opened_results import place_nominal_arm
from minimax_cal.fitting.parameter_results import Parameters, build_parameters
from minimax_cal.fitting.region_holdout import RegionHoldout
from minimax_cal.modelling.cell import Cell
from minimax_cal.solvers.status import Status
from minimax_cal.validation.monitoring.change_search import ChangeSearch
from minimax_cal.validation.monitoring.monitored_arm import MonitoredArm
from minimax_cal.validation.monitoring.open_arm import match_flags_by_name

NOT_IDENTIFIED_REASON = NotIdentifiedReason("not identified")


def build_refitted_calibration(fit: Fit, watched: MonitoredArm, found: ChangeSearch) -> Fit:
    """The calibration with what moved corrected, and placed where the new poses have it."""
    rows, state = found.after.rows, found.after.state
    names, data, old = watched.names, watched.data, fit.uncertainty
    link_count = 5 * watched.cell.robot.joints
    cell = Cell.from_parameters(
        watched.cell.robot, state, names.target_names, watched.cell.effects, watched.cell.sessions
    )
    nominal = place_nominal_arm(fit.nominal.robot, data)

    # What is known then: the calibration's covariance, updated by the new poses.
    factor = found.after.covariance_factor(watched.kept_covariance_root)
    covariance = factor @ factor.T
    known = match_flags_by_name(fit, watched, fit.identification.active) | rows.active
    covariance[~known] = np.nan
    covariance[:, ~known] = np.nan
    old_units = dict(zip(old.names.all_names, old.units, strict=True))
    units = tuple(
        old_units.get(name, unit) for name, unit in zip(names.all_names, names.units, strict=True)
    )
    uncertainty = replace(old, names=names, units=units, covariance=covariance)
    lost = [name for name, is_known in zip(names.all_names, uncertainty.active, strict=True)
            if not is_known]  # fmt: skip
    identification = Identification(
        uncertainty.active,
        {name: fit.identification.reasons.get(name, NOT_IDENTIFIED_REASON) for name in lost},
        fit.identification.singular,
        np.linalg.norm(rows.jacobian, axis=0),
    )

    # Every parameter, as drawn and then.
    axes, no_effects = nominal.base[:3, :3], np.zeros(names.parameter_count - names.geometric_count)
    drawn = replace(nominal.parameter_values, effects=no_effects).values_in_file_convention(
        axes, nominal.robot
    )
    end = cell.parameter_values.values_in_file_convention(axes, cell.robot)
    every = build_parameters(names, units, drawn, end, uncertainty.sigma, identification)

    # The geometry alone, with what moved in the joint fit: the data are too few to fit it anew.
    geometric = None
    if cell.effects.cause_terms:
        change = cell.robot.mdh - fit.cell.robot.mdh
        geometric = place_nominal_arm(fit.robot.with_mdh(fit.robot.mdh + change), data)
    settings = {  # the options of a calibration that would end there
        **fit.options.settings(), "objective": "sum", "holdout": 0.0, "holdout_by": None,
        "fix": [names.all_names[i] for i in range(link_count) if not rows.active[i]], "free": (),
        "priors": {}, "loss": "square", "trim": 0.0, "after_check": True,
    }  # fmt: skip
    moved = ", ".join(m.parameter for m in found.named) or "nothing but frame and targets"
    return Fit.build(
        cell,
        nominal,
        data,
        np.zeros(data.poses, dtype=bool),
        (nominal.error(data), cell.error(data)),
        settings,
        uncertainty,
        status=Status.CONVERGED,
        iterations=1,
        seconds=fit.seconds,
        parameters=Parameters(every, old.dof),
        identification=identification,
        notices=(f"refitted on {data.poses} poses after a check: {moved}; the rest is as it was",),
        claim=LazyValue(
            partial(RegionHoldout, reason="few poses after a check: nothing is left out")
        ),
        set_aside=data.set_aside,
        answered=fit.answered,
        work=fit.work,
        stated_geometric=geometric,
        moved=fit.moved,
        contradictions=fit.contradictions,
    )
