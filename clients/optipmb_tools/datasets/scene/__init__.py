"""Generated traffic scenes."""
