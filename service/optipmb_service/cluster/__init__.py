"""Which process has which stream, and where checkpoints are kept."""
