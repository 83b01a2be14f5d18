"""Reconstruction: physically possible tracks near the recorded ones; noise, smoothing, bounds, causal filter."""
