"""Samples (prediction origins) with their maneuvers and neighbors."""
