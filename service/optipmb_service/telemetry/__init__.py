"""Metrics, health, logs and reports of problems."""
