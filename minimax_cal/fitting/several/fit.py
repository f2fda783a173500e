"""The fit of all instruments: start, identifiable parameters, least squares, noises, sigmas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import TypeVar, cast

import numpy as np

from minimax_cal.fitting.coaxial import (
    OffsetTrial,
    coaxial_joints,
    identify_with_offset,
    is_offset_shown,
    start_with_offset,
    with_normal_turned,
)
from minimax_cal.fitting.found import Parameter, link_by_link
from minimax_cal.fitting.geometry_fit import MAX_PRIOR_ROUNDS, MIN_NOISE
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.options import QpSolver, freed
from minimax_cal.fitting.several.identify import (
    Alone,
    determined_alone,
    generic_count,
    identified,
    order_of,
    words_of_own,
)
from minimax_cal.fitting.several.laws import Laws
from minimax_cal.fitting.several.options import (
    SUM,
    Progress,
    RelativeOptions,
    sigmas_of,
)
from minimax_cal.fitting.several.robust import ALIKE, Shares, of_loss, with_loss
from minimax_cal.fitting.several.stack import Known, Squares, Stack, started
from minimax_cal.fitting.several.worst import Worst, WorstOverNoise, least_worst
from minimax_cal.fitting.solve import EFFECT_PASSES, without_bounded_effects
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.instruments.instrument import METRE, Instrument
from minimax_cal.modelling.effects.table import Term, at_bounds
from minimax_cal.modelling.near import between, is_kept
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.modelling.rows import MIN_COMPUTED_NOISE
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LeastSquares, method_of, solve_normal
from minimax_cal.solvers.status import Status

SETTLED = 0.01  # relative change of the noises that ends their weighing


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
    where not identified.  noise: (b,) sigma of a row of each instrument [m].  trains: what was
    fitted, by what the file is called.  alone: what each determines by itself, empty where there is
    one.  stiff: the fit of geometry alone, where this one has laws besides.  worst: what a minimax
    rests on, None where the sum was minimised; notices: of it.  lack: that the covariance holds,
    None where it holds none.
    """

    problem: Squares
    nominal: State
    state: State
    identification: Identification
    found: LeastSquares[State]
    covariance: Array
    noise: Array
    trains: Mapping[str, Instrument]
    alone: tuple[Alone, ...]
    stiff: InstrumentFit | None = None
    worst: Worst | None = None
    notices: tuple[str, ...] = ()
    lack: LackOfFit | None = None

    @property
    def stack(self) -> Stack:
        """The instruments, weighed by their noise."""
        return self.problem.stack

    def state_of(self, i: int) -> tuple[State, State]:
        """As drawn and calibrated, of an instrument."""
        return self.stack.part(self.nominal, i), self.stack.part(self.state, i)


F = TypeVar("F", bound=InstrumentFit)


def stack_of(robot: Robot, trains: Mapping[str, Instrument], options: RelativeOptions) -> Stack:
    """The training measurements as a least-squares problem."""
    alone = [each.ready(robot, options) for each in trains.values()]
    every = [one.beside([*alone[:i], *alone[i + 1 :]]) for i, one in enumerate(alone)]
    stack = Stack.of(robot, every, [*trains])
    given = [options.noises.get(label, np.nan) for label in stack.labels]
    of_rows = [sigma * one.row_noise for sigma, one in zip(given, every, strict=True)]
    return replace(stack, given=np.square(of_rows))


def allowed_of(stack: Stack, options: RelativeOptions) -> tuple[Array, Array]:
    """What may be fitted (p,), and what is to be given up last (p,); the base is no unknown."""
    names = stack.names
    allowed = ~names.match(options.fix, "fix")
    wanted = freed(names, options.free, allowed)
    allowed[5 * names.joints : names.geometric] = False
    for i, one in enumerate(stack.instruments):
        allowed[stack.own(i)] &= [name not in one.held for name in one.names]
    return allowed, wanted


