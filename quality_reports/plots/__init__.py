"""Plots: those of the report as SVG text, and the reliability plot of an evaluation."""
