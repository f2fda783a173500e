"""What pixels can tell, and why not the rest.

Pixels know no base and no tool, and no length either where no board gives one.  Both show in the
rank of the directions to the targets at plenty of poses that no one had to take.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from minimax_cal.fitting.identify import (
    RANK_TOLERANCE,
    Because,
    Identification,
    Kept,
    drop_order,
    redundant,
    scale_keeper,
)
from minimax_cal.fitting.pixels.model import PixelModel, Scene
from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.parameters import Names
from minimax_cal.robots.robot import Robot
from minimax_cal.robots.sampling import random_joints

PLENTY = 60  # poses that show what no poses could tell
STILL = 1e-9  # relative motion of a column that moves nothing
WHOLE = 4  # targets of a board that stand for all
NO_BASE = "no pixel knows the base"


@dataclass(frozen=True)
class Told:
    """What was identified; by_drawing: whether nothing but the drawing tells the scale."""

    identification: Identification
    by_drawing: bool


def lengths_of(names: Names) -> Array:
    """(p,) True for the lengths of the links."""
    return np.asarray(np.arange(names.count) < 2 * names.joints)


def reference_of(robot: Robot, model: PixelModel) -> PixelModel:
    """Every target seen by every camera at plenty of random poses; of a board some targets."""
    q = random_joints(robot, (PLENTY,), np.random.default_rng(0))
    targets = np.unique(model.target)
    if len(model.board):
        chosen = np.linspace(0, len(targets) - 1, min(len(targets), WHOLE)).astype(int)
        spread = np.argsort(np.linalg.norm(model.board[targets] - model.board.mean(axis=0), axis=1))
        targets = targets[spread[chosen]]
    cameras = np.arange(len(model.intrinsic))
    grid = np.meshgrid(np.arange(PLENTY), cameras, targets, indexing="ij")
    pose, camera, target = (part.reshape(-1) for part in grid)
    none = np.zeros((len(pose), 2))
    return replace(
        model, q=robot.turned(q), pose=pose, camera=camera, target=target, pixel=none,
        weight=np.ones(len(pose)),
    )  # fmt: skip


def gram_of_bearings(model: PixelModel, x: Scene, active: Array) -> Array:
    """(p, p) Gram matrix of the directions to the targets, 0 but for the active parameters."""
    rows = model.bearings(x, active)
    flat = rows.reshape(len(rows), -1)
    gram = np.zeros((len(active),) * 2)
    gram[np.ix_(active, active)] = flat @ flat.T
    return gram


def gram_of_pixels(model: PixelModel, x: Scene, active: Array) -> Array:
    """(p, p) Gram matrix of the pixels, 0 but for the active parameters."""
    _, rows = model.rows(x, active)
    flat = (rows * np.sqrt(model.weight)).reshape(len(rows), -1)
    gram = np.zeros((len(active),) * 2)
    gram[np.ix_(active, active)] = flat @ flat.T
    return gram


def identified(
    robot: Robot,
    model: PixelModel,
    x: Scene,
    allowed: Array,
    wanted: Array,
    resolution: float,
) -> Told:
    """The largest set of allowed parameters that the pixels determine; see `fitting.identify`.

    x: the arm as drawn, with cameras and targets fitted to it.  allowed: (p,) False for what the
    user fixed, lenses that are held among it.  wanted: (p,) those to give up last.
    """
    names = model.names
    lens = np.arange(names.count) >= names.count - x.lens[0].size
    base = ~names.links & (np.arange(names.count) < names.geometric)
    plain = gram_of_bearings(reference_of(robot, model), x, ~lens & ~base)
    gram = gram_of_pixels(model, x, ~base)
    scale = np.sqrt(np.diag(gram) / max(len(model.pose), 1))
    kept = Kept(names, allowed & ~base, {}).without(base, Because.OTHER, NO_BASE)
    kept = kept.without(~allowed & names.links, Because.FIXED)
    kept = kept.without(~allowed & lens, Because.OTHER, "held as the camera's file says")
    size = np.sqrt(np.diag(plain))
    for motion, reason in ((size, "turns no direction"), (scale, "moves nothing at these poses")):
        part = kept.active & ~lens
        still = part & (motion <= STILL * motion[~lens].max())
        kept = kept.without(still, Because.OTHER, reason)
    order = np.concatenate([drop_order(robot, names), np.arange(names.geometric, names.count)])
    order = np.concatenate([order[~wanted[order]], order[wanted[order]]])
    keeper = [] if len(model.board) else scale_keeper(robot, kept.active & names.links, wanted)
    order = np.array(list(dict.fromkeys([*keeper, *(int(i) for i in order)])))
    gone = redundant(plain, kept.active & ~lens, order, RANK_TOLERANCE)
    by_drawing = set(keeper) & set(gone)  # nothing but the drawing tells the scale
    kept = kept.without([i for i in gone if i not in by_drawing], Because.SAME_MOTION)
    known = lens | (bool(by_drawing) & lengths_of(names))
    told = gram + np.diag(np.where(known, np.diag(gram), 0.0))
    kept = kept.without(redundant(told, kept.active, order, resolution), Because.NOT_TOLD)
    stems = {"board"} | {name.rpartition("_")[0] for name in names.all if "_" in name}
    found = kept.identification(told, scale, stems, "cameras and targets moved together")
    return Told(found, bool(by_drawing))
