"""Delimited text to typed columns with every line accounted for, from files or archives."""
