"""Stages with count and time left; a line now and then without a terminal; files by ending."""

import json

from conftest import run

import minimax_cal as mc
from minimax_cal.cli import progress
from minimax_cal.cli.progress import Stages, Ticker, stages
from minimax_cal.ground.stages import Stage, clock, count_stage


class Hands:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.at = 100.0

    def __call__(self) -> float:
        return self.at


def test_time_left_is_that_of_the_steps_so_far():
    now = Hands()
    told = Stages(now)

    def replicate(part: int) -> Stage:
        return count_stage("replicate", part, 10)

    assert told.line("geometry") == "geometry, 0 s"
    now.at += 60.0
    assert told.line(replicate(1)) == "replicate 1 of 10, 1 min 0 s"
    now.at += 4.0  # two steps took four seconds, eight are left
    assert told.line(replicate(3)) == "replicate 3 of 10, 1 min 4 s, about 16 s left"
    now.at += 10.0
    first = count_stage("part", 1, 3, " left out: joint 2")
    assert told.line(first) == "part 1 of 3 left out: joint 2, 1 min 14 s"
    assert told.line("step 3 of 9") == "step 3 of 9, 1 min 14 s"  # words are never read back
    assert clock(125.4) == "2 min 5 s"


def test_a_line_every_ten_seconds_from_the_first_second(monkeypatch, capsys):
    now, waits = Hands(), list[float]()
    ticker = Ticker(Stages(now))

    def wait(seconds: float) -> bool:
        """As an event that is set after three lines; stages begin meanwhile."""
        waits.append(seconds)
        now.at += seconds
        if len(waits) == 2:
            ticker.show(count_stage("part", 3, 18))
        return len(waits) > 3

    monkeypatch.setattr(progress, "FIRST", 1.0)  # as it is but for tests
    ticker.show("geometry")
    monkeypatch.setattr(ticker.over, "wait", wait)
    ticker.run()
    assert waits == [progress.FIRST, 10.0, 10.0, 10.0]
    assert capsys.readouterr().err.splitlines() == [
        "progress: geometry, 1 s",
        "progress: part 3 of 18, 11 s",
        "progress: part 3 of 18, 21 s, about 1 min 20 s left",
    ]
    with stages(quiet=True) as show:
        show("start")
    with stages(quiet=False) as show:  # over before the first second
        show("start")
    assert capsys.readouterr().err == ""


def test_files_by_their_ending(tmp_path, capsys):
    mc.write_measurements(tmp_path / "poses.csv", mc.simulate("irb120", 30, 2, seed=1).data)
    command = ("calibrate", "irb120", tmp_path / "poses.csv", "--objective", "sum")
    assert run(*command, "-o", tmp_path / "errors.svg") == 0
    assert f"written: {tmp_path / 'errors.svg'}" in capsys.readouterr().err
    assert b"<svg" in (tmp_path / "errors.svg").read_bytes()
    assert run(*command, "-o", tmp_path / "fit.json", "-q") == 0
    assert "written" not in capsys.readouterr().err
    for name, start in (("map.json", "{"), ("map.svg", "<?xml")):
        assert run("map", tmp_path / "fit.json", "--bins", 4, "-o", tmp_path / name) == 0
        assert (tmp_path / name).read_text().startswith(start)
    assert json.loads((tmp_path / "map.json").read_text())
    capsys.readouterr()
    assert run("evaluate", tmp_path / "fit.json", tmp_path / "poses.csv", "-o",
               tmp_path / "a.png") == 2  # fmt: skip
    assert "this command draws no picture; write a .json" in capsys.readouterr().err
    assert run(*command, "-o", tmp_path / "fit.csv") == 2
    assert "this command writes no CSV; write a .json" in capsys.readouterr().err
    assert run("simulate", "ur10", "-o", tmp_path / "poses.json") == 2
    assert "the measurements are a CSV" in capsys.readouterr().err
    assert run("import", tmp_path / "poses.csv", "-o", tmp_path / "said.json") == 0
    assert json.loads((tmp_path / "said.json").read_text())["poses"] == 30
    plan = ("plan", "irb120", "--poses", 6, "--candidates", 30, "-q", "-o")
    for name, start in (("plan.json", "{"), ("plan.csv", "order,pose,q1_deg")):
        assert run(*plan, tmp_path / name) == 0
        assert (tmp_path / name).read_text().startswith(start)


def test_help_lists_options_in_parts(capsys):
    assert run("calibrate", "--help") == 0
    out = capsys.readouterr().out
    titles = ("What is fitted:", "How it is solved:", "What is held out:",
              "Outliers:", "Measurements and result:")  # fmt: skip
    places = [out.index(title) for title in titles]
    assert places == sorted(places)
    assert out.index("--cv") > out.index("What is held out:")


def test_events_are_lines_of_json(tmp_path, capsys):
    """Every line of stderr is one, in whatever order options stand; the next command is silent."""
    mc.write_measurements(tmp_path / "poses.csv", mc.simulate("irb120", 30, 2, seed=1).data)
    command = ("calibrate", "irb120", tmp_path / "poses.csv", "--objective", "sum", "-o",
               tmp_path / "fit.json", "--bootstrap", 20)  # fmt: skip
    assert run(*command, "--progress", "json") == 0
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    by_kind = {event["event"]: event for event in events}
    assert {"progress", "written"} <= set(by_kind)
    assert by_kind["written"]["text"] == str(tmp_path / "fit.json")
    counted = [event for event in events if "parts" in event]
    assert counted[0]["text"] == "replicate 1 of 20"
    assert (counted[0]["part"], counted[0]["parts"]) == (1, 20)
    for wrong in (("--objective", "best"), ("--holdout", "-1")):
        assert run("calibrate", "irb120", tmp_path / "poses.csv", *wrong, "--progress", "json") == 2
        (event,) = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
        assert (event["event"], event["exit_code"]) == ("error", 2)
        assert not event["text"].startswith("error")
    assert run("calibrate", "irb120", tmp_path / "none.csv") == 2
    assert capsys.readouterr().err.startswith("error: ")
