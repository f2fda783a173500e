"""The public names: whole, quick to import, never shadowed, and each function explains itself."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import click
import pytest
from numpy.testing import assert_allclose

import minimax_cal as mc
from minimax_cal.cli.command_group import COMMAND_MODULES, read_first_help_sentence
from minimax_cal.cli.command_runner import cli
from minimax_cal.fitting.multi_instrument.options import RelativeOptions
from minimax_cal.planning.plan_options import PlanOptions

FUNCTIONS = [name for name in mc.__all__ if inspect.isfunction(getattr(mc, name))]


def after(code: str, *modules: str) -> dict[str, bool]:
    """Which modules a fresh interpreter has imported once it ran some code."""
    told = f"\nimport sys\nprint([name in sys.modules for name in {modules!r}])"
    made = subprocess.run(
        [sys.executable, "-c", code + told], capture_output=True, text=True, check=True
    )
    line = made.stdout.splitlines()[-1]
    return dict(zip(modules, (word == "True" for word in re.findall(r"\w+", line)), strict=True))


# ---- the package -------------------------------------------------------------------------------


def test_every_name_is_there():
    assert set(mc.MODULES) == set(mc.__all__)
    assert set(dir(mc)) == {*mc.__all__, "__version__"}
    for name in mc.__all__:
        assert getattr(mc, name) is not None
    assert mc.__version__ == version("minimax-cal")
    with pytest.raises(AttributeError, match="'calibrat'"):
        mc.calibrat  # type: ignore[attr-defined] # noqa: B018


def test_type_checkers_see_the_same_names():
    """The imports under TYPE_CHECKING are those of the table."""
    text = Path(mc.__file__).read_text()
    block = text.partition("if TYPE_CHECKING:")[2].partition("\n__all__")[0]
    found = {}
    for module, names in re.findall(r"from minimax_cal\.([\w.]+) import (\([^)]*\)|.*)", block):
        for name in re.findall(r"\w+", names):
            found[name] = f"{module}.{name}" if name == "datasets" else module
    assert found == mc.MODULES


def test_a_calibration_imports_no_statistics_and_no_pictures():
    """And what is put off is there when it is asked for."""
    heavy = ("scipy.stats", "pandas", "matplotlib", "cvxpy", "plotly", "jinja2", "numba")
    unused = (
        *heavy,
        "numpy.f2py.crackfortran",
        "unittest",
        "yaml",
        "minimax_cal.robots.urdf_robot",
        "minimax_cal.selection.forward_selection",
        "minimax_cal.validation.bootstrap",
    )
    code = (
        "from minimax_cal.cli.command_group import import_quickly\n"
        "import_quickly('minimax_cal.cli.calibrate')"
    )
    late = f"\nimport sys\nfound = [name for name in {unused} if name in sys.modules]"
    late += "\nfrom numpy import testing\ntesting.assert_allclose(1.0, 1.0)\nassert found == []"
    assert after(code + late, "minimax_cal.fitting.calibrate")["minimax_cal.fitting.calibrate"]
    heavy += ("scipy.signal", "scipy.ndimage", "numba", "minimax_cal.fitting.fit")
    assert not any(after("from minimax_cal.cli.torques import torques_command", *heavy).values())


def test_importing_is_quick_work():
    code = "import minimax_cal"
    assert not any(after(code, "numpy", "scipy", "pydantic", "click").values())
    assert after("import minimax_cal\nminimax_cal.Robot", "numpy")["numpy"]


def test_no_module_shadows_a_public_name():
    pytest.importorskip("mujoco", reason="a module is one that MuJoCo's users import")
    for found in pkgutil.walk_packages(mc.__path__, "minimax_cal."):
        importlib.import_module(found.name)
    modules = {name for name in mc.__all__ if inspect.ismodule(getattr(mc, name))}
    assert modules == {"datasets"}
    assert {"calibrate", "diagnose", "export", "iso9283", "plan", "report"} <= set(FUNCTIONS)
    code = (
        "import minimax_cal.validation.iso9283, minimax_cal.reporting.report_file"
        "\nimport minimax_cal.cli.plan, minimax_cal as mc, inspect"
        "\nassert all(map(inspect.isfunction, (mc.iso9283, mc.plan, mc.report, mc.simulate)))"
    )
    assert after(code, "numpy")["numpy"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_help_explains_the_arguments_and_shows_an_example(name):
    function = getattr(mc, name)
    text = inspect.getdoc(function) or ""
    assert re.search(rf"^>>> .*\bmc\.{name}\(", text, re.M)
    told = text.partition(">>>")[0]
    assert "Parameters\n----------\n" in told
    assert "Examples\n--------\n" in told
    for argument in inspect.signature(function).parameters:
        if argument not in ("fun", "x0", "jac"):
            assert re.search(rf"\b{argument}\b", told), f"{name}: {argument}"


@pytest.mark.parametrize(
    ("function", "given"),
    [
        (mc.plan, ("irb2600", 10)),
        (mc.relative, ("irb2600", "wires.csv")),
        (mc.calibrate, ("irb2600", "poses.csv")),
        (mc.diagnose, ("irb2600", "poses.csv")),
        (mc.simulate, ("irb2600",)),
        (mc.export, ("irb2600", "urdf")),
        (mc.report, ("fit.json",)),
        (mc.iso9283, ("fit.json",)),
    ],
)
def test_a_typo_is_told_by_its_name(function, given):
    with pytest.raises(TypeError, match="holdot"):
        function(*given, holdot=0.1)


@pytest.mark.parametrize(
    ("function", "options"), [(mc.plan, PlanOptions), (mc.relative, RelativeOptions)]
)
def test_keywords_are_those_of_the_options(function, options):
    said = inspect.signature(function).parameters
    for name, default in vars(options()).items():
        assert said[name].default == (default if default != {} else None), name


# ---- functions beside the commands -------------------------------------------------------------


def test_simulate_takes_a_name(robot):
    one, other = (mc.simulate(arm, 5, seed=3).data for arm in (robot, "irb2600"))
    assert (one.y == other.y).all()


def test_export_takes_what_there_is(fit, tmp_path):
    fit.save(tmp_path / "fit.json")
    saved = mc.export(tmp_path / "fit.json", "json", tmp_path / "arm.json")
    assert (tmp_path / "arm.json").read_text() == saved
    assert mc.export(fit, "json") == mc.export(fit.cell, "json") == mc.export(fit.robot, "json")
    assert_allclose(mc.load_robot(tmp_path / "arm.json").mdh, fit.robot.mdh, rtol=0, atol=1e-12)
    said: list[str] = []
    assert mc.export(fit, "moc", experimental=True, notify=said.append)
    assert said
    with pytest.warns(UserWarning, match="placeholders"):
        assert mc.export("irb2600", to="urdf").startswith("<?xml")
    with pytest.raises(mc.OptionError, match="no such format"):
        mc.export(fit, "step")


def test_iso9283_of_a_fit_is_that_of_its_file(fit, tmp_path):
    path = tmp_path / "fit.json"
    fit.save(path)
    one, other = (mc.iso9283(given, tcp="smr1").parts for given in (fit, path))
    for key, part in one.items():
        for name, values in part.values.items():
            found = other[key].values[name]
            assert_allclose(found.position, values.position, rtol=0, atol=1e-9)  # the file's digits
    with pytest.raises(mc.DataError, match="cannot be read"):
        mc.iso9283(fit, "poses.csv")


def test_report_of_a_fit_is_that_of_its_file(fit, tmp_path):
    pytest.importorskip("plotly", reason="a report needs pip install minimax-cal[report]")
    path = tmp_path / "fit.json"
    fit.save(path)
    pages = [
        mc.report(given, tmp_path / name, date="2026-01-31").read_text()
        for given, name in ((fit, "a.html"), (path, "b.html"))
    ]
    assert pages[0].replace("calibration, not saved", path.name) == pages[1]
    assert str(tmp_path) not in pages[1]  # no folder of a machine


# ---- the command line --------------------------------------------------------------------------


def test_version_and_help_import_no_command():
    heavy = ("numpy", "scipy", "pydantic", "rich", "minimax_cal.cli.calibrate")
    for option in ("--version", "--help"):
        code = (
            "from minimax_cal.cli import main\n"
            f"try:\n    main([{option!r}])\nexcept SystemExit as ended:\n    assert not ended.code"
        )
        assert not any(after(code, *heavy).values()), option


def test_no_command_waits_for_what_its_help_does_not_need():
    heavy = ("scipy.stats", "scipy.optimize", "scipy.interpolate", "scipy.signal", "scipy.ndimage")
    heavy += ("cvxpy", "qpsolvers", "numba", "matplotlib", "plotly", "jinja2", "mujoco", "pandas")
    code = (
        "import minimax_cal.cli.command_runner as r\nfor name "
        "in r.COMMAND_MODULES:\n    r.cli.commands[name]"
    )
    imported = after(code, *heavy, "minimax_cal.cli.diagnose")
    assert [name for name, here in imported.items() if here] == ["minimax_cal.cli.diagnose"]


def test_the_list_says_what_the_commands_say():
    context = click.Context(cli)
    assert cli.list_commands(context) == list(cli.commands) == list(COMMAND_MODULES)
    for name in COMMAND_MODULES:
        command = cli.get_command(context, name)
        assert command is not None
        assert command.name == name
        first = " ".join((command.help or "").partition("\n\n")[0].split())
        assert first == read_first_help_sentence(name) != ""
    assert cli.get_command(context, "callibrate") is None
