"""Streams around their sessions: backlogs, turns, opening and recovery, network inputs, writing of checkpoints."""
