"""Export of samples as windows that need no tracklake to be read."""
