"""A ball on the flange that visits sockets again: the places of the sockets are eliminated."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.errors import DataError, OptionError
from minimax_cal.instruments.instrument import (
    MIN_LINEAR_START_SINGULAR_VALUE,
    SPOT,
    DistanceLimits,
    FitNominalArm,
    Instrument,
    InstrumentColumns,
    NumberCounts,
    Words,
    bare,
    check_instrument_data,
    count_distinct_poses,
    drop_unmeasured_rows,
)
from minimax_cal.instruments.instrument_options import (
    InstrumentOptions,
    KnownDistance,
    format_known_distance,
)
from minimax_cal.instruments.protocol import (
    MIN_MEAN_WEIGHT,
    NO_ROW_NUMBERS,
    FlangePoses,
    ResidualRows,
)
from minimax_cal.measuring.measurements import MAX_POINT_DISTANCE, build_joint_measurements
from minimax_cal.measuring.pose_groups import HoldoutMask, group_repeated_poses, select_holdout_rows
from minimax_cal.reading.measurement_table import MeasurementTable
from minimax_cal.robots.inverse_kinematics import pose_residual_and_jacobian, solve_nearest_joints
from minimax_cal.robots.joint_sampling import random_joint_values
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.transforms import build_transform

MAX_REACH_JOINT_STEP = 0.5  # step of a joint [rad, m]
MAX_CLOSED_GAP = 1e-9  # a gap below this counts as none [m]


def reach(
    robot: Robot, ball: Array, goal: Array, q: Array, iterations: int = 100
) -> tuple[Array, Array]:
    """Joint values (m, n) near q at which the ball lies at its goal, and the gaps left (m,) [m].

    ball: (3,) in the last frame [m].  goal: (m, 3) in the base [m].  q: (m, n) where to start
    [rad, m].  Damped Newton with steps of least norm; what cannot be reached ends nearby.
    """
    place = build_transform(np.eye(3), goal)

    def look(rows: Array, here: Array) -> tuple[Array, Array]:
        turned, turning = robot.chain_joint_values(here), robot.joint_to_chain_matrix
        return pose_residual_and_jacobian(
            robot.mdh, turned, robot.prismatic, turning, place[rows], 0.0, ball
        )

    anywhere = np.full(q.shape, np.inf)
    found = solve_nearest_joints(
        look, q, -anywhere, anywhere, max_joint_step=MAX_REACH_JOINT_STEP, max_steps=iterations
    )
    gap, _ = look(np.arange(len(q)), found)
    return found, np.asarray(np.linalg.norm(gap, axis=1))


def closing_poses(
    robot: Robot, ball: Array, sockets: int, visits: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Random joint values (m, n) that hold the ball in the same socket by turns, and labels (m,).

    Each socket is reached from `visits` random starts over the joints' whole range.  Where fewer
    than two ways to it are found, it is left out.
    """
    q = random_joint_values(robot, (sockets, visits), rng)
    pose = robot.pose(q[:, 0])
    place = pose[:, :3, :3] @ ball + pose[:, :3, 3]
    goal = np.repeat(place, visits, axis=0)
    found, gap = reach(robot, ball, goal, q.reshape(-1, robot.joints))
    label = np.repeat(np.arange(sockets), visits)
    closed = gap < MAX_CLOSED_GAP
    often = np.bincount(label[closed], minlength=sockets) > 1
    kept = closed & often[label]
    return found[kept], label[kept]


# ---- sockets -------------------------------------------------------------------------------------


SOCKET_COLUMN_PATTERN = re.compile("socket")
MIN_SOCKETS_HELD_OUT_WHOLE = 5  # sockets from which on whole ones are held out
RANDOM_SOCKET_COUNT, RANDOM_VISITS_PER_SOCKET = 20, 10


