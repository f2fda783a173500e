"""Diagnoses without a part of the poses: effects sought anew, and judged by the part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.diagnosing.causes import Causes
from minimax_cal.diagnosing.established import covers_key
from minimax_cal.diagnosing.findings import group_terms
from minimax_cal.diagnosing.gap import Judges, Ladder, fit_ladder
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.evidence.selection import select, tuned_again
from minimax_cal.fitting.beyond import Beyond, Errors, not_claimed, without
from minimax_cal.fitting.options import Progress
from minimax_cal.fitting.stations import steps_of
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.parallel import share
from minimax_cal.ground.stages import count_stage
from minimax_cal.measuring.grouping import parts
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.parameters import State


def fold_of(study: Study, causes: Causes, rows: Array, state: State) -> Ladder:
    """Effects sought and fitted on some rows only; maps of joints only fitted.

    Of those that are confirmed on all rows, or stand for one.

    causes: of all rows; the products of their library serve every fold.  rows: (m,) True for those
    used.  state: the geometry that was fitted to them.
    """
    small = studied(study.robot, study.data.take(rows), replace(study.fit, state=state))
    if not causes.confirmed:
        return fit_ladder(small, [], [])
    choice = tuned_again(select(causes.choice.part(study.rows.at(rows))))
    named = causes.maps.beside(group_terms(choice))
    sure = [any(covers_key(one, terms[0].key) for one in causes.confirmed) for terms in named]
    return fit_ladder(small, named, sure, guessed=causes.guessed).confirmed


def fold_errors(
    study: Study, causes: Causes, rows: Array, state: State, left: Measurements
) -> tuple[Array, Array]:
    """Errors (f, k, 3) at poses left out, of the model sought without them and of its geometry [m].

    As `fold_of`; left: the poses left out.
    """
    fits = fold_of(study, causes, rows, state).fits
    return fits[-1].cell.error(left), fits[0].cell.error(left)


def beyond_of(study: Study, causes: Causes, judges: Judges, progress: Progress) -> Beyond:
    """Every part of the poses judges a model that was sought without it."""
    data = judges.everyone
    known = not_claimed(study.robot, study.data)
    if known.narrow:
        return known
    found = parts(data, judges.by)
    masks = [np.isin(study.data.line, data.line[part.rows]) for part in found]
    estimator = Estimator(
        study.model.only(study.fit.identification.active), np.ones(len(study.model.y))
    )
    errors = Errors()
    states = without(estimator, study.fit.state, masks, steps_of(study.data.frames))
    waiting = [i for i, state in enumerate(states) if state is not None]
    for part, state in zip(found, states, strict=True):
        if state is None:
            errors.missed.append(part.name)
    calls = [(study, causes, ~masks[i], states[i], data.take(found[i].rows)) for i in waiting]
    ended = {}
    for number, pair in share(fold_errors, calls, processes=causes.jobs, cluster=causes.cluster):
        ended[number] = pair
        name = found[waiting[number]].name
        progress(count_stage("part", len(ended), len(calls), f" held out: {name}"))
    for number, i in enumerate(waiting):
        errors.add(found[i].name, *ended[number])
    if not found:
        return replace(known, reason="the poses are too few or too much alike")
    return replace(errors.beyond(sought=True), spans=known.spans)
