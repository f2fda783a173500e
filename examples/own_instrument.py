"""An instrument of one's own beside a tracker: python examples/own_instrument.py."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import minimax_cal as mc
from minimax_cal.core.arrays import Array
from minimax_cal.instruments.instrument import SPOT, Instrument, Words, bare, spots_aside
from minimax_cal.instruments.protocol import FlangePoses, ResidualRows
from minimax_cal.instruments.wires import trilaterated
from minimax_cal.modelling.simulate import Truth, simulate


@mc.register_instrument
@dataclass(frozen=True, eq=False)
class DrawWire(Instrument):
    """A draw-wire encoder, which counts from a zero of its own.

    length: (m,) that it shows [m].
    """

    length: Array

    kind = "draw_wire"
    unit = "m"
    words = Words(quantity="length of the draw wire")
    by_row = ("length",)
    names = (*SPOT, "anchor_x", "anchor_y", "anchor_z", "zero")

    def starts(self, arm: FlangePoses, free: Array) -> Sequence[Array]:
        """Places of the target, and for each the anchor and zero by trilateration."""
        spots, shown = spots_aside(arm, np.zeros(3)), self.length[:, None]
        return [np.append(spot, trilaterated(arm.place(spot), shown, True)) for spot in spots]

    def read(self, arm: FlangePoses, own: Array) -> ResidualRows:
        """What it shows minus |target - anchor| + zero."""
        target, anchor, zero = own[:3], own[3:6], own[6]
        point = arm.place(target)
        distance = np.linalg.norm(point - anchor, axis=1)
        along = (point - anchor) / distance[:, None]
        by_target = np.einsum("ri,rij->rj", along, arm.rotation)
        return ResidualRows(
            residual=self.length - distance - zero,
            pose=np.arange(self.poses),
            point=point,
            by_point=along,
            by_rotation=np.zeros_like(along),
            by_own=np.column_stack([by_target, -along, np.ones(self.poses)]),
        )


def main() -> None:
    """Measure a simulated arm by a tracker and such a wire, and find the wire's zero."""
    robot = mc.load_robot("irb2600")
    made = simulate(robot, poses=90, seed=3, truth=Truth(compliance=0.0))
    q, target = made.data.q, np.array([0.08, 0.02, 0.11])
    pose = made.cell.robot.pose(q)
    place = pose[:, :3, :3] @ target + pose[:, :3, 3]
    anchor, zero, noise = np.array([2.0, 1.0, 0.3]), 0.0375, 50e-6
    shown = np.linalg.norm(place - anchor, axis=1) + zero
    shown += np.random.default_rng(0).normal(scale=noise, size=len(q))

    fit = mc.relative(robot, [made.data.take(np.arange(30)), DrawWire(bare(q, {}), shown)])
    found = next(p for p in fit.parameters if p.name == "draw_wire.zero")
    print(f"zero {1e3 * found.value:.2f} +- {1e3 * found.sigma:.2f} mm, truly {1e3 * zero:.2f}")
    print(fit.files_table().text(100))


if __name__ == "__main__":
    main()
