"""A clock for solvers that have none: they run in a process of their own, which can be ended."""

from __future__ import annotations

import math
import os
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    keywords = {"method": method, "tolerance": tolerance, "warm_start": warm_start}
    answer: Solution = call(module, "solve", problem, keywords, time_limit)
    return answer


def call(
    module: str, name: str, problem: Problem, keywords: dict[str, Any], time_limit: float
) -> Any:
    """What a function at the top of a module answers; a Solution without x where it gave none."""
    here = sys.modules.get(module)
    root = Path(here.__file__).parents[module.count(".")] if here and here.__file__ else ""
    paths = (str(Path(__file__).parents[1]), str(root), os.environ.get("PYTHONPATH", ""))
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", __name__],
            input=pickle.dumps((module, name, problem, keywords)),
            capture_output=True,
            timeout=time_limit if math.isfinite(time_limit) else None,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
            check=False,
        )
    except subprocess.TimeoutExpired:
        return nothing(problem, Status.TIME_LIMIT, f"stopped after {time_limit:.3g} s")
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        return nothing(problem, Status.FAILED, f"process ended with {done.returncode}", *last)
    return pickle.loads(done.stdout)


def main() -> None:
    """Solve the problem on stdin and write the solution to stdout."""
    module, name, problem, keywords = pickle.load(sys.stdin.buffer)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # whatever a solver prints must not mix with the answer
        answer = getattr(import_module(module), name)(problem, **keywords)
        out.write(pickle.dumps(answer))


if __name__ == "__main__":
    main()
