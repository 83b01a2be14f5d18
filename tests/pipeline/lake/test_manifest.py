"""What any commits and removals keep true of a manifest: no file is lost or leaked, none is both live and retired."""

from hypothesis import given
from hypothesis import strategies as st

from tracklake.pipeline.lake import Commit, LakeFile, Manifest

KEYS = st.sampled_from(["ingest/highd/01", "ingest/highd/02", "validate/highd/01", "split"])
COMMITS = st.tuples(KEYS, st.lists(st.integers(0, 2), max_size=3, unique=True))
STEPS = st.lists(st.one_of(COMMITS, st.sets(KEYS)), max_size=15)


def make_commit(key: str, numbers: list[int]) -> Commit:
    """Files of one's own, as their names carry the key and a fingerprint; some in one table, some in another."""
    files: dict[str, list[LakeFile]] = {"tracks": [], "vehicles": []}
    for number in numbers:
        table = "tracks" if number % 2 else "vehicles"
        files[table].append(LakeFile(f"{table}/{key}/{number}", rows=1, bytes=1))
    return Commit(key, f"{numbers}", files)


@given(STEPS)
def test_every_file_ever_committed_is_live_or_retired_with_the_step_that_let_go_of_it(steps):
    manifest = Manifest()
    held: dict[str, set[str]] = {}
    since: dict[str, int] = {}  # of files that are no longer live: the step, kept by hand
    for generation, step in enumerate(steps, start=1):
        before = manifest
        if isinstance(step, tuple):
            key, numbers = step
            manifest = manifest.add_commit(make_commit(key, numbers), generation)
            now = {**held, key: {f"{'tracks' if n % 2 else 'vehicles'}/{key}/{n}" for n in numbers}}
        else:
            manifest = manifest.remove_commits(step, generation)
            now = {key: paths for key, paths in held.items() if key not in step}
        for paths in held.values():
            since.update(dict.fromkeys(paths - {path for kept in now.values() for path in kept}, generation))
        held = now
        live = {path for paths in held.values() for path in paths}
        since = {path: step_number for path, step_number in since.items() if path not in live}
        assert manifest.live_paths() == live
        assert {item.path: item.generation for item in manifest.retired} == since
        assert len(manifest.retired) == len(since), "each once"
        assert not live & since.keys()
        assert manifest.commits.keys() == held.keys()
        assert manifest.generation == generation
        assert (manifest.lake_id, before.generation) == (before.lake_id, generation - 1), "the one before is untouched"


@given(st.sets(KEYS))
def test_removing_what_is_not_there_retires_nothing(keys):
    assert Manifest().remove_commits(keys, 1).retired == ()
