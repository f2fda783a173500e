"""Structure that bends under weight: links, the base, the tool's bracket."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.modelling.effects.scene import (
    PLAIN,
    Choice,
    Columns,
    Effect,
    Scene,
    joint_of,
    principal,
)
from minimax_cal.robots.gravity import G, centres
from minimax_cal.robots.kinematics import cross

SHORT = 0.1  # of the reach: shorter links are stiff
UNLIKE = 0.1  # share of the tool's motion that the links' must leave for it to be told apart


def turned_about(scene: Scene, turn: Array, centre: Array) -> Array:
    """(k, 3, m) motion of the targets for a small turn (3, m) [rad] about a point (3, m) [m]."""
    arm = scene.points - centre
    return np.asarray(cross(np.broadcast_to(turn, arm.shape), arm))


def long_links(scene: Scene) -> tuple[str, ...]:
    """Links long enough to bend, that carry something."""
    mdh = scene.robot.mdh
    length = np.hypot(mdh[:, 0], mdh[:, 1])
    mass, _ = scene.masses
    carry = [length[i] > SHORT * scene.robot.reach() and mass[i + 1 :].sum() > 0.0
             for i in range(scene.joints - 1)]  # fmt: skip
    return tuple(f"L{i + 1}" for i, bends in enumerate(carry) if bends)


def bent(scene: Scene, link: int, mass: Array, com: Array) -> Array:
    """(k, 3, m) motion of the targets per unit of 1/EI."""
    links = scene.links
    along = links.after[link] - links.before[link]
    length = np.linalg.norm(along, axis=0)
    along = along / length
    moment, weight = scene.load_beyond(link, mass, com)
    force = -G * scene.robot.up[:, None] * weight
    across = force - along * (along * force).sum(axis=0)
    turn = 0.5 * length**2 * cross(along, force) + length * moment
    sag = length**3 / 3.0 * across + 0.5 * length**2 * cross(moment, along)
    return np.asarray(sag + turned_about(scene, turn, links.after[link]))


Shift = Callable[[Scene, Array, Array], Array]  # (k, 3, m) per unit, of masses and their centres


def differing(shift: Shift) -> Callable[[Scene], Array]:
    """How the displacement that a law gives for the masses told may differ: asked for rarely."""

    def doubt(scene: Scene) -> Array:
        whole = shift(scene, *scene.masses)
        return principal(np.array([shift(scene, *other) - whole for other in scene.other_masses]))

    return doubt


def link_columns(scene: Scene, place: str, choice: Choice) -> Columns:
    """A cantilever with the weight F and moment M of what lies beyond at its end.

    theta = (L^2/2 l x F + L M) / EI,  delta = (L^3/3 F_across + L^2/2 M x l) / EI, l along it.
    """
    return under_weight(scene, choice, "1/EI", "1/(N m^2)", of_link(place))


def under_weight(scene: Scene, choice: Choice, name: str, unit: str, shift: Shift) -> Columns:
    """What gives way to all weights; besides to the kilograms of a tool that nobody told."""
    whole, doubt = shift(scene, *scene.masses), differing(shift)
    if not choice.get("tool"):
        return Columns((name,), (unit,), shift=whole[None], doubt={0: doubt})
    names, fields = (name, f"{name} (tool)"), np.stack([whole, of_tool(scene, shift)])
    return Columns(names, (unit,) * 2, shift=fields, doubt={0: doubt})


def of_tool(scene: Scene, shift: Shift) -> Array:
    """(k, 3, m) motion of the targets by one kilogram amid them."""
    nothing, one = np.zeros((2, scene.joints))
    one[-1], spot = 1.0, np.zeros((scene.joints, 3))
    spot[-1] = scene.target_positions.mean(axis=0)
    return shift(scene, one, spot) - shift(scene, nothing, spot)  # both with the payload


def tools(scene: Scene, shift: Shift) -> Sequence[Choice]:
    """Without the tool's weight, and with it where nobody told masses and it does not act alike."""
    if scene.known_masses:
        return PLAIN
    links, tool = shift(scene, *scene.masses), of_tool(scene, shift)
    rest = tool - links * (float((tool * links).sum()) / max(float((links**2).sum()), 1e-300))
    apart = float((rest**2).sum()) > UNLIKE**2 * float((tool**2).sum())
    return ({"tool": 0.0}, {"tool": 1.0}) if apart else PLAIN


def of_link(place: str) -> Shift:
    """What a link does."""
    link = joint_of(place)
    return lambda scene, mass, com: bent(scene, link, mass, com)


LINK_BENDING = Effect(
    "link_bending",
    "a link bends under the weight beyond it",
    "theta = (L^2/2 l x F + L M)/EI, delta = (L^3/3 F + L^2/2 M x l)/EI",
    long_links,
    link_columns,
    choices=lambda scene, place: tools(scene, of_link(place)),
    positive=True,
    follows="load",
)


def tilted(scene: Scene, mass: Array, com: Array) -> Array:
    """(k, 3, m) motion of the targets when the base turns by the overturning moment."""
    lever = (mass[:, None, None] * centres(scene.links, com)).sum(axis=0)
    lever = lever + scene.column("payload") * scene.payload_place
    moment = cross(lever, np.broadcast_to(-G * scene.robot.up[:, None], lever.shape))
    return turned_about(scene, moment, np.zeros((3, 1)))


def base_columns(scene: Scene, place: str, choice: Choice) -> Columns:
    """The base turns by C times the overturning moment."""
    return under_weight(scene, choice, "C", "rad/(N m)", tilted)


BASE_FLEX = Effect(
    "base_flex",
    "the base tilts under the arm's overturning moment",
    "omega = C M",
    lambda scene: ("frame",),
    base_columns,
    choices=lambda scene, place: tools(scene, tilted),
    positive=True,
    moves="foot",
    follows="load",
)


def tool_columns(scene: Scene, place: str, choice: Choice) -> Columns:
    """The bracket turns with its attitude to gravity, and is drawn out along its axis.

    lever 0: towards gravity about its foot, as a mass amid the targets pulls; 1: as one on the
    flange's axis; 2: any turn that is linear in gravity's direction.
    """
    axes, down = scene.links.axes, -scene.robot.up[:, None]
    attitude = (axes * down).sum(axis=1)  # gravity's direction in the flange
    if choice["lever"] == 2.0:
        turn = (axes[:, None] * attitude[None, :, None]).reshape(9, 3, -1)
        names = [f"turn {a}{b}" for a in "xyz" for b in "xyz"]
    else:
        spot = (
            scene.target_positions.mean(axis=0)
            if choice["lever"] == 0.0
            else np.array([0.0, 0.0, 1.0])
        )
        lever = np.einsum("a,acm->cm", spot / max(float(np.linalg.norm(spot)), 1e-3), axes)
        turn = cross(lever, np.broadcast_to(down, lever.shape))[None]
        names = ["turn"]
    rotated = [turned_about(scene, one, scene.links.origin) for one in turn]
    drawn = np.broadcast_to(axes[2] * attitude[2], scene.points.shape)
    units = ("rad",) * len(names) + ("m",)
    return Columns((*names, "axial"), units, shift=np.stack([*rotated, drawn]))


TOOL_FLEX = Effect(
    "tool_flex",
    "the bracket of the targets sags as its attitude to gravity changes",
    "omega = c s x g, delta = e z (z . g)",
    lambda scene: ("all",),
    tool_columns,
    choices=lambda scene, place: ({"lever": 0.0}, {"lever": 1.0}, {"lever": 2.0}),
    typical=5e-3,
    moves="tool",
    follows="attitude",
)
