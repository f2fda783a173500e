from __future__ import annotations

from importlib import metadata, util

import numpy as np
import pytest

from qp_backends import BackendError, Problem, available, names, registry
from qp_backends.registry import DENSE_ORDER, SPARSE_ORDER, backend, fallback_order

ONE = Problem([[1.0]], [-3.0], [[1.0]], [-np.inf], [1.0])


def test_available_backends_have_the_versions_of_their_packages():
    versions = available()
    assert versions["daqp"] == metadata.version("daqp")
    assert versions["proxqp"] == metadata.version("proxsuite")
    assert versions["subgradient"] == "own"
    assert set(versions) <= set(names())


def test_a_missing_package_is_an_error_that_says_what_to_install(monkeypatch):
    find = util.find_spec
    monkeypatch.setattr(util, "find_spec", lambda name: None if name == "piqp" else find(name))
    registry._imported.cache_clear()
    with pytest.raises(BackendError, match=r"pip install minimax-cal\[piqp\]"):
        backend("piqp")
    assert "piqp" not in available()
    assert "piqp" not in fallback_order(ONE)
    monkeypatch.undo()
    assert "piqp" in fallback_order(ONE)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dapq", "did you mean 'daqp'"),
        ("nothing like it", "choose one of daqp, quadprog"),
        ("daqp:fast", "no QP backend 'daqp:fast'"),
        ("cvxpy:nothing", "cvxpy has no QP solver 'nothing'"),
        ("subgradient:nothing", "choose one of restarted, raw, eliminated"),
    ],
)
def test_a_wrong_name_is_an_error_that_says_what_there_is(name, message):
    with pytest.raises(BackendError, match=message):
        backend(name)


def test_the_fallback_order_depends_on_how_the_problem_is_stored():
    from scipy import sparse

    thin = Problem(sparse.eye_array(1), [-3.0], [[1.0]], [-np.inf], [1.0])
    installed = set(available())
    assert fallback_order(ONE) == tuple(name for name in DENSE_ORDER if name in installed)
    assert fallback_order(thin) == tuple(name for name in SPARSE_ORDER if name in installed)
    assert sorted(DENSE_ORDER) == sorted(SPARSE_ORDER)


def test_a_registered_solver_gets_the_keywords_that_it_takes(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    seen = {}

    def all_of_them(problem, **keywords):
        seen.update(keywords)
        return np.ones(1), np.full(1, 2.0)

    registry.register("all", all_of_them)
    registry.register("none", lambda problem: (np.ones(1), np.full(1, 2.0)))
    given = {"tolerance": 1e-5, "time_limit": 3.0, "warm_start": None}
    assert backend("all")(ONE, **given).x == 1.0
    assert seen == given
    assert backend("none")(ONE, **given).y == 2.0
    assert available()["all"] == "registered"
    assert "none" in names()
