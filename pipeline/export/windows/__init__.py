"""Export of samples as windows that can be read without tracklake."""
