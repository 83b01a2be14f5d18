"""Files that `tracklake predict --attention` writes: a drawing and a table per sample."""

import json

import numpy as np
import pytest
from drawn_moment import FAR, FAR_SAMPLE, OWN, OWN_SAMPLE, open_moment
from tensor_tables import TINY

from tracklake.pipeline.cli.predict import export_attention
from tracklake.training.models import find_model
from tracklake.training.plots.attention import draw_attention, map_attention


@pytest.mark.parametrize("markings", [(0.0, 4.0, 8.0), None])
def test_a_network_is_exported(tmp_path, markings):
    folder = open_moment(tmp_path / "moment", markings=markings)
    network = find_model("attention-h2").build(TINY)
    files = export_attention(folder, network, [FAR_SAMPLE, OWN_SAMPLE], tmp_path / "out")
    assert [file.name for file in files] == [
        f"b_{vehicle}_1.0s_attention{suffix}" for vehicle in (FAR, OWN) for suffix in (".svg", ".json")
    ]
    _, own = map_attention(folder, network, [FAR_SAMPLE, OWN_SAMPLE])
    assert files[2].read_bytes() == draw_attention(own).render(".svg")
    table = json.loads(files[3].read_text())
    for part, rows in table["attention"].items():
        np.testing.assert_allclose(np.sum(rows, axis=-1), 1, atol=1e-5, err_msg=part)
        assert np.shape(rows)[:2] == (2, 3)
    assert export_attention(folder, network, [], tmp_path / "out") == []
    with pytest.raises(IndexError):
        export_attention(folder, network, [99], tmp_path / "out")
