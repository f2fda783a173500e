"""Reflectors on the robot's foot: they say of themselves how base and instrument moved apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from minimax_cal.core.arrays import Array
from minimax_cal.core.linear_algebra import jackknife_variance
from minimax_cal.diagnosing.diagnosis import Finding
from minimax_cal.diagnosing.joint_fit import GeometryEffectFit
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.measuring.session_frames import frame_index_of_rows, transform_points
from minimax_cal.modelling.effects.effect_names import format_effect
from minimax_cal.modelling.effects.scene import PosedArm
from minimax_cal.modelling.effects.table import EFFECTS, Term
from minimax_cal.selection.thresholds import CONTRADICTION_SIGMAS

VISIT_BLOCK_COUNT = 10  # of the visits, left out in turn: what the law misses goes on for a while
MIN_REFLECTOR_POSES = 30  # poses at which a reflector was measured


def read_foot_reflectors(data: Measurements) -> Array:
    """(m, n, 3) the foot's reflectors as the first session saw them, NaN where not measured [m]."""
    names = [name[:-2] for name in data.columns if name.startswith("base") and name.endswith("_x")]
    every = [[f"{name}_{axis}" for axis in "xyz"] for name in names]
    whole = [
        np.stack([data.columns[name] for name in three], axis=-1)
        for three in every
        if all(name in data.columns for name in three)
    ]
    if not whole:
        return np.zeros((data.poses, 0, 3))
    points = np.stack(whole, axis=1)
    points = np.where(np.isfinite(points).all(axis=2, keepdims=True), points, np.nan)
    if data.frames:
        points = transform_points(
            points, np.stack(list(data.frames.values()))[frame_index_of_rows(data)]
        )
    return points[:, np.isfinite(points[..., 0]).sum(axis=0) >= MIN_REFLECTOR_POSES]


def fit_law_to_reflectors(reflector_points: Array, law_columns: Array, pose_mask: Array) -> Array:
    """(d,) parameters of a law from reflectors (n, 3, m) alone.  law_columns: (d, n, 3, m)."""
    gram, pull = np.zeros((len(law_columns), len(law_columns))), np.zeros(len(law_columns))
    for own, field in zip(reflector_points, np.moveaxis(law_columns, 1, 0), strict=True):
        known = pose_mask & np.isfinite(own[0])
        y = own[:, known] - own[:, known].mean(axis=1, keepdims=True)
        x = field[..., known] - field[..., known].mean(axis=2, keepdims=True)
        gram += np.einsum("acm,bcm->ab", x, x)
        pull += np.einsum("acm,cm->a", x, y)
    return np.asarray(np.linalg.lstsq(gram, pull, rcond=1e-9)[0])


def centre_motion_per_parameter(scene: PosedArm, term: Term) -> Array:
    """(3, d) motion of the reflectors' middle by each parameter, from first visit to last."""
    middle = np.nanmean(scene.points, axis=(0, 2))
    points = np.broadcast_to(middle[None, :, None], (1, 3, scene.poses))
    field = term.columns(replace(scene, points=points)).shift[:, 0]
    clock = scene.column("clock")
    return np.asarray((field[..., np.argmax(clock)] - field[..., np.argmin(clock)]).T)


def compare_laws_with_reflectors(
    fit: GeometryEffectFit, data: Measurements
) -> Iterator[tuple[Term, str, str]]:
    """Laws of a fit that move the foot, how far its reflectors say, and where they contradict."""
    points, scene = (
        read_foot_reflectors(fit.cell.align_to_first_session(data)),
        fit.cell.pose_arm(data),
    )
    if not points.shape[1]:
        return
    # The reflectors in the place of the targets, in base axes.
    points = np.moveaxis((points - scene.origin) @ scene.rotation, 0, 2)
    scene, clock = replace(scene, points=points), scene.column("clock")
    block = np.minimum(
        (np.argsort(np.argsort(clock)) * VISIT_BLOCK_COUNT) // len(clock), VISIT_BLOCK_COUNT - 1
    )
    at = fit.model.names.geometric_count
    for term in fit.terms:
        count = len(term.columns(fit.study.scene).names)
        own, at = slice(at, at + count), at + count
        if EFFECTS[term.effect].moves != "frame" or term.frees_session_frames:
            continue
        # The law fitted to the reflectors alone; its sigma by blocks of visits left out in turn.
        across = centre_motion_per_parameter(scene, term)
        columns = term.columns(replace(scene, points=np.nan_to_num(points))).shift
        told = across @ fit_law_to_reflectors(points, columns, block >= 0)
        parts = np.array(
            [fit_law_to_reflectors(points, columns, block != b) for b in range(VISIT_BLOCK_COUNT)]
        )
        told_sigma = np.sqrt(jackknife_variance(parts @ across.T))
        value = across @ fit.cell.effects.values[fit.terms.index(term)]
        spread = across @ np.nan_to_num(fit.uncertainty.covariance[own, own]) @ across.T
        own_sigma = np.sqrt(np.diag(spread))
        sigma = np.hypot(own_sigma, told_sigma)
        wrong = np.abs(value - told) > CONTRADICTION_SIGMAS * sigma
        shown = ", ".join(
            f"{axis} {1e6 * b:+.0f} +- {1e6 * s:.0f} um, by the fit "
            f"{1e6 * a:+.0f} +- {1e6 * u:.0f} um"
            for axis, a, u, b, s in zip("xyz", value, own_sigma, told, told_sigma, strict=True)
        )
        yield term, shown, ", ".join(np.array(list("xyz"))[wrong])


def describe_reflector_agreement(comparisons: Iterable[tuple[Term, str, str]]) -> Iterator[str]:
    """Whether the reflectors on the foot confirm laws.  comparisons: as of
    `compare_laws_with_reflectors`.
    """
    for term, shown, odd in comparisons:
        verdict = f"they contradict it in {odd}" if odd else "they agree with it"
        yield f"{format_effect(*term.key)}: the reflectors on the foot moved by {shown}: {verdict}"


def mark_contradicted_findings(
    findings: Iterable[Finding], comparisons: Iterable[tuple[Term, str, str]]
) -> Iterator[Finding]:
    """The findings, with what the reflectors on the foot contradict."""
    odd = {term.key: f"in {axes} by the foot" for term, _, axes in comparisons if axes}
    for found in findings:
        yield replace(found, contradicted=odd.get(found.term.key, ""))
