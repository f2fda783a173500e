"""How a solver ended; the text says what to try."""

from __future__ import annotations

from enum import StrEnum


class Status(StrEnum):
    """How a solver ended, in the contract's words."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    STALLED = "stalled"
    INFEASIBLE = "infeasible"
    FAILED = "failed"
    CONTRADICTORY = "contradictory"
    NOT_DETERMINED = "not_determined"
    NO_BETTER = "no_better"

    @property
    def advice(self) -> str:
        """What to try next."""
        return STATUS_ADVICE[self]

    @property
    def keeps_drawn(self) -> bool:
        """Whether the result's arm is the drawn one, and the fitted one is given only on demand."""
        return self in (Status.CONTRADICTORY, Status.NOT_DETERMINED, Status.NO_BETTER)


STATUS_ADVICE = {
    Status.CONVERGED: "",
    Status.ITERATION_LIMIT: "the iteration limit was reached: the robot file may not describe this "
    "arm (check lengths, joint signs, units), or some parameters are weakly determined",
    Status.STALLED: "no step lowers the objective any more, yet the optimality test fails; try "
    "another QP backend, or (in a calibration) fix weakly determined parameters or give priors",
    Status.INFEASIBLE: "the constraints could not be met and may contradict each other; loosen "
    "them (in a calibration the distance tolerance)",
    Status.FAILED: "the numbers broke down, or the result contradicts its own data; check the "
    "robot file, units and joint signs, or try another QP backend",
    Status.CONTRADICTORY: "the files contradict each other; find what differs between them, or "
    "calibrate from one",
    Status.NOT_DETERMINED: "the measurements determine the arm less well than the drawing does; "
    "measure more, of more kinds, or fix parameters",
    Status.NO_BETTER: "the calibrated arm is no better than the drawn one on new poses; keep the "
    "drawn arm",
}
