"""The command line, and how the service is started, supervised and ended."""
