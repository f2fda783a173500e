"""Imports point down: a module imports only lower layers (those of one folder may share one)."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = (
    "errors kinematics solvers.status tables",
    "files frames gravity designs.criteria plans.observability plans.tour intervals"
    " importers.sheet solvers.least_squares solvers.minimax faults.chance faults.fault"
    " where.gaps where.rows",
    "options csv_columns urdf_file designs.exchange solvers.cones",
    "urdf designs.relaxation",
    "metrics robot data designs.search importers.reading where.answer where.cuts where.residual",
    "parameters gates history plans.wishes visibility relative.data relative.closing"
    " importers.rapid importers.leica importers.robodk importers.tracker6d importers.contract"
    " importers.figaroh importers.joint_rows importers.smr_files importers.columns"
    " importers.join importers.times importers.units faults.distances where.chance"
    " where.features where.spread",
    "effects.scene poses relative.file plans.candidates relative.split importers.assemble"
    " faults.declared faults.joints faults.nests faults.sessions faults.surprise faults.swaps"
    " where.joints where.mean_squares where.trends",
    "effects.compliance effects.bending effects.gears effects.time faults.outliers where.curves"
    " where.locate",
    "effects.table datasets import_command faults.find where",
    "model cell faults",
    "identify start relative.rows plans.stops worst extend noise suspects exporters.job",
    "trimmed plans.prospect",
    "robust",
    "sense uncertainty relative.identify relative.options relative.start iso9283.formulas saved"
    " curves point_cones",
    "calibration iso9283.visits simulate minimize mixups spectrum structure exporters.correct"
    " exporters.dh_csv exporters.moc exporters.robot_json exporters.ros_yaml exporters.ur_yaml",
    "evidence compensate exporters.urdf plans.promise iso9283.result relative.fit"
    " relative.poses relative.result",
    "calibrate iso9283 figures plans.result diagnosis rivals compensate_command exporters.table",
    "words pictures relative.remarks plan_picture plans.ground sheets separate export_command"
    " tradeoff bootstrap maps iso9283_command",
    "tradeoff_command relative.kinds map_picture plans.separating",
    "map_command relative report.schema plans.task report.content report.projection report.pdf",
    "relative_command report.sources report.charts plans.outlook",
    "report.error_charts report.fit_tables report.gap_tables planning report.verdict report.page",
    "report.more_charts report.scene plan_command",
    "report.fit_sections report.gap_sections",
    "report.document",
    "report",
    "report_command",
    "diagnose calibrate_command simulate_command",
    "diagnose_command",
    "cli",
)
LAYER = {name: number for number, names in enumerate(LAYERS) for name in names.split()}


def imported(path: Path) -> set[str]:
    """Modules of the project that a file imports, dotted."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
    return found


MODULES = sorted(p for p in (ROOT / "minimax_cal").rglob("*.py") if p.name != "__init__.py")


@pytest.mark.parametrize("path", MODULES, ids=lambda p: p.stem)
def test_imports_point_down(path: Path) -> None:
    name = ".".join(path.relative_to(ROOT / "minimax_cal").with_suffix("").parts)
    assert name in LAYER, f"give {name} a layer"
    for module in imported(path):
        inner = module.removeprefix("minimax_cal.")
        if module != inner and inner in LAYER:
            assert LAYER[inner] < LAYER[name], f"{name} imports {inner}"
        assert not module.startswith(("experiments", "tests"))


@pytest.mark.parametrize("path", sorted((ROOT / "qp_backends").glob("*.py")), ids=lambda p: p.stem)
def test_qp_backends_knows_no_robot(path: Path) -> None:
    assert not any(module.startswith(("minimax_cal", "experiments")) for module in imported(path))
