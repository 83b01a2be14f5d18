"""Settings and protocols: what no one sets is the protocol's, and what cannot go together is refused."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app, load_command
from tracklake.pipeline.settings import SettingError, Settings
from tracklake.schemas.protocols import PROTOCOLS


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    """No tracklake.toml, no lake, wide enough a terminal."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")


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
        ({"protocol": "mine"}, "setting protocol: no protocol is called mine; expected one of csp, csp-2018"),
        (
            {"protocol": "v2v-2021"},
            "setting protocol: v2v-2021 is for drives, and `tracklake onboard` uses it by itself",
        ),
        ({"min_future_s": 5.1}, "expected 5 or less, the horizon of the protocol csp"),
        ({"protocol": "grid-2021", "min_future_s": 2.5}, "expected 2 or less, the horizon of the protocol grid-2021"),
        ({"protocol": "csp-2018", "splits": ["flow-balanced"]}, "expected 'csp-2018' among them"),
        ({"protocol": "csp-2018", "split": "time-blocks", "splits": ["csp-2018"]}, "expected 'time-blocks' among them"),
        ({"split_eval_block": 0}, 'expected split = "time-blocks" with it'),
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


def refused(**options) -> str:
    with pytest.raises(SettingError) as caught:
        Settings(**options)
    return str(caught.value)


def test_a_file_is_found_above_and_its_paths_are_relative_to_it(tmp_path, monkeypatch):
    (tmp_path / "tracklake.toml").write_text('lake = "data"\ncolumns = "/etc/columns.toml"\nworkers = 3\n')
    assert Settings().lake == Path("data"), "as written where the file is in the working folder"
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    monkeypatch.chdir(below)
    found = Settings()
    assert (found.lake, found.columns, found.workers) == (tmp_path / "data", Path("/etc/columns.toml"), 3)
    (below / "tracklake.toml").write_text("workers = 5\n")
    assert (Settings().workers, Settings().lake) == (5, Path("lake")), "the nearest file alone"


def test_the_lakes_own_file_overrides_that_of_the_folder(tmp_path, monkeypatch):
    own = tmp_path / "data" / "tracklake.toml"
    own.parent.mkdir()
    (tmp_path / "tracklake.toml").write_text(
        'lake = "data"\nnearest = 1\nsplit_seed = 1\nworkers = 1\n[thresholds]\noverlap_m = 1\nhigh_jerk_mps3 = 1\n'
    )
    own.write_text("nearest = 2\nsplit_seed = 2\nworkers = 2\n[thresholds]\noverlap_m = 2\n")
    monkeypatch.setenv("TRACKLAKE_SPLIT_SEED", "3")
    monkeypatch.setenv("TRACKLAKE_WORKERS", "3")
    found = Settings(workers=4)
    assert (found.nearest, found.split_seed, found.workers) == (2, 3, 4)
    assert found.thresholds == {"overlap_m": 2.0, "high_jerk_mps3": 1.0}
    assert Settings(lake="elsewhere", workers=4).nearest == 1
    monkeypatch.chdir(own.parent)
    assert Settings(lake=".").nearest == 2, "one file, read once"
    monkeypatch.chdir(tmp_path)
    own.write_text('lake = "other"\n')
    assert "data/tracklake.toml:1: a lake's own file names no lake" in refused()


