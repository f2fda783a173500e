"""What the visiting order tells of each pose: the last move, its direction, the time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.set_aside import merged

STILL = 1e-7  # a joint that moved less did not move [rad, m]
MAX_BEND = 0.3  # of what joints move by in two rows, off a straight line: recorded in motion


def with_history(data: Measurements) -> Measurements:
    """The data with columns that a split into parts would lose; columns already there are kept.

    approach1..n: (m,) sign of the joint's last move, 0 unknown.  move1..n: (m,) the move from the
    pose before [rad, m], 0 unknown.  followed: (m,) 1 where the pose before is known, else 0.
    clock: (m,) place in the session, 0 first to 1 last.  rate1..n: `joint_rates`.  Without
    an order or times nothing of this is known: all are 0.  Poses that were set aside were visited
    as well.
    """
    if data.aside is None:
        return known_history(data)
    every = known_history(merged(data, data.aside))
    alone = replace(data.aside, columns=columns_at(every, data.aside.line))
    return replace(data, columns=columns_at(every, data.line), aside=alone)


def columns_at(data: Measurements, line: Array) -> dict[str, Array]:
    """The columns at some lines of the file, of which the rows are in order."""
    rows = np.searchsorted(data.line, line)
    return {name: column[rows] for name, column in data.columns.items()}


def known_history(data: Measurements) -> Measurements:
    """As `with_history`, of rows that are all there."""
    if not ordered(data):
        joints = range(data.q.shape[1])
        names = [f"{stem}{j + 1}" for stem in ("approach", "move") for j in joints]
        zero = dict.fromkeys((*names, "followed", "clock"), np.zeros(data.poses))
        return replace(data, columns={**zero, **data.columns})
    order = visits(data)
    linked = followed(data)
    move = moves(data)
    approach = np.zeros_like(move)
    approach[order] = last_signs(move[order], linked[order])
    joints = range(data.q.shape[1])
    found = {f"approach{j + 1}": approach[:, j] for j in joints}
    found |= {f"move{j + 1}": move[:, j] for j in joints}
    found |= {"followed": linked.astype(float), "clock": clock(data)}
    found |= {f"rate{j + 1}": rate for j, rate in enumerate(joint_rates(data).T)}
    return replace(data, columns={**found, **data.columns})


def sessions(data: Measurements) -> Array:
    """(m,) number of each row's session, in the order of their first rows."""
    if "session" not in data.columns:
        return np.zeros(data.poses, dtype=int)
    _, first, label = np.unique(data.columns["session"], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[label.reshape(-1)])


def ordered(data: Measurements) -> bool:
    """Whether anything tells in which order the poses were visited."""
    if "followed" in data.columns:
        return True  # part of data whose history is known, or is known to be unknown
    time = data.columns.get("time", np.zeros(0)).astype(float)
    return numbered(data) or int(np.isfinite(time).sum()) > 1


def is_timed(data: Measurements) -> bool:
    """Whether a change during the session can be told: an order, times, or a clock that goes."""
    clocked = data.columns.get("clock")
    return bool(np.ptp(clocked) > 0.0) if clocked is not None else ordered(data)


def numbered(data: Measurements) -> bool:
    """Whether there is an `order` column with a number in it."""
    return "order" in data.columns and bool(np.isfinite(data.columns["order"].astype(float)).any())


def visits(data: Measurements) -> Array:
    """(m,) the rows as they were visited; rows without a number come last in their session."""
    if not numbered(data):
        return np.arange(data.poses)
    return np.lexsort((data.columns["order"].astype(float), sessions(data)))


def time_notices(data: Measurements) -> list[str]:
    """A notice where `time_s` falls from one visit to the next of a session."""
    rows = visits(data)
    rows = rows[np.isfinite(data.columns.get("time", np.full(data.poses, np.nan))[rows])]
    time, session = data.columns["time"][rows] if len(rows) else rows, sessions(data)[rows]
    back = 1 + np.flatnonzero((np.diff(time) < 0.0) & (np.diff(session) == 0))
    if not len(back):
        return []
    by = "the column order" if numbered(data) else "the rows"
    return [
        f"{data.source}:{data.line[rows[back[0]]]}: column time_s runs backwards against {by}, "
        f"{len(back)} times: moves follow {by}, the clock time_s; correct one of them, or name the "
        "sessions in a column `session`"
    ]


def moves(data: Measurements) -> Array:
    """(m, n) joint moves from the pose before, 0 where that is not known [rad, m].

    Those of `with_history` where the data have them: a part of the data knows no better.
    """
    names = [f"move{j + 1}" for j in range(data.q.shape[1])]
    if all(name in data.columns for name in names):
        return np.stack([data.columns[name] for name in names], axis=1)
    order = visits(data)
    move = np.zeros_like(data.q)
    move[order[1:]] = np.diff(data.q[order], axis=0)
    return np.where(followed(data)[:, None], move, 0.0)


def joint_rates(data: Measurements) -> Array:
    """(m, n) velocity of the joints by `time_s`, of sessions recorded in motion [rad/s, m/s].

    0 where the arm was at rest, or went farther from row to row than these show.
    """
    rate, order = np.zeros_like(data.q), visits(data)
    time = data.columns.get("time", np.full(data.poses, np.nan)).astype(float)
    session = sessions(data)[order]
    for number in np.unique(session):
        rows = order[session == number]
        q, going = data.q[rows], time[rows]
        bend = np.linalg.norm(np.diff(q, 2, axis=0))
        if (np.diff(going) > 0.0).all() and bend < MAX_BEND * np.linalg.norm(q[2:] - q[:-2]):
            rate[rows] = np.gradient(q, going, axis=0)
    return rate


