"""The fit of all instruments: start, identifiable parameters, least squares, noises, sigmas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import TypeVar, cast

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.fitting.cell_fit import EFFECT_PASSES, without_bounded_effects
from minimax_cal.fitting.coaxial_axes import (
    OffsetTrial,
    build_offset_trial,
    find_coaxial_joints,
    identification_with_offset,
    is_offset_significant,
    with_rotated_common_normal,
)
from minimax_cal.fitting.geometry_fit import MAX_PRIOR_ROUNDS, MIN_NOISE
from minimax_cal.fitting.identification import Identification
from minimax_cal.fitting.multi_instrument.instrument_identification import (
    DeterminedAlone,
    count_generic_instrument_parameters,
    find_directions_determined_alone,
    identify_instrument_parameters,
    instrument_drop_order,
    own_parameter_stems_and_text,
)
from minimax_cal.fitting.multi_instrument.instrument_robust_fit import (
    EQUAL_LOSS_WEIGHTS,
    LossWeights,
    loss_weights_and_notice,
    minimise_instrument_loss,
)
from minimax_cal.fitting.multi_instrument.instrument_stack import (
    InstrumentLeastSquares,
    InstrumentStack,
    LinkPriors,
    start_own_values,
)
from minimax_cal.fitting.multi_instrument.laws import InstrumentLaws
from minimax_cal.fitting.multi_instrument.options import (
    SUM,
    Progress,
    RelativeOptions,
    link_prior_sigmas,
)
from minimax_cal.fitting.multi_instrument.worst_rows import (
    WorstRows,
    WorstRowsOverNoise,
    minimise_largest_mean_square,
)
from minimax_cal.fitting.options import QpSolver, select_freed_parameters
from minimax_cal.fitting.parameter_results import Parameter, build_parameters
from minimax_cal.instruments.instrument import METRE_UNIT, Instrument
from minimax_cal.modelling.effects.table import Term, at_bound_mask
from minimax_cal.modelling.error_rows import MIN_ESTIMATED_POINT_NOISE
from minimax_cal.modelling.nearby_fit import fit_within_bounds, is_within_bounds
from minimax_cal.modelling.parameters import ParameterValues, flatten_link_parameters
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import (
    LeastSquaresSolution,
    find_method,
    solve_normal_equations,
)
from minimax_cal.solvers.status import Status

MAX_SETTLED_NOISE_CHANGE = 0.01  # relative change of the noises that ends their weighing


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """What an arm does that no link holds: by c factors of functions of the pose.

    moved: (p, c) how far each factor moves the parameters of a fit.  moment: (c, c) mean of the
    factors' products, given the rows.
    """

    moved: Array
    moment: Array


@dataclass(frozen=True, eq=False)
class InstrumentFit:
    """What the solver found.

    problem: as it was solved, its instruments weighed by their noise.  nominal: the arm as drawn
    with the instruments fitted to it.  state: the calibrated one.  covariance: (p, p) [SI], NaN
    where not identified.  noise: (b,) sigma of a row of each instrument [m].  training_data: what
    was fitted, by what the file is called.  determined_alone: what each determines by itself, empty
    where there is one.  geometric_fit: the fit of geometry alone, where this one has laws besides.
    worst: what a minimax rests on, None where the sum was minimised; notices: of it.  lack: that
    the covariance holds, None where it holds none.
    """

    problem: InstrumentLeastSquares
    nominal: ParameterValues
    state: ParameterValues
    identification: Identification
    least_squares: LeastSquaresSolution[ParameterValues]
    covariance: Array
    noise: Array
    training_data: Mapping[str, Instrument]
    determined_alone: tuple[DeterminedAlone, ...]
    geometric_fit: InstrumentFit | None = None
    worst: WorstRows | None = None
    notices: tuple[str, ...] = ()
    lack: LackOfFit | None = None

    @property
    def stack(self) -> InstrumentStack:
        """The instruments, weighed by their noise."""
        return self.problem.stack

    def states_of_instrument(self, i: int) -> tuple[ParameterValues, ParameterValues]:
        """As drawn and calibrated, of an instrument."""
        return self.stack.state_of_block(self.nominal, i), self.stack.state_of_block(self.state, i)


F = TypeVar("F", bound=InstrumentFit)


def build_training_stack(
    robot: Robot, training_data: Mapping[str, Instrument], options: RelativeOptions
) -> InstrumentStack:
    """The training measurements as a least-squares problem."""
    alone = [each.ready(robot, options) for each in training_data.values()]
    every = [
        one.adapt_to_other_instruments([*alone[:i], *alone[i + 1 :]]) for i, one in enumerate(alone)
    ]
    stack = InstrumentStack.from_instruments(robot, every, [*training_data])
    given = [options.noises.get(label, np.nan) for label in stack.labels]
    of_rows = [sigma * one.row_noise for sigma, one in zip(given, every, strict=True)]
    return replace(stack, given=np.square(of_rows))


def select_parameters(stack: InstrumentStack, options: RelativeOptions) -> tuple[Array, Array]:
    """What may be fitted (p,), and what is to be given up last (p,); the base is no unknown."""
    names = stack.names
    allowed = ~names.match_patterns(options.fix, "fix")
    wanted = select_freed_parameters(names, options.free, allowed)
    allowed[5 * names.joints : names.geometric_count] = False
    for i, one in enumerate(stack.instruments):
        allowed[stack.own_columns(i)] &= [name not in one.given_unknown_names for name in one.names]
    return allowed, wanted


def build_start_state(robot: Robot, stack: InstrumentStack, is_allowed: Array) -> ParameterValues:
    """The arm as drawn, and what fits it best."""
    every = enumerate(stack.instruments)
    return stack.state(
        robot.mdh,
        [start_own_values(robot, one, is_allowed[stack.own_columns(i)]) for i, one in every],
    )


def fit_instruments(
    robot: Robot,
    training_data: Mapping[str, Instrument],
    options: RelativeOptions,
    progress: Progress,
) -> InstrumentFit:
    """Fit the identifiable parameters to the training measurements.  Raises DataError."""
    # Start: the arm as drawn, and base, targets and unknowns of the instruments that fit it best.
    progress("start")
    training_data = {label: data.sort_rows_for_fit() for label, data in training_data.items()}
    stack = build_training_stack(robot, training_data, options)
    allowed, preferred = select_parameters(stack, options)
    known = LinkPriors(flatten_link_parameters(robot.mdh), link_prior_sigmas(stack.names, options))
    nominal = build_start_state(robot, stack, allowed)

    # Which parameters the rows determine: against what plenty of poses would.
    progress("identifiable parameters")
    reference = stack.at_reference_poses(robot, nominal)
    has_prior = known.has_prior(stack.names.parameter_count)
    unknowns = count_generic_instrument_parameters(robot, reference, nominal, allowed & ~has_prior)
    check_number_count([*training_data.values()], stack, unknowns)
    offsets = np.zeros(
        stack.names.parameter_count, dtype=bool
    )  # by which coaxial axes were found apart

    def identify(stack: InstrumentStack, known: LinkPriors, x: ParameterValues) -> Identification:
        more = (0, len(stack.laws.names))
        return identify_instrument_parameters(
            robot, stack, reference, x, np.pad(allowed, more, constant_values=True),
            np.pad(preferred, more),
            known=known.has_prior(stack.names.parameter_count) | np.pad(offsets, more),
            resolution=options.resolution,
        )  # fmt: skip

    # Least squares, instruments weighed by the noises that remain; again, since one that is rough
    # then determines less than it seemed to.
    identification = identify(stack, known, nominal)
    progress("least squares")
    problem = InstrumentLeastSquares(stack, identification.active, known)
    problem, ended = fit_with_estimated_noises(problem, nominal, options)
    if len(training_data) > 1:
        identification = identify(problem.stack, known, nominal)
        problem = replace(problem, active=identification.active)
        problem, ended = fit_with_estimated_noises(problem, nominal, options)

    # Axes that are drawn coaxial: apart in any direction, if the rows show it.
    for joint in find_coaxial_joints(robot):
        trial = fit_coaxial_offset(robot, problem, ended, joint, allowed, reference)
        if trial is None:
            continue
        offsets |= trial.is_added
        problem = InstrumentLeastSquares(problem.stack, trial.is_free, known)
        problem, ended = fit_with_estimated_noises(problem, trial.begin, options)
        gram = problem.stack.at_nominal_measurements(robot, trial.begin).gram_matrix(trial.begin)
        identification = identification_with_offset(
            identification, stack.names, trial, gram, *own_parameter_stems_and_text(problem.stack)
        )
    fit = geometric = build_instrument_fit(problem, ended, nominal, identification, training_data)

    # Effects beside the geometry: linear where it ended, then for finite rotations too.
    if options.effects:
        progress("effects")
        laws = select_laws(robot, geometric, options.effects)
        for _ in range(EFFECT_PASSES):
            fit = fit_with_laws(robot, fit, laws, known, identify, options)
        fit = replace(fit, geometric_fit=geometric)

    # The minimax.  Parts of several files compare by the noises of these, which the sum gave.
    if options.objective != SUM and fit.least_squares.status[0] is not Status.FAILED:
        part, names = fit.stack.part_indices(fit.state), fit.stack.part_names
        in_metres = {one.unit for one in fit.stack.instruments} == {METRE_UNIT}
        kind = WorstRows if in_metres else WorstRowsOverNoise
        fit, share = minimise_worst_rows(fit, part, names, 1, options.qp, MIN_NOISE, kind)
        variance = np.square(fit.noise)
        covariance = parameter_covariance(fit.problem, fit.state, variance, (share, share**2))
        fit = replace(fit, covariance=covariance)

    # What each of several instruments determines by itself.
    if len(training_data) > 1:
        closed, active = (
            fit.stack.at_nominal_measurements(robot, fit.nominal),
            fit.identification.active,
        )
        alone = find_directions_determined_alone(closed, fit.nominal, active, options.resolution)
        fit = replace(fit, determined_alone=alone)
    return fit


def fit_coaxial_offset(
    robot: Robot,
    problem: InstrumentLeastSquares,
    ended: LeastSquaresSolution[ParameterValues],
    joint: int,
    is_allowed: Array,
    reference: InstrumentStack,
) -> OffsetTrial | None:
    """The fit in which a coaxial axis and its next are apart, where that fit begins at its end.

    None where the rows do not show it.  reference: the instruments at plenty of poses.
    """
    stack, state = problem.stack, ended.x.take(np.array(0))
    order = instrument_drop_order(robot, stack)
    trial = build_offset_trial(
        robot, state, joint, problem.active, is_allowed, order, reference.gram_matrix
    )
    if trial is None:
        return None
    method, limits = find_method(least_squares.AUTO_METHOD_NAME), least_squares.NEAR_START_LIMITS

    def solved(
        problem: InstrumentLeastSquares, begin: ParameterValues
    ) -> LeastSquaresSolution[ParameterValues]:
        return least_squares.solve(problem, begin.batch(), 1, float(stack.points), method, limits)

    def solved_along(angle: float) -> ParameterValues:
        mdh = with_rotated_common_normal(robot, state.mdh, joint, trial.is_free, angle)
        return solved(problem, build_start_state(robot.with_mdh(mdh), stack, is_allowed)).x.take(
            np.array(0)
        )

    # Tool or base turn with the normal, along a curve that steps follow slowly: where the normal
    # lies is found first, from the two coordinates of the offset, each of a fit along it.
    across = solved_along(np.pi / 2.0).mdh[joint, 0]
    angle = np.arctan2(across, state.mdh[joint, 0])
    found = solved(replace(problem, active=trial.is_free), solved_along(float(angle)))
    spare = float(sum(one.degrees_of_freedom for one in stack.instruments) - trial.is_free.sum())
    if not is_offset_significant(float(ended.cost[0]), float(found.cost[0]), trial.is_added, spare):
        return None
    return replace(trial, begin=found.x.take(np.array(0)))


def minimise_worst_rows(
    fit: F,
    part_indices: Array,
    part_names: Sequence[str],
    numbers_per_error: int,
    qp: QpSolver,
    rounding_error: float,
    kind: type[WorstRows],
) -> tuple[F, Array]:
    """The minimax from a fit of the sum, and (r,) how much each row counts in it.

    part_indices: (r,) which of the names each row is of, else as `RowMinimax.at` has it, as
    numbers. rounding_error: as of `minimise_largest_mean_square`.
    """
    some = part_indices >= 0
    seen, number = np.unique(part_indices[some], return_inverse=True)
    part_indices, number = part_indices.copy(), number.reshape(-1)
    part_indices[some] = number
    best, share, notes = minimise_largest_mean_square(
        fit.problem, part_indices, numbers_per_error, fit.state, qp, rounding_error
    )

    # Errors in other units than metres compare by the noises of their files.
    units = fit.noise if kind is WorstRowsOverNoise else repeat(1.0)

    def sizes(x: ParameterValues) -> Array:
        none = np.zeros(fit.stack.names.parameter_count, dtype=bool)
        blocks = zip(units, fit.stack.rows_by_block(x, none), strict=False)
        error = np.concatenate([error / unit for unit, (error, _) in blocks])
        square = numbers_per_error * np.bincount(number, error[some] ** 2)
        return np.asarray(np.sqrt(square / np.bincount(number)))

    worst = kind.from_optimum([part_names[i] for i in seen], sizes(fit.state), sizes(best.x), best)
    found = replace(
        fit.least_squares, status=(best.status,), iterations=np.array([best.iterations])
    )
    return replace(fit, state=best.x, least_squares=found, worst=worst, notices=notes), share


def fit_with_laws(
    robot: Robot,
    fit: InstrumentFit,
    laws: InstrumentLaws,
    known: LinkPriors,
    identify: Callable[[InstrumentStack, LinkPriors, ParameterValues], Identification],
    options: RelativeOptions,
) -> InstrumentFit:
    """Geometry and effects together, from a fit whose laws are linear where it ended.

    known: of the links.  identify: the parameters that rows, priors and a state determine.
    """
    scenes = fit.stack.arm_states(robot, fit.state)
    stack, begin = fit.stack.with_laws(robot, laws, fit.state)
    names, first_law = stack.names, stack.parameter_count_without_laws - stack.names.geometric_count
    own = fit.nominal.effects[:first_law]
    drawn = replace(fit.nominal, effects=np.pad(own, (0, len(laws.names))))
    known = replace(known, laws=laws.sigma(scenes[0]))
    identification = identify(stack, known, drawn)
    begin.effects[
        np.flatnonzero(~identification.active[stack.parameter_count_without_laws :]) + first_law
    ] = 0.0
    problem = InstrumentLeastSquares(
        stack, identification.active, known, room=laws.parameter_bounds(scenes)
    )
    fit = build_instrument_fit(
        *fit_with_estimated_noises(problem, begin, options),
        drawn,
        identification,
        fit.training_data,
    )

    # A parameter of a law at its bound is not identified: it has no sigma.
    is_at_bound = at_bound_mask(stack.law_values(fit.state), problem.room)
    if not is_at_bound.any():
        return fit
    known_now = without_bounded_effects(identification, names, np.pad(is_at_bound, (first_law, 0)))
    problem = replace(fit.problem, active=known_now.active)
    shares, _ = loss_weights_and_notice(problem, fit.least_squares)
    covariance = parameter_covariance(problem, fit.state, np.square(fit.noise), shares)
    return replace(fit, identification=known_now, covariance=covariance)


def build_instrument_fit(
    problem: InstrumentLeastSquares,
    least_squares: LeastSquaresSolution[ParameterValues],
    nominal: ParameterValues,
    identification: Identification,
    training_data: Mapping[str, Instrument],
) -> InstrumentFit:
    """What a solved problem says."""
    state = least_squares.x.take(np.array(0))
    variance, (shares, notices) = (
        estimate_row_variances(problem, state),
        loss_weights_and_notice(problem, least_squares),
    )
    return InstrumentFit(
        problem,
        nominal,
        state,
        identification,
        least_squares,
        parameter_covariance(problem, state, variance, shares),
        np.sqrt(variance),
        training_data,
        (),
        notices=notices,
    )


def select_laws(
    robot: Robot, fit: InstrumentFit, effect_texts: Sequence[str | Term]
) -> InstrumentLaws:
    """The effects that were asked for; of a law that has several variants the best one.

    fit: of geometry alone.  Raises OptionError.
    """
    from minimax_cal.fitting.multi_instrument.linear_rows import (
        build_common_arm_state,
        build_instrument_rows,
    )
    from minimax_cal.modelling.arm_laws import ArmLaws
    from minimax_cal.selection.forward_selection import select_best_variant  # slow to import

    scene = build_common_arm_state(robot, fit)

    def pick(chosen: Sequence[Term], several: Sequence[Term]) -> Term:
        laws = ArmLaws(scene, build_instrument_rows(scene, fit))
        return cast(Term, select_best_variant(laws, chosen, several))

    each = fit.stack.arm_states(robot, fit.state)
    return InstrumentLaws.from_texts(scene, each, effect_texts, pick)


def fit_with_estimated_noises(
    problem: InstrumentLeastSquares, begin: ParameterValues, options: RelativeOptions
) -> tuple[InstrumentLeastSquares, LeastSquaresSolution[ParameterValues]]:
    """Least squares, instruments and priors weighed by the noises that remain.

    The problem with the weights that it ended with.  A lone instrument without priors has nothing
    to be weighed against.  As `FitTask.fit_least_squares` does.
    """
    points, method = float(problem.stack.points), find_method(options.method)

    def solved(
        problem: InstrumentLeastSquares, begin: ParameterValues = begin
    ) -> LeastSquaresSolution[ParameterValues]:
        found = least_squares.solve(
            problem, begin.batch(), 1, points, method, least_squares.NEAR_START_LIMITS
        )
        if not len(problem.room) or is_within_bounds(
            found.x.take(np.array(0)), problem.effect_bounds
        ):
            return found
        return fit_within_bounds(problem, points, problem.effect_bounds, found)

    if len(problem.stack.blocks) == 1 and not problem.known.has_any:
        return minimise_instrument_loss(problem, solved(problem), options.loss, solved)
    count = [one.degrees_of_freedom for one in problem.stack.instruments]
    none = np.zeros(problem.stack.names.parameter_count, dtype=bool)
    cost = [float(error @ error) for error, _ in problem.stack.rows_by_block(begin, none)]
    variance = np.maximum(np.divide(cost, count), MIN_NOISE**2)
    variance = problem.stack.row_variances(variance)
    for _ in range(MAX_PRIOR_ROUNDS):
        problem = problem.with_variances(variance)
        found = solved(problem)
        state = found.x.take(np.array(0))
        previous, variance = variance, estimate_row_variances(problem, state)
        if np.all(np.abs(variance - previous) <= MAX_SETTLED_NOISE_CHANGE * previous):
            break
    return minimise_instrument_loss(problem, found, options.loss, solved)


def estimate_row_variances(problem: InstrumentLeastSquares, x: ParameterValues) -> Array:
    """(b,) of a number of each block, as given or by what a fit leaves [m^2].

    Each pays for its share of the parameters, tr(H^-1 G_b) of the whole Gram matrix H [Forstner's
    variance components]; a prior pays for parameters of its own.
    """
    if len(problem.scale):
        return problem.stack.row_variances(problem.scale**2)
    cost, spare = residual_squares_and_freedom(problem, x)
    weighing = len(problem.stack.blocks) > 1 or len(problem.weight)
    left = np.maximum(cost / spare, (MIN_NOISE if weighing else MIN_ESTIMATED_POINT_NOISE) ** 2)
    return problem.stack.row_variances(left)


def residual_squares_and_freedom(
    problem: InstrumentLeastSquares, x: ParameterValues
) -> tuple[Array, Array]:
    """(b,) squared error of each block's rows [m^2], and its numbers beyond its parameters."""
    stack = problem.stack
    errors, slopes = zip(*stack.rows_by_block(x, problem.active), strict=True)
    grams = [w * slope @ slope.T for w, slope in zip(stack.precision, slopes, strict=True)]
    inverse = solve_normal_equations(sum(grams) + problem.prior, np.eye(len(grams[0])))
    paid = np.array([float(np.trace(inverse @ gram)) for gram in grams])
    spare = np.maximum([one.degrees_of_freedom for one in stack.instruments] - paid, 1.0)
    return np.array([float(error @ error) for error in errors]), spare