def start_of(robot: Robot, stack: Stack, allowed: Array) -> State:
    """The arm as drawn, and what fits it best."""
    every = enumerate(stack.instruments)
    return stack.state(robot.mdh, [started(robot, one, allowed[stack.own(i)]) for i, one in every])


def fit_instruments(
    robot: Robot, trains: Mapping[str, Instrument], options: RelativeOptions, progress: Progress
) -> InstrumentFit:
    """Fit the identifiable parameters to the training measurements.  Raises DataError."""
    # Start: the arm as drawn, and base, targets and unknowns of the instruments that fit it best.
    progress("start")
    trains = {label: data.in_order() for label, data in trains.items()}
    stack = stack_of(robot, trains, options)
    allowed, preferred = allowed_of(stack, options)
    known = Known(links_of(robot.mdh), sigmas_of(stack.names, options))
    nominal = start_of(robot, stack, allowed)

    # Which parameters the rows determine: against what plenty of poses would.
    progress("identifiable parameters")
    reference = stack.reference(robot, nominal)
    has_prior = known.told(stack.names.count)
    unknowns = generic_count(robot, reference, nominal, allowed & ~has_prior)
    check_count([*trains.values()], stack, unknowns)
    offsets = np.zeros(stack.names.count, dtype=bool)  # by which coaxial axes were found apart

    def identify(stack: Stack, known: Known, x: State) -> Identification:
        more = (0, len(stack.laws.names))
        return identified(
            robot, stack, reference, x, np.pad(allowed, more, constant_values=True),
            np.pad(preferred, more),
            known=known.told(stack.names.count) | np.pad(offsets, more),
            resolution=options.resolution,
        )  # fmt: skip

    # Least squares, instruments weighed by the noises that remain; again, since one that is rough
    # then determines less than it seemed to.
    identification = identify(stack, known, nominal)
    progress("least squares")
    problem = Squares(stack, identification.active, known)
    problem, ended = weighed(problem, nominal, options)
    if len(trains) > 1:
        identification = identify(problem.stack, known, nominal)
        problem = replace(problem, active=identification.active)
        problem, ended = weighed(problem, nominal, options)

    # Axes that are drawn coaxial: apart in any direction, if the rows show it.
    for joint in coaxial_joints(robot):
        trial = try_offset(robot, problem, ended, joint, allowed, reference)
        if trial is None:
            continue
        offsets |= trial.joined
        problem = Squares(problem.stack, trial.active, known)
        problem, ended = weighed(problem, trial.begin, options)
        gram = problem.stack.closed(robot, trial.begin).gram(trial.begin)
        identification = identify_with_offset(
            identification, stack.names, trial, gram, *words_of_own(problem.stack)
        )
    fit = geometric = solved(problem, ended, nominal, identification, trains)

    # Effects beside the geometry: linear where it ended, then for finite rotations too.
    if options.effects:
        progress("effects")
        laws = laws_of(robot, geometric, options.effects)
        for _ in range(EFFECT_PASSES):
            fit = fit_with_laws(robot, fit, laws, known, identify, options)
        fit = replace(fit, stiff=geometric)

    # The minimax.  Parts of several files compare by the noises of these, which the sum gave.
    if options.objective != SUM and fit.found.status[0] is not Status.FAILED:
        part, names = fit.stack.part_of_rows(fit.state), fit.stack.parts
        in_metres = {one.unit for one in fit.stack.instruments} == {METRE}
        kind = Worst if in_metres else WorstOverNoise
        fit, share = at_worst(fit, part, names, 1, options.qp, MIN_NOISE, kind)
        variance = np.square(fit.noise)
        covariance = covariance_of(fit.problem, fit.state, variance, (share, share**2))
        fit = replace(fit, covariance=covariance)

    # What each of several instruments determines by itself.
    if len(trains) > 1:
        closed, active = fit.stack.closed(robot, fit.nominal), fit.identification.active
        alone = determined_alone(closed, fit.nominal, active, options.resolution)
        fit = replace(fit, alone=alone)
    return fit


