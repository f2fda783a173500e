"""What a report reads of the JSON files of a calibration and of a diagnosis; other keys may stand
beside these, and what later versions add may be absent.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def number_or_nan(value: object) -> object:
    """JSON has null where there is no number."""
    return math.nan if value is None else value


def pair_or_nan(value: object) -> object:
    """An interval that is not known."""
    return (math.nan, math.nan) if value is None else value


Number = Annotated[float, BeforeValidator(number_or_nan)]
Interval = Annotated[tuple[Number, Number], BeforeValidator(pair_or_nan)]
Count = Annotated[int, Field(ge=0, lt=10**9)]
Square = Annotated[float, Field(ge=0.0)]
UNKNOWN = (math.nan, math.nan)


class Part(BaseModel):
    """A part of a file, as it was written."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Scores(Part):
    """Accuracy on some poses, with its 95 % intervals where they are known [mm, mm^2]."""

    rms_mm: Number = math.nan
    max_mm: Number = math.nan
    mean_mm: Number = math.nan
    poses: Count = 0
    sse_mm2: list[Square] = []
    points: list[Count] = []
    rms_ci95_mm: Interval = UNKNOWN
    max_ci95_mm: Interval = UNKNOWN


class Accuracies(Part):
    """Before and after, on the held-out and on the training poses."""

    nominal: Scores
    holdout: Scores
    nominal_train: Scores
    train: Scores


class ParameterLine(Part):
    """A parameter in its unit (mm, rad, or that of an effect)."""

    name: str
    unit: str = ""
    value: Number
    nominal: Number = math.nan
    sigma: Number = math.nan
    identifiable: bool = True
    reason: str = ""


class Iteration(Part):
    """One step of the minimax; backend: the QP solver that answered."""

    iteration: int
    value: Number = math.nan
    violation: Number = math.nan
    kkt: Number = math.nan
    length: Number = math.nan
    backend: str = ""


class Distance(Part):
    """A distance between two targets that the minimax keeps."""

    pair: tuple[str, str]
    measured_mm: Number
    tolerance_mm: Number
    multiplier: Number


class Minimax(Part):
    """How the minimax ended; without any function where there was none."""

    functions: list[str] = []
    multipliers: list[Number] = []
    active: list[str] = []
    distances: list[Distance] = []
    kkt: dict[str, Number] = {}
    trace: list[Iteration] = []


class Covariance(Part):
    """Of the identified parameters; without names where the file has none."""

    names: list[str] = []
    units: list[str] = []
    rows: list[list[Number]] = []


class Suspect(Part):
    """A point that does not fit the others.  together: all points of its pose are suspect."""

    line: int
    target: str
    distance_mm: Number = math.nan
    score: Number = math.nan
    chance: Number = math.nan
    together: bool = False


class Provenance(Part):
    """Where a result came from."""

    robot: str = ""
    data: str = ""
    data_sha256: str = ""
    settings: dict[str, Any] = {}
    versions: dict[str, str] = {}


class FitFile(Part):
    """The file of `minimax-cal calibrate -o`."""

    objective: str
    qp: str = ""
    status: str
    advice: str = ""
    iterations: int = 0
    seconds: Number = math.nan
    parameters: list[ParameterLine]
    accuracy: Accuracies
    condition: Number = math.nan
    trace_mm2: list[Number] = []
    minimax: Minimax = Minimax()
    covariance: Covariance = Covariance()
    suspects: list[Suspect] = []
    notices: list[str] = []
    provenance: Provenance


class Rival(Part):
    """An effect that the data cannot tell from the one named."""

    effect: str
    place: str
    rho2: Number = math.nan
    power: Number = math.nan
    loss: Number = math.nan
    separate_with: str = ""


class Fall(Part):
    """Held-out RMS without and with an effect [mm]."""

    before: Number = math.nan
    after: Number = math.nan


class Effect(Part):
    """An effect that was found.  size: lambda.  lines: rows of a fault of the data."""

    effect: str
    place: str
    share: Number = math.nan
    size: Number = Field(alias="lambda", default=math.nan)
    chance: Number = math.nan
    parameters: list[ParameterLine] = []
    holdout_rms_mm: Fall = Fall()
    alternatives: list[Rival] = []
    lines: list[int] = []


class Rung(Part):
    """One step of the gap ladder."""

    step: str
    train: Scores
    holdout: Scores


class Gap(Part):
    """The gap, how far it closes, and what noise would leave."""

    noise_floor_mm: Number = math.nan
    noise_floor_from: str = ""
    closed: Number = math.nan
    closed_ci95: Interval = UNKNOWN
    ladder: Annotated[list[Rung], Field(min_length=2)]
    blocked: dict[str, Number] = {}


class Untestable(Part):
    """What could not be tested, and what that needs."""

    effect: str
    needs: str


class Series(Part):
    """Values along an axis, or of a view; nested by target where each has its own."""

    label: str = ""
    name: str = ""
    values: list[Number] | list[list[Number]] = []


class CurveFile(Part):
    """Something against something, in several views."""

    title: str
    x: Series
    y: Series
    views: list[Series]


class GapFile(Part):
    """The file of `minimax-cal diagnose -o`."""

    robot: str
    status: str
    verdict: Literal["none", "named", "one_of", "unknown", "not_repeatable"]
    reasons: list[str]
    effects: list[Effect]
    gap: Gap
    noise: dict[str, Number] = {}
    structure: dict[str, Any] = {}
    where: dict[str, Any] = {}
    not_testable: list[Untestable] = []
    curves: dict[str, CurveFile] = {}
    suspects: list[Suspect] = []
    notices: list[str] = []
    seconds: Number = math.nan
    provenance: Provenance
