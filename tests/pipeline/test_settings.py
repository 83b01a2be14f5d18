"""Settings and protocols: what no one sets is the protocol's, and what cannot go together is refused."""

import pytest
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app, load_command
from tracklake.pipeline.settings import Settings
from tracklake.schemas.protocols import PROTOCOLS


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    """No tracklake.toml, no lake."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_nobody_sets_is_the_protocols(name):
    settings = Settings(protocol=name)
    assert settings.get_protocol() == PROTOCOLS[name]
    assert settings.get_split_recipe().name == PROTOCOLS[name].split
    # As plain values, which is how settings are sent to workers.
    assert Settings(**settings.model_dump(mode="json")).get_protocol() == PROTOCOLS[name]


def test_what_is_set_takes_its_place(tmp_path, monkeypatch):
    (tmp_path / "tracklake.toml").write_text('protocol = "mha-2020"\nsplit = "time-blocks"\nnearest = 0\n')
    monkeypatch.setenv("TRACKLAKE_MIN_FUTURE_S", "2")
    protocol = Settings(drop_error_findings=True).get_protocol()
    assert (protocol.name, protocol.split, protocol.nearest) == ("mha-2020", "time-blocks", 0)
    assert (protocol.min_future_s, protocol.drop_error_findings) == (2.0, True)
    assert (protocol.horizon_s, protocol.headline) == (3.0, "rmse-by-axis")
    assert Settings(split="csp-2018", nearest=4).get_protocol().nearest == 4


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"protocol": "mine"}, "expected one of csp, csp-2018, highd-flow-balanced, mha-2020, grid-2021"),
        ({"min_future_s": 5.1}, "expected 5 or less, the horizon of the protocol csp"),
        ({"protocol": "grid-2021", "min_future_s": 2.5}, "expected 2 or less, the horizon of the protocol grid-2021"),
        ({"protocol": "csp-2018", "splits": ["flow-balanced"]}, "expected 'csp-2018' among them"),
        ({"protocol": "csp-2018", "split": "time-blocks", "splits": ["csp-2018"]}, "expected 'time-blocks' among them"),
        ({"protocol": "mha-2020", "split_purge_s": 5.9}, "expected 6 or more, history and future"),
    ],
)
def test_what_does_not_go_together_is_refused(asked, message):
    with pytest.raises(ValueError, match=message):
        Settings(**asked)


def test_bounds_are_met():
    assert Settings(protocol="grid-2021", min_future_s=2, split_purge_s=4).get_protocol().min_future_ticks == 20
    assert Settings(min_future_s=5).get_protocol().min_future_ticks == 25
    assert Settings(protocol="csp-2018", splits=["csp-2018"]).get_split_recipes()[0].name == "csp-2018"


def test_splits_are_made_with_the_protocols_clock_and_share():
    recipes = {
        recipe.name: recipe for recipe in Settings(protocol="grid-2021", validation_part=True).get_split_recipes()
    }
    blocks = recipes["time-blocks"]
    assert (blocks.rate_hz, blocks.window_s, blocks.train_share, blocks.validation) == (10, 4.0, 0.7, True)
    assert {recipe.train_share for recipe in recipes.values()} == {0.7}
    assert {recipe.train_share for recipe in Settings().get_split_recipes()} == {0.8}


@pytest.mark.parametrize("command", ["run", "samples", "split", "tensors", "train", "evaluate", "report"])
def test_commands_take_a_protocol(command):
    options = {name for parameter in load_command(command).params for name in parameter.opts}
    assert "--protocol" in options


@pytest.mark.parametrize("command", [["run", "raw"], ["samples"], ["split"], ["tensors"], ["report"]])
def test_a_protocol_that_there_is_not_is_a_usage_error(command):
    done = CliRunner().invoke(app, [*command, "--protocol", "mine"])
    assert done.exit_code == 2
    assert "expected one of csp, csp-2018" in done.stderr
