"""A session of a stream, without threads, clock and I/O: event time, order, window, tracking, and checkpoints of it."""
