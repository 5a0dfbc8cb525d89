"""Links between the tracks of streams and sites: which of them are one object."""
