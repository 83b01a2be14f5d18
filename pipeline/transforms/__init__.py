"""Pure functions, frame in, frame out: no file, no clock, no lake."""
