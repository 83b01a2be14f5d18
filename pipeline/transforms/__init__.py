"""Pure functions from frames to frames, without files, clocks or the lake."""
