"""A clock for solvers that have none: they run in a process of their own, which can be ended."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from .problem import Status, nothing

if TYPE_CHECKING:
    from .problem import Problem, Solution


def run(
    module: str,
    problem: Problem,
    method: str,
    tolerance: float,
    time_limit: float,
    warm_start: Solution,
) -> Solution:
    """The answer of a module's `solve` if it comes in time, TIME_LIMIT without x if not.

    Starting the process takes half a second, so this is for problems on which a solver may spend
    more than the limit.
    """
    paths = (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", ""))
    task = pickle.dumps((module, problem, method, tolerance, warm_start))
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", __name__],
            input=task,
            capture_output=True,
            timeout=time_limit,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
            check=False,
        )
    except subprocess.TimeoutExpired:
        return nothing(problem, Status.TIME_LIMIT, f"stopped after {time_limit:.3g} s")
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        return nothing(problem, Status.FAILED, f"process ended with {done.returncode}", *last)
    answer: Solution = pickle.loads(done.stdout)
    return answer


def main() -> None:
    """Solve the problem on stdin and write the solution to stdout."""
    module, problem, method, tolerance, warm_start = pickle.load(sys.stdin.buffer)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # whatever a solver prints must not mix with the answer
        solve = import_module(module).solve
        answer = solve(problem, method=method, tolerance=tolerance, warm_start=warm_start)
        out.write(pickle.dumps(answer))


if __name__ == "__main__":
    main()
