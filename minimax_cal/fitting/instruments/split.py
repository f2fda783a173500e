"""Which rows are held out, and what an error of a visit is about."""

from __future__ import annotations

import numpy as np

from minimax_cal.fitting.instruments.data import RelativeData
from minimax_cal.fitting.instruments.options import RelativeOptions
from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import DataError
from minimax_cal.measuring.grouping import groups, held_out

WHOLE = 5  # sockets from which on whole ones are held out


def held_back(data: RelativeData, options: RelativeOptions) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where a row is held out, as `grouping.held_out` chooses or as sockets need."""
    if data.kind != "closures":
        return held_out(data.at, options.holdout, options.seed)
    needed = tuple(label for known in options.known_distances for label in known[:2])
    return split_sockets(data, options.holdout, options.seed, needed)


def before_and_after(nominal: Array, calibrated: Array, held: Array) -> dict[str, Array]:
    """Errors (parts, m, ...) of all poses by the keys of a result.  held: (m,)."""
    return {
        "nominal": nominal[:, held],
        "train": calibrated[:, ~held],
        "holdout": calibrated[:, held],
        "nominal_train": nominal[:, ~held],
    }


def split_sockets(
    data: RelativeData, holdout: float, seed: int, needed: tuple[str, ...]
) -> tuple[Array, tuple[str, ...]]:
    """(m,) True where a visit is held out, and a notice that says what was chosen.

    Whole sockets where there are enough: nothing of them shaped the fit.  Else visits, of which
    each socket keeps two.  needed: sockets that must stay, those of known distances.
    """
    held, notices = held_out(data.at, holdout, seed)  # raises for a wrong option
    if "split" in data.at.columns:
        gone = [label for label in needed if held[data.socket == label].all()]
        if gone:
            raise DataError(
                f"{data.at.source}: column split holds out all of socket {gone[0]!r}, whose "
                "distance is given with known_distances=; leave some of its visits in training"
            )
        return held, notices
    if holdout == 0.0:
        return held, notices
    rng = np.random.default_rng(seed)
    labels = np.array(data.sockets)
    loose = labels[~np.isin(labels, needed)]
    whole = round(holdout * len(labels))
    if len(labels) >= WHOLE and 0 < whole <= len(loose):
        chosen = rng.permutation(loose)[:whole]
        notice = (
            f"{whole} of {len(labels)} sockets are held out whole, their own barycentres fitted: "
            "an error is about that barycentre, three degrees of freedom less for each socket"
        )
        return np.isin(data.socket, chosen), (notice,)
    held = spare_visits(data, holdout, rng)
    count = f"{len(labels)} socket{'s' if len(labels) > 1 else ''}"
    notice = (
        f"with {count}, visits are held out, not sockets: an error is about the barycentre of the "
        "training visits"
    )
    return held, (notice,)


def spare_visits(data: RelativeData, holdout: float, rng: np.random.Generator) -> Array:
    """(m,) True for a share of the visits; each socket keeps two different poses."""
    pose = groups(data.at)
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


def misclosures(place: Array, socket: Array, held: Array) -> Array:
    """Errors of visits as if about known sockets: (m, 3) [m], NaN where nothing closes.

    place: (m, 3) of the ball by some model [m].  socket: (m,) labels.  held: (m,) True where held
    out.  A visit is about the barycentre of its socket's training visits, n in number, of which it
    is one: sqrt(n/(n-1)) makes up for it.  In a socket held out whole it is the same, about its own
    barycentre.  A held-out visit about n training visits holds their error too: sqrt(n/(n+1)).
    """
    error = np.full(place.shape, np.nan)
    for label in np.unique(socket):
        here = socket == label
        about = here & ~held if (here & ~held).any() else here
        n, apart = int(about.sum()), here & ~about
        centre = place[about].mean(axis=0)
        error[apart] = (place[apart] - centre) * np.sqrt(n / (n + 1.0))
        if n > 1:
            error[about] = (place[about] - centre) * np.sqrt(n / (n - 1.0))
    return error


def free_numbers(socket: Array, held: Array) -> tuple[int, int]:
    """Independent coordinates of training and held-out visits: three less for each barycentre."""
    trained, left = np.unique(socket[~held]), np.unique(socket[held])
    alone = len(left) - int(np.isin(left, trained).sum())
    return 3 * (int((~held).sum()) - len(trained)), 3 * (int(held.sum()) - alone)


def count_numbers(data: RelativeData, held: Array) -> dict[str, int]:
    """Independent numbers behind the errors, by the keys of a result."""
    if data.kind == "closures":
        trained, left = free_numbers(data.socket, held)
    else:
        each = numbers_by_row(data)
        trained, left = int(each[~held].sum()), int(each[held].sum())
    return {"nominal": left, "holdout": left, "train": trained, "nominal_train": trained}


def numbers_by_row(data: RelativeData) -> Array:
    """(m,) how many numbers each row holds; of poses and points in space."""
    if data.kind == "poses":
        return np.full(data.poses, 6)
    if data.kind == "pixels":
        return 2 * np.bincount(data.images.pose, minlength=data.poses)
    if data.kind == "points":
        return np.asarray(3 * data.at.seen.sum(axis=1))
    if data.kind == "contacts":
        return np.ones(data.poses, dtype=int)
    return np.asarray(np.isfinite(data.length).sum(axis=1))
