"""Measurements of Skyloop's own delays, against the bare hand-over of the same bytes in the same run."""