def parameter_covariance(
    problem: InstrumentLeastSquares,
    x: ParameterValues,
    variance: Array,
    loss_weights: LossWeights = EQUAL_LOSS_WEIGHTS,
) -> Array:
    """Covariance (p, p) of all parameters at a solution [SI], NaN where not identified.

    s^2 H^-1 F H^-1 with H = sum w j j' + P and F = sum w^2 j j' + P over the rows j of weight w and
    the priors P: a known distance weighs much and is no surer than a coordinate.  s^2: of a number
    of the best instrument, to which the others are weighed.  variance: (b,) as
    `estimate_row_variances` has it. loss_weights: (rows,) how much more each counts in H, and in F,
    than its weight says.
    """
    active, stack = problem.active, problem.stack
    _, jacobians = stack.rows(x, active)
    inverse = solve_normal_equations(
        (jacobians * loss_weights[0]) @ jacobians.T + problem.prior, np.eye(len(jacobians))
    )
    middle = (jacobians * stack.row_weights(x) * loss_weights[1]) @ jacobians.T + problem.prior
    covariance = np.full((len(active),) * 2, np.nan)
    unit = float((variance * stack.precision).mean())
    covariance[np.ix_(active, active)] = unit * inverse @ middle @ inverse
    return covariance


def check_number_count(
    instruments: Sequence[Instrument], stack: InstrumentStack, unknown_count: int
) -> None:
    """Raise DataError where the training measurements cannot determine the unknowns."""
    for data in instruments:
        data.check_enough_training_data()
    given = sum(one.given_number_count for one in stack.instruments)
    different = sum(data.independent_number_count for data in instruments) + given
    unknown_count -= sum(one.costless_parameter_count for one in stack.instruments)
    if different <= unknown_count:
        where = " and ".join(data.at.source for data in instruments)
        what = instruments[0].words.counted if len(instruments) == 1 else "numbers"
        raise DataError(
            f"{where}: {different} independent {what} in training, but {unknown_count} unknown "
            "parameters need more; measure at more poses, hold out fewer or fix parameters (fix)"
        )


