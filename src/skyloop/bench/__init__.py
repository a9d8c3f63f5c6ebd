"""Measurements of Skyloop's own delays, beside the bare hand-over of the same bytes in the same run."""
