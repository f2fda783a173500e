"""What a diagnosis says of sessions: since when something is otherwise, and by how much."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from minimax_cal.diagnosing.result import Finding
from minimax_cal.diagnosing.study import Study
from minimax_cal.fitting.between_sessions import amounts, change_of, frame_changes
from minimax_cal.fitting.uncertainty import quantile
from minimax_cal.modelling.effects.words import name_effect


def session_notices(study: Study, findings: Sequence[Finding]) -> Iterator[str]:
    """Effects that hold from a session on, with intervals, and where each session's frame stands.

    findings: with values and sigmas of the last fit.
    """
    names = list(study.data.frames)
    for finding in findings:
        if "session" not in finding.term.choice:
            continue
        value, sigma = np.array(finding.values), np.array(finding.sigmas)
        half = quantile(0.95, study.fit.uncertainty.dof) * sigma
        found = amounts(finding.names, finding.units, value, sigma, half)
        change = change_of(finding.term, names, found, finding.p_value)
        yield f"{name_effect(change.effect, change.place)}: {change.when} by {change.sizes}"
    if len(names) > 1:
        yield from (frame.sentence for frame in frame_changes(study.geometric, study.fit))
