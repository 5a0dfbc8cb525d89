"""Recordings in MCAP files: written from the network, read back however they ended, played into a service.

A recording holds every message of the chosen streams byte for byte, on channels named by their Zenoh keys, and
messages with which Foxglove draws the tracks. Log time is when a message was received (ns since 1970 UTC), publish time
is the stamp in it. The packages that this needs are the extra `record` of the installation.
"""
