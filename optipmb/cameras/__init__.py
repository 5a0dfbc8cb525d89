"""Places on the ground of the boxes of a camera."""
