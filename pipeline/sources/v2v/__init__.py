"""Logs of instrumented vehicles: messages, bags, and what a drive is made of."""
