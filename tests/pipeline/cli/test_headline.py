"""The figures and next commands that `run` and `report` print at the end."""

import copy
import json

import pytest

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.summary import show_headline


@pytest.fixture(scope="module")
def quality(lake):
    return json.loads((lake.root / "reports" / "quality.json").read_text())


@pytest.mark.parametrize("scores", [[], [{"model": "constant-velocity", "part": "eval", "rows": []}]])
def test_training_is_not_proposed_where_nothing_was_scored(lake, quality, capsys, scores):
    show_headline(Terminal(), quality, lake.root / "reports", lake.root)
    assert f"train lstm --lake {lake.root}" in capsys.readouterr().out
    unscored = copy.deepcopy(quality) | {"model_scores": scores}
    assert unscored["headline"]["samples"] > 0
    show_headline(Terminal(), unscored, lake.root / "reports", lake.root)
    printed = capsys.readouterr().out
    assert "train lstm" not in printed
    assert f'sql "FROM subsets" --lake {lake.root}' in printed


def test_every_error_stands_with_its_number_of_samples(lake, quality, capsys):
    """Few samples look 3 s ahead in short recordings: their error may be less than at 2 s."""
    rows = [{"seconds": s, "rmse_m": rmse, "n": n} for s, rmse, n in ((1, 1.371, 1427), (3, 1.82, 29), (5, None, 0))]
    scored = quality | {"model_scores": [{"model": "mine", "part": "eval", "rows": rows}]}
    show_headline(Terminal(), scored, lake.root / "reports", lake.root)
    assert "1 s 1.37  3 s 1.82  (n = 1,427, 29)" in capsys.readouterr().out
