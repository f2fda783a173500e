"""How to calibrate, and whether that can be done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar

import numpy as np

import qp_backends
from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import OptionError
from minimax_cal.core.option_fields import option_field_in_group
from minimax_cal.core.progress_stages import Progress as Progress
from minimax_cal.core.progress_stages import silent_progress as silent_progress
from minimax_cal.core.record_fields import FieldFormat, field_type_hints
from minimax_cal.core.record_parsing import parse_as_type
from minimax_cal.fitting import identification
from minimax_cal.fitting.minimax_problem import DISTANCE_FORMS
from minimax_cal.fitting.robust_fit import LOSSES, SQUARE_LOSS, check_loss_and_trim
from minimax_cal.instruments.instrument_options import InstrumentOptions
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.effects.table import Term
from minimax_cal.modelling.parameters import ParameterNames
from minimax_cal.robots.kinematics import MDH_NAMES
from minimax_cal.solvers import minimax
from minimax_cal.solvers.epigraph_qp import VerifiedQpSolver
from minimax_cal.solvers.least_squares import (
    AUTO_METHOD_NAME,
    JOINT_METHOD_NAME,
    LEAST_SQUARES_METHODS,
)
from minimax_cal.solvers.qp_function import QpFunction, build_verified_qp_solver
from qp_backends import BackendError
from qp_backends import solve as solve_qp
from qp_backends.registry import BackendName, backend

SEED_FORMAT = FieldFormat(least=0)
ONLY_OFFSETS = "offsets"  # what `only` may ask for
FALLBACK_QP_BACKEND = "daqp"  # a required package
QP_FUNCTION_PREFIX = "function "  # before the name of a QP solver that is none of the backends
PRIOR_UNIT_SCALES = {
    "mm": 1e-3,
    "um": 1e-6,
    "m": 1.0,
    "mrad": 1e-3,
    "rad": 1.0,
    "deg": 0.017453292519943295,
}
LENGTH_UNITS = ("mm", "um", "m")


Objective = Literal[
    "sum", "minimax", "point", "pose",
    "smr:1", "smr:2", "smr:3", "smr:4", "smr:5", "smr:6", "smr:7", "smr:8", "smr:9",
]  # fmt: skip
Loss = Literal["square", "huber", "cauchy", "tukey"]
QpSolver = str | QpFunction  # the name may be that of a registered one
QpChoice = BackendName | QpFunction
T = TypeVar("T")


MAX_PRIOR_SIGMA = 3.0  # no arm is so far off its drawing [m, rad]
LEAST_SIGMA, MOST_SIGMA = 1e-12, 1e6  # of a prior that says something [m, rad]


def parse_priors(prior_sigmas: Mapping[str, float | str] | None) -> dict[str, float]:
    """Sigmas of priors in SI, from numbers or texts with a unit.  Raises OptionError."""
    pairs = (prior_sigmas or {}).items()
    return dict(parse_prior(f"{k}={v}") if isinstance(v, str) else (k, v) for k, v in pairs)


def parse_prior(text: str) -> tuple[str, float]:
    """NAME=SIGMA with its unit, as ``a*=0.5mm`` or ``theta2=1mrad``."""
    name, equals, size = text.partition("=")
    kind = name.rstrip("0123456789*")
    for unit in sorted(PRIOR_UNIT_SCALES, key=len, reverse=True):
        if size.endswith(unit) and kind in MDH_NAMES and (kind in "ad") != (unit in LENGTH_UNITS):
            what = "a length: give mm" if kind in "ad" else "an angle: give mrad or deg"
            raise OptionError(f"prior {text!r}: {name} is {what}")
        if equals and name and size.endswith(unit):
            try:
                return name, float(size.removesuffix(unit)) * PRIOR_UNIT_SCALES[unit]
            except ValueError:
                break
    raise OptionError(f"prior {text!r}: write NAME=SIGMA with a unit, as a*=0.5mm or theta2=1mrad")


fitted, solved = option_field_in_group("What is fitted"), option_field_in_group("How it is solved")
held_out, known = option_field_in_group("What is held out"), option_field_in_group("What is known")
OUTLIER_OPTION_GROUP = option_field_in_group("Outliers")


@dataclass(frozen=True)
class Options:
    """How to calibrate.

    objective: sum, minimax (the worst target), point (the worst point), pose, or smr:K.
    qp: backend of the minimax QPs, or a function from Problem to a verified Solution.
    holdout: share of the poses kept out of the fit.  seed: of that choice.
    holdout_by: a column (session, group ...) or region, whose poses are held out together; poses
    that repeat each other or stand in a cluster unless given.
    cv: judge every pose by a fit without it, which is done anyway where fewer than 20 poses are
    held out.  instrument: u95 of a coordinate, as 10um+2.5um/m, where the data do not say.
    fix, free: parameters as ``beta*``, a list or a text with commas.
    only: offsets, for the joints' zero positions alone.
    priors: sigma of a parameter's deviation from nominal, by name [m, rad], or a text as 0.5mm.
    method: of the least squares.  lever: what a radian counts as in the pose objective [m], the
    targets' own unless given.  hessian: gauss-newton or bfgs.
    distance: form of the distance constraints, two-sided, squared or off.
    distance_tolerance: theirs [m], as measured unless given.
    resolution: relative singular value that counts as not measured.
    effects: beyond geometry, as joint_compliance:J2, or a diagnosis (or its file), whose confirmed
    effects are taken.  loss: square, huber, cauchy or tukey.
    trim: share of the points that may be set aside.
    allow_large_changes: accept links that differ from the drawing by more than 5 % of the reach, 5
    degrees (alpha, beta) or 30 degrees (theta).  simulated: the points may be exact.
    """

    objective: str = fitted(
        "minimax",
        "What is minimised: sum, minimax (worst target), point (worst point), pose, or one target "
        "alone, as smr:2. Of pixels: sum (default), minimax or camera (worst camera).",
    )
    qp: QpSolver = solved(  # noqa: RUF009
        "daqp",
        "The backend of the quadratic programs of the minimax; `minimax-cal backends` lists them, "
        "and daqp is the fastest for a calibration.",
    )
    holdout: float = held_out(
        InstrumentOptions.holdout,
        "The share of the poses that the fit does not see; a split column overrides it.",
    )
    seed: int = held_out(InstrumentOptions.seed, "The seed of the choice of held-out poses.")
    holdout_by: str | None = held_out(
        None,
        "Hold out whole groups of poses: a column, as session or group, or region; those are also "
        "left out in turn.",
        metavar="COLUMN",
    )
    cv: bool = held_out(
        False,
        "Cross-validate: judge every pose by a fit without it [default: when fewer than 20 are "
        "held out].",
    )
    fix: Sequence[str] = fitted((), "Keep these parameters nominal, as d2,beta*.", many=tuple)
    free: Sequence[str] = fitted(
        (), "Identify these where several parameters are not distinguishable.", many=tuple
    )
    only: str = fitted("", "Fit the joints' zero positions alone: offsets.", metavar="offsets")
    instrument: str | None = known(
        None,
        "u95 of a coordinate, where the data have no column for it; gives weights and noise floor.",
        metavar="10um+2.5um/m",
    )
    priors: Mapping[str, float] = fitted(
        dict,
        "What is known of a parameter: how far it may be from its nominal value, as a*=0.5mm.",
        flag="--prior",
        metavar="NAME=SIGMA",
        read=parse_prior,
        many=dict,
    )
    effects: Sequence[str | Term] = fitted(
        (),
        "Fit these too, as joint_compliance:all,backlash:J6; `minimax-cal effects` lists them.",
        metavar="NAME:PLACE",
        many=tuple,
    )
    method: str = solved(
        AUTO_METHOD_NAME,
        "The method of least squares: auto (variable projection, damped where a start is far), "
        f"joint (all parameters at once, the fastest), {', '.join(LEAST_SQUARES_METHODS)}.",
    )
    loss: str = OUTLIER_OPTION_GROUP(
        SQUARE_LOSS, f"How errors count, against outliers: {', '.join((SQUARE_LOSS, *LOSSES))}."
    )
    trim: float = OUTLIER_OPTION_GROUP(
        0.0, "Set aside at most this fraction of the points, the largest outliers.", metavar="SHARE"
    )
    hessian: str = solved("gauss-newton", "The Hessian of the minimax: gauss-newton or bfgs.")
    distance: str = solved(
        "two-sided", "How distances between targets are kept: two-sided, squared or off."
    )
    lever: float | None = fitted(
        None, "What a radian counts as in the pose objective [default: the targets' own].", "mm"
    )
    distance_tolerance: float | None = solved(
        None, "How far a distance between targets may be off [default: as measured].", "mm"
    )
    allow_large_changes: bool = known(
        False,
        "Accept links that differ from the drawing by more than 5 % of the reach, 5 degrees "
        "(alpha, beta) or 30 degrees (theta).",
    )
    simulated: bool = known(
        False,
        "The points are of a simulation and may be exact; a file with a column simulated says "
        "so itself.",
    )
    resolution: float = identification.DEFAULT_RESOLUTION

    def settings(self) -> dict[str, object]:
        """For the record, effects in their written form."""
        effects = [e.text if isinstance(e, Term) else e for e in self.effects]
        return {**vars(self), "effects": effects, "qp": qp_solver_name(self.qp)}


def read_options(settings: Mapping[str, object], **given: object) -> Options:
    """The options that a result's file holds, but for those given.  Raises ValueError."""
    texts = dict.fromkeys(("fix", "free", "effects"), tuple[str, ...])
    kinds = {
        **field_type_hints(Options),
        **texts,
        "qp": str,
    }  # effects and a QP solver have names there
    kept: dict[str, object] = {}
    for name in kinds.keys() & settings.keys() - given.keys():
        value, at = settings[name], f"provenance.settings.{name}"
        if value is None and kinds[name] is float:
            raise ValueError(f"{at}: should be a number")
        kept[name] = parse_as_type(
            kinds[name], value, SEED_FORMAT if name == "seed" else FieldFormat(), at
        )
    return Options(**{**kept, **given})  # type: ignore[arg-type]


