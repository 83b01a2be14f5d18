"""What pages, cards and scores say of generated data."""

import pytest

from tracklake.schemas.origin import describe_synthetic, summarise_origins


def test_recorded_data_need_no_word():
    assert describe_synthetic({}) is None
    assert describe_synthetic({"01-upper": "recorded", "02-upper": "recorded"}) is None


def test_synthetic_data_are_called_so():
    assert describe_synthetic({"01-upper": "synthetic"}).startswith("Synthetic data: 01-upper was generated")
    both = describe_synthetic({"01-upper": "synthetic", "01-lower": "synthetic"})
    assert both.startswith("Synthetic data: all 2 subsets were generated")


def test_a_mixture_names_what_is_synthetic():
    origins = {f"{number:02}-upper": "synthetic" for number in range(1, 6)} | {"us-101-0750": "recorded"}
    assert "5 of 6 subsets were generated" in describe_synthetic(origins)
    assert "(01-upper, 02-upper, 03-upper, 04-upper, ...)" in describe_synthetic(origins)


@pytest.mark.parametrize(
    ("origins", "together"),
    [
        ((), "recorded"),
        (("recorded",), "recorded"),
        (("synthetic",) * 2, "synthetic"),
        (("recorded", "synthetic"), "mixed"),
    ],
)
def test_origins_together(origins, together):
    assert summarise_origins(origins) == together