def try_offset(
    robot: Robot,
    problem: Squares,
    ended: LeastSquares[State],
    joint: int,
    allowed: Array,
    reference: Stack,
) -> OffsetTrial | None:
    """The fit in which a coaxial axis and its next are apart, where that fit begins at its end.

    None where the rows do not show it.  reference: the instruments at plenty of poses.
    """
    stack, state = problem.stack, ended.x.take(np.array(0))
    order = order_of(robot, stack)
    trial = start_with_offset(robot, state, joint, problem.active, allowed, order, reference.gram)
    if trial is None:
        return None
    method, limits = method_of(least_squares.AUTO), least_squares.NEAR

    def solved(problem: Squares, begin: State) -> LeastSquares[State]:
        return least_squares.solve(problem, begin.batch(), 1, float(stack.points), method, limits)

    def solved_along(angle: float) -> State:
        mdh = with_normal_turned(robot, state.mdh, joint, trial.active, angle)
        return solved(problem, start_of(robot.with_mdh(mdh), stack, allowed)).x.take(np.array(0))

    # Tool or base turn with the normal, along a curve that steps follow slowly: where the normal
    # lies is found first, from the two coordinates of the offset, each of a fit along it.
    across = solved_along(np.pi / 2.0).mdh[joint, 0]
    angle = np.arctan2(across, state.mdh[joint, 0])
    found = solved(replace(problem, active=trial.active), solved_along(float(angle)))
    spare = float(sum(one.degrees for one in stack.instruments) - trial.active.sum())
    if not is_offset_shown(float(ended.cost[0]), float(found.cost[0]), trial.joined, spare):
        return None
    return replace(trial, begin=found.x.take(np.array(0)))


def at_worst(
    fit: F, of: Array, names: Sequence[str], numbers: int, qp: QpSolver, rounding: float,
    kind: type[Worst],
) -> tuple[F, Array]:  # fmt: skip
    """The minimax from a fit of the sum, and (r,) how much each row counts in it.

    of: (r,) which of the names each row is of, else as `RowMinimax.at` has it, as numbers.
    rounding: as of `least_worst`.
    """
    some = of >= 0
    seen, number = np.unique(of[some], return_inverse=True)
    of, number = of.copy(), number.reshape(-1)
    of[some] = number
    best, share, notes = least_worst(fit.problem, of, numbers, fit.state, qp, rounding)

    # Errors in other units than metres compare by the noises of their files.
    units = fit.noise if kind is WorstOverNoise else repeat(1.0)

    def sizes(x: State) -> Array:
        none = np.zeros(fit.stack.names.count, dtype=bool)
        blocks = zip(units, fit.stack.rows_by_block(x, none), strict=False)
        error = np.concatenate([error / unit for unit, (error, _) in blocks])
        square = numbers * np.bincount(number, error[some] ** 2)
        return np.asarray(np.sqrt(square / np.bincount(number)))

    worst = kind.of([names[i] for i in seen], sizes(fit.state), sizes(best.x), best)
    found = replace(fit.found, status=(best.status,), iterations=np.array([best.iterations]))
    return replace(fit, state=best.x, found=found, worst=worst, notices=notes), share


def fit_with_laws(
    robot: Robot,
    fit: InstrumentFit,
    laws: Laws,
    known: Known,
    identify: Callable[[Stack, Known, State], Identification],
    options: RelativeOptions,
) -> InstrumentFit:
    """Geometry and effects together, from a fit whose laws are linear where it ended.

    known: of the links.  identify: the parameters that rows, priors and a state determine.
    """
    scenes = fit.stack.scenes(robot, fit.state)
    stack, begin = fit.stack.bent(robot, laws, fit.state)
    names, first_law = stack.names, stack.lawless - stack.names.geometric
    own = fit.nominal.effects[:first_law]
    drawn = replace(fit.nominal, effects=np.pad(own, (0, len(laws.names))))
    known = replace(known, laws=laws.sigma(scenes[0]))
    identification = identify(stack, known, drawn)
    begin.effects[np.flatnonzero(~identification.active[stack.lawless :]) + first_law] = 0.0
    problem = Squares(stack, identification.active, known, room=laws.room(scenes))
    fit = solved(*weighed(problem, begin, options), drawn, identification, fit.trains)

    # A parameter of a law at its bound is not identified: it has no sigma.
    is_at_bound = at_bounds(stack.values(fit.state), problem.room)
    if not is_at_bound.any():
        return fit
    known_now = without_bounded_effects(identification, names, np.pad(is_at_bound, (first_law, 0)))
    problem = replace(fit.problem, active=known_now.active)
    shares, _ = of_loss(problem, fit.found)
    covariance = covariance_of(problem, fit.state, np.square(fit.noise), shares)
    return replace(fit, identification=known_now, covariance=covariance)