def split_names(names: str | Sequence[T]) -> Sequence[T | str]:
    """Names from a list, or from one text with commas."""
    if isinstance(names, str):
        return tuple(filter(None, names.replace(" ", "").split(",")))
    return names


def parse_objective_target(objective: str, data: Measurements) -> int:
    """Index of the single target of smr:K, else -1.  Raises OptionError."""
    if objective in ("sum", "minimax", "point", "pose"):
        return -1
    kind, _, which = objective.partition(":")
    if kind != "smr" or not which:
        raise OptionError(
            f"no objective {objective!r}; choose sum, minimax, point, pose or smr:K (K as in smr1)"
        )
    if f"smr{which}" not in data.target_names:
        raise OptionError(
            f"objective {objective}: {data.source} has no target smr{which}; "
            f"it has {', '.join(data.target_names)}"
        )
    return data.target_names.index(f"smr{which}")


def check_options(options: Options) -> None:
    """Raise an error for a choice that does not exist, before any work."""
    for name, value, choices in (
        ("method", options.method, (AUTO_METHOD_NAME, JOINT_METHOD_NAME, *LEAST_SQUARES_METHODS)),
        ("hessian", options.hessian, minimax.HESSIAN_CHOICES),
        ("distance form", options.distance, DISTANCE_FORMS),
    ):
        if value not in choices:
            raise OptionError(f"no {name} {value!r}; choose {', '.join(choices)}")
    if options.only not in ("", ONLY_OFFSETS):
        raise OptionError(f"only {options.only!r}: the only choice is {ONLY_OFFSETS}")
    check_loss_and_trim(options.loss, options.trim)
    check_resolution(options.resolution)
    for name, length in (
        ("lever", options.lever),
        ("distance tolerance", options.distance_tolerance),
    ):
        if length is not None and not 0.0 < length < np.inf:
            raise OptionError(f"{name} {length:g} m: must be positive and finite")
    check_priors(options.priors)


