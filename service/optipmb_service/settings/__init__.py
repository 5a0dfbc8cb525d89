"""The settings of the service: which there are, how they are written, and where their values come from."""
