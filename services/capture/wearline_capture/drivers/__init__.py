"""Cameras: one Protocol, one file per kind."""
