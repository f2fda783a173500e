"""The fit of lengths and of closures: start, identifiable parameters, least squares, sigmas."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from minimax_cal.fitting.fit import Parameter, link_by_link
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.instruments.data import LEAST_LENGTHS, RelativeData
from minimax_cal.fitting.instruments.identify import generic_count, has_scale, identified
from minimax_cal.fitting.instruments.options import (
    Progress,
    RelativeOptions,
    sigmas_of,
    wishes,
)
from minimax_cal.fitting.instruments.rows import (
    Closures,
    Instrument,
    Known,
    Squares,
    Wires,
    arm_at,
    places,
)
from minimax_cal.fitting.instruments.split import before_and_after, free_numbers, misclosures
from minimax_cal.fitting.instruments.start import ball_start, wire_start
from minimax_cal.fitting.solve import LEAST_NOISE, PRIOR_ROUNDS
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.grouping import groups
from minimax_cal.modelling.parameters import State, links_of
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers import least_squares
from minimax_cal.solvers.least_squares import LeastSquares, method_of, solve_normal

SETTLED = 0.01  # relative change of the noise that ends the weighing of priors


@dataclass(frozen=True, eq=False)
class InstrumentFit:
    """What the solver found.

    nominal: the arm as drawn with the instrument fitted to it.  state: the calibrated one.
    numbers: independent numbers fitted.  covariance: (p, p) [SI], NaN where not identified.
    """

    instrument: Instrument
    nominal: State
    state: State
    identification: Identification
    found: LeastSquares[State]
    numbers: int
    covariance: Array


def instrument_of(robot: Robot, train: RelativeData, options: RelativeOptions) -> Instrument:
    """The training measurements as a least-squares problem."""
    if train.kind == "distances":
        return Wires.of(robot, train.at.q, train.wires, train.length)
    labels, number = np.unique(train.socket, return_inverse=True)
    place = {str(label): i for i, label in enumerate(labels)}
    known = options.known_distances
    pairs = np.array([(place[a], place[b]) for a, b, _ in known], dtype=int).reshape(-1, 2)
    distance = np.array([length for _, _, length in known])
    return Closures.of(robot, train.at.q, number, pairs, distance)


def allowed_of(
    robot: Robot, instrument: Instrument, options: RelativeOptions
) -> tuple[Array, Array]:
    """What may be fitted (p,), and what is to be given up last (p,); the base is no unknown."""
    names = instrument.names
    allowed, wanted = wishes(names, options)
    allowed[5 * robot.joints : 5 * robot.joints + 6] = False
    offsets = np.array([name.startswith("offset") for name in names.all])
    return allowed & (options.offset | ~offsets), wanted


def start_of(robot: Robot, instrument: Instrument, q: Array, allowed: Array) -> State:
    """The arm as drawn, and what fits it best."""
    if isinstance(instrument, Closures):
        return ball_start(robot, instrument)
    return wire_start(robot, q, instrument, allowed)


def fit_instrument(
    robot: Robot, train: RelativeData, options: RelativeOptions, progress: Progress
) -> InstrumentFit:
    """Fit the identifiable parameters to the training measurements.  Raises DataError."""
    progress("start")
    instrument = instrument_of(robot, train, options)
    allowed, wanted = allowed_of(robot, instrument, options)
    known = known_of(robot, instrument, options)
    held = np.pad(np.isfinite(known.sigma), (0, len(allowed) - len(known.sigma)))
    nominal = start_of(robot, instrument, train.at.q, allowed)
    progress("identifiable parameters")
    unknowns = generic_count(robot, instrument, nominal, allowed & ~held)
    numbers = check_count(train, unknowns, len(options.known_distances))
    found = identified(
        robot, instrument, nominal, allowed, wanted, known=held, resolution=options.resolution
    )
    progress("least squares")
    problem = Squares(instrument, found.active, known)
    problem, ended = believed(problem, nominal, numbers, options)
    state = ended.x.take(np.array(0))
    return InstrumentFit(
        instrument, nominal, state, found, ended, numbers, covariance_of(problem, state, numbers)
    )


def known_of(robot: Robot, instrument: Instrument, options: RelativeOptions) -> Known:
    """What the user knows of the links."""
    return Known(links_of(robot.mdh), sigmas_of(instrument.names, options))


def believed(
    problem: Squares, begin: State, numbers: int, options: RelativeOptions
) -> tuple[Squares, LeastSquares[State]]:
    """Least squares; with priors, weighed against the noise that remains.

    The problem with the weights that it ended with.  As `solve.Task.squares` does.
    """

    def solved(problem: Squares) -> LeastSquares[State]:
        points, method = float(problem.instrument.points), method_of(options.method)
        return least_squares.solve(problem, begin.batch(), 1, points, method, least_squares.NEAR)

    if problem.known is None or not problem.known.any:
        return problem, solved(problem)
    count = problem.instrument.names.count
    variance = float(problem.normal(begin.batch())[0][0]) / numbers
    for _ in range(PRIOR_ROUNDS):
        problem = replace(problem, weight=problem.known.weights(variance, count))
        found = solved(problem)
        previous, variance = variance, noise_of(problem, found.x.take(np.array(0)), numbers)
        if abs(variance - previous) <= SETTLED * previous:
            break
    return problem, found


def noise_of(problem: Squares, x: State, numbers: int) -> float:
    """Variance of a number by what a fit leaves [m^2]; a prior pays for parameters of its own."""
    error, jacobian = problem.instrument.rows(x, problem.active)
    gram = jacobian @ jacobian.T
    held = np.diag(problem.weight[problem.active]) if len(problem.weight) else 0.0 * gram
    paid = float(np.trace(solve_normal(gram + held, gram)))
    least = LEAST_NOISE**2 if len(problem.weight) else 0.0
    return max(float(error @ error) / max(numbers - paid, 1.0), least)


def covariance_of(problem: Squares, x: State, numbers: int) -> Array:
    """Covariance (p, p) of all parameters at a solution [SI], NaN where not identified.

    s^2 H^-1 F H^-1 with H = sum w j j' + P and F = sum w^2 j j' + P over the rows j of weight w and
    the priors P: a known distance weighs much and is no surer than a coordinate.  s^2: cost over
    spare numbers.
    """
    active = problem.active
    _, jacobians = problem.instrument.rows(x, active)
    known = np.diag(problem.weight[active]) if len(problem.weight) else np.zeros((1, 1))
    bread = solve_normal(jacobians @ jacobians.T + known, np.eye(len(jacobians)))
    meat = (jacobians * problem.instrument.weights) @ jacobians.T + known
    covariance = np.full((len(active),) * 2, np.nan)
    covariance[np.ix_(active, active)] = noise_of(problem, x, numbers) * bread @ meat @ bread
    return covariance


def numbers_of(train: RelativeData) -> tuple[int, int]:
    """How many independent numbers were measured, and how many at different poses."""
    pose = groups(train.at)
    if train.kind == "distances":
        seen = np.isfinite(train.length)
        return int(seen.sum()), sum(len(np.unique(pose[wire])) for wire in seen.T)
    labels = np.unique(train.socket)
    different = [len(np.unique(pose[train.socket == label])) for label in labels]
    return 3 * (train.poses - len(labels)), 3 * (sum(different) - len(labels))


def check_count(train: RelativeData, unknowns: int, known: int) -> int:
    """The numbers measured in training, known distances among them.

    Raises DataError if they cannot determine the unknowns.
    """
    where = train.at.source
    for name, count in zip(train.wires, np.isfinite(train.length).sum(axis=0), strict=True):
        if count < LEAST_LENGTHS:
            raise DataError(
                f"{where}: {name} has {count} lengths in training, and needs {LEAST_LENGTHS}; "
                "measure more or hold out fewer"
            )
    numbers, different = numbers_of(train)
    if different + known <= unknowns:
        what = "lengths" if train.kind == "distances" else "coordinates of visits"
        raise DataError(
            f"{where}: {different + known} independent {what} in training, but {unknowns} unknown "
            "parameters need more; measure at more poses, hold out fewer or fix parameters (fix)"
        )
    return numbers + known


def errors_of(
    robot: Robot, fit: InstrumentFit, data: RelativeData, held: Array
) -> dict[str, Array]:
    """Errors by the keys of a result: (parts, m, 3) each [m], NaN where not measured.

    The error of a length stands first of three; that of a visit is about its socket.
    """
    arm = arm_at(robot, data.at.q)

    def errors(x: State) -> Array:
        if not isinstance(fit.instrument, Wires):
            return misclosures(places(arm, x).T, data.socket, held)[None]
        error = replace(fit.instrument, model=arm, length=data.length).errors(x)
        return np.stack([error, *(np.where(np.isnan(error), np.nan, 0.0),) * 2], axis=-1)

    return before_and_after(errors(fit.nominal), errors(fit.state), held)


def count_numbers(data: RelativeData, held: Array) -> dict[str, int]:
    """Independent numbers behind the errors, by the keys of a result."""
    if data.kind == "distances":
        seen = np.isfinite(data.length)
        trained, left = int(seen[~held].sum()), int(seen[held].sum())
    else:
        trained, left = free_numbers(data.socket, held)
    return {"nominal": left, "holdout": left, "train": trained, "nominal_train": trained}


def parameters_of(robot: Robot, fit: InstrumentFit, *, offset: bool) -> tuple[Parameter, ...]:
    """Every parameter, link by link; then target, anchors and, where fitted, offsets."""
    names = fit.instrument.names
    before, after = (x.along(np.eye(3), robot) for x in (fit.nominal, fit.state))
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    hidden = ("base_",) if offset else ("base_", "offset")
    every = link_by_link(names, names.units, before, after, sigma, fit.identification)
    return tuple(p for p in every if not p.name.startswith(hidden))


def placed(fit: InstrumentFit, data: RelativeData, options: RelativeOptions) -> dict[str, Any]:
    """For JSON: what was fitted besides the robot, in the robot's base and last frame."""
    out: dict[str, Any] = {"target_mm": (1e3 * fit.state.target_positions[0]).tolist()}
    if isinstance(fit.instrument, Wires):
        anchors, offsets = fit.instrument.split(fit.state.effects)
        out["anchors_mm"] = dict(zip(data.wires, (1e3 * anchors).tolist(), strict=True))
        if options.offset:
            out["offsets_mm"] = dict(zip(data.wires, (1e3 * offsets).tolist(), strict=True))
    else:
        centre = fit.instrument.barycentres(places(fit.instrument.model, fit.state)).T
        out["sockets_mm"] = dict(zip(data.sockets, (1e3 * centre).tolist(), strict=True))
        out["known_distances"] = [[a, b, 1e3 * length] for a, b, length in options.known_distances]
        out["scale"] = "known distance" if has_scale(fit.instrument) else "as drawn"
    return out