def test_what_is_wrong_is_named_with_its_place(tmp_path, monkeypatch):
    (tmp_path / "tracklake.toml").write_text(
        '# mine\nsplits = [\n  "csp-2018",\n  "no",\n]\nworker = 2\nmax_backward_share = 1.5\nsplit_block_s = nan\n'
    )
    said = refused().splitlines()
    assert "tracklake.toml:6: setting worker: unknown setting; did you mean workers?" in said
    assert "tracklake.toml:7: setting max_backward_share: expected 0 or more and 1 or less, got 1.5" in said
    assert "tracklake.toml:8: setting split_block_s: expected a finite number, got nan" in said
    assert any(line.startswith("tracklake.toml:2: setting splits.1: expected 'flow-balanced'") for line in said)
    (tmp_path / "tracklake.toml").write_text(
        "thresholds = 3\nnearest = 2.5\nsplit_seed = 'x'\n[lake]\nx = 1\n[on_ramp_lane]\nx = [1]\n[threshold]\n"
    )
    assert refused().splitlines() == [
        "tracklake.toml:4: setting lake: expected a path, got {'x': 1}",
        "tracklake.toml:1: setting thresholds: expected a table, got 3",
        "tracklake.toml:2: setting nearest: expected a whole number, got 2.5",
        "tracklake.toml:3: setting split_seed: expected a whole number, got 'x'",
        "tracklake.toml:6: setting on_ramp_lane: unknown setting; did you mean on_ramp_lanes?",
        "tracklake.toml:8: setting threshold: unknown setting; did you mean thresholds?",
    ], "tables have a line, too"
    (tmp_path / "tracklake.toml").write_text("[thresholds]\nhigh_jerk_mps3 = 9\nhigh_acceleration_mps2 = -3\n")
    message = "tracklake.toml:3: setting thresholds.high_acceleration_mps2: expected 0 or more (m/s2), got -3.0"
    assert refused() == message
    monkeypatch.setenv("TRACKLAKE_THRESHOLDS__HIGH_JERK_MPS3", "-1")
    assert "TRACKLAKE_THRESHOLDS__HIGH_JERK_MPS3: setting thresholds.high_jerk_mps3: expected 0 or more" in refused()
    monkeypatch.setenv("TRACKLAKE_THRESHOLDS", "{")
    assert refused() == 'TRACKLAKE_THRESHOLDS: expected JSON such as ["a"] or {"a": 1}, got \'{\''
    monkeypatch.setenv("TRACKLAKE_THRESHOLDS", "")
    assert refused(workers=0).startswith("setting workers: expected 1 or more, got 0")
    assert "thresholds: expected a number or a text, not true or false" in refused(thresholds={"overlap_m": True})
    assert refused(protocol="cps") == "setting protocol: no protocol is called cps; did you mean csp?"


def test_a_table_that_is_refused_as_a_whole_has_a_place(tmp_path, monkeypatch):
    message = "setting safety_thresholds: no measure is called ttc; did you mean ttc_s?"
    (tmp_path / "tracklake.toml").write_text("workers = 2\n[safety_thresholds]\nttc = 1.5\n")
    assert refused() == f"tracklake.toml:3: {message}"
    monkeypatch.setenv("TRACKLAKE_SAFETY_THRESHOLDS__TTC", "1.5")
    assert refused() == f"TRACKLAKE_SAFETY_THRESHOLDS__TTC: {message}"


def test_variables_that_are_no_settings_are_named_and_harmless(monkeypatch):
    monkeypatch.setenv("TRACKLAKE_WORKER", "3")
    monkeypatch.setenv("TRACKLAKE_THRESHOLDS__OVERLAP_M", "0.5")
    monkeypatch.setenv("TRACKLAKE_DEBUG", "0")
    done = CliRunner().invoke(app, ["config"])
    assert done.exit_code == 0
    assert done.stderr == (
        "warning: TRACKLAKE_WORKER: no setting has this name, so it has no effect; did you mean TRACKLAKE_WORKERS?\n"
    )


def test_config_shows_what_is_in_force_and_where_it_comes_from(tmp_path, monkeypatch):
    (tmp_path / "tracklake.toml").write_text("nearest = 4\n[thresholds]\n\nhigh_jerk_mps3 = 12\n")
    monkeypatch.setenv("TRACKLAKE_SPLIT_SEED", "7")
    done = CliRunner().invoke(app, ["config", "--lake", "mine", "--protocol", "mha-2020", "--json"])
    said = json.loads(done.stdout)
    assert said["files"] == ["tracklake.toml"]
    shown = {name: (row["value"], row["from"]) for name, row in said["settings"].items()}
    expected = {
        "lake": ("mine", "--lake"),
        "protocol": ("mha-2020", "--protocol"),
        "nearest": (4, "tracklake.toml:1"),
        "split_seed": (7, "TRACKLAKE_SPLIT_SEED"),
        "thresholds.high_jerk_mps3": (12.0, "tracklake.toml:4"),
        "thresholds.high_acceleration_mps2": (3.05, "default"),
        "min_future_s": (PROTOCOLS["mha-2020"].min_future_s, "protocol mha-2020"),
        "validation_part": (False, "default"),
    }
    assert {name: shown[name] for name in expected} == expected
    assert set(Settings.model_fields) == {name.partition(".")[0] for name in shown}
    assert "settings: tracklake.toml\n" in CliRunner().invoke(app, ["validate"]).stdout, "commands name the file"
    table = CliRunner().invoke(app, ["config"]).stdout
    assert table.startswith("files: tracklake.toml\n")
    assert [line.split() for line in table.splitlines() if line.startswith("thresholds.high_jerk")] == [
        ["thresholds.high_jerk_mps3", "12.0", "tracklake.toml:4"]
    ]


def test_the_page_names_every_setting():
    page = (Path(__file__).parents[2] / "docs" / "settings.md").read_text()
    assert [name for name in Settings.model_fields if name not in page] == []
