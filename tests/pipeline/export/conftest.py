"""Catalogs are not what these tests look at."""

from plain_catalogs import plain_catalogs as plain_catalogs