def solved(
    problem: Squares,
    ended: LeastSquares[State],
    nominal: State,
    told: Identification,
    trains: Mapping[str, Instrument],
) -> InstrumentFit:
    """What a solved problem says."""
    state = ended.x.take(np.array(0))
    variance, (shares, notices) = variances(problem, state), of_loss(problem, ended)
    return InstrumentFit(
        problem, nominal, state, told, ended, covariance_of(problem, state, variance, shares),
        np.sqrt(variance), trains, (), notices=notices,
    )  # fmt: skip


def laws_of(robot: Robot, fit: InstrumentFit, texts: Sequence[str | Term]) -> Laws:
    """The effects that were asked for; of a law that has several variants the best one.

    fit: of geometry alone.  Raises OptionError.
    """
    from minimax_cal.evidence.selection import best_variant  # slow to import
    from minimax_cal.fitting.several.linear import rows_of_all, scene_of_all
    from minimax_cal.modelling.dictionary import ArmLaws

    scene = scene_of_all(robot, fit)

    def pick(chosen: Sequence[Term], several: Sequence[Term]) -> Term:
        laws = ArmLaws(scene, rows_of_all(scene, fit))
        return cast(Term, best_variant(laws, chosen, several))

    each = fit.stack.scenes(robot, fit.state)
    return Laws.of(scene, each, texts, pick)


def weighed(
    problem: Squares, begin: State, options: RelativeOptions
) -> tuple[Squares, LeastSquares[State]]:
    """Least squares, instruments and priors weighed by the noises that remain.

    The problem with the weights that it ended with.  A lone instrument without priors has nothing
    to be weighed against.  As `FitTask.fit_least_squares` does.
    """
    points, method = float(problem.stack.points), method_of(options.method)

    def solved(problem: Squares, begin: State = begin) -> LeastSquares[State]:
        found = least_squares.solve(problem, begin.batch(), 1, points, method, least_squares.NEAR)
        if not len(problem.room) or is_kept(found.x.take(np.array(0)), problem.whole_room):
            return found
        return between(problem, points, problem.whole_room, found)

    if len(problem.stack.blocks) == 1 and not problem.known.any:
        return with_loss(problem, solved(problem), options.loss, solved)
    count = [one.degrees for one in problem.stack.instruments]
    none = np.zeros(problem.stack.names.count, dtype=bool)
    cost = [float(error @ error) for error, _ in problem.stack.rows_by_block(begin, none)]
    variance = np.maximum(np.divide(cost, count), MIN_NOISE**2)
    variance = problem.stack.variance(variance)
    for _ in range(MAX_PRIOR_ROUNDS):
        problem = problem.believed(variance)
        found = solved(problem)
        state = found.x.take(np.array(0))
        previous, variance = variance, variances(problem, state)
        if np.all(np.abs(variance - previous) <= SETTLED * previous):
            break
    return with_loss(problem, found, options.loss, solved)


def variances(problem: Squares, x: State) -> Array:
    """(b,) of a number of each block, as given or by what a fit leaves [m^2].

    Each pays for its share of the parameters, tr(H^-1 G_b) of the whole Gram matrix H [Forstner's
    variance components]; a prior pays for parameters of its own.
    """
    if len(problem.scale):
        return problem.stack.variance(problem.scale**2)
    cost, spare = remaining(problem, x)
    weighing = len(problem.stack.blocks) > 1 or len(problem.weight)
    left = np.maximum(cost / spare, (MIN_NOISE if weighing else MIN_COMPUTED_NOISE) ** 2)
    return problem.stack.variance(left)


