"""Parameters of a calibration: what was found, how sure, and why not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, overload

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.files import convert_to_plain_json
from minimax_cal.core.optional_packages import import_optional
from minimax_cal.core.record_fields import FieldFormat, round_to_15_digits
from minimax_cal.core.record_parsing import parse_record_fields
from minimax_cal.core.tables import Table
from minimax_cal.core.units import (
    display_unit_of_change,
    display_unit_of_value,
    file_unit,
    record_in_file_unit,
)
from minimax_cal.fitting.identification import (
    Identification,
    NotIdentifiedReason,
    ReasonKind,
    describe_reason,
)
from minimax_cal.fitting.uncertainty import student_quantile
from minimax_cal.modelling.effects.effect_names import format_parameter
from minimax_cal.modelling.parameters import BASE_PARAMETER_NAMES, ParameterNames

NOT_IDENTIFIED_PREFIX = "not identified because"
CORRECTED_QUANTITIES = {  # parameters that are no values but corrections, and of what
    **dict.fromkeys(BASE_PARAMETER_NAMES, "the base of the drawn arm, along its axes"),
    **dict.fromkeys(
        ("tool_rx", "tool_ry", "tool_rz"), "the tool of the drawn arm, along the flange's axes"
    ),
}


@dataclass(frozen=True)
class Parameter:
    """One parameter in SI; sigma is NaN where it is not identified.

    reason: why it is not; because: of which kind that is; like: the parameters that together move
    the points as it does.
    """

    name: str
    value: float
    nominal: float
    sigma: float
    unit: str = ""
    identifiable: bool = True
    reason: Annotated[str, FieldFormat(brief=True)] = ""
    because: ReasonKind = ReasonKind.OTHER
    like: tuple[str, ...] = ()

    @property
    def is_of_effect(self) -> bool:
        """Whether it belongs to an effect beyond geometry."""
        return ":" in self.name

    @property
    def corrected_quantity(self) -> str:
        """What it is a correction of, empty where it is a value by itself."""
        return CORRECTED_QUANTITIES.get(
            self.name.rpartition(".")[2], ""
        )  # of several files: file.base_x

    @property
    def title(self) -> str:
        """Its name for people, who must not take a correction for a value."""
        return f"{self.name} (correction)" if self.corrected_quantity else self.name

    @property
    def display_scale_and_unit(self) -> tuple[float, str]:
        """Factor and unit in which people read its change: millimetres, milliradians."""
        return display_unit_of_change(self.unit)

    @property
    def file_scale_and_unit(self) -> tuple[float, str]:
        """Factor and unit in files: only lengths are scaled, to millimetres."""
        return file_unit(self.unit)

    @property
    def why_not(self) -> str:
        """Why it was not identified, empty where it was."""
        return "" if self.identifiable else self.reason or "no reason was recorded"

    @property
    def reason_record(self) -> NotIdentifiedReason:
        """Why it is not identified, in one."""
        return NotIdentifiedReason(self.reason, self.because, self.like)

    @property
    def reason_for_display(self) -> str:
        """`why_not`, with other parameters as people call them."""
        if self.identifiable or not self.like:
            return self.why_not
        return describe_reason(self.because, [format_parameter(name) for name in self.like])

    def scaled(self, scale: float, unit: str) -> Parameter:
        """In another unit."""
        value, nominal, sigma = (scale * x for x in (self.value, self.nominal, self.sigma))
        return replace(self, value=value, nominal=nominal, sigma=sigma, unit=unit)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, lengths in millimetres."""
        out = record_in_file_unit(self, "value", "nominal", "sigma")
        out |= {name: round_to_15_digits(out[name]) for name in ("value", "nominal", "sigma")}
        if self.corrected_quantity:
            correction = self.file_scale_and_unit[0] * (self.value - self.nominal)
            out |= {"correction": correction, "corrects": self.corrected_quantity}
        why = ("because", "like") if not self.reason else ()
        return dict(
            convert_to_plain_json({key: value for key, value in out.items() if key not in why})
        )

    @staticmethod
    def from_dict(content: Any, at: str) -> Parameter:
        """From `to_dict`.  Raises ValueError."""
        told = Parameter(**parse_record_fields(Parameter, content, at))
        return told.scaled(1e-3, "m") if told.unit == "mm" else told


