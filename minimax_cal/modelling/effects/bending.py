"""Structure that bends under weight: links, the base, the tool's bracket."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.modelling.effects.scene import (
    DEFAULT_CHOICES,
    Choice,
    Effect,
    EffectColumns,
    PosedArm,
    joint_index_from_place,
    principal_variations,
)
from minimax_cal.robots.gravity_torques import STANDARD_GRAVITY, link_mass_centres_in_base
from minimax_cal.robots.kinematics import cross

MIN_BENDING_LINK_RATIO = 0.1  # of the reach: shorter links are stiff
MIN_SEPARABLE_TOOL_SHARE = (
    0.1  # share of the tool's motion that the links' must leave for it to be told apart
)


def displace_by_small_rotation(
    posed_arm: PosedArm, rotation_vectors: Array, centre: Array
) -> Array:
    """(k, 3, m) motion of the targets for a small turn (3, m) [rad] about a point (3, m) [m]."""
    arm = posed_arm.points - centre
    return np.asarray(cross(np.broadcast_to(rotation_vectors, arm.shape), arm))


def find_bendable_links(posed_arm: PosedArm) -> tuple[str, ...]:
    """Links long enough to bend, that carry something."""
    mdh = posed_arm.robot.mdh
    length = np.hypot(mdh[:, 0], mdh[:, 1])
    mass, _ = posed_arm.link_masses_and_centres
    carry = [
        length[i] > MIN_BENDING_LINK_RATIO * posed_arm.robot.reach() and mass[i + 1 :].sum() > 0.0
        for i in range(posed_arm.joints - 1)
    ]
    return tuple(f"L{i + 1}" for i, bends in enumerate(carry) if bends)


def link_bending_displacement(
    posed_arm: PosedArm, link: int, link_masses: Array, mass_centres: Array
) -> Array:
    """(k, 3, m) motion of the targets per unit of 1/EI."""
    links = posed_arm.links
    along = links.after[link] - links.before[link]
    length = np.linalg.norm(along, axis=0)
    along = along / length
    moment, weight = posed_arm.moment_and_mass_beyond_link(link, link_masses, mass_centres)
    force = -STANDARD_GRAVITY * posed_arm.robot.up[:, None] * weight
    across = force - along * (along * force).sum(axis=0)
    turn = 0.5 * length**2 * cross(along, force) + length * moment
    sag = length**3 / 3.0 * across + 0.5 * length**2 * cross(moment, along)
    return np.asarray(sag + displace_by_small_rotation(posed_arm, turn, links.after[link]))


DisplacementByMasses = Callable[
    [PosedArm, Array, Array], Array
]  # (k, 3, m) per unit, of masses and their centres


def build_mass_uncertainty_function(
    displacement_by_masses: DisplacementByMasses,
) -> Callable[[PosedArm], Array]:
    """How the displacement that a law gives for the masses told may differ: asked for rarely."""

    def doubt(scene: PosedArm) -> Array:
        whole = displacement_by_masses(scene, *scene.link_masses_and_centres)
        return principal_variations(
            np.array(
                [
                    displacement_by_masses(scene, *other) - whole
                    for other in scene.link_masses_and_centres_off_by_one_sigma
                ]
            )
        )

    return doubt


def link_bending_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """A cantilever with the weight F and moment M of what lies beyond at its end.

    theta = (L^2/2 l x F + L M) / EI,  delta = (L^3/3 F_across + L^2/2 M x l) / EI, l along it.
    """
    return bending_columns_under_weight(
        posed_arm, choice, "1/EI", "1/(N m^2)", build_link_displacement_function(place)
    )


def bending_columns_under_weight(
    posed_arm: PosedArm,
    choice: Choice,
    parameter_name: str,
    unit: str,
    displacement_by_masses: DisplacementByMasses,
) -> EffectColumns:
    """What gives way to all weights; besides to the kilograms of a tool that nobody told."""
    whole, doubt = (
        displacement_by_masses(posed_arm, *posed_arm.link_masses_and_centres),
        build_mass_uncertainty_function(displacement_by_masses),
    )
    if not choice.get("tool"):
        return EffectColumns((parameter_name,), (unit,), shift=whole[None], doubt={0: doubt})
    names, fields = (
        (parameter_name, f"{parameter_name} (tool)"),
        np.stack([whole, displacement_by_tool_kilogram(posed_arm, displacement_by_masses)]),
    )
    return EffectColumns(names, (unit,) * 2, shift=fields, doubt={0: doubt})


def displacement_by_tool_kilogram(
    posed_arm: PosedArm, displacement_by_masses: DisplacementByMasses
) -> Array:
    """(k, 3, m) motion of the targets by one kilogram amid them."""
    nothing, one = np.zeros((2, posed_arm.joints))
    one[-1], spot = 1.0, np.zeros((posed_arm.joints, 3))
    spot[-1] = posed_arm.target_positions.mean(axis=0)
    return displacement_by_masses(posed_arm, one, spot) - displacement_by_masses(
        posed_arm, nothing, spot
    )  # both with the payload


def tool_weight_choices(
    posed_arm: PosedArm, displacement_by_masses: DisplacementByMasses
) -> Sequence[Choice]:
    """Without the tool's weight, and with it where nobody told masses and it does not act alike."""
    if posed_arm.has_known_masses:
        return DEFAULT_CHOICES
    links, tool = (
        displacement_by_masses(posed_arm, *posed_arm.link_masses_and_centres),
        displacement_by_tool_kilogram(posed_arm, displacement_by_masses),
    )
    rest = tool - links * (float((tool * links).sum()) / max(float((links**2).sum()), 1e-300))
    apart = float((rest**2).sum()) > MIN_SEPARABLE_TOOL_SHARE**2 * float((tool**2).sum())
    return ({"tool": 0.0}, {"tool": 1.0}) if apart else DEFAULT_CHOICES


