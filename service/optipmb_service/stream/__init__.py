"""Streams: their backlogs, turns, opening and recovery, and what they need of the network and the store."""
