"""What the messages of one stream mean: pure, without I/O, threads or a clock of its own."""
