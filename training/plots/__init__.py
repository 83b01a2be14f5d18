"""Drawings: samples with what came and what models say, attention, errors over the horizon."""