def remaining(problem: Squares, x: State) -> tuple[Array, Array]:
    """(b,) squared error of each block's rows [m^2], and its numbers beyond its parameters."""
    stack = problem.stack
    errors, slopes = zip(*stack.rows_by_block(x, problem.active), strict=True)
    grams = [w * slope @ slope.T for w, slope in zip(stack.precision, slopes, strict=True)]
    inverse = solve_normal(sum(grams) + problem.prior, np.eye(len(grams[0])))
    paid = np.array([float(np.trace(inverse @ gram)) for gram in grams])
    spare = np.maximum([one.degrees for one in stack.instruments] - paid, 1.0)
    return np.array([float(error @ error) for error in errors]), spare


def covariance_of(problem: Squares, x: State, variance: Array, shares: Shares = ALIKE) -> Array:
    """Covariance (p, p) of all parameters at a solution [SI], NaN where not identified.

    s^2 H^-1 F H^-1 with H = sum w j j' + P and F = sum w^2 j j' + P over the rows j of weight w and
    the priors P: a known distance weighs much and is no surer than a coordinate.  s^2: of a number
    of the best instrument, to which the others are weighed.  variance: (b,) as `variances` has it.
    shares: (rows,) how much more each counts in H, and in F, than its weight says.
    """
    active, stack = problem.active, problem.stack
    _, jacobians = stack.rows(x, active)
    inverse = solve_normal(
        (jacobians * shares[0]) @ jacobians.T + problem.prior, np.eye(len(jacobians))
    )
    middle = (jacobians * stack.weights(x) * shares[1]) @ jacobians.T + problem.prior
    covariance = np.full((len(active),) * 2, np.nan)
    unit = float((variance * stack.precision).mean())
    covariance[np.ix_(active, active)] = unit * inverse @ middle @ inverse
    return covariance


def check_count(every: Sequence[Instrument], stack: Stack, unknowns: int) -> None:
    """Raise DataError where the training measurements cannot determine the unknowns."""
    for data in every:
        data.check_training()
    given = sum(one.given for one in stack.instruments)
    different = sum(data.independent for data in every) + given
    unknowns -= sum(one.costless for one in stack.instruments)
    if different <= unknowns:
        where = " and ".join(data.at.source for data in every)
        what = every[0].words.counted if len(every) == 1 else "numbers"
        raise DataError(
            f"{where}: {different} independent {what} in training, but {unknowns} unknown "
            "parameters need more; measure at more poses, hold out fewer or fix parameters (fix)"
        )


def parameters_of(robot: Robot, fit: InstrumentFit) -> tuple[Parameter, ...]:
    """Every parameter, link by link; then each instrument's own."""
    every, names = every_parameter(robot, fit), fit.stack.names
    own = (own_parameters(robot, fit, i) for i in range(len(fit.stack.blocks)))
    return sum(own, every[: 5 * names.joints]) + every[fit.stack.lawless :]


def every_parameter(robot: Robot, fit: InstrumentFit) -> tuple[Parameter, ...]:
    """Links, those of all instruments as they are fitted, and last those of the laws."""
    names = fit.stack.names
    states = map(fit.stack.read_out, (fit.nominal, fit.state))
    before, after = (x.along(np.eye(3), robot) for x in states)
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return link_by_link(names, names.units, before, after, sigma, fit.identification)


def own_parameters(robot: Robot, fit: InstrumentFit, i: int) -> tuple[Parameter, ...]:
    """An instrument's own, as people read them."""
    every, place, one = every_parameter(robot, fit), fit.stack.own(i), fit.stack.instruments[i]
    found = [every[j] for j, name in zip(place, one.names, strict=True) if name not in one.held]
    drawn, ended = (fit.stack.blocks[i].own(x) for x in fit.state_of(i))
    told = one.told(ended, drawn, fit.covariance[np.ix_(place, place)])
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
