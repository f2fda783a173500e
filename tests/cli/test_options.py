"""Options made from fields: what is shown is the default, and what is given arrives in SI."""

from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

from minimax_cal.cli.options import options_from, options_of
from minimax_cal.correcting.compensate import compensate
from minimax_cal.fitting.options import Options
from minimax_cal.fitting.several import RelativeOptions
from minimax_cal.ground.options import Option
from minimax_cal.judging.maps import Grid
from minimax_cal.modelling.simulate import Truth
from minimax_cal.planning.options import PlanOptions


def given(options: Any, *arguments: object) -> dict[str, Any]:
    """What a command with these options gets."""
    got: dict[str, Any] = {}

    @click.command()
    @options
    def command(**chosen: Any) -> None:
        got.update(chosen)

    CliRunner().invoke(command, list(map(str, arguments)), catch_exceptions=False)
    return got


@pytest.mark.parametrize("kind", [Options, RelativeOptions, PlanOptions, Truth, Grid])
def test_defaults_are_those_of_the_fields(kind):
    defaults = vars(kind())
    found = given(options_from(kind))
    assert found
    for name, value in found.items():
        if name != "joints":  # texts until the robot is known
            expected = defaults[name]
            number = isinstance(expected, float) or name in ("reach", "elevation")
            assert value == (
                pytest.approx(expected, rel=1e-12, nan_ok=True) if number else expected
            )


def test_units_arrive_in_si():
    found = given(
        options_from(PlanOptions),
        *("--acceptance", 90, "--noise", 20, "--body", 80, "--range", "1:20"),
        *("--elevation", "-90:45", "--tracker", "3000,0,500", "--target", "1,2,3"),
    )
    assert found["acceptance"] == pytest.approx(np.pi / 2.0)
    assert found["noise"] == pytest.approx(20e-6)
    assert found["body"] == pytest.approx(0.08)
    assert found["reach"] == (1.0, 20.0)
    assert found["elevation"] == pytest.approx((-np.pi / 2.0, np.pi / 4.0))
    assert found["tracker"] == (3.0, 0.0, 0.5)
    assert found["spots"] == (pytest.approx((0.001, 0.002, 0.003)),)


def test_some_fields_and_arguments_of_a_function():
    assert set(given(options_from(Options, "seed", "qp"))) == {"seed", "qp"}
    told = options_of(compensate, most_change=Option(unit="deg", flag="--max-change"))
    assert given(told) == {"most_change": pytest.approx(np.pi / 36.0)}
    assert given(told, "--max-change", 90) == {"most_change": pytest.approx(np.pi / 2.0)}
    several = given(options_from(Options), "--fix", "a1, d2", "--fix", "beta*", "--prior", "a*=1mm")
    assert several["fix"] == ("a1", "d2", "beta*")
    assert several["priors"] == {"a*": 1e-3}