@dataclass(frozen=True, repr=False)
class Parameters(Sequence[Parameter]):
    """All p parameters of a fit, link by link; by number or by name.

    dof: degrees of freedom behind their sigmas.
    """

    every: tuple[Parameter, ...]
    dof: float

    def __len__(self) -> int:
        return len(self.every)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.every)

    @overload
    def __getitem__(self, key: int | str) -> Parameter: ...
    @overload
    def __getitem__(self, key: slice) -> Sequence[Parameter]: ...
    def __getitem__(self, key: int | str | slice) -> Parameter | Sequence[Parameter]:
        """A parameter by number or name, or some.  Raises IndexError, KeyError."""
        if isinstance(key, str):
            try:
                return next(p for p in self.every if p.name == key)
            except StopIteration:
                raise KeyError(f"no parameter {key!r}; there are {', '.join(self.names)}") from None
        return self.every[key]

    def __repr__(self) -> str:
        known = sum(p.identifiable for p in self.every)
        return f"<{len(self)} parameters, {known} identified>"

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) as d1 or joint_compliance:J2.c2."""
        return tuple(p.name for p in self.every)

    @property
    def units(self) -> tuple[str, ...]:
        """(p,) SI."""
        return tuple(p.unit for p in self.every)

    @property
    def value(self) -> Array:
        """(p,) [SI]."""
        return np.array([p.value for p in self.every])

    @property
    def nominal(self) -> Array:
        """(p,) [SI]."""
        return np.array([p.nominal for p in self.every])

    @property
    def sigma(self) -> Array:
        """(p,) standard deviations, NaN where not identified [SI]."""
        return np.array([p.sigma for p in self.every])

    @property
    def ci95(self) -> Array:
        """(p, 2) ends of the 95 % intervals by Student's law, NaN where not identified [SI]."""
        half = student_quantile(0.95, self.dof) * self.sigma
        return np.stack([self.value - half, self.value + half], axis=1)

    def frame(self) -> Any:
        """As a pandas data frame, a row a parameter, SI.  Raises OptionError without pandas."""
        low, high = self.ci95.T
        return import_optional("pandas", "a data frame", "pandas").DataFrame(
            {
                "name": self.names, "unit": self.units, "value": self.value,
                "nominal": self.nominal, "sigma": self.sigma, "low95": low, "high95": high,
                "identifiable": [p.identifiable for p in self.every],
                "reason": [p.reason for p in self.every],
            }
        )  # fmt: skip


def build_parameters(
    names: ParameterNames,
    units: Sequence[str],
    nominal_values: Array,
    values: Array,
    sigmas: Array,
    identification: Identification,
) -> tuple[Parameter, ...]:
    """Every parameter in the order in which people read them.

    units: of each, SI.  nominal_values, values, sigmas: (p,) as drawn, as found and how sure [SI].
    """
    order = names.joint_by_joint_order.tolist()
    numbers = (
        part[order].tolist() for part in (values, nominal_values, sigmas, identification.active)
    )
    whys = [identification.reasons.get(names.all_names[i], NotIdentifiedReason("")) for i in order]
    return tuple(
        Parameter(
            names.all_names[i], value, nominal, own, units[i], told, why.text, why.kind, why.like
        )
        for i, value, nominal, own, told, why in zip(order, *numbers, whys, strict=True)
    )


def geometry_parameter_table(parameters: Iterable[Parameter]) -> Table:
    """Parameters of geometry: values in mm and degrees, changes and sigmas in mm and mrad.

    Of a correction there is a change alone: where base and tool stand, their frames say.
    """
    rows: list[tuple[object, ...]] = []
    for p in (each for each in parameters if not each.is_of_effect):
        (size, unit), (scale, of_change) = display_unit_of_value(p.unit), p.display_scale_and_unit
        value = (
            (None, None, "") if p.corrected_quantity else (size * p.nominal, size * p.value, unit)
        )
        change = scale * (p.value - p.nominal)
        rows.append((p.title, *value, change, scale * p.sigma, of_change, p.why_not))
    columns = "name | nominal .4f | calibrated .4f | in | change +.4f | sigma .2g | in"
    return Table.from_rows("parameters", rows, columns, NOT_IDENTIFIED_PREFIX)


def effect_parameter_table(parameters: Iterable[Parameter]) -> Table:
    """Of parameters those of effects, as in the files."""
    rows = (
        (format_parameter(p.name), unit, p.value * scale, p.sigma * scale, p.reason_for_display)
        for p in parameters
        for scale, unit in [p.file_scale_and_unit]
        if p.is_of_effect
    )
    columns = "effect | unit | value .4g | sigma .2g"
    return Table.from_rows("effects beyond geometry", rows, columns, NOT_IDENTIFIED_PREFIX)
