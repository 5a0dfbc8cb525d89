"""State and parameters of the tracker, and the records that its stages share."""
