"""Pictures of tracks, viewers, and what commands draw in the terminal."""
