"""What instruments can tell, alone and together, and why not the rest.

Lengths and closures know no base frame; closures know no length either.  Both show in the rank of
their rows at plenty of poses that no one had to measure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.fitting.identification import (
    DEFAULT_RESOLUTION,
    MIN_RANK_RATIO,
    Identification,
    KeptParameters,
    ReasonKind,
    gram_with_priors,
    order_prior_links_last,
    redundancy_drop_order,
    select_length_to_keep,
    select_redundant_parameters,
)
from minimax_cal.fitting.multi_instrument.instrument_stack import InstrumentStack
from minimax_cal.instruments.instrument import MOVES_NOTHING_REASON
from minimax_cal.instruments.protocol import ResidualRows, slopes_by_arm_parameters
from minimax_cal.modelling.parameters import ParameterNames, ParameterValues
from minimax_cal.modelling.point_model import DEFAULT_TARGET_NAME
from minimax_cal.robots.robot import Robot

MIN_MOTION_RATIO = 1e-7  # relative motion of a column that moves nothing
MIN_NULL_VECTOR_FRACTION = (
    0.05  # of a direction that others leave open: a parameter with less is known without it
)
ALL_LENGTHS_PREFIX = "all lengths together: "
ALL_OWN_PARAMETERS_TEXT = "all frames, anchors and targets of the files moved together"


def instrument_drop_order(robot: Robot, stack: InstrumentStack) -> Array:
    """Parameters in the order in which redundant ones are given up.

    First laws and what the instruments give up, as offsets of wires, then as
    `identify.redundancy_drop_order`, the instruments' own last.
    """
    names, laws = (
        stack.names,
        range(stack.parameter_count_without_laws, stack.names.parameter_count),
    )
    extra = np.arange(names.geometric_count, stack.parameter_count_without_laws)
    soft = np.array([name.startswith(one.given_up) for one in stack.instruments
                     for name in one.names], dtype=bool)  # fmt: skip
    order = [*laws, *extra[soft], *redundancy_drop_order(robot, names), *extra[~soft]]
    return np.array([int(i) for i in order], dtype=int)


def distance_jacobian(stack: InstrumentStack, x: ParameterValues) -> Array:
    """(p,) derivative of the distance between two places of the first instrument's target."""
    block, x, links = stack.blocks[0], stack.state_of_block(x, 0), 5 * stack.names.joints
    one = block.instrument
    arm = block.flange(
        x,
        np.ones(
            links + stack.names.parameter_count - stack.parameter_count_without_laws, dtype=bool
        ),
    )
    point = arm.place(one.flange_points(block.own_values(x))[0])
    ends = np.array([int(np.argmax(((point - point[0]) ** 2).sum(axis=1))), 0])
    gap = point[ends[0]] - point[0]
    along = gap / max(float(np.linalg.norm(gap)), 1e-12)
    by_point, none = np.stack([along, -along]), np.zeros((2, 3))
    slopes = slopes_by_arm_parameters(
        arm, ResidualRows(none[:, 0], ends, point[ends], by_point, none, none[:, :0])
    )
    row, (far, near) = np.zeros(stack.names.parameter_count), arm.rotation[ends]
    row[:links], row[stack.parameter_count_without_laws :] = np.split(slopes.sum(axis=1), [links])
    at = stack.own_columns(0)[one.targets_at][:3]
    row[at] = (along @ (far - near))[: len(at)]
    return row


def is_scale_undetermined(
    reference: InstrumentStack, x: ParameterValues, plain: Array, active: Array, order: Array
) -> bool:
    """Whether one more length would tell one more of the active parameters.

    Not so where the user fixed a length of the arm.
    """
    if any(one.has_length for one in reference.instruments):
        return False
    row = distance_jacobian(reference, x)
    if not row.any():  # one socket: nothing has a length
        return True
    more = plain + reference.points * np.outer(row, row)
    missing = [
        len(select_redundant_parameters(gram, active, order, MIN_RANK_RATIO))
        for gram in (plain, more)
    ]
    return missing[1] < missing[0]


