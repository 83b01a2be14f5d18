"""Derived tables for traffic research: car following, lane changes, safety, detectors, Edie's figures."""