def build_instrument_parameters(robot: Robot, fit: InstrumentFit) -> tuple[Parameter, ...]:
    """Every parameter, link by link; then each instrument's own."""
    every, names = build_all_parameters(robot, fit), fit.stack.names
    own = (build_own_parameters(robot, fit, i) for i in range(len(fit.stack.blocks)))
    return sum(own, every[: 5 * names.joints]) + every[fit.stack.parameter_count_without_laws :]


def build_all_parameters(robot: Robot, fit: InstrumentFit) -> tuple[Parameter, ...]:
    """Links, those of all instruments as they are fitted, and last those of the laws."""
    names = fit.stack.names
    states = map(fit.stack.state_for_display, (fit.nominal, fit.state))
    before, after = (x.values_in_file_convention(np.eye(3), robot) for x in states)
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return build_parameters(names, names.units, before, after, sigma, fit.identification)


def build_own_parameters(robot: Robot, fit: InstrumentFit, i: int) -> tuple[Parameter, ...]:
    """An instrument's own, as people read them."""
    every, place, one = (
        build_all_parameters(robot, fit),
        fit.stack.own_columns(i),
        fit.stack.instruments[i],
    )
    found = [
        every[j]
        for j, name in zip(place, one.names, strict=True)
        if name not in one.given_unknown_names
    ]
    drawn, ended = (fit.stack.blocks[i].own_values(x) for x in fit.states_of_instrument(i))
    told = one.parameters_for_report(ended, drawn, fit.covariance[np.ix_(place, place)])
    if not told:
        return tuple(found)
    kept, rest = found[: one.targets_at.start], found[one.targets_at.start :]
    stem = found[0].name.removesuffix(one.names[0])
    known = all(each.identifiable for each in rest)
    why = "" if known else "same motion as links and base"
    for name, unit, *numbers in told:
        value, was, sigma = map(float, numbers)
        sure = sigma if known else np.nan
        kept.append(Parameter(stem + name, value, was, sure, unit, known, why))
    return tuple(kept)
