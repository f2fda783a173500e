"""Runs as CSV in the house's columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from minimax_cal.dynamics.run import TORQUE, Run
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.ground.files import csv_text


def runs_text(runs: Sequence[Run], sliding: Array) -> str:
    """CSV of runs of one arm that `read_runs` reads.  sliding: (n,) joints in mm.

    Raises DataError for runs in different units.
    """
    units = {run.unit for run in runs}
    if len(units) > 1 or len({run.joints for run in runs}) > 1:
        raise DataError(
            f"{runs[0].source}: the runs differ in joints or units; write one at a time"
        )
    n = runs[0].joints
    length = ["mm" if slides else "rad" for slides in sliding]
    scale = np.where(sliding, 1e3, 1.0)
    drive = ["A" if TORQUE not in units else "N" if slides else "Nm" for slides in sliding]
    letter = "tau" if TORQUE in units else "i"
    blocks: list[tuple[list[str], list[Array | None]]] = [
        ([f"q{j + 1}_{u}" for j, u in enumerate(length)], [r.q * scale for r in runs]),
    ]
    for kind, suffix in (("qd", "_s"), ("qdd", "_s2")):
        given = [getattr(run, kind) for run in runs]
        if any(value is not None for value in given):
            names = [f"{kind}{j + 1}_{u}{suffix}" for j, u in enumerate(length)]
            blocks.append((names, [None if v is None else v * scale for v in given]))
    blocks.append(([f"{letter}{j + 1}_{u}" for j, u in enumerate(drive)], [r.torque for r in runs]))
    blocks += [block for block in (warmth(runs, n), payload(runs)) if block]
    many = len(runs) > 1
    header = [name for names, _ in blocks for name in names]
    lines = [[*(["run"] if many else []), "t_s", *header]]
    for at, run in enumerate(runs):
        parts = [values[at] for _, values in blocks]
        widths = [len(names) for names, _ in blocks]
        for row in range(len(run.time)):
            cells = [f"{run.time[row]:.6f}"]
            for part, width in zip(parts, widths, strict=True):
                cells += [""] * width if part is None else [f"{v:.9g}" for v in part[row]]
            lines.append([*([run.name] if many else []), *cells])
    return csv_text(lines)


def warmth(runs: Sequence[Run], n: int) -> tuple[list[str], list[Array | None]] | None:
    """Columns of temperature, where runs have them alike."""
    given = [run.temperature for run in runs if run.temperature is not None]
    if not given:
        return None
    one = all(value.ndim == 1 for value in given)
    names = ["temperature_C"] if one else [f"temperature{j + 1}_C" for j in range(n)]
    wide = [None if r.temperature is None else np.atleast_2d(r.temperature.T).T for r in runs]
    return names, [v if v is None or v.shape[1] == len(names) else np.repeat(v, n, 1) for v in wide]


def payload(runs: Sequence[Run]) -> tuple[list[str], list[Array | None]] | None:
    """The column of payload, where a run has one."""
    if all(run.payload is None for run in runs):
        return None
    values = [None if r.payload is None else np.full((len(r.time), 1), r.payload) for r in runs]
    return ["payload_kg"], list(values)
