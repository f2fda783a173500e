"""The result of a calibration: what was found, how well it does, and where it came from."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from minimax_cal.fitting.certificate import Certificate
from minimax_cal.fitting.identify import Identification
from minimax_cal.fitting.intervals import Interval, max_interval, rms_interval
from minimax_cal.fitting.minimax_problem import Distances
from minimax_cal.fitting.suspects import Suspect, table_of
from minimax_cal.fitting.uncertainty import Uncertainty
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.files import json_text, write_whole
from minimax_cal.ground.tables import Cell as TableCell
from minimax_cal.ground.tables import Table
from minimax_cal.measuring.accuracy import Accuracy, accuracy
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.pose_rows import pose_rows
from minimax_cal.modelling.cell import Cell
from minimax_cal.modelling.parameters import State
from minimax_cal.robots.robot import Robot
from minimax_cal.solvers.minimax import Optimum
from minimax_cal.solvers.status import Status

SCHEMA = 1
PACKAGES = ("minimax-cal", "numpy", "scipy", "qpsolvers")


@dataclass(frozen=True)
class Parameter:
    """One parameter in SI; sigma is NaN where it is not identified, reason says why it is not."""

    name: str
    value: float
    nominal: float
    sigma: float
    unit: str
    identifiable: bool
    reason: str = ""

    def to_dict(self) -> dict[str, object]:
        """For JSON, lengths in millimetres."""
        scale = 1e3 if self.unit == "m" else 1.0
        out: dict[str, object] = {
            "name": self.name,
            "value": self.value * scale,
            "nominal": self.nominal * scale,
            "sigma": None if math.isnan(self.sigma) else self.sigma * scale,
            "unit": "mm" if self.unit == "m" else self.unit,
            "identifiable": self.identifiable,
        }
        return out | ({"reason": self.reason} if self.reason else {})


@dataclass(frozen=True)
class Provenance:
    """Where a result came from, so that it can be had again."""

    robot: str
    data: str
    data_sha256: str
    settings: Mapping[str, object]
    versions: Mapping[str, str]

    @staticmethod
    def of(robot: Robot, data: Measurements, settings: Mapping[str, object]) -> Provenance:
        """Of this run, on this machine."""
        plain = {
            key: None if isinstance(value, float) and math.isnan(value) else value
            for key, value in settings.items()
        }
        versions = {name: version(name) for name in PACKAGES}
        versions["python"] = platform.python_version()
        return Provenance(robot.name, data.source, data.digest, plain, versions)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated robot and everything that is known about the fit.

    robot: calibrated, usable wherever a robot is.  cell: with base and targets.  nominal: the
    nominal robot with its best base and targets.  accuracy: nominal and holdout on the held-out
    poses, nominal_train and train on the training poses.  errors: (k, m, 3) measured minus
    predicted points under the same keys, NaN where not measured [m].  uncertainty: of all
    parameters, base in its own axes [SI].  worst: the minimax answer, if one was asked for.
    certificates: how far the worst point is from its optimum, where it was the objective.
    trace: cost at each iterate of the least squares [m^2].
    data: all poses, with their history where effects need it.  held: (m,) True where held out.
    loss: of the least squares.  suspects: training points that stand out from the fit.
    weights: (k, training poses) of the points besides their u95, 0 where set aside.
    """

    robot: Robot
    cell: Cell
    nominal: Cell
    objective: str
    qp: str
    status: Status
    iterations: int
    seconds: float
    parameters: tuple[Parameter, ...]
    accuracy: Mapping[str, Accuracy]
    errors: Mapping[str, Array]
    identification: Identification
    uncertainty: Uncertainty
    worst: tuple[Optimum[State], ...]
    certificates: tuple[Certificate, ...]
    distances: Distances
    trace: tuple[float, ...]
    data: Measurements
    held: Array
    notices: tuple[str, ...]
    loss: str
    suspects: tuple[Suspect, ...]
    weights: Array
    provenance: Provenance

    @property
    def worst_mm2(self) -> tuple[float, ...]:
        """F_i of the training poses [mm^2]."""
        return self.accuracy["train"].sse_mm2

    @property
    def covariance(self) -> Array:
        """(p, p) of all parameters, NaN where not identified [SI, base in its own axes]."""
        return self.uncertainty.covariance

    @cached_property
    def intervals(self) -> Mapping[str, tuple[Interval, Interval]]:
        """95 % intervals of RMS and largest error on poses like those held out, by key."""
        rng = np.random.default_rng(int(str(self.provenance.settings.get("seed", 0))))
        return {
            key: (rms_interval(self.errors[key], rng=rng), max_interval(self.errors[key], rng=rng))
            for key in ("nominal", "holdout")
        }

    def predict(self, q: Array) -> Array:
        """Where the instrument should see each target: (m, k, 3) [m].  q: (m, n) [rad, m]."""
        return self.cell.predict(q)

    def accuracy_table(self) -> Table:
        """Accuracy before and after, on the training and on the held-out poses."""
        rows: list[tuple[TableCell, ...]] = []
        for title, key in (
            ("training, nominal", "nominal_train"),
            ("training, calibrated", "train"),
            ("held out, nominal", "nominal"),
            ("held out, calibrated", "holdout"),
        ):
            a = self.accuracy[key]
            each = [
                math.sqrt(f / m) if m else math.nan
                for f, m in zip(a.sse_mm2, a.counts, strict=True)
            ]
            rows.append((title, a.poses, a.rms_mm, a.mean_mm, a.max_mm, *each))
        targets = tuple(f"{name} RMS mm" for name in self.cell.target_names)
        return Table(
            f"{self.robot.name}: position accuracy, objective {self.objective}",
            ("poses", "count", "RMS mm", "mean mm", "max mm", *targets),
            tuple(rows),
            ("", "d", *[".4f"] * (3 + len(targets))),
        )

    def interval_rows(self) -> Table:
        """95 % intervals of the held-out accuracy; empty where the poses are too few."""
        rows = tuple(
            (title, a.rms_mm, 1e3 * rms.low, 1e3 * rms.high, a.max_mm, 1e3 * largest.low,
             1e3 * largest.high)
            for title, key in (("nominal", "nominal"), ("calibrated", "holdout"))
            for a, (rms, largest) in [(self.accuracy[key], self.intervals[key])]
            if math.isfinite(rms.low)
        )  # fmt: skip
        return Table(
            "held out, with 95 % intervals: of the RMS over such poses, of the largest error of as "
            "many new ones",
            ("robot", "RMS mm", "from", "to", "max mm", "from", "to"),
            rows,
            ("", *[".4f"] * 6),
        )

    def parameter_rows(self) -> Table:
        """Every parameter with its nominal value, change and sigma, in mm and mrad."""
        rows = []
        for p in self.parameters:
            if p.unit not in ("m", "rad") or ":" in p.name:
                continue  # effects have a table of their own
            # millimetres and milliradians: 1e3 serves both
            scale, unit = 1e3, "mm" if p.unit == "m" else "mrad"
            fixed = p.reason or "not identifiable"
            rows.append(
                (
                    p.name,
                    unit,
                    p.nominal * scale,
                    (p.value - p.nominal) * scale,
                    p.sigma * scale,
                    "" if p.identifiable else fixed,
                )
            )
        return Table(
            "parameters",
            ("name", "unit", "nominal", "change", "sigma", "not identified because"),
            tuple(rows),
            ("", "", ".4f", "+.4f", ".4f", ""),
        )

    def effect_rows(self) -> Table:
        """The parameters of effects beyond geometry, SI; empty without any."""
        rows = tuple(
            (p.name, p.unit, p.value, p.sigma, "" if p.identifiable else p.reason)
            for p in self.parameters
            if ":" in p.name
        )
        header = ("effect", "unit", "value", "sigma", "not identified because")
        return Table("effects beyond geometry", header, rows, ("", "", ".4g", ".2g", ""))

    def minimax_table(self) -> Table:
        """What the minimax of targets found: errors, multipliers, activity; empty without one."""
        rows: list[tuple[TableCell, ...]] = []
        for best in self.worst:
            for i in self.telling(best):
                active = "yes" if self.is_active(best)[i] else ""
                rows.append((self.labels[i], self.sizes[i], float(best.mu[i]), active))
        header = ("target", "F_i mm^2", "multiplier", "active")
        title = "worst target on the training poses"
        return Table(title, header, tuple(rows), ("", ".4f", ".4f", ""))

    def telling(self, best: Optimum[State]) -> list[int]:
        """The functions worth a row: every target, or the points with a multiplier."""
        order = np.argsort(-best.mu) if self.objective == "point" else np.arange(len(best.mu))
        return [int(i) for i in order if self.objective != "point" or best.mu[i] > 1e-6]

    def is_active(self, best: Optimum[State]) -> Array:
        """True where a function equals the largest to 1e-6."""
        return np.asarray(best.f >= best.f.max() * (1 - 1e-6))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the functions of the minimax: targets, or points by line of the file."""
        if self.objective != "point":
            return self.cell.target_names
        return tuple(
            f"{self.cell.target_names[target]} line {self.data.line[~self.held][pose]}"
            for target, pose in np.argwhere(self.weights > 0.0)
        )

    @property
    def sizes(self) -> tuple[float, ...]:
        """F_i [mm^2] of the targets, or distances of points [mm], of the training points kept."""
        if self.objective != "point":
            return accuracy(np.sqrt(self.weights)[..., None] * self.errors["train"]).sse_mm2
        distance = 1e3 * np.linalg.norm(self.errors["train"], axis=-1)
        return tuple(distance[self.weights > 0.0].tolist())

    def headline(self) -> str:
        """The result in a sentence or two."""
        before, after = self.accuracy["nominal"], self.accuracy["holdout"]
        where = f"on {after.poses} poses that were not used for the fit"
        if not after.poses:
            before, after = self.accuracy["nominal_train"], self.accuracy["train"]
            where = f"on the {after.poses} poses of the fit itself (none was held out)"
        identified = sum(p.identifiable for p in self.parameters)
        text = (
            f"RMS error {before.rms_mm:.3f} mm -> {after.rms_mm:.3f} mm, largest "
            f"{before.max_mm:.3f} mm -> {after.max_mm:.3f} mm, {where}. "
            f"{identified} of {len(self.parameters)} parameters identified "
            f"(condition {self.identification.condition:.3g}); {self.status} after "
            f"{self.iterations} iterations, {self.seconds:.2f} s."
        )
        return text + (f" {self.status.advice}." if self.status.advice else "")

    def tables(self) -> tuple[Table, ...]:
        """Every table of the result."""
        worst = (self.minimax_table(),) if self.worst and self.objective != "point" else ()
        worst = (*worst, *(proof.table() for proof in self.certificates))
        effects = (self.effect_rows(),) if self.cell.effects.terms else ()
        sure = self.interval_rows()
        sure_of = (sure,) if sure.rows else ()
        suspects = (table_of(self.suspects),) if self.suspects else ()
        return (
            self.accuracy_table(), *sure_of, *worst, *effects, *suspects, self.parameter_rows()
        )  # fmt: skip

    def summary(self, width: int = 110) -> str:
        """The result as plain text."""
        return "\n\n".join([*(table.text(width) for table in self.tables()), self.headline()])

    def to_dict(self) -> dict[str, Any]:
        """The JSON of the contract, and more."""
        out: dict[str, Any] = {
            "schema": SCHEMA,
            "kind": "calibration",
            "robot": self.robot.to_dict(),
            "nominal_robot": self.nominal.robot.to_dict(),
            **self.cell.to_dict(),
            "nominal_cell": self.nominal.to_dict(),
            "objective": self.objective,
            "loss": self.loss,
            "suspects": [suspect.to_dict() for suspect in self.suspects],
            "qp": self.qp,
            "status": str(self.status),
            "advice": self.status.advice,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "parameters": [p.to_dict() for p in self.parameters],
            "accuracy": {
                key: value.to_dict() | self.ends(key) for key, value in self.accuracy.items()
            },
            "condition": finite(self.identification.condition),
            "covariance": self.uncertainty.to_dict(),
            "trace_mm2": [value * 1e6 for value in self.trace],
            "poses": pose_rows(
                self.data,
                self.held,
                {"nominal": self.nominal.error(self.data), "final": self.cell.error(self.data)},
            ),
            "notices": list(self.notices),
            "provenance": vars(self.provenance),
        }
        for best in self.worst:
            chosen = self.telling(best)
            active = self.is_active(best)
            out["minimax"] = {
                "functions": [self.labels[i] for i in chosen],
                "multipliers": [float(best.mu[i]) for i in chosen],
                "active": [self.labels[i] for i in np.flatnonzero(active)],
                "distances": [
                    {
                        "pair": [self.cell.target_names[a], self.cell.target_names[b]],
                        "measured_mm": float(mean) * 1e3,
                        "tolerance_mm": float(tolerance) * 1e3,
                        "multiplier": float(lam),
                    }
                    for (a, b), mean, tolerance, lam in zip(
                        self.distances.pairs,
                        self.distances.mean,
                        self.distances.tolerance,
                        best.lam if len(best.lam) else np.zeros(len(self.distances.mean)),
                        strict=True,
                    )
                ],
                "kkt": vars(best.kkt),
                "iterations": best.iterations,
                "trace": [vars(step) for step in best.trace],
            }
        for proof in self.certificates:
            out["certificate"] = proof.to_dict()
        return out

    def ends(self, key: str) -> dict[str, list[float | None]]:
        """The intervals of some poses for JSON; nothing for training poses."""
        names = ("rms_ci95_mm", "max_ci95_mm")
        return {
            name: [finite(1e3 * end.low), finite(1e3 * end.high)]
            for name, end in zip(names, self.intervals.get(key, ()), strict=False)
        }

    def json(self) -> str:
        """`to_dict` as text."""
        return json_text(self.to_dict())

    def save(self, path: Path | str) -> None:
        """Write the JSON; never a half-written file."""
        write_whole(path, self.json())


def finite(value: float) -> float | None:
    """For JSON: null where there is no finite number."""
    return value if math.isfinite(value) else None
