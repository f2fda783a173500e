"""What the visiting order tells of each pose: the last move, its direction, the time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.set_aside_points import merge_rows_by_line

MIN_JOINT_MOVE = 1e-7  # a joint that moved less did not move [rad, m]
MAX_BEND = 0.3  # of what joints move by in two rows, off a straight line: recorded in motion


def add_history_columns(data: Measurements) -> Measurements:
    """The data with columns that a split into parts would lose; columns already there are kept.

    approach1..n: (m,) sign of the joint's last move, 0 unknown.  move1..n: (m,) the move from the
    pose before [rad, m], 0 unknown.  followed: (m,) 1 where the pose before is known, else 0.
    clock: (m,) place in the session, 0 first to 1 last.  rate1..n: `joint_rates`.  Without
    an order or times nothing of this is known: all are 0.  Poses that were set aside were visited
    as well.
    """
    if data.aside is None:
        return add_history_of_all_rows(data)
    every = add_history_of_all_rows(merge_rows_by_line(data, data.aside))
    alone = replace(data.aside, columns=columns_at_lines(every, data.aside.line))
    return replace(data, columns=columns_at_lines(every, data.line), aside=alone)


def columns_at_lines(data: Measurements, lines: Array) -> dict[str, Array]:
    """The columns at some lines of the file, of which the rows are in order."""
    rows = np.searchsorted(data.line, lines)
    return {name: column[rows] for name, column in data.columns.items()}


def add_history_of_all_rows(data: Measurements) -> Measurements:
    """As `add_history_columns`, of rows that are all there."""
    if not has_visit_order(data):
        joints = range(data.q.shape[1])
        names = [f"{stem}{j + 1}" for stem in ("approach", "move") for j in joints]
        zero = dict.fromkeys((*names, "followed", "clock"), np.zeros(data.poses))
        return replace(data, columns={**zero, **data.columns})
    order = rows_in_visit_order(data)
    linked = follows_previous_pose(data)
    move = joint_moves(data)
    approach = np.zeros_like(move)
    approach[order] = last_move_signs(move[order], linked[order])
    joints = range(data.q.shape[1])
    found = {f"approach{j + 1}": approach[:, j] for j in joints}
    found |= {f"move{j + 1}": move[:, j] for j in joints}
    found |= {"followed": linked.astype(float), "clock": session_clock_values(data)}
    found |= {f"rate{j + 1}": rate for j, rate in enumerate(joint_rates(data).T)}
    return replace(data, columns={**found, **data.columns})


def session_indices(data: Measurements) -> Array:
    """(m,) number of each row's session, in the order of their first rows."""
    if "session" not in data.columns:
        return np.zeros(data.poses, dtype=int)
    _, first, label = np.unique(data.columns["session"], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[label.reshape(-1)])


def has_visit_order(data: Measurements) -> bool:
    """Whether anything tells in which order the poses were visited."""
    if "followed" in data.columns:
        return True  # part of data whose history is known, or is known to be unknown
    time = data.columns.get("time", np.zeros(0)).astype(float)
    return has_order_numbers(data) or int(np.isfinite(time).sum()) > 1


def has_session_time(data: Measurements) -> bool:
    """Whether a change during the session can be told: an order, times, or a clock that goes."""
    clocked = data.columns.get("clock")
    return bool(np.ptp(clocked) > 0.0) if clocked is not None else has_visit_order(data)


def has_order_numbers(data: Measurements) -> bool:
    """Whether there is an `order` column with a number in it."""
    return "order" in data.columns and bool(np.isfinite(data.columns["order"].astype(float)).any())


def rows_in_visit_order(data: Measurements) -> Array:
    """(m,) the rows as they were visited; rows without a number come last in their session."""
    if not has_order_numbers(data):
        return np.arange(data.poses)
    return np.lexsort((data.columns["order"].astype(float), session_indices(data)))


def list_backward_time_notices(data: Measurements) -> list[str]:
    """A notice where `time_s` falls from one visit to the next of a session."""
    rows = rows_in_visit_order(data)
    rows = rows[np.isfinite(data.columns.get("time", np.full(data.poses, np.nan))[rows])]
    time, session = data.columns["time"][rows] if len(rows) else rows, session_indices(data)[rows]
    back = 1 + np.flatnonzero((np.diff(time) < 0.0) & (np.diff(session) == 0))
    if not len(back):
        return []
    by = "the column order" if has_order_numbers(data) else "the rows"
    return [
        f"{data.source}:{data.line[rows[back[0]]]}: column time_s runs backwards against {by}, "
        f"{len(back)} times: moves follow {by}, the clock time_s; correct one of them, or name the "
        "sessions in a column `session`"
    ]


def joint_moves(data: Measurements) -> Array:
    """(m, n) joint moves from the pose before, 0 where that is not known [rad, m].

    Those of `add_history_columns` where the data have them: a part of the data knows no better.
    """
    names = [f"move{j + 1}" for j in range(data.q.shape[1])]
    if all(name in data.columns for name in names):
        return np.stack([data.columns[name] for name in names], axis=1)
    order = rows_in_visit_order(data)
    move = np.zeros_like(data.q)
    move[order[1:]] = np.diff(data.q[order], axis=0)
    return np.where(follows_previous_pose(data)[:, None], move, 0.0)