@dataclass(frozen=True, eq=False)
class SocketVisits(Instrument):
    """Visits to sockets.

    socket: (m,) label of the socket that held the ball.  known: sockets whose distance is known
    [m].  sole_length: whether these are the only lengths of the fit; single: whether the closures
    are all of it.  share: (m,) how much each visit counts, empty where all count alike.

    Its own: the ball on the flange.  The best place of a socket is the visits' barycentre, whatever
    the other parameters are: eliminating it leaves the visits about it.
    """

    socket: Array
    known: tuple[KnownDistance, ...] = ()
    sole_length: bool = True
    single: bool = True
    share: Array = field(default_factory=lambda: NO_ROW_NUMBERS)

    kind = "closures"
    words = Words(
        quantity="ball about its socket",
        caution="A misclosure is no error of position: what moves all visits of a socket alike "
        "does not show in it. ",
        counted="coordinates of visits",
        check="the labels of the sockets",
        more="more sockets, farther apart",
    )
    names = SPOT
    part_names = ("visits",)
    by_row = ("socket",)
    chosen = ("known", "sole_length", "single")
    options = ("known_distances",)
    shrinks = True
    refines = False
    unmoved = "moves or turns all sockets alike: closures know no base frame"
    scale = (
        "a closure has no length standard",
        "one known length, as known_distances= A,B,MM, gives it",
    )

    @property
    def socket_labels(self) -> tuple[str, ...]:
        """The sockets' labels, in alphabetical order."""
        return tuple(str(label) for label in np.unique(self.socket))

    @cached_property
    def socket_index(self) -> Array:
        """(m,) which of the sockets."""
        return np.unique(self.socket, return_inverse=True)[1]

    @property
    def independent_number_count(self) -> int:
        """Three for each different pose in a socket but the first."""
        return sum(
            3 * (count_distinct_poses(self.at, self.socket == label) - 1)
            for label in self.socket_labels
        )

    def count_train_and_holdout_numbers(self, holdout_mask: Array) -> NumberCounts:
        """Three less for each barycentre."""
        return count_independent_coordinates(self.socket, holdout_mask)

    def check_data(self) -> None:
        """Raise DataError for a socket that was not visited again with other joint values."""
        group = group_repeated_poses(self.at)
        for label in self.socket_labels:
            rows = np.flatnonzero(self.socket == label)
            if len(np.unique(group[rows])) < 2:
                often = "once" if len(rows) == 1 else "with the same joint values only"
                raise DataError(
                    f"{self.row_location(rows[0])}: column socket: "
                    f"{label!r} is visited {often}; visit it "
                    "again with other joint values, or leave the cell empty"
                )

    def sort_rows_for_fit(self) -> Self:
        """Visits of one socket together."""
        return self.take_rows(np.argsort(self.socket, kind="stable"))

    def file_columns(self) -> Mapping[str, Array]:
        """The labels."""
        return {"socket": self.socket}

    # ---- in a fit ----------------------------------------------------------------------------

    def ready(self, robot: Robot, options: InstrumentOptions) -> SocketVisits:
        """With the distances that are known between them."""
        there = set(self.socket_labels)
        known = tuple(one for one in options.known_distances if set(one[:2]) <= there)
        return replace(self, known=known)

    def adapt_to_other_instruments(self, other_instruments: Sequence[Instrument]) -> SocketVisits:
        """A length of any other instrument is as good as a known distance."""
        lengths = any(
            one.has_length for one in other_instruments if not isinstance(one, SocketVisits)
        )
        return replace(self, sole_length=not lengths, single=not other_instruments)

    @property
    def has_length(self) -> bool:
        """Whether a distance of sockets is known."""
        return bool(self.known)

    @property
    def degrees_of_freedom(self) -> int:
        """Three less for each socket's place; and known distances."""
        return 3 * (self.poses - len(self.socket_labels)) + len(self.known)

    @property
    def given_number_count(self) -> int:
        """The known distances."""
        return len(self.known)

    def socket_centres(self, ball_positions: Array) -> Array:
        """(g, 3) barycentres of the visits to each socket.  ball_positions: (m, 3) of the ball."""
        return np.stack(
            [
                self.barycentre_weights(self.socket == label) @ ball_positions
                for label in self.socket_labels
            ]
        )

    def barycentre_weights(self, visit_mask: Array) -> Array:
        """(m,) by how much each visit counts in the barycentre of some (m,)."""
        weight = visit_mask * (self.share + MIN_MEAN_WEIGHT if len(self.share) else 1.0)
        return np.asarray(weight / weight.sum())

    def with_row_weights(self, row_weights: Array) -> SocketVisits:
        """With barycentres that are weighted as well."""
        return replace(self, share=row_weights[: self.poses])

    def read(self, arm: FlangePoses, unknowns: Array) -> ResidualRows:
        """Three rows a visit, axis by axis, about the socket's barycentre; known distances.

        One weighs as much as all visits together, else the fit would shrink the arm to shrink its
        misclosures.  Where other instruments measure lengths too, it counts as a coordinate.
        """
        m, place, here = self.poses, arm.place(unknowns[:3]), self.socket_index
        count = int(here.max()) + 1
        axis = np.repeat(np.arange(3), m)
        rows = ResidualRows(
            residual=-place.T.reshape(-1),
            pose=np.tile(np.arange(m), 3),
            point=np.tile(place, (3, 1)),
            by_point=np.eye(3)[axis],
            by_rotation=np.zeros((3 * m, 3)),
            by_own=arm.rotation.swapaxes(0, 1).reshape(3 * m, 3),
            about=np.tile(here, 3) + count * axis,
        )
        if not self.known:
            return rows
        heavy = 3 * m if self.sole_length else 1
        sums, short, first = np.zeros((len(self.known), 3, m)), [], []
        for one, (a, b, distance) in zip(sums, self.known, strict=True):
            apart = self.barycentre_weights(self.socket == a) - self.barycentre_weights(
                self.socket == b
            )
            gap = apart @ place
            length = max(float(np.linalg.norm(gap)), 1e-12)
            one += (gap / length)[:, None] * apart
            short.append(distance - length)
            first.append(int((self.socket == a).argmax()))
        return rows._replace(
            sums=np.sqrt(heavy) * sums.reshape(-1, 3 * m), short=np.sqrt(heavy) * np.array(short),
            sum_pose=np.array(first), heavy=float(heavy),
        )  # fmt: skip

    def starts(self, arm: FlangePoses, free_unknowns: Array) -> Sequence[Array]:
        """The ball's place on the flange for the arm as drawn, in which misclosures are linear."""
        rows = replace(self, known=()).read(arm, np.zeros(3))
        error, slopes = rows.eliminate_places_and_add_sums(rows.by_own.T[free_unknowns])
        values, vectors = np.linalg.eigh(slopes @ slopes.T)
        told = values > MIN_LINEAR_START_SINGULAR_VALUE**2 * max(float(values[-1]), 1e-30)
        ball = np.zeros(3)
        ball[free_unknowns] = vectors[:, told] @ (
            vectors[:, told].T @ (slopes @ error) / values[told]
        )
        return [ball]

    def at_random_poses(self, robot: Robot, unknowns: Array) -> SocketVisits:
        """At plenty of random poses that close."""
        q, socket = closing_poses(
            robot,
            unknowns[:3],
            RANDOM_SOCKET_COUNT,
            RANDOM_VISITS_PER_SOCKET,
            np.random.default_rng(0),
        )
        if len(np.unique(socket)) < 2:  # an arm that hardly reaches a place in two ways
            return self.at_exactly_fitting_poses(robot, unknowns)
        labels = np.array([f"{number:03d}" for number in socket])
        pair = np.unique(labels)[:2].tolist()
        known = ((pair[0], pair[1], 0.0),) * min(len(self.known), 1)
        return replace(self, at=bare(q, {}), socket=labels, known=known)

    def at_exactly_fitting_poses(self, robot: Robot, unknowns: Array) -> SocketVisits:
        """At nearby poses where the arm itself closes.

        Where a closure misses by millimetres, its rows turn with a turn of the whole arm, as if
        that could be told.
        """
        pose = robot.pose(self.at.q)
        centre = self.socket_centres(pose[:, :3, :3] @ unknowns[:3] + pose[:, :3, 3])
        q, _ = reach(robot, unknowns[:3], centre[self.socket_index], self.at.q)
        return replace(self, at=replace(self.at, q=q))

    def mean_square_error(self, arm: FlangePoses, unknowns: Array) -> float:
        """Of visits about their socket [m^2]."""
        rows = self.read(arm, unknowns)
        return float((rows.subtract_place_means(rows.residual) ** 2).sum() / self.poses)

    def part_errors(self, arm: FlangePoses, unknowns: Array, holdout_mask: Array) -> Array:
        """Of visits about their socket."""
        return compute_misclosures(arm.place(unknowns[:3]), self.socket, holdout_mask)[:, None]

    def fitted_values_to_dict(
        self, arm: FlangePoses, unknowns: Array, nominal_unknowns: Array
    ) -> dict[str, Any]:
        """Ball in the last frame, sockets in the robot's base."""
        centre = self.socket_centres(arm.place(unknowns[:3]))
        other = "as drawn" if self.single else "other files"
        return {
            "target_mm": (1e3 * unknowns[:3]).tolist(),
            "sockets_mm": dict(zip(self.socket_labels, (1e3 * centre).tolist(), strict=True)),
            "known_distances": [[a, b, 1e3 * length] for a, b, length in self.known],
            "scale": "known distance" if self.known else other,
        }

    def holdout_rows_and_notices(self, options: InstrumentOptions) -> HoldoutMask:
        """(m,) True where a visit is held out; sockets of known distances stay."""
        needed = tuple(label for known in options.known_distances for label in known[:2])
        return select_holdout_visits(self, options.holdout, options.seed, needed)

    # ---- slips -------------------------------------------------------------------------------

    @classmethod
    def check_options(cls, instruments: Sequence[SocketVisits], options: InstrumentOptions) -> None:
        """Raise OptionError for a known distance that is none of these files'."""
        sockets = [set(data.socket_labels) for data in instruments]
        files = ", ".join(data.at.source for data in instruments)
        asked: set[frozenset[str]] = set()
        for known in options.known_distances:
            first, second, distance = known
            said = format_known_distance(known)
            if {first, second} in asked:
                raise OptionError(f"{said}: this distance is given twice; give it once")
            asked.add(frozenset((first, second)))
            for label in (first, second):
                if not any(label in some for some in sockets):
                    raise OptionError(f"{said}: {files} has no socket {label!r}")
            if first == second or not 0.0 < distance < MAX_POINT_DISTANCE:
                raise OptionError(f"{said}: needs two different sockets and a positive length")
            if sum({first, second} <= some for some in sockets) != 1:
                raise OptionError(f"{said}: both sockets must be in one file, and in no other")

    def check_nominal_fit(
        self, fit_nominal_arm: FitNominalArm, distance_limits: DistanceLimits
    ) -> None:
        """Raise OptionError for a known distance that no arm like the drawn one can have."""
        ready, arm, own = fit_nominal_arm(self)
        centre = dict(
            zip(ready.socket_labels, ready.socket_centres(arm.place(own[:3])), strict=True)
        )
        for known, limit in zip(ready.known, distance_limits(ready, own), strict=True):
            drawn, told = float(np.linalg.norm(centre[known[0]] - centre[known[1]])), known[2]
            if abs(drawn - told) <= limit:
                continue
            metres = "; metres? give millimetres" if abs(drawn - 1e3 * told) <= limit else ""
            raise OptionError(
                f"{format_known_distance(known)}: by the arm as drawn "
                f"these sockets of {self.at.source} are "
                f"{1e3 * drawn:.4g} mm apart{metres or '; check the labels and the length'}"
            )