def build_link_displacement_function(place: str) -> DisplacementByMasses:
    """What a link does."""
    link = joint_index_from_place(place)
    return lambda scene, mass, com: link_bending_displacement(scene, link, mass, com)


LINK_BENDING = Effect(
    "link_bending",
    "a link bends under the weight beyond it",
    "theta = (L^2/2 l x F + L M)/EI, delta = (L^3/3 F + L^2/2 M x l)/EI",
    find_bendable_links,
    link_bending_columns,
    choices=lambda scene, place: tool_weight_choices(
        scene, build_link_displacement_function(place)
    ),
    positive=True,
    follows="load",
)


def base_tilt_displacement(posed_arm: PosedArm, link_masses: Array, mass_centres: Array) -> Array:
    """(k, 3, m) motion of the targets when the base turns by the overturning moment."""
    lever = (
        link_masses[:, None, None] * link_mass_centres_in_base(posed_arm.links, mass_centres)
    ).sum(axis=0)
    lever = lever + posed_arm.column("payload") * posed_arm.payload_centre_in_base
    moment = cross(
        lever, np.broadcast_to(-STANDARD_GRAVITY * posed_arm.robot.up[:, None], lever.shape)
    )
    return displace_by_small_rotation(posed_arm, moment, np.zeros((3, 1)))


def base_tilt_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The base turns by C times the overturning moment."""
    return bending_columns_under_weight(posed_arm, choice, "C", "rad/(N m)", base_tilt_displacement)


BASE_FLEX = Effect(
    "base_flex",
    "the base tilts under the arm's overturning moment",
    "omega = C M",
    lambda scene: ("frame",),
    base_tilt_columns,
    choices=lambda scene, place: tool_weight_choices(scene, base_tilt_displacement),
    positive=True,
    moves="foot",
    follows="load",
)


def tool_bracket_columns(posed_arm: PosedArm, place: str, choice: Choice) -> EffectColumns:
    """The bracket turns with its attitude to gravity, and is drawn out along its axis.

    lever 0: towards gravity about its foot, as a mass amid the targets pulls; 1: as one on the
    flange's axis; 2: any turn that is linear in gravity's direction.
    """
    axes, down = posed_arm.links.axes, -posed_arm.robot.up[:, None]
    attitude = (axes * down).sum(axis=1)  # gravity's direction in the flange
    if choice["lever"] == 2.0:
        turn = (axes[:, None] * attitude[None, :, None]).reshape(9, 3, -1)
        names = [f"turn {a}{b}" for a in "xyz" for b in "xyz"]
    else:
        spot = (
            posed_arm.target_positions.mean(axis=0)
            if choice["lever"] == 0.0
            else np.array([0.0, 0.0, 1.0])
        )
        lever = np.einsum("a,acm->cm", spot / max(float(np.linalg.norm(spot)), 1e-3), axes)
        turn = cross(lever, np.broadcast_to(down, lever.shape))[None]
        names = ["turn"]
    rotated = [displace_by_small_rotation(posed_arm, one, posed_arm.links.origin) for one in turn]
    drawn = np.broadcast_to(axes[2] * attitude[2], posed_arm.points.shape)
    units = ("rad",) * len(names) + ("m",)
    return EffectColumns((*names, "axial"), units, shift=np.stack([*rotated, drawn]))


TOOL_FLEX = Effect(
    "tool_flex",
    "the bracket of the targets sags as its attitude to gravity changes",
    "omega = c s x g, delta = e z (z . g)",
    lambda scene: ("all",),
    tool_bracket_columns,
    choices=lambda scene, place: ({"lever": 0.0}, {"lever": 1.0}, {"lever": 2.0}),
    typical=5e-3,
    moves="tool",
    follows="attitude",
)
