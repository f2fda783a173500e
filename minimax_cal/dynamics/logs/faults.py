"""Faults of logs: what is wrong is refused, mended and said, or said; one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError
from minimax_cal.dynamics.logs.log_table import RUN_ROW_FIELDS, DraftRun

MIN_RUN_ROWS, MIN_RUN_DURATION = 50, 2.0  # of a run that shows anything [1, s]
MAX_TIME_STEP_OF_FILTER = 0.1  # a step over which no filter of the motion reaches [s]
PAUSE_BETWEEN_JOINED_RUNS = 1.0  # between short runs that are joined [s]
MAX_TIME_STEP_DEVIATION_SHARE, MAX_UNEVEN_STEP_SHARE = (
    0.5,
    0.05,
)  # deviation of a step, of the median; share that may have it
MIN_ROW_RATE_HZ = 25.0  # fewer rows a second hold no motion of a few Hz [Hz]
FULL_TURN = 2.0 * np.pi
MAX_COMMANDED_ANGLE = (
    2.0 * FULL_TURN
)  # two turns: no joint is commanded farther unless it turns without end [rad]
MAX_JOINT_SPEED = 20.0  # speed of any joint; the quickest wrists reach 17 [rad/s, m/s]
MAX_FAST_ROW_SHARE = 0.01  # share of rows that are faster, of a joint whose unit is wrong
MIN_JOINT_RANGE = 0.01  # range of a joint that moves [rad, m]
MAX_RANGE_OF_RADIANS_AS_DEGREES = np.radians(
    FULL_TURN
)  # a motion that fits in two pi degrees may be one in radians [rad]
MIN_SPEED_CORRELATION = 0.9  # correlation of a logged speed with the change of its joint
SPEED_AVERAGING_DURATION = 0.1  # over which both are averaged before [s]
MAX_SPEED_SCALE_DEVIATION = 0.2  # deviation of their ratio
MIN_COMMAND_EQUAL_ROW_SHARE = (
    0.99  # share of rows in which a measured torque that equals its command is the command
)
MIN_CLIPPED_DURATION, MIN_CLIPPED_ROWS = 0.03, 4  # a flat top that is no chance
NOISE_DIFFERENCE_ORDER = 6  # order of the difference that is left of a measured torque: its noise
MIN_TORQUE_NOISE_SHARE = 1e-4  # of the span of a torque; measured ones have 3e-3 to 2e-2
DEGREES_PER_RADIAN = 180.0 / np.pi


def correct_time_order(draft: DraftRun) -> DraftRun:
    """Time that runs on; rows of one time count once."""
    step = np.diff(draft.time)
    if (step < 0.0).any():
        row = int(np.argmax(step < 0.0)) + 1
        raise draft.build_error(
            f"time runs back from {draft.time[row - 1]:.6g} to {draft.time[row]:.6g} s; give each "
            "run a file or a label in a column run",
            row,
        )
    again = np.append(False, step == 0.0)
    if not again.any():
        return draft
    said = f"{again.sum()} rows repeat the time of the row before: left out"
    return draft.with_notices(
        f"{said} ({draft.format_line_numbers(np.flatnonzero(again))})"
    ).select_rows_and_log_rows(~again)


def is_run_too_short(draft: DraftRun) -> bool:
    """Whether a run is too short to show anything."""
    return len(draft.time) < MIN_RUN_ROWS or draft.duration < MIN_RUN_DURATION


def check_run_length(draft: DraftRun) -> DraftRun:
    """Raise DataError for a run that is too short."""
    if is_run_too_short(draft):
        raise draft.build_error(
            f"{len(draft.time)} rows in {draft.duration:.2f} s are too short for a run; log at "
            f"least {MIN_RUN_DURATION:g} s of motion, or give short runs in one file with a column "
            "run: they are joined"
        )
    return draft


def join_short_runs(drafts: Sequence[DraftRun]) -> list[DraftRun]:
    """Runs of one log; those too short by themselves are parts of one run, with gaps between."""
    out: list[DraftRun] = []
    for draft in drafts:
        if (
            out
            and is_run_too_short(out[-1])
            and draft.reported_payloads == out[-1].reported_payloads
        ):
            out[-1] = merge_runs(out[-1], draft)
        else:
            out.append(draft)
    if (
        len(out) > 1
        and is_run_too_short(out[-1])
        and out[-1].reported_payloads == out[-2].reported_payloads
    ):
        out[-2:] = [merge_runs(*out[-2:])]
    return out


def merge_runs(earlier_run: DraftRun, later_run: DraftRun) -> DraftRun:
    """Two runs of one log after each other, with a gap that no filter reaches over."""
    later = replace(
        later_run, time=later_run.time + earlier_run.time[-1] + PAUSE_BETWEEN_JOINED_RUNS
    )
    parts: dict[str, Any] = {
        name: None
        if (first := getattr(earlier_run, name)) is None or (second := getattr(later, name)) is None
        else np.concatenate([first, second])
        for name in (*RUN_ROW_FIELDS, "log_row_indices")
    }
    name = f"{earlier_run.name}+{later_run.name.rpartition(':')[2]}"
    said = f"{earlier_run.log.source}: short runs are joined, with a pause between: {name}"
    kept = (text for text in earlier_run.notices if "short runs are joined" not in text)
    return replace(earlier_run, name=name, notices=(*kept, said), **parts)


def add_notices_of_sampling(draft: DraftRun) -> DraftRun:
    """Gaps, uneven steps and slow rates are said."""
    step, usual = np.diff(draft.time), draft.step
    gaps = np.flatnonzero(step > max(MAX_TIME_STEP_OF_FILTER, 3.0 * usual)) + 1
    uneven = np.mean(np.abs(step - usual) > MAX_TIME_STEP_DEVIATION_SHARE * usual)
    said = []
    if len(gaps):
        longest = f"the longest {step[gaps - 1].max():.2f} s"
        said.append(
            f"{len(gaps)} gaps in time, {longest} ({draft.format_line_numbers(gaps)}): not bridged"
        )
    if uneven > MAX_UNEVEN_STEP_SHARE:
        low, high = np.quantile(step, (0.05, 0.95))
        said.append(
            f"uneven time steps ({1e3 * low:.3g} to {1e3 * high:.3g} ms): resampled by their stamps"
        )
    if usual > 1.0 / MIN_ROW_RATE_HZ:
        said.append(f"only {1.0 / usual:.3g} rows a second; log at least 50")
    return draft.with_notices(*said)


def check_angle_units(draft: DraftRun) -> DraftRun:
    """Angles that are no degrees called radians, nor the reverse."""
    turning = np.flatnonzero(~draft.log.is_prismatic)
    if not len(turning):
        return draft
    q, unit = draft.q[:, turning], draft.log.units_by_kind["q"][turning[0]]
    jumps = np.diff(q, axis=0)
    fast = (
        np.mean(np.abs(jumps) > MAX_JOINT_SPEED * np.diff(draft.time)[:, None], axis=0)
        > MAX_FAST_ROW_SHARE
    )
    wrapped = (jumps + np.pi) % FULL_TURN - np.pi
    whole = np.abs(wrapped).max(axis=0) < 0.5 * np.abs(jumps).max(axis=0)  # by whole turns
    far = np.abs(q).max(axis=0) > MAX_COMMANDED_ANGLE
    if unit == "rad" and (far.sum() > 1 or (far & fast & ~whole).any()):
        at = int(np.argmax(np.abs(q).max(axis=0)))
        row = int(np.argmax(np.abs(q[:, at])))
        name = draft.find_column_name("q", int(turning[at]))
        raise draft.build_error(
            f"column {name}: {q[row, at]:.4g} rad is more than two turns; degrees? then name the "
            "columns q1_deg, q2_deg, ...",
            row,
        )
    span = float(np.ptp(q, axis=0).max())
    if unit == "deg" and 0.0 < span < MAX_RANGE_OF_RADIANS_AS_DEGREES:
        raise draft.build_error(
            f"no joint moves more than {np.degrees(span):.2g} deg; radians? then name the columns "
            "q1_rad, q2_rad, ...; else log a larger motion"
        )
    return draft


def unwrap_angles_or_refuse_jumps(draft: DraftRun) -> DraftRun:
    """Angles without jumps by whole turns; jumps by less than a turn are none of an arm."""
    q = draft.q.copy()
    step = np.diff(draft.time)
    for j in np.flatnonzero(~draft.log.is_prismatic).tolist():
        turns = np.round(np.diff(q[:, j]) / FULL_TURN) * (
            step < MAX_TIME_STEP_OF_FILTER
        )  # a gap may hold any motion
        if turns.any():
            q[1:, j] -= FULL_TURN * np.cumsum(turns)
            rows = np.flatnonzero(turns) + 1
            text = (
                f"column {draft.find_column_name('q', j)} jumps by whole "
                f"turns ({draft.format_line_numbers(rows)})"
            )
            draft = draft.with_notices(f"{text}: unwrapped")
    too_fast = np.abs(np.diff(q, axis=0)) > MAX_JOINT_SPEED * np.maximum(step, 1e-3)[:, None]
    too_fast &= (step < MAX_TIME_STEP_OF_FILTER)[:, None]
    if too_fast.any():
        row, j = np.argwhere(too_fast)[0]
        raise draft.build_error(
            f"column {draft.find_column_name('q', j)} jumps by {q[row + 1, j] - q[row, j]:.3g} in "
            f"{1e3 * step[row]:.3g} ms; delete the row, or give each run a file",
            int(row) + 1,
        )
    return replace(draft, q=q)


def find_moving_joints(draft: DraftRun) -> Array:
    """(n,) True for joints that move."""
    return np.asarray(np.ptp(draft.q, axis=0) > MIN_JOINT_RANGE)


def refuse_still_runs_and_notice_still_joints(draft: DraftRun) -> DraftRun:
    """Joints that stay are said; a motion of none, or torques that stay, are refused."""
    still = ~find_moving_joints(draft)
    if still.all():
        raise draft.build_error("no joint moves; log a motion")
    flat = np.ptp(draft.torque, axis=0) == 0.0
    if draft.has_torques and flat.any():
        j = int(np.argmax(flat))
        raise draft.build_error(
            f"column {draft.find_column_name(draft.torque_kind, j)}"
            f" is {draft.torque[0, j]:g} in all rows; the "
            "driver does not report it: log another quantity"
        )
    names = ", ".join(draft.find_column_name("q", j) for j in np.flatnonzero(still).tolist())
    draft = draft.with_notices(
        *([f"no motion in {names}: nothing is learnt of it"] if names else [])
    )
    if draft.qd is not None and not np.ptp(draft.qd[:, ~still], axis=0).all():
        j = int(np.flatnonzero(~still)[np.argmin(np.ptp(draft.qd[:, ~still], axis=0))])
        name = draft.find_column_name("qd", j)
        draft = replace(draft, qd=None).with_notices(
            f"column {name} is the same in all rows: not used"
        )
    return draft


def drop_wrong_logged_speeds(draft: DraftRun) -> DraftRun:
    """Logged speeds that are the change of their joints."""
    if draft.qd is None:
        return draft
    # Mean speeds from the joints and as logged: stamps that jitter hardly matter over so many rows.
    half = max(1, round(0.5 * SPEED_AVERAGING_DURATION / draft.step))
    took = draft.time[2 * half :] - draft.time[: -2 * half]
    near = took < 2.0 * np.median(took)  # gaps are left out
    joints, wide = np.flatnonzero(find_moving_joints(draft)), 2 * half + 1
    sums = np.pad(draft.qd, ((1, 0), (0, 0))).cumsum(axis=0)
    change = (draft.q[2 * half :] - draft.q[: -2 * half]) / took[:, None]
    mean = (sums[wide:] - sums[:-wide]) / wide
    d, v = change[near][:, joints], mean[near][:, joints]
    norm = np.linalg.norm(d, axis=0)[:, None] * np.linalg.norm(v, axis=0)
    alike = d.T @ v / norm  # (of change, of speed)
    own = np.diag(alike)
    ratio = (d * v).sum(axis=0) / (v * v).sum(axis=0)
    is_alike = bool((own > MIN_SPEED_CORRELATION).all())
    if is_alike and np.abs(ratio - 1.0).max() < MAX_SPEED_SCALE_DEVIATION:
        return draft
    at = int(np.argmax(np.abs(np.log(ratio))) if is_alike else np.argmin(own))
    j = int(joints[at])
    name, speed_name = draft.find_column_name("q", j), draft.find_column_name("qd", j)
    if is_alike:
        called, by = draft.log.units_by_kind["q"][j], float(ratio[at])
        mend = "check the unit of both and of time"
        if abs(by / DEGREES_PER_RADIAN - 1.0) < MAX_SPEED_SCALE_DEVIATION and called == "rad":
            mend = f"{name} is in degrees: name the columns q1_deg, q2_deg, ..."
        elif abs(by * DEGREES_PER_RADIAN - 1.0) < MAX_SPEED_SCALE_DEVIATION:
            mend = f"{speed_name} is in degrees a second: name the columns qd1_deg_s, ..."
            if called == "deg":
                mend = f"{name} is in radians: name the columns q1_rad, q2_rad, ..."
        raise draft.build_error(f"{name} changes by {by:.3g} times what {speed_name} says; {mend}")
    other = int(np.argmax(np.abs(alike[:, at])))
    if own[at] < -MIN_SPEED_CORRELATION:
        raise draft.build_error(
            f"column {speed_name} has another sign than the change of {name}; mend one of them"
        )
    if np.abs(alike[other, at]) > MIN_SPEED_CORRELATION:
        raise draft.build_error(
            f"column {speed_name} is the speed of "
            f"{draft.find_column_name('q', int(joints[other]))}, not of "
            f"{name}; put the joints of both in the robot's order"
        )
    text = f"column {speed_name} does not follow {name} (correlation {own[at]:.2f})"
    return replace(draft, qd=None, qdd=None).with_notices(f"{text}: logged speeds are not used")


def refuse_commanded_and_notice_quiet_torques(draft: DraftRun) -> DraftRun:
    """Torques that are no command: not those of a column of commands, and with some noise."""
    command = draft.log.values_by_kind.get(f"{draft.torque_kind}_cmd")
    if command is not None:
        same = np.mean(command[draft.log_row_indices] == draft.torque, axis=0)
        j = int(np.argmax(same))
        if same[j] > MIN_COMMAND_EQUAL_ROW_SHARE:
            raise draft.build_error(
                f"column {draft.find_column_name(draft.torque_kind, j)} equals "
                f"{draft.find_column_name(f'{draft.torque_kind}_cmd', j)}"
                f" in all rows: it is the command; log the "
                "measured one"
            )
    if draft.log.is_simulated:
        return draft
    quiet, order = [], 2 * NOISE_DIFFERENCE_ORDER
    for j in np.flatnonzero(find_moving_joints(draft)).tolist():
        torque = draft.torque[:, j]
        torque = torque[np.append(True, np.diff(torque) != 0.0)]  # drives that report more slowly
        if len(torque) < MIN_RUN_ROWS:
            continue
        noise = 1.4826 * np.median(np.abs(np.diff(torque, NOISE_DIFFERENCE_ORDER)))
        if (
            noise / np.sqrt(comb(order, NOISE_DIFFERENCE_ORDER)) / np.ptp(torque)
            < MIN_TORQUE_NOISE_SHARE
        ):
            quiet.append(draft.find_column_name(draft.torque_kind, j))
    said = "a command, a filtered or a simulated signal; log the measured one"
    return draft.with_notices(*([f"no noise in {', '.join(quiet)}: {said}"] if quiet else []))


def add_notices_of_clipped_torques(draft: DraftRun) -> DraftRun:
    """Torques that stop at a limit while the arm moves are said."""
    least = max(MIN_CLIPPED_ROWS, round(MIN_CLIPPED_DURATION / draft.step))
    for j, torque in enumerate(draft.torque.T):
        start = np.flatnonzero(np.append(True, np.diff(torque) != 0.0))
        length = np.diff(np.append(start, len(torque)))
        high = np.abs(torque[start]) >= 0.999 * np.abs(torque).max()
        limit = max(least, 2 * int(length[~high].max(initial=0)))
        flat = {
            a: n
            for a, n in zip(start[high], length[high], strict=True)
            if n >= limit and np.ptp(draft.q[a : a + n], axis=0).max() > 0.1 * MIN_JOINT_RANGE
        }
        if flat:
            rows = np.array(list(flat))
            at = f"{torque[rows[0]]:.4g} {'N m' if draft.torque_kind == 'tau' else 'A'}"
            draft = draft.with_notices(
                f"column {draft.find_column_name(draft.torque_kind, j)}"
                f" is cut off at {at} in {sum(flat.values())} "
                f"rows ({draft.format_line_numbers(rows)}): a limit "
                f"of the drive; move more slowly there"
            )
    return draft


RUN_CHECKS: tuple[
    Callable[[DraftRun], DraftRun], ...
] = (  # in this order: each relies on those before
    correct_time_order,
    check_run_length,
    add_notices_of_sampling,
    check_angle_units,
    unwrap_angles_or_refuse_jumps,
    refuse_still_runs_and_notice_still_joints,
    drop_wrong_logged_speeds,
)
TORQUE_CHECKS = (refuse_commanded_and_notice_quiet_torques, add_notices_of_clipped_torques)


def correct_and_check_run(draft: DraftRun) -> DraftRun:
    """The draft without what could be mended, and what is to be said of it.  Raises DataError."""
    for check in (*RUN_CHECKS, *(TORQUE_CHECKS if draft.has_torques else ())):
        draft = check(draft)
    return draft


# ---- runs that are one ---------------------------------------------------------------------------


MIN_WORD_ROWS, WORD_SHARE_OF_RUN = (
    4,
    0.05,
)  # rows that have to follow each other alike: at least, and of a run
MAX_COMMON_WORD_SHARE = 0.2  # of a run's words that may stand elsewhere


def drop_repeated_rows(values: Array) -> Array:
    """(m, n) values without rows that repeat the one before."""
    return np.asarray(values[np.append(True, (values[1:] != values[:-1]).any(axis=1))])


def hash_row_sequences(values: Array, row_count: int) -> Array:
    """(w,) a number for each so many rows (m, n) that follow each other."""
    bits = np.ascontiguousarray(values, dtype=float).view(np.uint64)
    count, random = max(len(bits) - row_count + 1, 0), np.random.default_rng(0)
    mixed = bits @ (
        2 * random.integers(2**63, size=(bits.shape[1], row_count), dtype=np.uint64) + 1
    )
    return np.asarray(sum(mixed[i : i + count, i] for i in range(row_count)))


def compute_common_word_share(rows: Array, other_rows: Array) -> float:
    """Share of the words of the shorter of two runs (m, n) that the other holds too.

    A word has WORD_SHARE of that run's rows: what drives log in coarse steps coincides in a few
    rows of any two runs, and seldom in many that follow each other.
    """
    rows, other_rows = drop_repeated_rows(rows), drop_repeated_rows(other_rows)
    length = max(MIN_WORD_ROWS, int(WORD_SHARE_OF_RUN * min(len(rows), len(other_rows))))
    told = (
        np.unique(hash_row_sequences(rows, length)),
        np.unique(hash_row_sequences(other_rows, length)),
    )
    few = min(map(len, told))
    return len(np.intersect1d(*told, assume_unique=True)) / few if few else 0.0


def check_no_repeated_runs(drafts: Sequence[DraftRun]) -> None:
    """Raise DataError for a run given twice, or torques equal to the digit in other motions."""
    for one, other in combinations(drafts, 2):
        if compute_common_word_share(one.torque, other.torque) <= MAX_COMMON_WORD_SHARE:
            continue
        whole = (np.hstack([draft.q, draft.torque]) for draft in (one, other))
        if compute_common_word_share(*whole) > MAX_COMMON_WORD_SHARE:
            raise DataError(
                f"{other.log.source}: run {other.name} holds rows of {one.name}; give each once"
            )
        raise DataError(
            f"{other.log.source}: torques of run {other.name} equal those of {one.name} to the "
            "digit, but the motions differ: they are commands; log the measured ones"
        )
    for draft in drafts:
        if has_repeated_torques(draft):
            raise draft.build_error(
                "torques repeat to the digit while the motion differs: they are commands; log the "
                "measured ones"
            )


def has_repeated_torques(draft: DraftRun) -> bool:
    """Whether torques of one run repeat to the digit, and its motion does not."""
    torque = drop_repeated_rows(draft.torque)
    length = max(MIN_WORD_ROWS, int(WORD_SHARE_OF_RUN * len(torque)))
    said, moved = (
        hash_row_sequences(torque, length),
        hash_row_sequences(drop_repeated_rows(draft.q), length),
    )
    repeated = len(said) - len(np.unique(said))
    if len(said) <= MIN_WORD_ROWS or repeated <= MAX_COMMON_WORD_SHARE * len(said):
        return False
    return len(moved) - len(np.unique(moved)) < 0.5 * repeated
