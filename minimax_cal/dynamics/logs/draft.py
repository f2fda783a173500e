"""A run in the making: the rows of one trajectory, and where in the file they stand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.dynamics.logs.table import SHOWN, Log
from minimax_cal.dynamics.run import CURRENT, NOTHING, TORQUE, Run, rows_of
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError

TURN = 2.0 * np.pi
COMMANDS = "q_cmd"
SAMPLED = ("row", "time", "q", "qd", "qdd", "torque")  # what has a value a row


@dataclass(frozen=True, eq=False)
class Draft:
    """Rows of one trajectory in SI; fields as those of a Run.

    log: the file's columns.  kind: of its torque columns, tau or i, else q_cmd.  row: (m,) rows of
    the log.
    """

    log: Log
    name: str
    kind: str
    row: Array
    time: Array
    q: Array
    qd: Array | None
    qdd: Array | None
    torque: Array
    notices: tuple[str, ...] = ()

    @property
    def measured(self) -> bool:
        """Whether torques or currents were logged; else commands stand in their place."""
        return self.kind != COMMANDS

    def saying(self, *notices: str) -> Draft:
        """With more notices."""
        where = f"{self.log.source}: " + (f"run {self.name}: " if self.log.run else "")
        return replace(self, notices=(*self.notices, *(where + text for text in notices)))

    def column(self, kind: str, joint: int) -> str:
        """The name of a joint's column in the file."""
        return self.log.headers[kind][joint]

    def line(self, row: int) -> int:
        """The line of the file of a row."""
        return int(self.log.line[self.row[row]])

    def error(self, text: str, row: int | None = None) -> DataError:
        """What is wrong, and where."""
        at = "" if row is None else f":{self.line(row)}"
        inside = f"run {self.name}: " if self.log.run and row is None else ""
        return DataError(f"{self.log.source}{at}: {inside}{text}")

    def keeping(self, rows: Array) -> Draft:
        """The same at some rows only.  rows: (m,) mask."""
        return replace(self, **rows_of(self, SAMPLED, rows))

    def lines(self, rows: Array) -> str:
        """Some lines of the file, to people."""
        some = ", ".join(str(self.line(row)) for row in rows[:SHOWN])
        return f"line{'s' * (len(rows) > 1)} {some}" + (" ..." if len(rows) > SHOWN else "")

    def run(self) -> Run:
        """The finished run.  Raises DataError for a payload that changes."""
        values = {kind: value[self.row] for kind, value in self.log.values.items()}
        payload = values.get("payload", np.empty(0))
        payload = np.unique(payload[np.isfinite(payload)])
        if len(payload) > 1:
            raise self.error(
                f"the payload changes from {payload[0]:g} to {payload[-1]:g} kg within a run; give "
                "each payload a run of its own"
            )
        warmth = values.get("temperature")
        return Run(
            name=self.name,
            source=self.log.source,
            time=self.time,
            q=self.q,
            qd=self.qd,
            qdd=self.qdd,
            torque=self.torque if self.measured else 0.0 * self.torque,
            unit={"tau": TORQUE, "i": CURRENT, COMMANDS: NOTHING}[self.kind],
            payload=float(payload[0]) if len(payload) else None,
            temperature=warmth if warmth is not None and np.isfinite(warmth).all() else None,
            notices=self.notices,
            command=commanded(values.get(COMMANDS), self.q),
        )


def commanded(values: Array | None, q: Array) -> Array | None:
    """Commanded joint values (m, n) without the whole turns by which they differ from q (m, n)."""
    if values is None or values.shape != q.shape or not np.isfinite(values).all():
        return None
    return np.asarray(values + TURN * np.round((q - values) / TURN))


def drafts_of(log: Log, name: str) -> list[Draft]:
    """The trajectories of a log, in the order of their first rows.  Raises DataError."""
    kind = torque_kind(log)
    values = log.values
    labels = np.array(log.run) if log.run else np.full(len(log.line), "")
    needed = (values["t"][:, None], values["q"], values[kind])
    whole = np.all([np.isfinite(block).all(axis=1) for block in needed], axis=0)
    if not whole.any():
        lost = next(b for b in needed if not np.isfinite(b).all(axis=1).any())
        what = "time" if lost is needed[0] else "joint value" if lost is needed[1] else "torque"
        raise DataError(f"{log.source}: no row holds a {what} of every joint; log them together")
    out = []
    for label in dict.fromkeys(labels):
        row = np.flatnonzero((labels == label) & whole)
        if not len(row):
            raise DataError(f"{log.source}: run {label} holds no whole row; delete it")
        title = f"{name}:{label}" if label else name
        draft = Draft(
            log=log,
            name=title,
            kind=kind,
            row=row,
            time=values["t"][row] - values["t"][row[0]],
            q=values["q"][row],
            qd=values["qd"][row] if "qd" in values else None,
            qdd=values["qdd"][row] if "qdd" in values else None,
            torque=values[kind][row],
            notices=log.notices,
        )
        lost_rows = int(((labels == label) & ~whole).sum())
        if lost_rows:
            lacking = f"{lost_rows} of {lost_rows + len(row)} rows lack a joint value or torque"
            draft = draft.saying(f"{lacking}: left out")
        out.append(without_holes(draft))
    return out


def torque_kind(log: Log) -> str:
    """Which columns hold what the drives did.  Raises DataError where none do."""
    for kind in ("tau", "i"):
        if kind in log.values and np.isfinite(log.values[kind]).any():
            return kind
    if COMMANDS in log.values and log.values[COMMANDS].shape == log.values["q"].shape:
        return COMMANDS
    if log.values.keys() & {"tau_cmd", "i_cmd"}:
        name = next(log.headers[k][0] for k in ("tau_cmd", "i_cmd") if k in log.values)
        raise DataError(
            f"{log.source}:1: {name} is the command; add the measured torque or current (tau1_Nm, "
            "i1_A)"
        )
    raise DataError(
        f"{log.source}:1: no column of torque or current; drive this motion and log tau1_Nm (or "
        "i1_A), tau2_Nm, ..."
    )


def without_holes(draft: Draft) -> Draft:
    """The draft, its derivatives given only where they are given in every row."""
    if draft.qd is not None and not np.isfinite(draft.qd).all():
        draft = replace(draft, qd=None).saying("speeds lack in some rows: not used")
    if draft.qdd is not None and not np.isfinite(draft.qdd).all():
        draft = replace(draft, qdd=None).saying("accelerations lack in some rows: not used")
    return draft