def closures(q: Array, socket: Array, **columns: Array) -> SocketVisits:
    """Sockets visited again, from arrays.  q: (m, n) [rad, m].  socket: (m,) labels."""
    labels = np.asarray(socket).astype(str)
    return check_instrument_data(SocketVisits(bare(q, columns, socket=labels), labels))


def parse_socket_visits(table: MeasurementTable) -> SocketVisits:
    """The sockets' labels.  Raises DataError."""
    at = build_joint_measurements(table, SOCKET_COLUMN_PATTERN)
    labels = np.array(table.text_column("socket"))
    return drop_unmeasured_rows(SocketVisits(at, labels), np.asarray(labels == ""))


def select_holdout_visits(
    data: SocketVisits, holdout: float, seed: int, needed_sockets: tuple[str, ...]
) -> HoldoutMask:
    """(m,) True where a visit is held out, and a notice that says what was chosen.

    Whole sockets where there are enough: nothing of them shaped the fit.  Else visits, of which
    each socket keeps two.  needed_sockets: sockets that must stay, those of known distances.
    """
    held, notices = select_holdout_rows(data.at, holdout, seed)  # raises for a wrong option
    if "split" in data.at.columns:
        gone = [label for label in needed_sockets if held[data.socket == label].all()]
        if gone:
            raise DataError(
                f"{data.at.source}: column split holds out all of socket {gone[0]!r}, whose "
                "distance is given with known_distances=; leave some of its visits in training"
            )
        return HoldoutMask(held, notices)
    if holdout == 0.0:
        return HoldoutMask(held, notices)
    rng = np.random.default_rng(seed)
    labels = np.array(data.socket_labels)
    loose = labels[~np.isin(labels, needed_sockets)]
    whole = round(holdout * len(labels))
    if len(labels) >= MIN_SOCKETS_HELD_OUT_WHOLE and 0 < whole <= len(loose):
        chosen = rng.permutation(loose)[:whole]
        notice = (
            f"{whole} of {len(labels)} sockets are held out whole, their own barycentres fitted: "
            "an error is about that barycentre, three degrees of freedom less for each socket"
        )
        return HoldoutMask(np.isin(data.socket, chosen), (notice,))
    held = select_spare_visits(data, holdout, rng)
    count = f"{len(labels)} socket{'s' if len(labels) > 1 else ''}"
    notice = (
        f"with {count}, visits are held out, not sockets: an error is about the barycentre of the "
        "training visits"
    )
    return HoldoutMask(held, (notice,))


