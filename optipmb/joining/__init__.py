"""Joining of the tracks of one object over gaps."""
