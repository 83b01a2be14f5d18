"""Tracks that start late, and the frames that are missing before them."""
