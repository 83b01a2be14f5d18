"""Prediction origins with their maneuvers and neighbors."""