def joint_rates(data: Measurements) -> Array:
    """(m, n) velocity of the joints by `time_s`, of sessions recorded in motion [rad/s, m/s].

    0 where the arm was at rest, or went farther from row to row than these show.
    """
    rate, order = np.zeros_like(data.q), rows_in_visit_order(data)
    time = data.columns.get("time", np.full(data.poses, np.nan)).astype(float)
    session = session_indices(data)[order]
    for number in np.unique(session):
        rows = order[session == number]
        q, going = data.q[rows], time[rows]
        bend = np.linalg.norm(np.diff(q, 2, axis=0))
        if (np.diff(going) > 0.0).all() and bend < MAX_BEND * np.linalg.norm(q[2:] - q[:-2]):
            rate[rows] = np.gradient(q, going, axis=0)
    return rate


def follows_previous_pose(data: Measurements) -> Array:
    """(m,) True where the pose visited just before is in the data.

    A gap in `order` hides poses that were visited and left out.  So does a number that stands at
    two places of the file with different joints: one cannot tell which of them came before.
    """
    if "followed" in data.columns:
        return np.asarray(data.columns["followed"] > 0.0)
    rows = rows_in_visit_order(data)
    session = session_indices(data)[rows]
    linked = np.append(False, session[1:] == session[:-1])
    if has_order_numbers(data):
        number = data.columns["order"].astype(float)[rows]
        step = np.append(np.inf, np.diff(number))
        same = np.append(
            False, np.all(np.abs(np.diff(data.q[rows], axis=0)) < MIN_JOINT_MOVE, axis=1)
        )
        beside = np.append(False, np.diff(rows) == 1)
        clash = linked & (step == 0.0) & ~same & ~beside
        muddled = np.isin(number, number[clash])
        with np.errstate(invalid="ignore"):
            linked &= step <= largest_consecutive_step(number, linked) * (1.0 + 1e-9)
        linked &= ~muddled & ~np.append(False, muddled[:-1])
    out = np.zeros(data.poses, dtype=bool)
    out[rows] = linked
    return out


def largest_consecutive_step(visit_numbers: Array, follows_previous: Array) -> float:
    """Largest step of the visit number between poses that follow each other.

    Whole numbers may count in tens; where a pose was squeezed in (1, 1.5, 2) one is still a step.
    """
    step = np.diff(visit_numbers)[follows_previous[1:]]
    step = step[step > 0.0]
    return max(1.0, float(step.min())) if len(step) else 1.0


def last_move_signs(moves_in_order: Array, follows_previous: Array) -> Array:
    """(m, n) sign of the last move of each joint, 0 unknown.

    moves_in_order: (m, n) as visited.  follows_previous: (m,) False where what was before is not
    known.
    """
    sign = np.where(np.abs(moves_in_order) > MIN_JOINT_MOVE, np.sign(moves_in_order), 0.0)
    told = (sign != 0.0) | ~follows_previous[:, None]
    index = np.where(told, np.arange(len(moves_in_order))[:, None], 0)
    return np.take_along_axis(sign, np.maximum.accumulate(index, axis=0), axis=0)


def session_clock_values(data: Measurements) -> Array:
    """(m,) place in the session, 0 to 1: by time, else by visit number, else by row.

    That of `add_history_columns` where the data have it: a part of the data knows no better.
    """
    if "clock" in data.columns:
        return np.asarray(data.columns["clock"])
    when = np.empty(data.poses)
    when[rows_in_visit_order(data)] = np.arange(data.poses)
    name = find_time_column(data)
    if name:
        when = interpolate_missing_times(when, data.columns[name].astype(float))
    length = np.ptp(when)
    return np.asarray((when - when.min()) / (length if length > 0.0 else 1.0))


def find_time_column(data: Measurements) -> str:
    """The column that tells when poses were visited: `time`, `order`, or none."""
    session = session_indices(data)
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


def interpolate_missing_times(visit_place: Array, given_times: Array) -> Array:
    """(m,) given times, those between interpolated.  visit_place: (m,) place in the visiting
    order.
    """
    known = np.isfinite(given_times)
    by_visit = np.argsort(visit_place[known])
    return np.interp(visit_place, visit_place[known][by_visit], given_times[known][by_visit])


@dataclass(frozen=True)
class SessionClock:
    """The time of a fit's data, for data that come later.

    column: `time` or `order`.  origin, length: where in it the clock is 0, and from there to 1.
    """

    column: str
    origin: float
    length: float

    @staticmethod
    def from_measurements(data: Measurements) -> SessionClock | None:
        """The clock of data, or of a part that knows its place (`add_history_columns`); None by
        row.
        """
        name = find_time_column(data)
        if not name:
            return None
        place = session_clock_values(data)
        given = data.columns[name].astype(float)
        known = np.flatnonzero(np.isfinite(given))
        first, last = known[np.argmin(given[known])], known[np.argmax(given[known])]
        told = place[last] - place[first]
        if not (given[last] > given[first] and told > 0.0):
            return None
        length = float((given[last] - given[first]) / told)
        found = SessionClock(name, float(given[first] - length * place[first]), length)
        same = np.abs(found.place_in_session(given[known]) - place[known]).max() < 1e-6
        return found if same else None  # a clock of the user's own is no line over the column

    def place_in_session(self, column_values: Array) -> Array:
        """Place in the session of the fit.  column_values: of the column."""
        return (column_values - self.origin) / self.length

    def add_clock_column(self, data: Measurements) -> Measurements:
        """The data with this clock; as they are where they have one, or lack the column."""
        if "clock" in data.columns or self.column not in data.columns:
            return data
        given = data.columns[self.column].astype(float)
        if not np.isfinite(given).any():
            return data
        visit = np.empty(data.poses)
        visit[rows_in_visit_order(data)] = np.arange(data.poses)
        return replace(
            data,
            columns={
                **data.columns,
                "clock": self.place_in_session(interpolate_missing_times(visit, given)),
            },
        )
