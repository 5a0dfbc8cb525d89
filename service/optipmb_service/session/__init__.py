"""Sessions: tracking of the messages of one stream, without I/O, threads or a clock of their own."""
