"""Streams: their backlogs, turns, opening and recovery, with their network inputs and their checkpoints."""
