import numpy as np
from recorded import make_tracks, run_reconstruction

from tracklake.pipeline.transforms.reconstruction import motion
from tracklake.pipeline.transforms.reconstruction.programs import solve_programs


def test_pieces_that_fail_together_are_solved_alone_or_listed(monkeypatch):
    x = np.where(np.arange(80) < 40, np.arange(80.0), 79.0 - np.arange(80.0))
    tracks = make_tracks((1, range(80), x), (2, range(80), x + 100))
    whole = run_reconstruction(tracks)
    assert whole.unkept.is_empty()

    def fail_together(bands, rows, first, size):
        way, solved = solve_programs(bands, rows, first, size)
        return way, solved & (len(first) == 1)

    monkeypatch.setattr(motion, "solve_programs", fail_together)
    alone = run_reconstruction(tracks)
    assert alone.unkept.is_empty()
    np.testing.assert_allclose(alone.entries["x_m"], whole.entries["x_m"], atol=1e-3)

    def fail(bands, _rows, first, _size):
        return np.zeros(bands.shape[1]), np.zeros(len(first), bool)

    monkeypatch.setattr(motion, "solve_programs", fail)
    failed = run_reconstruction(tracks)
    assert set(failed.unkept["bound"]) >= {"backward"}
    assert failed.quality["bounds_not_kept"].item() == failed.unkept.height
