"""Published figures: as printed, marked as such, beside the protocols that they belong to."""

import pytest

from tracklake.schemas.evaluations import EVALUATIONS, FIGURES
from tracklake.schemas.protocols import PROTOCOLS
from tracklake.schemas.published_results import (
    CELL_ACCURACY,
    CELL_ACCURACY_S,
    CHOI_2021,
    KIM_2020,
    PUBLISHED,
    list_published_rows,
)
from tracklake.training.models import MODELS

ELSEWHERE = {"MHA-LSTM", "STDAN"}
"""Published models that we have none of."""


@pytest.mark.parametrize("protocol", list(PROTOCOLS))
def test_published_rows_keep_the_table_s_rules_and_are_never_taken_for_measured_ones(protocol):
    rows = EVALUATIONS.validate(list_published_rows(protocol), where=protocol)
    assert rows.height > 0
    assert rows["origin"].unique().to_list() == ["published"]
    assert (rows["reference"] != "").all()
    for column in ("n", "vehicles", "protocol_digest", "split", "part", "latency_ms", "nll_nats"):
        assert rows[column].null_count() == rows.height, column


def test_every_line_names_known_protocols_models_and_figures():
    for line in PUBLISHED:
        assert set(line.protocols) <= set(PROTOCOLS)
        assert line.model in MODELS or line.model in ELSEWHERE
        assert set(line.figures) <= set(FIGURES)
        assert all(len(values) == len(line.seconds) for values in line.figures.values())
        # An error that shrinks with time would be a slip of the pen.
        assert all(list(values) == sorted(values) for values in line.figures.values())
        own = {seconds for name in line.protocols for seconds in PROTOCOLS[name].scored_s}
        assert set(line.seconds) == own


def errors(protocol, model, dataset, column="rmse_m"):
    rows = list_published_rows(protocol).filter(model=model, dataset=dataset)
    return [group[column].to_list() for _, group in rows.group_by("reference", maintain_order=True)]


def test_some_of_them_as_printed():
    assert errors("csp-2018", "constant-velocity", "ngsim") == [[0.73, 1.78, 3.13, 4.78, 6.68]]
    assert errors("csp-2018", "cs-lstm", "highd") == []
    assert errors("highd-flow-balanced", "cs-lstm", "highd") == [[0.22, 0.61, 1.24, 2.10, 3.27]]
    assert [0.62, 1.29, 2.13, 3.20, 4.52] in errors("csp", "cs-lstm-m", "ngsim")
    assert errors("mha-2020", "attention-h4", "highd", "rmse_longitudinal_m") == [[0.43, 0.47, 0.89]]
    assert errors("mha-2020", "attention-h4", "highd", "rmse_lateral_m") == [[0.04, 0.06, 0.11]]
    assert errors("mha-2020", "attention-h4", "highd") == [[None] * 3]
    assert errors("grid-2021", "lstm-encoder-decoder", "own", "mae_m") == [[0.58, 0.82, 1.23, 1.47]]
    braking = errors("highd-flow-balanced", "cs-lstm-m", "highd", "longitudinal_accuracy")
    assert braking == [[0.9994] * 5]


def test_figures_of_other_recordings_are_left_out():
    def datasets(protocol, *present):
        return set(list_published_rows(protocol, present)["dataset"])

    assert datasets("csp", "all", "ngsim") == {"ngsim"}
    assert datasets("csp", "all", "highd", "ngsim") == {"highd", "ngsim"}
    assert datasets("csp-2018", "all", "highd") == set()
    assert datasets("grid-2021", "all", "highd") == {"own"}
    assert list_published_rows("my-own").height == 0


def test_cells_of_the_grid():
    assert PROTOCOLS["grid-2021"].scored_s == CELL_ACCURACY_S
    assert CELL_ACCURACY["lstm-encoder-decoder + forest"] == (0.8718, 0.8946, 0.9183, 0.9087)
    assert all(len(shares) == len(CELL_ACCURACY_S) and min(shares) > 0.8 for shares in CELL_ACCURACY.values())
    assert "2021" in CHOI_2021
    assert "split is unpublished" in KIM_2020
