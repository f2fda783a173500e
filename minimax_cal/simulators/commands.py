"""Commands for a simulated arm: what turns its joints and has no element goes into the command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minimax_cal.ground.arrays import Array
from minimax_cal.ground.errors import CalibrationError
from minimax_cal.ground.files import saved_content
from minimax_cal.measuring.measurements import Measurements
from minimax_cal.modelling.cell import Cell, cell_from_dict, still


@dataclass(frozen=True, eq=False)
class Commands:
    """A command map: call it with joint values to get what to command.

    cell: the arm with the effects that the map holds.
    """

    cell: Cell

    def __call__(self, q: Array) -> Array:
        """The commands for joint values q, (n,) or (m, n) [rad, m]."""
        rows = np.atleast_2d(np.asarray(q, dtype=float))
        told = still(rows, self.cell.target_names, self.cell.robot)
        return self.follow(told).reshape(np.shape(q))

    def follow(self, data: Measurements) -> Array:
        """(m, n) the same for measured poses, with the way that led to each [rad, m]."""
        turn = self.cell.effects.turn(self.cell.scene(data))
        return np.asarray(data.q + self.cell.robot.commanded(turn))


def load_commands(path: Path | str) -> Commands:
    """The command map that an export to mjcf wrote beside a file.

    Parameters
    ----------
    path
        Of the map.

    Returns
    -------
    Commands
        It takes and gives the controller's joint values [rad, m].

    Raises
    ------
    CalibrationError
        For wrong input.

    Examples
    --------
    >>> data.ctrl[:] = mc.load_commands("arm.commands.json")(q)
    """
    content = saved_content(path)
    if content.get("kind") != "commands" or "cell" not in content:
        raise CalibrationError(
            f"{path}: is no command map; an export to mjcf writes one where it is needed"
        )
    return Commands(cell_from_dict(content["cell"], str(path)))