def check_resolution(resolution: float) -> None:
    """Raise OptionError for a share that is none."""
    if not 0.0 <= resolution < 1.0:
        raise OptionError(f"resolution {resolution:g}: give 0 <= resolution < 1")


def select_freed_parameters(
    names: ParameterNames, name_patterns: Sequence[str], is_allowed: Array
) -> Array:
    """(p,) True for what is to be given up last.  Raises OptionError for what is not allowed (p,).

    name_patterns: names or patterns.
    """
    wanted = names.match_patterns(name_patterns, "free")
    if (wanted & ~is_allowed).any():
        name = names.all_names[int(np.argmax(wanted & ~is_allowed))]
        raise OptionError(f"{name} is both fixed and freed; take it out of fix or free")
    return wanted


def prior_sigmas(
    names: ParameterNames, priors: Mapping[str, float], other_parameters: str
) -> Array:
    """(p,) sigma of each parameter's prior, infinite where nothing is known.  Raises OptionError.

    priors: sigma by name or pattern [SI], of which one of `MAX_PRIOR_SIGMA` or more says nothing.
    other_parameters: what is no link, in a message.
    """
    sigma = np.full(names.parameter_count, np.inf)
    for pattern, value in priors.items():
        chosen = names.match_patterns([pattern], "prior")
        if (chosen & ~names.link_mask).any():
            raise OptionError(
                f"prior {pattern}: {other_parameters} have no nominal value to keep to"
            )
        sigma[chosen] = value if value < MAX_PRIOR_SIGMA else np.inf
    return sigma


