"""Faults of logs: what is wrong is refused, mended and said, or said; one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from math import comb

import numpy as np

from minimax_cal.dynamics.logs.table import Draft
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError

LEAST_ROWS, SHORTEST_RUN = 50, 2.0  # of a run that shows anything [1, s]
GAP = 0.1  # a step over which no filter of the motion reaches [s]
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


def long_enough(draft: Draft) -> Draft:
    """A run of some length."""
    rows, seconds = len(draft.time), draft.time[-1] - draft.time[0]
    if rows < LEAST_ROWS or seconds < SHORTEST_RUN:
        raise draft.error(
            f"{rows} rows in {seconds:.2f} s are too short for a run; log at least "
            f"{SHORTEST_RUN:g} s of motion"
        )
    return draft


def sampled_well(draft: Draft) -> Draft:
    """Gaps, uneven steps and slow rates are said."""
    step = np.diff(draft.time)
    usual = float(np.median(step))
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


def turning_columns(draft: Draft) -> Array:
    """The joints whose columns are angles."""
    return np.flatnonzero(~draft.log.sliding)


def in_its_unit(draft: Draft) -> Draft:
    """Angles that are no degrees called radians, nor the reverse."""
    turning = turning_columns(draft)
    if not len(turning):
        return draft
    q = draft.q[:, turning]
    jumps = np.diff(q, axis=0)
    fast = np.mean(np.abs(jumps) > FASTEST * np.diff(draft.time)[:, None], axis=0) > OFTEN
    whole = np.abs(wrapped(jumps)).max(axis=0) < 0.5 * np.abs(jumps).max(axis=0)  # by whole turns
    far = np.abs(q).max(axis=0) > LARGEST
    if draft.log.units["q"][turning[0]] == "rad" and (far.sum() > 1 or (far & fast & ~whole).any()):
        at = int(np.argmax(np.abs(q).max(axis=0)))
        row = int(np.argmax(np.abs(q[:, at])))
        name = draft.column("q", int(turning[at]))
        raise draft.error(
            f"column {name}: {q[row, at]:.4g} rad is more than two turns; degrees? then name the "
            "columns q1_deg, q2_deg, ...",
            row,
        )
    span = float(np.ptp(q, axis=0).max())
    if draft.log.units["q"][turning[0]] == "deg" and 0.0 < span < LEAST_SPAN:
        raise draft.error(
            f"no joint moves more than {np.degrees(span):.2g} deg; radians? then name the columns "
            "q1_rad, q2_rad, ...; else log a larger motion"
        )
    return draft


def wrapped(angle: Array) -> Array:
    """Angles in -pi to pi."""
    return (angle + np.pi) % TURN - np.pi


def unwrapped(draft: Draft) -> Draft:
    """Angles without jumps by whole turns; jumps by less than a turn are none of an arm."""
    q = draft.q.copy()
    step = np.diff(draft.time)
    for j in turning_columns(draft).tolist():
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


def changes(draft: Draft, speed: Array) -> tuple[Array, Array]:
    """Mean speeds (m', n) over SMOOTHED about some rows: from the joints, and as logged.

    speed: (m, n).  Stamps that jitter hardly matter over so many rows; gaps are left out.
    """
    half = max(1, round(0.5 * SMOOTHED / float(np.median(np.diff(draft.time)))))
    took = draft.time[2 * half :] - draft.time[: -2 * half]
    near = took < 2.0 * np.median(took)
    change = (draft.q[2 * half :] - draft.q[: -2 * half]) / took[:, None]
    wide, sums = 2 * half + 1, np.pad(speed, ((1, 0), (0, 0))).cumsum(axis=0)
    mean = (sums[wide:] - sums[:-wide]) / wide
    return change[near], mean[near]


def matches_its_speed(draft: Draft) -> Draft:
    """Logged speeds that are the change of their joints."""
    if draft.qd is None:
        return draft
    change, speed = changes(draft, draft.qd)
    joints = np.flatnonzero(moving(draft))
    d, v = change[:, joints], speed[:, joints]
    norm = np.linalg.norm(d, axis=0)[:, None] * np.linalg.norm(v, axis=0)
    alike = d.T @ v / norm  # (of change, of speed)
    own = np.diag(alike)
    if (own > AGREES).all():
        return same_scale(draft, joints, (d * v).sum(axis=0) / (v * v).sum(axis=0))
    at = int(np.argmin(own))
    j = int(joints[at])
    name, speed_name = draft.column("q", j), draft.column("qd", j)
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


def same_scale(draft: Draft, joints: Array, ratio: Array) -> Draft:
    """The draft, if its speeds have the size of the joints' changes.  ratio: of change to speed."""
    off = np.abs(ratio - 1.0)
    if off.max() < SAME_SCALE:
        return draft
    at = int(np.argmax(np.abs(np.log(ratio))))
    j, by = int(joints[at]), float(ratio[at])
    name, speed = draft.column("q", j), draft.column("qd", j)
    called = draft.log.units["q"][j]
    mend = "check the unit of both and of time"
    if abs(by / IN_DEGREES - 1.0) < SAME_SCALE and called == "rad":
        mend = f"{name} is in degrees: name the columns q1_deg, q2_deg, ..."
    elif abs(by * IN_DEGREES - 1.0) < SAME_SCALE:
        mend = f"{speed} is in degrees a second: name the columns qd1_deg_s, ..."
        if called == "deg":
            mend = f"{name} is in radians: name the columns q1_rad, q2_rad, ..."
    raise draft.error(f"{name} changes by {by:.3g} times what {speed} says; {mend}")


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
    moved = np.flatnonzero(moving(draft)).tolist()
    quiet = [j for j in moved if noise_of(draft.torque[:, j]) < LEAST_NOISE]
    if not quiet:
        return draft
    names = ", ".join(draft.column(draft.kind, j) for j in quiet)
    return draft.saying(
        f"no noise in {names}: a command, a filtered or a simulated signal; log the measured one"
    )


def noise_of(torque: Array) -> float:
    """White noise of a torque (m,), of its span: from what high differences leave of it."""
    values = torque[np.append(True, np.diff(torque) != 0.0)]  # drives that report more slowly
    if len(values) < LEAST_ROWS:
        return np.inf
    left = np.median(np.abs(np.diff(values, DIFFERENCE)))
    return float(1.4826 * left / np.sqrt(comb(2 * DIFFERENCE, DIFFERENCE)) / np.ptp(values))


def is_unclipped(draft: Draft) -> Draft:
    """Torques that stop at a limit while the arm moves are said."""
    least = max(CLIPPED_ROWS, round(CLIPPED_S / float(np.median(np.diff(draft.time)))))
    for j, torque in enumerate(draft.torque.T):
        start = np.flatnonzero(np.append(True, np.diff(torque) != 0.0))
        length = np.diff(np.append(start, len(torque)))
        value = torque[start]
        high = np.abs(value) >= 0.999 * np.abs(torque).max()
        limit = max(least, 2 * int(length[~high].max(initial=0)))
        flat = [
            (a, a + n)
            for a, n in zip(start[high], length[high], strict=True)
            if n >= limit and np.ptp(draft.q[a : a + n], axis=0).max() > 0.1 * MOVES
        ]
        if flat:
            count = sum(end - first for first, end in flat)
            at = f"{torque[flat[0][0]]:.4g} {'N m' if draft.kind == 'tau' else 'A'}"
            draft = draft.saying(
                f"column {draft.column(draft.kind, j)} is cut off at {at} in {count} rows "
                f"({draft.lines(np.array([first for first, _ in flat]))}): a limit of the drive; "
                "move more slowly there"
            )
    return draft


CHECKS: tuple[Callable[[Draft], Draft], ...] = (  # in this order: each relies on those before
    in_order_of_time,
    long_enough,
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


WORD = 4  # rows that have to follow each other alike
MOST_ALIKE = 0.2  # share of a run's words of torque that may stand elsewhere


def words(values: Array) -> Array:
    """Rows that follow each other, WORD at a time, a number for each; repeated rows count once."""
    fresh = np.append(True, (values[1:] != values[:-1]).any(axis=1))
    bits = np.ascontiguousarray(values[fresh], dtype=float).view(np.uint64)
    count, random = max(len(bits) - WORD + 1, 0), np.random.default_rng(0)
    mixed = bits @ (2 * random.integers(2**63, size=(bits.shape[1], WORD), dtype=np.uint64) + 1)
    return np.asarray(sum(mixed[i : i + count, i] for i in range(WORD)))


def check_repeats(drafts: Sequence[Draft]) -> None:
    """Raise DataError for a run given twice, or torques equal to the digit in other motions."""
    said = [words(draft.torque) for draft in drafts]
    of_torque = [np.unique(every) for every in said]
    for a, b in combinations(range(len(drafts)), 2):
        few = min(len(of_torque[a]), len(of_torque[b]))
        if alike(of_torque[a], of_torque[b]) <= MOST_ALIKE * few:
            continue
        one, other = drafts[a], drafts[b]
        moved = np.unique(words(one.q)), np.unique(words(other.q))
        if alike(*moved) > MOST_ALIKE * min(map(len, moved)):
            raise DataError(
                f"{other.log.source}: run {other.name} holds rows of {one.name}; give each once"
            )
        raise DataError(
            f"{other.log.source}: torques of run {other.name} equal those of {one.name} to the "
            "digit, but the motions differ: they are commands; log the measured ones"
        )
    for draft, every, torque in zip(drafts, said, of_torque, strict=True):
        if within(draft, every, len(every) - len(torque)):
            raise draft.error(
                "torques repeat to the digit while the motion differs: they are commands; log the "
                "measured ones"
            )


def alike(one: Array, other: Array) -> int:
    """How many words two runs share."""
    return len(np.intersect1d(one, other, assume_unique=True))


def within(draft: Draft, said: Array, repeated: int) -> bool:
    """Whether torques of one run repeat to the digit, and its motion does not.

    said: their words, of which so many stand there before.
    """
    if len(said) <= WORD or repeated <= MOST_ALIKE * len(said):
        return False
    moved = words(draft.q)
    return len(moved) - len(np.unique(moved)) < 0.5 * repeated
