"""Parameters of a calibration: what was found, how sure, and why not."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, overload

import numpy as np

from minimax_cal.fitting.identify import Because, Identification, Reason, name_reason
from minimax_cal.fitting.uncertainty import quantile
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.facts import Fact, in_digits
from minimax_cal.ground.files import plain
from minimax_cal.ground.optional import optional
from minimax_cal.ground.records import stored
from minimax_cal.ground.tables import Table
from minimax_cal.ground.units import for_people, in_files, in_own_unit, turned_for_people
from minimax_cal.modelling.effects.words import name_parameter
from minimax_cal.modelling.parameters import BASE_NAMES, Names

NOT_IDENTIFIED = "not identified because"
CORRECTIONS = {  # parameters that are no values but corrections, and of what
    **dict.fromkeys(BASE_NAMES, "the base of the drawn arm, along its axes"),
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
    reason: Annotated[str, Fact(brief=True)] = ""
    because: Because = Because.OTHER
    like: tuple[str, ...] = ()

    @property
    def of_effect(self) -> bool:
        """Whether it belongs to an effect beyond geometry."""
        return ":" in self.name

    @property
    def corrects(self) -> str:
        """What it is a correction of, empty where it is a value by itself."""
        return CORRECTIONS.get(self.name.rpartition(".")[2], "")  # of several files: file.base_x

    @property
    def title(self) -> str:
        """Its name for people, who must not take a correction for a value."""
        return f"{self.name} (correction)" if self.corrects else self.name

    @property
    def scale(self) -> tuple[float, str]:
        """Factor and unit in which people read its change: millimetres, milliradians."""
        return for_people(self.unit)

    @property
    def written(self) -> tuple[float, str]:
        """Factor and unit in files: only lengths are scaled, to millimetres."""
        return in_files(self.unit)

    @property
    def why_not(self) -> str:
        """Why it was not identified, empty where it was."""
        return "" if self.identifiable else self.reason or "no reason was recorded"

    @property
    def why(self) -> Reason:
        """Why it is not identified, in one."""
        return Reason(self.reason, self.because, self.like)

    @property
    def why_in_words(self) -> str:
        """`why_not`, with other parameters as people call them."""
        if self.identifiable or not self.like:
            return self.why_not
        return name_reason(self.because, [name_parameter(name) for name in self.like])

    def scaled(self, scale: float, unit: str) -> Parameter:
        """In another unit."""
        value, nominal, sigma = (scale * x for x in (self.value, self.nominal, self.sigma))
        return replace(self, value=value, nominal=nominal, sigma=sigma, unit=unit)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, lengths in millimetres."""
        out = in_own_unit(self, "value", "nominal", "sigma")
        out |= {name: in_digits(out[name]) for name in ("value", "nominal", "sigma")}
        if self.corrects:
            correction = self.written[0] * (self.value - self.nominal)
            out |= {"correction": correction, "corrects": self.corrects}
        why = ("because", "like") if not self.reason else ()
        return dict(plain({key: value for key, value in out.items() if key not in why}))

    @staticmethod
    def from_dict(content: Any, at: str) -> Parameter:
        """From `to_dict`.  Raises ValueError."""
        told = Parameter(**stored(Parameter, content, at))
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
        half = quantile(0.95, self.dof) * self.sigma
        return np.stack([self.value - half, self.value + half], axis=1)

    def frame(self) -> Any:
        """As a pandas data frame, a row a parameter, SI.  Raises OptionError without pandas."""
        low, high = self.ci95.T
        return optional("pandas", "a data frame", "pandas").DataFrame(
            {
                "name": self.names, "unit": self.units, "value": self.value,
                "nominal": self.nominal, "sigma": self.sigma, "low95": low, "high95": high,
                "identifiable": [p.identifiable for p in self.every],
                "reason": [p.reason for p in self.every],
            }
        )  # fmt: skip


def link_by_link(
    names: Names,
    units: Sequence[str],
    before: Array,
    after: Array,
    sigma: Array,
    known: Identification,
) -> tuple[Parameter, ...]:
    """Every parameter in the order in which people read them.

    units: of each, SI.  before, after, sigma: (p,) as drawn, as found and how sure [SI].
    """
    order = names.link_by_link.tolist()
    numbers = (part[order].tolist() for part in (after, before, sigma, known.active))
    whys = [known.reasons.get(names.all[i], Reason("")) for i in order]
    return tuple(
        Parameter(names.all[i], value, nominal, own, units[i], told, why.text, why.kind, why.like)
        for i, value, nominal, own, told, why in zip(order, *numbers, whys, strict=True)
    )


def parameter_table(parameters: Iterable[Parameter]) -> Table:
    """Parameters of geometry: values in mm and degrees, changes and sigmas in mm and mrad.

    Of a correction there is a change alone: where base and tool stand, their frames say.
    """
    rows: list[tuple[object, ...]] = []
    for p in (each for each in parameters if not each.of_effect):
        (size, unit), (scale, of_change) = turned_for_people(p.unit), p.scale
        value = (None, None, "") if p.corrects else (size * p.nominal, size * p.value, unit)
        change = scale * (p.value - p.nominal)
        rows.append((p.title, *value, change, scale * p.sigma, of_change, p.why_not))
    columns = "name | nominal .4f | calibrated .4f | in | change +.4f | sigma .2g | in"
    return Table.made("parameters", rows, columns, NOT_IDENTIFIED)


def table_of_effects(parameters: Iterable[Parameter]) -> Table:
    """Of parameters those of effects, as in the files."""
    rows = (
        (name_parameter(p.name), unit, p.value * scale, p.sigma * scale, p.why_in_words)
        for p in parameters
        for scale, unit in [p.written]
        if p.of_effect
    )
    columns = "effect | unit | value .4g | sigma .2g"
    return Table.made("effects beyond geometry", rows, columns, NOT_IDENTIFIED)