def check_priors(priors: Mapping[str, float]) -> None:
    """Raise OptionError for a sigma that says nothing.  priors: sigma by name or pattern [SI]."""
    for pattern, sigma in priors.items():
        if not (np.isfinite(sigma) and sigma > 0.0):
            raise OptionError(f"prior {pattern}: sigma {sigma:g} must be positive")
        if not LEAST_SIGMA <= sigma <= MOST_SIGMA:
            mend = "fix it instead" if sigma < LEAST_SIGMA else "leave it out"
            raise OptionError(f"prior {pattern}: sigma {sigma:g} says nothing of an arm; {mend}")


def qp_solver_name(qp: QpSolver) -> str:
    """What a QP solver is called in results."""
    return (
        qp if isinstance(qp, str) else f"{QP_FUNCTION_PREFIX}{getattr(qp, '__name__', 'unnamed')}"
    )


def build_qp_solver(qp: QpSolver, tolerance: float) -> tuple[VerifiedQpSolver, tuple[str, ...]]:
    """The QP solver, and a notice where it is not the one that was named.  Raises OptionError."""
    if not (isinstance(qp, str) or callable(qp)):
        raise OptionError(f"qp={qp!r}: give the name of a backend, or a function")
    if not isinstance(qp, str):
        return build_verified_qp_solver(qp, tolerance, qp_solver_name(qp)), ()
    name, notices = select_usable_qp_backend(qp)
    return partial(solve_qp, name=name, tolerance=tolerance), notices


def select_usable_qp_backend(qp: str) -> tuple[str, tuple[str, ...]]:
    """The QP backend to use, and a notice where it is not the one that was named.

    A backend that exists but is not installed is replaced; a name that does not exist is a
    mistake.  Raises OptionError.
    """
    if qp.startswith(QP_FUNCTION_PREFIX):
        return FALLBACK_QP_BACKEND, (f"QP: the solver was a {qp}; {FALLBACK_QP_BACKEND} is used",)
    try:
        backend(qp)
    except BackendError as error:
        if qp.partition(":")[0] not in qp_backends.names():
            raise OptionError(str(error)) from error
        return FALLBACK_QP_BACKEND, (f"QP: {error}; {FALLBACK_QP_BACKEND} is used",)
    return qp, ()
