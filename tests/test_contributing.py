"""The recipes of CONTRIBUTING.md, followed: a toy rule and a toy model; the files that the recipes name exist."""

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
from rule_scenes import lay_out
from tiny_network import write_tiny

from tracklake.quality_reports.rules.derived import prepare
from tracklake.quality_reports.rules.findings import find
from tracklake.quality_reports.rules.registry import RULES
from tracklake.quality_reports.rules.rule import Case, Rule
from tracklake.training import models
from tracklake.training.train import TrainConfig, train

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text()
SECTIONS = dict(re.findall(r"^## Add a (\w+)\n(.*?)(?=^## |\Z)", PAGE, flags=re.DOTALL | re.MULTILINE))


def run_recipe(section: str) -> dict:
    """Names that the section's Python blocks define, one after the other."""
    names: dict = {"__name__": "recipe"}
    for block in re.findall(r"```python\n(.*?)```", SECTIONS[section], flags=re.DOTALL):
        exec(block, names)
    return names


def test_a_rule_is_declared_as_the_recipe_has_it():
    rule = run_recipe("rule")["TOO_FAST"]
    assert isinstance(rule, Rule)
    assert rule.name not in {known.name for known in RULES}
    entries = {"vehicle_id": (3,) * 5, "frame": (1, 2, 3, 4, 5), "speed_mps": (69.0, 70.0, 70.5, 71.0, 69.0)}
    scene = lay_out(Case(entries=entries, breaks=(2, 3)))
    findings = find(prepare(scene, rule.reads), [rule]).select(
        "vehicle_id", "rule", "first_frame", "last_frame", "worst"
    )
    assert findings.rows() == [(3, "too_fast", 3, 4, 71.0)]
    strict = find(prepare(scene, rule.reads), [rule], {"too_fast_mps": 69.0})
    assert strict.select("first_frame", "last_frame").rows() == [(2, 4)]


def test_a_model_is_added_as_the_recipe_has_it(tmp_path, monkeypatch):
    names = run_recipe("model")
    entry = names["LINEAR_MOTION"]
    module = ModuleType("linear_motion")
    module.LinearMotion = names["LinearMotion"]
    monkeypatch.setitem(sys.modules, f"tracklake.training.models{entry.module}", module)
    monkeypatch.setitem(models.MODELS, entry.name, entry)
    folder = write_tiny(tmp_path / "tensors")
    metrics = train(entry.name, folder, tmp_path / "run", TrainConfig(steps=3))
    assert all(row["rmse_m"] > 0 for row in metrics["evaluation"]["horizons"])
    assert (tmp_path / "run" / "weights.pt").exists()


@pytest.mark.parametrize("section", ["rule", "dataset", "model", "command", "stage"])
def test_the_files_that_a_recipe_names_exist(section):
    rows = re.findall(r"^\| (`.+?) \|", SECTIONS[section], flags=re.MULTILINE)
    assert len(rows) >= 3
    for path in (path for row in rows for path in re.findall(r"`([^`]+)`", row)):
        folder = ROOT / path.split("<")[0].rpartition("/")[0]
        known = ROOT / path if "/" in path or path.endswith(".md") else None
        assert folder.is_dir() if "<" in path or known is None else known.exists(), path
