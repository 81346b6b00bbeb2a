"""The paper's experiments in small: through the real steps to numbers, tables, plots; resumed when interrupted."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from endo3d.services.cli.app import app
from endo3d.services.evaluation import cylinder, report, spheres
from endo3d.services.evaluation.cache import Cache
from endo3d.services.evaluation.calibrated import calibrated
from endo3d.services.evaluation.measure import Settings
from endo3d.services.evaluation.virtual_run import head_yaml
from endo3d_core.calibration import Rig


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evaluation")


@pytest.mark.slow
def test_spheres_in_small(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Size, form and distance come out at the paper's scale, and fibres are named as a source of error."""
    measured = spheres.evaluate(Settings(folder, quick=True))
    values = [r for r in measured.figures["places"].values() if r is not None]
    assert len(values) == 3
    assert all(abs(r["size_um"]) < 16.0 and 0.05 < r["form_um"] < 8.0 for r in values)
    assert all(abs(v) < 2.0 for v in measured.figures["distance_error_percent"])
    shares = {row[0]: float(row[2]) for row in measured.tables[1].rows}
    assert shares["without fibres"] < shares["all effects"]
    # What is measured once is not measured again.
    monkeypatch.setattr(spheres, "_measure", lambda *_: pytest.fail("measured twice"))
    assert spheres.evaluate(Settings(folder, quick=True)).figures == measured.figures


@pytest.mark.slow
def test_cylinder_in_small(folder: Path) -> None:
    """Standing, both modes measure; at 2 mm/s only the continuous one does."""
    results = cylinder.evaluate(Settings(folder, quick=True)).figures["results"]
    for name in ("conventional 0", "continuous 0", "continuous 2"):
        assert results[name][0] is not None
        assert abs(results[name][0]["size_um"]) < 60.0
    assert results["conventional 2"] == [None]


@pytest.mark.slow
def test_handheld_in_small_on_the_command_line(folder: Path) -> None:
    ran = CliRunner().invoke(app, ["evaluate", "handheld", "--quick", "-o", str(folder), "--threads", "1"])
    assert ran.exit_code == 0, ran.output
    assert "simulated" in ran.output
    kept = json.loads((folder / "handheld-quick.json").read_text())
    assert kept["simulated"] is True
    features = kept["figures"]["scan"]["features"]
    assert abs(features["step, small"]["value"] - 500.4) < 30.0
    assert abs(features["angle"]["value"] - 89.96) < 2.0
    page = (folder / "handheld-quick.html").read_text()
    assert "simulated" in page
    assert (folder / "handheld-quick.png").read_bytes().startswith(b"\x89PNG")


def test_an_unknown_experiment_gets_one_line() -> None:
    ran = CliRunner().invoke(app, ["evaluate", "cubes"])
    assert ran.exit_code != 0
    assert "spheres, cylinder, handheld" in str(ran.exception) + ran.output


def test_an_interrupted_evaluation_goes_on(tmp_path: Path) -> None:
    """What was done before the interruption is kept; nothing is lost or done twice."""
    done: list[str] = []

    def work(name: str) -> dict[str, Any]:
        if name == "c" and "c" not in done:
            done.append(name)
            raise KeyboardInterrupt
        done.append(name)
        return {"value": name}

    for _ in range(2):
        cache = Cache(tmp_path / "x.json")
        try:
            results = [cache.get(name, lambda n=name: work(n)) for name in "abcd"]
        except KeyboardInterrupt:
            continue
    assert done == ["a", "b", "c", "c", "d"]
    assert [r and r["value"] for r in results] == list("abcd")


def test_a_report_reads_back_and_makes_a_page(tmp_path: Path) -> None:
    table = report.Table("T", ("a", "b"), [("1", "<2>")])
    one = report.Report("x", "Title", ["About."], [table], ["x.png"], {"n": 1})
    one.save(tmp_path)
    again = report.load(tmp_path / "x.json")
    assert again == one
    assert "&lt;2&gt;" in (tmp_path / "x.html").read_text()
    text = report.page([again], "evaluation/")
    assert "| 1 | <2> |" in text
    assert "evaluation/x.png" in text
    assert len(re.findall("simulated", text)) >= 3


def test_the_calibration_of_an_experiment_is_good_but_not_perfect() -> None:
    """Solved from noisy boards: it projects within a tenth of a pixel, and never exactly."""
    true = Rig.from_yaml(head_yaml("base6_wd20"))
    solved = Rig.from_yaml(calibrated(head_yaml("base6_wd20")))
    points = [(x, y, z) for x in (-3.0, 0.0, 3.0) for y in (-3.0, 0.0, 3.0) for z in (18.0, 20.0, 22.0)]
    off = abs(true.projector_pixel(points) - solved.projector_pixel(points)).max()
    assert 1e-4 < off < 0.3