def followed(data: Measurements) -> Array:
    """(m,) True where the pose visited just before is in the data.

    A gap in `order` hides poses that were visited and left out.  So does a number that stands at
    two places of the file with different joints: one cannot tell which of them came before.
    """
    if "followed" in data.columns:
        return np.asarray(data.columns["followed"] > 0.0)
    rows = visits(data)
    session = sessions(data)[rows]
    linked = np.append(False, session[1:] == session[:-1])
    if numbered(data):
        number = data.columns["order"].astype(float)[rows]
        step = np.append(np.inf, np.diff(number))
        same = np.append(False, np.all(np.abs(np.diff(data.q[rows], axis=0)) < STILL, axis=1))
        beside = np.append(False, np.diff(rows) == 1)
        clash = linked & (step == 0.0) & ~same & ~beside
        muddled = np.isin(number, number[clash])
        with np.errstate(invalid="ignore"):
            linked &= step <= stride(number, linked) * (1.0 + 1e-9)
        linked &= ~muddled & ~np.append(False, muddled[:-1])
    out = np.zeros(data.poses, dtype=bool)
    out[rows] = linked
    return out


def stride(number: Array, linked: Array) -> float:
    """Largest step of the visit number between poses that follow each other.

    Whole numbers may count in tens; where a pose was squeezed in (1, 1.5, 2) one is still a step.
    """
    step = np.diff(number)[linked[1:]]
    step = step[step > 0.0]
    return max(1.0, float(step.min())) if len(step) else 1.0


def last_signs(move: Array, linked: Array) -> Array:
    """(m, n) sign of the last move of each joint, 0 unknown.

    move: (m, n) as visited.  linked: (m,) False where what was before is not known.
    """
    sign = np.where(np.abs(move) > STILL, np.sign(move), 0.0)
    told = (sign != 0.0) | ~linked[:, None]
    index = np.where(told, np.arange(len(move))[:, None], 0)
    return np.take_along_axis(sign, np.maximum.accumulate(index, axis=0), axis=0)


def clock(data: Measurements) -> Array:
    """(m,) place in the session, 0 to 1: by time, else by visit number, else by row.

    That of `with_history` where the data have it: a part of the data knows no better.
    """
    if "clock" in data.columns:
        return np.asarray(data.columns["clock"])
    when = np.empty(data.poses)
    when[visits(data)] = np.arange(data.poses)
    name = timed_by(data)
    if name:
        when = filled(when, data.columns[name].astype(float))
    length = np.ptp(when)
    return np.asarray((when - when.min()) / (length if length > 0.0 else 1.0))


def timed_by(data: Measurements) -> str:
    """The column that tells when poses were visited: `time`, `order`, or none."""
    session = sessions(data)
    parts = [session == one for one in np.unique(session)]
    for name in ("time", "order"):
        if name not in data.columns:
            continue
        given = data.columns[name].astype(float)
        spans = [(given[one].min(), given[one].max()) for one in parts]
        if name == "order" and any(nxt[0] <= last[1] for last, nxt in pairwise(spans)):
            return ""  # the numbers of a later session begin again
        if np.isfinite(given).sum() > 1:
            return name
    return ""


def filled(visit: Array, given: Array) -> Array:
    """(m,) given times, those between interpolated.  visit: (m,) place in the visiting order."""
    known = np.isfinite(given)
    by_visit = np.argsort(visit[known])
    return np.interp(visit, visit[known][by_visit], given[known][by_visit])


@dataclass(frozen=True)
class Clock:
    """The time of a fit's data, for data that come later.

    column: `time` or `order`.  origin, length: where in it the clock is 0, and from there to 1.
    """

    column: str
    origin: float
    length: float

    @staticmethod
    def of(data: Measurements) -> Clock | None:
        """The clock of data, or of a part that knows its place (`with_history`); None by row."""
        name = timed_by(data)
        if not name:
            return None
        place = clock(data)
        given = data.columns[name].astype(float)
        known = np.flatnonzero(np.isfinite(given))
        first, last = known[np.argmin(given[known])], known[np.argmax(given[known])]
        told = place[last] - place[first]
        if not (given[last] > given[first] and told > 0.0):
            return None
        length = float((given[last] - given[first]) / told)
        found = Clock(name, float(given[first] - length * place[first]), length)
        same = np.abs(found.at(given[known]) - place[known]).max() < 1e-6
        return found if same else None  # a clock of the user's own is no line over the column

    def at(self, given: Array) -> Array:
        """Place in the session of the fit.  given: of the column."""
        return (given - self.origin) / self.length

    def on(self, data: Measurements) -> Measurements:
        """The data with this clock; as they are where they have one, or lack the column."""
        if "clock" in data.columns or self.column not in data.columns:
            return data
        given = data.columns[self.column].astype(float)
        if not np.isfinite(given).any():
            return data
        visit = np.empty(data.poses)
        visit[visits(data)] = np.arange(data.poses)
        return replace(data, columns={**data.columns, "clock": self.at(filled(visit, given))})
