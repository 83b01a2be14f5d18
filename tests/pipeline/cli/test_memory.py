"""Freed memory is kept by the process that asked for it, and objects are looked through no more often than needed."""

import platform
import subprocess
import sys

import pytest

REPEATED = """
import resource
from tracklake.pipeline.cli.memory import keep_freed_memory

done = keep_freed_memory()

def step():
    return [b"x" * 20_000_000 for _ in range(3)]  # 60 MB, all freed together

for _ in range(3):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    step()
print(done, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the settings are glibc's")
def test_repeated_steps_are_given_no_new_pages():
    run = subprocess.run([sys.executable, "-c", REPEATED], capture_output=True, text=True, check=True)
    done, faults = run.stdout.split()
    assert done == "True"
    assert int(faults) < 1000  # some 50,000 where nothing is kept


AT_EXIT = """
import atexit, gc
from tracklake.pipeline.cli.memory import collect_seldom

default = gc.get_threshold()[0]
atexit.register(lambda: print(gc.get_freeze_count() > 0))  # runs after what is registered later
collect_seldom()
atexit.register(lambda: print(gc.isenabled(), default < gc.get_threshold()[0] < 100_000, gc.get_freeze_count() == 0))
"""


def test_cycles_are_looked_for_seldom_until_the_exit_which_leaves_modules_out():
    run = subprocess.run([sys.executable, "-c", AT_EXIT], capture_output=True, text=True, check=True)
    assert run.stdout.splitlines() == ["True True True", "True"]
