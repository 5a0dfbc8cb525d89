"""What the tracker learns about a sensor from its detections."""
