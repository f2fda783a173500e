"""Faults of logs: what is wrong is refused, mended and said, or said; one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from minimax_cal.dynamics.logs.table import ROWS, Draft
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError

LEAST_ROWS, SHORTEST_RUN = 50, 2.0  # of a run that shows anything [1, s]
GAP = 0.1  # a step over which no filter of the motion reaches [s]
JOIN_PAUSE = 1.0  # between short runs that are joined [s]
UNEVEN, MOST_UNEVEN = 0.5, 0.05  # deviation of a step, of the median; share that may have it
SLOWEST_RATE = 25.0  # fewer rows a second hold no motion of a few Hz [Hz]
TURN = 2.0 * np.pi
LARGEST = 2.0 * TURN  # two turns: no joint is commanded farther unless it turns without end [rad]
FASTEST = 20.0  # speed of any joint; the quickest wrists reach 17 [rad/s, m/s]
OFTEN = 0.01  # share of rows that are faster, of a joint whose unit is wrong
MOVES = 0.01  # range of a joint that moves [rad, m]
LEAST_SPAN = np.radians(TURN)  # a motion that fits in two pi degrees may be one in radians [rad]
AGREES = 0.9  # correlation of a logged speed with the change of its joint
SMOOTHED = 0.1  # over which both are averaged before [s]
SAME_SCALE = 0.2  # deviation of their ratio
EQUAL = 0.99  # share of rows in which a measured torque that equals its command is the command
CLIPPED_S, CLIPPED_ROWS = 0.03, 4  # a flat top that is no chance
DIFFERENCE = 6  # order of the difference that is left of a measured torque: its noise
LEAST_NOISE = 1e-4  # of the span of a torque; measured ones have 3e-3 to 2e-2
IN_DEGREES = 180.0 / np.pi


def in_order_of_time(draft: Draft) -> Draft:
    """Time that runs on; rows of one time count once."""
    step = np.diff(draft.time)
    if (step < 0.0).any():
        row = int(np.argmax(step < 0.0)) + 1
        raise draft.error(
            f"time runs back from {draft.time[row - 1]:.6g} to {draft.time[row]:.6g} s; give each "
            "run a file or a label in a column run",
            row,
        )
    again = np.append(False, step == 0.0)
    if not again.any():
        return draft
    said = f"{again.sum()} rows repeat the time of the row before: left out"
    return draft.saying(f"{said} ({draft.lines(np.flatnonzero(again))})").keeping(~again)


def is_short(draft: Draft) -> bool:
    """Whether a run is too short to show anything."""
    return len(draft.time) < LEAST_ROWS or draft.duration < SHORTEST_RUN


def check_length(draft: Draft) -> Draft:
    """Raise DataError for a run that is too short."""
    if is_short(draft):
        raise draft.error(
            f"{len(draft.time)} rows in {draft.duration:.2f} s are too short for a run; log at "
            f"least {SHORTEST_RUN:g} s of motion, or give short runs in one file with a column "
            "run: they are joined"
        )
    return draft


def join_short_runs(drafts: Sequence[Draft]) -> list[Draft]:
    """Runs of one log; those too short by themselves are parts of one run, with gaps between."""
    out: list[Draft] = []
    for draft in drafts:
        if out and is_short(out[-1]) and draft.payloads == out[-1].payloads:
            out[-1] = joined(out[-1], draft)
        else:
            out.append(draft)
    if len(out) > 1 and is_short(out[-1]) and out[-1].payloads == out[-2].payloads:
        out[-2:] = [joined(*out[-2:])]
    return out


def joined(one: Draft, other: Draft) -> Draft:
    """Two runs of one log after each other, with a gap that no filter reaches over."""
    later = replace(other, time=other.time + one.time[-1] + JOIN_PAUSE)
    parts: dict[str, Any] = {
        name: None if (first := getattr(one, name)) is None or (second := getattr(later, name)) is
        None else np.concatenate([first, second])
        for name in (*ROWS, "row")
    }  # fmt: skip
    name = f"{one.name}+{other.name.rpartition(':')[2]}"
    said = f"{one.log.source}: short runs are joined, with a pause between: {name}"
    kept = (text for text in one.notices if "short runs are joined" not in text)
    return replace(one, name=name, notices=(*kept, said), **parts)


def sampled_well(draft: Draft) -> Draft:
    """Gaps, uneven steps and slow rates are said."""
    step, usual = np.diff(draft.time), draft.step
    gaps = np.flatnonzero(step > max(GAP, 3.0 * usual)) + 1
    uneven = np.mean(np.abs(step - usual) > UNEVEN * usual)
    said = []
    if len(gaps):
        longest = f"the longest {step[gaps - 1].max():.2f} s"
        said.append(f"{len(gaps)} gaps in time, {longest} ({draft.lines(gaps)}): not bridged")
    if uneven > MOST_UNEVEN:
        low, high = np.quantile(step, (0.05, 0.95))
        said.append(
            f"uneven time steps ({1e3 * low:.3g} to {1e3 * high:.3g} ms): resampled by their stamps"
        )
    if usual > 1.0 / SLOWEST_RATE:
        said.append(f"only {1.0 / usual:.3g} rows a second; log at least 50")
    return draft.saying(*said)


def in_its_unit(draft: Draft) -> Draft:
    """Angles that are no degrees called radians, nor the reverse."""
    turning = np.flatnonzero(~draft.log.sliding)
    if not len(turning):
        return draft
    q, unit = draft.q[:, turning], draft.log.units["q"][turning[0]]
    jumps = np.diff(q, axis=0)
    fast = np.mean(np.abs(jumps) > FASTEST * np.diff(draft.time)[:, None], axis=0) > OFTEN
    wrapped = (jumps + np.pi) % TURN - np.pi
    whole = np.abs(wrapped).max(axis=0) < 0.5 * np.abs(jumps).max(axis=0)  # by whole turns
    far = np.abs(q).max(axis=0) > LARGEST
    if unit == "rad" and (far.sum() > 1 or (far & fast & ~whole).any()):
        at = int(np.argmax(np.abs(q).max(axis=0)))
        row = int(np.argmax(np.abs(q[:, at])))
        name = draft.column("q", int(turning[at]))
        raise draft.error(
            f"column {name}: {q[row, at]:.4g} rad is more than two turns; degrees? then name the "
            "columns q1_deg, q2_deg, ...",
            row,
        )
    span = float(np.ptp(q, axis=0).max())
    if unit == "deg" and 0.0 < span < LEAST_SPAN:
        raise draft.error(
            f"no joint moves more than {np.degrees(span):.2g} deg; radians? then name the columns "
            "q1_rad, q2_rad, ...; else log a larger motion"
        )
    return draft


def unwrapped(draft: Draft) -> Draft:
    """Angles without jumps by whole turns; jumps by less than a turn are none of an arm."""
    q = draft.q.copy()
    step = np.diff(draft.time)
    for j in np.flatnonzero(~draft.log.sliding).tolist():
        turns = np.round(np.diff(q[:, j]) / TURN) * (step < GAP)  # a gap may hold any motion
        if turns.any():
            q[1:, j] -= TURN * np.cumsum(turns)
            rows = np.flatnonzero(turns) + 1
            text = f"column {draft.column('q', j)} jumps by whole turns ({draft.lines(rows)})"
            draft = draft.saying(f"{text}: unwrapped")
    too_fast = np.abs(np.diff(q, axis=0)) > FASTEST * np.maximum(step, 1e-3)[:, None]
    too_fast &= (step < GAP)[:, None]
    if too_fast.any():
        row, j = np.argwhere(too_fast)[0]
        raise draft.error(
            f"column {draft.column('q', j)} jumps by {q[row + 1, j] - q[row, j]:.3g} in "
            f"{1e3 * step[row]:.3g} ms; delete the row, or give each run a file",
            int(row) + 1,
        )
    return replace(draft, q=q)


def moving(draft: Draft) -> Array:
    """(n,) True for joints that move."""
    return np.asarray(np.ptp(draft.q, axis=0) > MOVES)


def is_alive(draft: Draft) -> Draft:
    """Joints that stay are said; a motion of none, or torques that stay, are refused."""
    still = ~moving(draft)
    if still.all():
        raise draft.error("no joint moves; log a motion")
    flat = np.ptp(draft.torque, axis=0) == 0.0
    if draft.measured and flat.any():
        j = int(np.argmax(flat))
        raise draft.error(
            f"column {draft.column(draft.kind, j)} is {draft.torque[0, j]:g} in all rows; the "
            "driver does not report it: log another quantity"
        )
    names = ", ".join(draft.column("q", j) for j in np.flatnonzero(still).tolist())
    draft = draft.saying(*([f"no motion in {names}: nothing is learnt of it"] if names else []))
    if draft.qd is not None and not np.ptp(draft.qd[:, ~still], axis=0).all():
        j = int(np.flatnonzero(~still)[np.argmin(np.ptp(draft.qd[:, ~still], axis=0))])
        name = draft.column("qd", j)
        draft = replace(draft, qd=None).saying(f"column {name} is the same in all rows: not used")
    return draft


def matches_its_speed(draft: Draft) -> Draft:
    """Logged speeds that are the change of their joints."""
    if draft.qd is None:
        return draft
    # Mean speeds from the joints and as logged: stamps that jitter hardly matter over so many rows.
    half = max(1, round(0.5 * SMOOTHED / draft.step))
    took = draft.time[2 * half :] - draft.time[: -2 * half]
    near = took < 2.0 * np.median(took)  # gaps are left out
    joints, wide = np.flatnonzero(moving(draft)), 2 * half + 1
    sums = np.pad(draft.qd, ((1, 0), (0, 0))).cumsum(axis=0)
    change = (draft.q[2 * half :] - draft.q[: -2 * half]) / took[:, None]
    mean = (sums[wide:] - sums[:-wide]) / wide
    d, v = change[near][:, joints], mean[near][:, joints]
    norm = np.linalg.norm(d, axis=0)[:, None] * np.linalg.norm(v, axis=0)
    alike = d.T @ v / norm  # (of change, of speed)
    own = np.diag(alike)
    ratio = (d * v).sum(axis=0) / (v * v).sum(axis=0)
    is_alike = bool((own > AGREES).all())
    if is_alike and np.abs(ratio - 1.0).max() < SAME_SCALE:
        return draft
    at = int(np.argmax(np.abs(np.log(ratio))) if is_alike else np.argmin(own))
    j = int(joints[at])
    name, speed_name = draft.column("q", j), draft.column("qd", j)
    if is_alike:
        called, by = draft.log.units["q"][j], float(ratio[at])
        mend = "check the unit of both and of time"
        if abs(by / IN_DEGREES - 1.0) < SAME_SCALE and called == "rad":
            mend = f"{name} is in degrees: name the columns q1_deg, q2_deg, ..."
        elif abs(by * IN_DEGREES - 1.0) < SAME_SCALE:
            mend = f"{speed_name} is in degrees a second: name the columns qd1_deg_s, ..."
            if called == "deg":
                mend = f"{name} is in radians: name the columns q1_rad, q2_rad, ..."
        raise draft.error(f"{name} changes by {by:.3g} times what {speed_name} says; {mend}")
    other = int(np.argmax(np.abs(alike[:, at])))
    if own[at] < -AGREES:
        raise draft.error(
            f"column {speed_name} has another sign than the change of {name}; mend one of them"
        )
    if np.abs(alike[other, at]) > AGREES:
        raise draft.error(
            f"column {speed_name} is the speed of {draft.column('q', int(joints[other]))}, not of "
            f"{name}; put the joints of both in the robot's order"
        )
    text = f"column {speed_name} does not follow {name} (correlation {own[at]:.2f})"
    return replace(draft, qd=None, qdd=None).saying(f"{text}: logged speeds are not used")


def is_measured(draft: Draft) -> Draft:
    """Torques that are no command: not those of a column of commands, and with some noise."""
    command = draft.log.values.get(f"{draft.kind}_cmd")
    if command is not None:
        same = np.mean(command[draft.row] == draft.torque, axis=0)
        j = int(np.argmax(same))
        if same[j] > EQUAL:
            raise draft.error(
                f"column {draft.column(draft.kind, j)} equals "
                f"{draft.column(f'{draft.kind}_cmd', j)} in all rows: it is the command; log the "
                "measured one"
            )
    if draft.log.simulated:
        return draft
    quiet, order = [], 2 * DIFFERENCE
    for j in np.flatnonzero(moving(draft)).tolist():
        torque = draft.torque[:, j]
        torque = torque[np.append(True, np.diff(torque) != 0.0)]  # drives that report more slowly
        if len(torque) < LEAST_ROWS:
            continue
        noise = 1.4826 * np.median(np.abs(np.diff(torque, DIFFERENCE)))
        if noise / np.sqrt(comb(order, DIFFERENCE)) / np.ptp(torque) < LEAST_NOISE:
            quiet.append(draft.column(draft.kind, j))
    said = "a command, a filtered or a simulated signal; log the measured one"
    return draft.saying(*([f"no noise in {', '.join(quiet)}: {said}"] if quiet else []))


def is_unclipped(draft: Draft) -> Draft:
    """Torques that stop at a limit while the arm moves are said."""
    least = max(CLIPPED_ROWS, round(CLIPPED_S / draft.step))
    for j, torque in enumerate(draft.torque.T):
        start = np.flatnonzero(np.append(True, np.diff(torque) != 0.0))
        length = np.diff(np.append(start, len(torque)))
        high = np.abs(torque[start]) >= 0.999 * np.abs(torque).max()
        limit = max(least, 2 * int(length[~high].max(initial=0)))
        flat = {
            a: n
            for a, n in zip(start[high], length[high], strict=True)
            if n >= limit and np.ptp(draft.q[a : a + n], axis=0).max() > 0.1 * MOVES
        }
        if flat:
            rows = np.array(list(flat))
            at = f"{torque[rows[0]]:.4g} {'N m' if draft.kind == 'tau' else 'A'}"
            draft = draft.saying(
                f"column {draft.column(draft.kind, j)} is cut off at {at} in {sum(flat.values())} "
                f"rows ({draft.lines(rows)}): a limit of the drive; move more slowly there"
            )
    return draft


CHECKS: tuple[Callable[[Draft], Draft], ...] = (  # in this order: each relies on those before
    in_order_of_time,
    check_length,
    sampled_well,
    in_its_unit,
    unwrapped,
    is_alive,
    matches_its_speed,
)
OF_TORQUE = (is_measured, is_unclipped)


def checked(draft: Draft) -> Draft:
    """The draft without what could be mended, and what is to be said of it.  Raises DataError."""
    for check in (*CHECKS, *(OF_TORQUE if draft.measured else ())):
        draft = check(draft)
    return draft


# ---- runs that are one ---------------------------------------------------------------------------


WORD, WORD_SHARE = 4, 0.05  # rows that have to follow each other alike: at least, and of a run
MAX_SHARE_ALIKE = 0.2  # of a run's words that may stand elsewhere


def fresh_rows(values: Array) -> Array:
    """(m, n) values without rows that repeat the one before."""
    return np.asarray(values[np.append(True, (values[1:] != values[:-1]).any(axis=1))])


def words(values: Array, length: int) -> Array:
    """(w,) a number for each so many rows (m, n) that follow each other."""
    bits = np.ascontiguousarray(values, dtype=float).view(np.uint64)
    count, random = max(len(bits) - length + 1, 0), np.random.default_rng(0)
    mixed = bits @ (2 * random.integers(2**63, size=(bits.shape[1], length), dtype=np.uint64) + 1)
    return np.asarray(sum(mixed[i : i + count, i] for i in range(length)))


def share_alike(one: Array, other: Array) -> float:
    """Share of the words of the shorter of two runs (m, n) that the other holds too.

    A word has WORD_SHARE of that run's rows: what drives log in coarse steps coincides in a few
    rows of any two runs, and seldom in many that follow each other.
    """
    one, other = fresh_rows(one), fresh_rows(other)
    length = max(WORD, int(WORD_SHARE * min(len(one), len(other))))
    told = np.unique(words(one, length)), np.unique(words(other, length))
    few = min(map(len, told))
    return len(np.intersect1d(*told, assume_unique=True)) / few if few else 0.0


def check_repeats(drafts: Sequence[Draft]) -> None:
    """Raise DataError for a run given twice, or torques equal to the digit in other motions."""
    for one, other in combinations(drafts, 2):
        if share_alike(one.torque, other.torque) <= MAX_SHARE_ALIKE:
            continue
        whole = (np.hstack([draft.q, draft.torque]) for draft in (one, other))
        if share_alike(*whole) > MAX_SHARE_ALIKE:
            raise DataError(
                f"{other.log.source}: run {other.name} holds rows of {one.name}; give each once"
            )
        raise DataError(
            f"{other.log.source}: torques of run {other.name} equal those of {one.name} to the "
            "digit, but the motions differ: they are commands; log the measured ones"
        )
    for draft in drafts:
        if repeats_torques(draft):
            raise draft.error(
                "torques repeat to the digit while the motion differs: they are commands; log the "
                "measured ones"
            )


def repeats_torques(draft: Draft) -> bool:
    """Whether torques of one run repeat to the digit, and its motion does not."""
    torque = fresh_rows(draft.torque)
    length = max(WORD, int(WORD_SHARE * len(torque)))
    said, moved = words(torque, length), words(fresh_rows(draft.q), length)
    repeated = len(said) - len(np.unique(said))
    if len(said) <= WORD or repeated <= MAX_SHARE_ALIKE * len(said):
        return False
    return len(moved) - len(np.unique(moved)) < 0.5 * repeated
