"""What every command offers: help by -h, completion in a fresh shell, a log on stderr or in a file."""

import os
import subprocess
import sys
import webbrowser
from pathlib import Path

import pytest

from tracklake.pipeline.cli.app import COMMANDS, load_command
from tracklake.pipeline.cli.logs import LOG, chosen

OPTIONS = {"--help", "-h", "--verbose", "-v", "--log-file", "--debug"}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_takes_the_options_of_all(command, name):
    for built in (load_command(name), *getattr(load_command(name), "commands", {}).values()):
        assert {option for parameter in built.params for option in parameter.opts} >= OPTIONS - {"--help", "-h"}
    shown = command.here(name, "-h")
    assert shown.code == 0
    assert [option for option in OPTIONS if option not in shown.out] == []


def test_completion_works_in_a_fresh_shell(tmp_path):
    """Installed as the README says, then used by a shell that has read its start-up file only."""
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "tracklake"
    script.write_text(f"#!{sys.executable}\nfrom tracklake.pipeline.cli.app import main\n\nmain()\n")
    script.chmod(0o755)
    path = f"{script.parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "HOME": str(tmp_path), "PATH": path}

    def call_bash(line: str) -> str:
        done = subprocess.run(["bash", "-c", line], env=environment, capture_output=True, text=True, check=True)
        return done.stdout

    assert "bash completion installed" in call_bash("tracklake --install-completion; true")
    words = "COMP_WORDS=(tracklake che); COMP_CWORD=1"
    assert call_bash(f'. ~/.bashrc; {words}; _tracklake_completion tracklake; echo "${{COMPREPLY[@]}}"') == "check\n"


def test_the_log_file_has_the_call_the_messages_and_the_end(command, tmp_path):
    log, handlers = tmp_path / "logs" / "tracklake.log", list(LOG.handlers)
    done = command.here("sql", "SELECT 1", "--lake", tmp_path / "none", "--log-file", log)
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith("error: ")
    assert "Traceback" not in done.err, "the file alone has it"
    text = log.read_text()
    for part in (
        "INFO    called as",
        "DEBUG   settings from option",
        "Traceback",
        "ERROR   error: ",
        "exit code 1 after",
    ):
        assert part in text, part
    assert command.here("--log-file", log, "config", "--json").code == 0
    assert log.read_text().startswith(text), "a file is appended to"
    assert "exit code 0 after" in log.read_text()
    assert (chosen.file, LOG.handlers) == (None, handlers), "nothing is left over for the next command"


def test_verbose_prints_what_is_not_shown_anyway(command, tmp_path):
    done = command.here("sql", "SELECT 1", "--lake", tmp_path / "none", "-v")
    assert done.err.count("no lake here") == 1
    assert "ended with exit code 1" in done.err
    assert "ended with" not in command.here("sql", "SELECT 1", "--lake", tmp_path / "none").err


def test_a_log_in_a_lake_and_one_that_cannot_be_written_are_refused(command, lake, tmp_path):
    inside = command.here("config", "--log-file", lake.root / "log")
    assert (inside.code, (lake.root / "log").exists()) == (1, False)
    assert "lies in the lake" in inside.err
    assert "another place with --log-file" in inside.err
    beyond = command.here("config", "--log-file", tmp_path)
    assert beyond.code == 1
    assert f"{tmp_path}: Is a directory" in beyond.err


@pytest.mark.usefixtures("plain_flows")
def test_the_report_opens_in_a_browser(command, lake, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or len(opened) == 1)
    first, second = (command.here("report", "--lake", lake.root, "--open") for _ in range(2))
    assert opened == [(lake.root / "reports" / "index.html").resolve().as_uri()] * 2
    assert Path(opened[0].removeprefix("file://")).is_file()
    assert (first.code, second.code) == (0, 0)
    assert "no web browser" not in first.err
    assert "note: there is no web browser to open the report with" in second.err