def select_spare_visits(data: SocketVisits, holdout: float, rng: np.random.Generator) -> Array:
    """(m,) True for a share of the visits; each socket keeps two different poses."""
    pose = group_repeated_poses(data.at)
    held = np.zeros(data.poses, dtype=bool)
    wanted = round(holdout * data.poses)
    for chosen in rng.permutation(np.unique(pose)):
        if held.sum() >= wanted:
            break
        rows = pose == chosen
        rest = ~held & ~rows
        left = [
            len(np.unique(pose[rest & (data.socket == label)]))
            for label in np.unique(data.socket[rows])
        ]
        if min(left) >= 2:
            held |= rows
    return held


def compute_misclosures(ball_positions: Array, sockets: Array, holdout_mask: Array) -> Array:
    """Errors of visits as if about known sockets: (m, 3) [m], NaN where nothing closes.

    ball_positions: (m, 3) of the ball by some model [m].  sockets: (m,) labels.  holdout_mask: (m,)
    True where held out.  A visit is about the barycentre of its socket's training visits, n in
    number, of which it is one: sqrt(n/(n-1)) makes up for it.  In a socket held out whole it is the
    same, about its own barycentre.  A held-out visit about n training visits holds their error too:
    sqrt(n/(n+1)).
    """
    error = np.full(ball_positions.shape, np.nan)
    for label in np.unique(sockets):
        here = sockets == label
        about = here & ~holdout_mask if (here & ~holdout_mask).any() else here
        n, apart = int(about.sum()), here & ~about
        centre = ball_positions[about].mean(axis=0)
        error[apart] = (ball_positions[apart] - centre) * np.sqrt(n / (n + 1.0))
        if n > 1:
            error[about] = (ball_positions[about] - centre) * np.sqrt(n / (n - 1.0))
    return error


def count_independent_coordinates(sockets: Array, holdout_mask: Array) -> NumberCounts:
    """Independent coordinates of training and held-out visits: three less for each barycentre."""
    trained, left = np.unique(sockets[~holdout_mask]), np.unique(sockets[holdout_mask])
    alone = len(left) - int(np.isin(left, trained).sum())
    return NumberCounts(
        3 * (int((~holdout_mask).sum()) - len(trained)), 3 * (int(holdout_mask.sum()) - alone)
    )


SocketVisits.file = InstrumentColumns(
    SOCKET_COLUMN_PATTERN, SOCKET_COLUMN_PATTERN, "socket", parse_socket_visits
)
