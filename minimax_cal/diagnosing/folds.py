"""Diagnoses without a part of the poses: effects sought anew, and judged by the part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from minimax_cal.diagnosing.causes import Causes, effects_of, held_back
from minimax_cal.diagnosing.gap import Judges, Ladder, climbed
from minimax_cal.diagnosing.study import Study, studied
from minimax_cal.evidence.selection import select, tuned_again
from minimax_cal.fitting.beyond import Beyond, Errors, not_claimed, without
from minimax_cal.fitting.options import Progress
from minimax_cal.fitting.stations import steps_of
from minimax_cal.fitting.uncertainty import Estimator
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.stages import count_stage
from minimax_cal.measuring.grouping import parts
from minimax_cal.modelling.parameters import State


def fold_of(study: Study, causes: Causes, rows: Array, state: State) -> Ladder:
    """Effects sought and fitted on some rows only; maps of joints only fitted.

    causes: of all rows; the products of their library serve every fold, and what holds names back
    holds them back in it.  rows: (m,) True for those used.  state: the geometry that was fitted to
    them.
    """
    small = studied(study.robot, study.data.take(rows), replace(study.fit, state=state))
    choice = tuned_again(select(causes.choice.part(study.rows.at(rows))))
    every = [candidate.term for candidate in choice.chosen]
    named = [
        terms for terms in effects_of(choice) if not held_back(terms, every, causes, study.scene)
    ]
    return climbed(small, causes.maps.beside(named), wary=causes.wary)


def beyond_of(
    study: Study, causes: Causes, judges: Judges, by: str | None, progress: Progress
) -> Beyond:
    """Every part of the poses judges a model that was sought without it.

    by: whose groups are the parts, as in `grouping.parts`.
    """
    data = judges.everyone
    known = not_claimed(study.robot, study.data)
    if known.narrow:
        return known
    found = parts(data, by)
    masks = [np.isin(study.data.line, data.line[part.rows]) for part in found]
    estimator = Estimator(
        study.model.only(study.fit.identification.active), np.ones(len(study.model.y))
    )
    errors = Errors()
    states = without(estimator, study.fit.state, masks, steps_of(study.data.frames))
    for number, (part, mask, state) in enumerate(zip(found, masks, states, strict=True)):
        if state is None:
            errors.miss(part.name)
            continue
        progress(count_stage("part", number + 1, len(found), f" left out: {part.name}"))
        fits = fold_of(study, causes, ~mask, state).fits
        rows = data.take(part.rows)
        errors.add(part.name, fits[-1].cell.error(rows), fits[0].cell.error(rows))
    if not found:
        return replace(known, reason="the poses are too few or too much alike")
    return replace(errors.beyond(sought=True), spans=known.spans)
