"""Tracks in the world: latitude and longitude, zones and their events."""