def identify_instrument_parameters(
    robot: Robot,
    stack: InstrumentStack,
    reference: InstrumentStack,
    x: ParameterValues,
    allowed: Array,
    wanted: Array,
    *,
    known: Array,
    resolution: float = DEFAULT_RESOLUTION,
) -> Identification:
    """The largest set of allowed parameters that the measurements determine; see `identify`.

    reference: the instruments at plenty of poses, without laws, which only the poses at hand tell.
    x: the arm as drawn, with the instruments' own parameters fitted to it.  wanted: (p,) those to
    give up last.  known: (p,) True where a prior stands in for measurements.
    """
    names = stack.names
    plain, gram = reference.gram_matrix(x), stack.at_nominal_measurements(robot, x).gram_matrix(x)
    stiff = stack.parameter_count_without_laws
    size, scale = np.sqrt(np.diag(plain)), np.sqrt(np.diag(gram) / max(stack.points, 1))
    kept = KeptParameters(names, allowed, {}).drop_parameters(
        ~allowed & names.link_mask, ReasonKind.FIXED
    )
    unmoved = {one.unmoved for one in stack.instruments}
    for motion_of, reason in (
        (size, unmoved.pop() if len(unmoved) == 1 else MOVES_NOTHING_REASON),
        (scale, "moves nothing at these poses"),
    ):
        still = np.zeros(names.parameter_count, dtype=bool)
        still[: len(motion_of)] = motion_of <= MIN_MOTION_RATIO * motion_of[:stiff].max()
        kept = kept.drop_parameters(kept.active & still, ReasonKind.OTHER, reason)
    order = instrument_drop_order(robot, stack)
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    order = order_prior_links_last(order, names, known)
    no_length = is_scale_undetermined(
        reference, x, plain, kept.active[:stiff], order[order < stiff]
    )
    keeper = select_length_to_keep(robot, kept.active, wanted) if no_length else []
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = select_redundant_parameters(
        plain, kept.active[:stiff], order[order < stiff], MIN_RANK_RATIO
    )
    gone = [i for i in gone if not known[i] or i in keeper]
    if all(one.drawn_scale for one in stack.instruments) and keeper:
        gone, known = [i for i in gone if i not in keeper], known | is_link_length(names)
    no_scale = ALL_LENGTHS_PREFIX + "; ".join(stack.instruments[0].scale)
    kept = kept.drop_parameters(gone, ReasonKind.SAME_MOTION).drop_parameters(
        [i for i in gone if i in keeper], ReasonKind.NO_SCALE, no_scale
    )
    told = gram_with_priors(gram, known)
    kept = kept.drop_parameters(
        select_redundant_parameters(told, kept.active, order, resolution), ReasonKind.NOT_TOLD
    )
    return kept.build_identification(told, scale, *own_parameter_stems_and_text(stack))


def own_parameter_stems_and_text(stack: InstrumentStack) -> tuple[set[str], str]:
    """Stems of what is the instruments' own, and what all of it is called."""
    whole = stack.instruments[0].words.whole if len(stack.blocks) == 1 else ALL_OWN_PARAMETERS_TEXT
    own = stack.names.effects[: stack.parameter_count_without_laws - stack.names.geometric_count]
    return {name.rpartition("_")[0] for name in own if whole} - {DEFAULT_TARGET_NAME, "base"}, whole


def is_link_length(names: ParameterNames) -> Array:
    """(p,) True for the lengths of the links."""
    return np.asarray(np.arange(names.parameter_count) < 2 * names.joints)


def count_generic_instrument_parameters(
    robot: Robot, reference: InstrumentStack, x: ParameterValues, allowed: Array
) -> int:
    """How many of the allowed parameters plenty of poses would determine."""
    plain = reference.gram_matrix(x)
    moving = allowed & (np.sqrt(np.diag(plain)) > MIN_MOTION_RATIO * np.sqrt(np.diag(plain).max()))
    gone = select_redundant_parameters(
        plain, moving, instrument_drop_order(robot, reference), MIN_RANK_RATIO
    )
    return int(moving.sum()) - len(gone)


@dataclass(frozen=True)
class DeterminedAlone:
    """What a single instrument determines.

    directions: number of independent ones that the others leave open.  names: link parameters that
    take part in them.
    """

    directions: int
    names: tuple[str, ...]


def find_directions_determined_alone(
    stack: InstrumentStack, x: ParameterValues, active: Array, resolution: float
) -> tuple[DeterminedAlone, ...]:
    """What the links would lack without each of several blocks.

    stack: where the arm fits it.  active: (p,).
    """
    out = []
    every = np.ones(stack.names.parameter_count, dtype=bool)
    grams = [slope @ slope.T for _, slope in stack.rows_by_block(x, every)]
    whole = np.sqrt(np.diag(np.sum(grams, axis=0)))
    for i in range(len(stack.blocks)):
        others, chosen = np.sum(grams[:i] + grams[i + 1 :], axis=0), active.copy()
        chosen[stack.own_columns(i)] = False
        size = whole[chosen]
        alike = others[np.ix_(chosen, chosen)] / np.outer(size, size)
        values, vectors = np.linalg.eigh(alike)
        lost = vectors[:, values <= resolution**2 * values[-1]]
        share = np.linalg.norm(lost, axis=1)
        places = np.flatnonzero(chosen)
        named = [stack.names.all_names[p] for p, s in zip(places, share, strict=True)
                 if s > MIN_NULL_VECTOR_FRACTION and stack.names.link_mask[p]]  # fmt: skip
        out.append(DeterminedAlone(lost.shape[1], tuple(named)))
    return tuple(out)
